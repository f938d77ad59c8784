"""A map grid rendered in its own projection: each node's brightness under a Sun and a view."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.photometry.laws import (
    HAPKE,
    LOMMEL_SEELIGER,
    LUNAR_HAPKE,
    LUNAR_LAMBERT,
    SurfaceLaw,
    lunar_weight,
)
from catalog.rendering.hapke_table import SMALL_TABLE_SIZE, TABLE_SIZE
from catalog.rendering.shading import NEAR, NEAR_LUNAR, TABLE, TWO_TERMS, Lighting
from catalog.rendering.shadow import (
    KEPT_SUNS,
    NO_TABLE,
    Outer,
    compute_illumination,
    compute_illumination_levels,
    map_grid,
)
from catalog.rendering.swept import ShadowField

ZENITH = (0.0, 0.0, 1.0)
LEVEL_NODES = 9  # a side of the places that level ground is looked at


def render_map(
    heights: Float32Array,
    posting_m: float,
    sun_local: ArrayLike,
    *,
    radius_m: float,
    view_local: ArrayLike | None = None,
    camera_local: ArrayLike | None = None,
    law: SurfaceLaw = LUNAR_HAPKE,
    outer: Outer | None = (),
) -> Float32Array:
    """Radiance factor of every node of a map grid, zero in shadow, NaN where there is no data.

    heights       (n, n) float32  m above the reference sphere, NaN for no data; row 0 north
    posting_m     m between nodes
    sun_local     (3,)  direction to the Sun; all vectors are east, north, up at the grid's centre
    radius_m      radius of the reference sphere
    view_local    (3,)  direction to a far camera; without it and a camera, straight up
    camera_local  (3,)  place of a near camera, m from the centre's foot on the reference sphere
    law           with the numbers of the ground, see `find_law`; by default Hapke's and the Moon's
    outer         coarser grids about the same centre that throw shadows in, or their field, as for
                  `make_lit_mask`; None for no cast shadows, then only what faces away from the Sun
                  is dark
    Returns (n, n) float32. Terrain is not hidden by terrain: a node that faces the camera is drawn.
    Raises ValueError for vectors without a direction.
    """
    if view_local is not None and camera_local is not None:
        raise ValueError("render_map: give view_local or camera_local, not both")
    view = ZENITH if view_local is None else view_local
    light = _make_light(law, sun_local, view)
    if camera_local is not None:
        camera = np.ascontiguousarray(camera_local, dtype=np.float64)
        made = NEAR_LUNAR if law.number == LUNAR_LAMBERT else NEAR
        light = light._replace(made=made, camera=camera)
    grid = map_grid(heights, posting_m, radius_m)
    return compute_illumination(grid, light, outer, TABLE_SIZE)


def render_map_quickly(
    heights: Float32Array,
    posting_m: float,
    sun_local: ArrayLike,
    *,
    radius_m: float,
    view_local: ArrayLike = ZENITH,
    law: SurfaceLaw = LUNAR_HAPKE,
    outer: Outer | None = (),
) -> Float32Array:
    """Render as `render_map` does under a fixed view, with Hapke's law from a coarse table.

    On small grids several times faster, wrong by 5e-4 of the mean (rms) to 25 deg off nadir.
    """
    return compute_illumination(
        map_grid(heights, posting_m, radius_m),
        _make_light(law, sun_local, view_local),
        outer,
        SMALL_TABLE_SIZE,
    )


def render_map_near(
    heights: Float32Array,
    posting_m: float,
    sun_local: ArrayLike,
    camera_local: FloatArray,
    *,
    radius_m: float,
    law: SurfaceLaw = LUNAR_HAPKE,
    outer: Outer | None = (),
) -> Float32Array:
    """Render as `render_map` does by Hapke's law for a near camera, in a fifth of the time.

    By the lunar-Lambert law every node is seen from the camera itself. How Hapke's law differs from
    that by the slope is taken from the middle of the grid, and how it differs for level ground from
    some places.
    """
    known = heights[np.isfinite(heights)]
    middle_m = np.float32(known.mean() if known.size else 0.0)
    view = camera_local - np.array([0.0, 0.0, middle_m])

    def nearly(grid: Float32Array, step_m: float, shadows: Outer | None) -> Float32Array:
        lit_grid, radius = (grid, step_m, sun_local), radius_m
        simple = law._replace(number=LUNAR_LAMBERT)
        near = render_map(
            *lit_grid, radius_m=radius, camera_local=camera_local, law=simple, outer=shadows
        )
        far = render_map(*lit_grid, radius_m=radius, view_local=view, law=simple, outer=None)
        wanted = render_map_quickly(
            *lit_grid, radius_m=radius, view_local=view, law=law, outer=None
        )
        return near * np.divide(wanted, far, out=np.zeros_like(far), where=far > 0.0)

    level = np.full((LEVEL_NODES, LEVEL_NODES), middle_m, np.float32)
    apart_m = posting_m * (len(heights) - 1) / (LEVEL_NODES - 1)
    exact = render_map(
        level, apart_m, sun_local, radius_m=radius_m, camera_local=camera_local, law=law, outer=None
    )
    approximate = nearly(level, apart_m, None)
    factor = np.divide(exact, approximate, out=np.ones_like(exact), where=approximate > 0.0)
    spread = _make_spread(len(heights))
    return nearly(heights, posting_m, outer) * (spread @ factor @ spread.T)


@lru_cache(maxsize=64)
def _make_spread(size: int) -> Float32Array:
    """Weights (size, LEVEL_NODES) of LEVEL_NODES even places at `size` even ones between them."""
    at = np.linspace(0.0, LEVEL_NODES - 1.0, size)
    distance = np.abs(at[:, None] - np.arange(LEVEL_NODES))
    weights: Float32Array = np.maximum(1.0 - distance, 0.0).astype(np.float32)
    return weights


def render_levels(
    grids: Sequence[tuple[Float32Array, float]],
    count: int,
    sun_local: ArrayLike,
    *,
    radius_m: float,
    law: SurfaceLaw,
) -> tuple[list[Float32Array], list[ShadowField]]:
    """`render_map` from straight up of the finest of some grids, each with all coarser ones about.

    grids  (heights, posting_m) about one centre, finer first
    count  how many are rendered
    Returns also the field of shadows about each grid, for other grids about the same centre.
    Raises ValueError for Hapke's law, which wants a table for each.
    """
    light = _make_light(law, sun_local, ZENITH)
    if light.made == TABLE:
        raise ValueError("render_levels: grids by Hapke's law are rendered one by one")
    return compute_illumination_levels([map_grid(*grid, radius_m) for grid in grids], light, count)


def _make_light(law: SurfaceLaw, sun_local: ArrayLike, view_local: ArrayLike) -> Lighting:
    """Make the lighting for a far camera."""
    sun, view = (np.asarray(vector, dtype=np.float64) for vector in (sun_local, view_local))
    if sun.shape != (3,) or view.shape != (3,):
        sun, view = _normalise(sun, "sun_local"), _normalise(view, "view_local")  # which refuses it
    return _make_far_light(law, tuple(sun.tolist()), tuple(view.tolist()))


@lru_cache(maxsize=KEPT_SUNS)
def _make_far_light(
    law: SurfaceLaw, sun_local: tuple[float, ...], view_local: tuple[float, ...]
) -> Lighting:
    sun, view = _normalise(sun_local, "sun_local"), _normalise(view_local, "view_local")
    weight = float(law.number == LOMMEL_SEELIGER)
    if law.number == LUNAR_LAMBERT:
        weight = lunar_weight(float(sun @ view))
    made = TABLE if law.number == HAPKE else TWO_TERMS
    return Lighting(made, sun, view, weight, law, NO_TABLE)


def _normalise(vector: ArrayLike, what: str) -> FloatArray:
    array = np.ascontiguousarray(vector, dtype=np.float64)
    # in plain numbers: a small grid is rendered in less time than a library takes for a norm
    length = math.hypot(*array.tolist()) if array.shape == (3,) else math.nan
    if not math.isfinite(length) or length == 0.0:
        raise ValueError(f"render_map: {what} must be a vector (3,) with a direction")
    return array / length
