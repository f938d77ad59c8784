"""When a solved pose is believed. A guess is never a solution.

Least squares gives a pose for any matches, and searching again around a wrong pose finds new
matches that agree with it. Three things give a guess away: the places scatter more than their
stated errors, the scores are such as chance finds too, or the pose is where it cannot be. The
second is an a-contrario test (Desolneux, Moisan, Morel, "Meaningful alignments", IJCV 2000): how
often would unrelated ground offer as many scores as good as these?
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaln
from scipy.stats import chi2

from optnav_cli.estimation.resection import Pose
from optnav_cli.estimation.robust import RobustResection

FloatArray = NDArray[np.float64]

# Best scores on unrelated ground, from 14 000 searches of other, mirrored and random pictures
# with templates of 80 and 32 nodes: score x nodes a side / sqrt(6) passes CHANCE_LEVEL + d
# CHANCE_DECADE in at most one search of 10^d.
CHANCE_NODES_PER_SAMPLE = 6.0
CHANCE_LEVEL = 4.0
CHANCE_DECADE = 2.1
# Matches that chance could offer more often than once in 10^6 frames are no evidence.
LEAST_DECADES = 6.0
# Small templates under a low Sun err by twice their stated sigma and are still right.
MOST_VARIANCE_FACTOR = 9.0
# As improbable is a distance from the prior that this share of right priors exceeds.
PRIOR_PROBABILITY = 1e-6
# A search always has room for a few nodes more, so a prior with a tiny sigma may be off by so much.
PRIOR_FLOOR_M = 1000.0


def independent_side(template_nodes: int, blur_nodes: float) -> float:
    """Side of a template that tells as much against chance and is not blurred, nodes.

    White noise under a Gaussian of sigma s is alike over an area of 2 pi s^2 nodes.
    """
    area = CHANCE_NODES_PER_SAMPLE + 2.0 * np.pi * blur_nodes**2
    return float(template_nodes * np.sqrt(CHANCE_NODES_PER_SAMPLE / area))


def decades_against_chance(scores: ArrayLike, tried: int, template_nodes: float) -> float:
    """How many powers of ten speak against chance for the scores of the used points.

    scores          (k,) of the points that the solution uses
    tried           number of points searched, k or more: picking k of them helps chance
    template_nodes  side of the reference, of nodes that err each for itself
    """
    scores = np.asarray(scores, dtype=np.float64)
    strength = scores * template_nodes / np.sqrt(CHANCE_NODES_PER_SAMPLE)
    each = np.maximum(strength - CHANCE_LEVEL, 0.0) / CHANCE_DECADE
    k, n = len(scores), max(tried, len(scores))
    choices = gammaln(n + 1.0) - gammaln(k + 1.0) - gammaln(n - k + 1.0)
    return float(each.sum() - choices / np.log(10.0))


def doubt_of_matches(
    solution: RobustResection, scores: ArrayLike, tried: int, template_nodes: float
) -> str:
    """Why the matches do not carry the solution; empty when they do.

    Arguments as `decades_against_chance`.
    """
    used = int(solution.used.sum())
    if solution.resection.degrees_of_freedom < 1:
        return f"{used} control points leave no check on a free attitude; at least 4 are needed"
    if solution.variance_factor > MOST_VARIANCE_FACTOR:
        return (
            f"the matches scatter {np.sqrt(solution.variance_factor):.1f} times as wide as they "
            "should: they do not belong to one position"
        )
    decades = decades_against_chance(scores, tried, template_nodes)
    if decades < LEAST_DECADES:
        return f"{used} of {tried} control points agree, no more than by chance"
    return ""


def doubt_of_place(
    pose: Pose,
    covariance_m2: FloatArray,
    prior_position_m: FloatArray,
    prior_covariance_m2: FloatArray,
) -> str:
    """Why the position cannot be true, given where the prior was; empty when it can.

    covariance_m2        (3, 3) of the pose's position
    prior_covariance_m2  (3, 3) of the prior's
    """
    offset = pose.position_m - prior_position_m
    spread = covariance_m2 + prior_covariance_m2 + np.eye(3) * PRIOR_FLOOR_M**2
    if float(offset @ np.linalg.solve(spread, offset)) < chi2.isf(PRIOR_PROBABILITY, 3):
        return ""
    sigma = float(np.sqrt(np.trace(prior_covariance_m2) / 3.0))
    return (
        f"the matches put the camera {np.linalg.norm(offset) / 1e3:.1f} km from the prior, whose "
        f"sigma is {sigma / 1e3:.1f} km: the prior, its sigma or the camera file is wrong"
    )
