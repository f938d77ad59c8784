"""The fit of a descent's sizes: known ones are found again, the shipped ones stay calibrated."""

import numpy as np
import pytest

from catalog.arrays import FloatArray
from catalog.config import read_toml_text, resource
from catalog.geometry.latlon import body_from_local
from optnav_cli.control_points.field import BAND_SIDES_M, NOT_STATED, StatedBands
from optnav_cli.navigate.descent.state import FILE, WindowGround, load_descent_sizes
from optnav_cli.navigate.descent.windows import STEP, WindowKey
from tests.studies import descent_fit
from tests.studies.descent_fit import FlightErrors

AXES = body_from_local(-0.75, -0.2)
WINDOWS, FRAMES, FLIGHTS, PIXEL_M = 25, 4, 8, 10.0
LEAST_DROP = 2.0  # of the logarithm of the likelihood: seven times less likely
# The sizes as they were last set and scored. Who sets them anew writes the new ones here.
CALIBRATED = {
    "own_postings": 0.075,
    "remainder": 1.3,
    "common": 0.07,
    "sunward_postings": 0.01,
    "height_postings": 0.02,
    "fresh_px": 0.08,
    "fresh_share": 0.22,
    "landmark_px": 0.4,
    "landmark_shift": 3e-4,
    "landmark_height_postings": 0.5,
    "stated_shift": 0.3,
    "stated_height": 3.2,
    "stated_width": 0.6,
    "stated_own": 0.45,
    "altimeter_postings": 0.06,
}


def place_m(key: WindowKey) -> FloatArray:
    """A window's place on flat ground."""
    return STEP * 118.45 * (AXES[:, :2] @ [key.col, key.row])


def flight(
    rng: np.random.Generator,
    sizes: descent_fit.DescentErrorSizes,
    stated: StatedBands = NOT_STATED,
) -> FlightErrors:
    """Windows side by side, seen in several frames from two sides, missed as sizes say."""
    keys = [
        WindowKey(0, 24, 4 * STEP * row, 4 * STEP * col) for row in range(5) for col in range(5)
    ]
    left = rng.uniform(0.0, 400.0, (WINDOWS, 2))
    pixel_m2 = PIXEL_M**2 * np.eye(2)
    grounds = [
        WindowGround(key, AXES, 118.45, np.diag(own), pixel_m2, stated, place_m(key))
        for key, own in zip(keys, left, strict=True)
    ]
    of_window = np.tile(np.arange(WINDOWS), FRAMES)
    level = np.tile(np.stack([AXES[:, 0], -AXES[:, 1]]) / PIXEL_M, (len(of_window), 1, 1))
    tilt = np.repeat(rng.uniform(-0.5, 0.5, (FRAMES, 2)), WINDOWS, axis=0)
    by_ground = level + tilt[:, :, None] * AXES[:, 2] / PIXEL_M
    shown = FlightErrors(
        "made",
        grounds,
        of_window,
        np.zeros((len(of_window), 2)),
        np.tile(rng.normal(0.0, 40.0, 2), (len(of_window), 1)),
        by_ground,
        np.tile(0.05 * np.eye(2), (len(of_window), 1, 1)),
    )
    missed, covariance = shown.errors(sizes)
    drawn: FloatArray = np.linalg.cholesky(covariance) @ rng.normal(size=missed.size)
    found = drawn.reshape(-1, 2) + sizes.sunward_postings * shown.sunward_px
    return descent_fit.replace(shown, missed_px=found)


@pytest.fixture(scope="module")
def calibrated() -> list[FlightErrors]:
    """Flights that are missed by the sizes as they were last fitted."""
    rng = np.random.default_rng(7)
    sizes = descent_fit.DescentErrorSizes(**CALIBRATED)
    return [flight(rng, sizes) for _ in range(FLIGHTS)]


def test_sizes_that_flights_were_made_with_are_found_again(calibrated: list[FlightErrors]) -> None:
    # the Sun on both sides, as of the flights that ship: a shift away from it is no wrong model,
    # whose scale followed such a shift before
    wrong = {"own_postings": 2.0, "fresh_px": 0.5, "sunward_postings": 2.0}
    start = descent_fit.scaled(descent_fit.DescentErrorSizes(**CALIBRATED), wrong)
    found = descent_fit.fitted(calibrated, start)
    for name in wrong:
        assert 1 / 1.3 < getattr(found, name) / CALIBRATED[name] < 1.3, name


@pytest.mark.calibration
def test_the_shipped_sizes_are_the_calibrated_ones(calibrated: list[FlightErrors]) -> None:
    """Halving or doubling any size in the file is less likely than what it was fitted to."""
    found = descent_fit.drops(calibrated, load_descent_sizes())
    weak = {"common", "sunward_postings"}  # of few flights, and little under these Suns
    for name, (half, twice) in found.items():
        assert twice > 0.0 if name in weak else min(half, twice) > LEAST_DROP, name
    for name, value in CALIBRATED.items():
        assert 1 / 1.5 < getattr(load_descent_sizes(), name) / value < 1.5, name


@pytest.mark.calibration
def test_flights_over_a_model_that_states_its_error_tell_its_sizes() -> None:
    """And no others: those of windows are told by flights over models that state nothing."""
    rng, sizes = np.random.default_rng(8), load_descent_sizes()
    sigmas_m = np.zeros((len(BAND_SIDES_M), 2))
    sigmas_m[-3:] = (10.0, 5.0), (140.0, 10.0), (30.0, 15.0)
    stated = StatedBands(BAND_SIDES_M, sigmas_m)
    found = descent_fit.drops([flight(rng, sizes, stated) for _ in range(FLIGHTS)], sizes)
    assert found.keys() == set(descent_fit.STATED)
    # of what windows share more may pass for a wrong model, whose scale is learned
    weak = {"stated_shift", "stated_width"}
    for name, (half, twice) in found.items():
        assert (half if name in weak else min(half, twice)) > LEAST_DROP, name


def test_new_sizes_are_written_into_the_file_of_the_old_ones() -> None:
    new = descent_fit.scaled(load_descent_sizes(), {"common": 1.5})
    text = read_toml_text(resource(FILE))
    made = descent_fit.with_sizes(text, new)
    changed = [(a, b) for a, b in zip(text.splitlines(), made.splitlines(), strict=True) if a != b]
    assert [line for _, line in changed] == [f"common = {new.common:.2g}"]
