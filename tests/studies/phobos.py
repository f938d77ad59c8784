"""Navigation at Phobos: every distance from 20 000 km to 20 km, and the catalog it rests on.

The truth is the 2 degree shape model, refined and with relief of 20 m rms below its posting
(configs/scenarios/phobos_*.toml); the navigator has the catalog of the plain model. Attitudes are
off by a star sensor's 10 arc seconds an axis. Rows are flown without any prior, so that each frame
is solved by what it shows, but those named so, whose positions are stated to 100 m. The approach
is one flight, whose frames have those before them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catalog.config import resource
from catalog.jobs.usage import Account
from catalog.pipeline import build
from catalog.places import make_folder
from catalog.progress import Progress
from optnav_cli.evaluation.figures import FrameError, compute_figures
from tests.studies import flights
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms, tally

WIDE, NARROW = "tsnn_shtk", "tsnn_utk"
POINTS_M = 195.0  # half of the model's posting, 2 degrees of the equator
BUILD_LIMIT_S = 180.0  # by the clock, on two cores
NEES = (0.7, 1.4)


@dataclass(frozen=True)
class PhobosCase(flights.Case):
    """One line of the table, the pictures of a scenario by one camera.

    prior        whether a position is stated
    flown        whether the scenario states attitudes as a star sensor does, so that none are made
    distance_km  only frames between these distances from the centre
    across_m     asked of the error across the line of sight, rms;  range_share along it
    """

    scenario: str
    camera: str = WIDE
    prior: bool = False
    flown: bool = False
    distance_km: tuple[float, float] = (0.0, np.inf)
    across_m: float | None = None
    range_share: float | None = None


ROWS = (
    PhobosCase("small disc, 20 000-6000 km", "phobos_disc"),
    PhobosCase("limb, 1000 km", "phobos_limb_1000km"),
    PhobosCase("limb, 300 km", "phobos_limb_0300km"),
    PhobosCase("limb, 100 km", "phobos_limb_0100km", across_m=15.0, range_share=0.001),
    PhobosCase("limb, 70 km", "phobos_limb_0070km"),
    PhobosCase("points from a prior, 60 km", "phobos_points_060km", prior=True, across_m=POINTS_M),
    PhobosCase("points from a prior, 40 km", "phobos_points_040km", prior=True, across_m=POINTS_M),
    PhobosCase("points from a prior, 20 km", "phobos_points_020km", prior=True),
    PhobosCase("loop, 60 km", "phobos_points_060km", across_m=POINTS_M),
    PhobosCase("loop, 40 km", "phobos_points_040km", across_m=POINTS_M),
    PhobosCase("loop, 20 km", "phobos_points_020km"),
    PhobosCase("approach, 300-70 km", "phobos_approach", flown=True, distance_km=(70.0, 301.0)),
    PhobosCase("approach, 70-40 km", "phobos_approach", flown=True, distance_km=(40.0, 70.0)),
    PhobosCase("approach, 40-20 km", "phobos_approach", flown=True, distance_km=(19.0, 40.0)),
    PhobosCase("narrow camera, 1000-500 km", "phobos_narrow", NARROW),
)


class PhobosResults(NamedTuple):
    """Frames by row; the account is that of this run's build, whose stages may have been kept."""

    account: Account
    rows: list[tuple[PhobosCase, list[FrameError]]]


def run(
    output: Path, progress: Progress, frames: int | None = None, rows: str = ""
) -> PhobosResults:
    """Build, fly, navigate and compare; what is there already is used again.

    output  folder for catalog, pictures, runs and figures.json
    frames  pictures of a scenario a camera, its own number when None
    rows    only rows whose name contains this
    """
    chosen = flights.rows_named(ROWS, rows)
    make_folder(output)
    catalog = output / "phobos.gpkg"
    config = resource("configs/catalogs/phobos.toml")
    account = build.run(config, output=catalog, progress=progress).account
    results = PhobosResults(account, [])
    runs: dict[str, tuple[FrameError, ...]] = {}
    for row in chosen:
        folder = flights.shipped_pictures(output, row.scenario, frames, progress)
        if not row.flown:
            folder = flights.with_star_sensor(folder, priors=row.prior)
        name = folder.name
        if name not in runs:
            runs[name] = flights.navigated(folder, [catalog], output / "runs" / name, progress)
        own = [frame for frame in runs[name] if frame.camera == row.camera]
        nearest, farthest = row.distance_km
        own = [frame for frame in own if nearest <= frame.distance_m / 1e3 < farthest]
        results.rows.append((row, own))
        single = flights.frames_table({case.name: frames for case, frames in results.rows})
        so_far = report(results)
        StudyReport((*so_far.tables, single), so_far.notes).write(output / flights.FIGURES)
    return results


COLUMNS = columns(
    "case; solved; frames; across, rms [m] .1f; across_limit_m = asked ≤ [m] .0f; "
    "across_max_m = max [m] .0f; range, rms [m] .1f; range_share = of range [%] .3f; "
    "range_share_limit = asked ≤ [%] .1f; NEES .2f; worst [σ] .1f; methods"
)


def report(results: PhobosResults) -> StudyReport:
    """The table, the build's line, and why frames were not solved."""
    notes = [_build_line(results.account), f"wanted besides: NEES {NEES[0]}-{NEES[1]}"]
    for row, frames in results.rows:
        # what the first method tried says; the others' words follow in solution.csv
        reasons = [f.solution.reason.partition(";")[0] for f in frames if f.nees is None]
        notes += flights.not_solved(row.name, reasons)
    rows = tuple(_cells(row, frames) for row, frames in results.rows)
    return StudyReport((StudyTable("", COLUMNS, rows),), tuple(notes))


def _build_line(account: Account) -> str:
    total = account.total()
    kept = " (in part or all done by earlier runs)" if any(s.kept for s in account.stages) else ""
    return (
        f"catalog: {account.usable} of {account.points} points usable, {total.seconds:.0f} s "
        f"(≤ {BUILD_LIMIT_S:.0f}) by the clock with {account.workers} workers, {total.cpu_s:.0f} s "
        f"of processors{kept}"
    )


def _cells(row: PhobosCase, frames: Sequence[FrameError]) -> tuple[Cell, ...]:
    solved = [frame for frame in frames if frame.error_rnb_m is not None]
    start = (row.name, len(solved), len(frames))
    asked = None if row.range_share is None else 100.0 * row.range_share
    if not solved:
        return (*start, None, row.across_m, None, None, None, asked, None, None, "none solved")
    f = compute_figures(frames)
    shares = [float(f.error_rnb_m[0]) / f.distance_m for f in solved if f.error_rnb_m is not None]
    errors = (f.horizontal_rms_m, row.across_m, f.horizontal_max_m, f.height_rms_m)
    end = (f.nees, max(map(flights.sigmas_off, solved)), tally([f.solution.method for f in solved]))
    return (*start, *errors, 100.0 * rms(shares), asked, *end)
