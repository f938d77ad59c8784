"""Cast shadows on a map grid of a curved body, by one sweep away from the Sun.

All rays to the Sun are parallel straight lines in the frame of the grid's centre. There the body
falls away below the tangent plane, so a node stands at z = (R + h) cos(angle from the centre) - R
and a ray that rises by tan(elevation) a metre of map is the edge of a shadow. Parallel lines one
node apart follow the Sun's azimuth across the grid; each carries the highest ray that the ground
behind it has thrown, and a node is compared with the two lines that it lies between. Only that one
interpolation is made, so a shadow's edge does not blur with its length.

Map x and y stand for the tangent plane's: wrong by (rho / 2R)^2 of a shadow's length (a five
thousandth at the rim of a 100 km tile on the Moon). The Sun is a point (its disc is 0.5 deg wide).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.geometry.kernel import kernel

FloatArray = NDArray[np.float64]
HeightGrid = NDArray[np.float32]
BoolGrid = NDArray[np.bool_]

NOTHING = -1e30  # height of no ground
NODE_TOLERANCE_M = 1e-3  # float32 heights of 1e4 m are good to this


@kernel
def _oriented(
    heights: HeightGrid, posting: float, radius: float, swap: bool, flip_t: bool, flip_c: bool
) -> FloatArray:
    """Tangent-frame heights with the Sun's side in row 0 and lines that run to higher columns."""
    size = heights.shape[0]
    out = np.empty((size, size), np.float64)
    middle = (size - 1) / 2.0
    scale = posting / (2.0 * radius)
    for block_t in range(0, size, 32):  # by blocks, since a swap reads across the rows
        for block_c in range(0, size, 32):
            for t in range(block_t, min(block_t + 32, size)):
                a = size - 1 - t if flip_t else t
                q_t = ((t - middle) * scale) ** 2
                for c in range(block_c, min(block_c + 32, size)):
                    b = size - 1 - c if flip_c else c
                    h = heights[b, a] if swap else heights[a, b]
                    q = q_t + ((c - middle) * scale) ** 2
                    # (R + h)(1 - q)/(1 + q) - R without the loss of digits
                    z = (h * (1.0 - q) - 2.0 * q * radius) / (1.0 + q)
                    out[t, c] = z if z == z else NOTHING
    return out


@kernel
def _sample_field(field: FloatArray, t: float, c: float) -> float:
    """Shadow height between the nodes of a coarser field; NOTHING outside it."""
    size = field.shape[0]
    if not (0.0 <= t <= size - 1 and 0.0 <= c <= size - 1):
        return NOTHING
    i, j = min(int(t), size - 2), min(int(c), size - 2)
    dt, dc = t - i, c - j
    return (1.0 - dt) * ((1.0 - dc) * field[i, j] + dc * field[i, j + 1]) + dt * (
        (1.0 - dc) * field[i + 1, j] + dc * field[i + 1, j + 1]
    )


@kernel
def _sweep(z: FloatArray, shear: float, rise: float, outer: FloatArray, ratio: float) -> FloatArray:
    """Height (m) that the ground must pass at each node to see the Sun.

    z       (n, n)  oriented heights
    shear   columns that a line moves a row, 0..1
    rise    climb (m) of a ray to the Sun from one row to the next
    outer   (m, m)  the same field of a coarser grid about the same centre, or (0, 0)
    ratio   postings of the coarser grid in one of this
    """
    size = z.shape[0]
    field = np.empty((size, size), np.float64)
    span = int(np.ceil(shear * (size - 1))) + 1
    # lines[k + span] meets row t at column k + shear t; it starts before the grid's first column
    lines = np.full(size + span + 1, NOTHING)
    has_outer = outer.shape[0] > 0
    middle = (size - 1) / 2.0
    outer_middle = (outer.shape[0] - 1) / 2.0
    born = size + span + 1  # the lowest line that has entered the grid
    for t in range(size):
        whole = int(np.floor(shear * t))
        part = shear * t - whole
        first = span - whole - 1  # the line at column part - 1
        if has_outer:
            for k in range(first, born):
                column = k - first + part - 1.0
                lines[k] = _sample_field(
                    outer,
                    outer_middle + (t - middle) * ratio,
                    outer_middle + (column - middle) * ratio,
                )
        born = min(born, first)
        # between lines: the one a part of a column back has weight `part`
        for c in range(size):
            field[t, c] = part * lines[first + c] + (1.0 - part) * lines[first + c + 1]
        for c in range(size - 1):
            ground = (1.0 - part) * z[t, c] + part * z[t, c + 1]
            lines[first + c + 1] = max(lines[first + c + 1], ground)
        lines[first + size] = max(lines[first + size], z[t, size - 1])
        for k in range(first, first + size + 1):
            lines[k] -= rise
    return field


@kernel
def _compare(z: FloatArray, field: FloatArray, tolerance: float) -> BoolGrid:
    lit = np.empty(z.shape, np.bool_)
    for t in range(z.shape[0]):
        for c in range(z.shape[1]):
            lit[t, c] = z[t, c] >= field[t, c] - tolerance
    return lit


def lit_mask(
    heights: HeightGrid,
    posting_m: float,
    sun_local: ArrayLike,
    radius_m: float,
    outer: Sequence[tuple[HeightGrid, float]] = (),
) -> BoolGrid:
    """Which nodes of a map grid see the Sun over the ground between.

    heights    (n, n) float32  m above the reference sphere, NaN for no data (casts no shadow)
    posting_m  m between nodes
    sun_local  (3,)   direction to the Sun, any length, east, north, up at the grid's centre
    radius_m   radius of the reference sphere
    outer      (heights, posting_m) of coarser grids about the same centre, finer first: what lies
               beyond the grid before them and throws its shadow into it
    Returns (n, n) bool; nodes without data are False. All False for a Sun at or below the
    horizon of the centre.
    Raises ValueError for a grid that is not square or a Sun of no length.
    """
    sun = np.asarray(sun_local, dtype=np.float64)
    length = float(np.linalg.norm(sun))
    if heights.ndim != 2 or heights.shape[0] != heights.shape[1] or heights.shape[0] < 2:
        raise ValueError(f"lit_mask: a map grid is square, at least 2 x 2, not {heights.shape}")
    if not length > 0.0:
        raise ValueError("lit_mask: the Sun's direction has no length")
    east, north, up = (float(value) for value in sun / length)
    valid = ~np.isnan(heights)
    if up <= 0.0:
        return np.zeros(heights.shape, dtype=np.bool_)
    swap = abs(east) > abs(north)
    # row 0 is north, column 0 west: rows are swept from the Sun's side
    along, across = (east, north) if swap else (north, east)
    if max(abs(along), abs(across)) < 1e-9 * up:
        return valid  # overhead
    flip_t = along > 0.0 if swap else along < 0.0
    # a line runs away from the Sun; mirrored so that it runs to higher columns
    flip_c = across < 0.0 if swap else across > 0.0
    shear = abs(across) / abs(along)
    climb = up / abs(along)  # m a metre along the swept axis

    field = np.empty((0, 0), np.float64)
    outer_posting = 1.0
    z = field
    for grid, posting in [*reversed(outer), (heights, posting_m)]:
        if grid.shape[0] != grid.shape[1]:
            raise ValueError(f"lit_mask: an outer map grid is square, not {grid.shape}")
        grid = np.ascontiguousarray(grid, dtype=np.float32)
        z = _oriented(grid, float(posting), float(radius_m), swap, flip_t, flip_c)
        field = _sweep(z, shear, climb * posting, field, posting / outer_posting)
        outer_posting = float(posting)
    lit = _compare(z, field, NODE_TOLERANCE_M)
    if flip_t:
        lit = lit[::-1]
    if flip_c:
        lit = lit[:, ::-1]
    if swap:
        lit = lit.T
    return np.ascontiguousarray(lit & valid)


def halo(relief_m: float, elevation: float) -> float:
    """How far (m) ground that rises relief_m above a tile can throw a shadow at a Sun elevation (rad).

    Flat-body value, an upper bound: the body's curvature only shortens shadows.
    Raises ValueError for a Sun at or below the horizon.
    """
    if not elevation > 0.0:
        raise ValueError("halo: the Sun must stand above the horizon")
    return float(relief_m / np.tan(elevation))
