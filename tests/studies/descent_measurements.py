"""Descents at the level of measurements: points seen without pictures, to compare formulations.

Three frames see control points; below, nothing but landmarks. The joint filter keeps what the
landmarks owe to the pose they were placed from; the two others do not, as the method is often told.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import squared_distance
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.navigate.descent.filter import (
    POSITION,
    TRACK,
    DescentFilter,
    TrackErrors,
)

RADIUS_M = 1.7374e6
FROM_M, TO_M, FRAMES, SECONDS = 6.5e3, 2.0e3, 20, 80.0
SPEED_M_S = 700.0, 70.0
RELIEF_M = 150.0  # of the ground about its mean, 1 sigma
ABSOLUTE_FRAMES, CONTROL_POINTS, CONTROL_POINT_M = 3, 6, 10.0
SQUARES, PIXEL_SIGMA = 7, 0.3
GROUND_SIGMA_M = 300.0  # of a landmark's height before it is seen twice
ERRORS = TrackErrors(300.0, 0.8, 0.0, 12.0 * ARCSEC, 0.08 * ARCSEC, 3.0 * ARCSEC)


class Formulation(StrEnum):
    """How landmarks join."""

    JOINT = "joint"  # in one state with the pose
    INDEPENDENT = "independent"  # as points with their own covariance, their ties to the pose cut
    SHIFTED = "shifted"  # the same, with the pose's covariance as a shift common to a frame

    @property
    def label(self) -> str:
        """The name for people."""
        words = {
            Formulation.JOINT: "in one state with the pose",
            Formulation.INDEPENDENT: "as independent points",
            Formulation.SHIFTED: "as points with a common shift",
        }
        return words[self]


@dataclass(frozen=True, eq=False)
class Errors:
    """Of a descent, frame by frame.

    height_m  (n,) over the mean ground
    error_m   (n, 3) along the flight, across, up
    nees      (n,) of the position, a degree of freedom
    """

    height_m: FloatArray
    error_m: FloatArray
    nees: FloatArray


def fly(camera: Camera, formulation: Formulation, seed: int) -> Errors:
    """One descent over drawn ground with drawn errors."""
    rng = np.random.default_rng(seed)
    stated, true = drawn_poses(rng, ERRORS)
    joint = DescentFilter(ERRORS)
    times = np.linspace(0.0, SECONDS, FRAMES)
    landmarks = np.zeros((0, 3))  # the true ground of the filter's points
    errors, nees = np.empty((FRAMES, 3)), np.empty(FRAMES)
    for k, (said, pose) in enumerate(zip(stated, true, strict=True)):
        if k:
            joint.propagate(times[k] - times[k - 1])
        if k < ABSOLUTE_FRAMES:
            points = _ground(rng, camera, pose, rng.uniform(0.1, 0.9, (CONTROL_POINTS, 2)))
            wrong = points + CONTROL_POINT_M * rng.normal(size=points.shape)
            numbers = joint.add_points(wrong, CONTROL_POINT_M**2 * np.eye(3 * len(wrong)))
            joint.update(camera, said, numbers, _seen(rng, camera, pose, points))
            joint.keep(np.arange(joint.count) < joint.count - CONTROL_POINTS)
        else:
            inside = _inside(camera, pose, landmarks)
            joint.keep(inside)
            landmarks = landmarks[inside]
            if len(landmarks):
                seen = _seen(rng, camera, pose, landmarks)
                joint.update(camera, said, np.arange(len(landmarks)), seen)
        landmarks = _with_new(rng, camera, joint, said, pose, landmarks)
        if formulation is not Formulation.JOINT:
            _cut(joint, shifted=formulation is Formulation.SHIFTED)
        off = joint.pose(said).position_m - pose.position_m
        errors[k] = off @ _axes(pose)
        nees[k] = squared_distance(off, joint.covariance[POSITION, POSITION]) / 3.0
    heights = np.array([float(np.linalg.norm(pose.position_m)) - RADIUS_M for pose in true])
    return Errors(heights, errors, nees)


def drawn_poses(rng: np.random.Generator, errors: TrackErrors) -> tuple[list[Pose], list[Pose]]:
    """What the track states and what is true."""
    times = np.linspace(0.0, SECONDS, FRAMES)
    share = times / SECONDS
    along = SECONDS * (SPEED_M_S[0] * share + (SPEED_M_S[1] - SPEED_M_S[0]) * share**2 / 2.0)
    heights = FROM_M + (TO_M - FROM_M) * share
    place, velocity, bias, drift = (
        sigma * rng.normal(size=3)
        for sigma in (
            errors.position_m,
            errors.velocity_m_s,
            errors.attitude_rad,
            errors.attitude_drift_rad_s,
        )
    )
    stated, true = [], []
    for time, far, height in zip(times, along, heights, strict=True):
        angle = far / RADIUS_M
        up = np.array([np.cos(angle), np.sin(angle), 0.0])
        forward = np.array([-np.sin(angle), np.cos(angle), 0.0])
        turn = Rotation.from_matrix(np.stack([np.cross(forward, up), -forward, -up]))
        pose = Pose((RADIUS_M + height) * up, turn)
        noise = errors.attitude_noise_rad * rng.normal(size=3)
        off = Rotation.from_rotvec(bias + drift * time + noise)
        true.append(pose)
        stated.append(Pose(pose.position_m - place - velocity * time, off.inv() * turn))
    return stated, true


def _axes(pose: Pose) -> FloatArray:
    """(3, 3) columns: along the flight, across it, up."""
    up = pose.position_m / np.linalg.norm(pose.position_m)
    forward = np.cross([0.0, 0.0, 1.0], up)
    return np.stack([forward, [0.0, 0.0, 1.0], up], axis=1)


def _on_sphere(pose: Pose, rays: FloatArray, radius_m: FloatArray) -> FloatArray:
    """Where rays (n, 3), body frame, meet spheres (n,)."""
    along = rays @ pose.position_m
    away = -along - np.sqrt(along**2 - pose.position_m @ pose.position_m + radius_m**2)
    points: FloatArray = pose.position_m + away[:, None] * rays
    return points


def _ground(rng: np.random.Generator, camera: Camera, pose: Pose, shares: FloatArray) -> FloatArray:
    """True ground (n, 3) at places (n, 2) of the picture, as shares of its sides."""
    pixels = shares * [camera.width_px - 1, camera.height_px - 1]
    rays = camera.unproject(pixels) @ pose.camera_from_body.as_matrix()
    return _on_sphere(pose, rays, RADIUS_M + RELIEF_M * rng.normal(size=len(pixels)))


def _seen(rng: np.random.Generator, camera: Camera, pose: Pose, points: FloatArray) -> Sightings:
    pixels, _ = predict(camera, pose, points)
    noise = PIXEL_SIGMA * rng.normal(size=pixels.shape)
    return Sightings(
        points, pixels + noise, np.tile(PIXEL_SIGMA**2 * np.eye(2), (len(points), 1, 1))
    )


def _inside(camera: Camera, pose: Pose, points: FloatArray) -> BoolArray:
    if len(points) == 0:
        return np.zeros(0, dtype=bool)
    pixels, _ = predict(camera, pose, points)
    return np.asarray(camera.contains(pixels), dtype=bool)


def _with_new(
    rng: np.random.Generator,
    camera: Camera,
    joint: DescentFilter,
    said: Pose,
    pose: Pose,
    landmarks: FloatArray,
) -> FloatArray:
    """Landmarks with a new one in each square of the picture that has none."""
    sides = np.array([camera.width_px, camera.height_px])
    taken = np.zeros((SQUARES, SQUARES), dtype=bool)
    if len(landmarks):
        at = (predict(camera, pose, landmarks)[0] / sides * SQUARES).astype(int)
        taken[tuple(np.clip(at, 0, SQUARES - 1).T)] = True
    free = np.argwhere(~taken)
    if len(free) == 0:
        return landmarks
    fresh = _ground(rng, camera, pose, (free + rng.uniform(0.2, 0.8, free.shape)) / SQUARES)
    seen = _seen(rng, camera, pose, fresh)
    expected = joint.pose(said)
    rays = camera.unproject(seen.pixels) @ expected.camera_from_body.as_matrix()
    places = _on_sphere(expected, rays, np.full(len(rays), RADIUS_M))
    sigmas = np.full(len(rays), GROUND_SIGMA_M)
    joint.add_sighted(camera, said, places, seen.covariances_px2, sigmas)
    return np.concatenate([landmarks, fresh])


def _cut(joint: DescentFilter, *, shifted: bool) -> None:
    """Take the ties between landmarks and pose, and among landmarks, out of the covariance."""
    whole = joint.covariance
    cut = np.zeros_like(whole)
    cut[:TRACK, :TRACK] = whole[:TRACK, :TRACK]
    for number in range(joint.count):
        own = slice(TRACK + 3 * number, TRACK + 3 * number + 3)
        cut[own, own] = whole[own, own]
    if shifted and joint.count:
        # every landmark is moved alike by the pose's error, which is tied to nothing else
        common = whole[POSITION, POSITION]
        ties = np.kron(np.ones((joint.count, joint.count)) - np.eye(joint.count), common)
        cut[TRACK:, TRACK:] += 0.999 * ties
        smallest = float(np.linalg.eigvalsh(cut[TRACK:, TRACK:])[0])
        if smallest < 0.0:
            cut[TRACK:, TRACK:] += (1e-6 - smallest) * np.eye(3 * joint.count)
    joint.covariance = cut
