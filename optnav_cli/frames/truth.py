"""truth.csv: where the camera really was, for simulated pictures."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from catalog.tables import CsvRow
from optnav_cli.frames.frames import MAX_DISTANCE_M
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.tables import POSITION, QUATERNION, TRUTH


@dataclass(frozen=True, eq=False)
class Truth:
    """The true state of the camera when it took a picture.

    position_m (3,) body frame, m; tdb_s in TDB s past J2000
    has_attitude  whether the attitude is stated; else camera_from_body is none
    """

    file: str
    utc: str
    tdb_s: float
    position_m: FloatArray
    camera_from_body: Rotation
    has_attitude: bool = True


def read_truth(path: str | Path, attitude: FileAttitude) -> list[Truth]:
    """Rows of a truth.csv; their quaternions are the rotation that `attitude` names.

    Raises DataError, with the row, for anything wrong: a truth with holes is no truth.
    """
    path = Path(path)
    attitude = replace(attitude, motion=None)  # by theory, as all that is compared with the truth
    truths: dict[str, Truth] = {}
    for index, row in enumerate(TRUTH.rows(path)):
        if "position_sigma_m" in row.cells:
            raise DataError(
                f"{path}: is a frames.csv, what is known before the solution; wanted the truth.csv"
            )
        try:
            if row["file"] in truths:
                raise DataError("the file stands there twice; keep one row")
            truths[row["file"]] = _read_truth(row, attitude)
        except (DataError, ValueError) as error:
            raise DataError(f"{path}: row {index + 1} ({row['file']}): {error}") from None
    return list(truths.values())


def write_truth(path: str | Path, attitude: FileAttitude, truths: Iterable[Truth]) -> None:
    """Write a truth.csv with the rotation that `attitude` names."""
    TRUTH.write(Path(path), (_make_cells(truth, attitude) for truth in truths))


def _read_truth(row: CsvRow, attitude: FileAttitude) -> Truth:
    if row.problem:
        raise DataError(row.problem)
    position, quaternion = row.vector(POSITION), row.vector(QUATERNION)
    if position is None:
        raise DataError("a position is empty; fill it in")
    if np.abs(position).max() > MAX_DISTANCE_M:
        raise DataError(f"the position lies more than {MAX_DISTANCE_M:g} m from the body")
    tdb_s = utc_to_tdb_s(row["utc"], "utc")
    position_m = attitude.places.transform_to_catalog(position)
    if quaternion is None:
        return Truth(
            row["file"], row["utc"], tdb_s, position_m, Rotation.identity(), has_attitude=False
        )
    camera_from_body = attitude.read(rotation_from_quaternion(*quaternion), tdb_s)
    return Truth(row["file"], row["utc"], tdb_s, position_m, camera_from_body)


def _make_cells(truth: Truth, attitude: FileAttitude) -> dict[str, object]:
    cells: dict[str, object] = {"file": truth.file, "utc": truth.utc}
    cells |= zip(POSITION, attitude.places.transform_to_stated(truth.position_m), strict=True)
    if truth.has_attitude:
        rotation = attitude.convert_for_file(truth.camera_from_body, truth.tdb_s)
        cells |= zip(QUATERNION, quaternion_from_rotation(rotation), strict=True)
    return cells
