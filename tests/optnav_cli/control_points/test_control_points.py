"""Navigation on pictures of ground that is richer than the control points know.

The truth must lie inside the stated covariance; and whatever is no picture of this ground, under
this Sun, from near the prior, must never be solved.
"""

import re
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from catalog.correlation.ncc import match_ncc
from catalog.correlation.peak import Match
from catalog.correlation.surf64 import match_surf
from catalog.errors import DataError
from catalog.terrain.error_model import TerrainErrorModel
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points import method, point_match
from optnav_cli.control_points import solve as solve_module
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.method import navigate
from optnav_cli.control_points.settings import MatchSettings, NavigateSettings, SolveSettings
from optnav_cli.control_points.solve import FEW
from optnav_cli.estimation.models.points import Pose
from optnav_cli.fix import PositionPrior, UnsolvedFrameError
from optnav_cli.frames.folder import Observation
from optnav_cli.frames.picture import Picture
from optnav_cli.reasons import ReasonCode

SETTINGS = NavigateSettings(
    match=MatchSettings(template_nodes=48), solve=SolveSettings(free_attitude_deg=0.2)
)
ARCSEC = np.pi / 648000.0
SUN = (30.0, 65.0)
PRIOR_SIGMA_M = 1000.0


@pytest.fixture(scope="session")
def scene(rough_world):
    """A picture with its true pose and Sun."""
    pose = rough_world.pose(100e3, roll=0.3, tilt=(0.01, -0.008))
    sun = rough_world.sun(*SUN)
    return rough_world.picture(pose, sun, noise_seed=4), pose, sun


def solve(world, field, picture, pose, sun, *, seed=1, sigma=0.0, attitude=None, **changes):
    """Navigate from a prior that is off by its sigma."""
    rng = np.random.default_rng(seed)
    position = pose.position_m + rng.normal(0.0, PRIOR_SIGMA_M, 3)
    prior = PositionPrior.isotropic(position, PRIOR_SIGMA_M, "test")
    options = {"camera": world.camera, "settings": SETTINGS, "matcher": match_ncc} | changes
    observation = Observation(
        "a.png",
        "",
        0.0,
        options["camera"],
        Picture(picture, 255.0),
        attitude or pose.camera_from_body,
        sigma,
        sun,
    )
    return navigate(observation, prior, field, options["settings"], options["matcher"])


def seen_by(world, camera):
    """The same ground, seen by another camera."""
    other = copy(world)
    other.camera = camera
    return other


@pytest.mark.parametrize(
    "lens",
    [
        {"height_px": 304, "principal_point_px": (255.5, 151.5), "focal_length_y_px": 593.0},
        {
            "distortion": "opencv",
            "coefficients": (-0.3, 0.2, 0.002, -0.003, 0.1, 0.05, -0.02, 0.01, 0.004, 0.0, -0.003,
                             0.001, 0.03, -0.02),
        },
    ],
    ids=["oblong", "opencv"],
)  # fmt: skip
def test_oblong_pixels_and_every_distortion_give_honest_fixes(rough_world, field_of, lens):
    """The attitude is exact; the truth lies inside four sigmas, as with square pixels."""
    camera = replace(rough_world.camera, **lens)
    world, sun = seen_by(rough_world, camera), rough_world.sun(*SUN)
    pose = world.pose(100e3, roll=0.3, tilt=(0.01, -0.008))
    picture = world.picture(pose, sun, noise_seed=4)
    fix = solve(world, field_of(rough_world), picture, pose, sun)
    assert mahalanobis(fix, pose) < 4.0
    assert np.linalg.norm(fix.position_m - pose.position_m) < 30.0
    assert sum(point.used for point in fix.evidence.matches) >= 10


def test_a_boresight_error_lies_inside_the_covariance_that_states_it(rough_world, field_of, scene):
    """120" at 100 km are 58 m, many times what the fix without them states."""
    picture, pose, sun = scene
    sigma = 120.0 * ARCSEC
    wrong = turned(pose, np.degrees([1.5 * sigma, -1.0 * sigma, 0.0]))
    fix = solve(rough_world, field_of(rough_world), picture, pose, sun, sigma=sigma, attitude=wrong)
    assert mahalanobis(fix, pose) < 4.0
    exact = solve(rough_world, field_of(rough_world), picture, pose, sun)
    assert np.trace(fix.covariance_m2) > 4.0 * np.trace(exact.covariance_m2)


def turned(pose, degrees):
    """The attitude of a pose after a rotation vector in camera axes."""
    return Rotation.from_rotvec(np.radians(degrees)) * pose.camera_from_body


def mahalanobis(fix, truth):
    error = fix.position_m - truth.position_m
    return float(np.sqrt(error @ np.linalg.solve(fix.covariance_m2, error)))


@pytest.mark.parametrize("matcher", [match_ncc, match_surf])
def test_with_an_exact_attitude_the_truth_lies_inside_four_sigma(
    rough_world, field_of, scene, matcher
):
    picture, pose, sun = scene
    fix = solve(rough_world, field_of(rough_world), picture, pose, sun, matcher=matcher)
    assert mahalanobis(fix, pose) < 4.0
    assert np.linalg.norm(fix.position_m - pose.position_m) < 30.0
    used = [point for point in fix.evidence.matches if point.used]
    assert len(used) >= 0.9 * len(fix.evidence.matches) >= 12
    assert np.sqrt(np.mean([point.residual_px**2 for point in used])) < 0.15


@pytest.mark.parametrize(
    ("hidden_cols", "first_tried"),
    [(0, FEW), (170, SETTINGS.solve.max_first_pass_points)],
    ids=["they agree", "too few are found"],
)
def test_some_points_lead_to_the_finest_levels_where_they_agree(
    rough_world, field_of, scene, monkeypatch, hidden_cols, first_tried
):
    """Otherwise all are searched, none of them twice; and the last pass has all either way."""
    picture, pose, sun = scene
    searches, searched = [], []
    plan_search, match_point = method.plan_search, solve_module.match_point

    def noted(*of):
        searches.append([])
        return plan_search(*of)

    def counted(reference, *of):
        searches[-1].append(reference.point.id)
        return match_point(reference, *of)

    def passed(*of):
        searched.append(search(*of))
        return searched[-1]

    search = method._search
    monkeypatch.setattr(method, "plan_search", noted)
    monkeypatch.setattr(solve_module, "match_point", counted)
    monkeypatch.setattr(method, "_search", passed)
    picture = picture.copy()
    picture[:, :hidden_cols] = np.nan
    fix = solve(rough_world, field_of(rough_world), picture, pose, sun)
    assert len(searches[0]) == len(set(searches[0])) == len(searched[0].view) == first_tried
    assert not searched[0].at_finest
    assert (
        len(searched[-1].view) == len(fix.evidence.matches) > SETTINGS.solve.max_first_pass_points
    )
    assert mahalanobis(fix, pose) < 4.0


@pytest.mark.parametrize(
    ("passes", "settled"),
    [
        (((9.0, 0.01, True),), False),  # of some of the points only
        (((9.0, 2.0, False), (3.0, 0.04, True)), True),
        (((9.0, 2.0, False), (3.0, 0.06, True)), False),
        (((9.0, 2.0, False), (3.0, 0.04, False)), False),
        (((9.0, 2.0, True), (0.9, 0.06, True)), True),
    ],
)
def test_no_pass_repeats_what_the_one_before_saw(passes, settled):
    """Passes by how far they moved the pose, sigmas and nodes, and whether at the finest levels."""
    none = None, [], None, method.NO_POINTS
    assert method._is_settled([method._Pass(*none, *one, 0.0) for one in passes]) == settled


def test_the_stated_error_of_the_terrain_model_widens_the_sigmas(rough_world, field_of, scene):
    picture, pose, sun = scene
    sigmas = []
    for stated in (None, (0.01, 0.2), (28.0, 1.6)):
        field = field_of(rough_world)
        if stated is not None:
            error = TerrainErrorModel(*stated, 2.0, "test")
            layers = [replace(layer, errors=(error,) * len(layer.ids)) for layer in field.layers]
            field = ControlPointField(layers)
        fix = solve(rough_world, field, picture, pose, sun)
        sigmas.append(np.sqrt(np.trace(fix.covariance_m2)))
    assert sigmas[1] < 0.9 * sigmas[0]  # a model of which nothing is stated may be wrong
    # templates of 5.7 km err by 150 m an axis, a fourth of it added; 12 and more are averaged
    assert 15.0 < sigmas[2] < 300.0


class WrongFinest:
    """A store of points whose finest level has relief that is none."""

    def __init__(self, store):
        self.store, self.point = store, store.point

    def patches(self, point_id):
        finest, *others = self.store.patches(point_id)
        noise = np.random.default_rng(point_id).normal(size=finest.heights_m.shape)
        relief = gaussian_filter(noise, 1.0)
        wrong = finest.heights_m + 25.0 * (relief / relief.std()).astype(np.float32)
        return replace(finest, heights_m=wrong), *others


def test_a_terrain_model_that_is_wrong_in_detail_is_matched_at_coarser_levels(
    rough_world, field_of, scene
):
    picture, pose, sun = scene
    right = field_of(rough_world)
    wrong = ControlPointField([replace(x, store=WrongFinest(x.store)) for x in right.layers])
    levels = []
    for field in (right, wrong):
        fix = solve(rough_world, field, picture, pose, sun)
        assert mahalanobis(fix, pose) < 4.0
        levels.append([point.level for point in fix.evidence.matches if point.used])
    assert max(levels[0]) == 0
    assert np.mean(np.array(levels[1]) > 0) > 0.5


def test_with_ten_arc_seconds_of_attitude_noise_the_truth_lies_inside_four_sigma(
    rough_world, field_of, scene
):
    picture, pose, sun = scene
    field = field_of(rough_world)
    for seed in range(4):
        turn = np.random.default_rng(seed).normal(0.0, 10.0 * ARCSEC, 3)
        attitude = Rotation.from_rotvec(turn) * pose.camera_from_body
        fix = solve(
            rough_world, field, picture, pose, sun, seed=seed, sigma=10 * ARCSEC, attitude=attitude
        )
        assert mahalanobis(fix, pose) < 4.0
        stated = np.sqrt(np.trace(fix.covariance_m2))
        # 10" at 100 km are 4.8 m across on each of two axes
        assert 6.0 < stated < 60.0


def test_a_poorly_known_roll_does_not_break_the_consensus(rough_world, field_of, scene):
    """0.3 degrees of roll move the picture's rim by 1.9 px: far beyond a match's own error."""
    picture, pose, sun = scene
    attitude = turned(pose, [0.02, -0.03, 0.3])
    field, sigma = field_of(rough_world), np.radians(0.2)
    fix = solve(rough_world, field, picture, pose, sun, sigma=sigma, attitude=attitude)
    assert mahalanobis(fix, pose) < 4.0
    assert sum(point.used for point in fix.evidence.matches) >= 0.9 * len(fix.evidence.matches)


def test_with_a_free_attitude_position_and_attitude_are_found(rough_world, field_of, scene):
    picture, pose, sun = scene
    attitude, field = turned(pose, [0.15, -0.2, 0.2]), field_of(rough_world)
    fix = solve(rough_world, field, picture, pose, sun, sigma=None, attitude=attitude)
    assert mahalanobis(fix, pose) < 4.0
    off = (fix.camera_from_body * pose.camera_from_body.inv()).magnitude()
    assert off < 4.0 * np.sqrt(3.0) * fix.attitude_sigma_rad
    assert off < np.radians(0.1)


def test_two_points_are_enough_when_the_attitude_is_known(rough_world, field_of, scene):
    picture, pose, sun = scene
    every = solve(rough_world, field_of(rough_world), picture, pose, sun)
    ids = [point.cp_id for point in every.evidence.matches if point.used]
    pair = {ids[0], ids[-1]}
    field = field_of(rough_world)
    places = [k for k in range(len(field)) if field.name(k)[1] in pair]
    few = field_of(rough_world, slice(places[0], places[1] + 1, places[1] - places[0]))
    assert len(few) == 2
    fix = solve(rough_world, few, picture, pose, sun)
    assert sum(point.used for point in fix.evidence.matches) == 2
    assert mahalanobis(fix, pose) < 4.0


@pytest.mark.parametrize("first_px", [160, 208])
def test_a_frame_with_fewer_than_two_whole_templates_is_solved_by_parts(
    rough_world, field_of, scene, first_px
):
    """128 px hold one template of 58 px whole, or none, and most of three or four."""
    picture, pose, sun = scene
    cut, centre = slice(first_px, first_px + 128), 255.5 - first_px
    camera = replace(
        rough_world.camera, width_px=128, height_px=128, principal_point_px=(centre, centre)
    )
    fix = solve(rough_world, field_of(rough_world), picture[cut, cut], pose, sun, camera=camera)
    assert mahalanobis(fix, pose) < 4.0


def reason(*arguments, **options):
    with pytest.raises(UnsolvedFrameError) as caught:
        solve(*arguments, **options)
    assert not any(point.used for point in caught.value.evidence.matches)
    return str(caught.value)


def test_one_point_is_no_position(rough_world, field_of, scene):
    picture, pose, sun = scene
    middle = len(rough_world.control_points) // 2
    few = field_of(rough_world, slice(middle, middle + 1))
    assert "are needed" in reason(rough_world, few, picture, pose, sun)


def test_three_points_are_no_position_when_the_attitude_is_free(rough_world, field_of, scene):
    picture, pose, sun = scene
    middle = len(rough_world.control_points) // 2
    few = field_of(rough_world, slice(middle - 1, middle + 2))
    assert reason(rough_world, few, picture, pose, sun, sigma=None)


def test_a_prior_on_the_far_side_sees_no_point(rough_world, field_of, scene):
    picture, pose, sun = scene
    behind = Pose(-pose.position_m, pose.camera_from_body)
    assert "no control point" in reason(rough_world, field_of(rough_world), picture, behind, sun)


def test_a_prior_inside_the_body_is_named(rough_world, field_of, scene):
    picture, pose, sun = scene
    inside = Pose(pose.position_m * 0.9, pose.camera_from_body)
    said = reason(rough_world, field_of(rough_world), picture, inside, sun)
    assert said == "the prior position is inside the body"


@pytest.mark.parametrize("elevation_deg", [-20.0, 1.0, 80.0])
def test_a_sun_too_low_or_too_high_is_named(rough_world, field_of, scene, elevation_deg):
    picture, pose, _ = scene
    sun = rough_world.sun(elevation_deg, 65.0)
    said = reason(rough_world, field_of(rough_world), picture, pose, sun)
    assert "lit well: Sun elevation" in said
    assert "wanted 5.0 to 60.0" in said


def test_a_damaged_point_is_left_out_and_remembered(rough_world, field_of, scene):
    picture, pose, sun = scene
    field = field_of(rough_world)
    store = field.layers[0].store
    whole = store.patches
    _, bad = field.name(len(field) // 2)

    def patches(cp_id):
        if cp_id == bad:
            raise DataError("a checksum is wrong")
        return whole(cp_id)

    store.patches = patches
    fix = solve(rough_world, field, picture, pose, sun)
    assert field.damaged == {("world.gpkg", bad): "a checksum is wrong"}
    (row,) = [point for point in fix.evidence.matches if point.cp_id == bad]
    assert not row.used
    assert "damaged" in row.reason
    assert mahalanobis(fix, pose) < 4.0


@pytest.mark.parametrize("sigma", [0.0, 10.0 * ARCSEC, None])
def test_pure_noise_is_never_solved(rough_world, field_of, scene, sigma):
    _, pose, sun = scene
    field = field_of(rough_world)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        noise = gaussian_filter(rng.normal(size=(512, 512)), (0.0, 1.0, 2.5, 6.0)[seed % 4])
        picture = np.clip(128.0 + 40.0 * noise / noise.std(), 0.0, 255.0).astype(np.float32)
        reason(rough_world, field, picture, pose, sun, seed=seed, sigma=sigma)


@pytest.mark.parametrize(("sigma", "nodes"), [(0.0, 48), (None, 24)])
def test_a_picture_of_other_ground_is_never_solved(
    rough_world, other_world, field_of, scene, sigma, nodes
):
    """Ground of the same kind, the same light: small templates find dozens of false matches."""
    _, pose, sun = scene
    other = other_world.picture(pose, sun)
    field = field_of(rough_world)
    settings = NavigateSettings(match=MatchSettings(template_nodes=nodes), solve=SETTINGS.solve)
    for seed in range(10):
        # a shift round the frame makes other ground of each picture
        picture = np.roll(other, (51 * seed, 37 * seed), axis=(0, 1))
        reason(rough_world, field, picture, pose, sun, seed=seed, sigma=sigma, settings=settings)


WRONGS = {
    "mirrored": lambda picture: picture[:, ::-1],
    "upside down": lambda picture: picture[::-1],
    "turned by 180 degrees": lambda picture: picture[::-1, ::-1],
    "turned by 90 degrees": lambda picture: np.rot90(picture),
    "a negative": lambda picture: 255.0 - picture,
    "a repeated tile": lambda picture: np.tile(picture[200:264, 200:264], (8, 8)),
}


@pytest.mark.parametrize("wrong", list(WRONGS))
@pytest.mark.parametrize("sigma", [0.0, None])
def test_a_picture_changed_beyond_its_pose_is_never_solved(
    rough_world, field_of, scene, wrong, sigma
):
    picture, pose, sun = scene
    changed = np.ascontiguousarray(WRONGS[wrong](picture), dtype=np.float32)
    reason(rough_world, field_of(rough_world), changed, pose, sun, sigma=sigma)


@pytest.mark.parametrize("turn_deg", [90.0, 180.0, 270.0])
def test_a_sun_from_the_wrong_side_is_never_solved(rough_world, field_of, scene, turn_deg):
    picture, pose, _ = scene
    sun = rough_world.sun(SUN[0], SUN[1] + turn_deg)
    reason(rough_world, field_of(rough_world), picture, pose, sun)


def in_place(template, window, margin_nodes=0):
    """Finds every template in the middle, and not well."""
    return Match(0.0, 0.0, 0.4, -1.0, np.eye(2) * 1e-2)


@pytest.mark.parametrize(
    ("elevation_deg", "turn_deg"),
    [(8.0, 0.0), (55.0, 0.0), (8.0, 150.0), (30.0, 90.0), (30.0, 180.0), (55.0, -100.0)],
)
def test_weak_matches_that_agree_are_refused_under_a_wrong_sun_alone(
    rough_world, field_of, elevation_deg, turn_deg, monkeypatch
):
    """They are where they were found, in a noisy picture: nothing but the light can be wrong."""
    monkeypatch.setattr(point_match, "add_remainder_covariance", lambda match, *_: match)
    pose = rough_world.pose(100e3, roll=0.3, tilt=(0.01, -0.008))
    picture = rough_world.picture(pose, rough_world.sun(elevation_deg, 65.0), snr=5.0)
    prior = PositionPrior.isotropic(pose.position_m, 100.0, "test")
    stated = rough_world.sun(elevation_deg, 65.0 + turn_deg)
    seen = Observation("a.png", "", 0.0, rough_world.camera, Picture(picture, 255.0),
                       pose.camera_from_body, 0.0, stated)  # fmt: skip
    field = field_of(rough_world)
    if turn_deg == 0.0:
        navigate(seen, prior, field, SETTINGS, in_place)
        return
    with pytest.raises(UnsolvedFrameError, match="is lit from about") as caught:
        navigate(seen, prior, field, SETTINGS, in_place)
    assert caught.value.code == ReasonCode.WRONG_SUN
    degrees, way = re.search(r"about (\d+) deg (counter-)?clockwise", str(caught.value)).groups()
    found = float(degrees) if way else -float(degrees)  # azimuths count clockwise
    assert abs((found - turn_deg + 180.0) % 360.0 - 180.0) < 15.0


def test_a_focal_length_that_is_wrong_by_a_tenth_is_refused_by_the_prior(
    rough_world, field_of, scene
):
    """The picture fits a camera 10 km higher as well: only the prior knows better."""
    picture, pose, sun = scene
    camera = Camera("cam", "pinhole", 512, 512, 1100.0, (255.5, 255.5))
    for sigma in (0.0, None):
        said = reason(
            rough_world, field_of(rough_world), picture, pose, sun, sigma=sigma, camera=camera
        )
        assert said
