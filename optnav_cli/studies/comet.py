"""A comet with less and less stated: position and attitude, a turned attitude, no position.

The labels of the archive, corrected by what is common to them (`studies.real`), are taken for the
truth. What is stated is drawn about them with the sigmas of a case, by a fixed seed. Errors across
the line of sight hold those of the attitude, which moves the camera about the body.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress
from optnav_cli.evaluation.figures import FrameError, figures_of
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.truth import Truth, write_truth
from optnav_cli.studies import flights, real
from optnav_cli.studies.tables import Cell, StudyReport, StudyTable, columns, rms, tally

SEED = 7
TURNED_DEG = (0.02, 0.65, 0.23)  # the body's axes of the labels of 67P against its shape model


@dataclass(frozen=True)
class Stated(flights.Case):
    """What is stated of each frame.

    position_m    1 sigma a component; None: no position
    attitude_rad  1 sigma an axis; None: free, the first guess turned by TURNED_DEG
    """

    position_m: float | None
    attitude_rad: float | None


CASES = (
    Stated('position to 300 m, attitude to 200"', 300.0, 200.0 * ARCSEC),
    Stated("position to 300 m, attitude free, 0.7 deg off", 300.0, None),
    Stated("no position, attitude to 0.2 deg", None, np.radians(0.2)),
)


def run(
    folder: Path, output: Path, progress: Progress, frames: int | None = None, rows: str = ""
) -> list[tuple[Stated, tuple[FrameError, ...]]]:
    """Correct the labels of 67P, and navigate its pictures in each case; files go into `output`.

    folder, frames  as in `studies.real`;  rows  only cases whose name contains this
    """
    chosen = flights.rows_named(CASES, rows)
    pictures, catalogs = real.corrected_set("67P", folder, output, progress, frames)
    results = []
    for case in chosen:
        number = CASES.index(case)
        stated = stated_folder(pictures, output / f"pictures-{number}", case)
        run_folder = output / f"run-{number}"
        results.append((case, flights.navigated(stated, catalogs, run_folder, progress)))
    return results


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
    "stated; solved; frames; across, rms [m] .0f; range, rms [%] .2f; NEES .2f; worst [σ] .1f; "
    "methods"
)


def report(results: Sequence[tuple[Stated, Sequence[FrameError]]]) -> StudyReport:
    """The table, a case a row, and why frames were not solved."""
    notes = []
    for case, frames in results:
        reasons = [f.solution.reason.partition(";")[0] for f in frames if f.nees is None]
        notes += flights.not_solved(case.name, reasons)
    rows = tuple(_cells(case, frames) for case, frames in results)
    return StudyReport((StudyTable("67P with less and less stated", COLUMNS, rows),), tuple(notes))


def _cells(case: Stated, frames: Sequence[FrameError]) -> tuple[Cell, ...]:
    solved = [frame for frame in frames if frame.error_rnb_m is not None]
    if not solved:
        return (case.name, 0, len(frames), None, None, None, None, "none solved")
    f = figures_of(frames)
    shares = [float(f.error_rnb_m[0]) / f.distance_m for f in solved if f.error_rnb_m is not None]
    return (
        *(case.name, len(solved), len(frames), f.horizontal_rms_m, 100.0 * rms(shares), f.nees),
        max(map(flights.sigmas_off, solved)),
        tally([one.solution.method for one in solved]),
    )
