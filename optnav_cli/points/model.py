"""Picked points as measurements of a pose and the lens's error, and what they leave open.

Places beyond the horizon of a body that is no sphere and has relief are told here, too.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.least_squares import Estimate, Linearisation, linearised
from optnav_cli.estimation.models.points import Pose, ProjectingCamera, Sightings, predict
from optnav_cli.fix import LensEstimate
from optnav_cli.reasons import ReasonCode

ROOM = 0.5  # of the points' difference in height: ground between them lies lower than the lowest
MIN_BLOCKING = 0.1  # of the semi-axes: points with more relief than that tell no horizon
SIDE = 17  # places of the grid along either axis
REACH_SIGMAS = 4.0  # of the first grid, beyond the best pose and beyond its mirror image
LIKELY = 14.0  # a cost that is higher by so much has a likelihood of 0.1 %
ENOUGH, ZOOMS = 0.1, 4  # a grid is fine enough when so many of its places are likely
ROUNDS = 3  # of solving for the others, by derivatives that hardly change over the grid


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


def is_hidden(position_m: ArrayLike, places_m: FloatArray, radii_m: ArrayLike) -> BoolArray:
    """Find the places that a camera could see through the ground only.

    position_m  (3,) of the camera, m, body frame
    places_m    (n, 3) of the points, m, body frame, at least one
    radii_m     (3,) semi-axes of the body's ellipsoid, m

    Returns (n,).
    """
    radii = np.asarray(radii_m, dtype=np.float64)
    eye, points = np.asarray(position_m, np.float64) / radii, places_m / radii
    heights = np.linalg.norm(points, axis=1)
    lowest = heights.min()
    blocking = max(lowest - ROOM * (heights.max() - lowest), MIN_BLOCKING)
    # the nearest the line of sight, from the point to the camera, comes to the centre
    sights = eye - points
    lengths = np.einsum("ni,ni->n", sights, sights)
    along = -np.einsum("ni,ni->n", sights, points) / np.maximum(lengths, np.finfo(float).tiny)
    nearest = points + np.clip(along, 0.0, 1.0)[:, None] * sights
    hidden: BoolArray = np.linalg.norm(nearest, axis=1) < blocking * (1.0 - 1e-12)
    return hidden


@dataclass(frozen=True, eq=False)
class PickedLikelihood:
    """The cost of poses near the best one, from points that are all used."""

    camera: ProjectingCamera
    points: PickedSightings
    lens: LensPrior
    best: Estimate[LensPose]

    def covariance(self, mirror: Pose) -> FloatArray:
        """Return the mean square (k, k) of likely steps from the best pose, in the fit's unknowns.

        mirror  the pose with the lean to the other side, from which the points are seen nearly so
        """
        stated = self.best.covariance[:3, :3]
        weak = np.linalg.eigh(stated)[1][:, 1:]
        to_mirror = mirror.position_m - self.best.state.pose.position_m
        middle = 0.5 * to_mirror @ weak
        half = np.abs(middle) + REACH_SIGMAS * np.sqrt(np.diag(weak.T @ stated @ weak))
        basis, inner = self._split_unknowns(weak)
        line = np.linspace(-1.0, 1.0, SIDE)
        grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        for _ in range(ZOOMS + 1):
            places = middle + grid * half
            steps, costs = self._solve_at(places @ weak.T, basis, inner)
            likely = places[costs < self.best.cost + LIKELY]
            if len(likely) > ENOUGH * len(grid):
                break
            # a box around them and the best pose, wider by a step of the grid
            step = 2.0 * half / (SIDE - 1)
            low, high = likely.min(axis=0, initial=0.0), likely.max(axis=0, initial=0.0)
            middle, half = 0.5 * (low + high), 0.5 * (high - low) + step
        share = np.exp(-0.5 * (costs - costs.min()))
        share /= share.sum()
        mean_square: FloatArray = (steps * share[:, None]).T @ steps + basis @ inner @ basis.T
        return mean_square

    def _split_unknowns(self, weak: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return directions (k, k - 2) of the unknowns besides two axes (3, 2), and covariance."""
        axes = np.zeros((2, len(self.best.covariance)))
        axes[:, :3] = weak.T
        directions = np.linalg.svd(axes)[2][2:].T
        normal = self._normal
        basis = directions / np.sqrt(np.einsum("ik,ij,jk->k", directions, normal, directions))
        return basis, np.linalg.inv(basis.T @ normal @ basis)

    @property
    def _normal(self) -> FloatArray:
        total: FloatArray = np.sum([term.normal for term in self.best.terms], axis=0)
        return total

    def _solve_at(
        self, offsets_m: FloatArray, basis: FloatArray, inner: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return steps (m, k) to the best poses at offsets (m, 3) of the place, and costs (m,)."""
        normal = self._normal
        steps = np.zeros((len(offsets_m), len(normal)))
        steps[:, :3] = offsets_m
        steps -= (steps @ normal @ basis) @ inner @ basis.T  # where a parabola has them
        for _ in range(ROUNDS):
            steps += (self._evaluate_at(steps)[0] @ basis) @ inner @ basis.T
        return steps, self._evaluate_at(steps)[1]

    def _evaluate_at(self, steps: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return J' W r (m, k), with J of the best pose, and costs (m,) after steps (m, k)."""
        state, measured = self.best.state, self.best.measured
        turns = Rotation.from_rotvec(steps[:, 3:6]) * state.pose.camera_from_body
        sights = self.points.places_m - (state.pose.position_m + steps[:, :3])[:, None]
        pixels = self.camera.project(np.einsum("mij,mnj->mni", turns.as_matrix(), sights))
        first = 6 + (self.lens.focal > 0.0)
        focal = state.focal + (steps[:, 6] if first > 6 else np.zeros(len(steps)))
        shift = state.shift_px + (steps[:, first:] if self.lens.centre_px > 0.0 else np.zeros(2))
        out = pixels - self.lens.middle_px
        predicted = self.lens.middle_px + (1.0 + focal)[:, None, None] * out
        residuals = self.points.pixels - predicted - np.reshape(shift, (-1, 1, 2))
        weighted = np.einsum("nij,mnj->mni", measured.weights, residuals)
        costs = np.einsum("mni,mni->m", residuals, weighted)
        gradients = np.einsum("mni,nik->mk", weighted, measured.jacobian)
        for term in self.best.terms[1:]:  # what is stated of the lens is linear
            left = term.residuals - steps @ term.jacobian.T
            costs = costs + left**2 @ term.weights
            gradients = gradients + (left * term.weights) @ term.jacobian
        # a place from which points are out of view is none
        seen = np.isfinite(costs)
        return np.where(seen[:, None], gradients, 0.0), np.where(seen, costs, np.inf)


@lru_cache(maxsize=256)
def chi_square_quantile(probability: float, freedom: int) -> float:
    """Quantile of chi-square, like scipy.stats, which takes as long to load as half of our code."""
    return float(2.0 * gammaincinv(freedom / 2.0, probability))


def estimate_inflation(cost: float, freedom: int) -> float:
    """Estimate a covariance's inflation: residuals wider than one in twenty mean small sigmas."""
    return cost / freedom if freedom > 0 and cost > chi_square_quantile(0.95, freedom) else 1.0
