"""The studies of stereo and calibration: their tables, on little input."""

from pathlib import Path

import numpy as np
import pytest

from catalog.progress import SilentProgress
from tests.studies import calibration, stereo
from tests.studies.calibration_routes import KINDS, Route, simulated_route
from tests.studies.stereo import StereoErrors, StereoTruth


def test_a_study_of_few_routes_says_what_one_height_does_not_tell_apart(tmp_path: Path) -> None:
    found = calibration.run(tmp_path, SilentProgress(), trials=2, pictures=0, frames=16, seed=1)
    report = calibration.report(found)
    summary, numbers, accuracy = report.tables
    assert summary.column("routes") == [2]
    assert len(numbers.rows) == 8
    tied = accuracy.column("directions")
    assert "the clock" in str(tied[0])
    assert tied[1] == "none"
    (residual,) = summary.column("residual")
    assert residual == pytest.approx(1.0, abs=0.15)
    assert any("KMSS-2" in note for note in report.notes)


def test_a_route_is_the_same_for_the_same_seed_and_loses_what_it_says() -> None:
    camera = calibration.preset_camera("unk")
    whole, truth = simulated_route(Route(camera, frames=6), 5)
    again, _ = simulated_route(Route(camera, frames=6), 5)
    half, _ = simulated_route(Route(camera, frames=6, lost=0.5), 5)
    np.testing.assert_array_equal(whole[3].sightings.pixels, again[3].sightings.pixels)
    counts = [sum(len(frame.points) for frame in frames) for frames in (whole, half)]
    assert counts[1] / counts[0] == pytest.approx(0.5, abs=0.15)
    assert counts[0] / 6 == pytest.approx(60.0, rel=0.3)
    assert {number.kind for number in truth.numbers} == set(KINDS)


def test_stereo_tables_hold_the_growth_with_the_height() -> None:
    results = []
    for height_m in (50.0, 100.0, 200.0, 400.0, 800.0):
        sigma = 1e-5 * height_m**2
        result = StereoErrors(height_m, pairs=4)
        result.exact = [(sign * sigma, sigma) for sign in (1.0, -1.0, 1.0, -1.0)]
        result.mounted = result.exact
        result.of_mounting = [sigma] * 4
        results.append(result)
    off, spread = np.array([3e-3, 4e-3]), np.eye(2) * 2.5e-5
    results[1].velocity = [(off, spread)]
    results[1].one_eyed = [(2.0 * off, spread)]
    heights, growth, speeds, single = stereo.report(results).tables
    assert growth.column("slope") == [pytest.approx(2.0)] * 4
    assert heights.column("exact_nees") == [pytest.approx(1.0)] * 5
    assert speeds.column("nees") == [pytest.approx(0.5)]
    assert single.column("nees") == [pytest.approx(2.0)]


def test_the_true_height_is_over_the_ground_and_not_over_the_sphere() -> None:
    truth = StereoTruth(25.0, 6, 1)
    for exposures in truth.passes:
        assert truth.height_m(exposures[0]) == pytest.approx(25.0, abs=1.0)
