"""Pictures of the Earth through a telephoto lens, with points of known places, for `study points`.

They are drawn by another model than the one that judges them: relief on WGS 84, and rays that the
air bends, integrated by Bouguer's law (n r sin z is constant along a ray) through an exponential
atmosphere, where the fit takes a closed formula.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.geometry.latlon import xyz_from_latlon
from optnav_cli.camera.camera import Camera

HEIGHT_M, RELIEF_M = 420e3, 500.0
AIR_TOP_M, NODES = 120e3, 64
CAMERA = Camera("tele", "pinhole", 5616, 3744, 400.0 / 36.0 * 5616.0, (2807.5, 1871.5))
MARGIN = 0.02  # of a side, between points and the edge of the picture: picks are spread all over it


@dataclass(frozen=True, eq=False)
class PickedPicture:
    """The truth: place (3,), m, attitude, places (n, 3) of the points, pixels (n, 2)."""

    position_m: FloatArray
    camera_from_body: Rotation
    places_m: FloatArray
    pixels: FloatArray

    def error_of(self, position_m: FloatArray) -> tuple[float, float]:
        """Horizontal and vertical error of a position, m, the latter with its sign."""
        off, up = position_m - self.position_m, self.position_m / np.linalg.norm(self.position_m)
        height = float(off @ up)
        return float(np.linalg.norm(off - height * up)), height


def picked_picture(
    body: Body,
    rng: np.random.Generator,
    count: int,
    off_deg: float,
    focal: float = 1.0,
    relief_m: float = RELIEF_M,
    position_m: FloatArray | None = None,
) -> PickedPicture:
    """A picture so far off the nadir, in any direction and roll; four points stand in corners.

    focal     the true focal length over the stated one
    relief_m  how high points stand at most
    position_m  (3,) of the camera, body-fixed; None: anywhere at HEIGHT_M
    """
    if position_m is None:
        up = xyz_from_latlon(np.arcsin(rng.uniform(-0.7, 0.7)), rng.uniform(-np.pi, np.pi), 1.0)
        position_m = up * (body.radius_m + HEIGHT_M)
    position, up = position_m, position_m / np.linalg.norm(position_m)
    turn = _pointed(up, np.radians(off_deg), rng)
    pixels = _layout(rng, count)
    middle = np.array(CAMERA.principal_point_px)
    sights = CAMERA.unproject(middle + (pixels - middle) / focal) @ turn.as_matrix()
    heights = rng.uniform(0.0, relief_m, count)
    places = _on_ground(position, sights, np.array(body.radii_m) + heights[:, None])
    seen = turn.apply(_bent(position, places, body))
    return PickedPicture(position, turn, places, middle + focal * (CAMERA.project(seen) - middle))


def _layout(rng: np.random.Generator, count: int) -> FloatArray:
    side = np.array(CAMERA.shape[::-1])
    if count == 4:
        corners = np.array([(0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9)])
        found: FloatArray = (corners + rng.uniform(-0.08, 0.08, (4, 2))) * side
        return found
    placed: FloatArray = rng.uniform(MARGIN, 1.0 - MARGIN, (count, 2)) * side
    return placed


def _pointed(up: FloatArray, off: float, rng: np.random.Generator) -> Rotation:
    east = np.cross((0.0, 0.0, 1.0), up)
    east /= np.linalg.norm(east)
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    level = np.sin(azimuth) * east + np.cos(azimuth) * np.cross(up, east)
    axis = np.sin(off) * level - np.cos(off) * up
    right = np.cross(level, up)
    upright = Rotation.from_matrix(np.array([right, np.cross(axis, right), axis]))
    return Rotation.from_rotvec((0.0, 0.0, rng.uniform(-np.pi, np.pi))) * upright


def _on_ground(position: FloatArray, sights: FloatArray, radii: FloatArray) -> FloatArray:
    """Where straight sights (n, 3) reach ellipsoids of semi-axes (n, 3)."""
    ways, start = sights / radii, position / radii
    a, b = (ways * ways).sum(axis=1), (ways * start).sum(axis=1)
    under = b * b - a * ((start * start).sum(axis=1) - 1.0)
    along = (-b - np.sqrt(under)) / a
    found: FloatArray = position + sights * along[:, None]
    return found


def _bent(position: FloatArray, places: FloatArray, body: Body) -> FloatArray:
    """Directions (n, 3) from which light of places comes to a camera above the air."""
    straight = places - position
    air = body.atmosphere
    if air is None:
        return straight
    far, near = float(np.linalg.norm(position)), np.linalg.norm(places, axis=1)
    crossed = np.linalg.norm(np.cross(position, places), axis=1)
    wanted = np.arctan2(crossed, places @ position)  # at the Earth's centre
    x, weight = np.polynomial.legendre.leggauss(NODES)
    # nodes crowd where the air is
    share = 0.5 * (x + 1.0)
    height = AIR_TOP_M * share**2
    step = 0.5 * weight * 2.0 * AIR_TOP_M * share
    index = 1.0 + air.refractivity * np.exp(-height / air.scale_height_m)
    radius = near[:, None] + height
    impact = crossed / np.linalg.norm(straight, axis=1)
    for _ in range(6):
        c = impact[:, None]
        through_air = c / (radius * np.sqrt((index * radius) ** 2 - c * c))
        bent = through_air - c / (radius * np.sqrt(radius**2 - c * c))
        angle = np.arccos(impact / far) - np.arccos(impact / near) + bent @ step
        slope = 1.0 / np.sqrt(near**2 - impact**2) - 1.0 / np.sqrt(far**2 - impact**2)
        impact = impact + (wanted - angle) / slope
    down = -position / far
    level = places - (places @ down)[:, None] * down
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    sine = (impact / far)[:, None]
    found: FloatArray = sine * level + np.sqrt(1.0 - sine**2) * down
    return found
