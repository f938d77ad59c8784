"""A picture folder: run.toml, cameras/NAME.toml, frames.csv, perhaps points.csv; the pictures.

And a picture with all that navigation must know of it beforehand.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import Ephemeris, load_ephemeris
from catalog.errors import ConfigError, DataError, NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera, write_camera
from optnav_cli.fix import PositionPrior
from optnav_cli.frames.frames import Frame, picture_path, read_frames, write_frames
from optnav_cli.frames.picture import Picture
from optnav_cli.frames.points import POINTS_CSV, PickedPoint, read_picked_points
from optnav_cli.frames.run_settings import (
    FileAttitude,
    RunSettings,
    read_run_settings,
    write_run_settings,
)
from optnav_cli.reasons import ReasonCode

FROM_FILE = "frames.csv"  # the source of a prior that the frame's row gives


@dataclass(frozen=True)
class Folder:
    """A picture folder that was read; frames in the order of frames.csv.

    motion  how the body turns: what attitudes against the stars and Suns of a time were read with
    points  picked in its pictures, by the picture's name; None where it has no points.csv
    """

    path: Path
    settings: RunSettings
    motion: Ephemeris
    cameras: dict[str, Camera]
    frames: list[Frame]
    points: dict[str, list[PickedPoint]] | None = None

    @property
    def body(self) -> Body:
        """The body that the pictures show."""
        return self.motion.body

    @property
    def attitude(self) -> FileAttitude:
        """Convention by which the folder's files write attitudes."""
        return FileAttitude(self.settings.attitude, self.body, self.motion)

    def picture_path(self, frame: Frame) -> Path:
        """Where a frame's picture lies, on any system."""
        return picture_path(self.path, frame.file)


def read_folder(path: str | Path, kernels: Sequence[Path] = ()) -> Folder:
    """Read all of a picture folder but the pictures.

    kernels  SPICE kernels for the body's rotation and its Sun; none: analytic theory
    Raises ConfigError for a wrong run.toml or camera file and DataError for a folder or frames.csv
    that cannot be used; what is wrong with one row is that frame's `problem`.
    """
    path = Path(path)
    if not path.is_dir():
        fault = "is no folder" if path.exists() else "there is no such folder"
        raise DataError(f"{path}: {fault}; wanted one with run.toml, frames.csv and cameras/")
    settings, body = read_run_settings(path / "run.toml")
    attitude = FileAttitude(settings.attitude, body, load_ephemeris(body, kernels))
    cameras = read_cameras(path / "cameras")
    picked = (path / POINTS_CSV).exists()  # then nothing else solves its frames
    frames = read_frames(path / "frames.csv", attitude, cameras, timeless=picked)
    if settings.inertial:
        _check_track(path / "frames.csv", frames)
    points = None
    if picked:
        files = [frame.file for frame in frames]
        try:
            settings.points.check(body)
        except ConfigError as error:
            raise ConfigError(f"{path / 'run.toml'}: {error}") from None
        points = read_picked_points(path / POINTS_CSV, files, body, settings.points.filled)
    return Folder(path, settings, attitude.ephemeris, cameras, frames, points)


def _check_track(path: Path, frames: Sequence[Frame]) -> None:
    """Raise DataError for frames that are not of one inertial track of one camera."""
    last: Frame | None = None
    for frame in frames:
        if frame.tdb_s is None:
            continue  # its row says what is wrong
        if last is not None and last.tdb_s is not None and frame.tdb_s <= last.tdb_s:
            raise DataError(
                f"{path}: '{frame.file}' is not later than '{last.file}' before it; [inertial] of "
                "run.toml wants one track, its rows in order of time"
            )
        if last is not None and frame.camera != last.camera:
            raise DataError(
                f"{path}: has the cameras '{last.camera}' and '{frame.camera}'; [inertial] of "
                "run.toml wants the pictures of one camera"
            )
        last = frame


def read_cameras(path: Path) -> dict[str, Camera]:
    """Cameras of a folder by name. Raises DataError without one, ConfigError for a bad one."""
    files = sorted(path.glob("*.toml"))
    if not files:
        raise DataError(f"{path}: there is no camera file; add one TOML file for each camera")
    cameras = {}
    for file in files:
        camera = load_camera(file)
        if camera.name != file.stem:
            raise ConfigError(
                f"{file}: name is '{camera.name}'; wanted the file's own name, '{file.stem}'"
            )
        cameras[camera.name] = camera
    return cameras


def write_folder(
    path: str | Path,
    settings: RunSettings,
    cameras: Iterable[Camera],
    frames: Iterable[Frame],
    motion: Ephemeris | None = None,
) -> None:
    """Write run.toml, the cameras and frames.csv into a folder, which is made where it is missing.

    motion  how the body turns, for attitudes against the stars; by theory if None
    The pictures are the caller's. The folder then reads back as it was given, to the digits of the
    files: 0.1 mm, 1e-12 of a quaternion.
    """
    path = Path(path)
    (path / "cameras").mkdir(parents=True, exist_ok=True)
    write_run_settings(settings, path)
    known = {camera.name: camera for camera in cameras}
    for camera in known.values():
        write_camera(path / "cameras", camera)
    attitude = FileAttitude(settings.attitude, load_body(settings.body), motion)
    write_frames(path / "frames.csv", attitude, frames, known)


@dataclass(frozen=True, eq=False)
class Observation:
    """A picture and what is stated about it.

    file, utc           what its row in solution.csv begins with
    camera_from_body    the stated attitude; of a free one the first guess
    attitude_sigma_rad  1 sigma an axis; 0: exact; None: free
    sun_body            (3,) unit vector to the Sun, body frame
    prior               the stated position, else where a known orbit leads, if there is one
    """

    file: str
    utc: str
    tdb_s: float
    camera: Camera
    picture: Picture
    camera_from_body: Rotation
    attitude_sigma_rad: float | None
    sun_body: FloatArray
    prior: PositionPrior | None = None

    @property
    def source(self) -> str:
        """Source name of a prior that another frame takes from this one."""
        return f"{self.camera.name} camera, {self.file}"


def make_observation(frame: Frame, camera: Camera, picture: Picture) -> Observation:
    """A frame with its picture. Raises NoSolutionError where its attitude or the Sun is missing."""
    if frame.camera_from_body is None:
        raise NoSolutionError("no attitude: the quaternion is empty", ReasonCode.NO_ATTITUDE)
    if frame.sun_body is None or frame.tdb_s is None:
        raise NoSolutionError("no direction to the Sun", ReasonCode.NO_SUN)
    prior = frame.predicted
    if frame.position_m is not None and frame.position_sigma_m is not None:
        prior = PositionPrior.isotropic(frame.position_m, frame.position_sigma_m, FROM_FILE)
    turn, sigma, sun = frame.camera_from_body, frame.attitude_sigma_rad, frame.sun_body
    return Observation(frame.file, frame.utc, frame.tdb_s, camera, picture, turn, sigma, sun, prior)
