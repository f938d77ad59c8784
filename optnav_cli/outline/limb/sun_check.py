"""The lit part of a body in the picture against the Sun as attitude and time place it.

A limb is lit where its surface faces the Sun, so the middle of the lit arc is the Sun's side. The
cusps that end the arc are rough by relief; an arc that the frame or structure ends says less. And
of a whole disc the Sun lights a share that the phase alone decides.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.vectors import perpendicular_basis, unit
from optnav_cli.camera.camera import Camera
from optnav_cli.outline.limb.detection import LimbPoints

MIN_ARC_DEG, FULL_ARC_DEG = 100.0, 300.0  # too little of a limb, or one lit all round: no side
# Of the middle of an arc that ends at the cusps. Of 17 rendered discs of 60 to 710 px radius, at
# phases of 26 to 103 deg, it was 1.5 deg off rms, 3.3 at most.
CUSP_SIGMA = np.radians(5.0)
CUT_SIGMA = np.radians(35.0)  # of one that the frame may have ended
DISAGREE_SIGMAS = 3.0
# Lit share of the disc against the phase's: of the same discs 0.03 rms off, 0.05 at most, by the
# threshold and by shadows at the terminator; blur widens a small disc by about a pixel.
SHARE_LIMIT, RIM_BLUR_PX = 0.12, 1.0
MIN_RADIUS_PX = 8.0
MAX_DISC = 0.25  # rad; of a body close by a cap is seen, whose lit share is another
RIM_POINTS = 180
MIN_SINE = 0.05  # of the angle between the Sun and the body's centre: below it no side


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


def measure_sun_side(limb: LimbPoints, rays: FloatArray, sun_camera: FloatArray) -> SunSide:
    """Compare the lit side of a limb with the Sun's direction.

    limb        found without the Sun, which else would have chosen the side
    rays        (n, 3) unit rays of its points, camera frame
    sun_camera  (3,) unit vector to the Sun
    """
    axis = limb.cone_axis_camera
    outward = rays - (rays @ axis)[:, None] * axis
    seen = unit(outward).mean(axis=0)
    expected = sun_camera - (sun_camera @ axis) * axis
    sine = float(np.linalg.norm(expected))
    sided = MIN_ARC_DEG <= limb.arc_deg <= FULL_ARC_DEG and np.linalg.norm(seen) > 0.0
    if not sided or sine < MIN_SINE:
        return SunSide(0.0, float(np.pi))
    cosine = float(seen @ expected / (np.linalg.norm(seen) * sine))
    sigma = CUT_SIGMA if limb.cut_by_frame else CUSP_SIGMA
    # as the Sun nears the line of sight the cusps spread and the side blurs
    return SunSide(float(np.arccos(np.clip(cosine, -1.0, 1.0))), float(min(sigma / sine, np.pi)))


def measure_lit_share(limb: LimbPoints, camera: Camera) -> float | None:
    """Measure a whole disc's lit share; None where the frame cuts it or it is too small or near.

    limb  of a sphere, found without the Sun
    """
    if limb.cone_angle > MAX_DISC:
        return None
    axis = limb.cone_axis_camera
    u, v = perpendicular_basis(axis)
    turn = np.linspace(0.0, 2.0 * np.pi, RIM_POINTS, endpoint=False)[:, None]
    outward = np.cos(turn) * u + np.sin(turn) * v
    rim = camera.project(np.cos(limb.cone_angle) * axis + np.sin(limb.cone_angle) * outward)
    if limb.cut_by_frame or not camera.contains(rim).all():
        return None
    x, y = (rim - rim[0]).T
    area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    radius = float(np.sqrt(area / np.pi))
    if radius < MIN_RADIUS_PX:
        return None
    return limb.lit_pixels / (area * (1.0 + RIM_BLUR_PX / radius) ** 2)


def describe_wrong_sun(limb: LimbPoints, camera: Camera, sun_camera: FloatArray) -> str:
    """Describe how a limb contradicts the stated Sun; empty when it does not.

    limb        of a sphere, found without the Sun, which else would have chosen the side
    sun_camera  (3,) unit vector to the Sun
    """
    side = measure_sun_side(limb, camera.unproject(limb.pixels), sun_camera)
    if side.disagrees:
        return (
            f"the lit side of the body is {np.degrees(side.angle):.0f} deg from where attitude "
            f"and time put the Sun (sigma {np.degrees(side.sigma):.0f} deg)"
        )
    share = measure_lit_share(limb, camera)
    expected = 0.5 * (1.0 - float(limb.cone_axis_camera @ sun_camera))
    if share is not None and abs(share - expected) > SHARE_LIMIT:
        return (
            f"{100.0 * share:.0f} % of the disc is lit, and {100.0 * expected:.0f} % should be by "
            "the Sun of this attitude and time"
        )
    return ""
