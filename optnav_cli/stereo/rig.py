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
from optnav_cli.frames.run_settings import MountSettings

OUTSIDE = -1e4  # pixel where a warp has no picture


@dataclass(frozen=True, eq=False)
class Eye:
    """A camera mounted in the ship: place (3,) m, rotation; mounting error 1 sigma, rad."""

    camera: Camera
    place_m: FloatArray
    ship_from_camera: Rotation
    error_rad: float = 0.0

    @classmethod
    def mount_camera(cls, mount: MountSettings, camera: Camera) -> "Eye":
        """Return the camera of a mount."""
        return cls(camera, mount.place_m, mount.turn, mount.error_rad)

    def unproject(self, pixels: FloatArray) -> FloatArray:
        """Unproject pixels (..., 2) to unit rays (..., 3), ship frame."""
        rays: FloatArray = self.camera.unproject(pixels) @ self.ship_from_camera.as_matrix().T
        return rays

    def linearise_projection(self, away: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Project vectors (n, 3) from the camera, ship frame; return also d pixel / d vector."""
        turn = self.ship_from_camera.as_matrix()
        pixels, by_point = self.camera.project_with_jacobian(away @ turn)
        return pixels, by_point @ turn.T

    def project(self, away: FloatArray) -> FloatArray:
        """Project vectors (..., 3) from the camera, ship frame, to pixels (..., 2)."""
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

    def compute_grid_rays(self) -> FloatArray:
        """Compute rays (rows, cols, 3), ship frame, of the first camera's pixels."""
        rows, cols = self.first.camera.shape
        x, y = np.meshgrid(np.arange(cols, dtype=np.float64), np.arange(rows, dtype=np.float64))
        return self.first.unproject(np.stack([x, y], axis=-1))


def resample(picture: Float32Array, pixels: FloatArray) -> Float32Array:
    """Resample a picture at pixels (rows, cols, 2), by cubic splines; NaN outside of it.

    cv2.remap rounds places to 1/32 px and cubic convolution moves fine texture by 0.01 px: 0.1 and
    0.05 m of height at 100 m over a base of 1 m.
    """
    places = np.where(np.isfinite(pixels), pixels, OUTSIDE)
    resampled: Float32Array = map_coordinates(
        picture,
        [places[..., 1], places[..., 0]],
        order=3,
        mode="constant",
        cval=np.nan,
        output=np.float32,
    )
    return resampled
