"""The stereo rig: two cameras in the frame of their ship, and what one of them has of the other.

Ship frame: as the mounts state it; by custom z down, x and y level. A ground point is the ray of a
pixel of the first camera and its inverse distance along it, 1/m: parallax is linear in it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.mounts import MountSettings

OUTSIDE = -1e4  # pixel where a warp has no picture


@dataclass(frozen=True, eq=False)
class Eye:
    """A camera as it stands in the ship: place (3,) m, and how it is turned; error 1 sigma, rad."""

    camera: Camera
    place_m: FloatArray
    ship_from_camera: Rotation
    error_rad: float = 0.0

    @classmethod
    def of(cls, mount: MountSettings, camera: Camera) -> "Eye":
        """The camera of a mount."""
        return cls(camera, mount.place_m, mount.turn, mount.error_rad)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Unit rays (..., 3), ship frame, of pixels (..., 2)."""
        rays: FloatArray = self.camera.unproject(pixels) @ self.ship_from_camera.as_matrix().T
        return rays

    def seen(self, away: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) of vectors (n, 3) from the camera, ship frame, and d pixel / d vector."""
        turn = self.ship_from_camera.as_matrix()
        pixels, by_point = self.camera.project_with_jacobian(away @ turn)
        return pixels, by_point @ turn.T

    def pixels(self, away: FloatArray) -> FloatArray:
        """Pixels (..., 2) of vectors (..., 3) from the camera, ship frame."""
        return self.camera.project(away @ self.ship_from_camera.as_matrix())


@dataclass(frozen=True, eq=False)
class Rig:
    """Two cameras on a base; what is measured lies on the picture grid of the first."""

    first: Eye
    second: Eye

    @property
    def base_m(self) -> float:
        """Distance between the cameras."""
        return float(np.linalg.norm(self.second.place_m - self.first.place_m))

    def grid_rays(self) -> FloatArray:
        """Rays (rows, cols, 3), ship frame, of the first camera's pixels."""
        rows, cols = self.first.camera.shape
        x, y = np.meshgrid(np.arange(cols, dtype=np.float64), np.arange(rows, dtype=np.float64))
        return self.first.rays(np.stack([x, y], axis=-1))


def warped(picture: Float32Array, pixels: FloatArray) -> Float32Array:
    """A picture at pixels (rows, cols, 2), by cubic splines; NaN outside of it.

    cv2.remap rounds places to 1/32 px and cubic convolution moves fine texture by 0.01 px: 0.1 and
    0.05 m of height at 100 m over a base of 1 m.
    """
    places = np.where(np.isfinite(pixels), pixels, OUTSIDE)
    found: Float32Array = map_coordinates(
        picture,
        [places[..., 1], places[..., 0]],
        order=3,
        mode="constant",
        cval=np.nan,
        output=np.float32,
    )
    return found
