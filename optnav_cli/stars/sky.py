"""The sky of a picture: where its stars are seen, and what time and motion leave open."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import compute_velocity_inertial
from catalog.bodies.stars import (
    LIGHT_M_S,
    BrightStars,
    apply_aberration,
    load_bright_stars,
)
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.stars.identify import StarIdentifier
from optnav_cli.stars.spots import find_spots

EARTH_SPEED_M_S = 29_785.0  # mean, about the Sun


@dataclass(frozen=True)
class SkyView:
    """Observer whose motion displaces the stars, and the time: TDB s past J2000 or None.

    distance_m  of the craft from the body's centre, None where not known: a low orbit's
    catalog     the stars that are looked for
    """

    body: Body
    tdb_s: float | None
    distance_m: float | None = None
    catalog: BrightStars = field(default_factory=load_bright_stars)

    def compute_directions(self) -> FloatArray:
        """Compute where the catalog's stars are seen, inertial axes: (n, 3)."""
        stars = self.catalog.propagate(self.tdb_s)
        if self.tdb_s is None:
            return stars
        return apply_aberration(stars, compute_velocity_inertial(self.body, self.tdb_s))

    @property
    def sigma_rad(self) -> float:
        """Unknown part of aberration, 1 sigma per axis: an orbit's motion, or the Earth's."""
        # a circle's speed in a direction that is not known: two of three components count
        distance = max(self.distance_m or 0.0, self.body.radius_m)
        orbit = np.sqrt(self.body.gm_m3_s2 / distance)
        speed = orbit if self.tdb_s is not None else np.hypot(orbit, EARTH_SPEED_M_S)
        return float(speed / LIGHT_M_S / np.sqrt(3.0))

    @property
    def variances(self) -> FloatArray:
        """Variances (3,) of aberration about a camera's axes, rad^2; least about the boresight.

        There only stars off the axis show it: a quarter is for fields of up to 60 deg.
        """
        return self.sigma_rad**2 * np.array([1.0, 1.0, 0.25])


@dataclass(frozen=True)
class StarSight:
    """Attitude of a picture by its stars, 1 sigma per axis, rad; None, with the reason."""

    camera_from_inertial: Rotation | None
    sigma_rad: float
    reason: str


def find_star_attitude(
    picture: Float32Array, saturation: float | None, camera: Camera, view: SkyView
) -> StarSight:
    """Find the attitude of a picture (h, w) by its stars, or why there is none."""
    try:
        spots = find_spots(picture, saturation)
        fix = StarIdentifier(camera, view.compute_directions(), view.catalog).identify(spots)
    except NoSolutionError as error:
        return StarSight(None, 0.0, str(error))
    # navigation takes one sigma for all axes; across, where the ground is moved most, it is honest
    across = np.sqrt((np.diag(fix.covariance) + view.variances)[:2].mean())
    return StarSight(fix.camera_from_sky, float(across), "")
