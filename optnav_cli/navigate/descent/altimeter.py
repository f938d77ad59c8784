"""An altimeter's range in a descent: predicted over the terrain model, checked, used.

The beam meets the model's ground at one point. What the ground lies off there is the relief below
the model's posting, the model's stated error at the smallest box, and the common error of the
level, which is a point of the filter's state.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.vectors import unit
from optnav_cli.estimation.models.points import Pose
from optnav_cli.navigate.descent.state import JointState, make_common_key
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
) -> Reason:
    """Update a state by a range; return why it was not used, if so: the state is then unchanged.

    stated   pose of the track
    moved_m  along the ground since the last range, for errors that neighbouring ground shares
    """
    pose = state.filter.pose(stated)
    ray = seen.beam @ pose.camera_from_body.as_matrix()
    point = windows.meet_ray(pose.position_m, ray)
    if point is None:
        text = "the altimeter's beam meets no ground of the catalog"
        return Reason(ReasonCode.RANGE_REFUSED, text)
    normal = windows.fit_normal(point, 0.0)
    slant = float(normal @ ray)
    if -slant < np.cos(MAX_SLANT):
        text = "the altimeter's beam meets the ground at a grazing angle"
        return Reason(ReasonCode.RANGE_REFUSED, text)
    predicted = float(np.linalg.norm(point - pose.position_m))
    # n . (p + r b - q) = 0: r falls as the camera nears the plane, and as the ground rises
    by_position = -normal / slant
    normal_camera = pose.camera_from_body.apply(normal)
    by_turn = predicted * np.cross(seen.beam, normal_camera) / slant
    by_height = float(normal @ unit(point)) / slant
    common, own_m, width_m = state.describe_ground(windows, point)
    key = make_common_key(0)
    number = state.keys.index(key) if key in state.keys else None
    row, spread = state.filter.predict_range(by_turn, by_position, (number, by_height * common))
    # Errors of neighbouring ground are alike: ranges closer than its width are fewer than they are.
    again = max(1.0, width_m / max(moved_m, 1.0))
    ground_m2 = again * (by_height * own_m) ** 2
    if number is None:
        ground_m2 += by_height**2 * float(common @ common)
    variance = spread + seen.sigma_m**2 + ground_m2
    misfit, sigma = seen.measured_m - predicted, float(np.sqrt(variance))
    if abs(misfit) > MAX_SIGMAS * sigma:
        text = (
            f"the altimeter's range of {seen.measured_m:.1f} m is not used: picture, track and "
            f"terrain model say {predicted:.1f} m with a sigma of {sigma:.1f} m"
        )
        return Reason(ReasonCode.RANGE_REFUSED, text)
    state.filter.update_range(row, misfit, variance)
    return NO_REASON
