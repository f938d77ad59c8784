"""What the build's economies cost: its settings against slower ones, on the same terrain.

The build renders a few candidates a cell under a few Suns at the finest level, and tries three of
them at most. Here that is held against *all Suns*, every candidate that fits into the cell, each
rendered under 32 Suns at two levels, and against *all tried*, where each of these goes through the
recognition trials as well and the best one wins. *Four of five* looks on after a place that three
trials of five recognised; *fewer* goes the other way. Every policy's points then meet new trials,
the same for the same place (catalog.selection.trial). Differences are paired by cell, so that cells
where both take the same place add no scatter.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from catalog.control_point import ControlPoint
from catalog.geometry.cells import CellGrid
from catalog.pipeline import check, render
from catalog.pipeline.check import run_trials
from catalog.pipeline.config import CheckSettings, RenderSettings
from catalog.pipeline.context import StageContext
from catalog.progress import Progress
from tests.studies.selection import SUNS, Z95, free_grounds, tycho_context
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

Place = tuple[float, float]  # latitude and longitude, deg

ALL = 24  # candidates: the spacing between them leaves no room for more
ALL_SPACED = 0.08  # of a cell between candidates
FEW = 4
SEED_OF_TRIALS = 20_000  # far from the seeds of the build's own trials


@dataclass(frozen=True)
class Policy:
    """A way to choose points: what differs from the default settings of a build."""

    name: str
    render: RenderSettings
    check: CheckSettings


def policies() -> tuple[Policy, ...]:
    """The build's own first; then slower and quicker ones."""
    own, tests = RenderSettings(), CheckSettings()
    every = RenderSettings(
        candidates=ALL, separation_cell=ALL_SPACED, levels=2, sun_elevations=4, sun_azimuths=8
    )
    # a place that is always recognised ends the search: a later one can only tie with it
    tried = CheckSettings(places=ALL, good_recognition=1.0)
    return (
        Policy("build", own, tests),
        Policy("all Suns", every, tests),
        Policy("all tried", every, tried),
        Policy("four of five", own, CheckSettings(good_recognition=0.8)),
        Policy("fewer", RenderSettings(candidates=FEW), tests),
    )


def run(
    progress: Progress, cells_deg: Sequence[float] = (1.0, 0.5), trials: int = 24, seed: int = 1
) -> list[tuple[Cell, ...]]:
    """All policies on cells of each size; `trials` new trials a place, at least."""
    with tycho_context() as context:
        sizes = [replace(context, grid=CellGrid(cell_deg)) for cell_deg in cells_deg]
        return [row for size in sizes for row in one_size(size, progress, trials, seed)]


def one_size(
    context: StageContext, progress: Progress, trials: int, seed: int
) -> list[tuple[Cell, ...]]:
    """A row a policy on the cells of a context that lie on the terrain; times of one core a cell.

    Against the build's own rate: the mean difference and half of its 95 % interval.
    """
    cells = list(free_grounds(context))
    known: dict[Place, float] = {}
    rows: list[tuple[Cell, ...]] = []
    own_rates, own_places = np.empty(0), []
    name = f"economy {context.grid.step_deg:g} deg"
    with progress.stage(name, 2 * len(cells) * len(policies()), "cell") as bar:
        for policy in policies():
            records, spent = _built(context, policy, cells)
            bar.advance(len(cells), policy.name)
            places = [(record.lat_deg, record.lon_deg) for record in records]
            for place in places:
                if place not in known:
                    known[place] = _rate(context, place, trials, seed)
                bar.advance()
            rates = np.array([known[place] for place in places])
            if not rows:
                own_rates, own_places = rates, places
            gain = rates - own_rates
            half = Z95 * float(gain.std(ddof=1)) / np.sqrt(gain.size)
            against = (100.0 * float(gain.mean()), 100.0 * half) if rows else (None, None)
            usable = sum(record.usable for record in records) / len(records)
            same = float(np.mean([a == b for a, b in zip(places, own_places, strict=True)]))
            start = (context.grid.step_deg, len(cells), -(-trials // SUNS) * SUNS, policy.name)
            times = (seconds / len(cells) * 1e3 for seconds in spent)
            shares = (100.0 * usable, 100.0 * float(rates.mean()))
            rows.append((*start, *times, *shares, *against, 100.0 * same))
    return rows


def _built(
    context: StageContext, policy: Policy, cells: Sequence[int]
) -> tuple[list[ControlPoint], tuple[float, float]]:
    """The points that a policy chooses, and the seconds that render and check took."""
    config = msgspec.structs.replace(context.config, render=policy.render, check=policy.check)
    own = replace(context, config=config)
    render.render_chunk(own, cells[:1])  # compiled, tables and files open: not the policy's cost
    started = time.process_time()
    shortlists = render.render_chunk(own, cells)
    rendered = time.process_time()
    selected = render.select(own, shortlists)
    selected_at = time.process_time()
    records = check.check_chunk(own, selected)
    return records, (rendered - started, time.process_time() - selected_at)


def _rate(context: StageContext, place: Place, trials: int, seed: int) -> float:
    """Recognition rate of a place in trials that no policy has seen, the same for each policy."""
    patches, limit = context.patches(*place), context.config.check.max_error_nodes
    own = round((place[0] + 90.0) * 1e6)
    successes = 0
    for turn in range(-(-trials // SUNS)):
        seeds = [SEED_OF_TRIALS + seed, turn, own]
        found = run_trials(context, patches, *place, seed=seeds, relief_seed=turn, trials=SUNS)
        successes += sum(o.accepted and o.distance <= limit for o in found)
    return successes / (-(-trials // SUNS) * SUNS)


COLUMNS = columns(
    "cell [°] g; cells; trials = new trials [a place]; policy; render [ms] .1f; "
    "check [ms] .1f; usable [%] .1f; recognised [%] .1f; "
    "against = against build [points] +.1f; against_half = ± (95 %) [points] .1f; "
    "same = same place [%] .0f"
)


def report(rows: Sequence[tuple[Cell, ...]]) -> StudyReport:
    """All policies by size of cell."""
    return StudyReport((StudyTable("", COLUMNS, tuple(rows)),))
