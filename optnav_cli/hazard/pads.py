"""Pads for landing: the best place for one in each square of the ground that a picture shows.

Source of the scheme (a pad of 20 m in squares of 200 m, an 8-bit code whose 255 refuses): B. S.
Zhukov, Autonomous optical navigation near the Moon and small bodies, thesis summary, ch. 4.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from catalog.arrays import BoolArray, ByteArray, Float32Array, FloatArray
from catalog.errors import NoSolutionError
from catalog.terrain.slopes import slope_degrees
from optnav_cli.hazard.ground_view import MIN_PAD_CELLS, PictureOnGround, box_means
from optnav_cli.hazard.model import HazardModel
from optnav_cli.hazard.shading import ShadedSlopes

REFUSED = 255
MAX_CODE = 254
WHOLE = 0.9999  # of a pad that the picture shows; sums of shares round


@dataclass(frozen=True, eq=False)
class RiskMap:
    """How risky a pad is, (rows, cols) by its middle.

    score    what the best pad has least of; infinite where refused
    refused  by reason, in the order in which they are told
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


def pad_cells(view: PictureOnGround, pad_m: float) -> int:
    """The least odd number of cells that a pad fits into.

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
    return cells + 1 - cells % 2


def risk_of_slopes(
    view: PictureOnGround, slopes: ShadedSlopes, pad_m: float, model: HazardModel
) -> RiskMap:
    """The expected share of dangerous slopes on each pad; shaded and cut ones are refused."""
    cells = pad_cells(view, pad_m)
    shown = box_means(view.valid.astype(np.float32), cells, 0.0) >= WHOLE
    degrees = slope_degrees(np.stack([slopes.toward, slopes.across]))
    shares = {
        "expected_dangerous_share": box_means(slopes.dangerous, cells, 0.0),
        "expected_critical_share": box_means(slopes.critical, cells, 0.0),
        "shadow_share": box_means(slopes.shadow, cells, 0.0),
        "mean_slope_deg": box_means(degrees, cells, 0.0),
    }
    refused = {
        "not whole in the picture": ~shown,
        "shadow": shares["shadow_share"] > model.max_shadow_under(view.sun_elevation_deg),
    }
    expected = np.clip(shares["expected_dangerous_share"], 0.0, 1.0)
    score = expected + shares["mean_slope_deg"] * np.float32(math.radians(model.flatness))
    score += shares["expected_critical_share"]
    return with_refusals(
        RiskMap(score, refused, 0.0, 1, cells, coded(MAX_CODE * expected), shares), {}
    )


def coded(values: Float32Array | FloatArray) -> ByteArray:
    """Codes 0..254 of numbers."""
    code: ByteArray = np.clip(np.rint(values), 0, MAX_CODE).astype(np.uint8)
    return code


def with_refusals(risk: RiskMap, more: Mapping[str, BoolArray]) -> RiskMap:
    """The same map with more pads refused."""
    refused = {**risk.refused, **more}
    score, code = risk.score.copy(), risk.code.copy()
    for places in refused.values():
        score[places], code[places] = np.inf, REFUSED
    return RiskMap(score, refused, risk.origin, risk.step, risk.cells, code, risk.shares)


def choose_pads(view: PictureOnGround, risk: RiskMap, square_m: float) -> list[Pad]:
    """The best pad of each square; squares lie about the middle of the view.

    Pads lie whole in their square. A picture narrower than a square is one.
    """
    pads = []
    for square, (first, last) in _squares(view, square_m):
        # indices of pads whose outermost cells lie in the square
        reach = 0.5 * (risk.cells - 1)
        low = [math.ceil((a + reach - risk.origin) / risk.step - 1e-9) for a in first]
        high = [math.floor((b - reach - risk.origin) / risk.step + 1e-9) for b in last]
        place = tuple(
            slice(max(a, 0), min(b + 1, size)) for a, b, size in zip(low, high, risk.score.shape)
        )
        pads.append(_best(risk, square, place))
    return pads


def _squares(
    view: PictureOnGround, square_m: float
) -> Iterator[tuple[tuple[int, int], tuple[tuple[float, float], tuple[float, float]]]]:
    """Row and column of squares, and their first and last cells, down and across."""
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


def _best(risk: RiskMap, square: tuple[int, int], place: tuple[slice, ...]) -> Pad:
    part = risk.score[place]
    if not part.size:
        return Pad(square, None, {}, "no pad fits in")
    at = np.unravel_index(int(np.argmin(part)), part.shape)
    if not np.isfinite(part[at]):
        return Pad(square, None, {}, _why_none(risk, place))
    row, col = place[0].start + int(at[0]), place[1].start + int(at[1])
    shares = {name: float(values[row, col]) for name, values in risk.shares.items()}
    cell = risk.origin + risk.step * row, risk.origin + risk.step * col
    return Pad(square, cell, shares)


def _why_none(risk: RiskMap, place: tuple[slice, ...]) -> str:
    """The shares of a square's pads that are refused for each reason, the first one that holds."""
    left = np.ones(risk.score[place].shape, bool)
    words = []
    for reason, refused in risk.refused.items():
        now = left & refused[place]
        if now.any():
            words.append(f"{reason} {now.mean():.0%}")
        left &= ~refused[place]
    return ", ".join(words)
