"""Terrain: a grid of elevations with linear interpolation (Leonard 2016, 5.1).

The studies of section 6.1 use formulas along the runway's axis (Figs. 18, 19);
`TerrainFile` takes any grid from a GeoTIFF or an ESRI ASCII file. Elevations
are relative to the touch-down point, upwards.
"""

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tifffile
from numba import njit
from pydantic import Field

from systems.configuration import Finite, Metres, Positive, configuration
from systems.runway_frames import RunwayConfig, ned_from_geodetic

_ALONG = (-12000.0, 4000.0)  # m, extent of the formulas' grids along the runway


@dataclass(frozen=True)
class TerrainGrid:
    """Elevations at the points of a rectangular grid.

    Attributes
    ----------
    values : array, shape (rows, columns)
        Elevation above the touch-down point, m.
    geometry : array, shape (6,)
        `[a0, b0, da, db, cos H, sin H]`: row i lies at a = a0 + i da and column
        j at b = b0 + j db (m), where a runs along the heading H and b to the
        right of it, from the touch-down point.
    """

    values: np.ndarray
    geometry: np.ndarray

    def covers(self, north: float, east: float) -> bool:
        """Whether a point in NED (m) lies within the grid, not beyond its edges."""
        a0, b0, da, db, c, s = self.geometry
        i, j = (c * north + s * east - a0) / da, (c * east - s * north - b0) / db
        rows, columns = self.values.shape
        return bool(0.0 <= i <= rows - 1 and 0.0 <= j <= columns - 1)

    def elevation(self, north: float, east: float) -> float:
        """The elevation (m) of the ground at a point in NED (m)."""
        return float(elevation_at(self.values, self.geometry, north, east))


@njit(cache=True)
def elevation_at(values, geometry, north, east):
    """Linear interpolation in the grid of a `TerrainGrid`; constant beyond its edges."""
    a = geometry[4] * north + geometry[5] * east
    b = -geometry[5] * north + geometry[4] * east
    i = (a - geometry[0]) / geometry[2]
    j = (b - geometry[1]) / geometry[3]
    i = min(max(i, 0.0), values.shape[0] - 1.0)
    j = min(max(j, 0.0), values.shape[1] - 1.0)
    i0 = min(int(i), values.shape[0] - 2)
    j0 = min(int(j), values.shape[1] - 2)
    u, v = i - i0, j - j0
    near = (1.0 - v) * values[i0, j0] + v * values[i0, j0 + 1]
    far = (1.0 - v) * values[i0 + 1, j0] + v * values[i0 + 1, j0 + 1]
    return (1.0 - u) * near + u * far


def grid_along_runway(
    along: np.ndarray, elevation: np.ndarray, across: np.ndarray, runway: RunwayConfig
) -> TerrainGrid:
    """A grid in the runway's axes.

    Parameters
    ----------
    along, across : array, shape (rows,), (columns,)
        Evenly spaced Y_r and X_r, m.
    elevation : array, shape (rows, columns)
        m above the touch-down point.
    """
    heading = runway.heading_radians
    geometry = np.array(
        [
            along[0],
            across[0],
            along[1] - along[0],
            across[1] - across[0],
            math.cos(heading),
            math.sin(heading),
        ]
    )
    return TerrainGrid(np.ascontiguousarray(elevation, dtype=float), geometry)


def _profile(spacing: float, profile: np.ndarray, runway: RunwayConfig) -> TerrainGrid:
    along = np.arange(_ALONG[0], _ALONG[1] + spacing, spacing)
    across = np.array([-10000.0, 10000.0])
    values = np.interp(along, profile[:, 0], profile[:, 1])
    return grid_along_runway(along, np.repeat(values[:, None], 2, axis=1), across, runway)


@configuration
class FlatTerrain:
    """Flat, at the height of the touch-down point."""

    kind: Literal["flat"] = "flat"

    def grid(self, runway: RunwayConfig) -> TerrainGrid:
        """The grid of elevations about `runway`."""
        return _profile(4000.0, np.array([[-1.0, 0.0], [1.0, 0.0]]), runway)


@configuration
class SlopeTerrain:
    """Descends towards the touch-down point until `until` before it, then flat (Fig. 18)."""

    kind: Literal["slope"] = "slope"
    gradient: Finite = 0.03  # 1, 3 %: the laser underestimates the height (6.1, Table 12)
    until: Positive = 300.0  # m before the touch-down point

    def grid(self, runway: RunwayConfig) -> TerrainGrid:
        """The grid of elevations about `runway`."""
        _require_on_grid("until", self.until)
        far = _ALONG[0]
        top = self.gradient * (-far - self.until)
        return _profile(20.0, np.array([[far, top], [-self.until, 0.0]]), runway)


@configuration
class CliffTerrain:
    """Lower by `drop` until `at` before the touch-down point, then flat (Figs. 18, 36)."""

    kind: Literal["cliff"] = "cliff"
    drop: Metres = 20.0  # m: the laser overestimates the height
    at: Positive = 300.0  # m before the touch-down point

    def grid(self, runway: RunwayConfig) -> TerrainGrid:
        """The grid of elevations about `runway`."""
        _require_on_grid("at", self.at)
        return _profile(5.0, _step(self.at, -self.drop), runway)


@configuration
class PlateauTerrain:
    """The reversed cliff (Table 10, case 2): higher by `rise` until `at`, then flat."""

    kind: Literal["plateau"] = "plateau"
    rise: Metres = 20.0  # m
    at: Positive = 300.0  # m before the touch-down point

    def grid(self, runway: RunwayConfig) -> TerrainGrid:
        """The grid of elevations about `runway`."""
        _require_on_grid("at", self.at)
        return _profile(5.0, _step(self.at, self.rise), runway)


@configuration
class ObstacleTerrain:
    """Flat with one obstacle across the approach, 15 m along it and 10 m high (Fig. 18)."""

    kind: Literal["obstacle"] = "obstacle"
    length: Positive = 15.0  # m, along the approach
    height: Metres = 10.0  # m
    at: Positive = 300.0  # m before the touch-down point, the far side

    def grid(self, runway: RunwayConfig) -> TerrainGrid:
        """The grid of elevations about `runway`."""
        _require_on_grid("at", self.at + self.length)
        a, b, h = -self.at - self.length, -self.at, self.height
        return _profile(2.5, np.array([[a - 2.5, 0.0], [a, h], [b, h], [b + 2.5, 0.0]]), runway)


@configuration
class CoastalTerrain:
    """An airfield on a plateau above the sea, like Figs. 8 and 42.

    The cliff crosses the approach obliquely; the plateau rolls gently away
    from the runway and is flat about it.
    """

    kind: Literal["coastal"] = "coastal"
    cliff: Positive = 900.0  # m before the touch-down point, on the runway's axis
    obliquity: Finite = 35.0  # deg, of the cliff line against the square to the runway
    steepness: Positive = 60.0  # m, from the sea to the edge
    undulation: Metres = 6.0  # m, amplitude of the plateau's rolling

    def grid(self, runway: RunwayConfig) -> TerrainGrid:
        """The grid of elevations about `runway`; the sea is at mean sea level."""
        _require_on_grid("cliff", self.cliff)
        along = np.arange(_ALONG[0], _ALONG[1] + 20.0, 20.0)
        across = np.arange(-8000.0, 8001.0, 40.0)
        Y, X = np.meshgrid(along, across, indexing="ij")
        inland = Y + self.cliff + math.tan(math.radians(self.obliquity)) * X
        away = np.clip((np.hypot(X, np.maximum(-Y - 300.0, 0.0)) - 150.0) / 1500.0, 0.0, 1.0)
        plateau = self.undulation * away * np.sin(X / 700.0 + 0.4) * np.cos(Y / 900.0)
        sea = -runway.altitude
        blend = np.clip(inland / self.steepness + 0.5, 0.0, 1.0)
        return grid_along_runway(along, sea + (plateau - sea) * blend, across, runway)


@configuration
class TerrainFile:
    """Elevations from a GeoTIFF (.tif, .tiff) or an ESRI ASCII grid (.asc).

    The file's horizontal coordinates are longitude and latitude in degrees
    (WGS84) or east and north in metres; in the latter case the touch-down
    point's easting and northing have to be given.
    """

    kind: Literal["file"] = "file"
    path: str  # the file
    coordinates: Literal["degrees", "metres"] = "degrees"
    easting: Finite = 0.0  # m, of the touch-down point, for coordinates in metres
    northing: Finite = 0.0  # m

    def grid(self, runway: RunwayConfig) -> TerrainGrid:
        """The grid of elevations about `runway`.

        Raises
        ------
        ValueError
            Names the file and what was expected of it.
        """
        values, west, north, step_x, step_y = read_grid(Path(self.path))
        rows, columns = values.shape
        east = west + (columns - 1) * step_x
        south = north - (rows - 1) * step_y
        if self.coordinates == "degrees":
            if not (-180.0 <= west < east <= 360.0 and -90.0 <= south < north <= 90.0):
                raise ValueError(
                    f"{self.path}: expected longitudes and latitudes in degrees, found "
                    f"{west} to {east} by {south} to {north}: set coordinates to metres?"
                )
            # a plane through the runway: the meridian and the parallel of its touch-down point
            h = runway.altitude
            n = [
                ned_from_geodetic(np.array([y, runway.longitude, h]), runway)[0]
                for y in (south, north)
            ]
            e = [
                ned_from_geodetic(np.array([runway.latitude, x, h]), runway)[1]
                for x in (west, east)
            ]
        else:
            n = [south - self.northing, north - self.northing]
            e = [west - self.easting, east - self.easting]
        if not (n[0] <= 0.0 <= n[1] and e[0] <= 0.0 <= e[1]):
            degrees = west <= runway.longitude <= east and south <= runway.latitude <= north
            raise ValueError(
                f"{self.path}: expected a grid that covers the touch-down point, but it spans "
                f"{n[0]:.0f} to {n[1]:.0f} m north and {e[0]:.0f} to {e[1]:.0f} m east of it"
                + (": set coordinates to degrees?" if degrees else "")
            )
        geometry = np.array(
            [n[0], e[0], (n[1] - n[0]) / (rows - 1), (e[1] - e[0]) / (columns - 1), 1.0, 0.0]
        )
        relative = np.ascontiguousarray(values[::-1]) - runway.altitude
        return TerrainGrid(relative, geometry)


Terrain = Annotated[
    FlatTerrain
    | SlopeTerrain
    | CliffTerrain
    | PlateauTerrain
    | ObstacleTerrain
    | CoastalTerrain
    | TerrainFile,
    Field(discriminator="kind"),
]


def _require_on_grid(field: str, distance: float) -> None:
    if distance >= -_ALONG[0]:
        raise ValueError(
            f"terrain.{field}: expected less than {-_ALONG[0]:g} m before the touch-down point, "
            f"where the terrain's grid ends, found {distance:g}"
        )


def _step(at: float, elevation: float) -> np.ndarray:
    return np.array([[-at - 5.0, elevation], [-at, 0.0]])


def read_grid(path: Path) -> tuple[np.ndarray, float, float, float, float]:
    """Read an elevation grid, its first row the northernmost.

    Returns
    -------
    tuple
        Elevations (m above mean sea level), shape (rows, columns), then the
        coordinates of the first sample (west, north) and the two positive
        steps, in the file's units.

    Raises
    ------
    ValueError
        For a file that is missing, of another kind, damaged, or with holes.
    """
    if not path.is_file():
        raise ValueError(f"{path}: expected an elevation grid, but there is no such file")
    suffix = path.suffix.lower()
    if suffix in (".tif", ".tiff"):
        values, west, north, step_x, step_y, nodata = _read_geotiff(path)
    elif suffix == ".asc":
        values, west, north, step_x, step_y, nodata = _read_esri_ascii(path)
    else:
        raise ValueError(f"{path}: expected a GeoTIFF (.tif, .tiff) or an ESRI ASCII grid (.asc)")
    if values.ndim != 2 or min(values.shape) < 2:
        found = " x ".join(str(length) for length in values.shape)
        raise ValueError(f"{path}: expected one band of at least 2 x 2 elevations, found {found}")
    if not (math.isfinite(west + north) and 0.0 < step_x < math.inf and 0.0 < step_y < math.inf):
        raise ValueError(
            f"{path}: expected a finite origin and cells of positive size, found steps of "
            f"{step_x:g} and {step_y:g} from ({west:g}, {north:g})"
        )
    if not np.isfinite(values).all() or (nodata is not None and (values == nodata).any()):
        raise ValueError(f"{path}: expected an elevation at every point, but some are missing")
    return values, west, north, step_x, step_y


def _read_esri_ascii(path: Path) -> tuple[np.ndarray, float, float, float, float, float | None]:
    wanted = "the ESRI ASCII header ncols, nrows, xllcorner, yllcorner, cellsize"
    header: dict[str, float] = {}
    try:
        lines = path.read_text(encoding="ascii").splitlines()
        first = 0
        while first < len(lines) and lines[first][:1].isalpha():
            name, value = lines[first].split()
            header[name.lower()] = float(value)
            first += 1
        columns, rows, cell = int(header["ncols"]), int(header["nrows"]), header["cellsize"]
        centred = "xllcenter" in header
        x = header["xllcenter"] if centred else header["xllcorner"] + 0.5 * cell
        y = header["yllcenter"] if centred else header["yllcorner"] + 0.5 * cell
    except (ValueError, KeyError, OverflowError) as error:
        raise ValueError(f"{path}: expected {wanted}") from error
    if columns < 2 or rows < 2 or not cell > 0.0:
        raise ValueError(f"{path}: expected at least 2 x 2 cells of positive size in the header")
    body = [line.split() for line in lines[first:] if line.strip()]
    if len(body) == rows:  # else the lines are no rows, which the format allows
        for row, line in enumerate(body, start=1):
            if len(line) != columns:
                raise ValueError(
                    f"{path}: expected {columns} elevations in row {row} (ncols), found {len(line)}"
                )
    try:
        values = np.array([value for line in body for value in line], dtype=float)
    except ValueError as error:
        raise ValueError(f"{path}: expected numbers after the header") from error
    if values.size != rows * columns:
        raise ValueError(
            f"{path}: expected {rows} x {columns} elevations after the header, found {values.size}"
        )
    north = y + (rows - 1) * cell
    return values.reshape(rows, columns), x, north, cell, cell, header.get("nodata_value")


def _read_geotiff(path: Path) -> tuple[np.ndarray, float, float, float, float, float | None]:
    log = logging.getLogger("tifffile")
    level = log.level
    log.setLevel(logging.CRITICAL)  # what it would log of a broken file is said below
    try:
        with tifffile.TiffFile(path) as tiff:
            page = tiff.pages.first
            values = page.asarray().astype(float)
            tags = {name: page.tags[name].value for name in _GEOTIFF_TAGS if name in page.tags}
            keys = page.geotiff_tags or {}
        scale, tie = (
            [float(value) for value in np.ravel(tags.get(name, ()))] for name in _GEOTIFF_TAGS[:2]
        )
        marker = tags.get("GDAL_NODATA")
        nodata = None if marker is None else float(str(marker).strip("\x00 "))
    except (tifffile.TiffFileError, ValueError, OSError, IndexError) as error:
        why = "it has no page" if isinstance(error, IndexError) else error
        raise ValueError(f"{path}: expected a readable GeoTIFF ({why})") from error
    finally:
        log.setLevel(level)
    if len(scale) < 2 or len(tie) < 6:
        raise ValueError(f"{path}: expected a GeoTIFF with ModelPixelScale and ModelTiepoint tags")
    step_x, step_y = scale[:2]
    column, row, _, x, y, _ = tie[:6]
    # RasterPixelIsArea (1, the default): the tie point is the pixel's corner, not its centre
    raster_type = keys.get("GTRasterTypeGeoKey", 1)
    half = 0.5 if int(raster_type) == 1 else 0.0
    west = x + (half - column) * step_x
    north = y - (half - row) * step_y
    return values, west, north, step_x, step_y, nodata


_GEOTIFF_TAGS = ("ModelPixelScaleTag", "ModelTiepointTag", "GDAL_NODATA")
