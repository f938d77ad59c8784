"""The lit side of a body in the picture against the Sun that attitude and time claim.

A limb is lit where its surface faces the Sun, so the middle of the lit arc is the Sun's side. The
cusps that end the arc are rough by relief; an arc that the frame or structure ends says less.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from optnav_cli.measurements.limb_points import LimbPoints

FloatArray = NDArray[np.float64]

FULL_ARC_DEG = 300.0  # a limb lit all round has no side
CUSP_SIGMA = np.radians(8.0)  # of the middle of an arc that ends at the cusps
CUT_SIGMA = np.radians(35.0)  # of one that the frame may have ended
DISAGREE_SIGMAS = 3.0
LEAST_SINE = 0.05  # of the angle between the Sun and the body's centre: below it no side


@dataclass(frozen=True)
class SunSide:
    """Angle between the lit side seen and the Sun's, about the body's centre, rad.

    sigma  its 1-sigma error; pi where picture or Sun has no side
    """

    angle: float
    sigma: float

    @property
    def disagrees(self) -> bool:
        """Whether the two are further apart than their error allows."""
        return self.angle > DISAGREE_SIGMAS * self.sigma


def sun_side_angle(limb: LimbPoints, rays: FloatArray, sun_camera: FloatArray) -> SunSide:
    """Compare the lit side of a limb with the Sun's direction.

    limb        found without the Sun, which else would have chosen the side
    rays        (n, 3) unit rays of its points, camera frame
    sun_camera  (3,) unit vector to the Sun
    """
    axis = limb.cone_axis_camera
    outward = rays - (rays @ axis)[:, None] * axis
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    seen = outward.mean(axis=0)
    claimed = sun_camera - (sun_camera @ axis) * axis
    sine = float(np.linalg.norm(claimed))
    if limb.arc_deg > FULL_ARC_DEG or sine < LEAST_SINE or not np.linalg.norm(seen) > 0.0:
        return SunSide(0.0, float(np.pi))
    cosine = float(seen @ claimed / (np.linalg.norm(seen) * sine))
    sigma = CUT_SIGMA if limb.cut_by_frame else CUSP_SIGMA
    # as the Sun nears the line of sight the cusps spread and the side blurs
    return SunSide(float(np.arccos(np.clip(cosine, -1.0, 1.0))), float(min(sigma / sine, np.pi)))


def doubt_of_sun(
    limb: LimbPoints, rays: FloatArray, camera_from_body: Rotation, sun_body: FloatArray
) -> str:
    """What is wrong with the Sun's side of a limb, in words; empty when nothing is.

    limb, rays as `sun_side_angle`;  sun_body (3,) unit vector to the Sun, body frame
    """
    side = sun_side_angle(limb, rays, camera_from_body.apply(sun_body))
    if not side.disagrees:
        return ""
    reason = (
        f"the lit side of the body is {np.degrees(side.angle):.0f} deg from where attitude and "
        f"time put the Sun (sigma {np.degrees(side.sigma):.0f} deg)"
    )
    other = sun_side_angle(limb, rays, camera_from_body.inv().apply(sun_body))
    if other.sigma < np.pi and not other.disagrees:
        return f"{reason}; the inverse rotation would agree: this looks like its quaternion"
    return f"{reason}; check attitude, clock and which rotation the quaternion is"
