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
from optnav_cli.reasons import ReasonCode
from optnav_cli.stereo.height import StereoHeight, measure_height
from optnav_cli.stereo.rig import Eye, Rig
from optnav_cli.stereo.velocity import (
    BeamRange,
    SideVelocity,
    Step,
    lay_level_ground,
    measure_one_eyed_velocity,
    measure_velocity,
)

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
        eye = find_ranged_eye(read)
        if eye is None:
            mounts, rig = build_rig(read)
            rows = _measure_pairs(read, rig, list(pair_frames(read.frames, mounts)), progress)
        else:
            rows = _measure_singles(read, eye, progress)
        HEIGHTS.write(out.path / HEIGHTS_CSV, (row.cells() for row in rows))
        files = [frame.file for frame in read.frames]
        out.inputs = {"folder": folder, "pictures_sha256": hash_files(folder, files)}
        solved = sum(row.height is not None for row in rows)
        out.results = {"pairs": len(rows), "solved": solved}
        if not solved:
            out.failure = f"{folder}: no pair gives a height; the first says: {rows[0].reason}"
    return rows


def _measure_pairs(
    folder: Folder,
    rig: Rig,
    pairs: Sequence[tuple[Frame | None, Frame | None, str]],
    progress: Progress,
) -> list[StereoRow]:
    """Measure pairs in order of time."""
    rows: list[StereoRow] = []
    before: PairState | None = None
    with progress.stage(STAGE, len(pairs), "pair") as bar:
        for pair in pairs:
            row, state = _measure_pair(folder, rig, pair, before)
            before = state or before
            rows.append(row)
            bar.advance()
    return rows


@dataclass(frozen=True, eq=False)
class _RangedState:
    """An earlier picture of one camera with its range, for the velocity of a later one."""

    frame: Frame
    picture: Float32Array
    seen: BeamRange
    down: FloatArray
    ship_from_body: Rotation | None

    @property
    def turn_sigma_rad(self) -> float:
        sigma = self.frame.own_attitude_sigma_rad
        return math.inf if sigma is None else sigma


def find_ranged_eye(folder: Folder) -> Eye | None:
    """Find the camera of a folder with one camera and an altimeter; None for a stereo pair.

    Without a [[mount]] the camera's frame is the ship's.
    """
    mounts, names = folder.settings.mount, sorted(folder.cameras)
    if len(mounts) > 1 or not any(frame.range_m is not None for frame in folder.frames):
        return None
    if not mounts and len(names) != 1:
        return None
    mount = mounts[0] if mounts else MountSettings(camera=names[0], position_m=(0.0, 0.0, 0.0))
    if mount.camera not in folder.cameras:
        return None
    return Eye.mount_camera(mount, folder.cameras[mount.camera])


def _measure_singles(folder: Folder, eye: Eye, progress: Progress) -> list[StereoRow]:
    """Measure the pictures of one camera with an altimeter, in order of time."""
    frames = [f for f in folder.frames if f.problem is not None or f.camera == eye.camera.name]
    frames.sort(key=lambda frame: frame.tdb_s or 0.0)
    rows: list[StereoRow] = []
    before: _RangedState | None = None
    with progress.stage(STAGE, len(frames), "picture") as bar:
        for frame in frames:
            row, state = _measure_single(folder, eye, frame, before)
            before = state or before
            rows.append(row)
            bar.advance()
    return rows


def _measure_single(
    folder: Folder, eye: Eye, frame: Frame, before: _RangedState | None
) -> tuple[StereoRow, _RangedState | None]:
    """Measure a picture with its range: its row, and its state for the next one."""
    try:
        if frame.problem is not None:
            raise DataError(frame.problem)
        if frame.range_m is None or frame.range_sigma_m is None:
            raise DataError("no range_m: one camera needs an altimeter")
        beam = eye.ship_from_camera.apply(folder.settings.beam.direction)
        seen = BeamRange(beam, frame.range_m, frame.range_sigma_m)
        picture = _read_brightness(folder, frame)
    except DataError as error:
        return StereoRow(frame.file, "", frame.utc, reason=str(error)), None
    ship = _compute_ship_attitude(eye, frame)
    down, remark = _find_down(ship, frame)
    height = lay_level_ground(eye, seen, down)
    state = _RangedState(frame, picture, seen, down, ship)
    if before is None:
        return StereoRow(frame.file, "", frame.utc, height, reason=remark), state
    try:
        times = before.frame.tdb_s or 0.0, frame.tdb_s or 0.0
        turns = before.ship_from_body, ship
        sigma = float(np.hypot(before.turn_sigma_rad, state.turn_sigma_rad))
        step = _make_step(times, turns, sigma, down)
        earlier = before.picture, before.seen, before.down
        velocity = measure_one_eyed_velocity(earlier, (picture, seen), eye, step)
    except NoSolutionError as error:
        refused = error.code == ReasonCode.RANGE_REFUSED
        said = f"{remark}; " if remark else ""
        reason = f"{said}no velocity: {error}"
        row = StereoRow(frame.file, "", frame.utc, None if refused else height, reason=reason)
        return row, state
    return StereoRow(frame.file, "", frame.utc, height, velocity, remark), state


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
    times, turns = (before.tdb_s, now.tdb_s), (before.ship_from_body, now.ship_from_body)
    sigma = float(np.hypot(before.turn_sigma_rad, now.turn_sigma_rad))
    step = _make_step(times, turns, sigma, down)
    return measure_velocity((before.picture, before.height), (now.picture, now.height), eye, step)


def _make_step(
    times: tuple[float, float],
    ship_from_body: tuple[Rotation | None, Rotation | None],
    sigma: float,
    down: FloatArray,
) -> Step:
    """Make the step between two times, earlier first. Raises NoSolutionError for none."""
    seconds = times[1] - times[0]
    if seconds > MAX_STEP_S:
        raise NoSolutionError(f"the pair before is {seconds:.0f} s old")
    if seconds <= 0.0:
        raise NoSolutionError("the pair before is of the same time")
    first, second = ship_from_body
    if first is None or second is None:
        raise NoSolutionError("the pictures have no attitude: a turn looks like a motion")
    if not np.isfinite(sigma):
        raise NoSolutionError("the attitudes have no sigma: a turn looks like a motion")
    return Step(seconds, first * second.inv(), sigma, down)


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
