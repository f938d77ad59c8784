"""Routes at measurement level: what a calibration is given, and what is true.

A camera whose lens, mounting and clock are not as stated flies over control points that err, with
positions by satellites and attitudes by star sensors that err as well.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.geometry.rotations import ARCSEC
from optnav_cli.calibration.adjustment import AdjustedFrame
from optnav_cli.calibration.model import estimate_frame_motions, propagate_ground_errors
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.common import Common, CommonState, common_numbers
from optnav_cli.estimation.models.points import Pose, Sightings, predict

RADIUS_M, GM_M3_S2 = 1_737_400.0, 4.902800118e12  # of the Moon
KINDS = (Common.FOCAL, Common.CENTRE, Common.DISTORTION, Common.MOUNTING, Common.CLOCK)
# how far the lens is off: share, px, 1, rad, s
OFF = {
    Common.FOCAL: 3e-3,
    Common.CENTRE: 8.0,
    Common.DISTORTION: 0.01,
    Common.MOUNTING: 200.0 * ARCSEC,
    Common.CLOCK: 0.08,
}
STRIP = 1.3  # of the seen width, over which control points lie


@dataclass(frozen=True)
class Route:
    """A route of frames.

    heights_km  of the passes, which share the frames
    rolled      whether the camera is turned about its boresight from frame to frame
    points      control points in view of a frame; lost: share of them under clouds
    """

    camera: Camera
    frames: int = 100
    heights_km: tuple[float, ...] = (200.0,)
    rolled: bool = False
    points: int = 60
    lost: float = 0.0
    spacing_s: float = 20.0
    pixel_sigma_px: float = 0.15
    point_sigma_m: float = 10.0
    position_sigma_m: float = 10.0
    attitude_sigma_arcsec: float = 10.0


def simulated_route(route: Route, seed: int) -> tuple[list[AdjustedFrame], CommonState]:
    """The frames of a route as an adjustment takes them, and the true numbers of the camera."""
    rng = np.random.default_rng(seed)
    name = route.camera.name
    numbers = common_numbers(KINDS, [name], RADIUS_M)
    signs = rng.choice([-1.0, 1.0], len(numbers))
    truth = CommonState(numbers, signs * np.array([OFF[n.kind] for n in numbers]))
    frames: list[AdjustedFrame] = []
    shares = np.array_split(np.arange(route.frames), len(route.heights_km))
    first_point = 0
    for number, (height_km, share) in enumerate(zip(route.heights_km, shares, strict=True)):
        orbit = _Orbit.of(height_km, rng)
        times = route.spacing_s * np.arange(len(share))
        ground = _control_points(route, orbit, times[-1] if len(times) else 0.0, height_km, rng)
        stated = [orbit.position_m(t) for t in times]
        stated = [place + rng.normal(0.0, route.position_sigma_m, 3) for place in stated]
        motions = estimate_frame_motions([1e5 * number + t for t in times], stated)
        for time_s, place_m, motion in zip(times, stated, motions, strict=True):
            roll = rng.uniform(-np.pi, np.pi) if route.rolled else 0.0
            frame = _frame(route, orbit, float(time_s), roll, ground, truth, rng)
            frame = replace(
                frame,
                points=frame.points + first_point,
                position_m=place_m,
                start=Pose(place_m, frame.start.camera_from_body),
                motion=motion,
            )
            frames.append(_with_ground_errors(frame, route.point_sigma_m))
        first_point += len(ground[0])
    return frames, truth


@dataclass(frozen=True, eq=False)
class _Orbit:
    """A circular orbit: axes (3, 3) up, forward and across at the start; m, rad/s."""

    axes: FloatArray
    radius_m: float
    rate: float

    @classmethod
    def of(cls, height_km: float, rng: np.random.Generator) -> "_Orbit":
        radius = RADIUS_M + 1e3 * height_km
        turn = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
        return cls(turn, radius, float(np.sqrt(GM_M3_S2 / radius**3)))

    def level(self, time_s: float) -> FloatArray:
        """(3, 3) rows up, forward, across at a time."""
        c, s = np.cos(self.rate * time_s), np.sin(self.rate * time_s)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        found: FloatArray = turn @ self.axes
        return found

    def position_m(self, time_s: float) -> FloatArray:
        """(3,) body frame."""
        found: FloatArray = self.radius_m * self.level(time_s)[0]
        return found

    def attitude(self, time_s: float, roll: float) -> Rotation:
        """Looking down, the picture's top forward, then turned about the boresight."""
        up, forward, across = self.level(time_s)
        level = Rotation.from_matrix(np.stack([-across, -forward, -up]))
        return Rotation.from_rotvec([0.0, 0.0, roll]) * level


def _control_points(
    route: Route, orbit: _Orbit, seconds: float, height_km: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Places (n, 3) of the control points of a pass as the catalog has them, and true ones, m."""
    camera = route.camera
    width = 1e3 * height_km * camera.width_px / camera.focal_length_px / RADIUS_M  # rad
    reach = STRIP * width
    along = orbit.rate * seconds + 2.0 * reach
    count = int(route.points * along * 2.0 * reach / width**2)
    forward = rng.uniform(-reach, along - reach, count)
    aside = rng.uniform(-reach, reach, count)
    local = np.stack(
        [np.cos(aside) * np.cos(forward), np.cos(aside) * np.sin(forward), np.sin(aside)], axis=1
    )
    heights = rng.normal(0.0, 1000.0, count)  # relief
    stated = (RADIUS_M + heights)[:, None] * (local @ orbit.axes)
    return stated, stated + rng.normal(0.0, route.point_sigma_m, stated.shape)


def _frame(
    route: Route,
    orbit: _Orbit,
    time_s: float,
    roll: float,
    ground: tuple[FloatArray, FloatArray],
    truth: CommonState,
    rng: np.random.Generator,
) -> AdjustedFrame:
    """A frame without its stated position: what it sees, and its stated attitude."""
    camera, sigma = route.camera, route.attitude_sigma_arcsec * ARCSEC
    stated, real = ground
    late = time_s + truth.clock_s(camera.name)
    mounting = truth.boresight(camera.name)
    pose = Pose(orbit.position_m(late), mounting * orbit.attitude(late, roll))
    lens = truth.lens(camera)
    far = real @ pose.position_m > 0.9 * RADIUS_M * float(np.linalg.norm(pose.position_m))
    pixels, _ = predict(lens, pose, real[far])
    inside = camera.contains(pixels, 5.0)
    chosen = np.flatnonzero(far)[inside]
    kept = rng.random(len(chosen)) >= route.lost
    measured = pixels[inside][kept]
    measured = measured + rng.normal(0.0, route.pixel_sigma_px, measured.shape)
    covariances = np.tile(np.eye(2) * route.pixel_sigma_px**2, (len(measured), 1, 1))
    said = orbit.attitude(time_s, roll)
    said = Rotation.from_rotvec(rng.normal(0.0, sigma, 3)) * said
    return AdjustedFrame(
        camera,
        Sightings(stated[chosen[kept]], measured, covariances),
        chosen[kept],
        Pose(orbit.position_m(time_s), said),
        position_sigma_m=route.position_sigma_m,
        attitude=said,
        attitude_sigma_rad=sigma,
    )


def _with_ground_errors(frame: AdjustedFrame, sigma_m: float) -> AdjustedFrame:
    """The frame whose sightings' covariances hold the control points' own errors."""
    seen = frame.sightings
    more = propagate_ground_errors(frame.camera, frame.start, seen.points_body_m, sigma_m)
    return replace(frame, sightings=replace(seen, covariances_px2=seen.covariances_px2 + more))
