"""A map grid rendered in its own projection: each node's brightness under a Sun and a view."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.photometry.hapke import LUNAR
from catalog.photometry.laws import (
    HAPKE,
    LAW_NUMBERS,
    NORMAL_ALBEDO,
    SurfaceLaw,
    law_by_name,
    lunar_weight,
)
from catalog.rendering.hapke_table import SMALL_TABLE_SIZE, TABLE_SIZE
from catalog.rendering.shading import NEAR, NEAR_LUNAR, TABLE, TWO_TERMS, Lighting
from catalog.rendering.shadow import (
    KEPT_SUNS,
    NO_TABLE,
    Outer,
    illuminated,
    illuminated_levels,
    map_grid,
)
from catalog.rendering.swept import ShadowField

ZENITH = (0.0, 0.0, 1.0)


def render_map(
    heights: Float32Array,
    posting_m: float,
    sun_local: ArrayLike,
    *,
    radius_m: float,
    view_local: ArrayLike | None = None,
    camera_local: ArrayLike | None = None,
    law: str = "hapke",
    outer: Outer | None = (),
) -> Float32Array:
    """Radiance factor of every node of a map grid, zero in shadow, NaN where there is no data.

    heights       (n, n) float32  m above the reference sphere, NaN for no data; row 0 north
    posting_m     m between nodes
    sun_local     (3,)  direction to the Sun; all vectors are east, north, up at the grid's centre
    radius_m      radius of the reference sphere
    view_local    (3,)  direction to a far camera; without it and a camera, straight up
    camera_local  (3,)  place of a near camera, m from the centre's foot on the reference sphere
    law           "hapke", "lommel_seeliger", "lunar_lambert" or "lambert", with the Moon's
                  parameters and normal albedo
    outer         coarser grids about the same centre that throw shadows in, or their field, as for
                  `lit_mask`; None for no cast shadows, then only what faces away from the Sun is
                  dark
    Returns (n, n) float32. Terrain is not hidden by terrain: a node that faces the camera is drawn.
    Raises ConfigError for an unknown law, ValueError for vectors without a direction.
    """
    if view_local is not None and camera_local is not None:
        raise ValueError("render_map: give view_local or camera_local, not both")
    view = ZENITH if view_local is None else view_local
    light = _light(law, sun_local, view)
    if camera_local is not None:
        camera = np.ascontiguousarray(camera_local, dtype=np.float64)
        made = NEAR_LUNAR if law == "lunar_lambert" else NEAR
        light = light._replace(made=made, camera=camera)
    grid = map_grid(heights, posting_m, radius_m)
    return illuminated(grid, light, outer, TABLE_SIZE)


def render_map_quickly(
    heights: Float32Array,
    posting_m: float,
    sun_local: ArrayLike,
    *,
    radius_m: float,
    view_local: ArrayLike = ZENITH,
    law: str = "hapke",
    outer: Outer | None = (),
) -> Float32Array:
    """As `render_map` under a fixed view, with Hapke's law from a coarse table.

    On small grids several times faster, wrong by 5e-4 of the mean (rms) to 25 deg off nadir.
    """
    return illuminated(
        map_grid(heights, posting_m, radius_m),
        _light(law, sun_local, view_local),
        outer,
        SMALL_TABLE_SIZE,
    )


def render_levels(
    grids: Sequence[tuple[Float32Array, float]],
    count: int,
    sun_local: ArrayLike,
    *,
    radius_m: float,
    law: str,
) -> tuple[list[Float32Array], list[ShadowField]]:
    """`render_map` from straight up of the finest of some grids, each with all coarser ones about.

    grids  (heights, posting_m) about one centre, finer first
    count  how many are rendered
    Returns also the field of shadows about each grid, for other grids about the same centre.
    Raises ConfigError for an unknown law, ValueError for Hapke's, which wants a table for each.
    """
    light = _light(law, sun_local, ZENITH)
    if light.made == TABLE:
        raise ValueError(f"render_levels: {law} grids are rendered one by one")
    return illuminated_levels([map_grid(*grid, radius_m) for grid in grids], light, count)


def _light(law: str, sun_local: ArrayLike, view_local: ArrayLike) -> Lighting:
    """Seen from one direction. Raises ConfigError for an unknown law."""
    sun, view = (np.asarray(vector, dtype=np.float64) for vector in (sun_local, view_local))
    if sun.shape != (3,) or view.shape != (3,):
        sun, view = _unit(sun, "sun_local"), _unit(view, "view_local")  # which refuses it
    return _far_light(law, tuple(sun.tolist()), tuple(view.tolist()))


@lru_cache(maxsize=KEPT_SUNS)
def _far_light(law: str, sun_local: tuple[float, ...], view_local: tuple[float, ...]) -> Lighting:
    law_by_name(law)  # refuses a name that is no law
    sun, view = _unit(sun_local, "sun_local"), _unit(view_local, "view_local")
    weight = float(law == "lommel_seeliger")
    if law == "lunar_lambert":
        weight = lunar_weight(float(sun @ view))
    number = LAW_NUMBERS[law]
    made = TABLE if number == HAPKE else TWO_TERMS
    return Lighting(made, sun, view, weight, SurfaceLaw(number, LUNAR, NORMAL_ALBEDO), NO_TABLE)


def _unit(vector: ArrayLike, what: str) -> FloatArray:
    array = np.ascontiguousarray(vector, dtype=np.float64)
    # in plain numbers: a small grid is rendered in less time than a library takes for a norm
    length = math.hypot(*array.tolist()) if array.shape == (3,) else math.nan
    if not math.isfinite(length) or length == 0.0:
        raise ValueError(f"render_map: {what} must be a vector (3,) with a direction")
    return array / length
