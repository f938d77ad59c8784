"""One point searched in pictures whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from catalog.control_point import Patch
from catalog.correlation import relief_albedo
from catalog.correlation.ncc import match_ncc
from catalog.correlation.relief_albedo import compute_steepness_and_crests, load_shipped_strengths
from catalog.correlation.surf64 import match_surf
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points import point_match
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.control_points.point_match import MatchGates, match_point
from optnav_cli.control_points.reference import Reference
from optnav_cli.control_points.search_plan import Distortion, SearchPlan
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.reasons import ReasonCode
from tests.optnav_cli.conftest import pixel_grid

CAMERA = Camera("small", "pinhole", 300, 300, 830.0, (149.5, 149.5))
METRES_PER_PIXEL = 120.5


@pytest.fixture
def reference(rough_world):
    point, patches = rough_world.control_points[len(rough_world.control_points) // 2]
    return Reference(point, patches, rough_world.radius_m)


@pytest.fixture
def sun(rough_world):
    return rough_world.sun(25.0, 70.0)


def above(rough_world, reference, roll=0.0):
    lat, lon = np.radians([reference.point.lat_deg, reference.point.lon_deg])
    return rough_world.pose(100e3, roll=roll, lat=lat, lon=lon)


def picture_of(reference, pose, sun, level=0, size=200, strengths=(0.0, 0.0)):
    """The reference's own terrain as a camera at the pose sees it.

    strengths  of albedo on its slopes and crests

    The rendered window is laid under the pixels by the inverse of the camera's geometry, found
    with the surface's own projection: a route that shares nothing with the matcher's resampling.
    """
    rendered = reference.render(level, reference.heights(level, size), sun, pose.position_m)
    posting = reference.patches[level].posting_m
    steep, crests = compute_steepness_and_crests(reference.heights(level, size), posting)
    rendered = rendered * np.exp(np.nan_to_num(strengths[0] * steep + strengths[1] * crests))
    rays = CAMERA.unproject(pixel_grid(CAMERA)) @ pose.camera_from_body.as_matrix()
    heights = np.nan_to_num(reference.heights(level, size))
    ground = np.zeros(rays.shape[:2])
    for _ in range(8):
        along = rays @ pose.position_m
        radius = reference.radius_m + ground
        squared = pose.position_m @ pose.position_m - radius**2
        place = pose.position_m + rays * (-along - np.sqrt(along**2 - squared))[..., None]
        x, y = reference.projection.xy_from_xyz(place)
        node = [(size - 1) / 2.0 - y / posting, (size - 1) / 2.0 + x / posting]
        ground = map_coordinates(heights, node, order=1, mode="nearest")
    return map_coordinates(rendered, node, order=3, mode="constant").astype(np.float32)


def search(reference, picture, pose, sun, **changes):
    options = {"matcher": match_ncc, "gates": MatchGates(0.5, 0.9)}
    options |= {name: changes.pop(name) for name in options if name in changes}
    plan = SearchPlan(
        **{"level": 0, "template_nodes": 64, "search_nodes": 12} | changes,
        metres_per_pixel=METRES_PER_PIXEL,
    )
    return match_point(reference, plan, PicturePyramid(picture), CAMERA, pose, sun, **options)


@pytest.mark.parametrize("matcher", [match_ncc, match_surf])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (430.0, -260.0), (-611.0, 777.0)])
def test_a_shifted_pose_gives_its_shift_back_to_a_tenth_of_a_node(
    rough_world, reference, sun, shift, matcher
):
    truth = above(rough_world, reference)
    picture = picture_of(reference, truth, sun)
    axes = reference.projection.body_from_local
    stated = Pose(truth.position_m + axes[:, :2] @ np.array(shift), truth.camera_from_body)
    found = search(reference, picture, stated, sun, matcher=matcher)
    assert not found.reason
    true_pixel, _ = predict(CAMERA, truth, reference.point.xyz_m[None])
    assert np.abs(found.pixel - true_pixel[0]).max() < 0.1
    # a camera stated too far east expects the point too far west in the picture: it is found east
    assert np.abs(found.offset_m - np.array(shift)).max() < 0.1 * 120.0 + 0.01 * np.hypot(*shift)
    assert found.score > 0.9
    assert np.linalg.eigvalsh(found.covariance_px2).min() > 0.0


def test_albedo_that_follows_relief_moves_no_point(rough_world, reference, monkeypatch):
    """Under a high Sun bright crests would move it away from the Sun by 10 m and more."""
    # the ground of the patterns an eighth as large, since the nodes are
    for name in ("SMOOTH_M", "CRESTS_OVER_M"):
        monkeypatch.setattr(relief_albedo, name, 0.125 * getattr(relief_albedo, name))
    truth, high = above(rough_world, reference), rough_world.sun(60.0, 90.0)
    picture = picture_of(reference, truth, high, strengths=(1.0, -1.0))
    # nodes of 118 m are finer than what was measured
    plain = search(reference, picture, truth, high, gates=MatchGates(0.2, 0.9))
    monkeypatch.setattr(point_match, "MIN_FINEST_ALBEDO_POSTING_M", 100.0)
    found = search(reference, picture, truth, high, gates=MatchGates(0.2, 0.9))
    # of coarser levels more is asked
    coarser = search(reference, picture, truth, high, level=1, template_nodes=32, search_nodes=6)
    assert not coarser.reason
    assert coarser.albedo is None
    assert plain.albedo is None
    assert plain.with_albedo(load_shipped_strengths()) is plain
    assert plain.offset_m[0] < -10.0
    assert found.offset_m[0] == plain.offset_m[0]
    assert found.albedo.laid.explained > 0.1
    moved = found.with_albedo(load_shipped_strengths())
    assert moved.under_albedo
    assert abs(moved.offset_m[0]) < 0.5 * abs(plain.offset_m[0])


def test_the_night_side_is_refused_before_any_search(rough_world, reference, sun):
    pose = above(rough_world, reference)
    found = search(reference, np.zeros((300, 300), np.float32), pose, -sun)
    assert found.reason.text == "in shadow"
    assert found.pixel is None


def test_a_point_outside_the_frame_is_refused(rough_world, reference, sun):
    pose = above(rough_world, reference)
    away = Pose(pose.position_m, Rotation.from_rotvec([0.0, 0.25, 0.0]) * pose.camera_from_body)
    found = search(reference, np.ones((300, 300), np.float32), away, sun)
    assert found.reason.text == "outside the frame"
    assert found.score is None


@pytest.mark.parametrize("level", [0.0, 128.0, 255.0])
def test_a_picture_without_content_is_no_match(rough_world, reference, sun, level):
    pose = above(rough_world, reference)
    assert search(reference, np.full((300, 300), level, np.float32), pose, sun).reason


def test_pure_noise_is_no_match(rough_world, reference, sun):
    pose = above(rough_world, reference)
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(100.0, 30.0, (300, 300)).astype(np.float32)
        found = search(reference, noise, pose, sun, gates=MatchGates(0.3, 0.9))
        assert found.reason.code in (ReasonCode.LOW_SCORE, ReasonCode.SEARCH_BORDER)
        assert found.score < 0.2


def test_the_same_ground_twice_in_the_picture_is_a_rival(rough_world, reference, sun):
    pose = above(rough_world, reference)
    picture = picture_of(reference, pose, sun)
    tile = picture[125:175, 125:175]
    found = search(reference, np.tile(tile, (6, 6)), pose, sun, template_nodes=32, search_nodes=32)
    assert found.reason.code == ReasonCode.RIVAL


def test_a_place_at_the_border_of_the_search_is_refused(rough_world, reference, sun):
    truth = above(rough_world, reference)
    picture = picture_of(reference, truth, sun)
    axes = reference.projection.body_from_local
    stated = Pose(truth.position_m + axes[:, 0] * 120.0 * 4.0, truth.camera_from_body)
    found = search(reference, picture, stated, sun, search_nodes=4)
    assert found.reason.text == "peak at the border of the search"
    assert found.covariance_px2 is None


def test_holes_without_terrain_are_no_reference(rough_world, reference, sun):
    empty = tuple(Patch(p.posting_m, np.full_like(p.heights_m, np.nan)) for p in reference.patches)
    bare = replace(reference, patches=empty)
    picture = np.ones((300, 300), np.float32)
    found = search(bare, picture, above(rough_world, reference), sun)
    assert found.reason.text == "no terrain data"


@pytest.mark.parametrize("roll_deg", [-3.0, 3.0])
def test_a_roll_of_three_degrees_is_found_by_trying_rolls(rough_world, reference, sun, roll_deg):
    truth = above(rough_world, reference, roll=np.radians(roll_deg))
    picture = picture_of(reference, truth, sun)
    stated = above(rough_world, reference)
    straight = search(reference, picture, stated, sun)
    rolls = tuple(np.radians([-4.0, -2.0, 0.0, 2.0, 4.0]))
    turned = search(reference, picture, stated, sun, distortion=Distortion(rolls, (1.0,)))
    assert not turned.reason
    assert turned.score > straight.score + 0.1
    true_pixel, _ = predict(CAMERA, truth, reference.point.xyz_m[None])
    assert np.abs(turned.pixel - true_pixel[0]).max() < 0.5


def test_mean_pixels_of_blocks_are_those_of_their_known_nodes():
    pixels = np.random.default_rng(3).normal(size=(20, 20, 2))
    pixels[4:9, 6] = np.nan
    top, left = np.array([0, 3, 8]), np.array([8, 4, 0])
    wanted = [
        np.nanmean(pixels[r : r + 12, c : c + 12], axis=(0, 1))
        for r, c in zip(top, left, strict=True)
    ]
    np.testing.assert_allclose(
        point_match._average_blocks(pixels, top, left, 12), wanted, atol=1e-12
    )
