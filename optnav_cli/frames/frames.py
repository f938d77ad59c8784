"""frames.csv: what is known beforehand about each picture of a folder."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import nearest_name
from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC, quaternion_from_rotation, rotation_from_quaternion
from catalog.tables import CsvRow
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import PositionPrior
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.tables import FRAMES, POSITION, QUATERNION, RANGE, SUN

# Unit vectors and quaternions are written with a few digits; further off, columns are mixed up.
UNIT_TOLERANCE = 0.01
# Bounds that no row needs to pass: 7 times the distance of the Sun; half a turn; and below that an
# attitude is exact. Squares and inverses of numbers far beyond them overflow.
MAX_DISTANCE_M = 1e12
MIN_ATTITUDE_ARCSEC, MAX_ATTITUDE_ARCSEC = 1e-6, 180.0 * 3600.0
MAX_TIME_SIGMA_S = 3600.0
MIN_RANGE_SIGMA_M = 1e-3  # of an altimeter: relief under its beam is never known better
MAX_NAME_BYTES = 255  # of a file or folder, on all common systems


@dataclass(frozen=True, eq=False)
class Frame:
    """One row of frames.csv. What is unknown is None.

    file                the picture's name, relative to the folder
    utc, tdb_s          its time as written, and in TDB s past J2000
    camera              the camera's name
    camera_from_body    attitude; for a free one the first guess
    attitude_sigma_rad  1 sigma an axis, common_sigma_rad included; 0: exact; None: free
    position_m          (3,) prior position, body frame, m
    position_sigma_m    its 1 sigma a component
    sun_body            (3,) unit vector to the Sun, body frame; from the time where not given
    common_sigma_rad    the share in attitude_sigma_rad that frames.csv does not state: of the
                        camera's boresight, common to all its frames, and of the body's own
                        rotation where the file's attitude is against the stars
    problem             why the frame cannot be used, or None; then any of the others may be None
    predicted           where a known orbit leads, for a frame without position_m
    range_m             slant range along the altimeter's beam, m;  range_sigma_m its 1 sigma
    """

    file: str
    utc: str
    camera: str
    tdb_s: float | None = None
    camera_from_body: Rotation | None = None
    attitude_sigma_rad: float | None = None
    position_m: FloatArray | None = None
    position_sigma_m: float | None = None
    sun_body: FloatArray | None = None
    common_sigma_rad: float = 0.0
    problem: str | None = None
    predicted: PositionPrior | None = None
    range_m: float | None = None
    range_sigma_m: float | None = None

    @property
    def own_attitude_sigma_rad(self) -> float | None:
        """attitude_sigma_rad without the common share: as the file states it."""
        sigma = self.attitude_sigma_rad
        return None if sigma is None else math.sqrt(max(sigma**2 - self.common_sigma_rad**2, 0.0))


def read_frames(
    path: Path, attitude: FileAttitude, cameras: Mapping[str, Camera], *, timeless: bool = False
) -> list[Frame]:
    """Frames of a frames.csv in its order; stated attitudes are turned by the camera's boresight.

    cameras  by name
    timeless  whether a row may have no utc, as of picked points, where no attitude is against the
              stars; it then has no tdb_s, and no Sun by its time

    What is wrong with one row becomes that frame's problem, so that the others go on.
    Raises DataError for what is wrong with the file: it cannot be read, lacks a column, has no
    rows, a row without a picture's name, or a name twice.
    """
    rows = FRAMES.rows(path)
    first: dict[str, int] = {}
    for number, row in enumerate(rows, 1):
        name = row["file"]
        if not name:
            raise DataError(f"{path}: row {number} names no picture in column 'file'; fill it in")
        if first.setdefault(name, number) != number:
            raise DataError(
                f"{path}: '{name}' stands in rows {first[name]} and {number}; "
                "give each picture one row"
            )
    return [_read_frame(row, attitude, cameras, timeless) for row in rows]


def write_frames(
    path: Path, attitude: FileAttitude, frames: Iterable[Frame], cameras: Mapping[str, Camera]
) -> None:
    """Write a frames.csv that `read_frames` reads back. The frames need a usable time."""
    FRAMES.write(path, (_make_cells(frame, attitude, cameras) for frame in frames))


def _read_frame(
    row: CsvRow, attitude: FileAttitude, cameras: Mapping[str, Camera], timeless: bool
) -> Frame:
    file, utc, camera = row["file"], row["utc"], row["camera"]
    try:
        if row.problem:
            raise DataError(row.problem)
        _check_name(file)
        if camera not in cameras:
            known = sorted(cameras)
            near = nearest_name(camera, known)
            hint = f"did you mean '{near}'?" if near else f"there are {', '.join(known)}"
            raise DataError(f"camera '{camera}' has no file in cameras/; {hint}")
        tdb_s = None if timeless and not utc else utc_to_tdb_s(utc, "utc")
        position, position_sigma = _read_position(row, attitude)
        sigma = _read_sigma(row, "attitude_sigma_arcsec", MIN_ATTITUDE_ARCSEC, MAX_ATTITUDE_ARCSEC)
        written = _read_unit_vector(row, QUATERNION, "the quaternion qw, qx, qy, qz")
        if tdb_s is None and attitude.name != "camera_from_body":
            raise DataError("utc is empty, and attitudes are against the stars; add the time")
        time = math.nan if tdb_s is None else tdb_s  # a body-fixed attitude needs none
        common = float(np.hypot(attitude.sigma_rad(time), cameras[camera].boresight_sigma_rad))
        rotation = None if written is None else rotation_from_quaternion(*written)
        sun = _read_unit_vector(row, SUN, "the Sun's direction sun_x, sun_y, sun_z")
        sun_body = None if tdb_s is None else attitude.ephemeris.sun_body(tdb_s)
        if sun is not None:
            sun_body = attitude.places.rotate_to_catalog(sun / float(np.linalg.norm(sun)))
        turn = None if rotation is None else attitude.read(rotation, time)
        range_m, range_sigma_m = _read_range(row, attitude)
        return Frame(
            file=file,
            utc=utc,
            camera=camera,
            tdb_s=tdb_s,
            camera_from_body=None if turn is None else cameras[camera].apply_boresight(turn),
            attitude_sigma_rad=None if sigma is None else float(np.hypot(sigma * ARCSEC, common)),
            common_sigma_rad=common,
            position_m=position,
            position_sigma_m=position_sigma,
            sun_body=sun_body,
            range_m=range_m,
            range_sigma_m=range_sigma_m,
        )
    except DataError as error:
        return Frame(file=file, utc=utc, camera=camera, problem=str(error))


def read_time_sigma(row: CsvRow) -> float | None:
    """1 sigma of a row's time, s; None where it states none. Raises DataError."""
    return _read_sigma(row, "utc_sigma_s", 0.0, MAX_TIME_SIGMA_S)


def picture_path(folder: Path, file: str) -> Path:
    """Where the picture that a folder's table names lies, on any system."""
    return folder / file.replace("\\", "/")


def _check_name(file: str) -> None:
    """Raise DataError for a name that no picture inside the folder can have."""
    path = PurePosixPath(file.replace("\\", "/"))
    longest = max((len(part.encode()) for part in path.parts), default=0)
    if not 0 < longest <= MAX_NAME_BYTES or "\0" in file:
        raise DataError(f"'{file[:40]}' is no name of a file; wanted 1 to {MAX_NAME_BYTES} bytes")
    if path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        raise DataError(f"picture '{file}' lies outside the folder; name one inside it")


def _read_unit_vector(row: CsvRow, columns: Sequence[str], what: str) -> FloatArray | None:
    """A vector (n,) of unit length, as far as its digits go; None where it is not given."""
    vector = row.vector(columns)
    length = 1.0 if vector is None else math.hypot(*vector)  # numpy's warns of large numbers
    if length < 1e-12:
        raise DataError(f"{what} is zero; wanted a length of 1")
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise DataError(f"{what} has a length of {length:.6g}; wanted 1")
    return vector


def _read_sigma(row: CsvRow, column: str, least: float, most: float) -> float | None:
    """A sigma, 0 or within bounds; None where it is not given."""
    value = row.number(column)
    if value is not None and value != 0.0 and not least <= value <= most:
        zero = "0 to" if least == 0.0 else f"0, or {least:g} to"
        raise DataError(f"{column} is {row[column]}; wanted {zero} {most:g}")
    return value


def _read_position(row: CsvRow, attitude: FileAttitude) -> tuple[FloatArray | None, float | None]:
    sigma = _read_sigma(row, "position_sigma_m", 0.0, MAX_DISTANCE_M)
    position, body = row.vector(POSITION), attitude.body
    if position is None:
        return None, None
    if np.abs(position).max() > MAX_DISTANCE_M:
        raise DataError(f"the prior position lies farther off than {MAX_DISTANCE_M:g} m")
    distance = float(np.linalg.norm(position))
    if distance < body.radius_m + body.plausible_heights_m[0]:
        raise DataError(
            f"the prior position lies inside the body, {distance / 1e3:.1f} km from its centre; "
            "wanted metres from the centre, body frame"
        )
    if sigma is None:
        raise DataError("position_sigma_m is empty; a prior position needs its sigma")
    return attitude.places.transform_to_catalog(position), sigma / attitude.places.scale


def _read_range(row: CsvRow, attitude: FileAttitude) -> tuple[float | None, float | None]:
    """An altimeter's range and its sigma, m; None where it measured nothing."""
    stated = row.vector(RANGE)
    if stated is None:
        return None, None
    measured, sigma = (float(value) for value in stated)
    if not 0.0 < measured <= MAX_DISTANCE_M:
        raise DataError(f"range_m is {row['range_m']}; wanted over 0 to {MAX_DISTANCE_M:g}")
    if not MIN_RANGE_SIGMA_M <= sigma <= measured:
        raise DataError(
            f"range_sigma_m is {row['range_sigma_m']}; wanted {MIN_RANGE_SIGMA_M:g} to the range"
        )
    scale = attitude.places.scale
    return measured / scale, sigma / scale


def _make_cells(
    frame: Frame, attitude: FileAttitude, cameras: Mapping[str, Camera]
) -> dict[str, object]:
    cells: dict[str, object] = {"file": frame.file, "utc": frame.utc, "camera": frame.camera}
    sigma = frame.own_attitude_sigma_rad
    cells["attitude_sigma_arcsec"] = None if sigma is None else sigma / ARCSEC
    if frame.camera_from_body is not None and frame.tdb_s is not None:
        camera, turn = cameras.get(frame.camera), frame.camera_from_body
        rotation = attitude.convert_for_file(
            camera.remove_boresight(turn) if camera else turn, frame.tdb_s
        )
        cells |= zip(QUATERNION, quaternion_from_rotation(rotation), strict=True)
    places = attitude.places
    if frame.position_m is not None:
        cells |= zip(POSITION, places.transform_to_stated(frame.position_m), strict=True)
    if frame.position_sigma_m is not None:
        cells["position_sigma_m"] = frame.position_sigma_m * places.scale
    if frame.range_m is not None and frame.range_sigma_m is not None:
        measured = frame.range_m * places.scale, frame.range_sigma_m * places.scale
        cells |= zip(RANGE, measured, strict=True)
    if frame.sun_body is not None:
        cells |= zip(SUN, places.rotate_to_stated(frame.sun_body), strict=True)
    return cells
