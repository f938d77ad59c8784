"""Slopes from shading: the risk of a pad as the share of it that is expected to be dangerous.

Under a low Sun brightness tells the slope along the Sun nearly exactly, and a surface ties the
other component to it: heights h of the spectrum P_h that fit the measured slopes p along the Sun
are, in Fourier space, p k_p / (i (k_p^2 + N / P_h)). Where the picture does not show the ground
(beyond its edges, in holes) p is what those heights give, found by iterating; a picture that is
merely mirrored or cut off there puts streaks along the Sun into the other component.

A pixel in shadow is as dark as ground that the Sun just grazes, and is taken for it: from the crest
to the shadow's end the ground falls by just as much.

Approximations, ours: the mean slope of a picture is taken for zero, as brightness does not show it.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import fft
from scipy.special import ndtr

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.geometry.kernel import kernel
from catalog.geometry.vectors import unit
from catalog.photometry.laws import find_law
from catalog.terrain.slopes import BASE_M, CRITICAL_DEG, DANGEROUS_DEG
from optnav_cli.hazard.ground_view import PictureOnGround, average_boxes, resize_grid
from optnav_cli.hazard.settings import ErrorOfSlopes, HazardModel, interpolate_terms

MARGIN_CELLS = 64  # around the picture, which its ground is continued over
STEPS = 512  # of a table of slopes by brightness
MAX_RATIO = 8.0  # brightness that the table reaches to, over that of level ground
PROBE = 7  # cells between those that the brightness of level ground is found from
# The normal distribution by the number of sigmas, read with linear steps: right to 1e-5.
CHANCE_STEPS, CHANCE_REACH = 128.0, 5.0  # a sigma, sigmas to either side
CHANCES: Float32Array = ndtr(
    np.arange(2.0 * CHANCE_STEPS * CHANCE_REACH + 1.0) / CHANCE_STEPS - CHANCE_REACH
).astype(np.float32)


class ShadedSlopes(NamedTuple):
    """Slopes and their risk from shading, (rows, cols) each.

    toward, across  tangents of the slope on BASE_M: along the direction to the Sun, and along that
                    turned left by 90 deg
    dangerous, critical  probabilities that the slope is above 7 and 15 deg
    sigma           1-sigma error of the slope, a tangent
    shadow          1 where the picture is dark, else 0
    """

    toward: Float32Array
    across: Float32Array
    dangerous: Float32Array
    critical: Float32Array
    sigma: Float32Array
    shadow: Float32Array


def map_slopes(view: PictureOnGround, model: HazardModel, law: str = "hapke") -> ShadedSlopes:
    """Map the slopes of the ground that a picture shows.

    law  of brightness, as `catalog.photometry` names it
    Raises NoSolutionError for a picture without contrast or light.
    """
    curves = _compute_curves(view, law)
    level = find_level_brightness(view, curves)
    toward, shadow = np.empty((2, *view.brightness.shape), np.float32)
    _invert(view.brightness, curves.slopes, 1.0 / level, model.shadow, toward, shadow)
    numbers = model.shading
    toward, across = _complete_slopes(view, toward, curves, numbers.noise, numbers.spectrum)
    across_base = max(1, round(BASE_M / view.cell_m))
    toward, across = average_boxes(toward, across_base), average_boxes(across, across_base)
    return rate_danger(view, toward, across, shadow, model)


def measure_slopes_toward(view: PictureOnGround, law: str) -> Float32Array:
    """Measure slopes along the Sun (rows, cols), tangents, from brightness alone.

    Raises NoSolutionError for a picture without light.
    """
    curves = _compute_curves(view, law)
    level = find_level_brightness(view, curves)
    toward = np.empty(view.brightness.shape, np.float32)
    _invert(view.brightness, curves.slopes, 1.0 / level, 0.0, toward, np.empty_like(toward))
    return toward


def rate_danger(
    view: PictureOnGround,
    toward: Float32Array,
    across: Float32Array,
    shadow: Float32Array,
    model: HazardModel,
    width_m: float | None = None,
) -> ShadedSlopes:
    """Rate how likely slopes are dangerous.

    width_m  of the widest picture that the slopes are from; None: the view's
    """
    numbers = model.shading
    squares, local, regional, dark = _average_surroundings(view, toward, across, shadow, model)
    dangerous, critical, sigma = np.empty((3, *squares.shape), np.float32)
    # the sigma that is stated is that of slopes about the lower limit
    for part, limit, out in (
        (numbers.critical, CRITICAL_DEG, critical),
        (numbers.dangerous, DANGEROUS_DEG, dangerous),
    ):
        terms = _combine_terms(part, model, view, limit, width_m)
        _rate(squares, local, regional, dark, terms, out, sigma)
    return ShadedSlopes(toward, across, dangerous, critical, sigma, shadow)


def _average_surroundings(
    view: PictureOnGround,
    toward: Float32Array,
    across: Float32Array,
    shadow: Float32Array,
    model: HazardModel,
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
    """Compute squared slopes, their means near and farther about, and the share of shadow near."""
    numbers, cell = model.shading, view.cell_m
    squares = toward * toward + across * across
    near, farther = _count_cells(numbers.local_m, cell), _count_cells(numbers.regional_m, cell)
    means = average_boxes(squares, near), average_boxes(squares, farther)
    return squares, *means, average_boxes(shadow, near)


def compute_rating_features(
    view: PictureOnGround, slopes: ShadedSlopes, model: HazardModel
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
    """Compute what rates danger: slope, its rms near and farther about, the share of shadow."""
    parts = _average_surroundings(view, slopes.toward, slopes.across, slopes.shadow, model)
    return np.sqrt(parts[0]), np.sqrt(parts[1]), np.sqrt(parts[2]), parts[3]


class Curves(NamedTuple):
    """Slopes along the Sun by brightness at 3 x 3 places of a view.

    slopes  (3, 3, STEPS) by brightness over that of level ground at the middle of the view, from 0
            up; [..., 0] is the Sun's own slope
    aside   (3, 3) how a slope across the Sun passes for one along it: the ratio of what they do
    """

    slopes: Float32Array
    aside: FloatArray


def _compute_curves(view: PictureOnGround, law: str) -> Curves:
    """Tabulate a law at the corners, edges and middle of a view."""
    rows, cols = view.brightness.shape
    azimuth, reflectance = view.sun_azimuth, find_law(law)
    toward = np.array([math.sin(azimuth), math.cos(azimuth), 0.0])
    left = np.array([-toward[1], toward[0], 0.0])
    grazing = view.sun[2] / math.hypot(view.sun[0], view.sun[1])
    # From grazing to a tangent of 1.5: brightness of steeper ground that faces the Sun is no guide.
    p = np.linspace(grazing, -1.5, 400)
    q = np.array([-0.02, 0.02])
    slopes, aside = np.empty((3, 3, STEPS), np.float32), np.empty((3, 3))

    def compute_brightness(
        along: FloatArray, over: FloatArray, to_camera: FloatArray
    ) -> FloatArray:
        normals = np.array([0.0, 0.0, 1.0]) - along[:, None] * toward - over[:, None] * left
        normals = unit(normals)
        return reflectance(normals @ view.sun, normals @ to_camera, float(view.sun @ to_camera))

    zero = np.zeros(1)
    middle = float(compute_brightness(zero, zero, unit(view.camera_m))[0])
    for i, row in enumerate((0.0, 0.5 * (rows - 1), rows - 1.0)):
        for j, col in enumerate((0.0, 0.5 * (cols - 1), cols - 1.0)):
            x, y = view.xy_m(row, col)
            to_camera = unit(view.camera_m - np.array([float(x), float(y), 0.0]))
            ratio = compute_brightness(p, np.zeros(p.size), to_camera) / middle
            ratio[0] = 0.0
            top = int(np.argmax(ratio)) + 1  # ground beyond gets darker again
            rising = np.maximum.accumulate(ratio[:top]) + 1e-9 * np.arange(top)
            slopes[i, j] = np.interp(np.linspace(0.0, MAX_RATIO, STEPS), rising, p[:top])
            level = np.zeros(2)
            by_p, by_q = (
                compute_brightness(q, level, to_camera),
                compute_brightness(level, q, to_camera),
            )
            aside[i, j] = (by_q[1] - by_q[0]) / (by_p[1] - by_p[0])
    return Curves(slopes, aside)


def find_level_brightness(view: PictureOnGround, curves: Curves) -> float:
    """Find the brightness of level ground at the view's middle: the mean slope along the Sun is 0.

    Raises NoSolutionError for a picture without light.
    """
    probes = np.ix_(*(_place_probes(size) for size in view.valid.shape))
    rows, cols = np.nonzero(view.valid[probes])
    if not rows.size:
        raise NoSolutionError("the picture shows no ground that can be used", "no_ground")
    values = np.ascontiguousarray(view.brightness[probes])
    low, high = np.log(np.maximum(np.quantile(values[rows, cols], [0.02, 0.995]), 1e-9))
    if not high > math.log(1e-6):
        raise NoSolutionError("the picture holds no light", "night")
    low = min(low, high - 6.0)
    out, shadow = np.empty((2, *values.shape), np.float32)
    high += 3.0
    for _ in range(18):
        level = math.exp(0.5 * (low + high))
        _invert(values, curves.slopes, 1.0 / level, 0.0, out, shadow)
        if float(out[rows, cols].mean()) > 0.0:
            high = math.log(level)
        else:
            low = math.log(level)
    return math.exp(0.5 * (low + high))


def _place_probes(size: int) -> IntArray:
    """Return cells about PROBE apart, symmetric: a turned picture has the same ones."""
    first = np.arange(0, (size + 1) // 2, PROBE)
    return np.unique(np.concatenate([first, size - 1 - first]))


@kernel
def _invert(
    brightness: Float32Array,
    tables: Float32Array,
    scale: float,
    dark: float,
    out: Float32Array,
    shadow: Float32Array,
) -> None:
    """Fill slopes along the Sun, and 1 where the brightness is below `dark` of level ground's."""
    rows, cols = brightness.shape
    last = tables.shape[2] - 1
    per_step = np.float32(last / MAX_RATIO)
    for i in range(rows):
        y = 2.0 * i / max(rows - 1, 1)
        top = min(int(y), 1)
        for j in range(cols):
            x = 2.0 * j / max(cols - 1, 1)
            left = min(int(x), 1)
            ratio = brightness[i, j] * np.float32(scale)
            shadow[i, j] = np.float32(1.0) if ratio < dark else np.float32(0.0)
            at = min(max(ratio * per_step, np.float32(0.0)), np.float32(last) - np.float32(1e-3))
            k = int(at)
            f = at - np.float32(k)
            total = np.float32(0.0)
            for a in range(2):
                down = np.float32(y - top if a else 1.0 - (y - top))
                for b in range(2):
                    weight = down * np.float32(x - left if b else 1.0 - (x - left))
                    low, high = tables[top + a, left + b, k], tables[top + a, left + b, k + 1]
                    total += weight * (low + f * (high - low))
            out[i, j] = total


def _complete_slopes(
    view: PictureOnGround, toward: Float32Array, curves: Curves, noise: float, spectrum: float
) -> tuple[Float32Array, Float32Array]:
    """Complete slopes along and across the Sun from those that brightness gives along it.

    The ground beyond is continued at half the resolution: what it does to the picture is smooth.
    """
    rows, cols = toward.shape
    aside = resize_grid(
        curves.aside.astype(np.float32), (cols, rows)
    )  # smooth: places hardly count
    # Slopes across the Sun that change brightness by less than 2 % of those along it are neglected.
    slanted = float(np.abs(curves.aside).max()) > 0.02
    continued, across = _continue_slopes(
        view, toward, aside if slanted else None, (noise, spectrum)
    )
    toward = toward - aside * across if slanted else toward
    margin = MARGIN_CELLS
    big = resize_grid(continued, (continued.shape[1] * 2, continued.shape[0] * 2))
    inside = big[margin : margin + rows, margin : margin + cols]
    np.copyto(inside, toward, where=view.valid)
    spread = fft.rfft2(big)
    filters = _make_filters(big.shape, view.cell_m, view.sun_azimuth, noise, spectrum)
    full = fft.irfft2(spread * filters.across, s=big.shape)
    across = full[margin : margin + rows, margin : margin + cols]
    return np.where(view.valid, toward, inside), np.ascontiguousarray(across)


def _continue_slopes(
    view: PictureOnGround,
    toward: Float32Array,
    aside: Float32Array | None,
    numbers: tuple[float, float],
) -> tuple[Float32Array, Float32Array]:
    """Continue slopes along the Sun over the picture's surroundings, every second cell.

    Also returns the picture's slopes across the Sun (zeros where `aside` is None).
    """
    rows, cols = toward.shape
    half = MARGIN_CELLS // 2
    shape = tuple(_find_fast_length(size + 2 * MARGIN_CELLS) // 2 for size in (rows, cols))
    high, wide = (rows + 1) // 2, (cols + 1) // 2
    inside = slice(half, half + high), slice(half, half + wide)
    weights = view.valid.astype(np.float32)
    padding = ((0, 2 * high - rows), (0, 2 * wide - cols))
    if padding != ((0, 0), (0, 0)):
        toward, weights = np.pad(toward, padding, "edge"), np.pad(weights, padding)
    sums = resize_grid(toward * weights, (wide, high))
    share = resize_grid(weights, (wide, high))
    known = share > 0.5
    data = np.divide(sums, share, out=np.zeros_like(sums), where=known)
    small = None if aside is None else resize_grid(aside, (wide, high))
    filters = _make_filters(shape, 2.0 * view.cell_m, view.sun_azimuth, *numbers)
    field, before = np.zeros(shape, np.float32), None
    field[inside] = data
    across = np.zeros((high, wide), np.float32)
    # More than eight passes gain little.
    for number in range(8):
        spread = fft.rfft2(field)
        smooth = fft.irfft2(spread * filters.toward, s=shape)
        if small is not None:
            across = fft.irfft2(spread * filters.across, s=shape)[inside]
        # Nesterov's momentum: what lies far from the picture settles in fewer passes
        ahead = 0.0 if before is None else number / (number + 3.0)
        field = smooth if before is None else smooth + np.float32(ahead) * (smooth - before)
        before = smooth
        measured = data if small is None else data - small * across
        field[inside] = np.where(known, measured, field[inside])
    full = resize_grid(across, (2 * wide, 2 * high))[:rows, :cols]
    return field, full


class Filters(NamedTuple):
    """Filters from the spectrum of slopes along the Sun to the slopes of the fitted heights."""

    toward: Float32Array
    across: Float32Array


@lru_cache(maxsize=4)
def _make_filters(
    shape: tuple[int, int], cell_m: float, azimuth: float, noise: float, spectrum: float
) -> Filters:
    rows, cols = shape
    # rows run against y
    k_y = -2.0 * np.pi * np.fft.fftfreq(rows, cell_m)[:, None]
    k_x = 2.0 * np.pi * np.fft.rfftfreq(cols, cell_m)[None, :]
    along = k_x * math.sin(azimuth) + k_y * math.cos(azimuth)
    left = -k_x * math.cos(azimuth) + k_y * math.sin(azimuth)
    square = k_x**2 + k_y**2
    square[0, 0] = 1.0
    # The noise of slopes is stated at a wavelength of 20 m.
    per_height = noise * square * (square * (20.0 / (2.0 * np.pi)) ** 2) ** (0.5 * spectrum - 1.0)
    gain = along / (along**2 + per_height)
    return Filters((along * gain).astype(np.float32), (left * gain).astype(np.float32))


def _find_fast_length(size: int) -> int:
    """Find an even length of at least this whose transform, and that of its half, is fast."""
    return 2 * int(fft.next_fast_len((size + 1) // 2, real=True))


def _count_cells(length_m: float, cell_m: float) -> int:
    """Count the cells of a length: the nearest odd number."""
    return max(1, 2 * round(0.5 * (length_m / cell_m - 1.0)) + 1)


def compute_width_m(view: PictureOnGround) -> float:
    """Compute the side of the square whose area a picture shows, m."""
    return max(math.sqrt(float(np.count_nonzero(view.valid))), 1.0) * view.cell_m


def compute_narrowness(
    view: PictureOnGround, model: HazardModel, width_m: float | None = None
) -> float:
    """Compute how much smaller a picture is than one that shows all waves: 0; 1 for a quarter."""
    wide = compute_width_m(view) if width_m is None else width_m
    return max(math.sqrt(model.shading.wide_m / wide) - 1.0, 0.0)


def _combine_terms(
    part: ErrorOfSlopes,
    model: HazardModel,
    view: PictureOnGround,
    limit_deg: float,
    width_m: float | None,
) -> Float32Array:
    """Combine the terms of a view for `_rate`."""
    elevations, elevation = model.shading.sun_elevation_deg, view.sun_elevation_deg
    limit, local, regional, dark, sigma, by_local, by_dark, narrow, by_narrow = interpolate_terms(
        part, elevations, elevation
    )
    x = compute_narrowness(view, model, width_m)
    limit *= math.tan(math.radians(limit_deg))
    combined = limit, local, regional + x * narrow, dark, sigma, by_local, by_dark, x * by_narrow
    return np.array(combined, np.float32)


@kernel
def _rate(
    squares: Float32Array,
    local: Float32Array,
    regional: Float32Array,
    dark: Float32Array,
    terms: Float32Array,
    out: Float32Array,
    sigma: Float32Array,
) -> None:
    """Fill how likely slopes (their squares) are above a limit; terms: see `_combine_terms`."""
    limit, by_local, by_regional, by_dark = terms[0], terms[1], terms[2], terms[3]
    base, more_local, more_dark, more_regional = terms[4], terms[5], terms[6], terms[7]
    steps, reach, least = np.float32(CHANCE_STEPS), np.float32(CHANCE_REACH), np.float32(0.01)
    last = 2.0 * reach * steps - np.float32(1.0)
    for i in range(squares.shape[0]):
        for j in range(squares.shape[1]):
            s, r, f = np.sqrt(squares[i, j]), np.sqrt(local[i, j]), dark[i, j]
            wide = np.sqrt(regional[i, j])
            above = s - limit + by_local * r + by_regional * wide + by_dark * f
            width = max(base + more_local * r + more_dark * f + more_regional * wide, least)
            sigma[i, j] = width
            at = min(max((above / width + reach) * steps, np.float32(0.0)), last)
            k = int(at)
            low = CHANCES[k]
            out[i, j] = low + (at - np.float32(k)) * (CHANCES[k + 1] - low)
