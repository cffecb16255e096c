"""Compiled twins of the geodesy in `systems.frames`, for hot loops."""

import math

import numpy as np
from numba import njit

from systems.frames import ned_from_world
from systems.runway_frames import ecef_from_geodetic, geodetic_from_ecef, ned_from_ecef_rotation


@njit(cache=True)
def geodetic_from_world(p_W, origin):
    """Latitude (deg), longitude (deg) and altitude (m) of p_W (m), shape (3,); origin likewise."""
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    R_NE = ned_from_ecef_rotation(longitude, latitude)
    p_E = ecef_from_geodetic(longitude, latitude, origin[2]) + R_NE.T @ ned_from_world(p_W)
    geodetic = geodetic_from_ecef(p_E)
    return np.array([math.degrees(geodetic[1]), math.degrees(geodetic[0]), geodetic[2]])


@njit(cache=True)
def world_from_geodetic(geodetic, origin):
    """The inverse of `geodetic_from_world`, shape (3,), m."""
    latitude, longitude = math.radians(origin[0]), math.radians(origin[1])
    point = ecef_from_geodetic(math.radians(geodetic[1]), math.radians(geodetic[0]), geodetic[2])
    away = point - ecef_from_geodetic(longitude, latitude, origin[2])
    ned = ned_from_ecef_rotation(longitude, latitude) @ away
    return np.array([ned[1], ned[0], -ned[2]])
