"""A map grid rendered in its own projection: each node's brightness under a Sun and a view."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.photometry.hapke import LUNAR, HapkeParameters
from catalog.photometry.laws import law_by_name
from catalog.photometry.lommel_seeliger import NORMAL_ALBEDO
from catalog.photometry.lunar_lambert import lunar_weight
from catalog.rendering import shading
from catalog.rendering.hapke_table import SMALL_TABLE_SIZE, TABLE_SIZE, shade_hapke, slope_table
from catalog.rendering.shadow import Outer, lit_mask

LAW_NUMBERS = {
    "hapke": shading.HAPKE,
    "lommel_seeliger": shading.LOMMEL_SEELIGER,
    "lunar_lambert": shading.LUNAR_LAMBERT,
    "lambert": shading.LAMBERT,
}
# A table pays from three nodes to an entry on; still smaller grids are evaluated node by node.
TABLE_PAYS_NODES = 3 * TABLE_SIZE**2
SMALL_TABLE_PAYS_NODES = 3 * SMALL_TABLE_SIZE**2
ALL_LIT: BoolArray = np.empty((0, 0), dtype=np.bool_)


def _unit(vector: ArrayLike, what: str) -> FloatArray:
    array = np.ascontiguousarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(array))
    if array.shape != (3,) or not np.isfinite(length) or length == 0.0:
        raise ValueError(f"render_map: {what} must be a vector (3,) with a direction")
    return array / length


def render_map(
    heights: Float32Array,
    posting_m: float,
    sun_local: ArrayLike,
    *,
    radius_m: float,
    view_local: ArrayLike | None = None,
    camera_local: ArrayLike | None = None,
    law: str = "hapke",
    outer: Outer = (),
    shadows: bool = True,
    surface: HapkeParameters = LUNAR,
    albedo: float = NORMAL_ALBEDO,
    quick: bool = False,
) -> Float32Array:
    """Radiance factor of every node of a map grid, zero in shadow, NaN where there is no data.

    heights       (n, n) float32  m above the reference sphere, NaN for no data; row 0 north
    posting_m     m between nodes
    sun_local     (3,)  direction to the Sun; all vectors are east, north, up at the grid's centre
    radius_m      radius of the reference sphere
    view_local    (3,)  direction to a far camera; without it and a camera, straight up
    camera_local  (3,)  place of a near camera, m from the centre's foot on the reference sphere
    law           "hapke", "lommel_seeliger", "lunar_lambert" or "lambert"
    outer         coarser grids about the same centre that throw shadows in, or their field, as for
                  `lit_mask`
    shadows       cast shadows; without them only what faces away from the Sun is dark
    surface       parameters of the Hapke law
    albedo        normal albedo of the other laws
    quick         Hapke's law from a coarse table under a fixed view: faster, on small grids several
                  times, wrong by 5e-4 of the mean (rms) to 25 deg off nadir
    Returns (n, n) float32. Terrain is not hidden by terrain: a node that faces the camera is drawn.
    Raises ConfigError for an unknown law, ValueError for vectors without a direction.
    """
    law_by_name(law)  # refuses a name that is no law
    if view_local is not None and camera_local is not None:
        raise ValueError("render_map: give view_local or camera_local, not both")
    sun = _unit(sun_local, "sun_local")
    heights = np.ascontiguousarray(heights, dtype=np.float32)
    lit = lit_mask(heights, posting_m, sun, radius_m, outer) if shadows else ALL_LIT
    number = LAW_NUMBERS[law]
    posting, radius = float(posting_m), float(radius_m)
    if camera_local is not None:
        camera = np.ascontiguousarray(camera_local, dtype=np.float64)
        return shading.shade_from_camera(
            heights, posting, radius, sun, camera, number, surface, float(albedo), lit
        )
    view = _unit((0.0, 0.0, 1.0) if view_local is None else view_local, "view_local")
    if law != "hapke":
        weight = {"lommel_seeliger": 1.0, "lambert": 0.0}.get(law)
        if weight is None:
            weight = lunar_weight(float(sun @ view))
        return shading.shade_two_terms(
            heights, posting, radius, sun, view, weight, float(albedo), lit
        )
    if quick and heights.size >= SMALL_TABLE_PAYS_NODES:
        table = slope_table(sun, view, surface, SMALL_TABLE_SIZE)
        return shade_hapke(heights, posting, radius, sun, view, surface, lit, table)
    if heights.size >= TABLE_PAYS_NODES:
        table = slope_table(sun, view, surface, TABLE_SIZE)
        return shade_hapke(heights, posting, radius, sun, view, surface, lit, table)
    return shading.shade_fixed(
        heights, posting, radius, sun, view, number, surface, float(albedo), lit
    )
