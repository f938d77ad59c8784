"""The pose in an ISIS cube: position, pointing, body rotation and Sun from its binary tables.

`spiceinit` writes these tables behind the picture (USGS ISIS, SpiceRotation and SpicePosition).
GDAL reads the picture, and the label that describes the tables, but not the tables. Conventions,
checked on a frame of Apollo 15 in the tests:

InstrumentPosition  camera minus centre of the body, J2000 axes, km
SunPosition         Sun minus centre of the body, J2000 axes, km; light time and aberration applied
InstrumentPointing  quaternion, scalar first, of the rotation taking J2000 vectors to the camera
BodyRotation        the same for the body, followed by the label's ConstantRotation

A table of a framing camera has one record; more are interpolated to the middle of the exposure, or
hold the terms of polynomials. Line scanners, whose tables span more than an exposure, are refused.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import DataError
from catalog.inputs import check_input
from catalog.rasters import handle_read_errors, open_raster

Label = dict[str, Any]  # a block: values, lists of values, and blocks, by name

MAX_NUMBER = 1e15  # of km, of seconds
MIN_SUN_KM = 1e6
MAX_RECORDS = 100_000
UTC_SECONDS_SINCE = -8.8e8  # TDB s of 1972, to some days: since then UTC is whole seconds from TAI
SAME_S = 5e-4  # half of the last digit of times in frames.csv
# Tables of a framing camera reach over its exposure and a little more; those of line scanners over
# all their lines, thousands of exposures.
MAX_EXPOSURES, MAX_MARGIN_S = 3.0, 0.1
MAX_APART_S = 600.0  # longest exposures, and clocks that StartTime was made by
_SECONDS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisec", "millisecond", "milliseconds"), 1e-3),
}
_TYPES = {"Double": "f8", "Real": "f4", "Integer": "i4"}


@dataclass(frozen=True, eq=False)
class CubePose:
    """The pose of a cube's tables, in the frames of this project.

    utc                 as the label writes it
    tdb_s               TDB s past J2000, of the tables
    position_m          (3,) camera position, body frame, m
    velocity_m_s        (3,) camera velocity against the stars along the body frame's axes, m/s
    isis_from_body      rotation taking body vectors to the *ISIS* camera frame of the instrument,
                        whose boresight may be -z and whose x need not point right
    sun_body            (3,) unit vector to the Sun, body frame
    body_from_inertial  orientation of the body that the tables use
    position_quality    what spiceinit calls the orbit: "reconstructed", "predicted", or nothing
    pointing_quality    the same of the attitude; "nadir" where it is none
    """

    utc: str
    tdb_s: float
    position_m: FloatArray
    velocity_m_s: FloatArray
    isis_from_body: Rotation
    sun_body: FloatArray
    body_from_inertial: Rotation
    position_quality: str = ""
    pointing_quality: str = ""


def read_cube_pose(path: str | Path) -> CubePose:
    """The pose in the tables of a cube of a framing camera.

    Raises DataError for a file that is missing or no such cube, or that lacks a table.
    """
    path = Path(path)
    label = read_cube_label(path)
    cube = label.get("IsisCube", {})
    instrument, kernels = cube.get("Instrument", {}), cube.get("Kernels", {})
    utc = str(instrument.get("StartTime", ""))
    try:
        rotations = _read_table(path, label, "BodyRotation")
        positions = _read_table(path, label, "InstrumentPosition")
        tdb_s = _find_middle(positions, utc, instrument)
        body_from_inertial = _find_rotation(rotations, tdb_s)
        isis_from_inertial = _find_rotation(_read_table(path, label, "InstrumentPointing"), tdb_s)
        position, velocity = _interpolate_states(positions, tdb_s)
        sun, _ = _interpolate_states(_read_table(path, label, "SunPosition"), tdb_s)
        if not np.linalg.norm(sun) > MIN_SUN_KM:
            raise DataError("its table SunPosition has the Sun inside the body")
    except DataError as error:
        raise DataError(
            f"{path}: {error}; run spiceinit on the cube and attach its tables"
        ) from None
    _check_time(path, utc, tdb_s)
    return CubePose(
        utc=utc,
        tdb_s=tdb_s,
        position_m=body_from_inertial.apply(position) * 1e3,
        velocity_m_s=body_from_inertial.apply(velocity) * 1e3,
        isis_from_body=isis_from_inertial * body_from_inertial.inv(),
        sun_body=body_from_inertial.apply(sun / np.linalg.norm(sun)),
        body_from_inertial=body_from_inertial,
        position_quality=str(kernels.get("InstrumentPositionQuality", "")).lower(),
        pointing_quality=str(kernels.get("InstrumentPointingQuality", "")).lower(),
    )


def find_middle_utc(pose: CubePose) -> str:
    """UTC of the middle of the exposure, ending in Z.

    Before 1972, where the toolkit that made the tables rounds UTC to whole seconds, and where both
    agree, it is the label's StartTime.
    """
    if pose.tdb_s < UTC_SECONDS_SINCE or abs(pose.tdb_s - utc_to_tdb_s(pose.utc)) < SAME_S:
        return pose.utc + "Z"
    return utc_from_tdb_s(pose.tdb_s, 3)


def read_cube_label(path: str | Path) -> Label:
    """The label of a cube, as GDAL reads it.

    Raises DataError for a file that is missing or no cube.
    """
    path = Path(path)
    check_input(path)
    try:
        with open_raster(path, ("ISIS3",)) as cube, handle_read_errors(path):
            # rasterio takes the text before the first colon for the name of a tag
            ((start, remainder),) = cube.tags(ns="json:ISIS3").items()
        label: Label = json.loads(f"{start}:{remainder}")
    except (DataError, ValueError, RecursionError):
        raise DataError(f"{path}: not an ISIS cube, or its label is damaged") from None
    return label


@dataclass(frozen=True, eq=False)
class _Table:
    """A binary table: its name, its label and its columns (n,) by the names of their fields."""

    name: str
    label: Label
    columns: dict[str, FloatArray]

    def rows(self, fields: Sequence[str]) -> FloatArray:
        """Columns of some fields, (n, fields)."""
        try:
            return np.column_stack([self.columns[field] for field in fields])
        except KeyError as error:
            raise DataError(f"its table {self.name} has no field {error}") from None


def _read_table(path: Path, label: Label, name: str) -> _Table:
    table = label.get(f"Table_{name}")
    if not isinstance(table, dict):
        raise DataError(f"it has no table {name}")
    fields = [field for key, field in table.items() if key.startswith("Field_")]
    try:
        start, length, records = (int(table[key]) for key in ("StartByte", "Bytes", "Records"))
        order = ">" if table["ByteOrder"].lower() == "msb" else "<"
        layout = np.dtype([(field["Name"], order + _TYPES[field["Type"]]) for field in fields])
        numbers = bool(fields) and all(field["Size"] == 1 for field in fields)
    except (AttributeError, KeyError, TypeError, ValueError):
        numbers = False
    if not numbers:
        raise DataError(f"its table {name} has a field that is no number, or lacks a description")
    if not 0 < records <= MAX_RECORDS:
        raise DataError(f"its table {name} has {records} records; wanted 1 to {MAX_RECORDS}")
    by_bytes, left = divmod(length, layout.itemsize)
    if left == 0 and by_bytes != records:
        raise DataError(
            f"its table {name} has {records} records; wanted {by_bytes} in its {length} bytes"
        )
    size = layout.itemsize * records
    with path.open("rb") as file:
        file.seek(max(start - 1, 0))
        raw = file.read(size)
    if start < 1 or len(raw) < size or length != size:
        raise DataError(f"its table {name} is cut short")
    values = np.frombuffer(raw, layout)
    columns = {field: values[field].astype(np.float64) for field in layout.names or ()}
    if not all((np.abs(column) < MAX_NUMBER).all() for column in columns.values()):
        raise DataError(f"its table {name} holds values that are not finite, or of no use")
    return _Table(name, table, columns)


def _find_middle(table: _Table, utc: str, instrument: Label) -> float:
    """The middle of the exposure, TDB s: the time of the one record, or by the label."""
    times = table.columns.get("ET", np.zeros(0))
    if times.size == 1:
        return float(times[0])
    exposure_s = _read_exposure_s(instrument)
    spans = np.ptp(times) if times.size else 0.0
    if exposure_s is None or spans > MAX_EXPOSURES * exposure_s + MAX_MARGIN_S:
        shown = (
            "an exposure that is not stated" if exposure_s is None else f"one of {exposure_s:g} s"
        )
        raise DataError(
            f"its table {table.name} spans {spans:g} s over {shown}: a line scanner or push frame "
            "camera, whose lines have a pose each; wanted a framing camera"
        )
    return utc_to_tdb_s(utc) + 0.5 * exposure_s


def _read_exposure_s(instrument: Label) -> float | None:
    """The exposure time of the label, s; None where it or its unit is not stated."""
    stated = instrument.get("ExposureDuration")
    if not isinstance(stated, dict) or not isinstance(stated.get("value"), int | float):
        return None
    scale = _SECONDS.get(str(stated.get("unit", "")).lower())
    return None if scale is None else float(stated["value"]) * scale


def _check_time(path: Path, utc: str, tdb_s: float) -> None:
    """Refuse tables of another picture."""
    try:
        apart = tdb_s - utc_to_tdb_s(utc)
    except DataError as error:
        raise DataError(f"{path}: its StartTime: {error}") from None
    if not abs(apart) < MAX_APART_S:
        raise DataError(
            f"{path}: its tables are of {apart:.6g} s after its StartTime {utc}; run spiceinit "
            "on the cube anew"
        )


def _evaluate_polynomials(table: _Table, fields: Sequence[str], tdb_s: float) -> FloatArray:
    """Polynomials whose terms are the records but the last, which has their origin and scale."""
    rows = table.rows(fields)
    origin, scale, degree = rows[-1]
    if degree != len(rows) - 2 or not scale > 0.0:
        raise DataError(
            f"its table {table.name} has {len(rows) - 1} terms of polynomials of degree {degree:g}"
        )
    values: FloatArray = np.polynomial.polynomial.polyval((tdb_s - origin) / scale, rows[:-1])
    return values


def _read_times(table: _Table, tdb_s: float) -> FloatArray:
    times = table.rows(["ET"])[:, 0]
    if not (np.diff(times) > 0.0).all() or not times[0] <= tdb_s <= times[-1]:
        raise DataError(
            f"its table {table.name} reaches from {times[0]:.3f} to {times[-1]:.3f} s, not to the "
            f"middle of the exposure at {tdb_s:.3f} s"
        )
    return times


def _interpolate_states(table: _Table, tdb_s: float) -> tuple[FloatArray, FloatArray]:
    """Position (3,), km, and velocity (3,), km/s, zero where the table has none."""
    axes = ["J2000X", "J2000Y", "J2000Z"]
    if "J2000SVX" in table.columns:
        return _evaluate_polynomials(table, [f"J2000SV{axis}" for axis in "XYZ"], tdb_s), np.zeros(
            3
        )
    positions = table.rows(axes)
    speeds = [f"{axis}V" for axis in axes]
    velocities = table.rows(speeds) if speeds[0] in table.columns else None
    if len(positions) == 1:
        return positions[0], np.zeros(3) if velocities is None else velocities[0]
    times, kind = _read_times(table, tdb_s), str(table.label.get("CacheType", "Linear")).lower()
    if velocities is not None and kind == "hermitespline":
        spline = CubicHermiteSpline(times, positions, velocities)
        return spline(tdb_s), spline(tdb_s, 1)
    if kind != "linear":
        raise DataError(f"its table {table.name} states CacheType = {kind}; wanted Linear")
    velocity = np.zeros(3) if velocities is None else _interpolate_columns(times, velocities, tdb_s)
    return _interpolate_columns(times, positions, tdb_s), velocity


def _interpolate_columns(times: FloatArray, rows: FloatArray, tdb_s: float) -> FloatArray:
    return np.array([np.interp(tdb_s, times, column) for column in rows.T])


def _find_rotation(table: _Table, tdb_s: float) -> Rotation:
    """Rotation from J2000 by the table, then the constant part of the label."""
    rotation = _interpolate_rotation(table, tdb_s)
    constant, name = table.label.get("ConstantRotation"), table.name
    if constant is None:
        return rotation
    if np.shape(constant) != (9,) or not all(isinstance(part, int | float) for part in constant):
        raise DataError(f"its table {name} has a ConstantRotation that is not 9 numbers")
    matrix = np.reshape(np.array(constant, dtype=np.float64), (3, 3))
    if not np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-6 or np.linalg.det(matrix) < 0.0:
        raise DataError(f"its table {name} has a ConstantRotation that is no rotation")
    return Rotation.from_matrix(matrix) * rotation


def _interpolate_rotation(table: _Table, tdb_s: float) -> Rotation:
    """Rotation by quaternions, or by polynomials of the three angles about z, x and z."""
    if "J2000Ang1" in table.columns:
        angles = _evaluate_polynomials(table, [f"J2000Ang{part}" for part in (1, 2, 3)], tdb_s)
        # axes turn by the first angle first: vectors turn the other way
        return Rotation.from_euler("zxz", -angles)
    quaternions = table.rows([f"J2000Q{part}" for part in range(4)])
    try:
        rotations = Rotation.from_quat(quaternions, scalar_first=True)
    except ValueError:
        raise DataError(f"its table {table.name} holds a quaternion of zero length") from None
    if len(quaternions) == 1:
        return rotations[0]
    return Slerp(_read_times(table, tdb_s), rotations)(tdb_s)
