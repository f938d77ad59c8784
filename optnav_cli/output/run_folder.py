"""A run folder: the names of its files, what it takes over from the picture folder, reading it.

And what came of a run, as a few lines for people.
"""

import math
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from catalog.bodies.body import is_body_file
from catalog.errors import ConfigError, DataError
from catalog.files import hash_file
from catalog.tables import CsvTable
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.fix import MatchRow, Method, Solution
from optnav_cli.frames.frames import picture_path, read_time_sigma
from optnav_cli.frames.points import POINTS_CSV
from optnav_cli.frames.run_settings import (
    RUN_TOML,
    FileAttitude,
    RunSettings,
    read_run_settings,
    write_run_settings,
)
from optnav_cli.frames.tables import CAMERA, FILE, UTC_SIGMA
from optnav_cli.output.manifest import read_manifest
from optnav_cli.output.tables import read_matches, read_solutions
from optnav_cli.output.wording import align_table, choose_length_unit, format_plural

SOLUTION, MATCHES, LANDMARKS = "solution.csv", "matches.csv", "landmarks.csv"
RECORDING, OVERLAYS = "run.mcap", "overlays"
COMMON_JSON, COMMON_CSV = "common.json", "common.csv"  # of an adjusted run
FRAMES, CAMERAS = "frames.csv", "cameras"  # copies of the picture folder's


@dataclass(frozen=True, eq=False)
class RunFolder:
    """Contents of a run folder; `cameras` by picture file name, as far as they are known.

    time_sigmas_s  1 sigma of times, by picture file name, where one is stated
    """

    path: Path
    settings: RunSettings
    attitude: FileAttitude
    solutions: list[Solution]
    matches: list[MatchRow]
    cameras: dict[str, Camera]
    time_sigmas_s: dict[str, float] = field(default_factory=dict)


def copy_inputs(pictures: Path, settings: RunSettings, run: Path) -> None:
    """Copy run.toml, the body's own file, frames.csv and cameras/ into a run, to be read alone."""
    for name in (RUN_TOML, FRAMES):
        shutil.copyfile(pictures / name, run / name)
    if (pictures / POINTS_CSV).exists():
        shutil.copyfile(pictures / POINTS_CSV, run / POINTS_CSV)
    if is_body_file(settings.body):
        write_run_settings(settings, run)
    shutil.copytree(pictures / CAMERAS, run / CAMERAS, copy_function=shutil.copyfile)


def read_run(path: Path) -> RunFolder:
    """Read a run folder back.

    Raises DataError for a folder that is no run and for damaged files.
    """
    if not (path / SOLUTION).is_file():
        problem = "a file" if path.is_file() else "no solution.csv in it"
        raise DataError(f"{path}: {problem}; wanted the folder that `optnav navigate -o` wrote")
    try:
        settings, body = read_run_settings(path / RUN_TOML)
    except ConfigError as error:
        raise DataError(f"{error}; the run's copy is needed to read its attitudes") from error
    attitude = FileAttitude(settings.attitude, body)
    matches = read_matches(path / MATCHES) if (path / MATCHES).exists() else []
    solutions = read_solutions(path / SOLUTION, attitude)
    return RunFolder(
        path, settings, attitude, solutions, matches, _read_cameras(path), _read_time_sigmas(path)
    )


def find_run_pictures(run: Path, pictures: Path | None) -> tuple[Path, dict[str, str | None]]:
    """Find the folder of a run's pictures, and their SHA-256 by name as the run knows them.

    pictures  the folder that the user names; None: as the run's manifest says
    Raises DataError where it is gone, or shows another body.
    """
    inputs = read_manifest(run).get("inputs")
    inputs = inputs if isinstance(inputs, dict) else {}
    hashes = inputs.get("files_sha256")
    if pictures is None:
        named = inputs.get("pictures")
        if not isinstance(named, str) or not Path(named).is_dir():
            raise DataError(
                f"{run}: its pictures are not in {named or 'any folder that it names'}; name the "
                "picture folder by --pictures"
            )
        pictures = Path(named)
    if not pictures.is_dir():
        raise DataError(f"{pictures}: there is no such folder; wanted that of the run's pictures")
    if (pictures / RUN_TOML).is_file():
        body, stated = (read_run_settings(at / RUN_TOML)[1].name for at in (run, pictures))
        if body != stated:
            raise DataError(
                f"{pictures}: its pictures show {stated}, {run} is a run at {body}; name the "
                "folder that the run was made from"
            )
    return pictures, hashes if isinstance(hashes, dict) else {}


def check_run_picture(pictures: Path, file: str, known: Mapping[str, str | None]) -> None:
    """Raise DataError for a picture that is not the one that the run solved."""
    wanted = known.get(file)
    path = picture_path(pictures, file)
    if wanted is not None and path.is_file() and hash_file(path) != wanted:
        raise DataError(
            f"{path}: is not the picture that the run was made from (another SHA-256); name the "
            "folder of the run's pictures with --pictures"
        )


def _read_time_sigmas(path: Path) -> dict[str, float]:
    """Read 1 sigma of each frame's time from solution.csv, else from the copy of frames.csv."""
    sigmas: dict[str, float] = {}
    table = CsvTable((FILE, UTC_SIGMA))
    for name in (FRAMES, SOLUTION):
        if (path / name).exists():
            for row in table.rows(path / name):
                try:
                    sigma = None if row.problem else read_time_sigma(row)
                except DataError as error:
                    raise DataError(f"{row.where}: {error}") from None
                if sigma is not None:
                    sigmas[row["file"]] = sigma
    return sigmas


def _read_cameras(path: Path) -> dict[str, Camera]:
    """Read the camera of each frame; frames whose camera is missing or wrong are left out."""
    if not (path / FRAMES).exists():
        return {}
    known: dict[str, Camera | None] = {}
    cameras = {}
    for row in CsvTable((FILE, CAMERA)).rows(path / FRAMES):
        name = row["camera"]
        if name not in known:
            try:
                known[name] = load_camera(path / CAMERAS / f"{name}.toml")
            except ConfigError:  # its frames are unsolved, and navigate has said why
                known[name] = None
        camera = known[name]
        if camera is not None:
            cameras[row["file"]] = camera
    return cameras


def summarise_run(solutions: Sequence[Solution]) -> list[str]:
    """Summarise how many frames are solved, by which method, how well, and why others are not."""
    sigmas: dict[str, list[float]] = {}
    for s in solutions:
        if s.covariance_m2 is not None:
            sigma = math.sqrt(max(float(np.trace(s.covariance_m2)), 0.0) / 3.0)
            sigmas.setdefault(Method(s.method).label, []).append(sigma)
    solved = sum(map(len, sigmas.values()))
    lines = [f"solved {solved} of {len(solutions)} {format_plural('frame', len(solutions))}"]
    if sigmas:
        unit = choose_length_unit(max(map(max, sigmas.values())))
        rows = [("method", "frames", f"median sigma an axis, {unit.name}", "largest")]
        for method, values in sorted(sigmas.items()):
            median, largest = unit.text(float(np.median(values))), unit.text(max(values))
            rows.append((method, str(len(values)), median, largest))
        lines += align_table(rows)
    reasons = Counter(s.reason_code.label for s in solutions if not s.solved)
    lines += [f"unsolved, {reason}: {count}" for reason, count in reasons.most_common()]
    return lines
