"""Whether the quaternions of a truth.csv are the rotation that run.toml names, or another one."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from optnav_cli.fix import Solution
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.truth import Truth

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
        inertial_from_body = attitude.inertial_from_body(truth.tdb_s)
        written = attitude.written(truth.camera_from_body, truth.tdb_s)
        for name, reading in READINGS.items():
            true = reading(written, inertial_from_body)
            angles[name].append(float((solution.camera_from_body * true.inv()).magnitude()))
    if not angles[attitude.name]:
        return ""
    off = {name: float(np.median(values)) for name, values in angles.items()}
    best = min(off, key=off.__getitem__)
    stated = off[attitude.name]
    return best if stated > FAR_RAD and off[best] < min(FAR_RAD, NEARER * stated) else ""
