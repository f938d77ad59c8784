"""Pictures of one cylinder under one lamp: their cloth and the lamp's width are alike in all.

Where the whole face is lit, a picture alone hardly tells the angle of the light from the gloss and
roughness of the cloth: 0.1 to 0.2 deg, 2 to 5 mm at 1.3 m, which changes within 5 deg of light. Of
pictures from several sides one cloth fits all. Speeds by neighbours take that.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.cylinder.fit import (
    DISTANCE,
    EXPECTED,
    LIGHT,
    LINEAR,
    SIGMAS,
    SOURCE,
    THETA,
    UNKNOWNS,
    WIDTH_SIGMAS,
    WIDTHS,
    CylinderFit,
)
from optnav_cli.cylinder.geometry import CRESCENT_DEG, load_error_sizes
from optnav_cli.estimation.least_squares import inverse_of

PLACE = np.array([DISTANCE, THETA])
# by its share of the light: what departs from Lambert's law; the blur may change with the focus
CLOTH = np.array([SOURCE, *range(LIGHT + 1, UNKNOWNS)])
CLOTH_EXPECTED = np.array([WIDTHS[1], *EXPECTED[LIGHT + 1 - LINEAR :]])
CLOTH_SIGMAS = np.array([WIDTH_SIGMAS[1], *SIGMAS[LIGHT + 1 - LINEAR :]])
ROUNDS = 2  # of weights by how far the cloth of a picture is from that of all


@dataclass(frozen=True, eq=False)
class SeriesPlace:
    """Where the camera is, about the axis, with the cloth of all pictures of a series.

    position   (2,) m: x towards the light, y where theta grows
    noise      (2, 2) m², the picture's own errors
    by_theta   (2,) m, of the sigma of what errors of theta pictures of one cloth have in common
    by_cloth   (2, k) m, of the cloth's sigmas, which are the same for all
    """

    position: FloatArray
    noise: FloatArray
    by_theta: FloatArray
    by_cloth: FloatArray


def place_series(fits: Sequence[CylinderFit]) -> list[SeriesPlace]:
    """Locate the camera in pictures of one cylinder under one lamp."""
    if not fits:
        return []
    cloth, covariance, doubts = _estimate_cloth(fits)
    root = np.linalg.cholesky(covariance).astype(np.float64)
    return [
        _place_picture(fit, cloth, root, doubt) for fit, doubt in zip(fits, doubts, strict=True)
    ]


def _estimate_cloth(fits: Sequence[CylinderFit]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Estimate the cloth (k,) of all pictures, its covariance, and each picture's doubt (n,).

    Cloth and lamp that the model does not have lead neighbouring pictures astray alike: all of
    them count as one. A picture whose cloth is another one, by its errors, counts for less.
    """
    prior = np.diag(CLOTH_SIGMAS**-2.0)
    known = [inverse_of(fit.state_covariance[np.ix_(CLOTH, CLOTH)]) for fit in fits]
    states = [fit.state[CLOTH] for fit in fits]
    is_usable = np.array([abs(math.degrees(fit.theta)) <= CRESCENT_DEG for fit in fits])
    doubts = np.ones(len(fits))
    for _ in range(ROUNDS):
        shares = is_usable / doubts / max(int(is_usable.sum()), 1)
        normal, right = prior.copy(), prior @ CLOTH_EXPECTED
        for share, information, cloth in zip(shares, known, states, strict=True):
            normal += share * (information - prior)
            right += share * (information @ cloth - prior @ CLOTH_EXPECTED)
        covariance = inverse_of(normal)
        cloth_of_all = covariance @ right
        off = [
            (cloth - cloth_of_all) @ information_of_fit @ (cloth - cloth_of_all)
            for cloth, information_of_fit in zip(states, known, strict=True)
        ]
        doubts = np.maximum(np.array(off) / len(CLOTH), 1.0)
    return cloth_of_all, covariance, doubts


def _place_picture(
    fit: CylinderFit, cloth: FloatArray, root: FloatArray, doubt: float
) -> SeriesPlace:
    """Locate the camera in a picture with the cloth of all, whose covariance has a root (k, k)."""
    state_covariance = fit.state_covariance
    by_cloth = state_covariance[np.ix_(PLACE, CLOTH)] @ inverse_of(
        state_covariance[np.ix_(CLOTH, CLOTH)]
    )
    distance, theta = fit.state[PLACE] + by_cloth @ (cloth - fit.state[CLOTH])
    # errors with the cloth held: of the place less what the cloth's errors make of it
    held = np.zeros((2, UNKNOWNS))
    held[[0, 1], PLACE] = 1.0
    held[:, CLOTH] = -by_cloth
    noise = held @ fit.state_noise @ held.T
    stated = max(fit.misfit, 1.0) ** 2 * doubt * (held @ state_covariance @ held.T)
    # the distance errs as the edges fall on the pixels, in each picture otherwise, theta with it
    along = stated[:, 0] / math.sqrt(stated[0, 0])
    left = math.sqrt(max(stated[1, 1] - along[1] ** 2 - noise[1, 1], 0.0))
    noise += np.outer(along, along)
    noise += np.diag(load_error_sizes().compute_variances(float(theta), float(distance)))
    cosine, sine = math.cos(theta), math.sin(theta)
    turned = np.array([[cosine, -distance * sine], [sine, distance * cosine]])
    return SeriesPlace(
        distance * np.array([cosine, sine]),
        turned @ noise @ turned.T,
        left * turned[:, 1],
        turned @ by_cloth @ root,
    )


def compute_velocity(
    places: Sequence[SeriesPlace], weights: FloatArray
) -> tuple[float, float, float]:
    """Weigh places (n,) by weights (n,), 1/s: a velocity, m/s, and its sigma per component."""
    pairs = list(zip(weights, places, strict=True))
    velocity = np.sum([weight * located.position for weight, located in pairs], axis=0)
    variance_of_noise = sum(weight**2 * float(np.trace(located.noise)) for weight, located in pairs)
    common = np.sum([weight * located.by_theta for weight, located in pairs], axis=0)
    cloth = np.sum([weight * located.by_cloth for weight, located in pairs], axis=0)
    variance = variance_of_noise + float(np.sum(common**2) + np.sum(cloth**2))
    return float(velocity[0]), float(velocity[1]), math.sqrt(variance / 2.0)
