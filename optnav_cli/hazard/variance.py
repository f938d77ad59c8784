"""The risk of a pad by the variance of its brightness, relative to the square of its mean.

Source: B. S. Zhukov, Autonomous optical navigation near the Moon and small bodies, thesis summary,
ch. 4. The thresholds of shadow and of mean brightness, which it does not print, are ours
(configs/models/hazard.toml): without those of the mean the criterion is worse than chance, because
slopes that face the Sun have the least contrast.
"""

import cv2
import numpy as np

from catalog.arrays import Float32Array
from catalog.errors import NoSolutionError
from optnav_cli.hazard.ground_view import MIN_PAD_CELLS, PictureOnGround
from optnav_cli.hazard.model import HazardModel
from optnav_cli.hazard.pads import RiskMap, coded, with_refusals

SCALE = 1000.0  # of the code over variance / mean^2, the paper's A
NEIGHBOUR = 0.2  # weight of the worst of the pads around, the paper's
BINS, SMOOTH_BINS = 256, 4.0  # of the histogram of brightness, and the width that smooths it
LIT_SHARE = 0.05  # of the brightest: below it the histogram is of shadow


def map_variance(view: PictureOnGround, pad_m: float, model: HazardModel) -> RiskMap:
    """The code of each pad, at the paper's step of 5 m.

    Raises NoSolutionError for a pad under three steps or wider than the picture, or a dark picture.
    """
    numbers = model.variance
    many = max(1, round(numbers.cell_m / view.cell_m))
    wide = round(pad_m / (many * view.cell_m))
    rows, cols = (size // many for size in view.brightness.shape)
    if wide < MIN_PAD_CELLS:
        raise NoSolutionError(
            f"a pad of {pad_m:g} m is under {MIN_PAD_CELLS} cells of {many * view.cell_m:.2f} m",
            "small_pad",
        )
    if wide > min(rows, cols):
        raise NoSolutionError(f"a pad of {pad_m:g} m is wider than the picture", "large_pad")
    peak = usual_brightness(view)
    shadow = (view.brightness < model.shadow * peak).astype(np.float32)
    size = rows * many, cols * many
    mean, square, dark, shown = (
        pad_means(cell_means(layer[: size[0], : size[1]], many), wide)
        for layer in (
            view.brightness,
            view.brightness**2,
            shadow,
            view.valid.astype(np.float32),
        )
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        alpha = SCALE * np.maximum(square - mean * mean, 0.0) / (mean * mean)
    alpha = np.where(np.isfinite(alpha), alpha, SCALE).astype(np.float32)
    elevations = numbers.low_sun_deg, numbers.high_sun_deg
    darkest, brightest = (
        float(np.interp(view.sun_elevation_deg, elevations, pair))
        for pair in (
            (numbers.darkest_low, numbers.darkest_high),
            (numbers.brightest_low, numbers.brightest_high),
        )
    )
    refused = {
        "not whole in the picture": shown < 0.9999,
        "shadow": dark > model.max_shadow,
        "turned from the Sun": mean < darkest * peak,
        "turned to the Sun": mean > brightest * peak,
    }
    out = np.any(list(refused.values()), axis=0)
    code = np.where(out, 255.0, np.minimum(alpha, 254.0)).astype(np.float32)
    # refused pads count as the worst neighbours; a border has none beyond it
    risk = code + np.float32(NEIGHBOUR) * worst_neighbour(code)
    made = RiskMap(
        risk,
        refused,
        origin=0.5 * (wide * many - 1),
        step=many,
        cells=wide * many,
        code=coded(np.minimum(risk, 254.0)),
        shares={"shadow_share": dark},
    )
    return with_refusals(made, {})


def usual_brightness(view: PictureOnGround) -> float:
    """The most frequent brightness of the lit ground: the peak of the smoothed histogram."""
    values = view.brightness[view.valid]
    if not values.size:
        raise NoSolutionError("the picture shows no ground that can be used", "no_ground")
    top = float(np.quantile(values, 0.995))
    if not top > 0.0:
        raise NoSolutionError("the picture holds no light", "night")
    counts, edges = np.histogram(values, BINS, (LIT_SHARE * top, 1.1 * top))
    smooth = cv2.GaussianBlur(counts.astype(np.float32)[None], (0, 0), SMOOTH_BINS)
    at = int(np.argmax(smooth))
    return float(0.5 * (edges[at] + edges[at + 1]))


def cell_means(values: Float32Array, many: int) -> Float32Array:
    """Means over squares of many x many; the sides are multiples of it."""
    rows, cols = values.shape
    grid = values.reshape(rows // many, many, cols // many, many)
    means: Float32Array = grid.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    return means


def pad_means(cells: Float32Array, wide: int) -> Float32Array:
    """Means (rows - wide + 1, cols - wide + 1) over pads that begin at each cell."""
    views = np.lib.stride_tricks.sliding_window_view(cells, (wide, wide))
    means: Float32Array = views.mean(axis=(2, 3), dtype=np.float64).astype(np.float32)
    return means


def worst_neighbour(code: Float32Array) -> Float32Array:
    """The largest of the 8 values around each; beyond the border there are none."""
    kernel = np.ones((3, 3), np.uint8)
    kernel[1, 1] = 0
    worst = cv2.dilate(code, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return worst.astype(np.float32, copy=False)
