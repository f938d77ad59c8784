"""The frames of a truth.csv: which way the camera moved (the axes R, N, B of true positions), and
whether its quaternions are the rotation that run.toml names, or another one.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.geometry.rotations import rnb_axes
from optnav_cli.fix import Solution
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.truth import Truth

Forward = Literal["motion", "north"]
# True attitudes as far as this from the solved ones are no errors of navigation, and another frame
# that brings them so much nearer is the one that they were written in.
FAR_RAD = np.radians(1.0)

# camera_from_body of a file's rotation and of inertial_from_body, by what the rotation is
READINGS: Mapping[str, Callable[[Rotation, Rotation], Rotation]] = {
    "camera_from_body": lambda written, inertial_from_body: written,
    "body_from_camera": lambda written, inertial_from_body: written.inv(),
    "camera_from_inertial": lambda written, inertial_from_body: written * inertial_from_body,
    "inertial_from_camera": lambda written, inertial_from_body: written.inv() * inertial_from_body,
}


class Placed(Protocol):
    """Where a camera was when: tdb_s in TDB s past J2000, position_m (3,) body frame, m."""

    @property
    def tdb_s(self) -> float: ...

    @property
    def position_m(self) -> FloatArray: ...


class TimedPlace(NamedTuple):
    """A position (3,), m, body frame, and its time, TDB s past J2000."""

    tdb_s: float
    position_m: FloatArray


def find_motion_axes(places: Sequence[Placed]) -> list[tuple[FloatArray, Forward]]:
    """Find axes R, N, B as rows (3, 3) for each position, and what N rests on.

    N points along the chord between the neighbours in time that belong to the same pass, as the
    body sees it; where there is none, or the motion is vertical, N is local north ("north").
    Positions of one time (several cameras) share their neighbours.
    """
    order = sorted(range(len(places)), key=lambda index: places[index].tdb_s)
    axes: list[tuple[FloatArray, Forward]] = [(np.eye(3), "north")] * len(places)
    for rank, index in enumerate(order):
        here = places[index]
        before = _find_next_in_time(places, order[:rank][::-1], here)
        after = _find_next_in_time(places, order[rank + 1 :], here)
        start = before if before is not None and is_same_pass(before, here) else here
        end = after if after is not None and is_same_pass(here, after) else here
        axes[index] = _compute_axes(here.position_m, end.position_m - start.position_m)
    return axes


def _find_next_in_time(
    places: Sequence[Placed], order: Sequence[int], here: Placed
) -> Placed | None:
    """Find the first in order that is of another time."""
    others = (places[index] for index in order)
    # cameras of one moment differ by up to 0.01 s
    return next((other for other in others if abs(other.tdb_s - here.tdb_s) > 0.01), None)


def is_same_pass(earlier: Placed, later: Placed) -> bool:
    """Whether two positions are neighbours in time on one pass, in this order."""
    gap_s = later.tdb_s - earlier.tdb_s
    nearest = min(float(np.linalg.norm(camera.position_m)) for camera in (earlier, later))
    # Frames further apart than 1200 s or 60 deg on the ground are not neighbours of one pass: the
    # chord between them is off the direction of motion by more than a few degrees. Motion slows as
    # the power 1.5 of the distance (Kepler), so beyond 2000 km the gap may grow like that.
    if not 0.0 < gap_s <= 1200.0 * max(1.0, nearest / 2.0e6) ** 1.5:
        return False
    speed = float(np.linalg.norm(later.position_m - earlier.position_m)) / gap_s
    cosine = earlier.position_m @ later.position_m
    cosine = cosine / np.linalg.norm(earlier.position_m) / np.linalg.norm(later.position_m)
    near = bool(cosine >= np.cos(np.radians(60.0)))
    # below 1 m/s the camera stands still, above 20 km/s it is another pass
    return near and 1.0 <= speed <= 20e3


def _compute_axes(position: FloatArray, motion: FloatArray) -> tuple[FloatArray, Forward]:
    length = float(np.linalg.norm(motion))
    up = position / np.linalg.norm(position)
    # 2 % of the motion across the vertical still give a direction
    if length > 0.0 and np.linalg.norm(np.cross(up, motion)) >= 0.02 * length:
        return rnb_axes(position, motion), "motion"
    north = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(up, north)) < 1e-9:  # at a pole any direction does
        north = np.array([1.0, 0.0, 0.0])
    return rnb_axes(position, north), "north"


def identify_other_frame(
    solutions: Sequence[Solution], truths: Sequence[Truth], attitude: FileAttitude
) -> str:
    """Identify the truth's quaternions where they are not what `attitude` names; else "".

    attitude  as the truth was read with
    """
    by_file = {truth.file: truth for truth in truths}
    angles: dict[str, list[float]] = {name: [] for name in READINGS}
    for solution in solutions:
        if solution.camera_from_body is None:
            continue
        truth = by_file[solution.file]
        if not truth.has_attitude:
            continue
        inertial_from_body = attitude.inertial_from_body(truth.tdb_s)
        written = attitude.convert_for_file(truth.camera_from_body, truth.tdb_s)
        for name, reading in READINGS.items():
            true = reading(written, inertial_from_body)
            angles[name].append(float((solution.camera_from_body * true.inv()).magnitude()))
    if not angles[attitude.name]:
        return ""
    off = {name: float(np.median(values)) for name, values in angles.items()}
    best = min(off, key=off.__getitem__)
    stated = off[attitude.name]
    return best if stated > FAR_RAD and off[best] < min(FAR_RAD, 0.1 * stated) else ""
