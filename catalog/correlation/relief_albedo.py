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
from catalog.correlation.ncc import cropped, high_pass_finite, laid_at, moved
from catalog.correlation.peak import (
    CORRELATED_NODES,
    DAMPED_NODES,
    SPECTRUM_FLOOR,
    Match,
    inverse_of_normal,
    lag_taper,
)

FILE = "configs/models/albedo.toml"
# A match without them stays as it is: of what it leaves over the patterns explain so large a share.
# On highlands under albedo that does not follow relief 95 of 100 matches have less than 0.011, over
# maria 95 of 100 have more than 0.025 (studies/README.md).
MIN_SHARE = 0.02
# The rest about a node: its Gaussian-weighted mean square, and the share of the whole mean square
# that every node has at least.
LOCAL_NODES, LOCAL_FLOOR = 5.0, 0.1
# A step of more is beyond what slopes can tell.
MAX_STEP_NODES = 0.7


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
    template, steep, crests, patch = _split(high_pass_finite(grids))
    near = [cropped(grid, margin_nodes) for grid in (template, steep, crests, patch)]
    if _explained(near) < MIN_SHARE:
        return match
    x, y = match.dx - np.rint(match.dx), match.dy - np.rint(match.dy)
    laid, slopes = moved(template, x, y, margin_nodes)
    others = [moved(other, x, y, margin_nodes)[0] for other in (steep, crests)]
    columns = _columns([laid, slopes[..., 0], slopes[..., 1], *others])
    seen_flat = near[3].astype(np.float64).ravel()
    rest = _rest(columns, seen_flat)
    side = laid.shape[0]
    local = _local_size(rest.reshape(side, side)).ravel()
    found = _place(columns / local[:, None], seen_flat / local, side)
    if found is None:
        return match._replace(covariance=np.diag([np.inf, np.inf]))
    shift, covariance = found
    x, y = shift * min(1.0, MAX_STEP_NODES / max(float(np.hypot(*shift)), 1e-9))
    return match._replace(dx=match.dx + x, dy=match.dy + y, covariance=covariance)


def _split(grids: Float32Array) -> list[Float32Array]:
    """The grids (n, n) of a stack (n, n, k)."""
    return [np.ascontiguousarray(grids[..., k]) for k in range(grids.shape[2])]


def _explained(near: list[Float32Array]) -> float:
    """Share of what template and slopes leave over of a patch that steepness and crests explain.

    near  all four, in this order and the patch last
    """
    template, steep, crests, patch = near
    down, along = (np.asarray(slope, np.float32) for slope in np.gradient(template))
    columns = _columns([template, along, down, steep, crests, patch])
    sums = columns.T @ columns
    rests = []
    for last in (4, 6):
        normal, right = sums[:last, :last], sums[:last, -1]
        size = np.sqrt(np.maximum(np.diag(normal), 1e-30))
        # so little added that flat patterns do no harm
        scaled = normal / np.outer(size, size) + 1e-9 * np.eye(last)
        rests.append(sums[-1, -1] - (right / size) @ np.linalg.solve(scaled, right / size))
    alone, both = rests
    return 1.0 - both / alone if alone > 1e-30 else 0.0


def _columns(grids: list[Float32Array]) -> FloatArray:
    """A constant and some grids (n, n) side by side, (n^2, k + 1)."""
    columns = np.ones((grids[0].size, len(grids) + 1))
    for k, grid in enumerate(grids, start=1):
        columns[:, k] = grid.ravel()
    return columns


def _rest(columns: FloatArray, values: FloatArray) -> FloatArray:
    """What the columns leave over of values (n^2,)."""
    rest: FloatArray = values - columns @ np.linalg.lstsq(columns, values)[0]
    return rest


def _local_size(rest: FloatArray) -> FloatArray:
    """Rms of a rest (n, n) about each node over that of the whole."""
    square = cv2.GaussianBlur(rest * rest, (0, 0), LOCAL_NODES, borderType=cv2.BORDER_REFLECT)
    mean = max(float(square.mean()), 1e-30)
    sizes: FloatArray = np.sqrt((square / mean + LOCAL_FLOOR) / (1.0 + LOCAL_FLOOR))
    return sizes


def _place(
    columns: FloatArray, values: FloatArray, side: int
) -> tuple[FloatArray, FloatArray] | None:
    """Shift (2,) and its covariance (2, 2), nodes; None where the gain is not above 0.

    As `refined_by_remainder`, with the two patterns beside the template and its slopes.
    """
    first = np.linalg.lstsq(columns, values)[0]
    if not first[1] > 0.0:
        return None
    rest = values - columns @ first
    wide = cv2.getOptimalDFTSize(side + CORRELATED_NODES)
    grids = np.concatenate([columns[:, 1:], rest[:, None]], axis=1).T.reshape(-1, side, side)
    *waves, of_rest = np.fft.rfft2(grids, (wide, wide))
    power = np.abs(of_rest) ** 2
    tapered = np.fft.irfft2(power, (wide, wide)) * lag_taper(wide)
    spectrum = np.fft.rfft2(tapered).real
    cycles = np.hypot(np.fft.fftfreq(wide)[:, None], np.fft.rfftfreq(wide)[None])
    weights = np.exp(-((2.0 * np.pi * DAMPED_NODES * cycles) ** 2))
    # rest and spectrum over all frequencies: those of half a plane stand for two
    twice = np.full(power.shape, 2.0)
    twice[:, 0] = 1.0
    if wide % 2 == 0:
        twice[:, -1] = 1.0
    mean = float((twice * spectrum).sum()) / wide**2
    weights /= spectrum + SPECTRUM_FLOOR * mean + 1e-30
    flat = np.stack(waves).reshape(len(waves), -1)
    share, noise = (twice * weights).ravel(), (twice * weights**2 * power).ravel()
    normal = ((flat * share) @ flat.conj().T).real
    right = ((flat * share) @ of_rest.conj().ravel()).real
    scatter = ((flat * noise) @ flat.conj().T).real
    # a pattern's strength times the gain is known to so much without the picture; sums over
    # frequencies are wide^2 times those over nodes, and the rest's power is of side^2 nodes
    scale, strengths = (wide / side) ** 2, shipped_strengths()
    for k, strength in ((3, strengths.steepness), (4, strengths.crests)):
        weight = scale / (strength.sigma * first[1]) ** 2
        right[k] += weight * (strength.mean * first[1] - first[1 + k])
        normal[k, k] += weight
        scatter[k, k] += weight
    inverse = inverse_of_normal(normal)
    if inverse is None:
        return None
    gain, *away = (first[1:] + inverse @ right)[:3]
    if not gain > 0.0:
        return None
    covariance = (inverse @ scatter @ inverse)[1:3, 1:3] * scale / gain**2
    return -np.array(away) / gain, covariance
