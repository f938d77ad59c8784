"""A stereo pair against box filters of its pictures; a calibration against a dense solution."""

import time

import cv2
import numpy as np
import pytest

from optnav_cli.calibration.adjustment import adjust
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.stereo.height import measure_height
from tests.bench.timing import in_turn, result, sized, spread, within
from tests.optnav_cli.stereo.pairs import DOWN, picture, rig
from tests.studies.calibration_routes import Route, simulated_route

pytestmark = pytest.mark.bench

ROUNDS = 15
# About twice what was measured, 88 ms and 213 filters, 0.5 s and 1.3 solutions.
PAIR_LIMIT_MS, PAIR_LIMIT_RATIO = 200.0, 400.0
FRAMES, POINTS = 100, 60
ROUTE_LIMIT_S, ROUTE_LIMIT_RATIO = 1.0, 2.5


def test_a_stereo_height_against_one_box_filter_of_each_picture() -> None:
    """Pictures of 320 x 320 px from 30 m."""
    pair = rig()
    seen = [
        picture(eye, 30.0, noise=0.5, seed=k) for k, eye in enumerate((pair.first, pair.second))
    ]
    measure_height(seen[0], seen[1], pair, DOWN)
    calls = {
        "filter": lambda: [cv2.boxFilter(one, cv2.CV_32F, (63, 63)) for one in seen],
        "pair": lambda: measure_height(seen[0], seen[1], pair, DOWN),
    }
    times = in_turn(calls, ROUNDS, time.process_time)
    ratio = spread(np.divide(times["pair"], np.maximum(times["filter"], 1e-6)))
    milliseconds = 1e3 * float(np.median(times["pair"]))
    result(
        "stereo height of a pair",
        f"{milliseconds:.1f} ms",
        f"{ratio} × box filters of the pair; limits {PAIR_LIMIT_MS:g} ms, {PAIR_LIMIT_RATIO:g} ×",
    )
    assert within(milliseconds, PAIR_LIMIT_MS)
    assert within(ratio.median, PAIR_LIMIT_RATIO)


def test_a_calibration_of_100_frames_against_one_dense_least_squares_solution() -> None:
    """All its iterations, of frames that are eliminated one by one, against one of all at once."""
    frames, points = sized(FRAMES, 8), sized(POINTS, 20)
    route = Route(preset_camera("unk"), frames, rolled=True, points=points)
    shown, truth = simulated_route(route, 1)
    rows = sum(2 * len(frame.sightings.pixels) for frame in shown) + 6 * frames
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(rows, len(truth.numbers) + 6 * frames))
    right = rng.normal(size=rows)
    calls = {
        "dense": lambda: np.linalg.lstsq(matrix, right, rcond=None),
        "calibrate": lambda: adjust(shown, truth.numbers, by_direction=True),
    }
    times = in_turn(calls, sized(3, 1), time.process_time)
    ratio = spread(np.divide(times["calibrate"], np.maximum(times["dense"], 1e-6)))
    seconds = float(np.median(times["calibrate"]))
    result(
        f"calibration of {frames} frames",
        f"{seconds:.2f} s",
        f"{ratio} × one dense solution; limits {ROUTE_LIMIT_S:g} s, {ROUTE_LIMIT_RATIO:g} ×",
    )
    assert within(seconds, ROUTE_LIMIT_S)
    assert within(ratio.median, ROUTE_LIMIT_RATIO)
