"""truth.csv: where the camera really was, for simulated pictures."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from catalog.tables import Row
from optnav_cli.frames.run_settings import RunSettings, camera_from_body, rotation_for_file
from optnav_cli.frames.tables import POSITION, QUATERNION, TRUTH


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
    for index, row in enumerate(TRUTH.rows(path)):
        if "position_sigma_m" in row.cells:
            raise DataError(
                f"{path}: is a frames.csv, what is known before the solution; wanted the truth.csv"
            )
        try:
            if row["file"] in truths:
                raise DataError("the file stands there twice; keep one row")
            truths[row["file"]] = _truth(row, settings, motion)
        except (DataError, ValueError) as error:
            raise DataError(f"{path}: row {index + 1} ({row['file']}): {error}") from None
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
    TRUTH.write(Path(path), (_cells(truth, settings, motion) for truth in truths))


def _truth(row: Row, settings: RunSettings, motion: Ephemeris) -> Truth:
    if row.problem:
        raise DataError(row.problem)
    position, quaternion = row.vector(POSITION), row.vector(QUATERNION)
    if position is None or quaternion is None:
        raise DataError("a position or quaternion is empty; fill it in")
    tdb_s = utc_to_tdb_s(row["utc"])
    rotation = rotation_from_quaternion(*quaternion)
    return Truth(
        file=row["file"],
        utc=row["utc"],
        tdb_s=tdb_s,
        position_m=position,
        camera_from_body=camera_from_body(rotation, settings.attitude, motion, tdb_s),
    )


def _cells(truth: Truth, settings: RunSettings, motion: Ephemeris) -> dict[str, object]:
    rotation = rotation_for_file(settings.attitude, motion, truth.tdb_s, truth.camera_from_body)
    return {
        "file": truth.file,
        "utc": truth.utc,
        **dict(zip(POSITION, truth.position_m, strict=True)),
        **dict(zip(QUATERNION, quaternion_from_rotation(rotation), strict=True)),
    }
