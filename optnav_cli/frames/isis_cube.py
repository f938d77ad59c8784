"""The pose in an ISIS cube: position, pointing, body rotation and Sun from its binary tables.

`spiceinit` writes these tables behind the picture (USGS ISIS, SpiceRotation and SpicePosition).
GDAL reads the picture, and the label that describes the tables, but not the tables. Conventions,
checked on a frame of Apollo 15 in the tests:

InstrumentPosition  camera minus centre of the body, J2000 axes, km
SunPosition         Sun minus centre of the body, J2000 axes, km; light time and aberration applied
InstrumentPointing  quaternion, scalar first, of the rotation taking J2000 vectors to the camera
BodyRotation        the same for the body, followed by the label's ConstantRotation

A table of a framing camera has one record; line scanners, which have many, are refused.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import DataError
from catalog.inputs import check_input
from catalog.rasters import open_raster, reading_raster

Label = dict[str, Any]  # a block: values, lists of values, and blocks, by name

MAX_NUMBER = 1e15  # of km, of seconds
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
    """

    utc: str
    tdb_s: float
    position_m: FloatArray
    velocity_m_s: FloatArray
    isis_from_body: Rotation
    sun_body: FloatArray
    body_from_inertial: Rotation


def read_cube_pose(path: str | Path) -> CubePose:
    """The pose in the tables of a cube of a framing camera.

    Raises DataError for a file that is missing or no such cube, or that lacks a table.
    """
    path = Path(path)
    label = read_cube_label(path)
    try:
        body_from_inertial = _rotation(path, label, "BodyRotation")
        isis_from_inertial = _rotation(path, label, "InstrumentPointing")
        axes = ("J2000X", "J2000Y", "J2000Z")
        position = _fields(path, label, "InstrumentPosition", axes)
        velocity = _fields(path, label, "InstrumentPosition", [f"{axis}V" for axis in axes])
        sun = _fields(path, label, "SunPosition", axes)
        utc = str(label.get("IsisCube", {}).get("Instrument", {}).get("StartTime", ""))
        tdb_s = float(_fields(path, label, "InstrumentPosition", ["ET"])[0])
    except DataError as error:
        raise DataError(
            f"{path}: {error}; run spiceinit on the cube and attach its tables"
        ) from None
    return CubePose(
        utc=utc,
        tdb_s=tdb_s,
        position_m=body_from_inertial.apply(position) * 1e3,
        velocity_m_s=body_from_inertial.apply(velocity) * 1e3,
        isis_from_body=isis_from_inertial * body_from_inertial.inv(),
        sun_body=body_from_inertial.apply(sun / np.linalg.norm(sun)),
        body_from_inertial=body_from_inertial,
    )


def read_cube_label(path: str | Path) -> Label:
    """The label of a cube, as GDAL reads it.

    Raises DataError for a file that is missing or no cube.
    """
    path = Path(path)
    check_input(path)
    try:
        with open_raster(path, ("ISIS3",)) as cube, reading_raster(path):
            # rasterio takes the text before the first colon for the name of a tag
            ((start, rest),) = cube.tags(ns="json:ISIS3").items()
        label: Label = json.loads(f"{start}:{rest}")
    except (DataError, ValueError, RecursionError):
        raise DataError(f"{path}: not an ISIS cube, or its label is damaged") from None
    return label


def _fields(path: Path, label: Label, name: str, wanted: Sequence[str]) -> FloatArray:
    """Some fields of the one record of a binary table."""
    table = label.get(f"Table_{name}")
    if not isinstance(table, dict):
        raise DataError(f"it has no table {name}")
    fields = [field for key, field in table.items() if key.startswith("Field_")]
    try:
        start, length, records = (int(table[key]) for key in ("StartByte", "Bytes", "Records"))
        order = ">" if table["ByteOrder"].lower() == "msb" else "<"
        layout = np.dtype([(field["Name"], order + _TYPES[field["Type"]]) for field in fields])
        numbers = all(field["Size"] == 1 for field in fields)
    except (AttributeError, KeyError, TypeError, ValueError):
        numbers = False
    if not numbers:
        raise DataError(f"its table {name} has a field that is no number, or lacks a description")
    if records != 1:
        raise DataError(f"its table {name} has {records} records; wanted 1")
    with path.open("rb") as file:
        file.seek(start - 1)
        raw = file.read(layout.itemsize)
    if len(raw) < layout.itemsize or length != layout.itemsize:
        raise DataError(f"its table {name} is cut short")
    values = np.frombuffer(raw, layout)[0]
    record = {field: float(values[field]) for field in layout.names or ()}
    if not (np.abs(list(record.values())) < MAX_NUMBER).all():
        raise DataError(f"its table {name} holds values that are not finite, or of no use")
    try:
        return np.array([record[field] for field in wanted])
    except KeyError as error:
        raise DataError(f"its table {name} has no field {error}") from None


def _rotation(path: Path, label: Label, name: str) -> Rotation:
    """Rotation from J2000: the table's quaternion, then the constant part of the label."""
    quaternion = _fields(path, label, name, [f"J2000Q{part}" for part in range(4)])
    try:
        rotation = Rotation.from_quat(quaternion, scalar_first=True)
    except ValueError:
        raise DataError(f"its table {name} holds a quaternion of zero length") from None
    constant = label[f"Table_{name}"].get("ConstantRotation")
    if constant is None:
        return rotation
    if np.shape(constant) != (9,) or not all(isinstance(part, int | float) for part in constant):
        raise DataError(f"its table {name} has a ConstantRotation that is not 9 numbers")
    matrix = np.reshape(np.array(constant, dtype=np.float64), (3, 3))
    if not np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-6 or np.linalg.det(matrix) < 0.0:
        raise DataError(f"its table {name} has a ConstantRotation that is no rotation")
    return Rotation.from_matrix(matrix) * rotation
