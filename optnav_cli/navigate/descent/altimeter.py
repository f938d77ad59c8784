"""An altimeter's range in a descent: predicted over the terrain model, checked, used.

The beam meets the model's ground at one point. What the ground lies off there is an error that it
shares with the windows about it, so that the point joins the filter's state, and relief below the
model's posting.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.vectors import unit
from optnav_cli.estimation.models.points import Pose
from optnav_cli.navigate.descent.state import JointState
from optnav_cli.navigate.descent.windows import WindowField
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

# A range is refused whose misfit is wider than so many sigmas: one right one in 16,000 is.
MAX_SIGMAS = 4.0
MAX_SLANT = np.radians(70.0)  # of the beam off the ground's normal: beyond it a slope decides


@dataclass(frozen=True, eq=False)
class Range:
    """A range along a beam.

    beam        (3,) unit vector, camera frame
    measured_m  slant range;  sigma_m its 1 sigma
    """

    beam: FloatArray
    measured_m: float
    sigma_m: float


def update_by_range(
    state: JointState, windows: WindowField, stated: Pose, seen: Range, moved_m: float
) -> tuple[JointState, Reason]:
    """Update a state by a range; return the new state and why the range was not used, if so.

    stated   pose of the track
    moved_m  along the ground since the last range: within a posting it meets the same relief
    """
    pose = state.filter.pose(stated)
    ray = seen.beam @ pose.camera_from_body.as_matrix()
    point = windows.meet_ray(pose.position_m, ray)
    if point is None:
        text = "the altimeter's beam meets no ground of the catalog"
        return state, Reason(ReasonCode.RANGE_REFUSED, text)
    normal = windows.fit_normal(point, 0.0)
    slant = float(normal @ ray)
    if -slant < np.cos(MAX_SLANT):
        text = "the altimeter's beam meets the ground at a grazing angle"
        return state, Reason(ReasonCode.RANGE_REFUSED, text)
    joined = state.copy()
    number = joined.join_beam(windows, point)
    # n . (p + r b - q) = 0: r falls as the camera nears the plane, and as the ground rises
    by_position = -normal / slant
    up = unit(point)
    by_ground = float(normal @ up) / slant * up
    predicted = float(np.linalg.norm(point - pose.position_m))
    predicted += float(by_ground @ joined.filter.offsets_m[number])
    by_turn = predicted * np.cross(seen.beam, pose.camera_from_body.apply(normal)) / slant
    row, spread = joined.filter.predict_range(by_turn, by_position, (number, by_ground))
    posting = windows.posting_m(0)
    relief_m = float(np.linalg.norm(by_ground)) * state.sizes.altimeter_postings * posting
    variance = spread + seen.sigma_m**2 + relief_m**2 * max(1.0, posting / max(moved_m, 1.0))
    misfit, sigma = seen.measured_m - predicted, float(np.sqrt(variance))
    if abs(misfit) > MAX_SIGMAS * sigma:
        text = (
            f"the altimeter's range of {seen.measured_m:.1f} m is not used: picture, track and "
            f"terrain model say {predicted:.1f} m with a sigma of {sigma:.1f} m"
        )
        return state, Reason(ReasonCode.RANGE_REFUSED, text)
    joined.filter.update_range(row, misfit, variance)
    return joined, NO_REASON
