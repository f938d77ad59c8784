"""At which level and how far to search a control point, from the covariance of the pose."""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray

# Room beyond the stated uncertainty: half a node of rounding and the error of the terrain itself.
MARGIN_NODES = 2.0
# Steps to either side at most: more would take longer than a search without a prior should.
MAX_STEPS = 3


@dataclass(frozen=True)
class Distortion:
    """Rolls (rad) and scales that the picture may have against the reference."""

    rolls: tuple[float, ...] = (0.0,)
    scales: tuple[float, ...] = (1.0,)


NO_DISTORTION = Distortion()


@dataclass(frozen=True)
class SearchPlan:
    """Parameters of a control point's search.

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


def find_finest_level(
    postings_m: FloatArray, metres_per_pixel: float, finest_posting_per_gsd: float
) -> int:
    """Find the finest level that the picture still resolves."""
    fit = np.flatnonzero(postings_m >= finest_posting_per_gsd * metres_per_pixel)
    return int(fit[0]) if len(fit) else len(postings_m) - 1


def choose_template_nodes(posting_m: float, frame_width_m: float, most: int) -> int:
    """Choose the even side of a template, nodes: `most`, or fewer in a narrow frame.

    frame_width_m  ground that the frame's shorter side covers
    """
    # A template wider than 45 % of the frame finds no position whole in it; fewer than 32 nodes
    # match by chance too often.
    fit = int(0.45 * frame_width_m / posting_m) // 2 * 2
    return min(most, max(fit, 32))


def search_room(
    postings_m: FloatArray,
    finest: int,
    uncertainty_m: float,
    search_sigmas: float,
    max_search_nodes: int,
) -> tuple[int, int]:
    """Find the finest level at which the uncertainty (1 sigma, m on the ground) fits the room.

    And the room on every side, nodes of that level.
    """
    # Two levels or fewer have no coarse one to search far at: the finest is searched twice as far.
    if len(postings_m) <= 2:
        max_search_nodes *= 2
    for level in range(finest, len(postings_m)):
        nodes = int(np.ceil(search_sigmas * uncertainty_m / postings_m[level] + MARGIN_NODES))
        if nodes <= max_search_nodes:
            return level, nodes
    return len(postings_m) - 1, max_search_nodes


def plan_distortion(
    template_nodes: int, roll_sigma: float, scale_sigma: float, sigmas: float
) -> Distortion:
    """Plan rolls and scales so that a template's rim is off by a node at most.

    roll_sigma (rad) and scale_sigma (relative) are what the pose leaves open, 1 sigma.
    """
    # A template's rim may be off by one node before a match suffers.
    step = 2.0 * 1.0 / template_nodes
    rolls, scales = _list_steps(sigmas * roll_sigma, step), _list_steps(sigmas * scale_sigma, step)
    if len(rolls) == len(scales) == 1:
        return NO_DISTORTION
    return Distortion(rolls, tuple(1.0 + s for s in scales))


def _list_steps(reach: float, step: float) -> tuple[float, ...]:
    """List symmetric values about zero up to `reach`; only zero when a step covers it."""
    count = min(int(np.ceil(reach / (2.0 * step) - 0.5)), MAX_STEPS)
    if count <= 0:
        return (0.0,)
    spread = max(2.0 * step, reach / count) if count == MAX_STEPS else 2.0 * step
    return tuple(spread * k for k in range(-count, count + 1))


def compute_ground_uncertainty_m(
    jacobian: FloatArray, pose_covariance: FloatArray, metres_per_pixel: FloatArray
) -> FloatArray:
    """Compute the largest 1-sigma ground shift (n,), m, that a pose error causes.

    jacobian (n, 2, 6) of pixels by position (m) and rotation (rad); pose_covariance (6, 6).
    A pixel's shift is turned into metres by the point's mean ground sample distance.
    """
    shift = jacobian @ pose_covariance @ np.swapaxes(jacobian, 1, 2)
    largest = np.linalg.eigvalsh(shift)[:, -1]
    sigma: FloatArray = np.sqrt(np.maximum(largest, 0.0)) * metres_per_pixel
    return sigma
