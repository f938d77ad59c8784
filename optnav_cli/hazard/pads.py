"""Pads for landing: their risk by slopes or by variance of brightness, and the best of each square.

Source of the scheme (a pad of 20 m in squares of 200 m, an 8-bit code whose 255 refuses) and of the
variance of a pad's brightness relative to the square of its mean: B. S. Zhukov, Autonomous optical
navigation near the Moon and small bodies, thesis summary, ch. 4. It does not print the thresholds
of shadow and of mean brightness: configs/models/hazard.toml has ours. Without those of the mean the
criterion is worse than chance, because slopes that face the Sun have the least contrast.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from catalog.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.terrain.slopes import convert_to_degrees
from optnav_cli.hazard.ground_view import MIN_PAD_CELLS, PictureOnGround, average_boxes
from optnav_cli.hazard.settings import HazardModel
from optnav_cli.hazard.shading import ShadedSlopes

REFUSED = 255
MAX_CODE = 254
WHOLE = 0.9999  # of a pad that the picture shows; sums of shares round
SCALE = 1000.0  # of the code over variance / mean^2, the paper's A


@dataclass(frozen=True, eq=False)
class RiskMap:
    """Risk of each pad, (rows, cols) by its middle.

    score    lower is better; infinite where refused
    refused  by reason, in the order of the report
    origin   (fractional) cell of a view where the first pad's middle lies, down and across alike
    step     cells of the view from one pad to the next
    cells    of the view that a pad is wide
    code     what risk.tif holds
    shares   what is known of each pad, by the column of pads.csv
    """

    score: Float32Array
    refused: Mapping[str, BoolArray]
    origin: float
    step: int
    cells: int
    code: ByteArray
    shares: Mapping[str, Float32Array] = field(default_factory=dict)

    def find_middles(self, shape: tuple[int, ...]) -> tuple[IntArray, ...]:
        """Find the cells of a view of a shape that the pads' middles lie in, for indexing."""
        places = (
            np.minimum(np.rint(self.origin + self.step * np.arange(size)).astype(int), limit - 1)
            for size, limit in zip(self.score.shape, shape)
        )
        return np.ix_(*places)


@dataclass(frozen=True)
class Pad:
    """The best pad of a square, or why there is none.

    square       row and column of the square, from the upper left
    cell         (fractional) row and column of the pad's middle in the view; None for no pad
    shares       what is known of it, by the column of pads.csv
    """

    square: tuple[int, int]
    cell: tuple[float, float] | None
    shares: Mapping[str, float]
    reason: str = ""


def count_odd_cells(length_m: float, cell_m: float) -> int:
    """Count the cells of a length: the least odd number that it fits into."""
    cells = math.ceil(length_m / cell_m - 1e-6)
    return cells + 1 - cells % 2


def count_pad_cells(view: PictureOnGround, pad_m: float) -> int:
    """Count the cells of a pad's side: the least odd number that it fits into.

    Raises NoSolutionError for a pad of under three cells or wider than the picture.
    """
    cells = math.ceil(pad_m / view.cell_m - 1e-6)
    rows, cols = view.brightness.shape
    if cells < MIN_PAD_CELLS:
        raise NoSolutionError(
            f"a pad of {pad_m:g} m is under {MIN_PAD_CELLS} cells of {view.cell_m:.2f} m; "
            "wanted a wider one, or a picture from less height",
            "small_pad",
        )
    if cells > min(rows, cols):
        raise NoSolutionError(
            f"a pad of {pad_m:g} m is wider than the picture, which shows {cols * view.cell_m:.0f}"
            f" x {rows * view.cell_m:.0f} m of ground",
            "large_pad",
        )
    return count_odd_cells(pad_m, view.cell_m)


def rate_slopes(
    view: PictureOnGround, slopes: ShadedSlopes, pad_m: float, model: HazardModel
) -> RiskMap:
    """Rate each pad by its expected share of dangerous slopes; refuse shaded and cut ones."""
    cells = count_pad_cells(view, pad_m)
    shown = average_boxes(view.valid.astype(np.float32), cells, 0.0) >= WHOLE
    degrees = convert_to_degrees(np.stack([slopes.toward, slopes.across]))
    shares = {
        "expected_dangerous_share": average_boxes(slopes.dangerous, cells, 0.0),
        "expected_critical_share": average_boxes(slopes.critical, cells, 0.0),
        "shadow_share": average_boxes(slopes.shadow, cells, 0.0),
        "mean_slope_deg": average_boxes(degrees, cells, 0.0),
    }
    refused = {
        "not whole in the picture": ~shown,
        "shadow": shares["shadow_share"] > model.limit_shadow(view.sun_elevation_deg),
    }
    expected = np.clip(shares["expected_dangerous_share"], 0.0, 1.0)
    score = expected + shares["mean_slope_deg"] * np.float32(math.radians(model.flatness))
    score += shares["expected_critical_share"]
    return add_refusals(
        RiskMap(score, refused, 0.0, 1, cells, encode_risk(MAX_CODE * expected), shares), {}
    )


@dataclass(frozen=True, eq=False)
class PadBrightness:
    """Brightness of all pads, (rows, cols) by their middles, at the paper's step of 5 m.

    alpha  1000 x variance over the squared mean
    level  mean over the most frequent brightness of lit ground
    dark   share of shadow
    shown  share that the picture shows
    step   cells of the view from one pad to the next;  cells  of the view that a pad is wide
    """

    alpha: Float32Array
    level: Float32Array
    dark: Float32Array
    shown: Float32Array
    step: int
    cells: int


def map_variance(view: PictureOnGround, pad_m: float, model: HazardModel) -> RiskMap:
    """Map the code of each pad, at the paper's step of 5 m.

    Raises NoSolutionError for a pad under three steps or wider than the picture, or a dark picture.
    """
    return rate_brightness(measure_brightness(view, pad_m, model), model)


def measure_brightness(view: PictureOnGround, pad_m: float, model: HazardModel) -> PadBrightness:
    """Measure mean and variance of brightness of all pads. Raises as `map_variance`."""
    many = max(1, round(model.variance.cell_m / view.cell_m))
    wide = round(pad_m / (many * view.cell_m))
    rows, cols = (size // many for size in view.brightness.shape)
    if wide < MIN_PAD_CELLS:
        raise NoSolutionError(
            f"a pad of {pad_m:g} m is under {MIN_PAD_CELLS} cells of {many * view.cell_m:.2f} m",
            "small_pad",
        )
    if wide > min(rows, cols):
        raise NoSolutionError(f"a pad of {pad_m:g} m is wider than the picture", "large_pad")
    peak = find_usual_brightness(view)
    shadow = (view.brightness < model.shadow * peak).astype(np.float32)
    size = rows * many, cols * many
    mean, square, dark, shown = (
        average_pads(average_cells(layer[: size[0], : size[1]], many), wide)
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
    return PadBrightness(alpha, mean / np.float32(peak), dark, shown, many, wide * many)


def rate_brightness(pads: PadBrightness, model: HazardModel) -> RiskMap:
    """Rate pads by the variance of their brightness; refuse dark, bright, shaded and cut ones."""
    refused = {
        "not whole in the picture": pads.shown < WHOLE,
        "shadow": pads.dark > model.max_shadow,
        "turned from the Sun": pads.level < model.variance.darkest,
        "turned to the Sun": pads.level > model.variance.brightest,
    }
    out = np.any(list(refused.values()), axis=0)
    code = np.where(out, 255.0, np.minimum(pads.alpha, 254.0)).astype(np.float32)
    # the worst of the pads around weighs 0.2, the paper's; refused pads count as the worst, and a
    # border has none beyond it
    risk = code + np.float32(0.2) * find_worst_neighbour(code)
    made = RiskMap(
        risk,
        refused,
        origin=0.5 * (pads.cells - 1),
        step=pads.step,
        cells=pads.cells,
        code=encode_risk(np.minimum(risk, 254.0)),
        shares={"shadow_share": pads.dark},
    )
    return add_refusals(made, {})


def find_usual_brightness(view: PictureOnGround) -> float:
    """Find the most frequent brightness of lit ground: the peak of the smoothed histogram."""
    values = view.brightness[view.valid]
    if not values.size:
        raise NoSolutionError("the picture shows no ground that can be used", "no_ground")
    top = float(np.quantile(values, 0.995))
    if not top > 0.0:
        raise NoSolutionError("the picture holds no light", "night")
    # below 5 % of the brightest the histogram is of shadow; a width of 4 of 256 bins smooths it
    counts, edges = np.histogram(values, 256, (0.05 * top, 1.1 * top))
    smooth = cv2.GaussianBlur(counts.astype(np.float32)[None], (0, 0), 4.0)
    at = int(np.argmax(smooth))
    return float(0.5 * (edges[at] + edges[at + 1]))


def average_cells(values: Float32Array, many: int) -> Float32Array:
    """Average squares of many x many; the sides are multiples of it."""
    rows, cols = values.shape
    grid = values.reshape(rows // many, many, cols // many, many)
    means: Float32Array = grid.mean(axis=(1, 3), dtype=np.float64).astype(np.float32)
    return means


def average_pads(cells: Float32Array, wide: int) -> Float32Array:
    """Average pads that begin at each cell: (rows - wide + 1, cols - wide + 1)."""
    views = np.lib.stride_tricks.sliding_window_view(cells, (wide, wide))
    means: Float32Array = views.mean(axis=(2, 3), dtype=np.float64).astype(np.float32)
    return means


def find_worst_neighbour(code: Float32Array) -> Float32Array:
    """Find the largest of the 8 values around each; beyond the border there are none."""
    kernel = np.ones((3, 3), np.uint8)
    kernel[1, 1] = 0
    worst = cv2.dilate(code, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    return worst.astype(np.float32, copy=False)


def encode_risk(values: Float32Array | FloatArray) -> ByteArray:
    """Round numbers to codes 0..254."""
    code: ByteArray = np.clip(np.rint(values), 0, MAX_CODE).astype(np.uint8)
    return code


def add_refusals(risk: RiskMap, more: Mapping[str, BoolArray]) -> RiskMap:
    """Return the map with more pads refused."""
    refused = {**risk.refused, **more}
    score, code = risk.score.copy(), risk.code.copy()
    for places in refused.values():
        score[places], code[places] = np.inf, REFUSED
    return RiskMap(score, refused, risk.origin, risk.step, risk.cells, code, risk.shares)


def add_rocks(
    risk: RiskMap, view: PictureOnGround, rocks: Float32Array, marked: Float32Array
) -> RiskMap:
    """Add the share of each pad that is near rocks to its risk, and count its rocks.

    rocks   (rows, cols) of the view: rocks whose middles lie in the cell
    marked  1 where a rock is under the base of a lander, else 0
    """
    cells = risk.cells + 1 - risk.cells % 2
    at_pads = risk.find_middles(view.brightness.shape)
    share = average_boxes(marked, cells, 0.0)[at_pads]
    count = np.rint(average_boxes(rocks, cells, 0.0)[at_pads] * np.float32(cells * cells))
    # by slopes a score is a share, by variance a code
    unit = 1.0 if "expected_dangerous_share" in risk.shares else MAX_CODE
    code = encode_risk(risk.code + np.float32(MAX_CODE) * share)
    code[risk.code == REFUSED] = REFUSED
    shares = {**risk.shares, "n_rocks": count.astype(np.float32), "rock_share": share}
    return replace(risk, score=risk.score + np.float32(unit) * share, code=code, shares=shares)


def choose_pads(view: PictureOnGround, risk: RiskMap, square_m: float) -> list[Pad]:
    """Choose the best pad of each square; squares lie about the middle of the view.

    Pads lie whole in their square. A picture narrower than a square is one.
    """
    pads = []
    for square, (first, last) in _divide_view(view, square_m):
        # indices of pads whose outermost cells lie in the square
        reach = 0.5 * (risk.cells - 1)
        low = [math.ceil((a + reach - risk.origin) / risk.step - 1e-9) for a in first]
        high = [math.floor((b - reach - risk.origin) / risk.step + 1e-9) for b in last]
        window = tuple(
            slice(max(a, 0), min(b + 1, size)) for a, b, size in zip(low, high, risk.score.shape)
        )
        pads.append(_choose_best(risk, square, window))
    return pads


def _divide_view(
    view: PictureOnGround, square_m: float
) -> Iterator[tuple[tuple[int, int], tuple[tuple[float, float], tuple[float, float]]]]:
    """Divide a view: row and column of squares, and their first and last cells, down and across."""
    shape = view.brightness.shape
    side = square_m / view.cell_m
    counts = [max(1, int(size / side + 1e-6)) for size in shape]
    wide = [min(side, float(size)) for size in shape]
    starts = [0.5 * (size - many * w) for size, many, w in zip(shape, counts, wide)]
    for row in range(counts[0]):
        for col in range(counts[1]):
            first = [start + number * w for start, number, w in zip(starts, (row, col), wide)]
            last = [a + w - 1.0 for a, w in zip(first, wide)]
            yield (row, col), ((first[0], first[1]), (last[0], last[1]))


def _choose_best(risk: RiskMap, square: tuple[int, int], window: tuple[slice, ...]) -> Pad:
    part = risk.score[window]
    if not part.size:
        return Pad(square, None, {}, "no pad fits in")
    at = np.unravel_index(int(np.argmin(part)), part.shape)
    if not np.isfinite(part[at]):
        return Pad(square, None, {}, _explain_refusal(risk, window))
    row, col = window[0].start + int(at[0]), window[1].start + int(at[1])
    shares = {name: float(values[row, col]) for name, values in risk.shares.items()}
    cell = risk.origin + risk.step * row, risk.origin + risk.step * col
    return Pad(square, cell, shares)


def _explain_refusal(risk: RiskMap, window: tuple[slice, ...]) -> str:
    """List the shares of a square's pads that are refused, each by the first reason that holds."""
    left = np.ones(risk.score[window].shape, bool)
    words = []
    for reason, refused in risk.refused.items():
        now = left & refused[window]
        if now.any():
            words.append(f"{reason} {now.mean():.0%}")
        left &= ~refused[window]
    return ", ".join(words)


@dataclass
class CarriedPad:
    """A pad followed from frame to frame of a descent.

    number         counts from 1 in the order of choice
    first_file, file  pictures of its choice and of its last place
    centre         latitude, longitude, rad, and height above the reference sphere, m
    covariance     (2, 2) of the place, east and north, m^2
    pixel          x and y of its middle in the last picture
    shares         what is known of it, by the column of pads.csv
    moved_m        from its first place
    reason         why it is followed no longer
    """

    number: int
    first_file: str
    file: str
    n_seen: int
    centre: tuple[float, float, float]
    covariance: FloatArray
    pixel: tuple[float, float]
    shares: dict[str, float]
    first_centre: tuple[float, float, float]
    reason: str = ""

    def measure_move_m(self, radius_m: float) -> float:
        """Measure how far the pad lies from its first place, m."""
        lat, lon = (now - then for now, then in zip(self.centre[:2], self.first_centre[:2]))
        return radius_m * math.hypot(lat, lon * math.cos(self.centre[0]))
