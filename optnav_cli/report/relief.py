"""Shaded relief under a map: from the bundled Moon, or from the catalog's own height grids."""

import logging
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from catalog.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.config import resource
from catalog.control_point import Patch
from catalog.errors import DataError
from catalog.geometry.cells import CellGrid
from catalog.geometry.ellipsoid import distance_to_sphere, geodetic_from_xyz
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.projection import Stereographic
from catalog.geometry.vectors import unit
from catalog.rasters import OWN, open_raster
from catalog.store.reader import Catalog
from optnav_cli.fix import Solution
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.run_folder import RunFolder
from optnav_cli.report import page as html
from optnav_cli.report.error_plots import is_apart, parse_time
from optnav_cli.report.svg import Plot
from optnav_cli.report.views import GroundMap, MapView

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
MAX_FOOTPRINTS = 60
MAX_DOTS = 4000
BORDER_POINTS = 12  # of a footprint, along each side of the picture
HEIGHT = 620
RELIEF_QUALITY = 60  # of the JPEG under the map, 0.1 to 0.3 MB


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


def plot_ground(run: RunFolder) -> Markup:
    """Plot footprints of solved frames, the ground track of the camera, and the control points."""
    solved = sorted(
        (s for s in run.solutions if s.position_m is not None), key=lambda s: parse_time(s.utc)
    )
    body = run.attitude.body
    lat, lon = _compute_latlon(np.array([s.position_m for s in solved]), body)
    points = {(m.catalog, m.cp_id): m for m in sorted(run.matches, key=lambda match: match.used)}
    tried = np.array([m.cp_position_m for m in points.values()]).reshape(-1, 3)
    cp_lat, cp_lon = _compute_latlon(tried, body)
    step = -(-len(solved) // MAX_FOOTPRINTS)
    borders = [border for s in solved[::step] if (border := _project_footprint(run, s)) is not None]
    all_lat = np.degrees(np.concatenate([lat, cp_lat, *(b[0] for b in borders)]))
    all_lon = np.degrees(np.concatenate([lon, cp_lon, *(b[1] for b in borders)]))
    finite = np.isfinite(all_lat)
    ground = GroundMap.fit(all_lat[finite], all_lon[finite], body.radius_m)
    extent = ground.places(all_lat[finite], all_lon[finite])
    plot = ground.plot(*extent, height=HEIGHT)
    caption = "Where the camera looked." + ("" if step == 1 else f" Footprints, one of {step}.")
    caption += " Latitudes are geodetic." if body.flattening else ""

    def convert_to_planetocentric(x: ArrayLike, y: ArrayLike) -> tuple[FloatArray, FloatArray]:
        on_map_deg, east_deg = ground.latlon(x, y)
        slope = (1.0 - body.flattening) ** 2 * np.tan(np.radians(on_map_deg))
        return (
            (np.degrees(np.arctan(slope)), east_deg) if body.flattening else (on_map_deg, east_deg)
        )

    under = _find_relief(
        run, MapView("", False, lambda: plot, convert_to_planetocentric, ground.places, None)
    )
    if under is not None:
        gray, known, words = under
        gray[~known] = round(GRAY)
        plot.picture(html.encode_picture_uri(gray, ".jpg", RELIEF_QUALITY), "pale")
        caption = f"{caption} {words}"
    for b_lat, b_lon in borders:
        x, y = ground.places(np.degrees(b_lat), np.degrees(b_lon))
        _draw_line(plot, ground, x, y, "s1 thin", closed=True)
    x, y = ground.places(np.degrees(cp_lat), np.degrees(cp_lon))
    used = np.array([m.used for m in points.values()], dtype=np.bool_)
    names = np.array([f"control point {cp_id}" for _, cp_id in points])
    for choice, series, radius in ((~used, "s4", 2.2), (used, "s3", 2.6)):
        few = slice(None, None, -(-max(int(choice.sum()), 1) // MAX_DOTS))
        plot.dots(x[choice][few], y[choice][few], series, radius, list(names[choice][few]))
    x, y = ground.places(np.degrees(lat), np.degrees(lon))
    cuts = np.flatnonzero(is_apart(np.array([parse_time(s.utc) for s in solved])))
    for part in np.split(np.arange(len(solved)), cuts[cuts > 0]):
        _draw_line(plot, ground, x[part], y[part], "s2 thin")
    plot.dots(x, y, "s2", 3.2, [s.file for s in solved])
    keys = {"k2": "below the camera"}
    keys |= {"k1": "footprint"} if borders else {}
    keys |= {"k3": "control point used"} if used.any() else {}
    keys |= {"k4": "tried, never used"} if not used.all() else {}
    return html.figure(plot.svg("Map of the run"), caption, keys)


def _draw_line(
    plot: Plot, ground: GroundMap, x: FloatArray, y: FloatArray, series: str, closed: bool = False
) -> None:
    """Draw a line, open at the seam of a map of longitudes."""
    if ground.regional:
        plot.line(x, y, series, closed)
        return
    if closed:
        x, y = np.append(x, x[0]), np.append(y, y[0])
    seams = np.flatnonzero(np.abs(np.diff(x)) > 180.0) + 1
    for places in np.split(np.arange(len(x)), seams):
        plot.line(x[places], y[places], series)


def _project_footprint(run: RunFolder, solution: Solution) -> tuple[FloatArray, FloatArray] | None:
    """Project a picture's border to the ground: latitude, longitude, rad; NaN in the sky."""
    camera = run.cameras.get(solution.file)
    if camera is None or solution.position_m is None or solution.camera_from_body is None:
        return None
    rays = camera.unproject(camera.border(BORDER_POINTS))
    rays_body = rays @ solution.camera_from_body.as_matrix()
    body = run.attitude.body
    if body.flattening:  # divided by its semi-axes the spheroid is the unit sphere
        radii = np.array(body.radii_m)
        eye, sights = solution.position_m / radii, unit(rays_body / radii)
        places = (eye + distance_to_sphere(eye, sights, 1.0)[:, None] * sights) * radii
    else:
        distance = distance_to_sphere(solution.position_m, rays_body, body.radius_m)
        places = solution.position_m + distance[:, None] * rays_body
    known = np.isfinite(places).all(axis=1)
    if not known.any():
        return None
    lat, lon = np.full((2, len(places)), np.nan)
    lat[known], lon[known] = _compute_latlon(places[known], body)
    return lat, lon


def _compute_latlon(places_m: FloatArray, body: Body) -> tuple[FloatArray, FloatArray]:
    """Compute latitude and longitude (n,) of places (n, 3), rad; geodetic of a spheroid."""
    lat, lon, _ = latlon_from_xyz(places_m)
    if body.flattening and len(places_m):
        geodetic = geodetic_from_xyz(places_m, body.radii_m)[0]
        lat = np.where(np.isfinite(geodetic), geodetic, lat)
    return lat, lon


def _find_relief(run: RunFolder, view: MapView) -> tuple[ByteArray, BoolArray, str] | None:
    """Find the ground under a map in the run's catalogs, else in the bundled Moon."""
    lat, lon = view.pixels()
    for path in _list_catalogs(run.path):
        try:
            with Catalog.open(path) as catalog:
                if catalog.meta.body == run.attitude.body.name:
                    ground = find_relief(catalog, lat, lon)
                    if ground is not None:
                        return ground
        except DataError:  # a catalog that is gone or damaged is no reason to have no report
            continue
    return find_bundled_relief(run.attitude.body.name, run.attitude.body.radius_m, lat, lon)


def _list_catalogs(folder: Path) -> Iterator[Path]:
    """List the catalogs that the run's manifest names and that are still there."""
    try:
        inputs = read_manifest(folder).get("inputs")
    except DataError:
        return
    named = inputs.get("catalogs") if isinstance(inputs, dict) else None
    for entry in named if isinstance(named, list) else ():
        path = entry.get("path") if isinstance(entry, dict) else None
        if isinstance(path, str) and Path(path).is_file():
            yield Path(path)
