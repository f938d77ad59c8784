"""One picture to take: where the camera is, how it is turned, and what is stated of it."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from optnav_cli.camera.camera import Camera

# streams of random numbers, so that a setting more or less does not move the others
CAMERAS = 4  # whose rays a ground keeps: 100 MB each at 2048 pixels a side
PLACE, POINTING, PRIOR, ATTITUDE, ROUGHNESS = range(5)


@dataclass(frozen=True, eq=False)
class Epoch:
    """The ship at a time when its cameras take their pictures.

    number               of the epoch in the scenario
    position_m, forward  (3,) body frame, m; forward is a unit vector level with the ground
    sun_body             (3,) unit vector; reported_sun says whether frames.csv states it
    ground_seed          which added relief, None for none
    """

    number: int
    pass_index: int
    tdb_s: float
    position_m: FloatArray
    forward: FloatArray
    sun_body: FloatArray
    reported_sun: bool
    ground_seed: int | None


@dataclass(frozen=True, eq=False)
class Exposure(Epoch):
    """The truth about one picture, and what frames.csv states of it.

    index             number of the picture; camera: number of the camera in the scenario
    camera_from_body  the truth;  reported_camera_from_body with its error
    prior_m           (3,) body frame, m; no prior is stated where it is None
    """

    camera_from_body: Rotation
    reported_camera_from_body: Rotation
    prior_m: FloatArray | None = None
    index: int = 0
    camera: int = 0
    file: str = ""
    utc: str = ""


class TruthGround(Protocol):
    """The ground that a scenario's pictures show: a region, a whole body or a mesh."""

    def radiance(self, camera: Camera, exposure: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width), sky 0, of a picture."""
        ...


def corner_rays(camera: Camera) -> FloatArray:
    """Unit rays (height + 1, width + 1, 3), camera frame, through the corners of the pixels."""
    x, y = np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1))
    return camera.unproject(np.stack([x, y], axis=-1) - 0.5)


def every_px(corners: FloatArray, step: int) -> FloatArray:
    """Every so many of corner rays (height + 1, width + 1, 3) along both sides, and the last."""
    r, c = (np.unique(np.append(np.arange(0, n - 1, step), n - 1)) for n in corners.shape[:2])
    chosen: FloatArray = corners[r][:, c]
    return chosen
