"""A run for GIS programs: tracks, positions, footprints and matched points, as a GeoPackage.

A footprint is the ground that a picture shows: the frame's border, and the limb where it crosses
the frame. The ground is the body's ellipsoid. Divided by its semi-axes it is the unit sphere; seen
from a camera at the distance d from the centre, it is a disc about the nadir of the angular radius
asin(1/d). In the plane with the angle from the nadir, over that radius, as the distance from the
origin, this disc is the unit circle and the picture's border a ring, which is cut to it.
"""

import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import OutputError
from catalog.files import replace_file
from catalog.geometry.ellipsoid import distance_to_sphere, geodetic_from_xyz
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.map_pieces import clip_ring, split_area, split_line
from catalog.geometry.vectors import perpendicular_basis, unit
from catalog.store.connection import SIDECARS
from catalog.store.geopackage import (
    BLUE,
    GRAY,
    GREEN,
    RED,
    UNDATED,
    Box,
    Feature,
    FeatureLayer,
    Kind,
    Rule,
    add_system,
    define_spheroid_srs,
    define_srs,
    describe_geopackage,
    encode_parts,
    encode_point,
    format_style,
    list_columns,
    open_new_geopackage,
)
from catalog.store.records import replace_unknown
from optnav_cli.camera.camera import Camera
from optnav_cli.evaluation.figures import TimedPlace, is_same_pass
from optnav_cli.evaluation.files import read_time
from optnav_cli.fix import Solution
from optnav_cli.output.run_folder import RunFolder

ENDING = ".gpkg"
_FRAME = ("file TEXT NOT NULL", "utc TEXT NOT NULL", "camera TEXT NOT NULL")
_WHY = ("reason TEXT NOT NULL", "reason_code TEXT NOT NULL")

TRACK = FeatureLayer(
    "camera_track",
    "MULTILINESTRING",
    "Below the camera, from frame to frame of one pass; a line for each camera",
    ("camera TEXT NOT NULL", "first_utc TEXT NOT NULL", "last_utc TEXT NOT NULL", "frames INTEGER"),
    format_style(Rule("track", "", "line", GRAY, 0.3)),
)
POSITIONS = FeatureLayer(
    "camera_positions",
    "POINT",
    "Below the camera; without a geometry where the frame is unsolved",
    (
        *(*_FRAME, "status TEXT NOT NULL", "method TEXT NOT NULL", "prior TEXT NOT NULL"),
        *("height_m DOUBLE", "sigma_height_m DOUBLE", "sigma_horizontal_m DOUBLE"),
        *("x_m DOUBLE", "y_m DOUBLE", "z_m DOUBLE"),
        *("n_used INTEGER", "n_limb INTEGER", "residual_rms_px DOUBLE", *_WHY),
    ),
    format_style(
        Rule("by control points", "\"method\" = 'control_points'", "circle", BLUE, 2.4),
        Rule("by the limb or disc", "ELSE", "triangle", BLUE, 2.4),
    ),
)
FOOTPRINTS = FeatureLayer(
    "footprints",
    "MULTIPOLYGON",
    "The ground in the frame, on the body's ellipsoid, up to the limb",
    (*_FRAME, "method TEXT NOT NULL", "height_m DOUBLE"),
    format_style(Rule("ground in view", "", "fill", BLUE, 0.3)),
)
MATCHES = FeatureLayer(
    "matched_points",
    "POINT",
    "Control points tried in a frame",
    (
        *("file TEXT NOT NULL", "catalog TEXT NOT NULL", "point_id INTEGER NOT NULL"),
        *("level INTEGER NOT NULL", "used BOOLEAN NOT NULL", "radius_m DOUBLE", "score DOUBLE"),
        *("residual_x_px DOUBLE", "residual_y_px DOUBLE", "sun_elevation_deg DOUBLE", *_WHY),
    ),
    format_style(
        Rule("used", '"used"', "circle", GREEN, 1.6), Rule("not used", "ELSE", "cross2", RED, 1.6)
    ),
)
POSITIONS_SPHEROID = replace(POSITIONS, columns=(*POSITIONS.columns, "height_ellipsoid_m DOUBLE"))
LAYERS = (FOOTPRINTS, TRACK, MATCHES, POSITIONS)  # as they are drawn, the lowest first


def export_run(run: RunFolder, path: Path) -> dict[str, int]:
    """Write a run's layers to a .gpkg file; returns how many rows each has.

    They lie on the body's sphere, those of a spheroid in geodetic coordinates on it.
    Raises OutputError for another ending, a place that cannot be written, or an existing file that
    is no such export.
    """
    if path.suffix.lower() != ENDING:
        raise OutputError(f"{path}: a run is written as {ENDING}; choose a name that ends so")
    body = run.attitude.body
    layers = LAYERS
    system = define_srs(body.name, body.radius_m)
    if body.flattening:
        system = define_spheroid_srs(body.name, body.radii_m)
        layers = (*LAYERS[:-1], POSITIONS_SPHEROID)
    srs_id = system[0]
    features = dict(zip(layers, (_make_footprints, _make_tracks, _make_matches, _make_positions)))
    with replace_file(path, _is_ours, SIDECARS) as partial, open_new_geopackage(partial) as db:
        describe_geopackage(db, body.name, body.radius_m, UNDATED)
        if body.flattening:
            add_system(db, system)
        for layer, make in features.items():
            layer.create(db)
            extent = layer.fill(db, make(run, srs_id))
            layer.register(db, srs_id, extent, UNDATED)
        return {layer.name: _count(db, layer) for layer in layers}


def _is_ours(path: Path) -> bool:
    ours = POSITIONS.names, POSITIONS_SPHEROID.names
    return list_columns(path, POSITIONS.name) in ours


def _count(db: sqlite3.Connection, layer: FeatureLayer) -> int:
    (count,) = db.execute(f"SELECT count(*) FROM {layer.name}").fetchone()
    return int(count)


def _get_camera_name(run: RunFolder, solution: Solution) -> str:
    camera = run.cameras.get(solution.file)
    return camera.name if camera is not None else ""


def _make_frame_cells(run: RunFolder, solution: Solution) -> tuple[object, ...]:
    return solution.file, solution.utc, _get_camera_name(run, solution)


def _project_to_map(xyz_m: FloatArray, body: Body) -> FloatArray:
    """Return vectors (..., 3) whose planetocentric coordinates are those of points on the map.

    Of a spheroid they are the normals through the places, whose latitudes are geodetic.
    """
    if not body.flattening:
        return xyz_m
    lat, lon, _ = geodetic_from_xyz(xyz_m, body.radii_m)
    normals = xyz_from_latlon(lat, lon, 1.0)
    return np.where(np.isfinite(normals), normals, xyz_m)


def _convert_to_lonlat(xyz_m: FloatArray, body: Body) -> tuple[float, float]:
    """Convert a position to longitude and latitude on the map, deg."""
    lat, lon, _ = (float(value) for value in latlon_from_xyz(_project_to_map(xyz_m, body)))
    return float(np.degrees(lon)), float(np.degrees(lat))


def _find_box(parts: list[FloatArray]) -> Box | None:
    if not parts:
        return None
    low, high = np.min(np.vstack(parts), axis=0), np.max(np.vstack(parts), axis=0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _encode_parts(
    kind: Kind, parts: list[FloatArray], srs_id: int
) -> tuple[bytes | None, Box | None]:
    return encode_parts(kind, parts, srs_id), _find_box(parts)


def _make_tracks(run: RunFolder, srs_id: int) -> Iterator[Feature]:
    """Make a feature for each camera with frames that belong together."""
    cameras: dict[str, list[tuple[TimedPlace, Solution]]] = {}
    body = run.attitude.body
    for s in run.solutions:
        if s.position_m is not None:
            point = TimedPlace(read_time(s.utc), s.position_m)
            cameras.setdefault(_get_camera_name(run, s), []).append((point, s))
    for number, (camera, places) in enumerate(sorted(cameras.items()), start=1):
        places.sort(key=lambda pair: pair[0].tdb_s)
        passes = [[places[0][0]]]
        for (before, _), (here, _) in pairwise(places):
            if not is_same_pass(before, here):
                passes.append([])
            passes[-1].append(here)
        lines = [np.array([point.position_m for point in way]) for way in passes if len(way) > 1]
        pieces = [piece for line in lines for piece in split_line(_project_to_map(line, body))]
        geometry, box = _encode_parts(TRACK.kind, pieces, srs_id)
        times = places[0][1].utc, places[-1][1].utc
        yield (number, geometry, camera, *times, len(places)), box


def _make_positions(run: RunFolder, srs_id: int) -> Iterator[Feature]:
    """Make a feature for each frame; of an unsolved one the attributes alone."""
    body = run.attitude.body
    above: tuple[object, ...] = (None,) if body.flattening else ()
    for number, s in enumerate(run.solutions, start=1):
        geometry, box, numbers, more = None, None, (None,) * 6, above
        if s.position_m is not None and s.covariance_m2 is not None:
            lon, lat = _convert_to_lonlat(s.position_m, body)
            radius = float(latlon_from_xyz(s.position_m)[2])
            up = s.position_m / radius
            variance = float(up @ s.covariance_m2 @ up)
            across = max(float(np.trace(s.covariance_m2)) - variance, 0.0)
            geometry, box = encode_point(lon, lat, srs_id), (lon, lat, lon, lat)
            height = radius - body.radius_m
            if body.flattening:
                more = (replace_unknown(float(geodetic_from_xyz(s.position_m, body.radii_m)[2])),)
            numbers = (height, variance**0.5, across**0.5, *map(float, s.position_m))
        evidence = s.n_used, s.n_limb, s.residual_rms_px
        words = s.status, s.method, s.prior
        why = s.reason, s.reason_code.value
        yield (
            (
                number,
                geometry,
                *_make_frame_cells(run, s),
                *words,
                *numbers,
                *evidence,
                *why,
                *more,
            ),
            box,
        )


def _make_footprints(run: RunFolder, srs_id: int) -> Iterator[Feature]:
    """Make a feature for each solved frame whose camera and attitude are known."""
    number = 0
    body = run.attitude.body
    for s in run.solutions:
        camera = run.cameras.get(s.file)
        if s.position_m is None or s.camera_from_body is None or camera is None:
            continue
        turn = s.camera_from_body.as_matrix()
        rings = compute_footprint(camera, s.position_m, turn, body.radii_m)
        pieces = [piece for ring in rings for piece in split_area(_project_to_map(ring, body))]
        geometry, box = _encode_parts(FOOTPRINTS.kind, pieces, srs_id)
        if geometry is not None:
            number += 1
            height = float(np.linalg.norm(s.position_m)) - body.radius_m
            yield (number, geometry, *_make_frame_cells(run, s), s.method, height), box


def _make_matches(run: RunFolder, srs_id: int) -> Iterator[Feature]:
    """Make a feature for each control point that was tried in a frame."""
    for number, m in enumerate(run.matches, start=1):
        lon, lat = _convert_to_lonlat(m.cp_position_m, run.attitude.body)
        radius = float(latlon_from_xyz(m.cp_position_m)[2])
        residual = (None, None) if m.residual_px is None else map(float, m.residual_px)
        numbers = m.score, *residual, m.sun_elevation_deg
        known = (None if v is None else replace_unknown(v) for v in numbers)
        named = m.file, m.catalog, m.cp_id, m.level, int(m.used), radius
        row = *named, *known, m.reason, m.reason_code.value
        yield (number, encode_point(lon, lat, srs_id), *row), (lon, lat, lon, lat)


def compute_footprint(
    camera: Camera, position_m: FloatArray, camera_from_body: FloatArray, radii_m: ArrayLike
) -> list[FloatArray]:
    """Compute rings (n, 3), m, body frame, with the ground in view at their left.

    position_m (3,) of the camera; camera_from_body (3, 3); radii_m (3,) semi-axes of the ellipsoid
    Empty where the picture shows none of it, or the camera is inside.
    """
    radii = np.asarray(radii_m, dtype=np.float64)
    eye = position_m / radii
    distance = float(np.linalg.norm(eye))
    if not distance > 1.0:
        return []
    reach = float(np.arcsin(1.0 / distance))
    up = eye / distance
    axes = np.vstack([*perpendicular_basis(up), up])  # rows: across, across, away from the body
    # 48 points along each side of the border.
    rays = camera.unproject(camera.border(48))
    rays = unit(rays[np.isfinite(rays).all(axis=1)] @ camera_from_body / radii)
    across, upward = rays @ axes[:2].T, rays @ up
    angle = np.arctan2(np.linalg.norm(across, axis=1), -upward)
    # the border goes clockwise round the picture, which is looked at from outside of the body
    ring = (normalise_rows(across) * (angle / reach)[:, None])[::-1]
    depth = 1.0 - np.linalg.norm(ring, axis=1)
    if (
        depth.size
        and not (depth > 0.0).any()
        and _is_in_view(camera, camera_from_body @ -position_m)
    ):
        parts = [np.vstack([[[1.0, 0.0]], _sample_circle(0.0, 2.0 * np.pi)])]  # the whole disc
    else:
        parts = clip_ring(ring, depth, _compute_azimuth, _sample_circle, 2.0 * np.pi)
    return [_locate_on_sphere(part, eye, axes, reach) * radii for part in parts]


def normalise_rows(vectors: FloatArray) -> FloatArray:
    """Normalise vectors (n, 2); zero vectors stay."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    directions: FloatArray = vectors / np.where(length > 0.0, length, 1.0)
    return directions


def _is_in_view(camera: Camera, direction: FloatArray) -> bool:
    pixel = camera.project(direction)
    return bool(np.isfinite(pixel).all() and camera.contains(pixel))


def _compute_azimuth(points: FloatArray) -> FloatArray:
    return np.arctan2(points[:, 1], points[:, 0])


def _sample_circle(start: float, length: float) -> FloatArray:
    """Sample the unit circle from an angle over a length, without the ends."""
    # Points of the limb are 2 deg apart about the nadir.
    count = int(length / np.radians(2.0)) + 1
    angles = start + length * np.arange(1, count + 1) / (count + 1)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _locate_on_sphere(
    part: FloatArray, eye: FloatArray, axes: FloatArray, reach: float
) -> FloatArray:
    """Return points (n, 3) of the unit sphere for points of the plane."""
    share = np.linalg.norm(part, axis=1)
    way = normalise_rows(part) @ axes[:2]
    limb = share >= 1.0 - 1e-9
    angle = np.minimum(share, 1.0 - 1e-9)[:, None] * reach
    rays = np.sin(angle) * way - np.cos(angle) * axes[2]
    ground: FloatArray = eye + distance_to_sphere(eye, rays, 1.0)[:, None] * rays
    # where the line of sight touches the sphere, as far from the nadir as `reach` is from square
    ground[limb] = np.cos(reach) * way[limb] + np.sin(reach) * axes[2]
    return ground
