"""Whether a picture shows ground under a template, or a smooth field and rounding alone.

Gradients, vignettes, stray light and haze correlate with a template by up to 0.5, and in all points
alike: laid over the relief of a terrain model, which no view from aside sees as a plane, a smooth
picture shows that relief. Rounding of their counts adds stripes.
"""

import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.correlation.filters import crop, filter_high_pass_quickly

# Along each side of the surface over the picture that is taken out: ground in 48 to 96 nodes keeps
# 0.85 to 1.00 of its variance without it, smooth fields little but rounding.
SURFACE_TERMS = 5
FITTED_NODES = 7  # from one node to the next, row after row, that the surface is fitted to
LOAD = 1e-12  # on the diagonal of its equations, share of their sum
MIN_GROUND_SHARE = 0.5  # of the high-passed variance, that such a surface leaves
# Of a step between counts: uniform rounding has 1/12; that of a slow gradient beats with the nodes.
ROUNDING_VARIANCE = 1.5 / 12.0
SAMPLED_PIXELS = 65_536  # of a picture, that its counts' step is found from
MAX_VALUES = 16_384  # different ones among these: more are no counts of a camera


def shows_ground(
    patch: Float32Array, pixels: FloatArray, margin_nodes: int, count_step: float
) -> bool:
    """Tell ground from a smooth field.

    patch (n, n)  of the picture on the nodes of a template with its margin, NaN without a value
    pixels (n, n, 2)  where the nodes lie in the picture
    margin_nodes  about it that only the high-pass sees
    count_step    between neighbouring counts of the picture; 0 where it has none

    Returns whether the high-passed contrast is above rounding and not that of a smooth picture.
    """
    valid = np.isfinite(patch) & np.isfinite(pixels[..., 0]) & np.isfinite(pixels[..., 1])
    shown = crop(valid, margin_nodes)
    if not shown.any():
        return False
    smooth = _smooth_picture(patch, pixels, valid)
    both = filter_high_pass_quickly(
        (patch, (patch - smooth).astype(np.float32)), valid, margin_nodes
    )
    whole, rough = (float(np.mean(np.square(grid[shown], dtype=np.float64))) for grid in both)
    return rough > ROUNDING_VARIANCE * count_step**2 and rough > MIN_GROUND_SHARE * whole


def _smooth_picture(patch: Float32Array, pixels: FloatArray, valid: BoolArray) -> FloatArray:
    """Fit a surface of few terms in the picture's own coordinates (n, n)."""
    values, every = patch[valid].astype(np.float64), slice(None, None, FITTED_NODES)
    across, down = (_powers(pixels[..., axis][valid]) for axis in (0, 1))
    few = (across[every, :, None] * down[every, None, :]).reshape(-1, SURFACE_TERMS**2)
    normal = few.T @ few
    normal += LOAD * np.trace(normal) * np.eye(len(normal))  # a patch may be a line of pixels
    strengths = np.linalg.solve(normal, few.T @ (values[every] - values.mean()))
    smooth = np.zeros(patch.shape)
    smooth[valid] = values.mean() + np.einsum(
        "na,na->n", across @ strengths.reshape(SURFACE_TERMS, SURFACE_TERMS), down
    )
    return smooth


def _powers(places: FloatArray) -> FloatArray:
    """Powers (n, SURFACE_TERMS) of places (n,), scaled to -1 to 1."""
    low, high = places.min(), places.max()
    return np.vander(2.0 * (places - low) / max(high - low, 1e-9) - 1.0, SURFACE_TERMS)


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
