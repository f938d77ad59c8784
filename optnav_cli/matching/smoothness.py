"""Whether a picture shows ground under a template, or a smooth field and rounding alone.

Gradients, vignettes, stray light and haze bend in a map and at the border of the high-pass, and
what is left of them correlates with a template by up to 0.5: few long waves, which a test against
chance takes for as many samples as ground has.
"""

from functools import lru_cache

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.ncc import cropped, quick_high_passed

# Along each side of the surface that is taken out: ground in 48 to 96 nodes keeps 0.85 to 1.00 of
# its variance without it, smooth fields little but rounding.
SURFACE_TERMS = 5
MIN_GROUND_SHARE = 0.5  # of the high-passed variance, that such a surface leaves
# Of a step between counts: uniform rounding has 1/12; that of a slow gradient beats with the nodes.
ROUNDING_VARIANCE = 1.5 / 12.0
SAMPLED_PIXELS = 65_536  # of a picture, that its counts' step is found from
MAX_VALUES = 16_384  # different ones among these: more are no counts of a camera


def shows_ground(patch: Float32Array, margin_nodes: int, count_step: float) -> bool:
    """Tell ground from a smooth field.

    patch (n, n)  of the picture on the nodes of a template with its margin, NaN without a value
    margin_nodes  about it that only the high-pass sees
    count_step    between neighbouring counts of the picture; 0 where it has none

    Returns whether the high-passed contrast is above rounding and not that of a smooth surface.
    """
    valid = np.isfinite(patch)
    filled = np.where(valid, patch, patch[valid].mean() if valid.any() else 0.0)
    basis = _surface_basis(patch.shape[0])
    smooth = basis @ (basis.T @ filled @ basis) @ basis.T
    both = quick_high_passed((patch, (filled - smooth).astype(np.float32)), valid, margin_nodes)
    shown = cropped(valid, margin_nodes)
    if not shown.any():
        return False
    whole, rough = (float(np.mean(np.square(grid[shown], dtype=np.float64))) for grid in both)
    return rough > ROUNDING_VARIANCE * count_step**2 and rough > MIN_GROUND_SHARE * whole


def find_count_step(picture: Float32Array) -> float:
    """Find the step between counts of a picture (h, w): their greatest common divisor.

    Returns 0 for fractions, and where the values are all alike.
    """
    known = picture[np.isfinite(picture)]
    values = np.unique(known[:: max(1, known.size // SAMPLED_PIXELS)])
    whole = np.rint(values).astype(np.int64)
    if not 1 < values.size <= MAX_VALUES or (whole != values).any():
        return 0.0
    return float(np.gcd.reduce(np.diff(whole)))


@lru_cache(maxsize=32)
def _surface_basis(size: int) -> FloatArray:
    """Orthonormal polynomials (size, SURFACE_TERMS) along a side."""
    return np.linalg.qr(
        np.polynomial.legendre.legvander(np.linspace(-1, 1, size), SURFACE_TERMS - 1)
    )[0]
