"""How large a small disc is, from how wide its light is spread: the disc's and the blur's together.

Neither the brightness law nor, where the camera's file does not say it, the blur is known: all that
fit the second moments are weighed by their likelihood.
"""

from dataclasses import dataclass
from functools import cache

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.config import Positive, load_toml, resource
from optnav_cli.outline.disc.moments import DiscMoments, LightMoments

RADII = 200  # first over all of them, then over the likely ones
UNLIKELY = 1e-6  # of the likeliest
FILE = "configs/models/disc.toml"


class DiscErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fitted numbers of FILE, which says what each is; law_prior is in the order of LAWS."""

    blur_px: Positive
    blur_sigma_px: Positive
    blur_shape: Positive
    blur_centre: Positive
    law_prior: tuple[Positive, Positive, Positive, Positive, Positive]
    figure: Positive
    law: Positive
    relief: Positive
    ellipsoid: Positive
    shadow_power: Positive
    drawing_px: Positive


@cache
def load_disc_sizes() -> DiscErrorSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), DiscErrorSizes)


def blur_prior(known_blur_px: tuple[float, float] | None) -> tuple[float, float]:
    """Blur with the pixel's own width and its 1-sigma error, px, also where it is not known."""
    sizes = load_disc_sizes()
    return known_blur_px or (sizes.blur_px, sizes.blur_sigma_px)


@dataclass(frozen=True, eq=False)
class DiscSize:
    """Posterior distribution of a disc's radius.

    radii_px      (n,)
    weights       (laws, n) how likely each is under each law; their sum is 1
    width_sigmas  by which the likeliest of all is likelier than a point
    misfit_sigmas by which even that one is off
    """

    radii_px: FloatArray
    weights: FloatArray
    width_sigmas: float
    misfit_sigmas: float


def estimate_radius(
    disc: DiscMoments,
    pixel_from_disc: FloatArray,
    moments: list[LightMoments],
    shape_sigma: float,
    known_blur_px: tuple[float, float] | None,
) -> DiscSize:
    """Weigh radii by a disc's second moments.

    pixel_from_disc  (2, 2) of area 1, from the axes of `moments`: toward the Sun and across
    moments          of each law, for a mean radius of 1
    shape_sigma      what the body's shape may differ from the known one, of the radius
    known_blur_px    sigma of the blur and its 1-sigma error; None where not known
    """
    a, b, c, d = np.linalg.inv(pixel_from_disc).ravel()
    # xx, yy and xy of the picture's axes to those of the disc's
    turn = np.array(
        [[a * a, b * b, 2 * a * b], [c * c, d * d, 2 * c * d], [a * c, b * d, a * d + b * c]]
    )
    second, noise = turn @ disc.second, turn @ disc.second_covariance @ turn.T
    round_blur = turn @ np.array([1.0, 1.0, 0.0])
    middle, sigma = blur_prior(known_blur_px)
    # Blurs up to 3.5 sigmas off are weighed.
    reach = 3.5 * sigma
    blurs = np.linspace(max(middle - reach, 0.0), middle + reach, 51)

    def weigh(radii: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Logarithms (laws, n) of how likely radii are, and squared misfits at the best blur."""
        blur_misfit = ((blurs - middle) / sigma) ** 2
        area = radii[:, None] ** 2
        logs = np.empty((len(moments), len(radii)))
        squares = np.empty(logs.shape)
        for k, light in enumerate(moments):
            along, beside = light.second[0, 0], light.second[1, 1]
            shape = np.array([along, beside, light.second[0, 1]])
            # a shape that is not the known one changes its moments by twice its share, and its
            # shadows by half as much again
            off = 3.0 * shape_sigma * np.array([along, beside, 0.5 * np.sqrt(along * beside)])
            covariance = noise + (area**2)[..., None] * np.diag(off**2)
            miss = second - area[..., None] * shape - blurs[:, None] ** 2 * round_blur
            inverse = np.linalg.inv(covariance)
            total = np.einsum("rbi,rij,rbj->rb", miss, inverse, miss) + blur_misfit
            squares[k] = total.min(axis=1)
            each = -0.5 * (total + np.log(np.linalg.det(covariance))[:, None])
            logs[k] = np.logaddexp.reduce(each, axis=1) + np.log(load_disc_sizes().law_prior[k])
        return logs, squares

    # Equal steps of the logarithm of the radius, 0.3 to 30 px, are equally likely.
    radii = np.geomspace(0.3, 30.0, RADII)
    logs, _ = weigh(radii)
    point = float(logs[:, 0].max())
    likely = np.flatnonzero((logs > logs.max() + np.log(UNLIKELY)).any(axis=0))
    low, high = max(int(likely[0]) - 1, 0), min(int(likely[-1]) + 1, RADII - 1)
    radii = np.geomspace(radii[low], radii[high], RADII)
    logs, squares = weigh(radii)
    best = float(logs.max())
    weights = np.exp(logs - best)
    weights /= weights.sum()
    return DiscSize(
        radii, weights, float(np.sqrt(2.0 * max(best - point, 0.0))), float(np.sqrt(squares.min()))
    )
