"""The map of a run: relief, footprints, the places below the camera, control points."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, ByteArray, FloatArray
from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.geometry.ellipsoid import distance_to_sphere, geodetic_from_xyz
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.vectors import unit
from catalog.store.reader import Catalog
from optnav_cli.fix import Solution
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.run_folder import RunFolder
from optnav_cli.report import page as html
from optnav_cli.report.error_plots import is_apart, parse_time
from optnav_cli.report.relief import GRAY, find_bundled_relief, find_relief
from optnav_cli.report.svg import Plot
from optnav_cli.report.views import GroundMap, MapView

MAX_FOOTPRINTS = 60
MAX_DOTS = 4000
BORDER_POINTS = 12  # of a footprint, along each side of the picture
HEIGHT = 620
RELIEF_QUALITY = 60  # of the JPEG under the map, 0.1 to 0.3 MB


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
