"""truth.csv: where the camera really was, for simulated pictures."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.geometry.rotations import rotation_from_quaternion
from optnav_cli.frames.csv_table import numbers, read_rows, write_rows
from optnav_cli.frames.frames import POSITION, QUATERNION, quaternion_texts
from optnav_cli.frames.run_settings import RunSettings, camera_from_body, rotation_for_file

COLUMNS = ("file", "utc", *POSITION, *QUATERNION)


@dataclass(frozen=True, eq=False)
class Truth:
    """The true state of the camera when it took a picture.

    position_m (3,) body frame, m; tdb_s in TDB s past J2000
    """

    file: str
    utc: str
    tdb_s: float
    position_m: FloatArray
    camera_from_body: Rotation


def read_truth(path: str | Path, settings: RunSettings) -> list[Truth]:
    """Rows of a truth.csv; `settings` says which rotation its quaternions are.

    Raises DataError, with the row, for anything wrong: a truth with holes is no truth.
    """
    # by theory, as everything that is compared with the truth is read
    path, motion = Path(path), AnalyticEphemeris(load_body(settings.body))
    truths: dict[str, Truth] = {}
    for index, row in enumerate(read_rows(path, COLUMNS)):
        if "position_sigma_m" in row:
            raise DataError(
                f"{path}: is a frames.csv, what was believed of the camera; wanted the truth.csv"
            )
        where = f"{path}: row {index + 1} ({row['file']}): "
        if row[""]:
            raise DataError(f"{where}{row['']}")
        if row["file"] in truths:
            raise DataError(f"{where}the file stands there twice; keep one row")
        position, quaternion = numbers(row, POSITION, where), numbers(row, QUATERNION, where)
        if position is None or quaternion is None:
            raise DataError(f"{where}a position or quaternion is empty; fill it in")
        try:
            tdb_s = utc_to_tdb_s(row["utc"])
            rotation = rotation_from_quaternion(*quaternion)
        except (DataError, ValueError) as error:
            raise DataError(f"{where}{error}") from None
        truths[row["file"]] = Truth(
            file=row["file"],
            utc=row["utc"],
            tdb_s=tdb_s,
            position_m=np.array(position),
            camera_from_body=camera_from_body(rotation, settings.attitude, motion, tdb_s),
        )
    return list(truths.values())


def write_truth(
    path: str | Path,
    settings: RunSettings,
    truths: Iterable[Truth],
    motion: Ephemeris | None = None,
) -> None:
    """Write a truth.csv with the rotation that `settings` names.

    motion  how the body turns, for attitudes against the stars; by theory if None
    """
    motion = motion or AnalyticEphemeris(load_body(settings.body))
    write_rows(
        Path(path),
        COLUMNS,
        (
            [
                *(truth.file, truth.utc),
                *(f"{value:.4f}" for value in truth.position_m),
                *quaternion_texts(
                    rotation_for_file(
                        settings.attitude, motion, truth.tdb_s, truth.camera_from_body
                    )
                ),
            ]
            for truth in truths
        ),
    )
