"""When a solved pose is accepted.

Least squares gives a pose for any matches, and searching again around a wrong pose finds new
matches that agree with it. A pose is refused when the places scatter more than their stated
errors, when chance finds such scores too, when the ground is lit from another side than the Sun
that is stated, or when it lies where it cannot be. The second is an a-contrario test (Desolneux,
Moisan, Morel, "Meaningful alignments", IJCV 2000): how often would unrelated ground offer as many
scores as good as these? The third is ours: the same ground lit from another side still correlates,
a crater's width aside, and in many points at once, which no test against chance refuses.

A search near its place has no room for a rival, and any pattern has a highest score in it: smooth
brightness scores 0.4 to 0.5 anywhere. So points are searched again about the solved pose, farther,
until those that are unambiguous there carry it (`drop_disproven`).

The limits are fitted numbers, in FILE.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, gammaln

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.config import Positive, load_toml, resource
from catalog.correlation.filters import filter_grid
from catalog.correlation.ncc import correlate_grids
from catalog.geometry.vectors import squared_distance
from optnav_cli.control_points.point_match import CHANCE_NODES_PER_SAMPLE, SeenPart
from optnav_cli.estimation.resection import Resection
from optnav_cli.fix import PositionPrior
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

FILE = "configs/models/acceptance.toml"
# Room to every side of a proof, nodes: three times as many places as a peak itself takes.
PROOF_NODES = 12
# Side of the grid on which parts of the frame are counted: a template spans dozens of its cells.
CELLS = 128


class _Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A section of FILE, which says what each number is."""


class ChanceLaw(_Limits, frozen=True):
    """Distribution of scores that unrelated ground offers."""

    level: Positive
    decade: Positive
    part_level: Positive
    part_decade: Positive
    near_postings: Positive


class DecadeLimits(_Limits, frozen=True):
    """Powers of ten against chance that matches must have."""

    least: Positive
    least_of_parts: Positive
    least_of_near_parts: Positive


class ScatterLimits(_Limits, frozen=True):
    """Variance factors that matches may have."""

    points: Positive
    parts: Positive


class PartLimits(_Limits, frozen=True):
    """Number of parts of templates behind a blur that a solution needs."""

    fewest: Annotated[int, msgspec.Meta(ge=2)]


class LightLimits(_Limits, frozen=True):
    """When the light contradicts the stated Sun."""

    nodes: Positive
    points: Positive
    gain: Positive
    agreeing_gain: Positive
    agreement: Positive
    turn_deg: Positive


class PriorLimits(_Limits, frozen=True):
    """When a place contradicts the prior."""

    probability: Positive
    floor_m: Positive


class AcceptanceLimits(_Limits, frozen=True):
    """The numbers of FILE."""

    chance: ChanceLaw
    decades: DecadeLimits
    scatter: ScatterLimits
    parts: PartLimits
    light: LightLimits
    prior: PriorLimits


@cache
def load_acceptance_limits() -> AcceptanceLimits:
    """Load the limits that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), AcceptanceLimits)


def compute_decades(scores: ArrayLike, tried: int, template_nodes: ArrayLike) -> float:
    """Compute powers of ten against chance that the scores of the used points give.

    scores          (k,) of the points that the solution uses
    tried           number of points searched, k or more: picking k of them helps chance
    template_nodes  (k,) sides of the references, of nodes that err each for itself
    """
    chance = load_acceptance_limits().chance
    scores = np.asarray(scores, dtype=np.float64)
    strength = scores * np.asarray(template_nodes) / np.sqrt(CHANCE_NODES_PER_SAMPLE)
    each = np.maximum(strength - chance.level, 0.0) / chance.decade
    return float(each.sum()) - _count_choices(len(scores), tried)


def compute_part_decades(
    strengths: ArrayLike, own_shares: ArrayLike, tried: int, searched_postings: float
) -> float:
    """Compute powers of ten against chance for templates behind a blur, whose parts may overlap.

    strengths   (k,) scores times the root of the samples that were compared
    own_shares  (k,) of each one's evidence, see `compute_evidence_shares`
    tried       number of points searched, k or more
    searched_postings  how far the first search went, in postings of the terrain model
    """
    chance = load_acceptance_limits().chance
    strengths = np.asarray(strengths, dtype=np.float64)
    each = np.maximum(strengths - chance.part_level, 0.0) / chance.part_decade
    # so many times as many places were offered as where the law was measured
    each = np.maximum(
        each - 2.0 * np.log10(max(searched_postings / chance.near_postings, 1.0)), 0.0
    )
    shares = np.asarray(own_shares, dtype=np.float64)
    # points that see the same ground are not chosen one by one either
    return float((each * shares).sum() - _count_choices(len(strengths), tried) * shares.mean())


def _count_choices(used: int, tried: int) -> float:
    """Count the ways to pick the used points of those tried, as powers of ten."""
    offered = max(tried, used)
    choices = gammaln(offered + 1.0) - gammaln(used + 1.0) - gammaln(offered - used + 1.0)
    return float(choices / np.log(10.0))


def check_matches(
    solution: Resection,
    decades: float,
    tried: int,
    min_decades: float,
    max_factor: float,
) -> Reason:
    """Check that the matches support the solution; return the reason where not.

    decades  against chance, of `compute_decades` or `compute_part_decades`;  tried as there
    """
    used = int(solution.used.sum())
    if solution.degrees_of_freedom < 1:
        text = f"{used} control points leave no check on a free attitude; at least 4 are needed"
        return Reason(ReasonCode.FEW_POINTS, text)
    if solution.variance_factor > max_factor:
        return Reason(
            ReasonCode.POINTS_DISAGREE,
            f"the matches scatter {np.sqrt(solution.variance_factor):.1f} times as wide as they "
            "should: they do not belong to one position",
        )
    if decades < min_decades:
        text = f"{used} of {tried} control points agree, no more than by chance"
        return Reason(ReasonCode.BY_CHANCE, text)
    return NO_REASON


def check_parts(used: int) -> Reason:
    """Check that there are enough parts of templates behind a blur; return the reason if not."""
    fewest = load_acceptance_limits().parts.fewest
    if used >= fewest:
        return NO_REASON
    text = f"{used} control points, seen in parts, agree; at least {fewest} are needed"
    return Reason(ReasonCode.FEW_POINTS, text)


def check_position(
    position_m: FloatArray, covariance_m2: FloatArray, prior: PositionPrior
) -> Reason:
    """Check a position (3,) with covariance (3, 3) against its prior; return the contradiction."""
    limits = load_acceptance_limits().prior
    offset = position_m - prior.position_m
    spread = covariance_m2 + prior.covariance_m2 + np.eye(3) * limits.floor_m**2
    if squared_distance(offset, spread) < chdtri(3, limits.probability):
        return NO_REASON
    sigma = float(np.sqrt(np.trace(prior.covariance_m2) / 3.0))
    return Reason(
        ReasonCode.FAR_FROM_PRIOR,
        f"the matches put the camera {np.linalg.norm(offset) / 1e3:.1f} km from the prior, whose "
        f"sigma is {sigma / 1e3:.1f} km: the prior, its sigma or the camera file is wrong",
    )


def draw_footprints(parts: Sequence[SeenPart], frame_size_px: tuple[int, int]) -> BoolArray:
    """Draw what each part covers of the frame, (n, CELLS, CELLS).

    frame_size_px  (width, height)
    """
    scale = CELLS / np.array(frame_size_px, dtype=np.float64)
    masks = np.zeros((len(parts), CELLS, CELLS), dtype=np.uint8)
    for mask, part in zip(masks, parts, strict=True):
        corners = np.rint((part.corners_px + 0.5) * scale - 0.5)
        if np.isfinite(corners).all():
            # far corners of an oblique template are cut where integers end
            cv2.fillConvexPoly(mask, np.clip(corners, -1e6, 1e6).astype(np.int32), 1)
    return masks.astype(bool)


def compute_evidence_shares(masks: BoolArray) -> FloatArray:
    """Compute the share (n,) of each part's evidence: ground seen k times counts once."""
    times = masks.sum(axis=0)
    each = masks / np.maximum(times, 1)
    shares: FloatArray = each.sum(axis=(1, 2)) / np.maximum(masks.sum(axis=(1, 2)), 1)
    return shares


class PointLight(NamedTuple):
    """Direction of the light on a point's ground, as its picture shows.

    stated  share of the contrast that the template under the stated Sun explains, at its best place
    free    share that light of any azimuth explains, at the best place of that
    along, across  that light: as much of the stated Sun, as much of one 90 deg counter-clockwise
    """

    stated: float
    free: float
    along: float
    across: float


def measure_light(
    template: Float32Array, aside: Float32Array, window: Float32Array, margin_nodes: int
) -> PointLight:
    """Measure the light on a template's ground from the picture where it was matched.

    template, aside (n, n)  under the stated Sun and under one whose azimuth is 90 deg on
    window (m, m)           of the picture, m - n even;  margin_nodes  of all three, as `match_ncc`

    Shading is linear in the horizontal part of the Sun's direction, but for shadows: whatever the
    azimuth, the contrast is nearly a sum of the two templates, and is fitted as one.
    """
    image = filter_grid(window, margin_nodes=margin_nodes)
    pair = [filter_grid(grid, margin_nodes=margin_nodes) for grid in (template, aside)]
    # what has no contrast scores -1
    first, second = (np.where(c > -1.0, c, 0.0) for c in (correlate_grids(g, image) for g in pair))
    values = [grid.values - grid.values.mean() for grid in pair]
    size = [float(np.sqrt(np.mean(grid**2))) for grid in values]
    if min(size) <= max(grid.floor for grid in pair):
        return PointLight(0.0, 0.0, 0.0, 0.0)  # a plain has no side
    common = float(np.mean(values[0] * values[1])) / (size[0] * size[1])
    alone = max(1.0 - common**2, 0.1)  # else the azimuth shows in hardly anything
    shares = (first**2 + second**2 - 2.0 * common * first * second) / alone
    at = np.unravel_index(int(np.argmax(shares)), shares.shape)
    towards_sun, sideways = float(first[at]), float(second[at])
    stated = max(float(first.max()), 0.0) ** 2
    along, across = (
        (towards_sun - common * sideways) / size[0],
        (sideways - common * towards_sun) / size[1],
    )
    length = max(float(np.hypot(along, across)), 1e-30)
    return PointLight(stated, float(shares[at]), along / length, across / length)


def check_light(lights: Sequence[PointLight]) -> Reason:
    """Check the light on some points against the stated Sun; return the contradiction."""
    stated, free, along, across = np.reshape(lights, (-1, 4)).T
    sideways, towards = float(free @ across), float(free @ along)
    turn_deg = float(np.degrees(np.arctan2(sideways, towards)))
    limits = load_acceptance_limits().light
    agree = np.hypot(sideways, towards) >= limits.agreement * free.sum()
    gain = limits.agreeing_gain if agree else limits.gain
    if free.sum() <= gain * stated.sum() or abs(turn_deg) < limits.turn_deg:
        return NO_REASON
    way = "counter-clockwise" if turn_deg > 0.0 else "clockwise"
    return Reason(
        ReasonCode.WRONG_SUN,
        f"the ground is lit from about {abs(turn_deg):.0f} deg {way} (seen from above) of the "
        "stated Sun: the direction to the Sun, the time or the attitude is wrong",
    )


def drop_disproven(
    stands_alone: Callable[[int], bool],
    strongest: Sequence[int],
    decades: Callable[[list[int]], float],
    least: float,
) -> list[int]:
    """Leave out points whose ground looks alike elsewhere in a wider search.

    stands_alone  whether a point does, in that search
    strongest     points that the solution uses, by what they say against chance, most first
    decades       powers of ten against chance that some of them give;  least that are asked for

    Stops where those that stand alone give enough. Returns the points not left out.
    """
    proven: list[int] = []
    for tried, k in enumerate(strongest, 1):
        if stands_alone(k):
            proven.append(k)
        if proven and decades(proven) >= least:
            return [*proven, *strongest[tried:]]
    return proven
