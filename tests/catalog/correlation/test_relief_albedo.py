"""Matches on ground whose albedo follows its relief: their places, and what they state of them."""

import numpy as np
import pytest
from scipy import ndimage

from catalog.correlation.ncc import add_remainder_covariance, match_ncc
from catalog.correlation.relief_albedo import (
    SMOOTH_M,
    compute_steepness_and_crests,
    estimate_strengths,
    load_shipped_strengths,
    make_relief_match,
    make_relief_patterns,
)

POSTING_M = 948.0
MARGIN, ROOM, SIDE = 8, 8, 96
STEEPNESS, CRESTS = 1.2, -1.0  # of a mare
SUN_SLOPE = np.tan(np.radians(36.0))  # of the shading: slope against the sine of the Sun's height


def heights(rng: np.random.Generator) -> np.ndarray:
    """A plain with craters of 4 to 15 km, (128, 128) m."""
    size = SIDE + 2 * ROOM + 16
    rows, cols = np.mgrid[:size, :size]
    ground = 30.0 * ndimage.gaussian_filter(rng.normal(size=(size, size)), 3.0)
    for _ in range(14):
        row, col, radius = *rng.uniform(10.0, size - 10.0, 2), rng.uniform(2.0, 8.0)
        away = np.hypot(rows - row, cols - col) / radius
        ground += 60.0 * radius * (0.4 * np.exp(-(((away - 1.0) / 0.35) ** 2)) - np.exp(-(away**3)))
    return ground


def shaded(ground: np.ndarray, posting_m: float = POSTING_M) -> np.ndarray:
    """Brightness under a Sun in the east."""
    return 1.0 - np.gradient(ground, posting_m, axis=1) / SUN_SLOPE


def cut(grid: np.ndarray, size: int) -> np.ndarray:
    first = (grid.shape[0] - size) // 2
    return np.ascontiguousarray(grid[first : first + size, first : first + size], np.float32)


def trial(
    rng: np.random.Generator,
    steepness: float,
    crests: float,
    hole: int = 0,
    posting_m: float = POSTING_M,
):
    """Matches without and with the patterns, and the fit; the reference lies where it was cut.

    hole  side of a square that neither the picture nor the reference shows
    """
    ground = heights(rng)
    reference = cut(shaded(ground, posting_m), SIDE)
    steep, crest = compute_steepness_and_crests(ground, posting_m)
    dust = 0.01 * ndimage.gaussian_filter(rng.normal(size=ground.shape), 1.0) / 0.28
    seen = shaded(ground, posting_m) * np.exp(steepness * steep + crests * crest + dust)
    search = cut(seen, SIDE + 2 * ROOM)
    patterns = make_relief_patterns(cut(ground, SIDE), posting_m, reference)
    search[30 : 30 + hole, 40 : 40 + hole] = np.nan
    before = add_remainder_covariance(
        match_ncc(reference, search, MARGIN), reference, search, MARGIN
    )
    fit = make_relief_match(before, reference, patterns, search, MARGIN)
    return before, fit.apply_albedo(load_shipped_strengths()), fit


def squares(matches: list) -> float:
    """Mean of the squared errors in the stated sigmas, a degree of freedom."""
    errors = [np.array([m.dx, m.dy]) for m in matches]
    pairs = zip(errors, matches, strict=True)
    return float(np.mean([e @ np.linalg.solve(m.covariance, e) / 2.0 for e, m in pairs]))


@pytest.mark.parametrize("posting_m", [POSTING_M, 0.5 * POSTING_M])
def test_bright_crests_move_a_place_and_the_patterns_move_it_back(posting_m: float) -> None:
    """A Sun in the east: crests that are brighter than the plain move places westward."""
    rng = np.random.default_rng(1)
    pairs = [trial(rng, STEEPNESS, CRESTS, posting_m=posting_m) for _ in range(20)]
    before, after = ([pair[k] for pair in pairs] for k in (0, 1))
    assert np.mean([m.dx for m in before]) < -0.1
    assert abs(np.mean([m.dx for m in after])) < 0.03
    assert squares(before) > 5.0
    assert squares(after) < 2.0


def test_albedo_that_does_not_follow_relief_explains_little() -> None:
    rng = np.random.default_rng(2)
    assert max(trial(rng, 0.0, 0.0)[2].explained for _ in range(5)) < 0.02
    assert min(trial(rng, STEEPNESS, CRESTS)[2].explained for _ in range(5)) > 0.2


def test_a_place_with_a_hole_is_moved_back_as_well() -> None:
    """Points of a frame that stay while others move would not fit together with them."""
    rng = np.random.default_rng(1)
    pairs = [trial(rng, STEEPNESS, CRESTS, hole=20) for _ in range(20)]
    before, after = ([pair[k] for pair in pairs] for k in (0, 1))
    assert np.mean([m.dx for m in before]) < -0.1
    assert abs(np.mean([m.dx for m in after])) < 0.03
    assert squares(after) < 2.0


def test_a_peak_that_is_none_stays_none() -> None:
    rng = np.random.default_rng(3)
    ground = heights(rng)
    reference = cut(shaded(ground), SIDE)
    patterns = make_relief_patterns(cut(ground, SIDE), POSTING_M, reference)
    search = cut(shaded(ground), SIDE + 2 * ROOM)
    match = match_ncc(reference, search, MARGIN)
    none = match._replace(covariance=np.diag([np.inf, np.inf]))
    assert make_relief_match(none, reference, patterns, search, MARGIN) is None


def test_points_of_a_picture_tell_its_strengths_and_hold_each_other() -> None:
    rng = np.random.default_rng(4)
    trials = [trial(rng, STEEPNESS, CRESTS) for _ in range(12)]
    fits = [fit for *_, fit in trials]
    strengths = estimate_strengths(fits)
    assert strengths.steepness.mean == pytest.approx(STEEPNESS, abs=0.1)
    assert strengths.crests.mean == pytest.approx(CRESTS, abs=0.1)
    assert strengths.steepness.sigma < load_shipped_strengths().steepness.sigma
    assert strengths.crests.sigma < load_shipped_strengths().crests.sigma
    alone, together = (
        [m.dx for m in some]
        for some in ([m for _, m, _ in trials], [f.apply_albedo(strengths) for f in fits])
    )
    assert np.std(together) < np.std(alone)
    assert estimate_strengths([]) == load_shipped_strengths()


@pytest.mark.parametrize("columns_m", [250.0, 125.0])
def test_crests_are_below_zero_and_slopes_are_steep(columns_m: float) -> None:
    away = np.abs(np.arange(161.0) - 80.0)
    ridge = np.repeat(-25.0 * away[:, None], 161, axis=1)
    steep, crests = compute_steepness_and_crests(ridge, (250.0, columns_m))
    assert steep[40, 80] == pytest.approx(0.1, rel=0.01)
    # a ridge of 0.1 to both sides, rounded by a Gaussian, bends most at its middle
    width_m = SMOOTH_M * np.sqrt(250.0 / columns_m)  # as many nodes along rows as along columns
    assert crests[80, 80] == pytest.approx(-0.2 * 1e3 / (np.sqrt(2.0 * np.pi) * width_m), rel=0.05)
    assert crests[40, 80] == pytest.approx(0.0, abs=1e-3)


def test_the_patterns_are_of_the_ground_not_of_its_nodes() -> None:
    """Albedo knows nothing of how finely the terrain model is given."""
    rng = np.random.default_rng(6)
    fine = ndimage.gaussian_filter(rng.normal(size=(200, 200)), 5.0) * 1e3
    coarse = fine.reshape(100, 2, 100, 2).mean(axis=(1, 3))
    for at_fine, at_coarse in zip(
        compute_steepness_and_crests(fine, 0.5 * POSTING_M),
        compute_steepness_and_crests(coarse, POSTING_M),
        strict=True,
    ):
        means = at_fine.reshape(100, 2, 100, 2).mean(axis=(1, 3))
        inner = np.s_[10:-10, 10:-10]
        scale = np.polyfit(at_coarse[inner].ravel(), means[inner].ravel(), 1)[0]
        assert scale == pytest.approx(1.0, abs=0.1)


@pytest.mark.calibration
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_strengths_halved_or_doubled_are_no_longer_those_of_the_moon(factor: float) -> None:
    """Of 367 squares the mean of crests is known to 0.05, of steepness to 0.06."""
    shipped = load_shipped_strengths()
    for strength, known in ((shipped.steepness, 0.06), (shipped.crests, 0.05)):
        assert abs(strength.mean * (factor - 1.0)) > 5.0 * known
