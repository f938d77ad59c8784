"""Resection: the camera's position, and attitude where wanted, from known points in a picture.

The geometry is r_i = R + L_i T e_i of Zhukov (2025), ch. 3; here it is solved in the picture, by
Gauss-Newton on pixel residuals, so that any camera model and any pixel covariance fit in. With
the attitude known three numbers are sought, otherwise six: a star sensor's sigma then enters as a
measurement of zero rotation, and a free attitude has none.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import cross_matrix
from optnav_cli.reasons import ReasonCode

MAX_ITERATIONS = 30
# A step below this share of its own sigma changes nothing that matters.
STEP_SIGMAS = 1e-4


class ProjectingCamera(Protocol):
    """What resection needs of a camera."""

    def project_with_jacobian(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) of camera-frame points (n, 3), and d pixel / d point (n, 2, 3)."""
        ...


@dataclass(frozen=True)
class Pose:
    """Where a camera is and how it is turned: body-fixed position, m, and camera_from_body."""

    position_m: FloatArray
    camera_from_body: Rotation


@dataclass(frozen=True)
class Sightings:
    """Points seen: body-fixed places, the pixels where they were found, their covariances.

    points_body_m (n, 3), pixels (n, 2), covariances_px2 (n, 2, 2)
    """

    points_body_m: FloatArray
    pixels: FloatArray
    covariances_px2: FloatArray

    def __len__(self) -> int:
        return len(self.points_body_m)

    def subset(self, index: IndexArray | BoolArray) -> "Sightings":
        """The sightings that an index array or mask picks."""
        return Sightings(self.points_body_m[index], self.pixels[index], self.covariances_px2[index])


@dataclass(frozen=True)
class Resection:
    """A solved pose with what is known of its errors.

    covariance        (3, 3) of position, m^2, body frame, or (6, 6) with the rotation vector
                      (rad, camera frame) behind it
    residuals_px      (n, 2) measured less predicted
    normalised        (n,) squared residuals in units of their covariance, expectation about 2
    degrees_of_freedom  measurements less unknowns, an attitude prior counted as a measurement
    """

    pose: Pose
    covariance: FloatArray
    residuals_px: FloatArray
    normalised: FloatArray
    degrees_of_freedom: int

    @property
    def position_covariance_m2(self) -> FloatArray:
        """(3, 3) covariance of the position, body frame."""
        return self.covariance[:3, :3]

    @property
    def attitude_sigma_rad(self) -> float:
        """One-sigma attitude error per axis, root mean square over the axes; 0 when held exact."""
        if self.covariance.shape[0] == 3:
            return 0.0
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


def predict(
    camera: ProjectingCamera, pose: Pose, points_body_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of body-fixed points, and their Jacobian (n, 2, 6).

    The six columns are the position (m) and a rotation vector in the camera frame (rad) applied
    after camera_from_body.
    """
    turn = pose.camera_from_body.as_matrix()
    points_camera = (points_body_m - pose.position_m) @ turn.T
    pixels, by_point = camera.project_with_jacobian(points_camera)
    by_position = -by_point @ turn
    # exp(w) p = p + w x p = p - [p]x w
    by_rotation = -by_point @ cross_matrix(points_camera)
    return pixels, np.concatenate([by_position, by_rotation], axis=-1)


def moved(pose: Pose, step: FloatArray) -> Pose:
    """A pose after a step (3,) or (6,) in the unknowns of `predict`."""
    turn = pose.camera_from_body
    if step.size == 6:
        turn = Rotation.from_rotvec(step[3:]) * turn
    return Pose(pose.position_m + step[:3], turn)


def resect(
    camera: ProjectingCamera,
    sightings: Sightings,
    start: Pose,
    attitude_sigma_rad: float | None,
    *,
    measured_attitude: Rotation | None = None,
) -> Resection:
    """Solve for the pose that explains the sightings best.

    start               first guess; its position is never a measurement
    attitude_sigma_rad  0: the attitude is exact; None: free; else the sigma per axis of
                        `measured_attitude` (camera_from_body; the start's when not given)

    Raises NoSolutionError for too few sightings, degenerate geometry or no convergence.
    """
    fixed = attitude_sigma_rad == 0.0
    unknowns = 3 if fixed else 6
    prior_count = 0 if fixed or attitude_sigma_rad is None else 3
    count = 2 * len(sightings) + prior_count
    if count < unknowns or len(sightings) < 2:
        raise NoSolutionError(
            f"{len(sightings)} control points are too few for {unknowns} unknowns",
            ReasonCode.FEW_POINTS,
        )
    information: FloatArray = np.linalg.inv(sightings.covariances_px2).astype(np.float64)
    reference = start.camera_from_body if measured_attitude is None else measured_attitude
    pose = start
    cost = np.inf
    damping = 0.0
    for _ in range(MAX_ITERATIONS):
        residuals, normal, gradient = _normal_equations(
            camera, sightings, information, pose, unknowns
        )
        if prior_count and attitude_sigma_rad is not None:
            # the measured turn, seen from the present attitude, in the camera frame
            offset = (reference * pose.camera_from_body.inv()).as_rotvec()
            normal[3:, 3:] += np.eye(3) / attitude_sigma_rad**2
            gradient[3:] += offset / attitude_sigma_rad**2
        new_cost = _cost(residuals, information)
        if new_cost > 4.0 * cost and damping < 1e3:
            damping = max(10.0 * damping, 1e-3)
        cost = new_cost
        covariance = _inverse(normal)
        damped = normal + damping * np.diag(np.diag(normal))
        step: FloatArray = np.linalg.solve(damped, gradient).astype(np.float64)
        pose = moved(pose, step)
        if np.max(np.abs(step) / np.sqrt(np.diag(covariance))) < STEP_SIGMAS and damping < 1.0:
            break
        damping *= 0.1
    else:
        raise NoSolutionError(
            f"the position did not settle in {MAX_ITERATIONS} iterations", ReasonCode.NOT_SETTLED
        )
    residuals, _, _ = _normal_equations(camera, sightings, information, pose, unknowns)
    stated = np.linalg.inv(sightings.covariances_px2)
    normalised = np.einsum("ni,nij,nj->n", residuals, stated, residuals)
    return Resection(pose, covariance, residuals, normalised, count - unknowns)


def _normal_equations(
    camera: ProjectingCamera,
    sightings: Sightings,
    information: FloatArray,
    pose: Pose,
    unknowns: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    pixels, jacobian = predict(camera, pose, sightings.points_body_m)
    residuals = sightings.pixels - pixels
    if not np.isfinite(residuals).all():
        raise NoSolutionError(
            "a control point left the camera's view during the iteration", ReasonCode.NOT_SETTLED
        )
    jacobian = jacobian[:, :, :unknowns]
    weighted = np.einsum("nik,nij->nkj", jacobian, information)
    normal = np.einsum("nkj,njl->kl", weighted, jacobian)
    gradient = np.einsum("nkj,nj->k", weighted, residuals)
    return residuals, normal, gradient


def _cost(residuals: FloatArray, information: FloatArray) -> float:
    return float(np.einsum("ni,nij,nj->", residuals, information, residuals))


def _inverse(normal: FloatArray) -> FloatArray:
    """Inverse of a normal matrix whose unknowns differ by orders of magnitude."""
    scale = np.sqrt(np.diag(normal))
    if not (np.isfinite(scale).all() and (scale > 0.0).all()):
        raise NoSolutionError("the control points do not fix all unknowns", ReasonCode.DEGENERATE)
    balanced = normal / np.outer(scale, scale)
    if np.linalg.cond(balanced) > 1e13:
        raise NoSolutionError(
            "the control points do not fix all unknowns (degenerate geometry)",
            ReasonCode.DEGENERATE,
        )
    return np.asarray(np.linalg.inv(balanced) / np.outer(scale, scale))
