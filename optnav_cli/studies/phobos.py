"""Navigation at Phobos: every distance from 20 000 km to 20 km, and the catalog it rests on.

The truth is the 2 degree shape model, refined and with relief of 20 m rms below its posting
(configs/scenarios/phobos_*.toml); the navigator has the catalog of the plain model. Attitudes are
off by a star sensor's 10 arc seconds an axis. Rows are flown without any prior, so that each frame
is solved by what it shows, but those named so, which are told a position to 100 m. The approach is
one flight, whose frames have those before them.
"""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.build import build
from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.jobs.usage import Account
from catalog.progress import Progress
from optnav_cli.evaluation.figures import FrameError, figures_of
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.runs.navigate_folder import navigate_folder
from optnav_cli.studies.pictures import shipped_pictures, with_star_sensor

WIDE, NARROW = "tsnn_shtk", "tsnn_utk"
POINTS_M = 195.0  # half of the model's posting, 2 degrees of the equator
BUILD_LIMIT_S = 180.0  # by the clock, on two cores
NEES = (0.7, 1.4)
FIGURES = "figures.json"


@dataclass(frozen=True)
class Row:
    """One line of the table, the pictures of a scenario by one camera.

    prior        whether a position is told
    flown        whether the scenario tells attitudes as a star sensor does, so that none are made
    distance_km  only frames between these distances from the centre
    across_m     asked of the error across the line of sight, rms;  range_share along it
    """

    name: str
    scenario: str
    camera: str = WIDE
    prior: bool = False
    flown: bool = False
    distance_km: tuple[float, float] = (0.0, np.inf)
    across_m: float | None = None
    range_share: float | None = None


ROWS = (
    Row("small disc, 20 000-6000 km", "phobos_disc"),
    Row("limb, 1000 km", "phobos_limb_1000km"),
    Row("limb, 300 km", "phobos_limb_0300km"),
    Row("limb, 100 km", "phobos_limb_0100km", across_m=15.0, range_share=0.001),
    Row("limb, 70 km", "phobos_limb_0070km"),
    Row("points from a prior, 60 km", "phobos_points_060km", prior=True, across_m=POINTS_M),
    Row("points from a prior, 40 km", "phobos_points_040km", prior=True, across_m=POINTS_M),
    Row("points from a prior, 20 km", "phobos_points_020km", prior=True),
    Row("loop, 60 km", "phobos_points_060km", across_m=POINTS_M),
    Row("loop, 40 km", "phobos_points_040km", across_m=POINTS_M),
    Row("loop, 20 km", "phobos_points_020km"),
    Row("approach, 300-70 km", "phobos_approach", flown=True, distance_km=(70.0, 301.0)),
    Row("approach, 70-40 km", "phobos_approach", flown=True, distance_km=(40.0, 70.0)),
    Row("approach, 40-20 km", "phobos_approach", flown=True, distance_km=(19.0, 40.0)),
    Row("narrow camera, 1000-500 km", "phobos_narrow", NARROW),
)


@dataclass(frozen=True, eq=False)
class RowResult:
    """The frames of a row."""

    row: Row
    frames: tuple[FrameError, ...]


@dataclass(frozen=True, eq=False)
class Results:
    """The table; the account is that of this run's build, whose stages may have been kept."""

    account: Account
    rows: tuple[RowResult, ...]


def run(output: Path, progress: Progress, frames: int | None = None, rows: str = "") -> Results:
    """Build, fly, navigate and compare; what is there already is used again.

    output  folder for catalog, pictures, runs and figures.json
    frames  pictures of a scenario a camera, its own number when None
    rows    only rows whose name contains this
    """
    chosen = [row for row in ROWS if rows in row.name]
    if not chosen:
        raise NothingToDoError(f"no row of the study is called '{rows}'")
    output.mkdir(parents=True, exist_ok=True)
    catalog = output / "phobos.gpkg"
    config = resource("configs/catalogs/phobos.toml")
    account = build.run(config, output=catalog, progress=progress).account
    found: list[RowResult] = []
    runs: dict[str, tuple[FrameError, ...]] = {}
    for row in chosen:
        told = shipped_pictures(output, row.scenario, frames, progress)
        if not row.flown:
            told = with_star_sensor(told, priors=row.prior)
        if told.name not in runs:
            runs[told.name] = _navigated(told, catalog, output / "runs" / told.name, progress)
        found.append(RowResult(row, tuple(e for e in runs[told.name] if _is_of(row, e))))
        _write(output / FIGURES, account, found)
    return Results(account, tuple(found))


def _navigated(
    pictures: Path, catalog: Path, place: Path, progress: Progress
) -> tuple[FrameError, ...]:
    place.parent.mkdir(exist_ok=True)
    # without a solution the run is written all the same, and that is a figure too
    with suppress(NothingToDoError):
        navigate_folder(pictures, [catalog], NavigateSettings(), "ncc", place, progress)
    return tuple(evaluate_run(place, pictures / "truth.csv").frames)


def _is_of(row: Row, frame: FrameError) -> bool:
    nearest, farthest = row.distance_km
    return frame.camera == row.camera and nearest <= frame.distance_m / 1e3 < farthest


def format_results(results: Results) -> str:
    """The build's line, the table, and why frames were not solved."""
    lines = [_build_line(results.account), ""]
    lines.append(
        f"{'case':<28}{'solved':>9}{'across, rms':>20}{'max':>8}{'range':>12}{'share':>19}"
        f"{'NEES':>7}{'worst':>7}  methods"
    )
    lines += [_line(result) for result in results.rows]
    lines.append(f"wanted besides: NEES {NEES[0]}-{NEES[1]}")
    for result in results.rows:
        # what the first method tried says; the others' words follow in solution.csv
        reasons = [f.solution.reason.partition(";")[0] for f in result.frames if f.nees is None]
        lines += [
            f"{result.row.name}: {reasons.count(reason)} not solved: {reason}"
            for reason in sorted(set(reasons))
        ]
    return "\n".join(lines)


def sigmas_off(frame: FrameError) -> float:
    """How far a solved frame is off in its own sigmas; 0 for an unsolved one."""
    return 0.0 if frame.nees is None else float(np.sqrt(frame.nees))


def _build_line(account: Account) -> str:
    total = account.total()
    kept = " (in part or all done by earlier runs)" if any(s.kept for s in account.stages) else ""
    return (
        f"catalog: {account.usable} of {account.points} points usable, {total.seconds:.0f} s "
        f"(≤ {BUILD_LIMIT_S:.0f}) by the clock with {account.workers} workers, {total.cpu_s:.0f} s "
        f"of processors{kept}"
    )


def _line(result: RowResult) -> str:
    row = result.row
    solved = [frame for frame in result.frames if frame.error_rnb_m is not None]
    start = f"{row.name:<28}{len(solved):>5}/{len(result.frames):<3}"
    if not solved:
        return f"{start}  none solved"
    figures = figures_of(result.frames)
    shares = [float(f.error_rnb_m[0]) / f.distance_m for f in solved if f.error_rnb_m is not None]
    share = float(np.sqrt(np.mean(np.square(shares))))
    methods = [frame.solution.method for frame in solved]
    tally = ", ".join(f"{methods.count(m)} {m.replace('_', ' ')}" for m in sorted(set(methods)))
    asked = "" if row.across_m is None else f"(≤ {row.across_m:.0f})"
    of_range = "" if row.range_share is None else f"(≤ {100.0 * row.range_share:.1f})"
    return (
        f"{start}{figures.horizontal_rms_m:>10.1f} {asked:<8}m{figures.horizontal_max_m:>6.0f} m"
        f"{figures.height_rms_m:>10.1f} m{100.0 * share:>10.3f} {of_range:<7}%"
        f"{figures.nees:>7.2f}{max(sigmas_off(f) for f in solved):>5.1f} σ  {tally}"
    )


def _write(path: Path, account: Account, rows: Sequence[RowResult]) -> None:
    content = {
        "catalog": msgspec.to_builtins(account),
        "rows": [
            {"case": result.row.name, "frames": [_frame(frame) for frame in result.frames]}
            for result in rows
        ],
    }
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _frame(frame: FrameError) -> dict[str, object]:
    error = None if frame.error_rnb_m is None else [float(v) for v in frame.error_rnb_m]
    return {
        "file": frame.file,
        "distance_m": frame.distance_m,
        "method": frame.solution.method,
        "prior": frame.solution.prior,
        "error_rnb_m": error,
        "sigmas": sigmas_off(frame) if error else None,
        "reason": frame.solution.reason,
    }
