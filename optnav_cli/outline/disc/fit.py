"""A small sphere's disc fitted whole: drawn again and again until it looks like the picture.

Along a limb of less than some twenty pixels' radius a profile across it holds too little ground
to separate the blur from the law, and near the cusps hardly a pixel is the limb's alone: the
profiles' edges lie up to half a pixel off. All pixels together, with what is known of blur and law,
separate them.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.least_squares import Iteration, Linearisation, VectorPrior, solve
from optnav_cli.frames.segmentation import Levels, measure_levels
from optnav_cli.outline.disc.moments import blur_prior, load_disc_sizes
from optnav_cli.outline.limb.cone import Cone, compute_stretched_rays
from optnav_cli.outline.limb.edge_fit import EdgeShape, Profiles, locate_edges
from optnav_cli.outline.limb.photometry import evaluate_three_laws
from optnav_cli.reasons import Reason, ReasonCode

MAX_BENT_LIMB_PX = 60.0  # beyond it the straight limb's error is below 0.01 px
FINE = 4  # sub-pixels a side
MARGIN_PX = 12
ABOUT_PX = 6  # of sky about the disc that is fitted
# Of a pixel of ground over its brightness: patterns and slopes that the law does not model.
TEXTURE, SHOT = 0.08, 1.0 / 50.0**2
MIXTURE_SIGMA = 0.1  # of the shares of the second and the third law
STEPS = np.array([0.03, 0.03, 0.03, 0.03, 0.05, 0.05])  # x, y, radius, blur: px; the two shares
MAX_MOVE = np.array([1.0, 1.0, 1.0, 0.3, 0.2, 0.2])
_OTHER_LIGHT = Reason(
    ReasonCode.WRONG_LIGHT,
    "the disc's light is not that of a sphere under the Sun of attitude and time: one of these "
    "is wrong, or it is another body",
)
ITERATION = Iteration(15, 0.1, _OTHER_LIGHT, _OTHER_LIGHT, each_unknown=True)


def measure_edge_bias_px(
    profiles: Profiles,
    places: IntArray,
    camera: Camera,
    cone: Cone,
    sun_camera: FloatArray,
    shape: EdgeShape,
    levels: Levels,
) -> FloatArray:
    """Depth (n,) at which profiles on a drawn disc find its limb, which lies at depth 0.

    places (n, m, 2) pixels of the profiles;  sun_camera (3,) unit vector to the Sun.
    """
    corner = places.reshape(-1, 2).min(axis=0) - MARGIN_PX
    size = places.reshape(-1, 2).max(axis=0) + MARGIN_PX - corner + 1
    drawn = draw_disc(camera, cone, sun_camera, shape, corner, size)
    x, y = places[..., 0] - corner[0], places[..., 1] - corner[1]
    lit = drawn[drawn > 0.2 * drawn.max()]
    values = levels.sky + drawn[y, x] * ((levels.bright - levels.sky) / float(np.median(lit)))
    return locate_edges(replace(profiles, values=values), shape, levels, np.inf)[0]


def draw_disc(
    camera: Camera,
    cone: Cone,
    sun_camera: FloatArray,
    shape: EdgeShape,
    corner: IntArray,
    size: IntArray,
) -> FloatArray:
    """Brightness (height, width), any unit, of the body about a cone, blurred, over pixels.

    corner, size  x, y of the first pixel; width and height
    """
    x = corner[0] + (np.arange(FINE * size[0]) + 0.5) / FINE - 0.5
    y = corner[1] + (np.arange(FINE * size[1]) + 0.5) / FINE - 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    rays = compute_stretched_rays(camera, pixels, cone.stretch)
    depth = cone.measure_depth(rays)
    beside = np.array([[x.mean(), y.mean()], [x.mean() + 1.0, y.mean()]])
    turn = compute_stretched_rays(camera, beside, cone.stretch)
    rad_per_fine = float(np.linalg.norm(turn[1] - turn[0])) / FINE
    covered = np.clip(0.5 + depth / rad_per_fine, 0.0, 1.0)
    near = covered > 0.0
    rays, depth = rays[near], depth[near]
    # the middle of what of a cut sub-pixel is covered stands for it
    off = cone.angle - np.maximum(depth, 0.1 * rad_per_fine)
    sine = np.sin(off) / np.sin(cone.angle)
    cosine = np.sqrt(1.0 - sine**2)
    outward = rays - (rays @ cone.axis)[:, None] * cone.axis
    side = outward - (outward * rays).sum(axis=1, keepdims=True) * rays
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-15)
    normal = unit((sine[:, None] * side - cosine[:, None] * rays) @ cone.stretch)
    seen = unit(np.linalg.solve(cone.stretch, rays.T).T)
    mu0, mu, cos_phase = normal @ sun_camera, -(normal * seen).sum(axis=1), -(seen @ sun_camera)
    second, third = shape.mixture
    laws = evaluate_three_laws(mu0, mu, cos_phase, -float(cone.axis_camera() @ sun_camera))
    mixed = (1.0 - second - third) * laws[0] + second * laws[1] + third * laws[2]
    fine = np.zeros(covered.shape)
    fine[near] = np.where(mu0 > 0.0, mixed, 0.0) * covered[near]
    # `blur_px` includes the variance of a pixel's own width, 1/12 px^2.
    blur = np.sqrt(max(shape.blur_px**2 - 1.0 / 12.0, 0.05)) * FINE
    blurred = cv2.GaussianBlur(fine, (0, 0), blur)
    averaged = cv2.resize(blurred, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA)
    return np.asarray(averaged, dtype=np.float64)


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


class DiscModel:
    """Pixels of a disc as measurements of its x, y, radius and blur, px, and of two laws' shares.

    Brightness and the sky's level are unknowns too, at their best for every state.
    """

    def __init__(
        self,
        camera: Camera,
        sun_camera: FloatArray,
        rad_per_px: float,
        corner: IntArray,
        counts: FloatArray,
        use: BoolArray,
        noise: float,
    ) -> None:
        """Counts above the sky (h, w) from a corner (x, y) on, which to use, scatter of the sky."""
        self._camera, self._sun, self._rad_per_px = camera, sun_camera, rad_per_px
        self._corner, self._size = corner, np.array(use.shape[::-1])
        self._use, self._seen, self._noise = use, counts[use], noise

    def _draw(self, state: FloatArray) -> FloatArray:
        ray = self._camera.unproject(state[:2])
        cone = Cone(np.eye(3), ray, float(state[2]) * self._rad_per_px)
        blur, *mixture = (float(value) for value in state[3:])
        # 0.36 px is the smallest blur that `draw_disc` can draw.
        shape = EdgeShape(max(blur, 0.36), (mixture[0], mixture[1]), 1.0, 1.0)
        return draw_disc(self._camera, cone, self._sun, shape, self._corner, self._size)[self._use]

    def linearise(self, state: FloatArray) -> Linearisation:
        """The pixels at a state (6,). Raises NoSolutionError where there is no disc to draw."""
        if not (np.isfinite(state).all() and state[2] > 1.0):
            raise _OTHER_LIGHT.error()
        model = self._draw(state)
        brightness = float(model @ self._seen) / max(float(model @ model), 1e-30)
        light = np.maximum(brightness * model, 0.0)
        bright = float(np.median(light[light > 0.3 * light.max()])) if light.max() > 0.0 else 1.0
        sigma = np.sqrt(self._noise**2 + SHOT * bright * light + (TEXTURE * light) ** 2)
        columns = [brightness * (self._draw(state + s) - model) / s.sum() for s in np.diag(STEPS)]
        jacobian = np.stack(columns, axis=1) / sigma[:, None]
        residuals = (self._seen - brightness * model) / sigma
        # what brightness and level explain is taken out of residuals and Jacobian: the normal
        # equations of all eight unknowns, solved for these two
        known = np.linalg.qr(np.stack([model, np.ones(len(model))], axis=1) / sigma[:, None])[0]
        free = jacobian - known @ (known.T @ jacobian)
        normal, gradient = free.T @ free, free.T @ residuals
        cost = float(residuals @ residuals)
        return Linearisation(normal, gradient, cost, residuals, free, np.ones(len(residuals)))


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
        raise NoSolutionError("the frame cuts the disc or its surroundings", ReasonCode.CUT_DISC)
    part = picture[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]
    values = part.astype(np.float64)
    levels = measure_levels(picture)
    use = np.isfinite(values) if saturation is None else values < saturation
    model = DiscModel(camera, sun_camera, per_px, corner, values - levels.sky, use, levels.noise)
    blur, blur_sigma = blur_prior(camera.known_blur_px)
    expected = np.array([blur, 0.0, 0.0])
    prior = VectorPrior(3, expected, np.array([blur_sigma, MIXTURE_SIGMA, MIXTURE_SIGMA]), 6)
    start = np.concatenate([start, expected])
    fit = solve(
        [model, prior], start, lambda at, step: at + np.clip(step, -MAX_MOVE, MAX_MOVE), ITERATION
    )
    misfit = float(np.sqrt(np.mean(fit.measured.residuals**2)))
    spread = max(misfit, 1.0) ** 2 * fit.covariance[:3, :3]
    if camera.known_blur_px is None:
        sizes = load_disc_sizes()
        moved = fit.state[3] * np.array([sizes.blur_centre, sizes.blur_centre, sizes.blur_shape])
        spread += np.diag(moved**2)
    return DiscFit(fit.state[:2], float(fit.state[2]), spread, misfit)


def rad_per_px(camera: Camera, axis: FloatArray) -> float:
    """Side of the square that a pixel sees about a direction (3,), rad."""
    steps = camera.unproject(camera.project(axis) + np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    return float(np.sqrt(np.linalg.norm(np.cross(steps[1] - steps[0], steps[2] - steps[0]))))
