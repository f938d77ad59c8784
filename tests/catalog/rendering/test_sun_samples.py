"""Sampled Suns against the declination that each would need."""

import math

import numpy as np
import pytest

from catalog.rendering.sun_samples import find_azimuth_band, find_highest_sun, sun_samples

TILT = math.radians(1.54)


def declination(sun, lat):
    """Latitude of the point under the Sun, from its direction at a place."""
    return np.arcsin(sun @ np.array([0.0, math.cos(lat), math.sin(lat)]))


@pytest.mark.parametrize("lat_deg", [-90.0, -88.0, -43.0, 0.0, 1.0, 30.0, 75.0, 89.5, 90.0])
def test_every_sampled_sun_can_occur(lat_deg):
    lat = math.radians(lat_deg)
    suns = sun_samples(lat)
    assert suns.shape == (32, 3)
    np.testing.assert_allclose(np.linalg.norm(suns, axis=1), 1.0, rtol=1e-12)
    assert (np.abs(declination(suns, lat)) <= TILT + 1e-9).all()
    assert (suns[:, 2] > 0.0).all()


@pytest.mark.parametrize("lat_deg", [-60.0, 10.0, 80.0])
def test_the_band_of_azimuths_is_what_a_year_of_days_fills(lat_deg):
    lat, elevation = math.radians(lat_deg), math.radians(8.0)
    dec, hour = np.meshgrid(np.linspace(-TILT, TILT, 401), np.linspace(0, np.pi, 20001))
    sin_el = np.sin(lat) * np.sin(dec) + np.cos(lat) * np.cos(dec) * np.cos(hour)
    near = np.abs(np.arcsin(sin_el) - elevation) < 1e-4
    north = np.cos(lat) * np.sin(dec) - np.sin(lat) * np.cos(dec) * np.cos(hour)
    seen = np.arctan2(np.cos(dec) * np.sin(hour), north)[near]
    band = find_azimuth_band(lat, elevation)
    assert band == pytest.approx((seen.min(), seen.max()), abs=math.radians(0.2))


def test_elevations_run_from_low_to_high_and_stop_at_the_highest_sun():
    elevations = np.degrees(np.arcsin(sun_samples(math.radians(20.0))[::8, 2]))
    np.testing.assert_allclose(elevations, [8.0, 20.333, 32.667, 45.0], atol=1e-2)
    polar = np.degrees(np.arcsin(sun_samples(math.radians(89.0))[::8, 2]))
    assert polar.max() < 2.54
    assert math.degrees(find_highest_sun(math.radians(89.0))) == pytest.approx(2.54)


def test_half_of_the_suns_stand_in_the_east():
    suns = sun_samples(math.radians(-43.0))
    assert (suns[:, 0] > 0).sum() == 16
    np.testing.assert_array_equal(suns, sun_samples(math.radians(-43.0)))


def test_a_sun_that_never_occurs_is_refused():
    assert find_azimuth_band(math.radians(60.0), math.radians(40.0)) is None
    with pytest.raises(ValueError, match="even number"):
        sun_samples(0.0, azimuths=3)
