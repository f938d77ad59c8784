"""Planetary vertex tables: radii on a grid of latitudes and longitudes, and plate models.

Grids are lines of latitude, longitude (deg) and radius, as the Thomas models of the PDS; plate
models are a count, numbered vertices, a count, numbered plates of three vertices; ICQ models are
the number q and six faces of (q + 1)^2 vertices each (Gaskell's implicitly connected
quadrilaterals).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.latlon import xyz_from_latlon

ANGLE_TOLERANCE_DEG = 1e-4  # of what tables print


class RadiiGrid(NamedTuple):
    """Radii (rows, cols) at latitudes (rows), pole to pole, and longitudes (cols), a whole turn.

    Angles are deg, ascending; the last column stands where the first does.
    """

    lats: FloatArray
    lons: FloatArray
    radii: FloatArray


def read_table(path: Path, longitude: str) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and triangles (m, 3) of a table; longitude "west" counts westward.

    Vertices on the poles and the seam occur several times. Raises ValueError for what is no table.
    """
    with path.open(encoding="ascii", errors="strict") as file:
        first = next((line.split() for line in file if line.split()), [])
        second = next((line.split() for line in file if line.split()), [])
    if len(first) <= 2 and longitude == "west":
        raise ValueError('a table of vertices has no longitudes; take longitude = "west" out')
    if len(first) == 1 and len(second) == 3:
        rows, q = np.loadtxt(path, skiprows=1, ndmin=2), int(first[0])
        if rows.shape != (6 * (q + 1) ** 2, 3):
            wanted = 6 * (q + 1) ** 2
            raise ValueError(f"{len(rows)} vertices; six faces of {q} x {q} have {wanted}")
        numbers = np.arange(len(rows)).reshape(6, q + 1, q + 1)
        return rows, np.concatenate([_quads(face) for face in numbers])
    if len(first) <= 2 and len(second) == 4:
        return _plates(path, int(first[0]))
    if len(first) != 3:
        raise ValueError(f"{len(first)} columns; wanted latitude, longitude, radius")
    return surface_of(read_grid(path), longitude)


def is_grid(path: Path) -> bool:
    """Whether a table that can be read is a grid of radii."""
    with path.open(encoding="ascii") as file:
        return len(next((line.split() for line in file if line.split()), [])) == 3


def read_grid(path: Path) -> RadiiGrid:
    """The radii of a table. Raises ValueError where they do not cover the body once."""
    rows = np.loadtxt(path, ndmin=2)
    lats, lons = np.unique(rows[:, 0]), np.unique(rows[:, 1])
    shape = lats.size, lons.size
    if len(rows) != lats.size * lons.size or min(shape) < 3:
        raise ValueError(
            f"{len(rows)} lines of {lats.size} latitudes and {lons.size} longitudes; wanted one "
            "line for each pair"
        )
    ends = abs(lats[0] + 90.0), abs(lats[-1] - 90.0)
    if max(ends) > ANGLE_TOLERANCE_DEG:
        raise ValueError(f"latitudes from {lats[0]:g} to {lats[-1]:g}; wanted both poles")
    turn, step = lons[-1] - lons[0], (lons[-1] - lons[0]) / (lons.size - 1)
    closed = abs(turn - 360.0) < ANGLE_TOLERANCE_DEG
    if not closed and abs(turn + step - 360.0) > ANGLE_TOLERANCE_DEG * lons.size:
        raise ValueError(f"longitudes from {lons[0]:g} to {lons[-1]:g}; wanted a whole turn")
    radii = np.full(shape, np.nan)
    radii[np.searchsorted(lats, rows[:, 0]), np.searchsorted(lons, rows[:, 1])] = rows[:, 2]
    if not closed:
        lons, radii = np.append(lons, lons[0] + 360.0), np.column_stack([radii, radii[:, 0]])
    if not radii.min() > 0.0:
        raise ValueError(f"a radius of {radii.min():g}; wanted all above 0, each place once")
    return RadiiGrid(lats, lons, radii)


def surface_of(grid: RadiiGrid, longitude: str) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and triangles (m, 3), counter-clockwise from outside, of a grid of radii."""
    lats, lons, radii = grid
    sign = -1.0 if longitude == "west" else 1.0
    lat, lon = np.radians(lats)[:, None], np.radians(sign * lons)[None, :]
    vertices = xyz_from_latlon(lat, lon, radii).reshape(-1, 3)
    vertices[np.repeat(np.abs(lats) > 90.0 - ANGLE_TOLERANCE_DEG, lons.size), :2] = 0.0
    numbers = np.arange(len(vertices)).reshape(radii.shape)
    # where the two ends of a parallel differ, the step between them is part of the surface
    faces = np.concatenate([_quads(numbers), _quads(numbers[:, [-1, 0]])])
    at = np.stack([lats[:, None] + 0.0 * lons, np.mod(lons, 360.0) + 0.0 * radii, radii], axis=-1)
    at[np.abs(lats) > 90.0 - ANGLE_TOLERANCE_DEG, :, 1] = 0.0
    corners = at.reshape(-1, 3)[faces]
    faces = faces[~(corners == np.roll(corners, -1, axis=1)).all(axis=2).any(axis=1)]
    return vertices, faces if sign > 0.0 else faces[:, ::-1]


def _plates(path: Path, count: int) -> tuple[FloatArray, IntArray]:
    with path.open(encoding="ascii") as file:
        lines = [line.split() for line in file if line.split()]
    both = len(lines[0]) == 2  # vertices and plates in one line
    vertices = np.array([line[1:4] for line in lines[1 : 1 + count]], dtype=np.float64)
    at = 1 + count if both else 2 + count
    plates = int(lines[0][1] if both else lines[at - 1][0])
    faces = np.array([line[1:4] for line in lines[at : at + plates]], dtype=np.int64) - 1
    if vertices.shape != (count, 3) or faces.shape != (plates, 3):
        raise ValueError(f"{len(lines)} lines for {count} vertices and {plates} plates")
    return vertices, faces


def _quads(numbers: IntArray) -> IntArray:
    """Two triangles for each quadrilateral of a grid of vertex numbers; rows go north."""
    a, b = numbers[:-1, :-1].ravel(), numbers[:-1, 1:].ravel()
    c, d = numbers[1:, 1:].ravel(), numbers[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
