"""A camera's lens by pictures of a plane grid of dots, each taken from somewhere.

A plane seen straight on looks the same through another lens from another distance, and its sideways
shift like another principal point with another turn: so every number has a prior of what lenses may
be, and what the pictures tell no more of than that is named.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.least_squares import (
    Iteration,
    Linearisation,
    Model,
    VectorPrior,
    linearised,
    solve,
)
from optnav_cli.estimation.models.common import Common, CommonNumber
from optnav_cli.reasons import Reason, ReasonCode

FOCAL, CENTRE, K1, K2, LENS = 0, 1, 3, 4, 5
FOCAL_SIDES = np.geomspace(
    0.4, 40.0, 25
)  # of the longer side, that a fit begins at: 103 to 1.4 deg
# Priors, 1 sigma: logarithm of the focal length, principal point as a share of the longer side from
# the middle of the picture, radial terms.
FOCAL_SIGMA, CENTRE_SHARE, RADIAL_SIGMA = 1.0, 0.05, (0.3, 0.3)
HELD = 1e-7  # the sigma of a number that is not solved for, in its own unit
DOT_PX = 0.05  # error of a dot's middle to begin with; then that of the residuals
LEAST_DOT_PX = 0.015  # a tilted disc's middle is not the middle of its picture
MAX_RMS_PX = 1.0  # of residuals: beyond it no plane, not evenly spaced, or another lens
MAX_FOCAL_SIGMA = 0.1  # relative: beyond it there is no camera to write
ITERATION = Iteration(
    max_steps=200,
    settled_sigmas=1e-3,
    undetermined=Reason(ReasonCode.DEGENERATE, "the grids leave a number of the lens open"),
    unsettled=Reason(ReasonCode.NOT_SETTLED, "the fit of the lens to the grids does not settle"),
    damped=True,
)


@dataclass(frozen=True, eq=False)
class GridView:
    """A picture's dots: pixels (n, 2), and columns and rows (n, 2)."""

    pixels: FloatArray
    places: IntArray


@dataclass(frozen=True)
class GridDistance:
    """From the lens to the middle of the grid in the first picture, measured, and its 1 sigma."""

    value_mm: float
    sigma_mm: float


@dataclass(frozen=True, eq=False)
class GridCalibration:
    """A lens and where the grids stood.

    numbers      of the lens, with their priors: focal length (relative), principal point, k1, k2
    covariance   (k, k) of these numbers
    before, after  (n, 2) residuals a picture, px: of a pinhole of the start, and of the solution
    distances_mm, tilts_deg  of each grid: of its middle, and from facing the camera
    focal_distance  correlation of the focal length with the distance of the first grid
    distance_misfit  of a measured distance, in sigmas; None without one
    """

    camera: Camera
    numbers: tuple[CommonNumber, ...]
    covariance: FloatArray
    sigma_px: float
    before: list[FloatArray]
    after: list[FloatArray]
    distances_mm: FloatArray
    tilts_deg: FloatArray
    focal_distance: float
    distance_misfit: float | None

    @property
    def focal_error(self) -> float:
        """Relative error of the focal length, 1 sigma."""
        return float(np.sqrt(self.covariance[0, 0]))


class GridModel:
    """Pixels of the dots of one picture; state: ln f, principal point, k1, k2, then six a picture.

    Its six are the rotation vector and the place of the grid, as OpenCV has them, mm.
    """

    def __init__(self, view: GridView, spacing_mm: float, number: int, pictures: int) -> None:
        middle = 0.5 * (view.places.min(axis=0) + view.places.max(axis=0))
        self.points = np.zeros((len(view.places), 3))
        self.points[:, :2] = (view.places - middle) * spacing_mm
        self.pixels = view.pixels
        self.first, self._unknowns = LENS + 6 * number, LENS + 6 * pictures
        self.variance = DOT_PX**2

    def linearise(self, state: FloatArray) -> Linearisation:
        """Linearise by OpenCV's derivatives."""
        pose = state[self.first : self.first + 6]
        matrix, terms = _build_opencv_lens(state)
        projected, jacobian = cv2.projectPoints(self.points, pose[:3], pose[3:], matrix, terms)[:2]
        jacobian_of_all = np.zeros((2 * len(self.pixels), self._unknowns))
        jacobian_of_all[:, self.first : self.first + 6] = jacobian[:, :6]
        jacobian_of_all[:, FOCAL] = jacobian[:, 6:8] @ np.full(2, matrix[0, 0])
        jacobian_of_all[:, CENTRE : CENTRE + 2] = jacobian[:, 8:10]
        jacobian_of_all[:, [K1, K2]] = jacobian[:, 10:12]
        residuals = (self.pixels - projected.reshape(-1, 2)).ravel()
        return linearised(residuals, jacobian_of_all, np.full(residuals.size, 1.0 / self.variance))

    def solve_pose(self, focal_px: float, centre: FloatArray) -> tuple[float, FloatArray]:
        """Solve the pose (6,) of a pinhole; return the squared residuals, too."""
        matrix = np.array([[focal_px, 0.0, centre[0]], [0.0, focal_px, centre[1]], [0.0, 0.0, 1.0]])
        done, turn, translation = cv2.solvePnP(
            self.points, self.pixels, matrix, np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
        if not done or not translation[2, 0] > 0.0:
            return np.inf, np.zeros(6)
        seen = cv2.projectPoints(self.points, turn, translation, matrix, np.zeros(4))[0].reshape(
            -1, 2
        )
        cost = float(np.sum((seen - self.pixels) ** 2))
        return cost, np.concatenate([turn.ravel(), translation.ravel()])


class DistanceModel:
    """A measured distance of the middle of the first grid."""

    def __init__(self, distance: GridDistance, unknowns: int) -> None:
        self._distance, self._unknowns = distance, unknowns

    def linearise(self, state: FloatArray) -> Linearisation:
        """Linearise the measurement at a state."""
        translation = state[LENS + 3 : LENS + 6]
        length = float(np.linalg.norm(translation))
        jacobian = np.zeros((1, self._unknowns))
        jacobian[0, LENS + 3 : LENS + 6] = translation / length
        off = np.array([self._distance.value_mm - length])
        return linearised(off, jacobian, np.array([self._distance.sigma_mm**-2.0]))


def calibrate_by_grids(
    blank: Camera,
    views: Sequence[GridView],
    spacing_mm: float,
    kinds: Sequence[Common],
    distance: GridDistance | None = None,
) -> GridCalibration:
    """Fit the lens to the dots of pictures.

    blank  a camera with the name and the size of the pictures
    kinds  what to solve for: FOCAL, CENTRE, DISTORTION; the others stay as their priors have them

    Raises NoSolutionError where the dots are not those of an even, plane grid, or leave the focal
    length open by over 10 %.
    """
    models = [GridModel(view, spacing_mm, n, len(views)) for n, view in enumerate(views)]
    start = _start_state(models, blank, distance)
    sigmas = _compute_prior_sigmas(blank, kinds)
    priors: list[Model[FloatArray]] = [VectorPrior(0, start[:LENS], sigmas, len(start))]
    if distance is not None:
        priors.append(DistanceModel(distance, len(start)))
    before = [model.linearise(start).residuals.reshape(-1, 2) for model in models]
    estimate = solve([*models, *priors], start, np.add, ITERATION)
    for _ in range(2):  # residuals tell how well dots are placed
        after = [model.linearise(estimate.state).residuals.reshape(-1, 2) for model in models]
        count = 2 * sum(len(part) for part in after)
        total = sum(float(np.sum(part**2)) for part in after)
        variance = total / max(count - len(start), 1)
        for model in models:
            model.variance = max(variance, LEAST_DOT_PX**2)
        estimate = solve([*models, *priors], estimate.state, np.add, ITERATION)
    rms = np.sqrt(total / count)
    if rms > MAX_RMS_PX:
        raise NoSolutionError(
            f"the dots are off by {rms:.1f} px rms from those of a plane grid of even spacing "
            "through any lens: wanted round dots as far apart in rows as in columns, on a flat "
            "sheet",
            ReasonCode.POINTS_DISAGREE,
        )
    numbers = _list_numbers(blank.name, sigmas, kinds)
    chosen = [number for number, sigma in enumerate(sigmas) if sigma > HELD]
    covariance = estimate.covariance
    if FOCAL in chosen and not np.sqrt(covariance[FOCAL, FOCAL]) < MAX_FOCAL_SIGMA:
        raise NoSolutionError(
            "the focal length is open: a grid that is seen straight on looks the same through "
            "another lens from another distance; tilt it by 20 to 40 deg, take several pictures, "
            "or measure its distance and give --distance-mm",
            ReasonCode.DEGENERATE,
        )
    poses = estimate.state[LENS:].reshape(-1, 6)
    normals = np.array([cv2.Rodrigues(pose[:3])[0][:, 2] for pose in poses])
    return GridCalibration(
        _make_camera(blank, estimate.state, covariance, kinds),
        numbers,
        covariance[np.ix_(chosen, chosen)],
        float(np.sqrt(models[0].variance)),
        before,
        after,
        np.linalg.norm(poses[:, 3:], axis=1),
        np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0.0, 1.0))),
        _correlate_focal_distance(covariance, estimate.state),
        _compute_misfit(distance, estimate.state, covariance),
    )


def _build_opencv_lens(state: FloatArray) -> tuple[FloatArray, FloatArray]:
    focal = float(np.exp(state[FOCAL]))
    x, y = state[CENTRE : CENTRE + 2]
    matrix = np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])
    return matrix, np.array([state[K1], state[K2], 0.0, 0.0, 0.0])


def _start_state(
    models: Sequence[GridModel], blank: Camera, distance: GridDistance | None
) -> FloatArray:
    """Start at the pinhole of least residuals, about the middle of the picture."""
    centre = 0.5 * np.array([blank.width_px - 1.0, blank.height_px - 1.0])
    best, state = np.inf, np.empty(0)
    for sides in FOCAL_SIDES:
        focal = float(sides * max(blank.shape))
        poses = [model.solve_pose(focal, centre) for model in models]
        cost = sum(part for part, _ in poses)
        if distance is not None and np.isfinite(cost):
            # what the dots leave open, the distance tells: within a tenth
            share = np.log(np.linalg.norm(poses[0][1][3:]) / distance.value_mm)
            cost += float((share / 0.1) ** 2)
        if cost < best:
            best = cost
            lens = [np.log(focal), *centre, 0.0, 0.0]
            state = np.concatenate([lens, *(pose for _, pose in poses)])
    if not state.size:
        raise ITERATION.undetermined.error()
    return state


def _compute_prior_sigmas(blank: Camera, kinds: Sequence[Common]) -> FloatArray:
    """Return prior sigmas (LENS,) of the numbers of the lens; HELD for what is not solved for."""
    sigmas = np.full(LENS, HELD)
    if Common.FOCAL in kinds:
        sigmas[FOCAL] = FOCAL_SIGMA
    if Common.CENTRE in kinds:
        sigmas[CENTRE : CENTRE + 2] = CENTRE_SHARE * max(blank.shape)
    if Common.DISTORTION in kinds:
        sigmas[[K1, K2]] = RADIAL_SIGMA
    return sigmas


def _list_numbers(
    camera: str, sigmas: FloatArray, kinds: Sequence[Common]
) -> tuple[CommonNumber, ...]:
    names = (
        (Common.FOCAL, ""),
        (Common.CENTRE, "x"),
        (Common.CENTRE, "y"),
        (Common.DISTORTION, "k1"),
        (Common.DISTORTION, "k2"),
    )
    return tuple(
        CommonNumber(kind, axis, camera, float(sigma))
        for (kind, axis), sigma in zip(names, sigmas, strict=True)
        if kind in kinds
    )


def _make_camera(
    blank: Camera, state: FloatArray, covariance: FloatArray, kinds: Sequence[Common]
) -> Camera:
    """Make the camera found, with the errors of its focal length and principal point."""
    bent = Common.DISTORTION in kinds
    sigmas = np.sqrt(np.diag(covariance)[: CENTRE + 2])
    return Camera(
        blank.name,
        "pinhole",
        blank.width_px,
        blank.height_px,
        float(np.exp(state[FOCAL])),
        (float(state[CENTRE]), float(state[CENTRE + 1])),
        "brown" if bent else "none",
        (float(state[K1]), float(state[K2]), 0.0, 0.0, 0.0) if bent else (),
        focal_length_error=float(sigmas[FOCAL]),
        principal_point_error_px=float(np.sqrt(np.mean(sigmas[CENTRE:] ** 2))),
    )


def _differentiate_distance(state: FloatArray) -> FloatArray:
    """Return the derivative (k,) of the distance of the first grid."""
    row = np.zeros(len(state))
    translation = state[LENS + 3 : LENS + 6]
    row[LENS + 3 : LENS + 6] = translation / np.linalg.norm(translation)
    return row


def _correlate_focal_distance(covariance: FloatArray, state: FloatArray) -> float:
    row = _differentiate_distance(state)
    both = np.sqrt(covariance[FOCAL, FOCAL] * (row @ covariance @ row))
    return float(row @ covariance[FOCAL] / both) if both > 0.0 else 0.0


def _compute_misfit(
    distance: GridDistance | None, state: FloatArray, covariance: FloatArray
) -> float | None:
    """Compute the residual of a measured distance over its sigma, less what the fit takes up."""
    if distance is None:
        return None
    row = _differentiate_distance(state)
    left = distance.sigma_mm**2 - float(row @ covariance @ row)
    off = distance.value_mm - float(np.linalg.norm(state[LENS + 3 : LENS + 6]))
    # nothing is left where the distance alone tells the focal length
    return off / np.sqrt(left) if left > (1e-3 * distance.sigma_mm) ** 2 else 0.0
