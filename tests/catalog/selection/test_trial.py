"""Recognition trials: the picture is where its distortion says, and failures are noticed."""

import cv2
import numpy as np
import pytest

from catalog.selection.trial import (
    FINER,
    Circumstances,
    Gate,
    Level,
    Search,
    _draw_noise,
    compute_distortion,
    compute_side,
    compute_truth_size,
    draw_circumstances,
    run_trial,
    scale_to_counts,
    simulate_picture,
)

MOON_M = 1_737_400.0
POSTING_M = 100.0
SEARCH = Search(template_nodes=48)


def smooth_terrain(seed, size, posting_m, height_m=120.0):
    """The same hills whatever the grid: cosines of fixed wavelengths about the centre."""
    rng = np.random.default_rng(seed)
    axis = (np.arange(size) - (size - 1) / 2.0) * posting_m
    x, y = np.meshgrid(axis, -axis)
    total = np.zeros((size, size))
    for _ in range(60):
        wavelength, azimuth, phase = rng.uniform(900.0, 4000.0), *rng.uniform(0.0, 2 * np.pi, 2)
        along = x * np.sin(azimuth) + y * np.cos(azimuth)
        total += wavelength / 2500.0 * np.cos(2.0 * np.pi * along / wavelength + phase)
    return (height_m * total / 6.0).astype(np.float32)


def levels(seed=1, height_m=120.0, count=2):
    found = []
    for level in range(count):
        posting, finer = POSTING_M * 2.0**level, 1 if level else FINER
        truth = smooth_terrain(seed, compute_truth_size(SEARCH, finer), posting / finer, height_m)
        reference = smooth_terrain(seed, 64, posting, height_m)
        found.append(Level(reference, truth, posting, finer=finer))
    return found


def circumstances(**changes):
    plain = Circumstances(
        sun_local=np.array([np.cos(np.radians(25.0)), 0.0, np.sin(np.radians(25.0))]),
        view_local=np.array([0.0, 0.0, 1.0]),
        roll=0.0,
        scale=1.0,
        stretch_azimuth=0.0,
        stretch=1.0,
        shift_m=np.zeros(2),
        snr=50.0,
    )
    return plain._replace(**changes)


@pytest.mark.parametrize("shift_m", [(0.0, 0.0), (330.0, -140.0), (-215.0, 415.0)])
def test_a_shifted_place_is_found_where_it_is(shift_m):
    outcome = run_trial(levels(), circumstances(shift_m=np.array(shift_m)), [1], MOON_M, SEARCH)
    assert outcome.accepted
    # noise, 8 bits and two photometric laws: a fifth of a node
    assert outcome.distance < 0.2


@pytest.mark.parametrize(("roll_deg", "scale"), [(6.0, 1.0), (-6.0, 1.1), (3.0, 0.9)])
def test_roll_and_scale_within_the_limits_are_tracked(roll_deg, scale):
    turned = circumstances(roll=np.radians(roll_deg), scale=scale, shift_m=np.array([150.0, 260.0]))
    outcome = run_trial(levels(), turned, [2], MOON_M, SEARCH)
    assert outcome.accepted
    assert outcome.distance < 0.5


def test_another_ground_is_refused():
    mixed = [a._replace(truth=b.truth) for a, b in zip(levels(1), levels(2), strict=True)]
    outcomes = [run_trial(mixed, circumstances(), [k], MOON_M, SEARCH) for k in range(5)]
    assert not any(outcome.accepted for outcome in outcomes)


def test_flat_ground_under_noise_is_refused():
    outcome = run_trial(levels(height_m=0.5), circumstances(snr=10.0), [3], MOON_M, SEARCH)
    assert not outcome.accepted


def test_a_place_beyond_the_search_is_never_accepted_as_if_near():
    far = circumstances(shift_m=np.array([4000.0, 0.0]))
    outcome = run_trial(levels(), far, [4], MOON_M, SEARCH)
    assert not outcome.accepted
    assert outcome.distance > 3.0


def test_the_same_seed_gives_the_same_outcome_and_another_other_noise():
    first = run_trial(levels(), circumstances(snr=10.0), [5], MOON_M, SEARCH)
    assert first == run_trial(levels(), circumstances(snr=10.0), [5], MOON_M, SEARCH)
    assert first.error != run_trial(levels(), circumstances(snr=10.0), [6], MOON_M, SEARCH).error


def test_a_stricter_gate_refuses():
    outcome = run_trial(
        levels(), circumstances(snr=10.0), [7], MOON_M, SEARCH, Gate(min_score=0.9999)
    )
    assert not outcome.accepted


def test_a_trial_without_a_level_is_refused():
    with pytest.raises(ValueError, match="at least one level"):
        run_trial([], circumstances(), [1], MOON_M)


def test_distortion_turns_stretches_and_squeezes_as_stated():
    turned = compute_distortion(circumstances(roll=np.radians(90.0), scale=1.1))
    np.testing.assert_allclose(turned @ [1.0, 0.0], [0.0, 1.1], atol=1e-12)
    squeezed = compute_distortion(circumstances(stretch=0.9, stretch_azimuth=np.radians(90.0)))
    np.testing.assert_allclose(squeezed, np.diag([0.9, 1.0]), atol=1e-12)


def test_drawn_circumstances_stay_within_their_limits():
    suns = np.array([[0.0, 0.8, 0.6], [0.6, 0.0, 0.8]])
    rng = np.random.default_rng(8)
    drawn = [draw_circumstances(rng, suns, POSTING_M) for _ in range(400)]
    assert max(abs(c.roll) for c in drawn) <= np.radians(6.0)
    assert 0.9 <= min(c.scale for c in drawn) < 0.92
    assert 1.08 < max(c.scale for c in drawn) <= 1.1
    off = [np.degrees(np.arccos(c.view_local[2])) for c in drawn]
    assert 23.0 < max(off) <= 25.0
    assert all(c.stretch == pytest.approx(c.view_local[2]) for c in drawn)
    assert min(c.snr for c in drawn) >= 10.0
    assert max(c.snr for c in drawn) <= 50.0


def test_a_picture_has_the_stated_noise_and_whole_counts():
    # a slope in one direction, so that the percentile which sets the exposure is known
    bright = np.tile(np.linspace(0.1, 0.2, 200, dtype=np.float32), (200, 1))
    centre = np.full(2, 99.5)
    rng = np.random.default_rng(9)
    clean = simulate_picture(bright, np.eye(2) * FINER, centre, 64, 1, 1e9, rng)
    noisy = simulate_picture(bright, np.eye(2) * FINER, centre, 64, 1, 20.0, rng)
    assert np.array_equal(noisy, np.rint(noisy))
    assert noisy.max() <= 255
    scale = 1.0 / np.percentile(bright, 99.5) * 255
    relative = (noisy - clean).std() / clean.mean()
    # exposure follows the noise too: a tenth
    assert relative == pytest.approx(1.0 / 20.0, rel=0.15), scale


@pytest.mark.parametrize("finer", [1, FINER])
def test_the_truth_covers_every_window_that_can_be_asked_for(finer):
    worst = draw_circumstances(np.random.default_rng(1), np.eye(3)[2:], POSTING_M)
    worst = worst._replace(roll=np.radians(6.0), scale=0.9, stretch=1.0)
    size = compute_truth_size(SEARCH, finer)
    bright = np.ones((size, size), np.float32)
    window = SEARCH.template_nodes + 2 * SEARCH.coarse_nodes
    inverse = np.linalg.inv(compute_distortion(worst))
    centre = np.full(2, (size - 1) / 2.0)
    rng = np.random.default_rng(2)
    picture = simulate_picture(bright, finer * inverse, centre, window, 1, 1e9, rng, finer)
    assert np.isfinite(picture).all()
    assert cv2.countNonZero(picture) == picture.size


def test_exposure_is_numpy_s_percentile_of_the_noisy_picture():
    rng = np.random.default_rng(3)
    for shape in ((80, 80), (37, 51), (3, 3)):
        sampled = rng.uniform(0.05, 0.2, shape).astype(np.float32)
        sampled[0, :2] = np.nan
        noise = rng.standard_normal(shape, dtype=np.float32)
        noisy = sampled + noise * np.float32(np.nanmean(sampled) * 0.08)
        white = np.nanpercentile(noisy, 99.5)
        wanted = np.clip(np.rint(noisy * (255.0 / white)), 0, 255)
        found = scale_to_counts(sampled, noise, 0.08)
        assert np.array_equal(np.isnan(found), np.isnan(sampled))
        # a count may fall to the other side of a half
        assert np.nanmax(np.abs(found - wanted)) <= 1.0
        assert ((found != wanted) & ~np.isnan(wanted)).sum() <= 1 + sampled.size // 100
    assert np.isnan(scale_to_counts(np.full((4, 4), np.nan, np.float32), noise[:1, :1], 0.1)).all()


def test_the_part_of_the_truth_under_a_picture_gives_the_same_picture():
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.1, 0.2, (200, 200)).astype(np.float32)
    for _ in range(10):
        matrix = FINER * np.linalg.inv(
            compute_distortion(
                circumstances(roll=rng.uniform(-0.1, 0.1), scale=rng.uniform(0.95, 1.1))
            )
        )
        offset = rng.uniform(-5.0, 5.0, 2)
        side = compute_side(matrix, offset, 64, 200)
        assert side < 200
        cut = slice(100 - side // 2, 100 + side // 2)
        seed = np.random.default_rng(5), np.random.default_rng(5)
        whole = simulate_picture(truth, matrix, 99.5 + offset, 64, 1, 1e9, seed[0])
        part = simulate_picture(
            truth[cut, cut], matrix, (side - 1) / 2 + offset, 64, 1, 1e9, seed[1]
        )
        # warpAffine rounds its coordinates: a count here and there
        np.testing.assert_allclose(part, whole, atol=1.0)
        assert (part == whole).mean() > 0.95


def test_noise_of_trials_is_white_and_their_own():
    """Of unit variance, without likeness of neighbours or trials; the same for a seed."""
    one, two, again = (_draw_noise(80, np.random.default_rng(seed)) for seed in (1, 2, 1))
    np.testing.assert_array_equal(one, again)
    many = np.array([_draw_noise(80, np.random.default_rng(seed)) for seed in range(40)])
    assert abs(many.mean()) < 0.02
    assert many.std() == pytest.approx(1.0, abs=0.02)
    for pair in ((one, two), (one[1:], one[:-1]), (one[:, 1:], one[:, :-1])):
        assert abs(np.corrcoef(*map(np.ravel, pair))[0, 1]) < 0.05
