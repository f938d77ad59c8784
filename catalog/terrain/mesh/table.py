"""Planetary vertex tables: radii on a grid of latitudes and longitudes, and plate models.

Grids are lines of latitude, longitude (deg) and radius, as the Thomas models of the PDS; plate
models are a count, vertices, a count, plates of three vertices, with or without numbers before
them; ICQ models are the number q and six faces of (q + 1)^2 vertices each (Gaskell's implicitly
connected quadrilaterals). Columns are set apart by blanks or commas.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
    first, second = _read_beginning(path)
    if len(first) <= 2 and longitude == "west":
        raise ValueError('a table of vertices has no longitudes; take longitude = "west" out')
    if len(first) > 2 or len(second) not in (3, 4):
        if len(first) != 3:
            raise ValueError(f"{len(first)} columns; wanted latitude, longitude, radius")
        return make_surface(read_grid(path), longitude)
    counts = [_count(word, path) for word in first]
    with _open_lines(path) as lines:
        next(lines)
        rows = _read_numbers(islice(lines, counts[0]))
        after = next(lines, "").split()
        if len(counts) == 1 and len(after) == rows.shape[1] == 3:
            more_rows = _read_numbers(chain([" ".join(after)], lines))
            return _make_icq(np.concatenate([rows, more_rows]), counts[0])
        if len(counts) == 2:
            plates = _read_numbers(chain([" ".join(after)], lines), np.int64)
        else:
            counts.append(_count(" ".join(after), path))
            plates = _read_numbers(lines, np.int64)
    if [len(rows), len(plates)] != counts or plates.shape[1] not in (3, 4):
        raise ValueError(f"{len(rows)} vertices and {len(plates)} plates; it states {counts}")
    return rows[:, -3:], _find_vertices(plates[:, -3:], rows)


def is_grid(path: Path) -> bool:
    """Whether a table that can be read is a grid of radii."""
    return len(_read_beginning(path)[0]) == 3


def is_vertex_face_table(path: Path) -> bool:
    """Whether a table is lines "v x y z" and "f i j k"."""
    return _read_beginning(path)[0][:1] == ["v"]


def read_grid(path: Path) -> RadiiGrid:
    """The radii of a table. Raises ValueError where they do not cover the body once."""
    with _open_lines(path) as lines:
        rows = _read_numbers(lines)
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


def make_surface(grid: RadiiGrid, longitude: str) -> tuple[FloatArray, IntArray]:
    """Vertices (n, 3) and triangles (m, 3), counter-clockwise from outside, of a grid of radii."""
    lats, lons, radii = grid
    sign = -1.0 if longitude == "west" else 1.0
    lat, lon = np.radians(lats)[:, None], np.radians(sign * lons)[None, :]
    vertices = xyz_from_latlon(lat, lon, radii).reshape(-1, 3)
    vertices[np.repeat(np.abs(lats) > 90.0 - ANGLE_TOLERANCE_DEG, lons.size), :2] = 0.0
    numbers = np.arange(len(vertices)).reshape(radii.shape)
    # where the two ends of a parallel differ, the step between them is part of the surface
    faces = np.concatenate([_split_quads(numbers), _split_quads(numbers[:, [-1, 0]])])
    at = np.stack([lats[:, None] + 0.0 * lons, np.mod(lons, 360.0) + 0.0 * radii, radii], axis=-1)
    at[np.abs(lats) > 90.0 - ANGLE_TOLERANCE_DEG, :, 1] = 0.0
    corners = at.reshape(-1, 3)[faces]
    faces = faces[~(corners == np.roll(corners, -1, axis=1)).all(axis=2).any(axis=1)]
    return vertices, faces if sign > 0.0 else faces[:, ::-1]


@contextmanager
def _open_lines(path: Path) -> Iterator[Iterator[str]]:
    """Lines of a table that are not blank, without commas and comments."""
    with path.open(encoding="ascii", errors="strict") as file:
        yield filter(None, (line.partition("#")[0].replace(",", " ").strip() for line in file))


def _read_beginning(path: Path) -> tuple[list[str], list[str]]:
    """The words of the first two lines."""
    with _open_lines(path) as lines:
        return next(lines, "").split(), next(lines, "").split()


def _read_numbers(lines: Iterator[str], kind: type[np.generic] = np.float64) -> NDArray[Any]:
    """The numbers (n, columns) of lines. Raises ValueError for none."""
    first = next(lines, None)
    if first is None:
        raise ValueError("it ends where numbers are wanted")
    rows = np.loadtxt(chain([first], lines), dtype=kind, ndmin=2)
    if not np.isfinite(rows).all():
        raise ValueError("a number that is not finite")
    return rows


def _count(word: str, path: Path) -> int:
    """A count of lines, of which each takes six bytes at least."""
    if not (word.isdecimal() and len(word) < 12 and 0 < 6 * int(word) <= path.stat().st_size):
        raise ValueError(f"it states {word[:20]!r} lines, which it has not")
    return int(word)


def _make_icq(vertices: FloatArray, q: int) -> tuple[FloatArray, IntArray]:
    wanted = 6 * (q + 1) ** 2
    if len(vertices) != wanted:
        raise ValueError(f"{len(vertices)} vertices; six faces of {q} x {q} have {wanted}")
    numbers = np.arange(wanted).reshape(6, q + 1, q + 1)
    return vertices, np.concatenate([_split_quads(face) for face in numbers])


def _find_vertices(plates: IntArray, rows: FloatArray) -> IntArray:
    """Places of the vertices that plates name: by the numbers before them, else from 1."""
    names = rows[:, 0] if rows.shape[1] == 4 else np.arange(1.0, len(rows) + 1.0)
    order = np.argsort(names, kind="stable")
    at = np.searchsorted(names[order], plates).clip(max=len(rows) - 1)
    missing = names[order][at] != plates
    if missing.any():
        raise ValueError(f"a plate names vertex {plates[missing][0]}, which there is none of")
    places: IntArray = order[at]
    return places


def _split_quads(numbers: IntArray) -> IntArray:
    """Two triangles for each quadrilateral of a grid of vertex numbers; rows go north."""
    a, b = numbers[:-1, :-1].ravel(), numbers[:-1, 1:].ravel()
    c, d = numbers[1:, 1:].ravel(), numbers[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
