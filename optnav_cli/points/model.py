"""Picked points as measurements of a pose and of what the lens is off by."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.least_squares import Linearisation, linearised
from optnav_cli.estimation.models.points import Pose, ProjectingCamera, Sightings, predict
from optnav_cli.fix import LensEstimate
from optnav_cli.reasons import ReasonCode


@dataclass(frozen=True)
class LensPrior:
    """Errors of a lens, 1 sigma.

    focal       relative, of the focal length;  centre_px  of the principal point, a coordinate
    middle_px   (2,) the stated principal point
    """

    focal: float
    centre_px: float
    middle_px: FloatArray

    @property
    def sigmas(self) -> FloatArray:
        """(k,) of the numbers that are not exact: factor, then shift along x and y."""
        shift = [self.centre_px] * 2 if self.centre_px > 0.0 else []
        return np.array([self.focal] * (self.focal > 0.0) + shift)


@dataclass(frozen=True)
class LensPose:
    """A pose and an error of the lens: its focal length's factor less 1, and a shift (2,) px."""

    pose: Pose
    focal: float
    shift_px: FloatArray


@dataclass(frozen=True, eq=False)
class PickedSightings:
    """Points that a person picked.

    places_m (n, 3) body frame;  pixels (n, 2);  sigma_px, sigma_m (n,) a coordinate
    """

    places_m: FloatArray
    pixels: FloatArray
    sigma_px: FloatArray
    sigma_m: FloatArray

    def __len__(self) -> int:
        return len(self.places_m)

    def subset(self, some: BoolArray) -> "PickedSightings":
        """Return the points of a mask (n,)."""
        return PickedSightings(
            self.places_m[some], self.pixels[some], self.sigma_px[some], self.sigma_m[some]
        )

    def sightings(self, camera: ProjectingCamera, pose: Pose) -> Sightings:
        """Return sightings with the error of each place as the camera sees it from a pose, px."""
        _, jacobian = predict(camera, pose, self.places_m)
        by_place = jacobian[:, :, :3]
        seen = by_place @ by_place.transpose(0, 2, 1)
        by_pixel = np.eye(2) * (self.sigma_px**2)[:, None, None]
        return Sightings(
            self.places_m, self.pixels, by_pixel + seen * (self.sigma_m**2)[:, None, None]
        )


class LensPoints:
    """Picked points as measurements of a pose and a lens."""

    def __init__(self, camera: ProjectingCamera, seen: Sightings, lens: LensPrior) -> None:
        self._camera, self._seen, self._lens = camera, seen, lens
        self._information = np.linalg.inv(seen.covariances_px2).astype(np.float64)

    def linearise(self, state: LensPose) -> Linearisation:
        """The points at a pose. Raises NoSolutionError for one out of view."""
        pixels, by_pose = predict(self._camera, state.pose, self._seen.points_body_m)
        out = pixels - self._lens.middle_px
        factor = 1.0 + state.focal
        residuals = self._seen.pixels - (self._lens.middle_px + state.shift_px + factor * out)
        if not np.isfinite(residuals).all():
            text = "a point left the camera's view during the iteration"
            raise NoSolutionError(text, ReasonCode.NOT_SETTLED)
        columns = [factor * by_pose]
        if self._lens.focal > 0.0:
            columns.append(out[:, :, None])
        if self._lens.centre_px > 0.0:
            columns.append(np.broadcast_to(np.eye(2), (len(out), 2, 2)))
        return linearised(residuals, np.concatenate(columns, axis=2), self._information)


class LensErrors:
    """The lens as its file states it, as a measurement."""

    def __init__(self, lens: LensPrior) -> None:
        self._lens, self._sigmas = lens, lens.sigmas

    def linearise(self, state: LensPose) -> Linearisation:
        """The lens at a state."""
        numbers = lens_numbers(state, self._lens)
        jacobian = np.eye(6 + numbers.size)[6:]
        return linearised(-numbers, jacobian, self._sigmas**-2)


class StatedAttitude:
    """A measured attitude (camera_from_body) with one sigma an axis, rad."""

    def __init__(self, camera_from_body: Rotation, sigma_rad: float, unknowns: int) -> None:
        self._measured, self._weights = camera_from_body, np.full(3, sigma_rad**-2)
        self._jacobian = np.eye(3, unknowns, 3)

    def linearise(self, state: LensPose) -> Linearisation:
        """The measured turn, seen from the present attitude."""
        offset = (self._measured * state.pose.camera_from_body.inv()).as_rotvec()
        return linearised(offset, self._jacobian, self._weights)


@dataclass(frozen=True)
class AttitudePrior:
    """A stated attitude, camera_from_body, and its sigma an axis, rad, over 0."""

    camera_from_body: Rotation
    sigma_rad: float


def lens_numbers(state: LensPose, lens: LensPrior) -> FloatArray:
    """(k,) as `LensPrior.sigmas`."""
    shift = list(state.shift_px) if lens.centre_px > 0.0 else []
    return np.array([state.focal] * (lens.focal > 0.0) + shift)


def make_lens_estimate(state: LensPose, sigmas: FloatArray, lens: LensPrior) -> LensEstimate | None:
    """Return the lens of a state, sigmas (k,) as `LensPrior.sigmas`; None for an exact one."""
    if not sigmas.size:
        return None
    estimated = LensEstimate()
    if lens.focal > 0.0:
        estimated = LensEstimate(1.0 + state.focal, float(sigmas[0]))
    if not lens.centre_px > 0.0:
        return estimated
    (x, y), (sigma_x, sigma_y) = state.shift_px.tolist(), sigmas[-2:].tolist()
    return replace(estimated, shift_px=(x, y), shift_sigma_px=(sigma_x, sigma_y))


def move_with_lens(state: LensPose, step: FloatArray, lens: LensPrior) -> LensPose:
    """Apply a step (6 + k,) to a state: the pose, then what the lens is solved for."""
    focal, shift, remaining = state.focal, state.shift_px, step[6:]
    if lens.focal > 0.0:
        focal, remaining = focal + float(remaining[0]), remaining[1:]
    if lens.centre_px > 0.0:
        shift = shift + remaining
    return LensPose(state.pose.moved(step[:6]), focal, shift)
