"""A comet with less and less stated: position and attitude, a turned attitude, no position.

The labels of the archive, corrected by what is common to them (`studies.real`), are taken for the
truth. What is stated is drawn about them with the sigmas of a case, by a fixed seed.

A picture tells where the body stands before the camera. The camera's place about the body hangs on
the attitude besides: 200 arc seconds are 120 m at these distances, whatever is matched. So errors
across the line of sight are given twice: of the body's place as the camera sees it, which is what
is asked of a method, and of the camera's place about the body, which its covariance states.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import unit
from catalog.progress import Progress
from optnav_cli.evaluation.figures import FrameError, compute_figures
from optnav_cli.fix import Fix
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.truth import Truth, read_truth, write_truth
from tests.studies import flights, real
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms, tally

SEED = 7
TURNED_DEG = (0.02, 0.65, 0.23)  # the body's axes of the labels of 67P against its shape model


@dataclass(frozen=True)
class Stated(flights.Case):
    """What is stated of each frame, and what is asked of it.

    position_m    1 sigma a component; None: no position
    attitude_rad  1 sigma an axis; None: free, the first guess turned by TURNED_DEG
    solved_percent, seen_m, range_percent  frames solved at least; the others rms at most
    """

    position_m: float | None
    attitude_rad: float | None
    solved_percent: float
    seen_m: float | None = None
    range_percent: float | None = None


CASES = (
    Stated('position to 300 m, attitude to 200"', 300.0, 200.0 * ARCSEC, 90.0, 30.0, 0.3),
    Stated("position to 300 m, attitude free, 0.7 deg off", 300.0, None, 80.0),
    Stated("no position, attitude to 0.2 deg", None, np.radians(0.2), 60.0, 200.0, 1.0),
)


class CaseResult(NamedTuple):
    """The frames of a case against the truth.

    seen_m     by file of solved frames: how far the body's centre lies across the line of sight
               from where the camera sees it
    held_back  files with which no size of an error was set
    """

    case: Stated
    frames: tuple[FrameError, ...]
    seen_m: Mapping[str, float]
    held_back: frozenset[str]


def run(
    folder: Path, output: Path, progress: Progress, frames: int | None = None, rows: str = ""
) -> list[CaseResult]:
    """Correct the labels of 67P, and navigate its pictures in each case; files go into `output`.

    folder, frames  as in `studies.real`;  rows  only cases whose name contains this
    """
    chosen = flights.rows_named(CASES, rows)
    pictures, catalogs = real.corrected_set("67P", folder, output, progress, frames)
    # sizes were set on the even ones of all pictures (configs/models/silhouette.toml)
    odd = tuple(path.stem for path in real.labels_of("67P", folder)[1::2])
    results = []
    for case in chosen:
        number = CASES.index(case)
        stated = stated_folder(pictures, output / f"pictures-{number}", case)
        run_folder = output / f"run-{number}"
        found = flights.navigated(stated, catalogs, run_folder, progress)
        truths = read_truth(stated / "truth.csv", read_folder(stated).attitude)
        held_back = frozenset(f.file for f in found if f.file.startswith(odd))
        results.append(CaseResult(case, found, _seen_m(found, truths), held_back))
    return results


def _seen_m(frames: Sequence[FrameError], truths: Sequence[Truth]) -> dict[str, float]:
    by_file = {truth.file: truth for truth in truths}
    fixes = {frame.file: frame.solution.fix for frame in frames}
    return {n: seen_error_m(fix, by_file[n]) for n, fix in fixes.items() if fix is not None}


def seen_error_m(fix: Fix, truth: Truth) -> float:
    """How far the body's centre lies across the line of sight from where the camera sees it, m."""
    true_centre = truth.camera_from_body.apply(-truth.position_m)
    turn = truth.camera_from_body if fix.camera_from_body is None else fix.camera_from_body
    error = turn.apply(-fix.position_m) - true_centre
    towards = unit(true_centre)
    return float(np.linalg.norm(error - towards * (towards @ error)))


def stated_folder(pictures: Path, place: Path, case: Stated) -> Path:
    """The pictures with what a case states of them, and their truth."""
    read = read_folder(pictures)
    rng = np.random.default_rng(SEED)
    frames, truths = [], []
    for frame in read.frames:
        turn, position = frame.camera_from_body, frame.position_m
        if turn is None or position is None or frame.tdb_s is None:
            raise DataError(f"{pictures}: {frame.file}: wanted its position, attitude and time")
        truths.append(Truth(frame.file, frame.utc, frame.tdb_s, position, turn))
        aside, moved = rng.normal(size=3), rng.normal(size=3)
        if case.attitude_rad is None:
            stated = turn * Rotation.from_rotvec(np.radians(TURNED_DEG)).inv()
        else:
            stated = Rotation.from_rotvec(case.attitude_rad * aside) * turn
        known = None if case.position_m is None else position + case.position_m * moved
        frames.append(
            replace(
                frame,
                camera_from_body=stated,
                attitude_sigma_rad=case.attitude_rad,
                common_sigma_rad=0.0,
                position_m=known,
                position_sigma_m=case.position_m,
            )
        )
    cameras = [replace(c, boresight_sigma_arcsec=0.0) for c in read.cameras.values()]
    write_folder(place, read.settings, cameras, frames)
    write_truth(place / "truth.csv", FileAttitude(read.settings.attitude, read.body), truths)
    for frame in frames:
        (place / frame.file).unlink(missing_ok=True)
        os.link(pictures / frame.file, place / frame.file)
    return place


COLUMNS = columns(
    "stated; solved; frames; solved_limit = asked ≥ [%] .0f; "
    "across_seen_m = across, as seen, rms [m] .1f; across_limit = asked ≤ [m] .0f; "
    "range, rms [%] .2f; range_limit = asked ≤ [%] .1f; across, about the body, rms [m] .0f; "
    "NEES .2f; nees_held_back = NEES, held back .2f; worst [σ] .1f; beyond = beyond 5 σ; methods"
)


def report(results: Sequence[CaseResult]) -> StudyReport:
    """The table, a case a row, and why frames were not solved."""
    notes = []
    for result in results:
        reasons = [f.solution.reason.partition(";")[0] for f in result.frames if f.nees is None]
        notes += flights.not_solved(result.case.name, reasons)
    rows = tuple(map(_cells, results))
    return StudyReport((StudyTable("67P with less and less stated", COLUMNS, rows),), tuple(notes))


def _cells(result: CaseResult) -> tuple[Cell, ...]:
    case, frames = result.case, result.frames
    solved = [frame for frame in frames if frame.error_rnb_m is not None]
    begin = (case.name, len(solved), len(frames), case.solved_percent)
    if not solved:
        return (*begin, *[None] * (len(COLUMNS) - len(begin) - 1), "none solved")
    f = compute_figures(frames)
    shares = [float(f.error_rnb_m[0]) / f.distance_m for f in solved if f.error_rnb_m is not None]
    held_back = [one.nees / 3.0 for one in solved if one.nees and one.file in result.held_back]
    return (
        *begin,
        *(rms(list(result.seen_m.values())), case.seen_m),
        *(100.0 * rms(shares), case.range_percent),
        *(f.horizontal_rms_m, f.nees, float(np.mean(held_back)) if held_back else None),
        *(max(map(flights.sigmas_off, solved)), f.beyond_5_sigma),
        tally([one.solution.method for one in solved]),
    )
