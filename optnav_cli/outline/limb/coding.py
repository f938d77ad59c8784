"""Whether counts across a limb are linear in light, and edges where they are not.

Square-root tables and gamma steepen the dark side of an edge: an edge model of linear counts puts
it 0.2-0.4 px too far out, at a stated hundredth. What the model leaves follows a pattern then,
alike in all profiles; decoded by the right exponent, noise is left. Halos and rough ground leave
patterns, too, which no exponent takes away: these are left as they are.
"""

from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.frames.segmentation import Levels
from optnav_cli.outline.limb.edge_fit import (
    EdgeShape,
    Profiles,
    compute_edge_residuals,
    fit_common_shape,
    locate_edges,
)

# Mean squares of the pattern's bins over their errors': drawn discs have 0.6-1.4 where counts are
# linear, 1.5-26 under a square root; these with 0.6-1.4 where they are decoded right.
MIN_PATTERN, MAX_PATTERN_LEFT = 2.0, 1.6
EXPONENTS = (1.2, 1.43, 1.7, 2.0, 2.2)  # of light over counts: square root 2, sRGB about 2.2
EXPONENT_SIGMA = 0.1  # of the best of these
BIN_PX = 0.5
MIN_IN_BIN = 10
LEAST_SHARE = 1e-3  # of the peak: no sky is darker, where a power's slope vanishes


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of a limb, and how counts were read for them.

    depth_px, sigma_px  (n,) as `locate_edges`
    shape     what they have in common
    levels    of the picture, decoded
    exponent  of counts that gives light; 1 where they are taken as linear
    """

    depth_px: FloatArray
    sigma_px: FloatArray
    shape: EdgeShape
    levels: Levels
    exponent: float = 1.0


def fit_edges(profiles: Profiles, levels: Levels, saturation: float) -> Edges:
    """Edges of profiles in counts, as these are, or decoded where the limb shows a coding.

    Raises NoSolutionError when no profile has an edge.
    """
    as_stated = _fit(profiles, levels, saturation, 1.0)
    if as_stated[1] < MIN_PATTERN or levels.peak <= 0.0:
        return as_stated[0]
    # most patterns are the ground's: two exponents tell these from a coding's
    tried = [_fit(*_decode(profiles, levels, saturation, e), e) for e in EXPONENTS[1:4:2]]
    if min(pattern for _, pattern in tried) > as_stated[1]:
        return as_stated[0]
    tried = [_fit(*_decode(profiles, levels, saturation, e), e) for e in EXPONENTS]
    best = int(np.argmin([pattern for _, pattern in tried]))
    edges, pattern = tried[best]
    if pattern > MAX_PATTERN_LEFT or pattern > 0.5 * as_stated[1]:
        return as_stated[0]
    moved = float(np.nanmedian(edges.depth_px - as_stated[0].depth_px))
    error = EXPONENT_SIGMA * abs(moved) / (EXPONENTS[best] - 1.0)
    common = float(np.hypot(edges.shape.common_sigma_px, error))
    return replace(edges, shape=replace(edges.shape, common_sigma_px=common))


def _fit(
    profiles: Profiles, levels: Levels, saturation: float, exponent: float
) -> tuple[Edges, float]:
    """Edges of profiles, and the size of the pattern that their model leaves."""
    shape = fit_common_shape(profiles, levels, saturation)
    depth, sigma = locate_edges(profiles, shape, levels, saturation)
    inside, residuals = compute_edge_residuals(profiles, shape, levels, saturation)
    edges = Edges(depth, sigma, shape, levels, exponent)
    return edges, _measure_pattern(inside, residuals)


def _measure_pattern(inside_px: FloatArray, residuals: FloatArray) -> float:
    """Mean square of residuals (n,) in bins of the distance inside the edge, over its variance."""
    bins = np.floor(inside_px / BIN_PX).astype(np.int64)
    bins -= bins.min(initial=0)
    number = np.bincount(bins)
    full = number >= MIN_IN_BIN
    if not full.any():
        return 0.0
    mean = np.bincount(bins, residuals)[full] / number[full]
    return float(np.mean(number[full] * mean**2))


def _decode(
    profiles: Profiles, levels: Levels, saturation: float, exponent: float
) -> tuple[Profiles, Levels, float]:
    """Profiles, levels and full scale in light, of which the peak has as much as in counts."""
    peak = levels.peak

    def decode_counts(counts: FloatArray | float) -> FloatArray:
        share = np.asarray(counts, np.float64) / peak
        decoded: FloatArray = peak * np.sign(share) * np.abs(share) ** exponent
        return decoded

    slope = exponent * max(levels.sky / peak, LEAST_SHARE) ** (exponent - 1.0)
    changed = replace(
        levels,
        sky=float(decode_counts(levels.sky)),
        noise=levels.noise * slope,
        bright=float(decode_counts(levels.bright)),
        threshold=float(decode_counts(levels.threshold)),
    )
    full = float(decode_counts(saturation)) if np.isfinite(saturation) else saturation
    return replace(profiles, values=decode_counts(profiles.values)), changed, full
