"""The error of a terrain model: its size over boxes and slopes, and that it is one field."""

from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.geometry.latlon import Lattice, xyz_from_latlon
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.error_model import load_terrain_laws
from catalog.terrain.synthetic import fractal
from catalog.terrain.synthetic.model_error import (
    BOX_RMS,
    BOX_SIDES,
    ModelError,
    SlopeMap,
    map_rms_slope,
)

RADIUS_M = 1_737_400.0
POSTING_M = 118.0


def even(slope):
    """A map of one slope everywhere."""
    slopes = np.full((4, 8), slope, np.float32)
    return SlopeMap(slopes, 0.5 * np.pi, -np.pi, np.pi / 3.0, 2.0 * np.pi / 7.0)


def error(seed=1, slope=0.085):
    return ModelError(
        seed, load_terrain_laws().spectrum["gld100"], 1.4 * POSTING_M, RADIUS_M, even(slope)
    )


def box_means(field, nodes):
    n = len(field) // nodes * nodes
    return field[:n, :n].reshape(n // nodes, nodes, n // nodes, nodes).mean(axis=(1, 3))


def rms_of_boxes(slope, nodes, posting_m=500.0, seeds=range(1, 33)):
    """Rms over fields of 64 km, far apart; nodes of 500 m are means over their own cells."""
    squares = []
    for seed in seeds:
        lat, step = 0.03 * seed - 0.5, posting_m / RADIUS_M
        field = error(seed, slope).window(lat, seed, step, step / np.cos(lat), 128, 128)
        squares.append(np.mean(box_means(field, nodes) ** 2))
    return float(np.sqrt(np.mean(squares)))


@pytest.mark.parametrize(("slope", "wanted"), [(0.02, 9.0), (0.055, 22.0), (0.15, 34.0)])
def test_the_error_over_2_km_is_that_of_the_table_in_three_classes_of_slope(slope, wanted):
    assert rms_of_boxes(slope, 4) == pytest.approx(wanted, rel=0.17)


@pytest.mark.parametrize(("nodes", "wanted"), [(4, 28.0), (8, 15.0), (16, 9.5), (30, 8.0)])
def test_the_error_falls_with_the_size_of_the_box_as_the_table_says(nodes, wanted):
    assert rms_of_boxes(0.085, nodes) == pytest.approx(wanted, rel=0.2)


def test_a_seed_gives_the_same_ground_in_whichever_window_it_is_sampled():
    step = POSTING_M / RADIUS_M
    whole = error().window(-0.7, 0.3, step, 1.3 * step, 90, 110)
    part = error().window(-0.7 - 30 * step, 0.3 + 40 * 1.3 * step, step, 1.3 * step, 20, 30)
    np.testing.assert_allclose(part, whole[30:50, 40:70], atol=1e-3)
    turned = error().turned_window(np.eye(3), Lattice(-0.7, 0.3, step, 40, 50))
    np.testing.assert_allclose(turned, error().window(-0.7, 0.3, step, step, 40, 50), atol=1e-3)
    assert not np.allclose(error(2).window(-0.7, 0.3, step, step, 40, 50), turned)


def test_model_and_truth_agree_at_long_waves_and_not_at_all_at_short_ones():
    """Coherence^2 of GLD100 with LOLA: 0.98 from 3 to 6 km, 0.71, 0.18, 0 below 0.8 km.

    Tycho's slopes are 0.13 rms, where the table of the errors gives more than on most highlands.
    """
    model = DemSettings(str(resource("data/tycho_gld100_256ppd.tif")))
    heights = DemSource.open(model, Path(), load_body("moon")).read_window(1300, 500, 1024, 1024)
    step = np.pi / 180.0 / 256.0
    north = np.radians(-38.0) - 1300 * step
    wrong = error(1, 0.13).window(north, np.radians(345.0), step, step, 1024, 1024)
    taper = np.outer(np.hanning(1024), np.hanning(1024))
    a = np.fft.rfft2((heights - heights.mean()) * taper)
    b = np.fft.rfft2((heights + wrong - heights.mean()) * taper)
    rows, cols = np.fft.fftfreq(1024, 0.1184), np.fft.rfftfreq(1024, 0.1184 * np.cos(north))
    wave = 1.0 / np.maximum(np.hypot(rows[:, None], cols[None, :]), 1e-6)

    def coherence(least_km, most_km):
        band = (wave >= least_km) & (wave < most_km)
        both = np.abs(np.sum(a[band] * np.conj(b[band]))) ** 2
        return both / np.sum(np.abs(a[band]) ** 2) / np.sum(np.abs(b[band]) ** 2)

    assert coherence(3.2, 6.4) > 0.8
    assert 0.5 < coherence(1.6, 3.2) < 0.8
    assert 0.05 < coherence(0.8, 1.6) < 0.3
    assert coherence(0.4, 0.8) < 0.1


def test_the_response_of_boxes_is_that_of_the_noise():
    octave = fractal.Octaves(5, np.array([1.0]), np.array([1.0]), 300.0)
    field, step = np.zeros((1024, 1024), np.float32), 0.125 / 300.0
    across = step * (np.arange(1024) - 512.0)
    fractal.add_noise_window(field, octave, across[::-1].copy(), across)
    for side, wanted in list(zip(BOX_SIDES, BOX_RMS))[1:6]:
        means = box_means(field, round(side / 0.125))
        assert np.sqrt(np.mean(means**2)) == pytest.approx(wanted, rel=0.05)


def test_slopes_are_those_of_the_heights_and_holes_have_none():
    north = 1900.0 * 0.1 * np.arange(40.0)[:, None] + np.zeros((40, 40))
    heights = north.astype(np.float32)
    np.testing.assert_allclose(map_rms_slope(heights, 1900.0, 1900.0)[5:-5, 5:-5], 0.1, rtol=1e-3)
    heights[18:22, 18:22] = np.nan
    assert np.isfinite(map_rms_slope(heights, 1900.0, 1900.0)).all()


def test_a_globe_of_slopes_has_no_seam():
    lat = np.pi / 180.0 * (89.5 - np.arange(180.0))
    lon = np.pi / 180.0 * (0.5 + np.arange(360.0))
    x = xyz_from_latlon(lat[:, None], lon[None, :], 1.0)
    slopes = SlopeMap.measure_globe((5e4 * x[..., 0]).astype(np.float32), RADIUS_M)
    at = slopes.sample(np.zeros((1, 3)), np.array([[-1e-4, 0.0, 1e-4]]))
    np.testing.assert_allclose(at, at[0, 0], atol=1e-4)
    assert slopes.sample(np.zeros((1, 1)), np.full((1, 1), 0.5 * np.pi))[0, 0] == pytest.approx(
        5e4 / RADIUS_M, rel=0.05
    )
