"""A camera's numbers by the frames of a route: derivatives, dense normals, what is tied."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from catalog.errors import NothingToDoError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.calibration import adjustment
from optnav_cli.calibration.adjustment import AdjustedFrame, adjust, compute_residuals
from optnav_cli.calibration.job import check_points
from optnav_cli.calibration.model import (
    CalibrateSettings,
    estimate_frame_motions,
    find_inseparable,
    find_tied_pairs,
)
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml, load_camera
from optnav_cli.estimation.models.common import Common, CommonState
from tests.studies.calibration_routes import KINDS, OFF, Route, simulated_route

UNK = Camera("unk", "pinhole", 2048, 2048, 4183.87, (1023.5, 1023.5))
FISHEYE = Camera("round", "equidistant", 1024, 1024, 420.0, (511.5, 511.5))
SHORT = Route(UNK, frames=24, heights_km=(100.0, 300.0), rolled=True, points=40, spacing_s=10.0)
STEPS = {
    Common.FOCAL: 1e-6,
    Common.CENTRE: 1e-3,
    Common.DISTORTION: 1e-6,
    Common.MOUNTING: 1e-7,
    Common.CLOCK: 1e-4,
}


@pytest.mark.parametrize("camera", [UNK, FISHEYE], ids=["pinhole", "fisheye"])
def test_changes_of_pixels_with_the_lens_are_those_of_differences(camera: Camera) -> None:
    frames, truth = simulated_route(replace(SHORT, camera=camera, frames=6), 3)
    frame = frames[2]
    _, by_common, _ = adjustment._compute_jacobians(frame, frame.start, truth)
    for k, number in enumerate(truth.numbers):
        step = np.zeros(len(truth.numbers))
        step[k] = STEPS[number.kind]
        ends = [
            compute_residuals(
                frame, frame.start, CommonState(truth.numbers, truth.values + sign * step)
            )
            for sign in (1.0, -1.0)
        ]
        slope = -(ends[0] - ends[1]) / (2.0 * step[k])
        np.testing.assert_allclose(by_common[:, :, k], slope, rtol=1e-4, atol=1e-4)


def test_changes_of_statements_with_mounting_and_clock_are_those_of_differences() -> None:
    frames, truth = simulated_route(SHORT, 4)
    frame = frames[5]
    rows = adjustment._linearise_statements(frame, frame.start, truth)
    for k, number in enumerate(truth.numbers):
        step = np.zeros(len(truth.numbers))
        step[k] = STEPS[number.kind]
        for place, (_, columns, _, _) in enumerate(rows):
            ends = [
                adjustment._linearise_statements(
                    frame, frame.start, CommonState(truth.numbers, truth.values + sign * step)
                )[place][2]
                for sign in (1.0, -1.0)
            ]
            slope = -(ends[0] - ends[1]) / (2.0 * step[k])
            np.testing.assert_allclose(columns[:, k], slope, rtol=2e-3, atol=1e-4)


def test_frames_eliminated_one_by_one_give_the_covariance_of_all_at_once() -> None:
    # frames far apart: no point is seen twice, and nothing but the blocks makes the covariance
    frames, truth = simulated_route(replace(SHORT, frames=6, spacing_s=100.0, points=20), 5)
    found = adjust(frames, truth.numbers, by_direction=True)
    count, size = len(truth.numbers), len(truth.numbers) + 6 * len(frames)
    normal = np.zeros((size, size))
    normal[:count, :count] = np.diag([n.prior_sigma**-2 for n in truth.numbers])
    for place, (frame, result) in enumerate(zip(frames, found.frames, strict=True)):
        own = np.r_[np.arange(count), count + 6 * place + np.arange(6)]
        by_pose, by_common, _ = adjustment._compute_jacobians(frame, result.pose, found.common)
        both = np.concatenate([by_common, by_pose], axis=2)
        weighing = np.linalg.inv(frame.sightings.covariances_px2)
        weighing *= result.weights[:, None, None]
        normal[np.ix_(own, own)] += np.einsum("nia,nij,njb->ab", both, weighing, both)
        for rows, columns, _, weight in adjustment._linearise_statements(
            frame, result.pose, found.common
        ):
            both = np.concatenate([columns, rows], axis=1)
            normal[np.ix_(own, own)] += both.T @ weight @ both
    scale = 1.0 / np.sqrt(np.diag(normal))
    dense = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    assert found.point_excess == pytest.approx(1.0, abs=0.35)
    # what points share raises it, and never lowers it
    ratio = found.sigmas / np.sqrt(np.diag(dense)[:count])
    assert (ratio > 0.999).all()
    assert (ratio < 1.2).all()


def test_errors_are_as_the_covariance_says() -> None:
    squares = []
    for seed in range(4):
        frames, truth = simulated_route(replace(SHORT, lost=0.5), seed)
        found = adjust(frames, truth.numbers, by_direction=True)
        off = found.common.values - truth.values
        squares.append(off @ np.linalg.solve(found.covariance, off) / len(off))
        assert (np.abs(off) < 4.5 * found.sigmas).all()
    assert 0.5 < np.mean(squares) < 1.7


def test_one_height_and_one_roll_do_not_tell_clock_centre_and_pitch_apart() -> None:
    frames, truth = simulated_route(Route(UNK, frames=30, points=40, spacing_s=10.0), 1)
    found = adjust(frames, truth.numbers, by_direction=True)
    (direction,) = find_inseparable(truth.numbers, found.covariance)
    words = direction.describe()
    assert "the clock of unk" in words
    assert "the principal point of unk along y" in words
    assert "the mounting of unk about x" in words
    assert "turn the camera about its boresight" in words


def test_a_varied_roll_tells_them_apart_and_states_what_a_pair_does_to_a_pixel() -> None:
    frames, truth = simulated_route(replace(SHORT, heights_km=(200.0,)), 1)
    found = adjust(frames, truth.numbers, by_direction=True)
    assert find_inseparable(truth.numbers, found.covariance) == []
    pairs = find_tied_pairs(truth.numbers, found.covariance, {"unk": UNK.focal_length_px})
    assert pairs
    for pair in pairs:
        centre = truth.numbers[pair.places[0]]
        assert centre.kind == Common.CENTRE
        alone = found.sigmas[pair.places[0]]
        assert pair.moves_px is not None
        assert pair.moves_px < 0.5 * alone


def test_a_lens_that_is_changed_reads_back_from_its_file(tmp_path: Path) -> None:
    for camera in (UNK, FISHEYE):
        changed = camera.with_lens(1.003, (8.0, -8.0), 0.01)
        (tmp_path / f"{camera.name}.toml").write_text(camera_toml(changed), encoding="utf-8")
        assert load_camera(tmp_path / f"{camera.name}.toml") == changed
        assert changed.coefficients[0] == 0.01
        assert camera.with_lens(1.0, (0.0, 0.0), 0.0) == camera


def test_the_motion_of_a_circular_orbit_comes_from_three_positions() -> None:
    rate, radius = 8.2e-4, 1.9374e6
    times = np.arange(5) * 10.0
    angles = rate * times
    places = radius * np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    for motion, angle in zip(
        estimate_frame_motions(list(times), list(places)), angles, strict=True
    ):
        assert motion is not None
        true = radius * rate * np.array([-np.sin(angle), np.cos(angle), 0.0])
        assert np.linalg.norm(motion.velocity_m_s - true) < 0.1
        np.testing.assert_allclose(motion.turn_rad_s, [0.0, 0.0, rate], rtol=1e-3, atol=1e-7)


def test_frames_without_two_neighbours_have_no_motion() -> None:
    places = [np.array([2e6, 1e3 * k, 0.0]) for k in range(4)]
    assert estimate_frame_motions([0.0, 10.0, 500.0, 510.0], list(places)) == [None] * 4
    assert estimate_frame_motions([0.0, 10.0], places[:2]) == [None] * 2


def few_points(frames: list[AdjustedFrame], count: int) -> list[AdjustedFrame]:
    return [replace(f, sightings=f.sightings.subset(np.arange(count))) for f in frames]


def test_too_few_frames_or_points_are_refused_with_what_is_wanted() -> None:
    frames, _ = simulated_route(replace(SHORT, frames=6), 1)
    with pytest.raises(NothingToDoError, match="2 frames and 12 points"):
        check_points(frames[:1])
    with pytest.raises(NothingToDoError, match="with 3 points"):
        check_points(few_points(frames[:3], 1))
    check_points(frames)


def test_points_on_a_line_are_refused() -> None:
    frames, _ = simulated_route(replace(SHORT, frames=6), 1)
    flat = []
    for frame in frames:
        pixels = frame.sightings.pixels.copy()
        pixels[:, 1] = 1000.0 + 0.01 * pixels[:, 0]
        flat.append(replace(frame, sightings=replace(frame.sightings, pixels=pixels)))
    with pytest.raises(NothingToDoError, match="on a line"):
        check_points(flat)


def test_priors_are_those_of_the_settings() -> None:
    numbers = CalibrateSettings().list_numbers(list(KINDS), ["unk"])
    sigmas = {(n.kind, n.axis): n.prior_sigma for n in numbers}
    assert sigmas[Common.FOCAL, ""] == 0.05
    assert sigmas[Common.MOUNTING, "z"] == pytest.approx(3600.0 * ARCSEC)
    assert all(sigma > 3.0 * OFF[kind] for (kind, _), sigma in sigmas.items())
