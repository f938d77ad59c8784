"""truth.csv: where the camera really was, and which way it moved there."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from catalog.geometry.rotations import rnb_axes
from optnav_cli.output.attitude import FileAttitude
from optnav_cli.output.tables import numbers, quaternion, read_table

FloatArray = NDArray[np.float64]
Forward = Literal["motion", "north"]
TRUTH_COLUMNS = ("file", "utc", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz")
# Frames further apart than this in time or on the ground are not neighbours of one pass: the
# chord between them would no longer tell the direction of motion to a few degrees.
LARGEST_GAP_S = 1200.0
LARGEST_GAP_DEG = 60.0
SPEEDS_M_S = (1.0, 20e3)  # slower is standing still, faster is another pass
LEAST_ACROSS = 0.02  # share of the motion across the vertical that still gives a direction


@dataclass(frozen=True, eq=False)
class Truth:
    """One frame's true pose: position_m (3,), body frame; attitude None where it is not given."""

    file: str
    utc: str
    tdb_s: float
    position_m: FloatArray
    camera_from_body: Rotation | None


def read_truth(path: Path, attitude: FileAttitude) -> dict[str, Truth]:
    """The true poses of a folder by file name, in the file's order.

    Raises DataError for a missing or damaged file, and for a frame that is listed twice.
    """
    found: dict[str, Truth] = {}
    for where, row in read_table(path, TRUTH_COLUMNS):
        position = numbers(row, ("x_m", "y_m", "z_m"), where)
        if position is None:
            raise DataError(f"{where}: no position; a truth file has one for each frame")
        if row["file"] in found:
            raise DataError(f"{where}: {row['file']} is listed twice")
        written = quaternion(row, where)
        try:
            tdb_s = utc_to_tdb_s(row["utc"])
        except DataError as error:
            raise DataError(f"{where}: {error}") from error
        found[row["file"]] = Truth(
            row["file"],
            row["utc"],
            tdb_s,
            position,
            None if written is None else attitude.read(written, row["utc"]),
        )
    if not found:
        raise DataError(f"{path}: has no frames")
    return found


def directions_of_motion(truths: Sequence[Truth]) -> list[tuple[FloatArray, Forward]]:
    """Axes R, N, B as rows (3, 3) for each true position, and what N rests on.

    N points along the chord between the neighbours in time that belong to the same pass, as the
    body sees it; where there is none, or the motion is vertical, N is local north ("north").
    """
    order = sorted(range(len(truths)), key=lambda index: truths[index].tdb_s)
    axes: list[tuple[FloatArray, Forward]] = [(np.eye(3), "north")] * len(truths)
    for place, index in enumerate(order):
        here = truths[index]
        before = truths[order[place - 1]] if place else None
        after = truths[order[place + 1]] if place + 1 < len(order) else None
        start = before if before is not None and _same_pass(before, here) else here
        end = after if after is not None and _same_pass(here, after) else here
        axes[index] = _axes(here.position_m, end.position_m - start.position_m)
    return axes


def _same_pass(one: Truth, later: Truth) -> bool:
    gap_s = later.tdb_s - one.tdb_s
    if not 0.0 < gap_s <= LARGEST_GAP_S:
        return False
    speed = float(np.linalg.norm(later.position_m - one.position_m)) / gap_s
    cosine = one.position_m @ later.position_m
    cosine = cosine / np.linalg.norm(one.position_m) / np.linalg.norm(later.position_m)
    near = bool(cosine >= np.cos(np.radians(LARGEST_GAP_DEG)))
    return near and SPEEDS_M_S[0] <= speed <= SPEEDS_M_S[1]


def _axes(position: FloatArray, motion: FloatArray) -> tuple[FloatArray, Forward]:
    length = float(np.linalg.norm(motion))
    up = position / np.linalg.norm(position)
    if length > 0.0 and np.linalg.norm(np.cross(up, motion)) >= LEAST_ACROSS * length:
        return rnb_axes(position, motion), "motion"
    north = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(up, north)) < 1e-9:  # at a pole any direction does
        north = np.array([1.0, 0.0, 0.0])
    return rnb_axes(position, north), "north"
