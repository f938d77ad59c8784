"""The place of a match on ground whose albedo follows its relief.

On the Moon steep slopes and crests are brighter than the ground about them: debris slides off them
and fresh rock shows. A reference rendered with one albedo lacks this. Over plains, and under a high
Sun, the albedo has more contrast than the shading has, and as it goes with the same relief it moves
the peak of the correlation: a bright crest beside a slope in sunlight looks like a slope that lies
farther from the Sun. Over maria at nodes of 948 m that is 0.1 nodes under a Sun of 15 degrees and
0.3 under one of 36.

Both are taken of heights that are as smooth as the map of albedo from which their strengths come
(SMOOTH_M), at nodes of any size: of sharper ones the Moon's albedo as mapped follows only the
longer waves, and strengths that fit these move places too far back, at nodes of 474 m by 30 m and
more under a Sun of 45 degrees.

So both patterns are fitted along with the place, held by how they go with the Moon's relief (FILE,
`python -m tests.studies fit albedo`) and by how the other points of the picture show them: a place
and the strength of its crests are hard to tell apart. What then is left over lies where the relief
is, too, so that every node counts by the rest about it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.config import Positive, load_toml, resource
from catalog.correlation.filters import crop, filter_high_pass_quickly, filter_low_pass
from catalog.correlation.ncc import apply_remainder, cut_match
from catalog.correlation.peak import Match
from catalog.correlation.remainder import (
    Prior,
    WeightedFit,
    fit_plain,
    fit_weighted,
    place_patterns,
    subtract_patterns,
)

FILE = "configs/models/albedo.toml"
# The rest about a node: its Gaussian-weighted mean square, and the share of the whole mean square
# that every node has at least.
LOCAL_NODES, LOCAL_FLOOR = 5.0, 0.1
PLAIN_PATTERNS = 4  # 1, template and slopes
SMOOTH_M = 1330.0  # sigma: half a pixel of the LROC colour map of 4096 columns
CRESTS_OVER_M = 1000.0  # the distance over which a change of slope counts
# So many points' worth of scatter is that of all ground, of strengths in a picture.
PRIOR_POINTS = 1.0


class PatternStrength(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A section of FILE: mean and rms about it, from square to square of the ground."""

    mean: float
    sigma: Positive


class ReliefAlbedo(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All numbers of FILE."""

    steepness: PatternStrength
    crests: PatternStrength


@cache
def load_shipped_strengths() -> ReliefAlbedo:
    """The numbers that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), ReliefAlbedo)


def compute_steepness_and_crests(
    heights: ArrayLike, posting_m: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Slope of smoothed ground (n, m), and its change over a kilometre: below 0 on a crest.

    posting_m  m from row to row and from column to column, or one for both
    """
    rows_m, columns_m = np.broadcast_to(posting_m, 2)
    smooth = filter_low_pass(
        np.asarray(heights, np.float32), SMOOTH_M / np.sqrt(rows_m * columns_m)
    )
    down, along = np.gradient(smooth.astype(np.float64), rows_m, columns_m)
    bend = np.gradient(down, rows_m, axis=0) + np.gradient(along, columns_m, axis=1)
    return np.hypot(down, along), CRESTS_OVER_M * bend


def make_relief_patterns(
    heights: Float32Array, posting_m: float, brightness: Float32Array
) -> Float32Array:
    """Compute the change of brightness by unit slope, and by unit slope change per km, (2, n, n).

    heights (n, n) m, brightness (n, n) as rendered. NaN where either is unknown.
    """
    patterns = np.stack(compute_steepness_and_crests(heights, posting_m))
    # less their means, so that they carry no shading
    patterns -= np.nanmean(patterns, axis=(1, 2), keepdims=True)
    return (patterns * brightness).astype(np.float32)


@dataclass(frozen=True, eq=False)
class ReliefMatch:
    """A match on ground whose albedo may follow its relief.

    match                         as it is without that albedo
    laid (6, n, n), patch (n, n)  of `refined_by_remainder`, steepness and crests behind the slopes
    compared (n, n)               the nodes that all have; the others are zero
    """

    match: Match
    laid: Float32Array
    patch: Float32Array
    compared: BoolArray

    @cached_property
    def _residuals(self) -> list[Float32Array]:
        """Residuals of the patch without and with steepness and crests; [] where one is flat."""
        rests = []
        for some in (self.laid[:PLAIN_PATTERNS], self.laid):
            fit = fit_plain(some, self.patch)
            if fit is None:
                return []
            rests.append(subtract_patterns(some, self.patch, fit))
        return rests

    @cached_property
    def explained(self) -> float:
        """Share of what the match leaves over that steepness and crests explain."""
        if not self._residuals:
            return 0.0
        alone, both = (float(np.square(residual).mean()) for residual in self._residuals)
        return 1.0 - both / alone if alone > 1e-30 else 0.0

    @cached_property
    def fit(self) -> WeightedFit | None:
        """Steepness and crests fitted beside the place; None where they cannot be."""
        if not self._residuals:
            return None
        local = _compute_local_rms(self._residuals[1], self.compared)
        nodes = int(np.count_nonzero(self.compared))
        return fit_weighted(self.laid / local, self.patch / local, nodes)

    def apply_albedo(self, strengths: ReliefAlbedo) -> Match:
        """The match with place and covariance under so strong an albedo."""
        if self.fit is None:
            return self.match
        return apply_remainder(self.match, self.fit.remainder(_make_priors(strengths)))


def make_relief_match(
    match: Match,
    reference: Float32Array,
    patterns: Float32Array,
    search: Float32Array,
    margin_nodes: int,
) -> ReliefMatch | None:
    """A match with the patterns laid where it was found; None where it is no peak.

    reference (n, n), search (m, m)  as for `match_ncc`
    patterns (2, n, n)               of `make_relief_patterns`
    Nodes that either grid lacks take no part.
    """
    if not np.isfinite(match.covariance).all():
        return None
    grids = (reference, *patterns, cut_match(search, reference, match))
    known = np.isfinite(np.stack(grids)).all(axis=0)
    template, *others, patch = filter_high_pass_quickly(grids, known)
    compared = crop(known, margin_nodes)
    laid = place_patterns(match, template, margin_nodes, others) * compared
    return ReliefMatch(match, laid, crop(patch, margin_nodes) * compared, compared)


def estimate_strengths(points: Sequence[ReliefMatch]) -> ReliefAlbedo:
    """Strengths as some matches of a picture show them together, and how they differ among them.

    So a match is held by what the others tell.
    """
    shipped = load_shipped_strengths()
    fits = [point.fit for point in points if point.fit is not None]
    solutions = [
        solved
        for fit in fits
        if (solved := fit.solve_with_priors(_make_priors(shipped))) is not None
    ]
    if not solutions:
        return shipped
    parts = []
    for prior in _make_priors(shipped):
        k, variance = prior.pattern - 1, prior.sigma**2
        values = np.array([strengths[k] / strengths[0] for strengths, _ in solutions])
        noise = np.array([spread[k, k] / strengths[0] ** 2 for strengths, spread in solutions])
        # of few points their scatter is that of all ground
        scatter = max(float(((values - values.mean()) ** 2 - noise).sum()), 0.0)
        among = (scatter + PRIOR_POINTS * variance) / (len(values) - 1 + PRIOR_POINTS)
        weights = np.append(1.0 / (noise + among), 1.0 / variance)
        mean = float(weights @ np.append(values, prior.mean) / weights.sum())
        parts.append(PatternStrength(mean, float(np.sqrt(among + 1.0 / weights.sum()))))
    return ReliefAlbedo(*parts)


def _make_priors(strengths: ReliefAlbedo) -> list[Prior]:
    return [
        Prior(PLAIN_PATTERNS + k, strength.mean, strength.sigma)
        for k, strength in enumerate((strengths.steepness, strengths.crests))
    ]


def _compute_local_rms(rest: Float32Array, compared: BoolArray) -> Float32Array:
    """Rms of a rest (n, n) about each node over that of the whole, of the nodes compared."""
    square, weight = (
        cv2.GaussianBlur(grid, (0, 0), LOCAL_NODES, borderType=cv2.BORDER_REFLECT)
        for grid in (rest * rest, compared.astype(np.float32))
    )
    mean = max(float(square.sum() / weight.sum()), 1e-30)
    near = square / np.maximum(weight, np.float32(1e-3)) / mean
    sizes: Float32Array = np.sqrt((near + LOCAL_FLOOR) / (1.0 + LOCAL_FLOOR)).astype(np.float32)
    return sizes
