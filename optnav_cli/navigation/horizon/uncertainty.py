"""What the residuals of a limb cannot show of its errors, as covariance of the position."""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.body import Body
from optnav_cli.estimation.limb_fit import LimbFit
from optnav_cli.navigation.horizon.sight import LimbRays

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
# The light of the ground about a crest moves edges together over some tens of degrees, differently
# from place to place: limbs of a known skyline, from 50 to 200 km, show 0.05 px at 5 deg of Sun,
# 0.02 from 10 to 40 and 0.01 above.
SECTOR_DEG = 30.0
SECTOR_PX, SECTOR_LOW_PX, SECTOR_FALL_DEG = 0.013, 0.09, 6.0


def attitude_covariance(position: FloatArray, sigma_rad: float) -> FloatArray:
    """(3, 3) m^2: turning all rays moves the position about the body's centre, heights stay."""
    square = float(position @ position)
    return sigma_rad**2 * (square * np.eye(3) - np.outer(position, position))


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """What the edges of a limb have wrong together.

    shapes (n, k)  rad, one sigma of each of k errors
    """

    shapes: FloatArray

    def with_constant(self, angle: float) -> "SharedErrors":
        """The same and one more error, of one angle (rad) at all points."""
        more = np.full((len(self.shapes), 1), angle)
        return SharedErrors(np.concatenate([self.shapes, more], axis=1))

    def with_sectors(self, azimuths: FloatArray, angle: float) -> "SharedErrors":
        """The same and an error of one angle (rad) in each sector about the nadir.

        azimuths (n,) rad
        """
        more = np.where(np.stack(_sectors(azimuths), axis=1), angle, 0.0)
        return SharedErrors(np.concatenate([self.shapes, more], axis=1))


def _sectors(azimuths: FloatArray) -> list[BoolArray]:
    """Which azimuths (n,) about the nadir, rad, lie in each sector of SECTOR_DEG."""
    count = round(360.0 / SECTOR_DEG)
    sector = np.floor((azimuths / (2.0 * np.pi) + 0.5) * count).astype(np.int64) % count
    return [sector == number for number in range(count)]


def edge_errors(sight: LimbRays, azimuths: FloatArray, sun_sine: FloatArray) -> SharedErrors:
    """What the edges have wrong together by their light.

    azimuths (n,) about the nadir;  sun_sine (n,) sine of the Sun's elevation at each limb point
    """
    elevation = np.degrees(np.arcsin(np.clip(sun_sine, 0.0, 1.0)))
    size = SECTOR_PX + SECTOR_LOW_PX * np.exp(-elevation / SECTOR_FALL_DEG)
    shapes = [np.full(len(sight), sight.common_px)]
    shapes += [np.where(part, size, 0.0) for part in _sectors(azimuths)]
    return SharedErrors(np.asarray(np.stack(shapes, axis=1) * sight.pixel_angle[:, None]))


def with_shared_errors(fit: LimbFit, errors: SharedErrors) -> tuple[FloatArray, FloatArray]:
    """Position (3,), m, and covariance (3, 3) when points share errors of known shapes.

    The sizes of the shapes are unknowns with a prior of one sigma, solved for beside the position:
    those that the residuals show are taken out, the others remain in the covariance. How much the
    residuals can show goes by the sandwich, not by the stated noise.
    """
    shift = fit.gain_m @ errors.shapes
    seen = errors.shapes + fit.rates @ shift  # what the fit leaves of each shape in the residuals
    excess = max(float(np.trace(np.linalg.solve(fit.noise_m2, fit.covariance_m2))) / 3.0, 1.0)
    weighted = seen * (fit.information / excess)[:, None]
    spread = np.linalg.inv(np.eye(seen.shape[1]) + weighted.T @ seen)
    found = spread @ (weighted.T @ fit.residuals)
    position = fit.position_m - shift @ found
    return position, fit.covariance_m2 + shift @ spread @ shift.T


def relief_covariance(
    fit: LimbFit, body: Body, azimuths: FloatArray, distance_m: float, circle: float
) -> FloatArray:
    """(3, 3) m^2: what a body's relief does to the fit of its bare ellipsoid.

    azimuths (n,) of the rays;  distance_m  to the limb;  circle  rad, angle at the body's centre
    from the nadir to the limb. Bodies other than the Moon take its statistics in units of their
    plausible heights.
    """
    low, high = body.plausible_heights_m
    unit = (high - low) / MOON_HEIGHTS_KM
    bins = np.floor((azimuths / (2.0 * np.pi) + 0.5) * RELIEF_BINS).astype(np.int64) % RELIEF_BINS
    gain = np.stack([np.bincount(bins, row / distance_m, RELIEF_BINS) for row in fit.gain_m])
    at = 2.0 * np.pi * np.arange(RELIEF_BINS) / RELIEF_BINS
    cosine = np.cos(circle) ** 2 + np.sin(circle) ** 2 * np.cos(at[:, None] - at[None, :])
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    covariance = np.interp(angle, MOON_ANGLE_DEG, MOON_COVARIANCE_KM2) + MOON_MEAN_KM**2
    return np.asarray(gain @ (covariance * unit**2) @ gain.T)
