"""Cast shadows on a map grid of a curved body: which nodes see the Sun over the ground between.

How the sweep is done: swept.py.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.projection import FLAT_RADIUS_M
from catalog.photometry.laws import LUNAR_HAPKE
from catalog.rendering.hapke_table import make_slope_table
from catalog.rendering.shading import FAR, LIMIT, LIT, TABLE, Lighting, MapGrid
from catalog.rendering.swept import NO_LIMITS, ShadowField, Sweep, sweep_grid, sweep_levels

ZENITH: FloatArray = np.array([0.0, 0.0, 1.0])
NO_LAW = LUNAR_HAPKE
NO_TABLE: Float32Array = np.empty((0, 0), np.float32)
NO_FIELD = ShadowField(NO_LIMITS, 1.0)
# A place is rendered at several levels under one Sun; what follows from its direction takes longer
# in the interpreter than a tenth of a small grid's shading.
KEPT_SUNS = 64


Outer = Sequence[tuple[Float32Array, float]] | ShadowField


def make_lit_mask(
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
               beyond the grid before them and throws its shadow into it; or their field under this
               Sun, see `make_shadow_field`
    Returns (n, n) bool; nodes without data are False. All False for a Sun at or below the
    horizon of the centre; but a plane (its radius) is no horizon to the slopes of a small body.
    Raises ValueError for a grid that is not square or a Sun of no length.
    """
    lit: BoolArray = (
        compute_illumination(
            map_grid(heights, posting_m, radius_m), _make_light(LIT, sun_local), outer
        )
        > 0
    )
    return lit


def compute_illumination(
    grid: MapGrid, light: Lighting, outer: Outer | None = (), table_size: int = 0
) -> Float32Array:
    """Compute what `light` asks for at every node of a grid (n, n) that the Sun reaches; else 0.

    light       its vectors are east, north, up; the Sun's of unit length
    outer       as `make_lit_mask` takes it; None for no cast shadows
    table_size  of the table that Hapke's law is read from where light.made is TABLE. It pays from
                three nodes to an entry on; smaller grids are evaluated node by node.
    NaN where there is no data. Raises ValueError for a grid that is not square.
    """
    _refuse_shape(grid.heights, "a map grid")
    sweep = _plan_sweep(*light.sun.tolist())
    if outer is not None and _is_set(light.sun, sweep, grid.radius):
        return np.where(np.isnan(grid.heights), grid.heights, np.float32(0.0))
    field = NO_FIELD
    if outer is None:
        sweep = sweep._replace(casts=False)
    elif sweep.casts:
        field = (
            outer
            if isinstance(outer, ShadowField)
            else make_shadow_field(outer, light.sun, grid.radius)
        )
    light = _orient_to_sweep(light, sweep)
    if light.made == TABLE and grid.heights.size < 3 * table_size**2:
        light = light._replace(made=FAR)
    elif light.made == TABLE:
        table = make_slope_table(light.sun, light.camera, light.law.surface, table_size)
        light = light._replace(table=table)
    return sweep_grid(grid, sweep, field, light)


def make_shadow_field(
    grids: Sequence[tuple[Float32Array, float]],
    sun_local: ArrayLike,
    radius_m: float,
    beyond: ShadowField | None = None,
) -> ShadowField:
    """The shadows that coarser grids throw, for several finer grids under the same Sun.

    grids   (heights, posting_m) about the same centre, finer first, as `make_lit_mask` takes them
    beyond  the field of still coarser ones
    Raises ValueError for a grid that is not square or a Sun of no length.
    """
    light, field = _make_light(LIMIT, sun_local), beyond or NO_FIELD
    sweep = _plan_sweep(*light.sun.tolist())
    for heights, posting in reversed(grids):
        _refuse_shape(heights, "an outer map grid")
        if sweep.casts and not _is_set(light.sun, sweep, radius_m):
            grid = map_grid(heights, posting, radius_m)
            field = ShadowField(sweep_grid(grid, sweep, field, light), grid.posting)
    return field


def compute_illumination_levels(
    grids: Sequence[MapGrid], light: Lighting, count: int
) -> tuple[list[Float32Array], list[ShadowField]]:
    """Compute illumination of the first `count` grids about one centre, under all coarser ones.

    grids  finer first
    light  of a law without a table
    Returns also the field that the coarser ones throw over each grid.
    """
    sweep = _plan_sweep(*light.sun.tolist())
    if not sweep.casts or _is_set(light.sun, sweep, grids[0].radius):
        return [compute_illumination(grid, light) for grid in grids[:count]], [NO_FIELD] * len(
            grids
        )
    return sweep_levels(grids, sweep, _orient_to_sweep(light, sweep), count)


def _orient_to_sweep(light: Lighting, sweep: Sweep) -> Lighting:
    """Swap the vectors' axes where the sweep swaps rows and columns."""
    if not sweep.swap:
        return light
    return light._replace(sun=_swap_axes(light.sun), camera=_swap_axes(light.camera))


def map_grid(heights: Float32Array, posting_m: float, radius_m: float) -> MapGrid:
    """A grid as kernels take it."""
    grid = np.ascontiguousarray(heights, dtype=np.float32)
    return MapGrid(grid, float(posting_m), float(radius_m))


def _make_light(made: int, sun_local: ArrayLike) -> Lighting:
    """Make the lighting of a quantity that needs no law."""
    sun = np.asarray(sun_local, dtype=np.float64)
    length = math.hypot(*sun.tolist())
    if not length > 0.0:
        raise ValueError("lit_mask: the Sun's direction has no length")
    return Lighting(made, sun / length, ZENITH, 0.0, NO_LAW, NO_TABLE)


def _swap_axes(vector: FloatArray) -> FloatArray:
    """A vector where rows and columns have changed places."""
    return np.array([-vector[1], -vector[0], vector[2]])


def _is_set(sun: FloatArray, sweep: Sweep, radius_m: float) -> bool:
    """Whether no ground about the centre can see the Sun."""
    return bool(sun[2] <= 0.0 and (radius_m < FLAT_RADIUS_M or not sweep.casts))


@lru_cache(maxsize=KEPT_SUNS)
def _plan_sweep(east: float, north: float, up: float) -> Sweep:
    """The way to sweep under a Sun; one overhead casts no shadows."""
    swap = abs(east) > abs(north)
    # row 0 is north, column 0 west: rows are swept from the Sun's side
    along, across = (east, north) if swap else (north, east)
    if max(abs(along), abs(across)) < 1e-9 * abs(up):
        return Sweep(False, False, False, False, 0.0, 0.0)
    return Sweep(
        swap=swap,
        flip_t=along > 0.0 if swap else along < 0.0,
        # a line runs away from the Sun
        flip_c=across < 0.0 if swap else across > 0.0,
        casts=True,
        shear=abs(across) / abs(along),
        climb=up / abs(along),  # m a metre along the swept axis
    )


def _refuse_shape(grid: Float32Array, what: str) -> None:
    if grid.ndim != 2 or grid.shape[0] != grid.shape[1] or grid.shape[0] < 2:
        raise ValueError(f"lit_mask: {what} is square, at least 2 x 2, not {grid.shape}")
