"""How far a matched control point may be from its true place, beyond what its peak shows.

The curvature of the correlation peak tells of noise and of relief that the reference lacks. What
stays is small and does not average out as noise does: the terrain model's own interpolation, the
shading law, the averaging of coarse levels. A part of it is each point's own; a part is common to
a frame, because all points stand under one Sun: a shift, and a stretch about the frame's middle.
Without the common part the covariance of many points together would come out too small.

The numbers are fitted to simulated frames over ground richer than the catalog's (study navigation).
"""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

# 1 sigma an axis, in nodes of the catalog's finest level.
OWN_FINEST_NODES = 0.03
# The same in nodes of the level that was matched.
OWN_LEVEL_NODES = 0.012
# Common to all points of a frame, in nodes of the finest level: what a perfect score leaves, and
# what unexplained relief adds (shading biases all points alike, along the Sun). The stretch is
# that at the points' rms distance from their middle.
COMMON_FINEST_NODES = 0.01
COMMON_PER_UNEXPLAINED = 0.08


def own_sigma_m(posting_m: float, finest_posting_m: float) -> float:
    """One-sigma ground error per axis, m, of a point's own that its peak does not show."""
    return float(np.hypot(OWN_LEVEL_NODES * posting_m, OWN_FINEST_NODES * finest_posting_m))


def common_errors_px(
    pixels: FloatArray,
    metres_per_pixel: FloatArray,
    scores: FloatArray,
    finest_posting_m: float,
) -> FloatArray:
    """What one sigma of each error common to a frame moves every point by, (n, 2, 3), px.

    pixels (n, 2), metres_per_pixel (n,), scores (n,) of the correlation peaks.
    The three errors are independent: shift along x, shift along y, stretch.
    """
    nodes = COMMON_FINEST_NODES + COMMON_PER_UNEXPLAINED * (1.0 - scores)
    shift = nodes * finest_posting_m / metres_per_pixel
    zero = np.zeros_like(shift)
    from_middle = pixels - pixels.mean(axis=0)
    reach = float(np.sqrt((from_middle**2).sum(axis=1).mean()))
    outward = from_middle / max(reach, 1e-9) * shift[:, None]
    along_x, along_y = np.stack([shift, zero], axis=1), np.stack([zero, shift], axis=1)
    return np.stack([along_x, along_y, outward], axis=2)
