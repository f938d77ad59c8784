"""Cast shadows on a map grid of a curved body, by one sweep away from the Sun.

All rays to the Sun are parallel straight lines in the frame of the grid's centre. There the body
falls away below the tangent plane, so a node stands at z = (R + h) cos(angle from the centre) - R
and a ray that rises by tan(elevation) a metre of map is the edge of a shadow. Parallel lines one
node apart follow the Sun's azimuth across the grid; each carries the highest ray that the ground
behind it has thrown, and a node is compared with the two lines that it lies between. Only that one
interpolation is made, so a shadow's edge does not blur with its length.

Map x and y are taken for the tangent plane's: wrong by (rho / 2R)^2 of a shadow's length (a five
thousandth at the rim of a 100 km tile on the Moon). The Sun is a point (its disc is 0.5 deg wide).
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.kernel import kernel
from catalog.geometry.projection import FLAT_RADIUS_M

NOTHING = -1e30  # height of no ground
NODE_TOLERANCE_M = 1e-3  # float32 heights of 1e4 m are good to this
NO_FIELD: FloatArray = np.empty((0, 0))
NO_MASK: BoolArray = np.empty((0, 0), dtype=np.bool_)


class _Sweep(NamedTuple):
    """How grids are swept under a Sun.

    swap    rows and columns change places: the sweep follows the columns
    flip_t  rows are swept against their order
    flip_c  lines run to lower columns
    shear   columns that a line moves a row, 0..1
    climb   climb of a ray to the Sun a metre along the rows' order
    """

    swap: bool
    flip_t: bool
    flip_c: bool
    shear: float
    climb: float


@kernel
def _sample_field(field: FloatArray, t: float, c: float) -> float:
    """Shadow height between the nodes of a coarser field; NOTHING outside it."""
    size = field.shape[0]
    if not (0.0 <= t <= size - 1 and 0.0 <= c <= size - 1):
        return NOTHING
    i, j = min(int(t), size - 2), min(int(c), size - 2)
    dt, dc = t - i, c - j
    value: float = (1.0 - dt) * ((1.0 - dc) * field[i, j] + dc * field[i, j + 1]) + dt * (
        (1.0 - dc) * field[i + 1, j] + dc * field[i + 1, j + 1]
    )
    return value


@kernel
def _tangent_row(
    heights: Float32Array, t: int, posting: float, radius: float, mirror: bool, z: FloatArray
) -> None:
    """Fill z (n,) with the tangent-frame heights of a row, its columns mirrored on demand."""
    size = heights.shape[0]
    line = heights[t]
    middle = (size - 1) / 2.0
    scale = posting / (2.0 * radius)
    q_row = ((t - middle) * scale) ** 2
    for c in range(size):
        h = line[size - 1 - c] if mirror else line[c]
        q = q_row + ((c - middle) * scale) ** 2
        # (R + h)(1 - q)/(1 + q) - R without the loss of digits
        value = (h - q * (h + 2.0 * radius)) / (1.0 + q)
        z[c] = value if value == value else NOTHING


@kernel
def _sweep(
    heights: Float32Array,
    posting: float,
    radius: float,
    sweep: _Sweep,
    outer: FloatArray,
    ratio: float,
    field: FloatArray,
    lit: BoolArray,
) -> None:
    """Sweep a grid away from the Sun, row by row.

    heights  (n, n)  transposed where the sweep swaps rows and columns
    outer    (m, m)  field of a coarser grid about the same centre, or (0, 0)
    ratio    this grid's posting in postings of the coarser one
    field    (n, n) or (0, 0)  receives the height that ground must pass to see the Sun, in the
             order of the sweep
    lit      (n, n) or (0, 0)  receives whether the node's ground does, in the order of `heights`
    """
    _, flip_t, flip_c, shear, climb = sweep
    size = heights.shape[0]
    want_field, want_lit, has_outer = field.shape[0] > 0, lit.shape[0] > 0, outer.shape[0] > 0
    middle = (size - 1) / 2.0
    outer_middle = (outer.shape[0] - 1) / 2.0
    rise = climb * posting
    span = int(np.ceil(shear * (size - 1))) + 1
    # lines[k + span] meets row t at column k + shear t; the highest k starts in the last column
    lines = np.full(size + span + 1, NOTHING)
    born = size + span  # the lowest line that has entered the grid
    z, limit = np.empty(size), np.empty(size)
    for t in range(size):
        row = size - 1 - t if flip_t else t
        _tangent_row(heights, row, posting, radius, flip_c, z)
        # a line that rounding leaves a hair before a column is on it
        whole = int(np.floor(shear * t + 1e-9))
        part = max(shear * t - whole, 0.0)
        first = span - whole - 1  # the line at column part - 1
        near = lines[first : first + size]
        here = lines[first + 1 : first + 1 + size]
        if has_outer:
            for k in range(first, born):
                lines[k] = _sample_field(
                    outer,
                    outer_middle + (t - middle) * ratio,
                    outer_middle + (k - first + part - 1.0 - middle) * ratio,
                )
            born = min(born, first)
        # a node lies between two lines: the one a part of a column ahead, and the one before it
        for c in range(size):
            limit[c] = part * near[c] + (1.0 - part) * here[c]
        if want_field:
            field[t, :] = limit
        if want_lit:
            seen = lit[row]
            if flip_c:
                for c in range(size):
                    seen[size - 1 - c] = z[c] >= limit[c] - NODE_TOLERANCE_M
            else:
                for c in range(size):
                    seen[c] = z[c] >= limit[c] - NODE_TOLERANCE_M
        for c in range(size - 1):
            ground = (1.0 - part) * z[c] + part * z[c + 1]
            here[c] = (here[c] if here[c] > ground else ground) - rise
        here[size - 1] = max(here[size - 1], z[size - 1]) - rise
        near[0] -= rise


class ShadowField(NamedTuple):
    """What terrain on coarser grids throws over a point, for one Sun; see `shadow_field`.

    heights    (m, m)  height that ground must pass to see the Sun, in the order of the sweep;
               (0, 0) when nothing throws shadows
    posting_m  m between its nodes
    """

    heights: FloatArray
    posting_m: float


Outer = Sequence[tuple[Float32Array, float]] | ShadowField


def lit_mask(
    heights: Float32Array,
    posting_m: float,
    sun_local: ArrayLike,
    radius_m: float,
    outer: Outer = (),
) -> BoolArray:
    """Which nodes of a map grid see the Sun over the ground between.

    heights    (n, n) float32  m above the reference sphere, NaN for no data (casts no shadow)
    posting_m  m between nodes
    sun_local  (3,)   direction to the Sun, any length, east, north, up at the grid's centre
    radius_m   radius of the reference sphere
    outer      (heights, posting_m) of coarser grids about the same centre, finer first: what lies
               beyond the grid before them and throws its shadow into it; or their `shadow_field`
               under this Sun
    Returns (n, n) bool; nodes without data are False. All False for a Sun at or below the
    horizon of the centre; but a plane (its radius) is no horizon to the slopes of a small body.
    Raises ValueError for a grid that is not square or a Sun of no length.
    """
    _refuse_shape(heights, "a map grid")
    up, sweep = _sweep_of(sun_local)
    valid = ~np.isnan(heights)
    if _is_set(up, sweep, radius_m):
        return np.zeros(heights.shape, dtype=np.bool_)
    if sweep is None:
        return valid
    field = outer if isinstance(outer, ShadowField) else shadow_field(outer, sun_local, radius_m)
    lit = np.empty(heights.shape, dtype=np.bool_)
    _swept(heights, posting_m, radius_m, sweep, field, NO_FIELD, lit)
    if sweep.swap:
        lit = cv2.transpose(lit.view(np.uint8)).view(np.bool_)
    return lit & valid


def shadow_field(
    grids: Sequence[tuple[Float32Array, float]],
    sun_local: ArrayLike,
    radius_m: float,
    beyond: ShadowField | None = None,
) -> ShadowField:
    """The shadows that coarser grids throw, for several finer grids under the same Sun.

    grids   (heights, posting_m) about the same centre, finer first, as `lit_mask` takes them
    beyond  the field of still coarser ones
    Raises ValueError for a grid that is not square or a Sun of no length.
    """
    up, sweep = _sweep_of(sun_local)
    field = beyond or ShadowField(NO_FIELD, 1.0)
    for grid, posting in reversed(grids):
        _refuse_shape(grid, "an outer map grid")
        if _is_set(up, sweep, radius_m) or sweep is None:
            continue
        finer = np.empty(grid.shape)
        _swept(grid, posting, radius_m, sweep, field, finer, NO_MASK)
        field = ShadowField(finer, float(posting))
    return field


def _is_set(up: float, sweep: _Sweep | None, radius_m: float) -> bool:
    """Whether no ground about the centre can see the Sun."""
    return up <= 0.0 and (sweep is None or radius_m < FLAT_RADIUS_M)


def _sweep_of(sun_local: ArrayLike) -> tuple[float, _Sweep | None]:
    """Sine of the Sun's elevation, and the way to sweep; None for a Sun overhead."""
    sun = np.asarray(sun_local, dtype=np.float64)
    length = float(np.linalg.norm(sun))
    if not length > 0.0:
        raise ValueError("lit_mask: the Sun's direction has no length")
    east, north, up = (float(value) for value in sun / length)
    swap = abs(east) > abs(north)
    # row 0 is north, column 0 west: rows are swept from the Sun's side
    along, across = (east, north) if swap else (north, east)
    if max(abs(along), abs(across)) < 1e-9 * abs(up):
        return up, None
    return up, _Sweep(
        swap=swap,
        flip_t=along > 0.0 if swap else along < 0.0,
        # a line runs away from the Sun; mirrored so that it runs to higher columns
        flip_c=across < 0.0 if swap else across > 0.0,
        shear=abs(across) / abs(along),
        climb=up / abs(along),  # m a metre along the swept axis
    )


def _swept(
    grid: Float32Array,
    posting_m: float,
    radius_m: float,
    sweep: _Sweep,
    outer: ShadowField,
    field: FloatArray,
    lit: BoolArray,
) -> None:
    heights, ratio = np.ascontiguousarray(grid, dtype=np.float32), posting_m / outer.posting_m
    if sweep.swap:
        heights = np.asarray(cv2.transpose(heights), dtype=np.float32)
    _sweep(heights, float(posting_m), float(radius_m), sweep, outer.heights, ratio, field, lit)


def _refuse_shape(grid: Float32Array, what: str) -> None:
    if grid.ndim != 2 or grid.shape[0] != grid.shape[1] or grid.shape[0] < 2:
        raise ValueError(f"lit_mask: {what} is square, at least 2 x 2, not {grid.shape}")


def halo(relief_m: float, elevation: float) -> float:
    """How far (m) ground relief_m above a tile can throw a shadow at a Sun elevation (rad).

    Flat-body value, an upper bound: the body's curvature only shortens shadows.
    Raises ValueError for a Sun at or below the horizon.
    """
    if not elevation > 0.0:
        raise ValueError("halo: the Sun must stand above the horizon")
    return float(relief_m / np.tan(elevation))
