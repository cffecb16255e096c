"""The earth's magnetic field as PX4 knows it: a coarse table of the world magnetic model.

PX4 carries WMM-2020 of 30 May 2024 as 16-bit numbers on a grid of 10 degrees and
interpolates linearly, so on board the declination is off by some tenths of a
degree. The table is made here anew from the model (NOAA, by pygeomag).
"""

import math
from functools import lru_cache

import pygeomag

_DATE = 2024.41257  # decimal year of PX4's table
_GRID = 10.0  # deg
# Quanta of PX4's table: the largest value over 32767, in deg, deg, nT.
_QUANTA = (0.00545143522, 0.00269892695, 2.04183483)
_GAUSS = 1e-5  # per nT


@lru_cache(maxsize=1)
def _model() -> pygeomag.GeoMag:
    return pygeomag.GeoMag(coefficients_file="wmm/WMM_2020.COF")


@lru_cache(maxsize=64)
def _node(latitude: float, longitude: float) -> tuple[float, float, float]:
    field = _model().calculate(glat=latitude, glon=longitude, alt=0.0, time=_DATE)
    declination, inclination, strength = (
        quantum * round(value / quantum)
        for value, quantum in zip((field.d, field.i, field.f), _QUANTA, strict=True)
    )
    return declination, inclination, strength * _GAUSS


def earth_field(latitude: float, longitude: float) -> tuple[float, float, float]:
    """The field at a place (deg): declination, inclination (deg, down) and strength (gauss)."""
    south = min(math.floor(latitude / _GRID) * _GRID, 90.0 - _GRID)
    west = min(math.floor(longitude / _GRID) * _GRID, 180.0 - _GRID)
    u, v = (latitude - south) / _GRID, (longitude - west) / _GRID
    result = [
        (1.0 - u) * ((1.0 - v) * sw + v * se) + u * ((1.0 - v) * nw + v * ne)
        for sw, se, nw, ne in zip(
            _node(south, west),
            _node(south, west + _GRID),
            _node(south + _GRID, west),
            _node(south + _GRID, west + _GRID),
            strict=True,
        )
    ]
    return result[0], result[1], result[2]
