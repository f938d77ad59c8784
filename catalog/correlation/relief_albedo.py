"""The place of a match on ground whose albedo follows its relief.

On the Moon steep slopes and crests are brighter than the ground about them: debris slides off them
and fresh rock shows. A reference rendered with one albedo lacks this. Over plains, and under a high
Sun, the albedo has more contrast than the shading has, and as it goes with the same relief it moves
the peak of the correlation: a bright crest beside a slope in sunlight looks like a slope that lies
farther from the Sun. Over maria at nodes of 948 m that is 0.1 nodes under a Sun of 15 degrees and
0.3 under one of 36.

So both patterns are fitted along with the place, held by how they go with the Moon's relief (FILE,
`optnav study fit albedo`). What then is left over lies where the relief is, too, so that every node
counts by the rest about it.
"""

from functools import cache

import cv2
import msgspec
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.config import Positive, load_toml, resource
from catalog.correlation.ncc import cropped, high_pass_finite, laid_at, laid_patterns, stepped
from catalog.correlation.peak import Match, Prior, plain_fit, refined_by_remainder, rest_of

FILE = "configs/models/albedo.toml"
# A match without them stays as it is: of what it leaves over the patterns explain so large a share.
# On highlands under albedo that does not follow relief 95 of 100 matches have less than 0.011, over
# maria 95 of 100 have more than 0.025 (studies/README.md).
MIN_SHARE = 0.02
# The rest about a node: its Gaussian-weighted mean square, and the share of the whole mean square
# that every node has at least.
LOCAL_NODES, LOCAL_FLOOR = 5.0, 0.1
PLAIN_PATTERNS = 4  # 1, template and slopes


class PatternStrength(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A section of FILE: mean and rms about it, from square to square of the ground."""

    mean: float
    sigma: Positive


class ReliefAlbedo(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All numbers of FILE."""

    steepness: PatternStrength
    crests: PatternStrength


@cache
def shipped_strengths() -> ReliefAlbedo:
    """The numbers that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), ReliefAlbedo)


def steepness_and_crests(heights: ArrayLike, posting_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Slope of ground (n, m), and how much it changes from node to node: below 0 on a crest.

    posting_m  m from row to row and from column to column, or one for both
    """
    rows_m, columns_m = np.broadcast_to(posting_m, 2)
    down, along = np.gradient(np.asarray(heights), rows_m, columns_m)
    return np.hypot(down, along), np.gradient(down, axis=0) + np.gradient(along, axis=1)


def relief_patterns(
    heights: Float32Array, posting_m: float, brightness: Float32Array
) -> Float32Array:
    """How brightness changes by a unit of slope, and by one of slope change a node, (2, n, n).

    heights (n, n) m, brightness (n, n) as rendered. NaN where either is unknown.
    """
    patterns = np.stack(steepness_and_crests(heights, posting_m))
    # less their means, so that they carry no shading
    patterns -= np.nanmean(patterns, axis=(1, 2), keepdims=True)
    return (patterns * brightness).astype(np.float32)


def without_relief_albedo(
    match: Match,
    reference: Float32Array,
    patterns: Float32Array,
    search: Float32Array,
    margin_nodes: int,
) -> Match:
    """A match with place and covariance as if the albedo that follows relief were known.

    reference (n, n), search (m, m) as for `match_ncc`;  patterns (2, n, n) of `relief_patterns`
    It stays as it is where that albedo explains no MIN_SHARE of what it leaves over, where it is
    no peak, and where either grid has a hole.
    """
    if not np.isfinite(match.covariance).all():
        return match
    seen = laid_at(search, reference, match)
    grids = np.dstack([reference, *patterns, seen])
    if not np.isfinite(grids).all():
        return match
    template, *others, patch = _split(high_pass_finite(grids))
    patch = cropped(patch, margin_nodes)
    patterns = laid_patterns(match, template, margin_nodes, others)
    rests = []
    for some in (patterns[:PLAIN_PATTERNS], patterns):
        fit = plain_fit(some, patch)
        if fit is None:
            return match
        rests.append(rest_of(some, patch, fit))
    alone, both = (float(np.square(rest).mean()) for rest in rests)
    if not alone - both >= max(MIN_SHARE * alone, 1e-30):
        return match
    local = _local_size(rests[1])
    strengths = shipped_strengths()
    priors = [
        Prior(PLAIN_PATTERNS + k, strength.mean, strength.sigma)
        for k, strength in enumerate((strengths.steepness, strengths.crests))
    ]
    found = refined_by_remainder(patterns / local, patch / local, patch.size, priors)
    return stepped(match, found)


def _split(grids: Float32Array) -> list[Float32Array]:
    """The grids (n, n) of a stack (n, n, k)."""
    return [np.ascontiguousarray(grids[..., k]) for k in range(grids.shape[2])]


def _local_size(rest: Float32Array) -> Float32Array:
    """Rms of a rest (n, n) about each node over that of the whole."""
    square = cv2.GaussianBlur(rest * rest, (0, 0), LOCAL_NODES, borderType=cv2.BORDER_REFLECT)
    mean = max(float(square.mean()), 1e-30)
    return np.asarray(np.sqrt((square / mean + LOCAL_FLOOR) / (1.0 + LOCAL_FLOOR)), np.float32)
