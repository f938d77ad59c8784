"""What the residuals of a limb cannot show of its errors, as covariance of the position."""

import numpy as np
from numpy.typing import NDArray

from catalog.bodies.body import Body
from optnav_cli.estimation.limb_fit import LimbFit
from optnav_cli.navigation.horizon.sight import Sight

FloatArray = NDArray[np.float64]

# The limb of the Moon (GLD100, 16 cells a degree, 150 places at each of 50, 200, 800, 20 000 km):
# its height over the mean sphere averages 0.9 km, being made of crests, and its covariance between
# two limb points depends on the angle between them at the centre alone, not on the altitude.
MOON_ANGLE_DEG = np.array([0, 1, 2.5, 5, 10, 20, 30, 45, 60, 80, 100, 120, 140, 160, 180.0])
MOON_COVARIANCE_KM2 = np.array(
    [6.2, 5.9, 5.6, 5.3, 4.6, 3.7, 2.9, 1.9, 0.9, 0.1, -0.5, -0.8, -1.1, -1.3, -1.3]
)
MOON_MEAN_KM = 0.9
MOON_HEIGHTS_KM = 24.0  # plausible heights of the Moon, lowest to highest
RELIEF_BINS = 120  # of azimuth, when relief is propagated
# Common to all crests: what the crest correction of a relief of MOON_POSTING_M leaves, and how it
# grows with the cells (lunar relief: rms height over a length ~ length^0.95).
CREST_M, MOON_POSTING_M, HURST = 15.0, 1895.0, 0.95
# Where the Sun is low the faces of crests are half in shadow, whatever the relief knows of it:
# edges stray together by LOW_SUN_PX, falling by e every LOW_SUN_DEG of the Sun's elevation.
LOW_SUN_PX, LOW_SUN_DEG = 0.06, 15.0


def attitude_covariance(position: FloatArray, sigma_rad: float) -> FloatArray:
    """(3, 3) m^2: turning all rays moves the position about the body's centre, heights stay."""
    square = float(position @ position)
    return sigma_rad**2 * (square * np.eye(3) - np.outer(position, position))


def edge_covariance(fit: LimbFit, sight: Sight, sun_sine: FloatArray) -> FloatArray:
    """(3, 3) m^2: an edge error that all points share cannot be told from height.

    sun_sine (n,) sine of the Sun's elevation at each limb point
    """
    shift = fit.gain_m @ (sight.pixel_angle * sight.common_px)
    elevation = np.degrees(np.arcsin(np.clip(sun_sine, 0.0, 1.0)))
    low = fit.gain_m @ (sight.pixel_angle * LOW_SUN_PX * np.exp(-elevation / LOW_SUN_DEG))
    return np.asarray(np.outer(shift, shift) + np.outer(low, low))


def crest_sigma_m(posting_m: float) -> float:
    """What the crest correction of a relief of this posting may leave on all crests, m."""
    return float(CREST_M * max(posting_m / MOON_POSTING_M, 1.0) ** HURST)


def crest_covariance(fit: LimbFit, crest_m: float, distances_m: FloatArray) -> FloatArray:
    """(3, 3) m^2: all crests higher by one sigma, at distances (n,) from the camera."""
    shift = fit.gain_m @ (crest_m / distances_m)
    return np.outer(shift, shift)


def relief_covariance(
    fit: LimbFit, body: Body, azimuths: FloatArray, distances_m: FloatArray, circle: float
) -> FloatArray:
    """(3, 3) m^2: what a body's relief does to the fit of its bare ellipsoid.

    azimuths, distances_m (n,) of the rays;  circle  rad, angle at the body's centre from the nadir
    to the limb. Bodies other than the Moon take its statistics in units of their plausible heights.
    """
    low, high = body.plausible_heights_m
    unit = (high - low) / MOON_HEIGHTS_KM
    bins = np.floor((azimuths / (2.0 * np.pi) + 0.5) * RELIEF_BINS).astype(np.int64) % RELIEF_BINS
    gain = np.stack([np.bincount(bins, row / distances_m, RELIEF_BINS) for row in fit.gain_m])
    at = 2.0 * np.pi * np.arange(RELIEF_BINS) / RELIEF_BINS
    cosine = np.cos(circle) ** 2 + np.sin(circle) ** 2 * np.cos(at[:, None] - at[None, :])
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    covariance = np.interp(angle, MOON_ANGLE_DEG, MOON_COVARIANCE_KM2) + MOON_MEAN_KM**2
    return np.asarray(gain @ (covariance * unit**2) @ gain.T)
