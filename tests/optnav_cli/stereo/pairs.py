"""Pictures of analytic ground by cameras on a base: no renderer between truth and measurement."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from optnav_cli.camera.camera import Camera
from optnav_cli.stereo.rig import Eye, Rig

CAMERA = Camera("left", "pinhole", 320, 320, 800.0, (159.5, 159.5))
DOWN = np.array([0.0, 0.0, 1.0])


def rig(base_m: float = 1.0, error_rad: float = 0.0, turn: Rotation | None = None) -> Rig:
    """Two cameras beside each other; the second one's mounting is known so well."""
    second = Eye(
        replace(CAMERA, name="right"),
        np.array([base_m, 0.0, 0.0]),
        turn or Rotation.identity(),
        error_rad,
    )
    return Rig(Eye(CAMERA, np.zeros(3), Rotation.identity()), second)


def brightness(x: FloatArray, y: FloatArray, seed: int = 1) -> FloatArray:
    """Of the ground at level places (m): waves of 0.5 to 8 m in all directions."""
    rng = np.random.default_rng(seed)
    total = np.zeros(np.shape(x))
    for length in np.geomspace(0.5, 8.0, 40):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        along = np.cos(angle) * x + np.sin(angle) * y
        total += np.sin(2.0 * np.pi * along / length + phase)
    return 100.0 + 4.0 * total


def picture(
    eye: Eye,
    height_m: float,
    *,
    at_m: FloatArray | None = None,
    ground_from_ship: Rotation | None = None,
    slope: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.0,
    seed: int = 1,
) -> Float32Array:
    """What a camera sees of a plane whose height below the ship's place is given.

    at_m  (3,) of the ship in the ground's frame, z down;  slope of depth with x and y
    """
    rows, cols = eye.camera.shape
    x, y = np.meshgrid(np.arange(cols, dtype=np.float64), np.arange(rows, dtype=np.float64))
    turn = (ground_from_ship or Rotation.identity()).as_matrix()
    rays = eye.unproject(np.stack([x, y], axis=-1)) @ turn.T
    place = turn @ eye.place_m + (np.zeros(3) if at_m is None else at_m)
    # depth = height + slope . (x, y)
    normal = np.array([-slope[0], -slope[1], 1.0])
    along = (height_m - place @ normal) / (rays @ normal)
    ground = place + along[..., None] * rays
    light = brightness(ground[..., 0], ground[..., 1])
    if noise:
        light = light + noise * np.random.default_rng(seed).normal(size=light.shape)
    found: Float32Array = light.astype(np.float32)
    return found
