"""Rocks by their shadows: places, diameters, and heights from shadow lengths.

The picture is turned until shadows run along its rows. A rock is a group of neighbouring rows in
which lit ground turns dark at nearly the same place; its height is the shadow's length times the
tangent of the Sun's elevation over the ground there (B. S. Zhukov, Autonomous optical navigation
near the Moon and small bodies, thesis summary, ch. 4). Craters and steps of the ground throw
shadows, too: a logistic rule tells them apart, fitted in configs/models/hazard.toml.

With slope p along the Sun, view d (tangent off the vertical, along the shadow) and length L the
shadow's edge on the rock is L / (1 / (tan e - p) - d) high.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy.special import expit

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.terrain.slopes import BASE_M
from optnav_cli.hazard.ground_view import PictureOnGround, average_boxes, resize_grid
from optnav_cli.hazard.settings import HazardModel, HazardSettings, RockNumbers
from optnav_cli.hazard.shading import measure_slopes_toward

ROCKS_FILE = "rocks.csv"  # of the output folder, beside its points as rocks.gpkg
CELL_M = 0.04  # of the view that rocks are looked for in, or the picture's pixels where coarser
BLOCK_M = 0.6  # over which the brightness of lit ground is taken
MIN_RUN = 2  # cells of shadow in a row
FACES = np.linspace(0.08, 1.0, 12)  # before a shadow over its width: where a rock's lit face is
MAX_WIDTH_M = 4.0  # of a rock whose lit face is looked for
TIP_M = 0.15  # of ground behind a shadow's end
SLOPE_AT = 0.6  # of a shadow's length, where the slope under it is taken
# Height over width at most: rocks lie on their flat sides; on average it is 0.54 of the length (N.
# E. Demidov and A. T. Basilevsky, Solar System Research 48 (2014) 324).
MAX_HEIGHT_RATIO, LOST_ROWS = 1.1, 2.0  # rows at both ends, whose shadows are too short
# Share of lit ground in the square of this side, m, about a rock that is listed: what juts out of a
# crater's shadow looks like a rock, and no pad is chosen there.
LIT_SHARE, LIT_M = 0.6, 4.0
STEADY_ROWS = 4.0  # bends of fewer rows are mostly noise
MIN_RATIO = 0.02  # of brightness, before its logarithm is taken
FEATURES = 5


@dataclass(frozen=True)
class Rock:
    """A rock, x and y from the middle of the view along its columns and against its rows, m.

    diameter_m  across the Sun;  height_m, height_sigma_m  height and its 1 sigma
    chance      probability that it is a rock, by the fitted rule
    """

    x_m: float
    y_m: float
    diameter_m: float
    height_m: float
    height_sigma_m: float
    chance: float


@dataclass(frozen=True)
class RockSurvey:
    """Rocks of a picture, or the reason why none were looked for."""

    rocks: tuple[Rock, ...] = ()
    reason: str = ""

    def mark_cells(self, view: PictureOnGround) -> tuple[Float32Array, Float32Array]:
        """Count the rocks of each cell of a view, and mark those with one under a lander's base.

        Returns two (rows, cols); the marks are 1, else 0.
        """
        counts, marked = np.zeros((2, *view.brightness.shape), np.float32)
        for rock in self.rocks:
            row, col = (round(at) for at in find_cell(rock, view))
            if 0 <= row < counts.shape[0] and 0 <= col < counts.shape[1]:
                counts[row, col] += 1.0
            reach = max(1, round(0.5 * (BASE_M + rock.diameter_m) / view.cell_m))
            cv2.circle(marked, (col, row), reach, 1.0, -1)
        return counts, marked


def find_cell(rock: Rock, view: PictureOnGround) -> tuple[float, float]:
    """Find the (fractional) row and column of a rock in a view."""
    rows, cols = view.brightness.shape
    row = 0.5 * (rows - 1) - rock.y_m / view.cell_m
    return row, rock.x_m / view.cell_m + 0.5 * (cols - 1)


class ShadowEdges(NamedTuple):
    """Groups of rows (n,) where shadows begin, in a view turned along the Sun.

    row, col  of their middles, cells;  rows  that they span
    length    of the longest shadow, cells
    slope, view  tangents: of the ground towards the Sun, and of the line of sight along the shadow
    features  (n, FEATURES), of the rule that tells rocks
    """

    row: FloatArray
    col: FloatArray
    rows: FloatArray
    length: FloatArray
    slope: FloatArray
    view: FloatArray
    features: FloatArray


def survey_rocks(
    view: PictureOnGround,
    look: Callable[[float], PictureOnGround],
    settings: HazardSettings,
    model: HazardModel,
) -> RockSurvey:
    """Find the rocks above `min_rock_m` of a picture, or say why it shows none.

    view  of the picture in coarse cells;  look  makes one in cells of a given size, m
    """
    if settings.min_rock_m <= 0.0:
        return RockSurvey((), "not looked for: min_rock_m is 0")
    try:
        check_scale(view.pixel_m, view.sun_elevation_deg, settings.min_rock_m, model.rocks)
        return RockSurvey(tuple(find_rocks(look(CELL_M), settings, model)))
    except NoSolutionError as error:
        return RockSurvey((), f"no rocks looked for: {error}")


def check_scale(pixel_m: float, sun_deg: float, rock_m: float, numbers: RockNumbers) -> None:
    """Raise NoSolutionError for pixels or a Sun that hide rocks of this height."""
    if pixel_m > numbers.max_pixel * rock_m:
        raise NoSolutionError(
            f"pixels of {pixel_m:.3g} m are too coarse for rocks of {rock_m:g} m; wanted up to "
            f"{numbers.max_pixel * rock_m:.3g} m: take a picture from less height",
            "coarse",
        )
    shadow = rock_m / math.tan(math.radians(sun_deg)) / pixel_m
    if shadow < numbers.min_shadow_px:
        raise NoSolutionError(
            f"under a Sun of {sun_deg:.3g} deg a rock of {rock_m:g} m throws a shadow of "
            f"{shadow:.1f} pixels; wanted at least {numbers.min_shadow_px:g}",
            "high_sun",
        )


def find_rocks(view: PictureOnGround, settings: HazardSettings, model: HazardModel) -> list[Rock]:
    """Find the rocks of a finely sampled view whose heights may be above `min_rock_m`.

    Raises NoSolutionError for a picture without light.
    """
    turn = make_turn(view)
    edges = find_shadow_edges(view, turn, settings, model)
    numbers, elevation = model.rocks, view.sun_elevation_deg
    height, sigma = measure_heights(edges, view, numbers)
    chance = rate_edges(edges.features, elevation, numbers)
    least = np.interp(elevation, numbers.sun_elevation_deg, numbers.least_chance)
    kept = (chance >= least) & (height + sigma >= settings.min_rock_m)
    x, y = place_edges(edges, height, turn, view)
    rocks: list[Rock] = []
    order = np.flatnonzero(kept)
    for at in order[np.argsort(-height[order], kind="stable")]:
        diameter = float(edges.rows[at]) * view.cell_m
        foot = float(x[at]), float(y[at])
        # a second edge within a rock is its own
        if all(math.dist(foot, (r.x_m, r.y_m)) > 0.5 * r.diameter_m for r in rocks):
            values = (float(part[at]) for part in (height, sigma, chance))
            rocks.append(Rock(*foot, diameter, *values))
    return rocks


def place_edges(
    edges: ShadowEdges, height: FloatArray, turn: FloatArray, view: PictureOnGround
) -> tuple[FloatArray, FloatArray]:
    """Place the middles of rocks (n,), x and y from the middle of the view, m."""
    back = 0.5 * edges.rows * math.sin(math.radians(view.sun_elevation_deg))
    col, row = turn @ np.stack([edges.col - back, edges.row, np.ones(edges.row.size)])
    x, y = view.xy_m(row, col)
    # the edge is as high as the rock: it is seen aside of where the rock stands
    share = height / view.camera_m[2]
    return x - share * (x - view.camera_m[0]), y - share * (y - view.camera_m[1])


def make_turn(view: PictureOnGround) -> FloatArray:
    """Make the matrix (2, 3) from x, y of a picture turned along the shadows to the view's."""
    rows, cols = view.brightness.shape
    along = np.array([-math.sin(view.sun_azimuth), math.cos(view.sun_azimuth)])  # x, y down
    axes = np.array([[along[0], -along[1]], [along[1], along[0]]])
    wide, high = _measure_turned_size(view)
    middle = axes @ (0.5 * (wide - 1), 0.5 * (high - 1))
    shift = np.array([0.5 * (cols - 1), 0.5 * (rows - 1)]) - middle
    return np.column_stack([axes, shift])


def _measure_turned_size(view: PictureOnGround) -> tuple[int, int]:
    rows, cols = view.brightness.shape
    s, c = abs(math.sin(view.sun_azimuth)), abs(math.cos(view.sun_azimuth))
    return math.ceil(cols * s + rows * c) + 2, math.ceil(cols * c + rows * s) + 2


def _level_ground(
    view: PictureOnGround, settings: HazardSettings
) -> tuple[Float32Array, Float32Array]:
    """Brightness of lit ground and its slope to the Sun, about each cell: medians of blocks."""
    many = max(1, round(BLOCK_M / view.cell_m))
    rows, cols = (size // many * many for size in view.brightness.shape)
    values = np.where(view.valid, view.brightness, np.float32(np.nan))[:rows, :cols]
    bright = float(np.nanmedian(values[::7, ::7])) if view.valid.any() else 0.0
    if not bright > 0.0:
        raise NoSolutionError("the picture holds no light", "night")
    tiles = values.reshape(rows // many, many, cols // many, many).swapaxes(1, 2)
    blocks = tiles.reshape(rows // many, cols // many, many * many)
    lit = np.where(blocks > settings.shadow * bright, blocks, np.float32(np.nan))
    share = np.isfinite(lit).mean(axis=-1)
    lit = np.sort(lit, axis=-1)  # NaN last
    count = np.isfinite(lit).sum(axis=-1)
    medians = np.take_along_axis(lit, np.maximum(count - 1, 0)[..., None] // 2, axis=-1)[..., 0]
    medians = np.where(share > 0.1, medians, np.float32(np.nan))
    known = np.isfinite(medians)
    if not known.any():
        raise NoSolutionError("the picture holds no light", "night")
    # blocks without lit ground take their neighbours' level
    weight = average_boxes(known.astype(np.float32), 9)
    filled = np.where(known, medians, np.float32(0.0)).astype(np.float32)
    around = average_boxes(filled, 9) / np.maximum(weight, 1e-6)
    around = np.where(weight > 0.0, around, np.float32(np.nanmedian(medians)))
    level = np.where(known, medians, around).astype(np.float32)
    coarse = replace(view, brightness=level, valid=known, cell_m=many * view.cell_m)
    slope = measure_slopes_toward(coarse, settings.law)
    size = view.brightness.shape[::-1]
    return resize_grid(average_boxes(level, 3), size), resize_grid(average_boxes(slope, 3), size)


def find_shadow_edges(
    view: PictureOnGround, turn: FloatArray, settings: HazardSettings, model: HazardModel
) -> ShadowEdges:
    """Find where shadows begin, in groups of neighbouring rows, and measure them."""
    level, slope = _level_ground(view, settings)
    size = _measure_turned_size(view)

    def warp(values: Float32Array) -> Float32Array:
        turned = cv2.warpAffine(
            values, turn, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=0.0
        )
        return turned.astype(np.float32, copy=False)

    shown = warp(view.valid.astype(np.float32)) > 0.999
    ratio = warp((view.brightness / np.maximum(level, 1e-9)).astype(np.float32, copy=False))
    dark = (ratio < settings.shadow) & shown
    dark[:, :2] = dark[:, -2:] = False
    step = np.diff(dark.astype(np.int8), axis=1)
    wide = dark.shape[1]
    begin, end = (np.flatnonzero(step == sign) for sign in (1, -1))
    # index of the last lit cell before, and of the last dark one, of the whole picture
    row, first = np.divmod(begin, wide - 1)
    last = end % (wide - 1)
    length = last - first
    # a shadow that the picture cuts has no length
    uncut = (length >= MIN_RUN) & shown[row, np.maximum(first - 1, 0)]
    uncut &= shown[row, np.minimum(last + 2, wide - 1)]
    row, first, last, length = (part[uncut] for part in (row, first, last, length))
    label, count = _group_edges(row, first, dark.shape)
    if not count:
        nothing = np.zeros(0)
        return ShadowEdges(*(nothing,) * 6, features=np.zeros((0, FEATURES)))
    longest = np.zeros(count)
    np.maximum.at(longest, label, length)
    # rows of at least half the longest shadow tell what is before and behind
    core = length >= 0.5 * longest[label]
    rows = np.bincount(label, minlength=count).astype(np.float64)
    back = np.rint(FACES * np.minimum(rows, MAX_WIDTH_M / view.cell_m)[label][:, None])
    face = ratio[row[:, None], np.maximum(first[:, None] - back.astype(np.int64), 0)].max(axis=1)
    edge = _look_along(ratio, row, first, 2, np.min)
    tip = _look_along(ratio, row, last + 2, round(TIP_M / view.cell_m), np.mean)

    def average(values: FloatArray) -> FloatArray:
        weights = np.bincount(label, core, count)
        return np.bincount(label, values * core, count) / np.maximum(weights, 1.0)

    middle, start = average(row.astype(np.float64)), average(first + 0.5)
    bend = _measure_bend(row, first, label, rows)
    halfway = np.clip(start + SLOPE_AT * longest, 0, wide - 1).astype(int)
    at = np.clip(np.rint(middle), 0, size[1] - 1).astype(int), halfway
    along = np.array([-view.sun[0], -view.sun[1]]) / math.hypot(view.sun[0], view.sun[1])
    places = turn @ np.stack([start, middle, np.ones(count)])
    x, y = view.xy_m(places[1], places[0])
    sight = ((x - view.camera_m[0]) * along[0] + (y - view.camera_m[1]) * along[1]) / view.camera_m[
        2
    ]
    features = np.stack(
        [
            np.log(np.maximum(average(face), MIN_RATIO)),
            np.log(np.maximum(average(tip), MIN_RATIO)),
            np.log(np.maximum(average(edge), MIN_RATIO)),
            np.log(rows / longest),
            bend,
        ],
        axis=1,
    )
    under = warp(slope)[at].astype(np.float64)
    edges = ShadowEdges(middle, start, rows, longest, under, sight, features)
    around = average_boxes(dark.astype(np.float32), 2 * round(0.5 * LIT_M / view.cell_m) + 1)
    lit = 1.0 - around[at[0], np.clip(start, 0, wide - 1).astype(int)]
    return ShadowEdges(*(part[lit >= LIT_SHARE] for part in edges))


def _group_edges(row: IntArray, first: IntArray, shape: tuple[int, ...]) -> tuple[IntArray, int]:
    """Label edges (n,) of neighbouring rows, up to two cells apart along them."""
    marked = np.zeros(shape, np.uint8)
    marked[row, first] = 1
    grown = cv2.dilate(marked, np.ones((1, 3), np.uint8))
    count, labels = cv2.connectedComponents(grown, connectivity=8)
    return labels[row, first].astype(np.int64) - 1, count - 1


def _measure_bend(row: IntArray, first: IntArray, label: IntArray, rows: FloatArray) -> FloatArray:
    """Measure how fast edges (n,) recede from the Sun away from their middles, a tangent.

    A crater's rim does, the dark side of a rock does not.
    """
    count = rows.size

    def average(values: FloatArray) -> FloatArray:
        return np.bincount(label, values, count) / rows

    offset = np.abs(row - average(row.astype(np.float64))[label])
    lag = first - average(first.astype(np.float64))[label]
    mean = average(offset)
    variance = average(offset * offset) - mean * mean
    bend = np.clip(average(lag * offset) / np.maximum(variance, 0.1), -2.0, 2.0)
    return bend * rows / (rows + STEADY_ROWS)


def _look_along(
    ratio: Float32Array,
    row: IntArray,
    first: IntArray,
    cells: int,
    combine: Callable[..., FloatArray],
) -> FloatArray:
    """Combine the brightness of cells from places (n,) on along the rows; back where negative."""
    reach = np.arange(max(abs(cells), 1)) * (1 if cells > 0 else -1)
    cols = np.clip(first[:, None] + reach, 0, ratio.shape[1] - 1)
    combined: FloatArray = combine(ratio[row[:, None], cols], axis=1).astype(np.float64)
    return combined


def measure_heights(
    edges: ShadowEdges, view: PictureOnGround, numbers: RockNumbers
) -> tuple[FloatArray, FloatArray]:
    """Measure heights and their 1 sigma (n,), m, by the lengths of the shadows."""
    tangent = math.tan(math.radians(view.sun_elevation_deg))
    length = (edges.length + numbers.longer_px) * view.cell_m
    # a slope that hides the Sun or more is none that a shadow ends on
    grazing = np.maximum(tangent - numbers.slope_weight * edges.slope, 0.2 * tangent)
    rise = 1.0 / np.maximum(1.0 / grazing - edges.view, 0.2 / grazing)
    # a shadow that goes on in a crater's is longer than any rock of this width would throw
    height = np.minimum(length * rise, MAX_HEIGHT_RATIO * view.cell_m * (edges.rows + LOST_ROWS))
    sigma = np.hypot(numbers.sigma_px * view.cell_m * rise, numbers.sigma_share * height)
    return height, np.hypot(sigma, length * numbers.sigma_slope)


def rate_edges(features: FloatArray, elevation_deg: float, numbers: RockNumbers) -> FloatArray:
    """Rate how likely edges (n, FEATURES) are those of rocks, by the rule of the nearest Suns."""
    weights = np.array(numbers.weights)  # (Suns, FEATURES + 1)
    terms = [np.interp(elevation_deg, numbers.sun_elevation_deg, part) for part in weights.T]
    chance: FloatArray = expit(terms[0] + features @ np.array(terms[1:]))
    return chance
