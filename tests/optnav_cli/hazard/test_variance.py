"""The variance of brightness: against a plain loop, and what it refuses."""

import numpy as np
import pytest

from catalog.errors import NoSolutionError
from optnav_cli.hazard.pads import (
    REFUSED,
    find_usual_brightness,
    map_variance,
    measure_brightness,
)
from optnav_cli.hazard.settings import load_hazard_model
from tests.optnav_cli.hazard.views import view_of

MODEL = load_hazard_model()
CELL, PAD = 5, 4  # m, cells


def picture() -> np.ndarray:
    rng = np.random.default_rng(5)
    values = 100.0 + 6.0 * rng.standard_normal((83, 91))
    values[20:32, 40:60] = 4.0  # a shadow
    values[50:75, 10:40] += 30.0
    values[5:25, 60:90] -= 22.0
    return values.astype(np.float32)


def codes_by_a_plain_loop(values: np.ndarray, peak: float) -> np.ndarray:
    rows, cols = values.shape[0] // CELL, values.shape[1] // CELL
    high, wide = rows - PAD + 1, cols - PAD + 1
    code = np.zeros((high, wide))
    darkest, brightest = MODEL.variance.darkest, MODEL.variance.brightest
    for i in range(high):
        for j in range(wide):
            pad = values[i * CELL : (i + PAD) * CELL, j * CELL : (j + PAD) * CELL].astype(float)
            mean = pad.mean()
            alpha = 1000.0 * ((pad**2).mean() - mean**2) / mean**2
            refused = (pad < 0.3 * peak).mean() > 0.1
            refused |= not darkest * peak <= mean <= brightest * peak
            code[i, j] = 255.0 if refused else min(alpha, 254.0)
    whole = np.zeros((high, wide), int)
    for i in range(high):
        for j in range(wide):
            around = [
                code[a, b]
                for a in range(max(i - 1, 0), min(i + 2, high))
                for b in range(max(j - 1, 0), min(j + 2, wide))
                if (a, b) != (i, j)
            ]
            risk = min(254.0, code[i, j] + 0.2 * max(around))
            whole[i, j] = 255 if code[i, j] == 255.0 else round(risk)
    return whole


def test_codes_are_those_of_a_plain_loop() -> None:
    values = picture()
    view = view_of(values, elevation_deg=20.0)
    risk = map_variance(view, 20.0, MODEL)
    expected = codes_by_a_plain_loop(values, find_usual_brightness(view))
    assert risk.code.shape == expected.shape
    assert (risk.code == REFUSED).any()
    assert len(np.unique(risk.code)) > 10
    assert np.abs(risk.code.astype(int) - expected).max() <= 1
    np.testing.assert_array_equal(risk.code == REFUSED, expected == REFUSED)


def test_the_usual_brightness_is_that_of_most_lit_ground() -> None:
    assert find_usual_brightness(view_of(picture())) == pytest.approx(100.0, abs=3.0)


def test_pads_that_are_darker_or_brighter_than_most_ground_are_refused() -> None:
    view = view_of(picture())
    pads, risk = measure_brightness(view, 20.0, MODEL), map_variance(view, 20.0, MODEL)
    for outside in (pads.level < MODEL.variance.darkest, pads.level > MODEL.variance.brightest):
        assert outside.any()
        assert (risk.code[outside] == REFUSED).all()


@pytest.mark.parametrize(("pad_m", "words"), [(10.0, "under 3 cells"), (200.0, "wider than")])
def test_a_pad_that_does_not_fit_is_refused(pad_m: float, words: str) -> None:
    with pytest.raises(NoSolutionError, match=words):
        map_variance(view_of(picture()), pad_m, MODEL)


def test_a_dark_picture_is_refused() -> None:
    with pytest.raises(NoSolutionError, match="no light"):
        map_variance(view_of(np.zeros((90, 90), np.float32)), 20.0, MODEL)
