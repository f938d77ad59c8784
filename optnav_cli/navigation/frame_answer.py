"""A frame as the loop takes it up, and its answer: a row with what was tried, and why."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.orbit_arc import GATE
from optnav_cli.imagery.frames import Frame
from optnav_cli.imagery.picture import Picture
from optnav_cli.navigation.control_points import ControlPointFix, TriedPoint
from optnav_cli.navigation.outline import Outline
from optnav_cli.solution import OutlineMarks, Solution, solved

CONTROL_POINTS = "control_points"


@dataclass(frozen=True, eq=False)
class Answer:
    """A frame's row, the control points tried for it, and the marks of the body's outline."""

    solution: Solution
    tried: list[TriedPoint]
    marks: OutlineMarks | None = None


@dataclass(frozen=True, eq=False)
class Sight:
    """A frame that can be navigated: everything that must be known about it is there.

    sun_body (3,) unit vector, body frame
    """

    frame: Frame
    tdb_s: float
    camera: Camera
    picture: Picture
    camera_from_body: Rotation
    sun_body: FloatArray

    @property
    def row(self) -> tuple[str, str]:
        """What its row in solution.csv begins with."""
        return self.frame.file, self.frame.utc


def source_of(sight: Sight) -> str:
    """What a prior is called that another frame takes from this one."""
    return f"{sight.camera.name} camera, {sight.frame.file}"


def sight_of(frame: Frame, camera: Camera, picture: Picture) -> Sight:
    """A frame with its picture. Raises NoSolutionError for what it must say and does not."""
    if frame.camera_from_body is None:
        raise NoSolutionError("no attitude: the quaternion is empty")
    if frame.sun_body is None or frame.tdb_s is None:
        raise NoSolutionError("no direction to the Sun")
    return Sight(frame, frame.tdb_s, camera, picture, frame.camera_from_body, frame.sun_body)


def row_of_points(sight: Sight, fix: ControlPointFix) -> Solution:
    """The row of a frame that control points solved."""
    resection = fix.solution.resection
    used = [t.residual_px for t in fix.tried if t.used and t.residual_px is not None]
    return solved(
        *sight.row,
        CONTROL_POINTS,
        resection.pose.position_m,
        resection.position_covariance_m2,
        resection.pose.camera_from_body,
        resection.attitude_sigma_rad,
        n_predicted=len(fix.tried),
        n_matched=sum(not tried.match.reason for tried in fix.tried),
        n_used=len(used),
        residual_rms_px=float(np.sqrt(np.mean(np.square(used)))) if used else None,
        reason=fix.remark,
    )


def spoken(method: str) -> str:
    """A method's name in a sentence."""
    return method.replace("_", " ")


def apart(row: Solution, found: Outline) -> str:
    """A remark where an outline lies further from the control points' position than it states."""
    if row.position_m is None or row.covariance_m2 is None:
        return ""
    offset = row.position_m - found.position_m
    square = float(offset @ np.linalg.solve(row.covariance_m2 + found.covariance_m2, offset))
    if square < GATE:
        return ""
    away = float(np.linalg.norm(offset)) / 1e3
    return f"the {spoken(found.method)} lies {away:.1f} km ({np.sqrt(square):.0f} sigmas) off"


def remarked(answer: Answer, remark: str) -> Answer:
    """An answer with a remark behind its reason; as it is without one."""
    row = answer.solution
    reason = "; ".join(part for part in (row.reason, remark) if part)
    return replace(answer, solution=replace(row, reason=reason))
