"""Resampling between a picture and a map grid: the finer of both is averaged, not picked.

A picture is kept at several resolutions, for grids coarser than its pixels. A rendered grid finer
than them is averaged over what each pixel sees of the ground: seen obliquely that is several times
as much outwards as across, more on slopes that face away from the camera than on those that face
it, and nothing of those turned from it. A template that lacks this is found some 10 m nearer to the
camera's nadir for a squared tangent of the emission of 1, at 948 m from node to node.

`is_ground_shown` tells ground from a smooth field and rounding. Gradients, vignettes, stray light
and haze correlate with a template by up to 0.5, and in all points alike: resampled on the relief of
a terrain model, which no oblique view sees as a plane, a smooth picture shows that relief. Rounding
of counts adds stripes.
"""

import math
from functools import cached_property

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.correlation.filters import crop, filter_high_pass_quickly
from catalog.geometry.grid import interpolate_bicubic
from catalog.geometry.kernel import inplace_kernel, kernel
from optnav_cli.camera.camera import PIXEL_SIGMA_PX, Camera

FULL_SQUARE_PX = 5  # side of full squares that show no pattern
BLOCK = 512  # places that are sampled side by side
NONE = np.uint32(2**32 - 1)  # no row of a picture

# Blur of a lens of which none is stated: templates fit pictures of 0.7 px nearly as well by 0.6 as
# by 0.8.
ASSUMED_PSF_PX = 0.6
# Sigma, in nodes, of a blur that counts, in the median of some nodes. Below it the picture resolves
# what the grid holds, and of relief so fine terrain models have little that is true: over ground
# off as the Moon's is from GLD100 fixes are no better with it.
MIN_BLUR_NODES = 0.8
PROBE_NODES = 8  # from one node to the next that tell whether the blur counts
MAX_REACH_NODES = 12  # that a blur reaches to either side
# The weight (1 - d^2 / reach^2)^4 has the variance of a Gaussian whose sigma is reach / sqrt(12).
REACH = math.sqrt(12.0)


class PicturePyramid:
    """Samples a picture at any place, averaged over about the footprint of a map node.

    picture     (height, width) float32; NaN where a pixel has no value
    saturation  count from which on a pixel is full; areas of full pixels show no pattern, and have
                no value here
    """

    def __init__(self, picture: Float32Array, saturation: float | None = None) -> None:
        values = np.ascontiguousarray(picture, dtype=np.float32)
        if saturation is not None:
            values = _remove_full_areas(values, saturation)
        self._levels: dict[int, Float32Array] = {1: values}

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the picture, px."""
        height, width = self._levels[1].shape
        return int(height), int(width)

    @cached_property
    def count_step(self) -> float:
        """Between neighbouring counts of the picture; 0 where it has none."""
        return find_count_step(self._levels[1])

    def sample(self, pixels: FloatArray, pixels_per_node: float) -> Float32Array:
        """Brightness at pixels (..., 2); NaN outside the picture or where a pixel is NaN.

        pixels_per_node  picture pixels that one node of the map grid spans
        """
        height, width = self.shape
        # A block of up to one node; cubic interpolation between blocks does the rest.
        smallest_side = max(1, min(self.shape) // 8)
        factor = int(min(max(1.0, np.floor(pixels_per_node + 0.25)), smallest_side))
        level = self._level(factor)
        places = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2)
        out = np.full(len(places), np.nan, np.float32)
        _sample(level, places, factor, height, width, out)
        return out.reshape(pixels.shape[:-1])

    def _level(self, factor: int) -> Float32Array:
        if factor not in self._levels:
            picture = self._levels[1]
            rows, cols = picture.shape[0] // factor, picture.shape[1] // factor
            blocks = picture[: rows * factor, : cols * factor]
            level = cv2.resize(blocks, (cols, rows), interpolation=cv2.INTER_AREA)
            self._levels[factor] = np.asarray(level, dtype=np.float32)
        return self._levels[factor]


def _remove_full_areas(values: Float32Array, saturation: float) -> Float32Array:
    """Replace squares of full pixels in a picture (h, w) by NaN; single full pixels stay."""
    full = values >= saturation
    if np.count_nonzero(full) < FULL_SQUARE_PX**2:
        return values
    square = np.ones((FULL_SQUARE_PX, FULL_SQUARE_PX), np.uint8)
    areas = cv2.morphologyEx(full.view(np.uint8), cv2.MORPH_OPEN, square) > 0
    return np.where(areas, np.float32(np.nan), values) if areas.any() else values


@kernel
def _sample(
    level: Float32Array,
    pixels: FloatArray,
    factor: int,
    height: int,
    width: int,
    out: Float32Array,
) -> None:
    """Fill brightness (n,) at pixels (n, 2) of a picture, from its means over blocks of `factor`.

    Places outside the picture stay as they are.
    """
    # Not cv2.remap: its cubic kernel (a = -3/4) does not give a ramp back. It moves a pattern by
    # up to 0.05 px, the same at all nodes of a grid that happens to step with the pixels.
    rows, cols = level.shape
    # the centre of the first block of `factor` pixels lies at (factor - 1) / 2
    shift, inverse = (factor - 1) / 2.0, 1.0 / factor
    row, col = np.empty(BLOCK), np.empty(BLOCK)
    top, left = np.empty(BLOCK, np.uint32), np.empty(BLOCK, np.uint32)
    down, across = np.empty((4, BLOCK), np.float32), np.empty((4, BLOCK), np.float32)
    next_one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)
    for first in range(0, out.size, BLOCK):
        size = min(BLOCK, out.size - first)
        # loops of their own over plain arrays: the processor takes several places at once
        for k in range(size):
            x, y = pixels[first + k, 0], pixels[first + k, 1]
            seen = (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
            # the last rows and columns that fill no whole block take the nearest block's value
            row[k] = min((y - shift) * inverse, rows - 0.5) if seen else np.nan
            col[k] = min((x - shift) * inverse, cols - 0.5) if seen else np.nan
        for k in range(size):
            inner = (row[k] >= 1.0) & (row[k] < rows - 2.0)
            inner &= (col[k] >= 1.0) & (col[k] < cols - 2.0)
            r, c = np.int32(row[k] if inner else 1.0), np.int32(col[k] if inner else 1.0)
            top[k], left[k] = r - 1 if inner else NONE, c - 1
            down[0, k], across[0, k] = np.float32(row[k] - r), np.float32(col[k] - c)
        for k in range(size):
            weights = _compute_weights(down[0, k])
            down[0, k], down[1, k], down[2, k], down[3, k] = weights
            weights = _compute_weights(across[0, k])
            across[0, k], across[1, k], across[2, k], across[3, k] = weights
        for k in range(size):
            if top[k] == NONE:
                if row[k] == row[k]:
                    out[first + k] = interpolate_bicubic(level, row[k], col[k])
                continue
            # as interpolate_bicubic, in single precision, as a picture is stored: half the time;
            # indices are unsigned: none counts from the end
            i, j = np.uint64(top[k]), np.uint64(left[k])
            x0, x1, x2, x3 = across[0, k], across[1, k], across[2, k], across[3, k]
            value = np.float32(0.0)
            for w in range(4):
                a, b = level[i, j], level[i, j + next_one]
                d, e = level[i, j + two], level[i, j + three]
                value += down[w, k] * (x0 * a + x1 * b + x2 * d + x3 * e)
                i += next_one
            out[first + k] = value


@inplace_kernel
def _compute_weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Compute `cubic_weights` in single precision."""
    half, two = np.float32(0.5), np.float32(2.0)
    t2, t3 = t * t, t * t * t
    outer = t2 - half * (t + t3)
    inner = half * t + two * t2 - np.float32(1.5) * t3
    return outer, np.float32(1.0) - outer - inner - half * (t3 - t2), inner, half * (t3 - t2)


def get_blur_px(camera: Camera) -> float:
    """Return the sigma of the blur of a camera's lens and pixels together, px."""
    known = camera.known_blur_px
    return math.hypot(ASSUMED_PSF_PX, PIXEL_SIGMA_PX) if known is None else known[0]


def average_as_seen(grid: Float32Array, pixels: FloatArray, sigma_px: float) -> Float32Array:
    """Average each node of a grid (n, n) as seen; pixels (m, m, 2), m > n, about its middle.

    pixels    where the nodes are seen; NaN outside the camera's view
    sigma_px  of the camera's blur, see `get_blur_px`
    NaN of the grid stays and takes no part. The grid itself where the blur is below MIN_BLUR_NODES.
    """
    size, border = grid.shape[0], (pixels.shape[0] - grid.shape[0]) // 2
    places = np.ascontiguousarray(pixels)
    area, reach = np.zeros((size, size)), np.zeros((2, size, size), np.float32)
    _fill_footprints(places, border, sigma_px * REACH, PROBE_NODES, area, reach)
    probed = reach[:, ::PROBE_NODES, ::PROBE_NODES]
    if np.median(probed, axis=(1, 2)).max() < MIN_BLUR_NODES * REACH:
        return grid
    _fill_footprints(places, border, sigma_px * REACH, 1, area, reach)
    out = np.empty_like(grid)
    _average(grid, places, border, area, reach, sigma_px * REACH, out)
    return out


@kernel
def _fill_footprints(
    pixels: FloatArray,
    border: int,
    reach_px: float,
    step: int,
    area: FloatArray,
    reach: Float32Array,
) -> None:
    """Fill the picture area of some nodes, and how far a circle about each reaches.

    step   from one node to the next
    area   (size, size) px^2, 0 of ground that is turned from the camera
    reach  (2, size, size) nodes down and along that `reach_px` spans
    """
    size, facing = area.shape[0], 0.0
    for i in range(0, size, step):
        for j in range(0, size, step):
            p, q = i + border, j + border
            down_x = 0.5 * (pixels[p + 1, q, 0] - pixels[p - 1, q, 0])
            down_y = 0.5 * (pixels[p + 1, q, 1] - pixels[p - 1, q, 1])
            along_x = 0.5 * (pixels[p, q + 1, 0] - pixels[p, q - 1, 0])
            along_y = 0.5 * (pixels[p, q + 1, 1] - pixels[p, q - 1, 1])
            turned = down_x * along_y - down_y * along_x
            if turned == turned and turned != 0.0:
                area[i, j] = turned
                facing += turned
                reach[0, i, j] = reach_px * math.hypot(along_x, along_y) / abs(turned)
                reach[1, i, j] = reach_px * math.hypot(down_x, down_y) / abs(turned)
    # ground that is turned from the camera is seen the other way round
    sign = 1.0 if facing >= 0.0 else -1.0
    for i in range(0, size, step):
        for j in range(0, size, step):
            area[i, j] = max(sign * area[i, j], 0.0)


@kernel
def _average(
    grid: Float32Array,
    pixels: FloatArray,
    border: int,
    area: FloatArray,
    reach: Float32Array,
    reach_px: float,
    out: Float32Array,
) -> None:
    size, per_square = grid.shape[0], 1.0 / reach_px**2
    for i in range(size):
        for j in range(size):
            out[i, j] = grid[i, j]
            x, y = pixels[i + border, j + border, 0], pixels[i + border, j + border, 1]
            if grid[i, j] != grid[i, j] or reach[0, i, j] == 0.0:
                continue
            down = int(min(reach[0, i, j], MAX_REACH_NODES - 1)) + 1
            along = int(min(reach[1, i, j], MAX_REACH_NODES - 1)) + 1
            total = weights = 0.0
            for r in range(max(i - down, 0), min(i + down + 1, size)):
                for c in range(max(j - along, 0), min(j + along + 1, size)):
                    dx = pixels[r + border, c + border, 0] - x
                    dy = pixels[r + border, c + border, 1] - y
                    left = 1.0 - (dx * dx + dy * dy) * per_square
                    if left > 0.0 and grid[r, c] == grid[r, c]:
                        weight = left * left * left * left * area[r, c]
                        total += weight * grid[r, c]
                        weights += weight
            if weights > 0.0:
                out[i, j] = total / weights


# Along each side of the surface over the picture that is taken out: ground in 48 to 96 nodes keeps
# 0.85 to 1.00 of its variance without it, smooth fields little but rounding.
SURFACE_TERMS = 5


def is_ground_shown(
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
    total, rough = (float(np.mean(np.square(grid[shown], dtype=np.float64))) for grid in both)
    # Uniform rounding has a variance of 1/12 of a step squared, that of a slow gradient beats with
    # the nodes: 1.5 times as much. Ground keeps half of the high-passed variance and more.
    return rough > (1.5 / 12.0) * count_step**2 and rough > 0.5 * total


def _smooth_picture(patch: Float32Array, pixels: FloatArray, valid: BoolArray) -> FloatArray:
    """Fit a surface of few terms in the picture's own coordinates (n, n)."""
    # The surface is fitted to every seventh node.
    values, every = patch[valid].astype(np.float64), slice(None, None, 7)
    across, down = (_compute_powers(pixels[..., axis][valid]) for axis in (0, 1))
    few = (across[every, :, None] * down[every, None, :]).reshape(-1, SURFACE_TERMS**2)
    normal = few.T @ few
    normal += 1e-12 * np.trace(normal) * np.eye(len(normal))  # a patch may be a line of pixels
    strengths = np.linalg.solve(normal, few.T @ (values[every] - values.mean()))
    smooth = np.zeros(patch.shape)
    smooth[valid] = values.mean() + np.einsum(
        "na,na->n", across @ strengths.reshape(SURFACE_TERMS, SURFACE_TERMS), down
    )
    return smooth


def _compute_powers(places: FloatArray) -> FloatArray:
    """Compute powers (n, SURFACE_TERMS) of coordinates (n,), scaled to -1 to 1."""
    low, high = places.min(), places.max()
    return np.vander(2.0 * (places - low) / max(high - low, 1e-9) - 1.0, SURFACE_TERMS)


def find_count_step(picture: Float32Array) -> float:
    """Find the step between counts of a picture (h, w): their greatest common divisor.

    Returns 0 for fractions, and where the values are all alike.
    """
    known = picture[np.isfinite(picture)]
    values = np.unique(known[:: max(1, known.size // 65_536)])
    rounded = np.rint(values).astype(np.int64)
    # More than 16384 values among 65536 pixels are no counts of a camera.
    if not 1 < values.size <= 16_384 or (rounded != values).any():
        return 0.0
    return float(np.gcd.reduce(np.diff(rounded)))
