"""Settings to landings in a folder, as `optnav orbit landing` does."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.config import resolve_config
from catalog.errors import NoSolutionError, NothingToDoError
from catalog.files import hash_file
from catalog.progress import Progress
from optnav_cli.frames.orbit_tables import LANDING, LANDING_IMPULSE, LANDING_PATH
from optnav_cli.orbit.fit.oem import Oem, write_oem
from optnav_cli.orbit.landing.descent import Touchdown
from optnav_cli.orbit.landing.navigation import beams_about
from optnav_cli.orbit.landing.settings import (
    IMPULSE_CSV,
    LANDING_CSV,
    LANDING_KIND,
    PATH_CSV,
    load_landing_settings,
)
from optnav_cli.orbit.landing.trials import (
    STEP_S,
    LandingTask,
    LandingTrial,
    fly_descents,
    fly_transfer,
    landing_task,
    wrong_ground,
)
from optnav_cli.orbit.qso.settings import FOLDER, moon_of
from optnav_cli.output.manifest import output_folder
from optnav_cli.output.wording import align_table

STAGE = "orbit landing"
GROUNDS = 5  # wrong grounds that the trials take in turn
DRAWN_BEAMS = 5  # sets of beams in path.csv
PROFILE_KM, PROFILE_STEP_KM = 20.0, 0.1


@dataclass(frozen=True, eq=False)
class LandingResult:
    """The nominal landing, and trials in groups of one ground each."""

    task: LandingTask
    trials: list[LandingTrial]
    groups: list[tuple[list[LandingTrial], Touchdown]]

    def cells(self) -> list[dict[str, object]]:
        """Rows of landing.csv in the order of the trials."""
        rows: dict[int, dict[str, object]] = {
            trial.number: {
                "trial": trial.number,
                "status": "unsolved" if trial.reason else "solved",
                "reason": trial.reason,
                "dv_m_s": trial.dv_m_s,
            }
            for trial in self.trials
        }
        for trials, down in self.groups:
            for index, trial in enumerate(trials):
                rows[trial.number] |= _trial_cells(trial, down, index)
        return [rows[trial.number] for trial in self.trials]


def landing_folder(settings_path: Path, output: Path, progress: Progress) -> LandingResult:
    """Fly the landing of the settings and write the folder.

    Raises ConfigError and DataError for wrong settings and files, NothingToDoError where there is
    no nominal landing or, after the folder is written, no trial that arrives.
    """
    path = resolve_config(settings_path, FOLDER)
    settings = load_landing_settings(settings_path)
    with output_folder(output, LANDING_KIND, "orbit landing", [path], STAGE) as out:
        moon = moon_of(settings.landing.body, path)
        try:
            task = landing_task(settings, moon, path.parent)
        except NoSolutionError as error:
            raise NothingToDoError(f"{settings_path}: {error}") from None
        result = fly_trials(task, progress)
        cells = result.cells()
        landed = [row for row in cells if row["status"] == "solved"]
        LANDING.write(out.path / LANDING_CSV, cells)
        LANDING_IMPULSE.write(out.path / IMPULSE_CSV, _impulse_cells(task))
        LANDING_PATH.write(out.path / PATH_CSV, _path_cells(result))
        write_oem(out.path / "transfer.oem", _oem(task), "TRANSFER")
        out.options = msgspec.to_builtins(settings)
        out.inputs = {"settings": path, "settings_sha256": hash_file(path)}
        out.results = {"trials": len(cells), "landed": len(landed)}
        if cells and not landed:
            out.failure = f"{settings_path}: no trial lands; the first: {cells[0]['reason']}"
    return result


def fly_trials(task: LandingTask, progress: Progress, grounds: int = GROUNDS) -> LandingResult:
    """All trials that the settings ask for, over so many grounds in turn."""
    section = task.settings.landing
    trials: list[LandingTrial] = []
    groups: list[tuple[list[LandingTrial], Touchdown]] = []
    with progress.stage(STAGE, section.trials, "trial") as bar:
        for ground in range(min(grounds, section.trials)):
            truth = wrong_ground(task, section.seed * grounds + ground)
            flown = []
            for number in range(ground + 1, section.trials + 1, grounds):
                flown.append(fly_transfer(task, truth, number))
                bar.advance()
            trials += flown
            arrived = [trial for trial in flown if not trial.reason]
            if arrived:
                groups.append((arrived, fly_descents(task, truth, arrived)))
    return LandingResult(task, sorted(trials, key=lambda trial: trial.number), groups)


def _trial_cells(trial: LandingTrial, down: Touchdown, place: int) -> dict[str, object]:
    end, error = down.end, trial.error
    cells: dict[str, object] = {
        "arrival_error_m": float(np.linalg.norm(error[:3])),
        "arrival_sigma_m": float(np.sqrt(np.trace(trial.covariance[:3, :3]))),
        "arrival_error_m_s": float(np.linalg.norm(error[3:])),
        "arrival_nees": trial.nees,
        "steps": trial.steps,
        "starts": trial.starts,
        "end_height_error_m": float(end.height_m[place]),
        "end_side_error_m": float(end.side_m[place]),
        "end_down_error_m_s": float(end.rate_m_s[place]),
        "end_side_error_m_s": float(end.side_m_s[place]),
        "end_nees": float(end.nees[place]),
    }
    if not down.landed[place]:
        return cells | {"status": "unsolved", "reason": "the craft does not come to the ground"}
    return cells | {
        "east_m": float(down.east_m[place]),
        "north_m": float(down.north_m[place]),
        "down_m_s": float(down.down_m_s[place]),
        "side_m_s": float(down.side_m_s[place]),
        "dv_m_s": trial.dv_m_s + float(down.dv_m_s[place]),
    }


def _impulse_cells(task: LandingTask) -> Iterator[dict[str, object]]:
    departure = task.departure
    errors = departure.errors_m_s()
    for step, (change, left) in enumerate(zip(departure.changes, errors, strict=True), start=1):
        axes = dict(zip(("dv_x_m_s", "dv_y_m_s", "dv_z_m_s"), map(float, change), strict=True))
        yield {"step": step, "left_m_s": float(left), **axes}


def _path_cells(result: LandingResult) -> Iterator[dict[str, object]]:
    """The landing in the plane of the transfer: path, ground and beams."""
    task = result.task
    settings, site = task.settings, task.site
    begin = (task.path[0] - site.point) @ site.axes.T
    along = np.array([*-begin[:2], 0.0]) / float(np.linalg.norm(begin[:2]))
    plane = np.stack([along, [0.0, 0.0, 1.0], np.cross([0.0, 0.0, 1.0], along)]) @ site.axes

    def row(kind: str, seconds: float | None, position: FloatArray) -> dict[str, object]:
        x, up, side = (plane @ (position - site.point) / 1e3).tolist()
        return {"kind": kind, "seconds": seconds, "along_km": x, "up_km": up, "side_km": side}

    duration = settings.landing.transfer_s
    seconds = np.linspace(0.0, duration, len(task.path))
    for after, position in zip(seconds, task.path, strict=True):
        yield row("transfer", float(after), position)
    for _, down in result.groups[:1]:
        for step, state in enumerate(down.path):
            yield row("descent", duration + step, site.point + state[:3] @ site.axes)
    steps = np.arange(-PROFILE_KM, PROFILE_KM, PROFILE_STEP_KM) * 1e3
    lines = site.point + steps[:, None] * plane[0] + 2e4 * site.up
    hits = task.model.cast(lines, np.tile(-site.up, (len(lines), 1)))
    for position, distance in zip(hits.points, hits.range_m, strict=True):
        if np.isfinite(distance):
            yield row("ground", None, position)
    chosen = np.linspace(0, len(task.path) - 1, DRAWN_BEAMS).astype(int)
    for position in task.path[chosen]:
        rays = beams_about(
            -position / np.linalg.norm(position), float(np.radians(settings.beams.off_deg))
        )
        beam_hits = task.model.cast(np.tile(position, (len(rays), 1)), rays)
        for point, distance in zip(beam_hits.points, beam_hits.range_m, strict=True):
            if np.isfinite(distance):
                yield row("beam", None, position)
                yield row("beam", None, point)


def _oem(task: LandingTask) -> Oem:
    departure = task.departure
    times = np.linspace(departure.tdb_s, departure.arrival_s, len(task.path))
    states = task.motion.propagate(departure.state, times, STEP_S)
    return Oem(task.motion.moon.name, times, states)


def landing_lines(result: LandingResult) -> list[str]:
    """A summary for people."""
    departure, cells = result.task.departure, result.cells()
    lines = [f"departure impulse {np.linalg.norm(departure.impulse):.3f} m/s"]
    landed = [row for row in cells if "east_m" in row]
    if not landed:
        return lines

    def column(name: str) -> FloatArray:
        return np.array([row[name] for row in landed], dtype=np.float64)

    distance = np.hypot(column("east_m"), column("north_m"))
    rows = [
        ("", "rms", "largest"),
        ("arrival error, m", *_two(column("arrival_error_m"))),
        ("distance from the target, m", *_two(distance)),
        ("velocity down, m/s", *_two(column("down_m_s"))),
        ("velocity across, m/s", *_two(column("side_m_s"))),
        ("velocity change of burns, m/s", *_two(column("dv_m_s"))),
    ]
    return [*lines, f"{len(landed)} of {len(cells)} trials land", *align_table(rows, left=(0,))]


def _two(values: FloatArray) -> tuple[str, str]:
    return f"{np.sqrt(np.mean(values**2)):.3g}", f"{np.abs(values).max():.3g}"
