"""What choosing control points gains: chosen against random and one-Sun Harris points.

All strategies pick one place a cell of the bundled Tycho terrain, from the same free places, and
meet the same trials: ground with relief below the DEM's posting, Hapke against Lommel-Seeliger,
noise, blur, 8 bits, scale, roll and off-nadir errors, Suns that occur (catalog.selection.trial).
*Chosen* is what the build's stages take, usable or not; *random* draws a new place for every round;
*one-Sun Harris* takes the strongest corner (OpenCV, the same window) of a picture under one Sun,
another Sun of those that occur for every round, as one happens to have it; *one-Sun corner* does
so with the few nodes of a textbook's corner. Both keep the same distance from other cells' points
as the chosen ones do.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.geometry.cells import CellGrid
from catalog.pipeline import check, render
from catalog.pipeline.cell_map import (
    CellGround,
    choose_spaced,
    compute_separation,
    cut_cell_ground,
    find_peaks,
    sample_suns,
)
from catalog.pipeline.check import run_trials
from catalog.pipeline.config import BodySettings, BuildConfig, DemSection
from catalog.pipeline.context import StageContext
from catalog.progress import Progress
from catalog.rendering.map_view import render_map
from catalog.selection.trial import TrialOutcome
from catalog.terrain.dem.mosaic import Mosaic
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

Interval = tuple[float, float, float]  # value, lower and upper end of 95 %

DEM = "data/tycho_gld100_256ppd.tif"
SUNS = 4  # trials of a round, one for each of so many Sun elevations
MIN_FREE = 0.5  # of a cell's places must have whole patches for the cell to take part
HARRIS_K = 0.04  # of the textbook
CORNER_NODES = 3  # side of the square that a textbook's corner is summed over
Z95 = 1.959964


@dataclass(frozen=True)
class Strategy:
    """How often places of a strategy were recognised, and how well.

    rate      of recognition with its 95 % interval (Wilson)
    error_m   rms distance of recognised places from the truth with its interval, m
    wrong     share of trials in which a place further than the limit was accepted
    """

    name: str
    trials: int
    recognised: int
    rate: Interval
    error_m: Interval
    wrong: float


@dataclass(frozen=True)
class SelectionRow:
    """All strategies at one posting, the chosen points last."""

    posting_m: float
    cells: int
    strategies: tuple[Strategy, ...]


def run(progress: Progress, trials: int = 1000, seed: int = 1) -> list[SelectionRow]:
    """Both postings; at least `trials` trials a strategy."""
    with tycho_context() as fine:
        coarse = replace(fine, posting_m=2.0 * fine.posting_m)
        return [one_posting(context, progress, trials, seed) for context in (fine, coarse)]


@contextmanager
def tycho_context() -> Iterator[StageContext]:
    """The bundled Tycho terrain at its own posting, as a build with default settings has it."""
    body, dem = load_body("moon"), DemSection(path=str(resource(DEM)))
    config = BuildConfig(body=BodySettings("moon"), dem=(dem,))
    with TemporaryDirectory(prefix="optnav-") as folder:
        mosaic = Mosaic.from_files([dem], Path(folder), body, Path(folder))
        grid = CellGrid(config.grid.cell_deg)
        yield StageContext(body, mosaic, grid, mosaic.posting_m, config)
        mosaic.close()


def one_posting(context: StageContext, progress: Progress, trials: int, seed: int) -> SelectionRow:
    """All strategies on all cells that lie on the terrain with their fine patches."""
    grounds = free_grounds(context)
    shortlists = render.render_chunk(context, list(grounds))
    points = check.check_chunk(context, render.select(context, shortlists))
    chosen = {point.id: (point.lat_deg, point.lon_deg) for point in points}
    rounds = -(-trials // (SUNS * len(grounds)))
    outcomes: dict[str, list[TrialOutcome]] = {
        name: [] for name in ("random", "one-Sun corner", "one-Sun Harris", "chosen")
    }
    name = f"selection {context.posting_m:.0f} m"
    with progress.stage(name, rounds * len(grounds), "place") as bar:
        for turn in range(rounds):
            corner = _one_sun_harris(context, grounds, turn, CORNER_NODES)
            harris = _one_sun_harris(context, grounds, turn)
            for cell, ground in grounds.items():
                free = np.argwhere(ground.inside & ground.covered)
                row, col = free[np.random.default_rng([seed, cell, turn]).integers(len(free))]
                drawn = (float(ground.lat[row, col]), float(ground.lon[row, col]))
                places = (drawn, corner[cell], harris[cell], chosen[cell])
                for results, place in zip(outcomes.values(), places, strict=True):
                    results += _trials(context, place, [seed, cell, turn])
                bar.advance()
    limit = context.config.check.max_error_nodes
    strategies = tuple(
        summarise(name, results, limit, context.posting_m) for name, results in outcomes.items()
    )
    return SelectionRow(context.posting_m, len(grounds), strategies)


def free_grounds(context: StageContext) -> dict[int, CellGround]:
    """Grounds by cell, of all cells that lie on the terrain with most of their places' patches."""
    grounds = {}
    for cell in range(context.grid.total):
        lat, lon = np.radians(context.grid.centre_deg(cell))
        if context.mosaic.covers(lat, lon, 8.0 * context.posting_m).all():
            ground = cut_cell_ground(context, cell)
            if ground is None:
                continue
            # whether there is a choice: cells on the terrain's edge leave the same places to all
            if (ground.inside & ground.covered).sum() >= MIN_FREE * ground.inside.sum():
                grounds[cell] = ground
    return grounds


def _one_sun_harris(
    context: StageContext, grounds: dict[int, CellGround], turn: int, window: int | None = None
) -> dict[int, tuple[float, float]]:
    """The strongest corners of pictures under one Sun, a place a cell, spaced as the build does.

    window  side of the summed square, nodes; the template's when None
    """
    settings = context.config.render
    cells, places, scores = [], [], []
    for cell, ground in grounds.items():
        suns = sample_suns(settings, np.degrees(ground.projection.lat))
        sun, radius_m = suns[turn % len(suns)], context.body.radius_m
        picture = render_map(ground.heights, context.posting_m, sun, radius_m=radius_m)
        filled = np.nan_to_num(picture, nan=float(np.nanmean(picture)))
        response = cv2.cornerHarris(filled, window or ground.window, 3, HARRIS_K)
        nodes = np.arange(ground.lat.shape[0]) * ground.step + ground.window // 2
        at_places = response[np.ix_(nodes, nodes)]
        free = np.where(ground.inside & ground.covered, at_places, np.nan).astype(np.float32)
        radius = compute_separation(context, ground)
        for peak in find_peaks(free - np.nanmin(free), radius, settings.candidates):
            cells.append(cell)
            places.append((float(ground.lat[peak]), float(ground.lon[peak])))
            scores.append(-float(at_places[peak]))
    lat, lon = np.array(places).T
    spacing = context.config.select.spacing_cell * context.grid.step_deg
    choices = choose_spaced(cells, lat, lon, np.array(scores), spacing)
    return {cell: places[choice.order[0]] for cell, choice in choices.items()}


def _trials(
    context: StageContext, place: tuple[float, float], seed: Sequence[int]
) -> list[TrialOutcome]:
    """A round of trials at a place, under the circumstances of the check stage."""
    patches, relief = context.patches(*place), 3 + sum(seed)  # neighbouring rounds see other relief
    own = [*seed, len(seed)]
    return list(run_trials(context, patches, *place, seed=own, relief_seed=relief, trials=SUNS))


def summarise(
    name: str, outcomes: Sequence[TrialOutcome], max_error_nodes: float, posting_m: float
) -> Strategy:
    """Counts and intervals of a strategy's outcomes."""
    good = [o.accepted and o.distance <= max_error_nodes for o in outcomes]
    wrong = [o.accepted and o.distance > max_error_nodes for o in outcomes]
    squares = np.array([o.distance**2 for o, ok in zip(outcomes, good, strict=True) if ok])
    mean = float(squares.mean()) if squares.size else float("nan")
    half = Z95 * float(squares.std()) / np.sqrt(max(squares.size, 1))
    ends = (mean, max(mean - half, 0.0), mean + half)
    error, low, high = (float(np.sqrt(value)) * posting_m for value in ends)
    rate, wrong_share = wilson(sum(good), len(outcomes)), sum(wrong) / max(len(outcomes), 1)
    return Strategy(name, len(outcomes), sum(good), rate, (error, low, high), wrong_share)


def wilson(successes: int, trials: int) -> Interval:
    """A share with Wilson's 95 % interval (E. B. Wilson, JASA 22, 1927)."""
    if trials == 0:
        return float("nan"), 0.0, 1.0
    share, z2 = successes / trials, Z95 * Z95
    middle = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z95 / (1 + z2 / trials)
    half *= float(np.sqrt(share * (1 - share) / trials + z2 / (4 * trials * trials)))
    return share, max(middle - half, 0.0), min(middle + half, 1.0)


def difference(better: Strategy, other: Strategy) -> Interval:
    """Difference of two shares with a 95 % interval from their Wilson intervals.

    Newcombe, Statistics in Medicine 17 (1998): the distances of the ends add in quadrature.
    """
    a, a_low, a_high = better.rate
    b, b_low, b_high = other.rate
    low = float(np.hypot(a - a_low, b_high - b))
    high = float(np.hypot(a_high - a, b - b_low))
    return a - b, a - b - low, a - b + high


COLUMNS = columns(
    "posting [m] .0f; cells; strategy; trials; recognised [%] .1f; "
    "recognised_low = from [%] .1f; recognised_high = to [%] .1f; error [m] .0f; "
    "error_low_m = from [m] .0f; error_high_m = to [m] .0f; wrong [%] .1f"
)
GAIN_COLUMNS = columns(
    "posting [m] .0f; over = chosen over; gain = gain [points] +.1f; "
    "gain_low = from [points] +.1f; gain_high = to [points] +.1f"
)


def report(rows: Sequence[SelectionRow]) -> StudyReport:
    """Strategies by posting, and what chosen points gain; ranges are 95 % intervals."""
    lines: list[tuple[Cell, ...]] = []
    gains: list[tuple[Cell, ...]] = []
    for row in rows:
        for one in row.strategies:
            start = (row.posting_m, row.cells, one.name, one.trials)
            lines.append((*start, *_percent(one.rate), *one.error_m, 100.0 * one.wrong))
        *others, chosen = row.strategies
        for other in others:
            gains.append((row.posting_m, other.name, *_percent(difference(chosen, other))))
    tables = (
        StudyTable("strategies, 95 % intervals", COLUMNS, tuple(lines)),
        StudyTable("gain of recognition, 95 % intervals", GAIN_COLUMNS, tuple(gains)),
    )
    return StudyReport(tables)


def _percent(interval: Interval) -> Interval:
    value, low, high = (100.0 * end for end in interval)
    return value, low, high
