"""Shaded relief under a map: from the bundled Moon, or from the catalog's own height grids."""

import logging

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from catalog.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from catalog.config import resource
from catalog.control_point import Patch
from catalog.errors import DataError
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.projection import Stereographic
from catalog.rasters import OWN, open_raster
from catalog.store.reader import Catalog

log = logging.getLogger(__name__)


MOON_FILE, MOON_RADIUS_M = "data/moon_gld100_4ppd.tif", 1737400.0
MOON_WORDS = "Relief: LROC WAC GLD100 at 4 px/deg, bundled."
OWN_WORDS = "Relief: the catalog's own height grids."
# Below this size of a map's pixel the bundled Moon, of 7.6 km, would look blurred.
MIN_MOON_PIXEL_M = 3000.0
MAX_PATCHES = 4000  # that are read for a relief: a second or two
MIN_COVERED = 0.6  # share of the map's ground that its patches must cover
STEEP = 0.55  # of the shading, for the slope that one pixel in ten exceeds
GRAY, DEPTH = 150.0, 95.0  # level ground, and how much light and shade differ from it


def find_relief(
    catalog: Catalog, lat_deg: FloatArray, lon_deg: FloatArray
) -> tuple[ByteArray, BoolArray, str] | None:
    """Find a gray picture (h, w) of the ground under a map's pixels, lit from the upper left.

    lat_deg, lon_deg  (h, w)  places of the pixels, not finite off the body

    Returns the picture, where its ground is known (h, w), and whose heights they are; None where
    the catalog holds too little ground and its body is not the Moon.
    """
    bundled = find_bundled_relief(catalog.meta.body, catalog.meta.radius_m, lat_deg, lon_deg)
    if bundled is not None:
        return bundled
    pixel_m = _compute_pixel_m(lat_deg, lon_deg, catalog.meta.radius_m)
    # heights above tangent planes are no map's: a small body is drawn by its whole relief
    if catalog.meta.planes is not None:
        heights = _sample_body(catalog, lat_deg, lon_deg)
    else:
        heights = _sample_patches(catalog, lat_deg, lon_deg, pixel_m)
    if heights is None:
        return None
    return shade(heights, pixel_m), np.isfinite(heights), OWN_WORDS


def find_bundled_relief(
    body: str, radius_m: float, lat_deg: FloatArray, lon_deg: FloatArray
) -> tuple[ByteArray, BoolArray, str] | None:
    """Find the bundled Moon's relief; None for another body and where it would look blurred."""
    pixel_m = _compute_pixel_m(lat_deg, lon_deg, radius_m)
    if body != "moon" or radius_m != MOON_RADIUS_M or pixel_m < MIN_MOON_PIXEL_M:
        return None
    heights = _sample_moon(lat_deg, lon_deg)
    return shade(heights, pixel_m), np.isfinite(heights), MOON_WORDS


def _compute_pixel_m(lat_deg: FloatArray, lon_deg: FloatArray, radius_m: float) -> float:
    """Compute the size of the pixel in the middle of a map."""
    row, column = (side // 2 for side in lat_deg.shape)
    lat, lon = (np.radians(v[row, column : column + 2]) for v in (lat_deg, lon_deg))
    first, second = xyz_from_latlon(lat, lon, radius_m)
    return float(np.linalg.norm(second - first))


def shade(heights_m: Float32Array, posting_m: float) -> ByteArray:
    """Shade heights (h, w) as relief in gray, lit from the upper left; NaN is level.

    Exaggerated until slopes read well, whatever the terrain's: this is a map, not a view.
    """
    southward, eastward = np.gradient(heights_m.astype(np.float64), posting_m)
    facing = np.nan_to_num((eastward + southward) / np.sqrt(2.0))
    rough = np.abs(facing[facing != 0.0])
    steep = float(np.percentile(rough, 90.0)) if rough.size else 1.0
    light: FloatArray = np.tanh(STEEP * facing / max(steep, 1e-9))
    return np.clip(np.rint(GRAY + DEPTH * light), 0.0, 255.0).astype(np.uint8)


def _sample_moon(lat_deg: FloatArray, lon_deg: FloatArray) -> Float32Array:
    with open_raster(resource(MOON_FILE), OWN) as source:
        heights = source.read(1).astype(np.float32)
    rows, columns = heights.shape
    # a column more at either end, so that nothing is special at the seam
    heights = np.concatenate([heights[:, -1:], heights, heights[:, :1]], axis=1)
    known = np.isfinite(lat_deg)
    # the file's first column begins at longitude 0
    x = np.mod(np.where(known, lon_deg, 0.0), 360.0) / 360.0 * columns + 0.5
    y = (90.0 - np.where(known, lat_deg, 0.0)) / 180.0 * rows - 0.5
    x, y = x.astype(np.float32), y.astype(np.float32)
    sampled = cv2.remap(heights, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(known, sampled, np.nan).astype(np.float32)


def _sample_body(catalog: Catalog, lat_deg: FloatArray, lon_deg: FloatArray) -> Float32Array | None:
    """Sample the pixels' heights in the relief of the full body, if the catalog carries one."""
    carried = catalog.relief()
    if carried is None:
        return None
    known = np.isfinite(lat_deg)
    heights = np.full(lat_deg.shape, np.nan, np.float32)
    heights[known] = carried.heights_at(np.radians(lat_deg[known]), np.radians(lon_deg[known]))
    return heights


def _sample_patches(
    catalog: Catalog, lat_deg: FloatArray, lon_deg: FloatArray, pixel_m: float
) -> Float32Array | None:
    """Sample the pixels' heights in the patches of the nearest points, as far as those reach."""
    known = np.isfinite(lat_deg)
    chosen = _thin_points(catalog)
    if len(chosen) == 0 or not known.any():
        return None
    lat, lon = lat_deg[known], lon_deg[known]
    directions = xyz_from_latlon(np.radians(lat), np.radians(lon), 1.0)
    chord, nearest = cKDTree(catalog.direction[chosen]).query(directions)
    level, reach_m = _choose_level(catalog, len(chosen))
    near = np.flatnonzero(chord * catalog.meta.radius_m <= reach_m)
    near = near[np.argsort(nearest[near], kind="stable")]
    bounds = np.searchsorted(nearest[near], np.arange(len(chosen) + 1))
    heights = np.full(len(lat), np.nan, np.float32)
    damaged = 0
    for number in np.flatnonzero(np.diff(bounds)):
        row, pixels = int(chosen[number]), near[bounds[number] : bounds[number + 1]]
        try:
            levels = catalog.patches(int(catalog.ids[row]))
        except DataError:
            damaged += 1
            continue
        patch = levels[min(level, len(levels) - 1)]
        lat0, lon0 = np.radians((catalog.lat_deg[row], catalog.lon_deg[row]))
        projection = Stereographic(lat0, lon0, catalog.meta.radius_m)
        heights[pixels] = _sample_patch(patch, *projection.xy_from_xyz(directions[pixels]), pixel_m)
    if damaged:  # the page is about the rest; `verify` lists the damage
        words = "%s: %d damaged control points are missing in the relief; run `catalog verify`"
        log.warning(words, catalog.path, damaged)
    inside = np.isin(catalog.grid.find_cells(lat, lon), catalog.ids)
    if not inside.any() or np.isfinite(heights[inside]).mean() < MIN_COVERED:
        return None
    picture = np.full(lat_deg.shape, np.nan, np.float32)
    picture[known] = heights
    return picture


def _choose_level(catalog: Catalog, chosen: int) -> tuple[int, float]:
    """Choose the finest level that reaches into all of a cell; return its farthest reach (m), too.

    chosen  points that are drawn; fewer than there are stand for more ground each
    """
    meta = catalog.meta
    half_m = (meta.size - 1) / 2.0 * meta.posting_m
    wanted_m = np.radians(meta.cell_deg) * meta.radius_m * np.sqrt(len(catalog) / chosen)
    level = min(max(int(np.ceil(np.log2(wanted_m / half_m))), 0), meta.levels - 1)
    return level, float(np.sqrt(2.0) * 2.0**level * half_m)


def _thin_points(catalog: Catalog) -> IntArray:
    """Thin the points that hold patches evenly over the body to a bearable number."""
    rows = np.flatnonzero(catalog.records["levels"] > 0)
    step = catalog.meta.cell_deg
    while len(rows) > MAX_PATCHES:
        step = min(1.5 * step, 90.0)
        cells = CellGrid(step).find_cells(catalog.lat_deg[rows], catalog.lon_deg[rows])
        rows = rows[np.unique(cells, return_index=True)[1]]
    return rows


def _sample_patch(patch: Patch, x: FloatArray, y: FloatArray, pixel_m: float) -> Float32Array:
    """Sample heights at map places (n,) of a patch, smoothed to the map's pixel; NaN outside."""
    heights = patch.heights_m
    sigma = 0.4 * pixel_m / patch.posting_m
    if sigma > 0.5:
        heights = np.asarray(cv2.GaussianBlur(heights, (0, 0), sigma), np.float32)
    half = (patch.size - 1) / 2.0
    places = np.stack([half - y / patch.posting_m, x / patch.posting_m + half])
    sampled: Float32Array = map_coordinates(heights, places, order=1, cval=np.nan)
    return sampled
