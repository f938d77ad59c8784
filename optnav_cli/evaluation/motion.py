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
# Frames further apart than this in time or on the ground are not neighbours of one pass: the
# chord between them is then off the direction of motion by more than a few degrees. Motion slows as
# the power 1.5 of the distance (Kepler), so beyond NEAR_M the gap may grow like that.
MAX_GAP_S, NEAR_M = 1200.0, 2.0e6
MAX_GAP_DEG = 60.0
SAME_TIME_S = 0.01  # cameras of one moment
SPEEDS_M_S = (1.0, 20e3)  # slower is standing still, faster is another pass
MIN_ACROSS = 0.02  # share of the motion across the vertical that still gives a direction
# True attitudes as far as this from the solved ones are no errors of navigation, and another frame
# that brings them so much nearer is the one that they were written in.
FAR_RAD, NEARER = np.radians(1.0), 0.1

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


def directions_of_motion(places: Sequence[Placed]) -> list[tuple[FloatArray, Forward]]:
    """Axes R, N, B as rows (3, 3) for each position, and what N rests on.

    N points along the chord between the neighbours in time that belong to the same pass, as the
    body sees it; where there is none, or the motion is vertical, N is local north ("north").
    Positions of one time (several cameras) share their neighbours.
    """
    order = sorted(range(len(places)), key=lambda index: places[index].tdb_s)
    axes: list[tuple[FloatArray, Forward]] = [(np.eye(3), "north")] * len(places)
    for rank, index in enumerate(order):
        here = places[index]
        before = _next_in_time(places, order[:rank][::-1], here)
        after = _next_in_time(places, order[rank + 1 :], here)
        start = before if before is not None and same_pass(before, here) else here
        end = after if after is not None and same_pass(here, after) else here
        axes[index] = _axes(here.position_m, end.position_m - start.position_m)
    return axes


def _next_in_time(places: Sequence[Placed], order: Sequence[int], here: Placed) -> Placed | None:
    """The first in order that is of another time."""
    others = (places[index] for index in order)
    return next((other for other in others if abs(other.tdb_s - here.tdb_s) > SAME_TIME_S), None)


def same_pass(one: Placed, later: Placed) -> bool:
    """Whether two places are neighbours in time on one way, and which is the later is known."""
    gap_s = later.tdb_s - one.tdb_s
    nearest = min(float(np.linalg.norm(place.position_m)) for place in (one, later))
    if not 0.0 < gap_s <= MAX_GAP_S * max(1.0, nearest / NEAR_M) ** 1.5:
        return False
    speed = float(np.linalg.norm(later.position_m - one.position_m)) / gap_s
    cosine = one.position_m @ later.position_m
    cosine = cosine / np.linalg.norm(one.position_m) / np.linalg.norm(later.position_m)
    near = bool(cosine >= np.cos(np.radians(MAX_GAP_DEG)))
    return near and SPEEDS_M_S[0] <= speed <= SPEEDS_M_S[1]


def _axes(position: FloatArray, motion: FloatArray) -> tuple[FloatArray, Forward]:
    length = float(np.linalg.norm(motion))
    up = position / np.linalg.norm(position)
    if length > 0.0 and np.linalg.norm(np.cross(up, motion)) >= MIN_ACROSS * length:
        return rnb_axes(position, motion), "motion"
    north = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(up, north)) < 1e-9:  # at a pole any direction does
        north = np.array([1.0, 0.0, 0.0])
    return rnb_axes(position, north), "north"


def other_frame(
    solutions: Sequence[Solution], truths: Sequence[Truth], attitude: FileAttitude
) -> str:
    """What the quaternions of the truth are, where they are not what `attitude` names; else "".

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
    return best if stated > FAR_RAD and off[best] < min(FAR_RAD, NEARER * stated) else ""
