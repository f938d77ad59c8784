"""A small body seen from its six sides, drawn from the relief that its catalog carries.

A side shows the body from so far that there is no perspective, under a Sun from the upper left.
What is in shadow gets some light from the lower right: this is a map of the body, not a picture.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import ByteArray, FloatArray
from catalog.errors import DataError, UsageError
from catalog.geometry.latlon import xyz_from_latlon
from catalog.rendering.mesh_scene import MeshScene
from catalog.store.reader import Catalog
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.relief.relief import GlobalRelief

# Where the viewer stands, what is up for him, what the side is called.
SIDES = (
    ((1, 0, 0), (0, 0, 1), "+x: longitude 0"),
    ((0, 1, 0), (0, 0, 1), "+y: longitude 90 east"),
    ((0, 0, 1), (-1, 0, 0), "+z: north pole, longitude 0 below"),
    ((-1, 0, 0), (0, 0, 1), "-x: longitude 180"),
    ((0, -1, 0), (0, 0, 1), "-y: longitude 90 west"),
    ((0, 0, -1), (1, 0, 0), "-z: south pole, longitude 0 above"),
)
MAX_ROWS = 360  # of the drawn relief: two pixels of a side a cell
ROOM = 1.1  # of the picture about the body
AWAY = 5000.0  # reaches of the body to the viewer: perspective is a hundredth of a pixel
SAMPLES = 3  # rays a side of a pixel, where the ground changes
SUN_ASIDE_DEG = 45.0  # from the line of sight
FILL_ASIDE_DEG, FILL = 55.0, 0.3  # the second light, and its share of all
GAMMA = 0.8
HIDDEN_CELLS = 3.0  # a point so far behind the ground is behind it
GRATICULE_DEG = 30
LINE_STEP_DEG = 2.0
MARGIN = 1.002  # lines run so far over the relief, not to sink into it


@dataclass(frozen=True, eq=False)
class Side:
    """One view.

    name    which
    half_m  half a side of the picture on the body
    gray    (h, h) uint8, 0 for the sky
    places  (n, 2) m right and up from the origin, of the catalog's points; NaN where hidden
    lines   of the graticule (k, 2) m, NaN where hidden
    """

    name: str
    half_m: float
    gray: ByteArray
    places: FloatArray
    lines: list[FloatArray]


def has_sides(catalog: Catalog) -> bool:
    """Whether a catalog is of a body so small that it is drawn whole, and knows its shape."""
    return catalog.meta.planes is not None and catalog.meta.relief is not None


def sides(catalog: Catalog, size_px: int) -> list[Side]:
    """Six views of the body, pictures of size_px a side.

    Raises UsageError for a large body; DataError for a catalog that carries no relief or a damaged
    one, or a machine without embree's rays.
    """
    if catalog.meta.planes is None:
        raise UsageError(
            f"{catalog.path}: {catalog.meta.body} is too large to be drawn with its points; name "
            "one of them, or see `optnav report` for maps"
        )
    relief = catalog.relief()
    if relief is None:
        raise DataError(
            f"{catalog.path}: carries no relief to draw the body from; build it again from a "
            "[[mesh]], or from a terrain model of the whole body"
        )
    mesh = MeshRays(relief_corners(relief))
    records = catalog.records
    lat, lon = np.radians(catalog.lat_deg), np.radians(catalog.lon_deg)
    points = xyz_from_latlon(lat, lon, np.asarray(records["radius_m"], np.float64))
    lines = _graticule(relief)
    unresolved_posting_m = (
        HIDDEN_CELLS * relief.posting_m * max(1.0, len(relief.heights) / MAX_ROWS)
    )
    return [_side(mesh, side, size_px, points, lines, unresolved_posting_m) for side in SIDES]


def relief_corners(relief: GlobalRelief) -> FloatArray:
    """The relief's mean heights as a closed mesh (m, 3, 3) m, counter-clockwise from outside.

    More than MAX_ROWS rows are averaged to as many or fewer.
    """
    factor = -(-relief.heights.shape[0] // MAX_ROWS)
    heights = relief.heights.astype(np.float64)
    rows = heights.shape[0] // factor
    heights = heights[: rows * factor, : 2 * rows * factor]
    heights = heights.reshape(rows, factor, 2 * rows, factor).mean(axis=(1, 3))
    step = factor * relief.step_rad
    lat = np.pi / 2.0 - (np.arange(rows) + 0.5) * step
    lon = -np.pi + (np.arange(2 * rows) + 0.5) * step
    grid = xyz_from_latlon(lat[:, None], lon[None, :], relief.radius_m + heights)
    grid = np.concatenate([grid, grid[:, :1]], axis=1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    parts = [np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]
    for row, turn in ((0, 1), (rows - 1, -1)):
        ring = grid[row]
        pole = np.broadcast_to(ring[:-1].mean(axis=0) * [0.0, 0.0, 1.0], ring[:-1].shape)
        parts.append(np.stack([pole, ring[:-1], ring[1:]][::turn], axis=1)[:, None])
    return np.concatenate([part.reshape(-1, 3, 3) for part in parts])


def _graticule(relief: GlobalRelief) -> list[FloatArray]:
    """Parallels and meridians (k, 3) m on the relief."""
    found = []
    along = np.radians(np.arange(-180.0, 180.0 + LINE_STEP_DEG, LINE_STEP_DEG))
    for degrees in range(-90 + GRATICULE_DEG, 90, GRATICULE_DEG):
        found.append((np.full_like(along, np.radians(degrees)), along))
    upward = np.radians(np.arange(-90.0, 90.0 + LINE_STEP_DEG, LINE_STEP_DEG))
    for degrees in range(-180, 180, GRATICULE_DEG):
        found.append((upward, np.full_like(upward, np.radians(degrees))))
    return [
        MARGIN * xyz_from_latlon(lat, lon, relief.radius_m + relief.heights_at(lat, lon))
        for lat, lon in found
    ]


def _side(
    mesh: MeshRays,
    side: tuple[tuple[int, ...], tuple[int, ...], str],
    size_px: int,
    points: FloatArray,
    lines: list[FloatArray],
    unresolved_posting_m: float,
) -> Side:
    toward, up = np.array(side[0], np.float64), np.array(side[1], np.float64)
    right = np.cross(up, toward)
    half = ROOM * mesh.reach_m
    viewer = AWAY * mesh.reach_m * toward
    edges = np.linspace(-half, half, size_px + 1)
    rays = edges[None, :, None] * right - edges[:, None, None] * up - viewer
    rays /= np.linalg.norm(rays, axis=2)[..., None]
    light = np.zeros((size_px, size_px))
    for aside_deg, share in ((SUN_ASIDE_DEG, 1.0 - FILL), (-FILL_ASIDE_DEG, FILL)):
        aside = np.radians(aside_deg)
        sun = np.cos(aside) * toward + np.sin(aside) * (up - right) / np.sqrt(2.0)
        bright = MeshScene(mesh, sun).picture(viewer, rays, SAMPLES)
        light += share * bright / max(float(np.percentile(bright[bright > 0.0], 99.5)), 1e-9)
    gray = np.rint(255.0 * np.clip(light, 0.0, 1.0) ** GAMMA).astype(np.uint8)

    def shown(places: FloatArray) -> FloatArray:
        sight = places - viewer
        away = np.linalg.norm(sight, axis=1)
        _, met = mesh.first_hits(viewer, sight / away[:, None])
        flat = np.column_stack([places @ right, places @ up])
        flat[met < away - unresolved_posting_m] = np.nan
        return flat

    return Side(side[2], half, gray, shown(points), [shown(line) for line in lines])
