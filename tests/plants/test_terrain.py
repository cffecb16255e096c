"""Elevation grids: interpolation, the thesis's terrains, files good and bad."""

import math

import numpy as np
import pytest
import tifffile
from scipy.interpolate import RegularGridInterpolator

from plants.terrain import (
    CliffTerrain,
    CoastalTerrain,
    FlatTerrain,
    ObstacleTerrain,
    PlateauTerrain,
    SlopeTerrain,
    TerrainFile,
    elevation_at,
    read_grid,
)
from systems.runway_frames import RunwayConfig, ned_from_runway

RUNWAY = RunwayConfig()


def before(terrain, distance, right=0.0):
    grid = terrain.grid(RUNWAY)
    p = ned_from_runway(np.array([right, -distance, 0.0]), RUNWAY.heading_radians)
    return grid.elevation(p[0], p[1])


def test_interpolation_agrees_with_scipy():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(7, 5))
    geometry = np.array([-30.0, 10.0, 10.0, 20.0, 1.0, 0.0])
    reference = RegularGridInterpolator(
        (np.arange(-30.0, 31.0, 10.0), np.arange(10.0, 91.0, 20.0)), values
    )
    for a, b in rng.uniform((-30.0, 10.0), (30.0, 90.0), size=(50, 2)):
        assert elevation_at(values, geometry, a, b) == pytest.approx(reference((a, b)).item())
    assert elevation_at(values, geometry, 500.0, -500.0) == values[-1, 0]  # constant beyond


@pytest.mark.parametrize(
    ("terrain", "expected"),
    [
        (FlatTerrain(), {1000.0: 0.0, 0.0: 0.0}),
        (SlopeTerrain(), {1000.0: 21.0, 300.0: 0.0, 100.0: 0.0}),
        (CliffTerrain(), {1000.0: -20.0, 310.0: -20.0, 299.0: 0.0}),
        (PlateauTerrain(), {1000.0: 20.0, 310.0: 20.0, 299.0: 0.0}),
        (ObstacleTerrain(), {330.0: 0.0, 312.0: 10.0, 301.0: 10.0, 290.0: 0.0}),
    ],
)
def test_terrains_of_the_thesis(terrain, expected):
    for distance, elevation in expected.items():
        assert before(terrain, distance) == pytest.approx(elevation, abs=0.2)


def test_the_coastal_airfield_stands_on_a_cliff():
    terrain = CoastalTerrain()
    assert before(terrain, 0.0) == pytest.approx(0.0, abs=0.1)
    assert before(terrain, 200.0) == pytest.approx(0.0, abs=0.1)
    assert before(terrain, 3000.0) == pytest.approx(-RUNWAY.altitude)
    # the cliff is oblique: the sea reaches nearer on the left
    assert before(terrain, 600.0, right=-1500.0) < -80.0
    assert abs(before(terrain, 600.0, right=1500.0)) < 10.0


def write_geotiff(path, values, west, north, step, raster_type=1):
    keys = (1, 1, 0, 2, 1024, 0, 1, 2, 1025, 0, 1, raster_type)
    tifffile.imwrite(
        path,
        values.astype(np.float32),
        extratags=[
            (33550, 12, 3, (step, step, 0.0), True),
            (33922, 12, 6, (0.0, 0.0, 0.0, west, north, 0.0), True),
            (34735, 3, len(keys), keys, True),
        ],
    )


def test_geotiff_in_degrees(tmp_path):
    """A plane that rises to the north and to the east comes back as that plane."""
    path = tmp_path / "plane.tif"
    step = 0.001
    west, north = RUNWAY.longitude - 0.02, RUNWAY.latitude + 0.02
    latitude = north - step * (np.arange(41) + 0.5)
    longitude = west + step * (np.arange(41) + 0.5)
    y, x = np.meshgrid(latitude, longitude, indexing="ij")
    metres = math.radians(1.0) * 6.37e6
    easting = (x - RUNWAY.longitude) * metres * math.cos(math.radians(RUNWAY.latitude))
    values = RUNWAY.altitude + 0.01 * (y - RUNWAY.latitude) * metres + 0.02 * easting
    write_geotiff(path, values, west, north, step)
    grid = TerrainFile(path=str(path)).grid(RUNWAY)
    assert grid.elevation(0.0, 0.0) == pytest.approx(0.0, abs=0.1)
    assert grid.elevation(1000.0, 0.0) == pytest.approx(10.0, abs=0.15)
    assert grid.elevation(0.0, 1000.0) == pytest.approx(20.0, abs=0.25)


@pytest.mark.parametrize(("raster_type", "shift"), [(1, 15.0), (2, 0.0)])
def test_geotiff_pixels_are_areas_or_points(tmp_path, raster_type, shift):
    path = tmp_path / "grid.tif"
    write_geotiff(path, np.zeros((3, 4)), 1000.0, 5000.0, 30.0, raster_type)
    _, west, north, step_x, step_y = read_grid(path)
    assert (west, north, step_x, step_y) == (1000.0 + shift, 5000.0 - shift, 30.0, 30.0)


ASCII = """ncols 3
nrows 2
xllcorner 90.0
yllcorner 180.0
cellsize 10.0
nodata_value -9999
95 95 95
89 89 92
"""


def test_esri_ascii_in_metres(tmp_path):
    path = tmp_path / "grid.asc"
    path.write_text(ASCII)
    terrain = TerrainFile(path=str(path), coordinates="metres", easting=100.0, northing=190.0)
    grid = terrain.grid(RUNWAY)
    # cell centres lie at 95, 105, 115 east and 185, 195 north
    assert grid.elevation(-5.0, -5.0) == pytest.approx(0.0)
    assert grid.elevation(5.0, -5.0) == pytest.approx(6.0)
    assert grid.elevation(0.0, 0.0) == pytest.approx(3.0)
    assert grid.elevation(-5.0, 15.0) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.asc", "no header\n1 2 3", "expected the ESRI ASCII header"),
        ("b.asc", ASCII.replace("92", ""), "expected 3 elevations in row 2 .ncols., found 2"),
        ("c.asc", ASCII.replace("92", "x"), "expected numbers after the header"),
        ("d.asc", ASCII.replace("92", "-9999"), "expected an elevation at every point"),
        ("e.asc", ASCII.replace("cellsize 10.0", "cellsize 0"), "cells of positive size"),
        ("f.tif", "not a TIFF", "expected a readable GeoTIFF"),
        ("g.png", "", "expected a GeoTIFF"),
        ("h.asc", ASCII, "expected longitudes and latitudes in degrees"),
    ],
)
def test_bad_grids_are_refused_in_one_sentence(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        TerrainFile(path=str(path)).grid(RUNWAY)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_missing_and_distant_grids_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        TerrainFile(path=str(tmp_path / "none.tif")).grid(RUNWAY)
    path = tmp_path / "far.asc"
    path.write_text(ASCII)
    with pytest.raises(ValueError, match="covers the touch-down point"):
        TerrainFile(path=str(path), coordinates="metres").grid(RUNWAY)


def test_a_tiff_without_georeference_is_refused(tmp_path):
    path = tmp_path / "picture.tif"
    tifffile.imwrite(path, np.zeros((4, 4), np.float32))
    with pytest.raises(ValueError, match="ModelPixelScale"):
        read_grid(path)
