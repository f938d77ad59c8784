"""A small sphere's disc fitted whole: drawn again and again until it looks like the picture.

Along a limb of less than some twenty pixels' radius a profile across it holds too little ground
to tell the blur from the law, and near the cusps hardly a pixel is the limb's alone: the profiles'
edges lie up to half a pixel off. All pixels together, with what is known of blur and law, tell them
apart.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.measurements.bright_body import measure_levels
from optnav_cli.measurements.disc_model import draw_disc
from optnav_cli.measurements.edge_profile import EdgeShape
from optnav_cli.measurements.limb_cone import Cone

ABOUT_PX = 6  # of sky about the disc that is fitted
LEAST_BLUR_PX = 0.36  # the smallest that `draw_disc` can draw
TURNS, SETTLED = 15, 0.1  # the last in sigmas of each unknown
# Of a pixel of ground over its brightness: patterns and slopes that the law does not know.
TEXTURE, SHOT = 0.08, 1.0 / 50.0**2
# Blur where it is not calibrated, and the shares of the second and the third law.
BLUR = 0.85, 0.3
MIXTURE_SIGMA = 0.1
STEPS = np.array([0.03, 0.03, 0.03, 0.03, 0.05, 0.05])  # x, y, radius, blur: px; the two shares
LARGEST = np.array([1.0, 1.0, 1.0, 0.3, 0.2, 0.2])


@dataclass(frozen=True, eq=False)
class DiscFit:
    """The disc of a sphere.

    centre_px   (2,)    where the axis of its cone meets the picture
    radius_px   of the circle of as much area, where the lens bends it
    covariance  (3, 3)  of centre and radius, px^2
    misfit      rms of the residuals over what they should be
    """

    centre_px: FloatArray
    radius_px: float
    covariance: FloatArray
    misfit: float


def fit_disc(
    picture: Float32Array,
    camera: Camera,
    axis: FloatArray,
    angle: float,
    sun_camera: FloatArray,
    saturation: float | None,
) -> DiscFit:
    """Fit the disc of a sphere from a first cone: axis (3,) unit vector, half angle (rad).

    Raises NoSolutionError where the frame cuts the disc and where the fit does not settle.
    """
    per_px = rad_per_px(camera, axis)
    start = np.append(camera.project(axis), angle / per_px)
    reach = int(np.ceil(start[2])) + ABOUT_PX
    corner = np.rint(start[:2]).astype(np.int64) - reach
    size = np.full(2, 2 * reach + 1)
    height, width = picture.shape
    if (corner < 0).any() or (corner + size > (width, height)).any():
        raise NoSolutionError("the frame cuts the disc or its surroundings")
    part = picture[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]
    values = part.astype(np.float64)
    levels = measure_levels(picture)
    use = np.ones(values.shape, bool) if saturation is None else values < saturation
    believed = camera.known_blur_px or BLUR
    prior = np.array([believed[0], 0.0, 0.0])
    prior_sigma = np.array([believed[1], MIXTURE_SIGMA, MIXTURE_SIGMA])

    def drawn(state: FloatArray) -> FloatArray:
        ray = camera.unproject(state[:2])
        cone = Cone(np.eye(3), ray, float(state[2]) * per_px)
        shape = EdgeShape(max(float(state[3]), LEAST_BLUR_PX), (float(state[4]), float(state[5])),
                          1.0, 1.0)  # fmt: skip
        return draw_disc(camera, cone, sun_camera, shape, corner, size)[use]

    state = np.concatenate([start, prior])
    seen = values[use] - levels.sky
    for _ in range(TURNS):
        model = drawn(state)
        brightness = float(model @ seen) / max(float(model @ model), 1e-30)
        light = np.maximum(brightness * model, 0.0)
        bright = float(np.median(light[light > 0.3 * light.max()])) if light.max() > 0.0 else 1.0
        sigma = np.sqrt(levels.noise**2 + SHOT * bright * light + (TEXTURE * light) ** 2)
        columns = [
            brightness * (drawn(state + step) - model) / step.sum() for step in np.diag(STEPS)
        ]
        jacobian = np.stack([*columns, model, np.ones(len(model))], axis=1) / sigma[:, None]
        residual = (seen - brightness * model) / sigma
        normal = jacobian.T @ jacobian
        right = jacobian.T @ residual
        normal[[3, 4, 5], [3, 4, 5]] += prior_sigma**-2
        right[3:6] += (prior - state[3:]) / prior_sigma**2
        covariance = np.linalg.inv(normal)
        move = (covariance @ right)[:6]
        state = state + np.clip(move, -LARGEST, LARGEST)
        if not (np.isfinite(state).all() and state[2] > 1.0):
            break
        if (np.abs(move) < SETTLED * np.sqrt(np.diag(covariance)[:6])).all():
            misfit = float(np.sqrt(np.mean(residual**2)))
            spread = np.asarray(max(misfit, 1.0) ** 2 * covariance[:3, :3], dtype=np.float64)
            return DiscFit(state[:2], float(state[2]), spread, misfit)
    raise NoSolutionError(
        "the disc's light is not that of a sphere under the Sun of attitude and time: one of these "
        "is wrong, or it is another body"
    )


def rad_per_px(camera: Camera, axis: FloatArray) -> float:
    """Side of the square that a pixel sees about a direction (3,), rad."""
    steps = camera.unproject(camera.project(axis) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return float(np.sqrt(np.linalg.norm(np.cross(steps[1] - steps[0], steps[2] - steps[0]))))
