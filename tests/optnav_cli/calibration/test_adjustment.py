"""Frames adjusted together: against scipy, against their own statistics, and what is not seen."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.calibration.adjustment import AdjustedFrame, adjust, estimate_shared_errors
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.common import Common, CommonState, common_numbers
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.estimation.resection import resect_robustly

RADIUS_M = 1650.0
CAMERA = Camera("narrow", "pinhole", 512, 512, 5863.0, (255.5, 255.5))
WIDE = Camera("wide", "pinhole", 512, 512, 300.0, (255.5, 255.5))
SIGMA_PX, POSITION_M, ATTITUDE = 0.4, 300.0, 200.0 * ARCSEC
# rotation rad, origin m, scale, boresight rad
TRUTH = np.array([3e-4, 0.011, 1e-3, 60.0, 49.0, 18.0, 0.0056, 1e-4, -1.4e-4])
ALL_BUT_FOCAL = (Common.BODY_ROTATION, Common.ORIGIN, Common.SCALE, Common.BORESIGHT)


def looking_at(position_m: np.ndarray) -> Rotation:
    z = -position_m / np.linalg.norm(position_m)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.stack([x, np.cross(z, x), z]))


def simulated(
    rng: np.random.Generator,
    *,
    frames: int,
    points: int = 12,
    kinds: tuple[Common, ...] = ALL_BUT_FOCAL,
    values: np.ndarray = TRUTH,
    camera: Camera = CAMERA,
    distance_m: float = 9e4,
    point_error_m: float = 0.0,
    shared_m: float = 0.0,
    stated: tuple[float, float] = (POSITION_M, ATTITUDE),
) -> tuple[list[AdjustedFrame], list[Pose], CommonState]:
    """Frames about a body with stated poses, their true poses and what is common."""
    numbers = common_numbers(kinds, [camera.name], RADIUS_M)
    common = CommonState(numbers, values)
    ground = rng.normal(size=(60, 3))
    ground *= RADIUS_M / np.linalg.norm(ground, axis=1, keepdims=True)
    moved = ground + rng.normal(0.0, point_error_m, ground.shape)
    made, truths = [], []
    all_alike = rng.normal()
    position_sigma_m, attitude_sigma = stated
    for number in range(frames):
        angle = 2.0 * np.pi * number / frames
        place = distance_m * np.array([np.cos(angle), np.sin(angle), 0.4 * np.cos(3.0 * angle)])
        turn = Rotation.from_euler("z", rng.uniform(0.0, 6.0)) * looking_at(place)
        true = Pose(place, Rotation.from_rotvec(rng.normal(0.0, attitude_sigma, 3)) * turn)
        # stated = inverse boresight * true, with the error on the stated side
        said = common.boresight(camera.name).inv() * turn
        seen = np.argsort(-(ground @ place))[:points]
        alike = rng.normal(0.0, shared_m, 3) * np.sqrt(0.5)
        alike += all_alike * shared_m * np.sqrt(0.5) * place / np.linalg.norm(place)
        looks = Pose(place + alike, true.camera_from_body)
        pixels, _ = predict(common.lens(camera), looks, common.places_m(moved[seen]))
        pixels = pixels + rng.normal(0.0, SIGMA_PX, pixels.shape)
        covariances = np.tile(np.eye(2) * SIGMA_PX**2, (points, 1, 1))
        sightings = Sightings(ground[seen], pixels, covariances)
        position = place + rng.normal(0.0, position_sigma_m, 3)
        start = Pose(position, said)
        made.append(
            AdjustedFrame(
                camera, sightings, seen, start, position, position_sigma_m, said,
                attitude_sigma, np.eye(3) * shared_m**2,
            )
        )  # fmt: skip
        truths.append(true)
    return made, truths, common


def test_the_small_case_is_scipys() -> None:
    frames, _, common = simulated(np.random.default_rng(3), frames=3, points=7)
    found = adjust(frames, common.numbers)
    sigmas = np.array([n.prior_sigma for n in common.numbers])

    def residuals(state: np.ndarray) -> np.ndarray:
        trial = CommonState(common.numbers, state[:9])
        parts = [state[:9] / sigmas]
        for number, frame in enumerate(frames):
            pose = frame.start.moved(state[9 + 6 * number : 15 + 6 * number])
            places = trial.places_m(frame.sightings.points_body_m)
            pixels, _ = predict(frame.camera, pose, places)
            off = frame.sightings.pixels - pixels
            root = np.sqrt(found.frames[number].weights)[:, None]
            parts.append((off * root / SIGMA_PX).ravel())
            parts.append((frame.position_m - pose.position_m) / POSITION_M)
            stated = trial.boresight("narrow") * frame.attitude
            parts.append((stated * pose.camera_from_body.inv()).as_rotvec() / ATTITUDE)
        return np.concatenate(parts)

    scale = np.concatenate([sigmas * 1e-2, *[[100.0] * 3 + [1e-3] * 3] * 3])
    theirs = least_squares(residuals, np.zeros(27), x_scale=scale, xtol=1e-14, ftol=1e-14)
    covariance = np.linalg.inv(theirs.jac.T @ theirs.jac)
    expected = np.sqrt(np.diag(covariance))
    # theirs has no sandwich for points that several frames see
    assert found.point_excess < 1.6
    assert (np.abs(found.common.values - theirs.x[:9]) < 0.02 * expected[:9]).all()
    np.testing.assert_allclose(found.sigmas, expected[:9], rtol=0.15)
    for number, result in enumerate(found.frames):
        pose = frames[number].start.moved(theirs.x[9 + 6 * number : 15 + 6 * number])
        off = result.pose.position_m - pose.position_m
        assert np.linalg.norm(off) < 0.02 * expected[9 + 6 * number]


@pytest.mark.parametrize(("point_error_m", "shared_m"), [(0.0, 0.0), (12.0, 0.0), (0.0, 200.0)])
def test_the_stated_covariances_are_those_of_the_errors(
    point_error_m: float, shared_m: float
) -> None:
    """12 m of each control point, 0.8 px here, are the same in all frames that see it.

    200 m are what the matches of a frame share: it looks as if the camera stood elsewhere, half of
    the variance in all frames alike.
    """
    rng = np.random.default_rng(11)
    common_nees, pose_nees = [], []
    for _ in range(20):
        frames, truths, common = simulated(
            rng, frames=14, point_error_m=point_error_m, shared_m=shared_m
        )
        if point_error_m:  # as a run states it
            variance = SIGMA_PX**2 + (point_error_m * 5863.0 / 9e4) ** 2
            tiles = np.tile(np.eye(2) * variance, (12, 1, 1))
            frames = [
                replace(f, sightings=replace(f.sightings, covariances_px2=tiles)) for f in frames
            ]
        found = adjust(frames, common.numbers)
        off = found.common.values - TRUTH
        common_nees.append(off @ np.linalg.solve(found.covariance, off) / len(off))
        for result, true in zip(found.frames, truths, strict=True):
            turn = (true.camera_from_body * result.pose.camera_from_body.inv()).as_rotvec()
            both = np.concatenate([true.position_m - result.pose.position_m, turn])
            pose_nees.append(both @ np.linalg.solve(result.covariance, both) / 6.0)
    assert 0.7 < np.mean(common_nees) < 1.4
    assert 0.7 < np.mean(pose_nees) < 1.4


def test_wrong_matches_are_weighted_out() -> None:
    frames, _, common = simulated(np.random.default_rng(5), frames=10)
    frames[3].sightings.pixels[2] += [9.0, -14.0]
    found = adjust(frames, common.numbers)
    assert found.frames[3].weights[2] == 0.0
    assert np.mean([frame.weights.mean() for frame in found.frames]) > 0.85
    assert (np.abs(found.common.values - TRUTH) < 4.0 * found.sigmas).all()


def test_a_focal_length_and_a_scale_are_not_told_apart_from_afar() -> None:
    kinds = (Common.SCALE, Common.FOCAL)
    frames, _, common = simulated(
        np.random.default_rng(7), frames=10, kinds=kinds, values=np.array([0.005, -0.003])
    )
    frames = [replace(frame, position_m=None, position_sigma_m=None) for frame in frames]
    found = adjust(frames, common.numbers)
    assert found.find_inseparable()
    assert {name for names in found.find_inseparable() for name in names} == {
        "the scale",
        "the focal length of narrow",
    }
    # with positions their product is known, and still neither of them
    frames, _, _ = simulated(
        np.random.default_rng(7), frames=10, kinds=kinds, values=np.array([0.005, -0.003])
    )
    found = adjust(frames, common.numbers)
    assert found.find_inseparable() == [("the scale", "the focal length of narrow")]
    product = found.common.values.sum()
    assert abs(product - 0.002) < 4.0 * np.sqrt(found.covariance.sum()) < 0.008


def test_a_wide_camera_near_by_tells_focal_length_from_scale() -> None:
    kinds = (Common.SCALE, Common.FOCAL)
    values = np.array([0.005, -0.003])
    frames, _, common = simulated(
        np.random.default_rng(8),
        frames=20,
        points=20,
        kinds=kinds,
        values=values,
        camera=WIDE,
        distance_m=4e3,
    )
    found = adjust(frames, common.numbers)
    assert found.find_inseparable() == []
    assert (np.abs(found.common.values - values) < 4.0 * found.sigmas).all()


def test_hundreds_of_frames_take_time_in_proportion() -> None:
    frames, _, common = simulated(np.random.default_rng(9), frames=200)
    found = adjust(frames, common.numbers)
    assert len(found.frames) == 200
    assert found.steps < 20


def test_what_a_run_states_beyond_the_scatter_stays_in_the_covariance() -> None:
    (frame, *_), _, _ = simulated(np.random.default_rng(4), frames=3, values=np.zeros(9))
    found = resect_robustly(CAMERA, frame.sightings, frame.start, ATTITUDE)
    alone = replace(frame, start=found.pose)
    own = found.position_covariance_m2 / found.variance_factor
    along = found.pose.position_m / np.linalg.norm(found.pose.position_m)
    shared = estimate_shared_errors(alone, own + 250.0**2 * np.outer(along, along))
    assert np.sqrt(along @ shared @ along) == pytest.approx(250.0, rel=0.05)
    assert np.trace(shared) == pytest.approx(250.0**2, rel=0.1)
    # one frame with nothing else stated comes out as its run states it
    bare = replace(alone, shared_m2=shared, position_m=None)
    (result,) = adjust([bare], ()).frames
    sigma = np.sqrt(along @ result.covariance[:3, :3] @ along)
    assert sigma == pytest.approx(np.sqrt(along @ own @ along + 250.0**2), rel=0.05)


def test_a_frame_with_nothing_stated_and_two_matches_is_open() -> None:
    (frame, *_), _, common = simulated(np.random.default_rng(4), frames=3, points=2)
    bare = replace(frame, position_m=None, attitude_sigma_rad=None)
    with pytest.raises(NoSolutionError, match="open"):
        adjust([bare], common.numbers)
