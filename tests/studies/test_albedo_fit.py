"""The fit of how albedo follows relief: from ground whose albedo is drawn by known strengths."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from catalog.bodies.body import load_body
from catalog.config import read_toml_text, resource
from catalog.correlation.relief_albedo import (
    FILE,
    SMOOTH_M,
    compute_steepness_and_crests,
    load_shipped_strengths,
)
from catalog.errors import ConfigError, NothingToDoError, UsageError
from catalog.progress import SilentProgress
from optnav_cli.simulation.albedo import AlbedoMap
from optnav_cli.simulation.scenario import load_scenario
from tests.studies import albedo_fit, fit, likelihood
from tests.studies.albedo_fit import AlbedoFitResult, fitted, numbers, squares

POSTINGS_M = 948.0, 900.0


def ground(
    seed: int, steepness: float, crests: float, rises: tuple[float, float] = (0.0, 0.0)
) -> albedo_fit.BoxStrengths:
    """Squares of hills whose brightness goes with them, and with rises toward east and north."""
    rng = np.random.default_rng(seed)
    hills = 2e4 * ndimage.gaussian_filter(rng.normal(size=(200, 250)), 3.0)
    steep, crest = compute_steepness_and_crests(hills, POSTINGS_M)
    down, east = np.gradient(hills, *POSTINGS_M)
    logs = steepness * steep + crests * crest + rises[0] * east - rises[1] * down
    logs += 0.02 * rng.normal(size=hills.shape)
    return squares("hills", hills, np.exp(logs), POSTINGS_M)


def test_strengths_that_albedo_was_drawn_by_are_found() -> None:
    boxes = [ground(seed, *pair) for seed, pair in enumerate([(0.9, -0.1), (0.3, -0.3)])]
    assert [len(box.strengths) for box in boxes] == [6, 6]
    found = fitted(boxes)
    assert found["steepness.mean"] == pytest.approx(0.6, abs=0.03)
    assert found["steepness.sigma"] == pytest.approx(0.3, abs=0.03)
    assert found["crests.mean"] == pytest.approx(-0.2, abs=0.02)
    assert found["crests.sigma"] == pytest.approx(0.1, abs=0.02)


def test_shading_that_a_map_holds_is_found_beside_albedo_that_follows_relief() -> None:
    plain, shaded = ground(5, 0.6, -0.2), ground(5, 0.6, -0.2, (0.2, -0.4))
    assert plain.rises.mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.02)
    assert shaded.rises.mean(axis=0) == pytest.approx([0.2, -0.4], abs=0.02)
    assert np.median(plain.shaded) < 0.01 < 0.1 < np.median(shaded.shaded)
    # it knows a direction, and so takes nothing from what does not
    assert fitted([shaded])["steepness.mean"] == pytest.approx(0.6, abs=0.1)


def test_the_report_tells_grounds_that_were_not_fitted_with() -> None:
    one = ground(1, 0.6, -0.2)
    result = AlbedoFitResult(load_shipped_strengths(), fitted([one]), [one], [one], [one])
    tables = fit.report(result).tables
    assert [row[0] for row in tables[0].rows] == list(numbers(load_shipped_strengths()))
    assert [row[2] for row in tables[1].rows] == ["fitted with", "other ground", "shown alone"]


def test_new_strengths_are_written_over_the_old_ones() -> None:
    old = numbers(load_shipped_strengths())
    text = likelihood.with_numbers(read_toml_text(resource(FILE)), old, old | {"crests.mean": -0.5})
    assert "mean = -0.5 " in text
    assert text.count("mean = 0.96") == 1


def test_heights_are_smoothed_by_half_a_pixel_of_the_map(
    shared_data: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shared_data("moon/lroc_color_2025_4k.jpg").parents[1]
    monkeypatch.setenv("OPTNAV_SHARED_DATA", str(folder))
    scenario = load_scenario(resource(f"configs/scenarios/{albedo_fit.MAPPED}.toml"))
    albedo = AlbedoMap(scenario.world.albedo_map, load_body("moon"))
    assert pytest.approx(0.5 * albedo.posting_m, rel=0.01) == SMOOTH_M


def test_ground_of_another_name_is_refused() -> None:
    with pytest.raises(NothingToDoError, match="no ground to fit with is called 'none'"):
        fit.run(SilentProgress(), "albedo", rows="none")


def test_pictures_are_refused_where_none_are_needed(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="leave --folder and --frames out"):
        fit.run(SilentProgress(), "albedo", folder=tmp_path)


def test_without_the_shared_map_the_fit_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPTNAV_SHARED_DATA", raising=False)
    with pytest.raises(ConfigError, match="OPTNAV_SHARED_DATA"):
        fit.run(SilentProgress(), "albedo")
