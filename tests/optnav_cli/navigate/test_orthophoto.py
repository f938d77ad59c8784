"""Orthophotos: counts at their places, hidden ground, and how far off places are."""

import csv
import json

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.projection import Stereographic
from catalog.geometry.rotations import rnb_axes
from catalog.geometry.vectors import unit
from catalog.terrain.dem.source import DemSource
from optnav_cli.fix import MatchRow
from optnav_cli.main import run as optnav
from optnav_cli.navigate.orthophoto import (
    MapFrame,
    SolvedPose,
    find_hidden,
    lay_out_map,
    make_pose,
    map_picture,
)
from tests.catalog.conftest import write_dem
from tests.optnav_cli.made_runs import CAMERA, RADIUS_M, nadir, orbit
from tests.optnav_cli.rows import solved

MOON = load_body("moon")
DEGREE = np.pi / 180.0


def pattern(lat, lon):
    """Brightness of a place (rad): waves of 40 km, many pixels long."""
    return 2000.0 + 700.0 * np.sin(270.0 * lat) * np.cos(200.0 * lon)


def hill(lat, lon):
    """Heights, m, of a hill 3 km high and about 15 km wide at 10 N 20 E."""
    apart = np.hypot((lat - 10.0 * DEGREE), (lon - 20.0 * DEGREE) * np.cos(10.0 * DEGREE))
    return 3000.0 * np.exp(-0.5 * (apart * RADIUS_M / 7000.0) ** 2)


def make_dem(path, heights=hill, side_deg=6.0, pixels=600):
    """A terrain model about 10 N 20 E on a grid of degrees."""
    step = side_deg / pixels
    affine = Affine(step, 0.0, 20.0 - side_deg / 2.0, 0.0, -step, 10.0 + side_deg / 2.0)
    at = (np.arange(pixels) + 0.5) * step - side_deg / 2.0
    lat, lon = (10.0 - at)[:, None] * DEGREE, (20.0 + at)[None, :] * DEGREE
    return write_dem(path, heights(lat, lon).astype(np.float32), affine=affine)


def aim(lat_deg, lon_deg, height_m, tilt_deg):
    """A camera over a place, its boresight tilted from nadir toward the orbit's normal."""
    position = xyz_from_latlon(lat_deg * DEGREE, lon_deg * DEGREE, RADIUS_M + height_m)
    ahead = xyz_from_latlon((lat_deg - 90.0) * DEGREE, lon_deg * DEGREE, 1.0)
    down = nadir(rnb_axes(position, ahead))
    return position, Rotation.from_rotvec([0.0, tilt_deg * DEGREE, 0.0]) * down


def draw_picture(position, turn, heights=hill):
    """Counts of the pattern in the camera; rays meet the ground by steps of their own."""
    x, y = np.meshgrid(np.arange(CAMERA.width_px), np.arange(CAMERA.height_px))
    rays = CAMERA.unproject(np.stack([x, y], axis=-1).astype(float)) @ turn.as_matrix()
    distance = np.full(x.shape, 1.0) * (np.linalg.norm(position) - RADIUS_M)
    for _ in range(16):
        lat, lon, radius = latlon_from_xyz(position + distance[..., None] * rays)
        distance = distance + 0.7 * (radius - RADIUS_M - heights(lat, lon))
    lat, lon, radius = latlon_from_xyz(position + distance[..., None] * rays)
    assert np.abs(radius - RADIUS_M - heights(lat, lon)).max() < 1.0
    return pattern(lat, lon)


def make_exact(position, turn):
    return SolvedPose(CAMERA, position, turn.as_matrix(), np.zeros((6, 6)))


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
def test_counts_lie_at_their_places_over_a_hill(tmp_path, tilt_deg):
    position, turn = aim(10.0, 20.0, 100e3, tilt_deg)
    pose = make_exact(position, turn)
    frame = lay_out_map(pose, MOON, 150.0)
    dem = DemSource.open_alone(make_dem(tmp_path / "dem.tif"), MOON)
    values, sigmas = map_picture(pose, frame, dem, draw_picture(position, turn), 0.0)
    seen = np.isfinite(values)
    assert seen.mean() > 0.5
    lat, lon = frame.projection.latlon(*frame.nodes(0, frame.size[0]))
    wrong = np.abs(values[seen] - pattern(lat, lon)[seen])
    # a pixel, 100 to 130 m, is 3 counts of the pattern's 110 a km
    assert np.quantile(wrong, 0.99) < 3.0
    assert wrong.max() < 12.0
    assert sigmas[seen].max() == 0.0


def test_ground_behind_a_wall_has_no_value():
    frame = MapFrame(
        Stereographic(10.0 * DEGREE, 20.0 * DEGREE, RADIUS_M), -15e3, 15e3, 250.0, (120, 120)
    )
    x, y = frame.nodes(0, 120)
    ground = np.where(np.abs(x) < 1500.0, 4000.0, 0.0).astype(np.float32)
    # 100 km high and 100 km west of the middle: the wall's shadow ends 5.5 km east of it
    west = 20.0 - np.degrees(100e3 / RADIUS_M) / np.cos(10.0 * DEGREE)
    position = xyz_from_latlon(10.0 * DEGREE, west * DEGREE, RADIUS_M + 100e3)
    points = frame.projection.points(x, y, ground)
    hidden = find_hidden(position, points, frame, ground, 0)
    assert not hidden[:, x[0] < 1400.0].any()
    assert hidden[:, (x[0] > 1800.0) & (x[0] < 5200.0)].all()
    assert not hidden[:, x[0] > 6200.0].any()
    assert np.array_equal(find_hidden(position, points[50:70], frame, ground, 50), hidden[50:70])


def test_sigmas_are_the_scatter_of_places_under_drawn_poses():
    position, turn = aim(10.0, 20.0, 100e3, 25.0)
    matrix = turn.as_matrix()
    rng = np.random.default_rng(5)
    mix = rng.normal(size=(6, 6)) * np.array([30.0, 30.0, 30.0, 3e-4, 3e-4, 3e-4])[:, None]
    pose = SolvedPose(CAMERA, position, matrix, mix @ mix.T)
    pixels = np.array([[30.0, 40.0], [255.0, 255.0], [480.0, 300.0]])
    rays = CAMERA.unproject(pixels) @ matrix
    points = position + distance_to_sphere(position, rays, RADIUS_M)[:, None] * rays
    up = unit(points)
    offsets = []
    for _ in range(4000):
        change = mix @ rng.normal(size=6)
        ray = CAMERA.unproject(pixels) @ (Rotation.from_rotvec(change[3:]).as_matrix() @ matrix)
        moved, height = position + change[:3], 50.0 * rng.normal()
        # the tangent plane, as high as the ground truly is
        far = ((points - moved + height * up) * up).sum(axis=1) / (ray * up).sum(axis=1)
        off = moved + far[:, None] * ray - points
        offsets.append(off - up * (off * up).sum(axis=1, keepdims=True))
    scatter = np.sqrt(0.5 * (np.array(offsets) ** 2).sum(axis=2).mean(axis=0))
    assert pose.compute_sigmas(points, 50.0) == pytest.approx(scatter, rel=0.05)


def test_matches_tie_position_and_attitude():
    position, turn = aim(10.0, 20.0, 100e3, 0.0)
    rng = np.random.default_rng(2)
    matches = []
    for number, pixel in enumerate(rng.uniform(20.0, 490.0, (12, 2))):
        ray = CAMERA.unproject(pixel) @ turn.as_matrix()
        along = float(distance_to_sphere(position, ray, RADIUS_M))
        place, residual = position + along * ray, rng.normal(size=2) * 0.2
        found = pixel + residual
        matches.append(
            MatchRow("a.png", number, 0, place, pixel, found, used=True, residual_px=residual)
        )
    # what twelve points of 0.2 px tell of an attitude that is free: 100 m aside, 60" of tilt
    solution = solved(
        "a.png", "2024-01-01T00:00:00Z", "control_points", position,
        np.diag([100.0, 100.0, 30.0]) ** 2, turn, 1e-3,
    )  # fmt: skip
    tied = make_pose(solution, CAMERA, matches)
    loose = make_pose(solution, CAMERA, matches[:2])
    place = matches[0].cp_position_m[None]
    assert loose.compute_sigmas(place, 0.0)[0] > 100.0
    assert tied.compute_sigmas(place, 0.0)[0] < 30.0
    assert np.trace(tied.covariance[:3, :3]) == pytest.approx(np.trace(solution.covariance_m2))


@pytest.fixture
def run(tmp_path, make_run):
    """A run whose first two frames are solved; pictures of the pattern on even ground."""
    make_run(tmp_path / "run", count=3, unsolved_from=2)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number, (_, position, axes) in enumerate(orbit(3)):
        counts = draw_picture(position, nadir(axes), lambda lat, lon: 0.0 * lat)
        cv2.imwrite(str(pictures / f"frame_{number:04d}.png"), counts.astype(np.uint16))
    manifest = {"made_by": "optnav", "kind": "run", "inputs": {"pictures": str(pictures)}}
    (tmp_path / "run" / "manifest.json").write_text(json.dumps(manifest))
    affine = Affine(0.05, 0.0, -20.0, 0.0, -0.05, -30.0)
    write_dem(tmp_path / "dem.tif", np.zeros((500, 500), np.float32), affine=affine)
    return tmp_path


def test_the_command_writes_maps_and_a_table(run, capsys):
    asked = ["export", f"{run}/run", "--ortho", "--dem", f"{run}/dem.tif", "-o", f"{run}/maps"]
    assert optnav([*asked, "--posting-m", "500"]) == 0
    out = capsys.readouterr().out
    assert "2 of 3 frames laid out" in out
    assert "frame_0002.png: is not solved: fewer than two control points matched" in out
    with (run / "maps" / "ortho.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["status"] for row in rows] == ["solved", "solved", "unsolved"]
    assert float(rows[0]["posting_m"]) == 500.0
    with rasterio.open(run / "maps" / rows[0]["ortho"]) as data:
        counts, sigma = data.read()
        assert "Stereographic" in data.crs.to_wkt()
        seen = np.isfinite(counts)
    assert seen.mean() > 0.6
    assert (sigma[seen] > 0.0).all()
    assert float(rows[0]["sigma_max_m"]) == pytest.approx(float(sigma[seen].max()), abs=1e-3)


def test_what_is_missing_is_named(run, capsys):
    base = ["export", f"{run}/run", "-o", f"{run}/maps", "--ortho"]
    assert optnav(base) == 2
    assert "wants --dem" in capsys.readouterr().err
    assert optnav(["export", f"{run}/run", "-o", f"{run}/a.gpkg", "--posting-m", "5"]) == 2
    assert "--posting-m: for --ortho" in capsys.readouterr().err
    assert optnav([*base[:-2], f"{run}/maps.tif", "--ortho", "--dem", f"{run}/dem.tif"]) in (2, 3)
    capsys.readouterr()
    elsewhere = Affine(0.05, 0.0, 100.0, 0.0, -0.05, 60.0)
    write_dem(run / "far.tif", np.zeros((50, 50), np.float32), affine=elsewhere)
    assert optnav([*base, "--dem", f"{run}/far.tif"]) == 4
    assert "no heights of the ground in the picture" in capsys.readouterr().err
    for file in (run / "pictures").iterdir():
        file.unlink()
    (run / "pictures").rmdir()
    assert optnav([*base, "--dem", f"{run}/dem.tif"]) == 3
    assert "name the picture folder by --pictures" in capsys.readouterr().err
