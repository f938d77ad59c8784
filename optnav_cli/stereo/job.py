"""A folder of stereo pairs to heights.csv: height and side velocity of each pair."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.errors import ConfigError, DataError, NoSolutionError
from catalog.geometry.vectors import unit
from catalog.progress import Progress
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_frame_picture
from optnav_cli.frames.run_settings import RUN_TOML, MountSettings, select_stereo_pair
from optnav_cli.frames.tables import HEIGHTS
from optnav_cli.navigate.history import SAME_TIME_S
from optnav_cli.output.manifest import hash_files, output_folder
from optnav_cli.output.wording import align_table
from optnav_cli.stereo.height import StereoHeight, measure_height
from optnav_cli.stereo.rig import Eye, Rig
from optnav_cli.stereo.velocity import SideVelocity, Step, measure_velocity

KIND, STAGE = "stereo heights", "stereo"
HEIGHTS_CSV = "heights.csv"
MAX_STEP_S = 60.0  # between pairs whose ground is looked for in each other
SHIP_DOWN = np.array([0.0, 0.0, 1.0])
LEVEL = "no attitude and position: the height is along the ship's z axis"


@dataclass(frozen=True, eq=False)
class StereoRow:
    """A row of heights.csv: a pair, or a picture that has none.

    first, second  names of the pictures, empty where one is missing
    """

    first: str
    second: str
    utc: str
    height: StereoHeight | None = None
    velocity: SideVelocity | None = None
    reason: str = ""

    def cells(self) -> dict[str, object]:
        """Return the cells of heights.csv."""
        cells: dict[str, object] = {"file_left": self.first, "file_right": self.second}
        cells |= {"utc": self.utc, "reason": self.reason}
        cells["status"] = "unsolved" if self.height is None else "solved"
        if self.height is not None:
            cells["height_m"] = self.height.height_m
            cells["sigma_m"] = self.height.sigma_m
            cells["sigma_mounting_m"] = self.height.sigma_mounting_m
            cells["n_windows"] = self.height.windows
        if self.velocity is not None:
            cells["velocity_x_m_s"], cells["velocity_y_m_s"] = self.velocity.velocity_m_s[:2]
            cells["velocity_sigma_m_s"] = self.velocity.side_sigma_m_s
        return cells


@dataclass(frozen=True, eq=False)
class PairState:
    """An earlier pair, for the velocity of a later one."""

    tdb_s: float
    picture: Float32Array
    height: StereoHeight
    ship_from_body: Rotation | None
    turn_sigma_rad: float


def measure_stereo_folder(folder: Path, output: Path, progress: Progress) -> list[StereoRow]:
    """Measure all pairs of a folder and write OUT with heights.csv.

    Raises ConfigError for a run.toml without two mounts on a base, DataError for a folder that
    cannot be used, NothingToDoError, after the output is written, when no pair gives a height.
    """
    with output_folder(output, KIND, "stereo", [folder], STAGE) as out:
        read = read_folder(folder)
        mounts, rig = build_rig(read)
        pairs = list(pair_frames(read.frames, mounts))
        rows: list[StereoRow] = []
        with progress.stage(STAGE, len(pairs), "pair") as bar:
            before: PairState | None = None
            for pair in pairs:
                row, state = _measure_pair(read, rig, pair, before)
                before = state or before
                rows.append(row)
                bar.advance()
        HEIGHTS.write(out.path / HEIGHTS_CSV, (row.cells() for row in rows))
        files = [frame.file for frame in read.frames]
        out.inputs = {"folder": folder, "pictures_sha256": hash_files(folder, files)}
        solved = sum(row.height is not None for row in rows)
        out.results = {"pairs": len(rows), "solved": solved}
        if not solved:
            out.failure = f"{folder}: no pair gives a height; the first says: {rows[0].reason}"
    return rows


def build_rig(folder: Folder) -> tuple[tuple[MountSettings, MountSettings], Rig]:
    """Build the mounts and the rig of a folder. Raises ConfigError where run.toml states none."""
    where = folder.path / RUN_TOML
    try:
        mounts = select_stereo_pair(folder.settings.mount)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    for mount in mounts:
        if mount.camera not in folder.cameras:
            raise ConfigError(
                f"{where}: [[mount]] names the camera '{mount.camera}', which has no file in "
                f"cameras/; there are {', '.join(sorted(folder.cameras))}"
            )
    first, second = (Eye.mount_camera(mount, folder.cameras[mount.camera]) for mount in mounts)
    return mounts, Rig(first, second)


def pair_frames(
    frames: Sequence[Frame], mounts: tuple[MountSettings, MountSettings]
) -> Iterator[tuple[Frame | None, Frame | None, str]]:
    """Pair pictures of one time by both cameras, in order of time; say why one has no partner."""
    names = [mount.camera for mount in mounts]
    usable = [f for f in frames if f.problem is None and f.tdb_s is not None and f.camera in names]
    usable.sort(key=lambda frame: (frame.tdb_s or 0.0, names.index(frame.camera)))
    left = [deque(f for f in usable if f.camera == name) for name in names]
    while left[0] or left[1]:
        # of both cameras' next ones the earlier, so that the other is the nearest that is left
        side = min((0, 1), key=lambda s: left[s][0].tdb_s or 0.0 if left[s] else math.inf)
        frame = left[side].popleft()
        nearest = left[1 - side][0] if left[1 - side] else None
        if nearest is not None and _compute_interval_s(frame, nearest) <= SAME_TIME_S:
            left[1 - side].popleft()
            yield (frame, nearest, "") if side == 0 else (nearest, frame, "")
            continue
        if nearest is None:
            why = f"camera '{names[1 - side]}' has no picture left for this one"
        else:
            why = (
                f"camera '{names[1 - side]}' has no picture of this time: the nearest, "
                f"{nearest.file}, is {_compute_interval_s(frame, nearest):.3g} s away"
            )
        yield (frame, None, why) if side == 0 else (None, frame, why)
    for frame in frames:
        if frame.problem is not None:
            yield frame, None, frame.problem


def _compute_interval_s(one: Frame, other: Frame) -> float:
    return abs((one.tdb_s or 0.0) - (other.tdb_s or 0.0))


def _measure_pair(
    folder: Folder, rig: Rig, pair: tuple[Frame | None, Frame | None, str], before: PairState | None
) -> tuple[StereoRow, PairState | None]:
    """Measure a pair: its row, and its state for the next one."""
    first, second, why = pair
    names = first.file if first else "", second.file if second else ""
    utc = next((frame.utc for frame in (first, second) if frame), "")
    if first is None or second is None:
        return StereoRow(*names, utc, reason=why), None
    try:
        brightness = _read_brightness(folder, first)
        other_brightness = _read_brightness(folder, second)
        ship = _compute_ship_attitude(rig.first, first)
        down, remark = _find_down(ship, first)
        height = measure_height(brightness, other_brightness, rig, down)
    except (DataError, NoSolutionError) as error:
        return StereoRow(*names, utc, reason=str(error)), None
    tdb_s = first.tdb_s or 0.0
    sigma = first.own_attitude_sigma_rad
    state = PairState(tdb_s, brightness, height, ship, math.inf if sigma is None else sigma)
    row = StereoRow(*names, utc, height, reason=remark)
    if before is None:
        return row, state
    try:
        velocity = _measure_velocity(before, state, rig.first, down)
    except NoSolutionError as error:
        said = f"{remark}; " if remark else ""
        return StereoRow(*names, utc, height, reason=f"{said}no velocity: {error}"), state
    return StereoRow(*names, utc, height, velocity, remark), state


def _read_brightness(folder: Folder, frame: Frame) -> Float32Array:
    return load_frame_picture(folder.path, frame.file, folder.cameras[frame.camera]).values


def _compute_ship_attitude(eye: Eye, frame: Frame) -> Rotation | None:
    turn = frame.camera_from_body
    return None if turn is None else eye.ship_from_camera * turn


def _find_down(ship_from_body: Rotation | None, frame: Frame) -> tuple[FloatArray, str]:
    """Find the way down (3,) in the ship's frame, with a remark where it is assumed."""
    if ship_from_body is None or frame.position_m is None:
        return SHIP_DOWN, LEVEL
    down: FloatArray = ship_from_body.apply(-unit(frame.position_m))
    return down, ""


def _measure_velocity(
    before: PairState, now: PairState, eye: Eye, down: FloatArray
) -> SideVelocity:
    seconds = now.tdb_s - before.tdb_s
    if seconds > MAX_STEP_S:
        raise NoSolutionError(f"the pair before is {seconds:.0f} s old")
    if seconds <= 0.0:
        raise NoSolutionError("the pair before is of the same time")
    if before.ship_from_body is None or now.ship_from_body is None:
        raise NoSolutionError("the pictures have no attitude: a turn looks like a motion")
    sigma = float(np.hypot(before.turn_sigma_rad, now.turn_sigma_rad))
    if not np.isfinite(sigma):
        raise NoSolutionError("the attitudes have no sigma: a turn looks like a motion")
    turn = before.ship_from_body * now.ship_from_body.inv()
    step = Step(seconds, turn, sigma, down)
    return measure_velocity((before.picture, before.height), (now.picture, now.height), eye, step)


def list_result_lines(rows: Sequence[StereoRow]) -> list[str]:
    """List the heights for people."""
    head = ("pair", "height, m", "sigma", "mounting", "side velocity, m/s", "sigma", "")
    table: list[tuple[str, ...]] = []
    for row in rows:
        height, velocity = row.height, row.velocity
        cells = ["", "", ""] if height is None else _format_height(height)
        speed = ("", "")
        if velocity is not None:
            x, y = velocity.velocity_m_s[:2]
            speed = (f"{x:.3f} {y:.3f}", f"{velocity.side_sigma_m_s:.3f}")
        table.append((row.first or row.second, *cells, *speed, row.reason))
    return align_table([head, *table], left=(0, 6))


def _format_height(height: StereoHeight) -> list[str]:
    values = height.height_m, height.sigma_m, height.sigma_mounting_m
    return [f"{value:.3f}" for value in values]
