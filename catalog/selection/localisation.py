"""How well a place can be matched: predicted from its relief, and from rendered brightness.

From relief, in closed form for every Sun azimuth: away from shadows the brightness of gentle relief
changes with the slope towards the Sun, so its gradient is the Hessian of the heights times the
Sun's azimuth vector, times the cotangent of the Sun's elevation over the node. The structure
tensor of the brightness under any azimuth is then a combination of six box sums of products of
second differences: Hxx², Hxx Hxy, Hxy², Hxx Hyy, Hxy Hyy, Hyy². Its smallest eigenvalue is Harris'
measure of a corner; the worst azimuth counts. Heights are in units of the posting, so every number
is dimensionless. The linear law is ours and ignores shadows and the curvature of the reflectance
law: on real ground it chose as well as full renders at a twentieth of their cost.

From brightness: with white image noise of variance s² a least-squares match has covariance s² M⁻¹,
M the structure tensor, the sum over the template of the products of the brightness gradient. The
noise here is the mean brightness over a signal-to-noise ratio, so that no radiometric unit enters.
A place can have sharp edges and yet too little contrast to stand out of the noise: correlation then
refuses it. The predicted correlation is the height of the peak, and a bound over it is the score
that orders candidates (the division is ours: on real ground it chose points that were recognised
1 % more often than the bound alone did, and 2 % more than the closed form). Uniqueness is how
unlike the true place its best rival in the search region is, by SURF.
"""

import math
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.filters import HIGH_PASS_NODES, filter_high_pass
from catalog.correlation.surf64 import compute_self_similarity_surface
from catalog.geometry.kernel import inplace_kernel, kernel

AZIMUTHS = 8  # over half a turn: the opposite Sun gives the same tensor
# a window may miss this share of its nodes before its response is unknown
MAX_MISSING = 0.02
# Nearer than this a peak of the similarity is the place itself.
LOBE_NODES = 3


@inplace_kernel
def compute_eigenvalue_row(
    sums: Float32Array, least: float, directions: Float32Array, out: Float32Array
) -> None:
    """Worst smallest eigenvalue (cols) for a row of window sums (7, cols).

    The first six are of the products; where the last, the number known, is less than `least` or
    NaN the eigenvalue is NaN. directions (n, 3): see `compute_sun_products`.
    """
    cols = out.size
    half, four = np.float32(0.5), np.float32(4.0)
    for c in range(cols):
        out[c] = np.float32(3e38)
    for a in range(directions.shape[0]):
        ee, en, nn = directions[a, 0], directions[a, 1], directions[a, 2]
        twice = en + en
        # a plain comparison: min() keeps the compiler from using vector registers, 12x slower
        for c in range(cols):
            m11 = ee * sums[0, c] + twice * sums[1, c] + nn * sums[2, c]
            m22 = ee * sums[2, c] + twice * sums[4, c] + nn * sums[5, c]
            m12 = ee * sums[1, c] + en * (sums[3, c] + sums[2, c]) + nn * sums[4, c]
            difference = m11 - m22
            doubled = m11 + m22 - np.sqrt(difference * difference + four * m12 * m12)
            worst = out[c]
            out[c] = doubled if doubled < worst else worst
    for c in range(cols):
        smallest = half * out[c]
        if sums[6, c] >= least:
            out[c] = smallest if smallest > 0.0 else np.float32(0.0)
        else:
            out[c] = np.float32(np.nan)


@inplace_kernel
def _sum_windows(columns: FloatArray, window: int, step: int, sums: Float32Array) -> None:
    """Window sums (7, right) of a row from its column sums (7, cols)."""
    # seven scalars, not an array: the additions of seven chains then overlap
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = 0.0
    for c in range(window):
        s0 += columns[0, c]
        s1 += columns[1, c]
        s2 += columns[2, c]
        s3 += columns[3, c]
        s4 += columns[4, c]
        s5 += columns[5, c]
        s6 += columns[6, c]
    for i in range(sums.shape[1]):
        sums[0, i], sums[1, i], sums[2, i], sums[3, i] = s0, s1, s2, s3
        sums[4, i], sums[5, i], sums[6, i] = s4, s5, s6
        if i == sums.shape[1] - 1:
            break
        for c in range(i * step, (i + 1) * step):
            s0 += columns[0, c + window] - columns[0, c]
            s1 += columns[1, c + window] - columns[1, c]
            s2 += columns[2, c + window] - columns[2, c]
            s3 += columns[3, c + window] - columns[3, c]
            s4 += columns[4, c + window] - columns[4, c]
            s5 += columns[5, c + window] - columns[5, c]
            s6 += columns[6, c + window] - columns[6, c]


@kernel
def _compute_eigenvalue_map(
    heights: Float32Array,
    scale: float,
    window: int,
    least: float,
    directions: Float32Array,
    step: int,
) -> Float32Array:
    """One sweep: column sums slide down, window sums slide right, eigenvalues by rows."""
    rows, cols = heights.shape
    down, right = (rows - window) // step + 1, (cols - window) // step + 1
    out = np.empty((down, right), np.float32)
    columns = np.zeros((7, cols))
    sums = np.empty((7, right), np.float32)
    for row in range(rows):
        for entering in range(2):
            r = row if entering == 0 else row - window
            if r < 1 or r > rows - 2:
                continue
            sign = 1.0 if entering == 0 else -1.0
            for c in range(1, cols - 1):
                middle = np.float64(heights[r, c])
                xx = scale * (heights[r, c - 1] - 2.0 * middle + heights[r, c + 1])
                yy = scale * (heights[r - 1, c] - 2.0 * middle + heights[r + 1, c])
                # y is north, rows go south
                xy = (0.25 * scale) * (
                    np.float64(heights[r - 1, c + 1])
                    - heights[r - 1, c - 1]
                    - heights[r + 1, c + 1]
                    + heights[r + 1, c - 1]
                )
                known = (xx + yy + xy) == (xx + yy + xy)
                xx = xx if known else 0.0
                yy = yy if known else 0.0
                xy = xy if known else 0.0
                columns[0, c] += sign * (xx * xx)
                columns[1, c] += sign * (xx * xy)
                columns[2, c] += sign * (xy * xy)
                columns[3, c] += sign * (xx * yy)
                columns[4, c] += sign * (xy * yy)
                columns[5, c] += sign * (yy * yy)
                columns[6, c] += sign if known else 0.0
        first = row - window + 1
        if first < 0 or first % step:
            continue
        _sum_windows(columns, window, step, sums)
        compute_eigenvalue_row(sums, least, directions, out[first // step])
    return out


@cache
def compute_azimuth_products(azimuths: int = AZIMUTHS) -> Float32Array:
    """(azimuths, 3): e², e n, n² of azimuths over half a turn; e, n the Sun's east and north."""
    angle = np.pi * np.arange(azimuths) / azimuths
    return compute_sun_products(np.stack([np.sin(angle), np.cos(angle), np.ones(azimuths)], axis=1))


def compute_sun_products(suns_local: FloatArray) -> Float32Array:
    """(n, 3) the same for Sun directions (n, 3) east, north, up, times cot² of their elevation.

    With these weights an eigenvalue is that of the *relative* brightness, and a match under noise
    of 1 / SNR has a predicted 1-sigma error of 1 / (SNR sqrt(eigenvalue)) nodes.
    """
    suns = np.asarray(suns_local, dtype=np.float64).reshape(-1, 3)
    east, north = suns[:, 0] / suns[:, 2], suns[:, 1] / suns[:, 2]
    return np.stack([east * east, east * north, north * north], axis=1).astype(np.float32)


def compute_hessian_eigenvalue_map(
    heights: Float32Array,
    posting_m: float,
    window: int,
    products: Float32Array | None = None,
    step: int = 1,
) -> Float32Array:
    """Smallest eigenvalue, worst Sun, of the summed Hessian products in every window.

    heights    (rows, cols)  m, NaN for no data, row 0 north
    posting_m                node spacing, m
    window                   nodes a side of the summed square
    products   (n, 3)        of the Suns, see `compute_sun_products`; None: all azimuths, unweighted
    step                     evaluate every step-th node

    Returns ((rows - window) // step + 1, ...) float32, dimensionless; entry [i, j] is the window
    whose first node is (i step, j step), so its middle is window / 2 - 1/2 nodes further. NaN
    where more than MAX_MISSING of a window has no data (nodes on the grid's edge, which have no
    second difference, do not count as missing).
    Raises ValueError when the window does not fit.
    """
    if min(heights.shape) < window or window < 3:
        raise ValueError(f"a window of {window} nodes does not fit into {heights.shape}")
    # the border of a grid lacks second differences: four sides of a window at most
    least = (1.0 - MAX_MISSING) * window * window - 4.0 * window
    grid = np.ascontiguousarray(heights, dtype=np.float32)
    weights = compute_azimuth_products() if products is None else products
    return _compute_eigenvalue_map(grid, 1.0 / posting_m, window, least, weights, step)


def compute_hessian_eigenvalue(
    heights: Float32Array, posting_m: float, products: Float32Array | None = None
) -> float:
    """Compute the eigenvalue of one square patch, summed over all of it; NaN when it has holes."""
    side = min(heights.shape)
    return float(
        compute_hessian_eigenvalue_map(heights[:side, :side], posting_m, side, products)[0, 0]
    )


def compute_brightness_eigenvalue_map(
    brightness: Float32Array, window: int, step: int = 1
) -> Float32Array:
    """Smallest eigenvalue of the structure tensor of brightness in every window.

    brightness (rows, cols), NaN for no data;  window, step  as `compute_hessian_eigenvalue_map`
    Returns what that returns, of brightness relative to its mean.
    """
    known = np.isfinite(brightness)
    mean = float(brightness[known].mean()) if known.any() else 1.0
    filled = np.where(known, brightness, np.float32(0.0)) / np.float32(max(mean, 1e-9))
    inside = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    gx, gy = (cv2.Sobel(filled, cv2.CV_32F, *o, ksize=1, scale=0.5) for o in ((1, 0), (0, 1)))
    sums = [_sum_boxes(inside * grid, window, step) for grid in (gx * gx, gx * gy, gy * gy)]
    xx, xy, yy = sums
    smallest = 0.5 * (xx + yy - np.hypot(xx - yy, 2.0 * xy))
    share = _sum_boxes(known.astype(np.float32), window, step) / window**2
    response: Float32Array = np.where(share >= 1.0 - MAX_MISSING, smallest, np.nan)
    return response.astype(np.float32)


def _sum_boxes(grid: Float32Array, window: int, step: int) -> FloatArray:
    """Sums over windows whose first nodes are `step` apart."""
    total = np.pad(np.cumsum(np.cumsum(grid, axis=0, dtype=np.float64), axis=1), ((1, 0), (1, 0)))
    down, along = (np.arange(0, side - window + 1, step) for side in grid.shape)
    low, high = total[down], total[down + window]
    boxes: FloatArray = high[:, along + window] - high[:, along] - low[:, along + window]
    return boxes + low[:, along]


@kernel
def _sum_structure_tensor(brightness: Float32Array) -> tuple[float, float, float, float]:
    """Its elements xx, xy and yy, x along columns, y along rows, and the mean brightness."""
    rows, cols = brightness.shape
    inner = cols - 2
    # sums a column, so that additions need not wait for each other
    sums, known = np.zeros((4, inner)), np.zeros(inner, np.int64)
    sxx, sxy, syy, values = sums[0], sums[1], sums[2], sums[3]
    for r in range(1, rows - 1):
        here, above, below = brightness[r], brightness[r - 1][1:], brightness[r + 1][1:]
        for c in range(inner):
            gx = 0.5 * (np.float64(here[c + 2]) - np.float64(here[c]))
            gy = 0.5 * (np.float64(below[c]) - np.float64(above[c]))
            value = np.float64(here[c + 1])
            has_gradient = (gx == gx) & (gy == gy)
            sxx[c] += gx * gx if has_gradient else 0.0
            sxy[c] += gx * gy if has_gradient else 0.0
            syy[c] += gy * gy if has_gradient else 0.0
            values[c] += value if value == value else 0.0
            known[c] += 1 if value == value else 0
    mxx, mxy, myy, total, count = sxx.sum(), sxy.sum(), syy.sum(), values.sum(), known.sum()
    return mxx, mxy, myy, total / max(count, 1)


def _measure_contrast(brightness: Float32Array) -> float:
    """Standard deviation of a template behind the high-pass that matching applies.

    Where it has no holes and even sides, the local mean is taken on half as many nodes a side.
    """
    rows, cols = brightness.shape
    contrast = math.nan
    if not (rows % 2 or cols % 2):
        contrast = _measure_contrast_by_halves(brightness, _compute_half_taps())
    if contrast == contrast:
        return contrast
    # holes are zero after the high-pass and count as nodes without contrast
    return float(cv2.meanStdDev(filter_high_pass(brightness))[1][0, 0])


@cache
def _compute_half_taps() -> Float32Array:
    """Weights of the blur of means of 2 x 2 nodes that is nearly the high-pass's of the nodes."""
    # means of two nodes and the way back between them blur by a variance of 1/4 and 3/4 node²
    sigma = math.sqrt(HIGH_PASS_NODES**2 - 1.0) / 2.0
    taps = cv2.getGaussianKernel(2 * math.ceil(4.0 * sigma) + 1, sigma)
    return taps[:, 0].astype(np.float32)


@inplace_kernel
def _mirror_index(index: int, count: int) -> int:
    """An index among so many, those beyond the ends mirrored about the end ones."""
    while count > 1 and not 0 <= index < count:
        index = -index if index < 0 else 2 * (count - 1) - index
    return index if count > 1 else 0


@inplace_kernel
def _blur(grid: Float32Array, taps: Float32Array, wide: Float32Array, out: Float32Array) -> None:
    """Fill out (rows, cols) with a grid blurred, mirrored about its end nodes.

    wide  (cols + taps.size - 1,) to work in
    """
    (rows, cols), reach = grid.shape, taps.size // 2
    inner = wide[reach : reach + cols]
    for r in range(rows):
        inner[:] = np.float32(0.0)
        for k in range(taps.size):
            weight, other = taps[k], grid[_mirror_index(r + k - reach, rows)]
            for c in range(cols):
                inner[c] += weight * other[c]
        for k in range(reach):
            wide[reach - 1 - k] = inner[_mirror_index(-1 - k, cols)]
            wide[reach + cols + k] = inner[_mirror_index(cols + k, cols)]
        line = out[r]
        line[:] = np.float32(0.0)
        for k in range(taps.size):
            weight, along = taps[k], wide[k : k + cols]
            for c in range(cols):
                line[c] += weight * along[c]


@kernel
def _measure_contrast_by_halves(brightness: Float32Array, taps: Float32Array) -> float:
    """`_measure_contrast` of a template with even sides; NaN with holes."""
    rows, cols = brightness.shape
    down, along = rows // 2, cols // 2
    quarter, three = np.float32(0.25), np.float32(0.75)
    means, soft = np.empty((down, along), np.float32), np.empty((down, along), np.float32)
    for r in range(down):
        upper, lower, line = brightness[2 * r], brightness[2 * r + 1], means[r]
        for c in range(along):
            line[c] = quarter * (upper[2 * c] + upper[2 * c + 1] + lower[2 * c] + lower[2 * c + 1])
    _blur(means, taps, np.empty(along + taps.size - 1, np.float32), soft)
    # sums a column, so that additions need not wait for each other
    totals, squares = np.zeros(cols), np.zeros(cols)
    between, local = np.empty(along + 2, np.float32), np.empty(cols, np.float32)
    for r in range(rows):
        near, here = soft[r // 2], brightness[r]
        far = soft[min(max(r // 2 + (1 if r % 2 else -1), 0), down - 1)]
        inner = between[1 : along + 1]
        for c in range(along):
            inner[c] = three * near[c] + quarter * far[c]
        between[0], between[along + 1] = inner[0], inner[along - 1]
        for c in range(along):
            local[2 * c] = three * between[c + 1] + quarter * between[c]
            local[2 * c + 1] = three * between[c + 1] + quarter * between[c + 2]
        for c in range(cols):
            value = np.float64(here[c] - local[c])
            totals[c] += value
            squares[c] += value * value
    mean = totals.sum() / (rows * cols)
    variance = squares.sum() / (rows * cols) - mean * mean
    return math.sqrt(variance) if variance > 0.0 else variance * 0.0


@dataclass(frozen=True)
class MatchPrediction:
    """Predicted quality of a match of a rendered template with its own picture under white noise.

    error_px     1-sigma error along the worst direction, nodes; infinite without contrast in some
                 direction or without any light
    correlation  0..1, of template and picture, both high-passed; zero without light
    """

    error_px: float
    correlation: float

    @property
    def score(self) -> float:
        """Error over correlation, nodes; infinite where there is nothing to match."""
        return self.error_px / self.correlation if self.correlation > 0.0 else math.inf


def predict_match(brightness: Float32Array, snr: float) -> MatchPrediction:
    """The expected error and correlation of a template's match.

    brightness  (n, n)  any unit, NaN for no data (which adds nothing)
    snr                 mean brightness over the standard deviation of a node's noise
    """
    brightness = np.ascontiguousarray(brightness, dtype=np.float32)
    mxx, mxy, myy, mean = _sum_structure_tensor(brightness)
    if mean <= 0.0:
        return MatchPrediction(math.inf, 0.0)
    smallest = 0.5 * (mxx + myy - math.hypot(mxx - myy, 2.0 * mxy))
    # 1e-12 of the brightness²: below it the difference of two sums is rounding
    known = smallest > 1e-12 * mean * mean
    contrast = _measure_contrast(brightness) / mean
    return MatchPrediction(
        mean / (snr * math.sqrt(smallest)) if known else math.inf,
        contrast / math.hypot(contrast, 1.0 / snr),
    )


@kernel
def find_best_rival(surface: Float32Array, search_nodes: float) -> float:
    """Highest local maximum of a similarity surface away from its middle, -1 when there is none.

    surface       (2k + 1, 2k + 1)  similarity, the true place in the middle
    search_nodes                    rivals beyond this distance (on either axis) do not count
    The slope of the true peak is no rival, so only local maxima count; on the outermost nodes a
    maximum is one among the neighbours that exist.
    """
    rows, cols = surface.shape
    middle = rows // 2
    best = -1.0
    for r in range(rows):
        for c in range(cols):
            distance = max(abs(r - middle), abs(c - middle))
            here = surface[r, c]
            if not (LOBE_NODES < distance <= search_nodes and here > best):
                continue
            if here >= surface[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].max():
                best = float(here)
    return best


def compute_uniqueness_margin(
    brightness: Float32Array, template_nodes: int, search_nodes: float
) -> float:
    """One minus the similarity of the best rival: 1 with none similar, 0 for a perfect double.

    brightness      (n, n)  a render of the ground about the place, NaN for no data
    template_nodes          side of the square that is described, n - template_nodes even
    search_nodes            how far the search goes, nodes; capped by the room that n leaves
    Raises ValueError when the template cannot be centred in the brightness.
    """
    rival = find_best_rival(
        compute_self_similarity_surface(brightness, template_nodes), search_nodes
    )
    return float(min(1.0 - rival, 1.0))
