"""At which level and how far to search a control point, from the covariance of the pose."""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray

# Room beyond the stated uncertainty: half a node of rounding and the error of the terrain itself.
MARGIN_NODES = 2.0
# A template's rim may be off by so many nodes before a match suffers.
RIM_NODES = 1.0
# Steps to either side at most: more would take longer than a search without a prior should.
MAX_STEPS = 3
# A template wider than this share of the frame finds no place whole in it.
MAX_TEMPLATE = 0.45
# Fewer nodes match by chance too often.
MIN_TEMPLATE_NODES = 32
# Where patches have so few levels there is no coarse one to search far at: the finest is searched
# so many times as far.
FEW_LEVELS, WIDER = 2, 2


@dataclass(frozen=True)
class Distortion:
    """Rolls (rad) and scales that the picture may have against the reference."""

    rolls: tuple[float, ...] = (0.0,)
    scales: tuple[float, ...] = (1.0,)


NO_DISTORTION = Distortion()


@dataclass(frozen=True)
class SearchPlan:
    """How a control point is searched.

    level             of its patches
    template_nodes    side of the reference;  search_nodes  room on every side, nodes of the level
    metres_per_pixel  ground sample distance at the point
    distortion        rolls and scales to try, where the pose may be off by so much that it shows
    blur_nodes        sigma of a blur on both sides, where patches are finer than what is known
    interim           whether finer levels follow, for which a rough covariance will do
    soft_nodes        sigma of a blur of the picture alone, where the terrain model is oversampled
    """

    level: int
    template_nodes: int
    search_nodes: int
    metres_per_pixel: float
    distortion: Distortion = NO_DISTORTION
    blur_nodes: float = 0.0
    interim: bool = False
    soft_nodes: float = 0.0


def finest_level(
    postings_m: FloatArray, metres_per_pixel: float, finest_posting_per_gsd: float
) -> int:
    """The finest level that the picture still resolves."""
    fit = np.flatnonzero(postings_m >= finest_posting_per_gsd * metres_per_pixel)
    return int(fit[0]) if len(fit) else len(postings_m) - 1


def template_nodes(posting_m: float, frame_width_m: float, most: int) -> int:
    """Side of a template, nodes, even: `most`, or fewer where the frame is not much wider.

    frame_width_m  ground that the frame's shorter side covers
    """
    fit = int(MAX_TEMPLATE * frame_width_m / posting_m) // 2 * 2
    return min(most, max(fit, MIN_TEMPLATE_NODES))


def search_room(
    postings_m: FloatArray,
    finest: int,
    uncertainty_m: float,
    search_sigmas: float,
    max_search_nodes: int,
) -> tuple[int, int]:
    """The finest level at which the uncertainty (1 sigma, m on the ground) fits the search room.

    And the room on every side, nodes of that level.
    """
    if len(postings_m) <= FEW_LEVELS:
        max_search_nodes *= WIDER
    for level in range(finest, len(postings_m)):
        nodes = int(np.ceil(search_sigmas * uncertainty_m / postings_m[level] + MARGIN_NODES))
        if nodes <= max_search_nodes:
            return level, nodes
    return len(postings_m) - 1, max_search_nodes


def plan_distortion(
    template_nodes: int, roll_sigma: float, scale_sigma: float, sigmas: float
) -> Distortion:
    """Rolls and scales to try so that a template's rim is never off by more than a node or so.

    roll_sigma (rad) and scale_sigma (relative) are what the pose leaves open, 1 sigma.
    """
    step = 2.0 * RIM_NODES / template_nodes
    rolls, scales = _steps(sigmas * roll_sigma, step), _steps(sigmas * scale_sigma, step)
    if len(rolls) == len(scales) == 1:
        return NO_DISTORTION
    return Distortion(rolls, tuple(1.0 + s for s in scales))


def _steps(reach: float, step: float) -> tuple[float, ...]:
    """Symmetric values about zero up to about `reach`; zero alone when a step covers it."""
    count = min(int(np.ceil(reach / (2.0 * step) - 0.5)), MAX_STEPS)
    if count <= 0:
        return (0.0,)
    spread = max(2.0 * step, reach / count) if count == MAX_STEPS else 2.0 * step
    return tuple(spread * k for k in range(-count, count + 1))


def ground_uncertainty_m(
    jacobian: FloatArray, pose_covariance: FloatArray, metres_per_pixel: FloatArray
) -> FloatArray:
    """Largest 1-sigma shift on the ground (n,), m, that a pose error causes in the picture.

    jacobian (n, 2, 6) of pixels by position (m) and rotation (rad); pose_covariance (6, 6).
    A pixel's shift is turned into metres by the point's mean ground sample distance.
    """
    shift = jacobian @ pose_covariance @ np.swapaxes(jacobian, 1, 2)
    largest = np.linalg.eigvalsh(shift)[:, -1]
    sigma: FloatArray = np.sqrt(np.maximum(largest, 0.0)) * metres_per_pixel
    return sigma
