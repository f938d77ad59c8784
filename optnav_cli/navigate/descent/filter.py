"""One state for a descent: the errors of an inertial track, of its attitude, and of points seen.

Source of the task: Zhukov 2025, ch. 3, whose landmarks enter the position as independent points. An
error made before lives in *every* landmark, so that their covariance with the pose must be kept:
treated as independent they are many times too sure (study descent). Here windows of the terrain
model and landmarks are unknown ground points in the state of one iterated extended Kalman filter
(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
ch. 10.5). A window's error stays with its ground from frame to frame, as a landmark's does.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray, IndexArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.models.points import Pose, ProjectingCamera, Sightings, predict
from optnav_cli.reasons import ReasonCode

# The first unknowns: errors of the track's position (m) and velocity (m/s), and of its attitude in
# the camera's axes: bias (rad) and drift (rad/s). Three more follow for each ground point (m).
POSITION, VELOCITY, BIAS, DRIFT = (slice(k, k + 3) for k in (0, 3, 6, 9))
TRACK = 12
# Relinearisations of one update, each from the prediction: an update repeated from its own result
# counts the same pixels twice.
ROUNDS = 3
# A sighting whose residual is wider than this, squared and in units of its covariance with two
# degrees of freedom, is left out: one right one in 3000 is.
GATE = 16.0


@dataclass(frozen=True)
class TrackErrors:
    """Errors of an inertial track, 1 sigma.

    position_m            at its start, a component
    velocity_m_s          a constant error, a component
    acceleration_m_s2     white noise of the acceleration, per root second, a component
    attitude_rad          bias, an axis of the camera
    attitude_drift_rad_s  its growth
    attitude_noise_rad    fresh in each frame
    """

    position_m: float
    velocity_m_s: float
    acceleration_m_s2: float
    attitude_rad: float
    attitude_drift_rad_s: float
    attitude_noise_rad: float

    def covariance(self) -> FloatArray:
        """Return (12, 12) of the track's unknowns at its start."""
        sigmas = self.position_m, self.velocity_m_s, self.attitude_rad, self.attitude_drift_rad_s
        return np.diag(np.repeat(np.square(sigmas), 3)).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Update:
    """Result of an update by a frame's sightings.

    used          (n,) which of them it kept
    residuals_px  (n, 2) measured less predicted, after the update
    squares       (n,) the residuals squared in units of their covariance
    """

    used: BoolArray
    residuals_px: FloatArray
    squares: FloatArray


class DescentFilter:
    """The joint state and its covariance.

    errors  of the track at its start
    Ground points are known by their place in `places_m` (k, 3), m, body frame; dropping some moves
    the others up.
    """

    def __init__(self, errors: TrackErrors) -> None:
        self._errors = errors
        self.state: FloatArray = np.zeros(TRACK)
        self.covariance: FloatArray = errors.covariance()
        self._nominal: FloatArray = np.zeros((0, 3))

    def copy(self) -> "DescentFilter":
        """Copy the filter, to try an update on."""
        other = DescentFilter(self._errors)
        other.state, other.covariance = self.state.copy(), self.covariance.copy()
        other._nominal = self._nominal.copy()
        return other

    @property
    def nominal_m(self) -> FloatArray:
        """(k, 3) where the ground points were when they joined, m, body frame."""
        return self._nominal

    def restore(self, state: FloatArray, covariance: FloatArray, nominal_m: FloatArray) -> None:
        """Go on from a state (12 + 3 k,), its covariance and its points (k, 3) as they were."""
        self.state, self.covariance = state.copy(), covariance.copy()
        self._nominal = nominal_m.copy()

    @property
    def count(self) -> int:
        """Ground points in the state."""
        return len(self._nominal)

    @property
    def places_m(self) -> FloatArray:
        """(k, 3) ground points, m, body frame."""
        places: FloatArray = self._nominal + self.state[TRACK:].reshape(-1, 3)
        return places

    @property
    def offsets_m(self) -> FloatArray:
        """(k, 3) of the ground points from where they were when they joined."""
        return self.state[TRACK:].reshape(-1, 3)

    def get_point_covariance(self, number: int) -> FloatArray:
        """Return the covariance (3, 3) of a ground point, m^2."""
        columns = slice(TRACK + 3 * number, TRACK + 3 * number + 3)
        return self.covariance[columns, columns]

    def propagate(self, seconds: float) -> None:
        """Propagate the errors over a time, s."""
        step = np.eye(TRACK)
        step[POSITION, VELOCITY] = step[BIAS, DRIFT] = seconds * np.eye(3)
        self.state[:TRACK] = step @ self.state[:TRACK]
        self.covariance[:TRACK] = step @ self.covariance[:TRACK]
        self.covariance[:, :TRACK] = self.covariance[:, :TRACK] @ step.T
        noise = self._errors.acceleration_m_s2**2 * np.eye(3)
        self.covariance[POSITION, POSITION] += noise * seconds**3 / 3.0
        self.covariance[POSITION, VELOCITY] += noise * seconds**2 / 2.0
        self.covariance[VELOCITY, POSITION] += noise * seconds**2 / 2.0
        self.covariance[VELOCITY, VELOCITY] += noise * seconds

    def add_jump(self, position_m: float, velocity_m_s: float) -> None:
        """Add the uncertainty of a jump of the track, m and m/s, 1 sigma per component."""
        self.covariance[POSITION, POSITION] += position_m**2 * np.eye(3)
        self.covariance[VELOCITY, VELOCITY] += velocity_m_s**2 * np.eye(3)

    def pose(self, stated: Pose) -> Pose:
        """Return the corrected pose where the track states one."""
        turn = Rotation.from_rotvec(self.state[BIAS]) * stated.camera_from_body
        return Pose(stated.position_m + self.state[POSITION], turn)

    def compute_pose_covariance(self) -> FloatArray:
        """Compute (6, 6) of position (m) and attitude (rad) with this frame's attitude noise."""
        which = np.r_[POSITION, BIAS]
        covariance: FloatArray = self.covariance[np.ix_(which, which)].copy()
        covariance[3:, 3:] += self._errors.attitude_noise_rad**2 * np.eye(3)
        return covariance

    def add_points(
        self, places_m: FloatArray, covariance_m2: FloatArray, by_state: FloatArray | None = None
    ) -> IndexArray:
        """Add ground points and return their numbers.

        places_m       (k, 3) m, body frame
        covariance_m2  (3 k, 3 k) of what is the points' own
        by_state       (3 k, n) derivative of their places by the state so far; None for none
        """
        old, new = len(self.state), 3 * len(places_m)
        covariance = np.zeros((old + new, old + new))
        covariance[:old, :old] = self.covariance
        covariance[old:, old:] = covariance_m2
        if by_state is not None:
            across = by_state @ self.covariance
            covariance[old:, :old], covariance[:old, old:] = across, across.T
            covariance[old:, old:] += across @ by_state.T
        self.covariance = covariance
        self.state = np.concatenate([self.state, np.zeros(new)])
        first = self.count
        self._nominal = np.concatenate([self._nominal, places_m])
        return np.arange(first, self.count)

    def add_sighted(
        self,
        camera: ProjectingCamera,
        stated: Pose,
        places_m: FloatArray,
        covariances_px2: FloatArray,
        ground_sigmas_m: FloatArray,
    ) -> IndexArray:
        """Add ground points that this frame shows for the first time; returns their numbers.

        places_m         (k, 3) where the rays of their pixels at `pose` meet the ground
        covariances_px2  (k, 2, 2) of these pixels
        ground_sigmas_m  (k,) how well the ground's height is known
        """
        pose, count = self.pose(stated), len(places_m)
        _, by_pose = predict(camera, pose, places_m)
        ups = places_m / np.linalg.norm(places_m, axis=1, keepdims=True)
        # two pixels and the height are three equations for the place
        equations = np.concatenate([-by_pose[:, :, :3], ups[:, None]], axis=1)
        inverse = np.linalg.inv(equations)
        by_state = np.zeros((3 * count, len(self.state)))
        moved = -inverse[:, :, :2] @ by_pose
        by_state[:, POSITION] = moved[:, :, :3].reshape(-1, 3)
        by_state[:, BIAS] = moved[:, :, 3:].reshape(-1, 3)
        # the frame's attitude noise moves all of them together
        turns = by_state[:, BIAS]
        noise_m2 = self._errors.attitude_noise_rad**2 * turns @ turns.T
        for k in range(count):
            spread = np.zeros((3, 3))
            spread[:2, :2], spread[2, 2] = covariances_px2[k], ground_sigmas_m[k] ** 2
            rows = slice(3 * k, 3 * k + 3)
            noise_m2[rows, rows] += inverse[k] @ spread @ inverse[k].T
        return self.add_points(places_m, noise_m2, by_state)

    def add_offsets(self, numbers: IndexArray, offsets_m: FloatArray) -> None:
        """Move ground points by (k, 3) m from where they joined: a correlated prior's mean."""
        self.state[_list_columns(numbers)] += offsets_m.ravel()

    def add_point_noise(self, number: int, covariance_m2: FloatArray) -> None:
        """Add a (3, 3) covariance to a ground point whose patch was cut again, with a new error."""
        columns = slice(TRACK + 3 * number, TRACK + 3 * number + 3)
        self.covariance[columns, columns] += covariance_m2

    def keep(self, kept: BoolArray) -> None:
        """Marginalise the ground points that are not kept (k,)."""
        columns = np.concatenate([np.ones(TRACK, dtype=bool), np.repeat(kept, 3)])
        self.state = self.state[columns]
        self.covariance = self.covariance[np.ix_(columns, columns)]
        self._nominal = self._nominal[kept]

    def predict(
        self, camera: ProjectingCamera, stated: Pose, numbers: IndexArray
    ) -> tuple[FloatArray, FloatArray]:
        """Predict pixels (n, 2) of ground points with their covariance (n, 2, 2)."""
        pixels, by_pose = predict(camera, self.pose(stated), self.places_m[numbers])
        rows = _SightingRows(by_pose, numbers)
        noise = self._errors.attitude_noise_rad
        spread = np.empty((len(numbers), 2, 2))
        for k in range(len(numbers)):
            row = rows.get_row(k)
            wanted = row.columns
            spread[k] = row.values @ self.covariance[np.ix_(wanted, wanted)] @ row.values.T
            spread[k] += noise**2 * by_pose[k, :, 3:] @ by_pose[k, :, 3:].T
        return pixels, spread

    def update(
        self,
        camera: ProjectingCamera,
        stated: Pose,
        numbers: IndexArray,
        seen: Sightings,
        shared_px: FloatArray | None = None,
        gate: float = GATE,
    ) -> Update:
        """Update by all sightings of a frame at once; what contradicts the others is left out.

        numbers    (n,) of the ground points seen; the places in `seen` are not read
        shared_px  (n, 2, m) what m errors that sightings have in common move them by, at 1 sigma
        gate       the widest residual that is kept, as GATE
        Raises NoSolutionError for a point that leaves the view, or for sightings none of which
        agrees with the state; the state is then as it was.
        """
        used = np.ones(len(numbers), dtype=bool)
        shared = np.zeros((len(numbers), 2, 0)) if shared_px is None else shared_px
        for _ in range(len(numbers) + 1):
            kept = np.flatnonzero(used)
            if kept.size == 0:
                text = "no window or landmark agrees with the inertial track"
                raise NoSolutionError(text, ReasonCode.POINTS_DISAGREE)
            state, covariance, squares = self._solve_update(
                camera, stated, numbers[kept], seen.subset(kept), shared[kept]
            )
            wide = squares > gate
            if not wide.any():
                break
            # the worst drag others along: first those that are at least half as wide
            used[kept[wide & (squares > 0.5 * squares.max())]] = False
        self.state, self.covariance = state, covariance
        pixels, _ = predict(camera, self.pose(stated), self.places_m[numbers])
        all_squares = np.full(len(numbers), np.inf)
        all_squares[used] = squares
        return Update(used, seen.pixels - pixels, all_squares)

    def predict_range(
        self, beam: FloatArray, by_position: FloatArray, by_ground: tuple[int | None, FloatArray]
    ) -> tuple[FloatArray, float]:
        """Linearise a range; return its derivative (state,) and its variance by the state, m^2.

        beam         (3,) derivative of the range by the camera's turn, camera axes, m/rad
        by_position  (3,) derivative by the camera's position
        by_ground    a ground point's number, None for none, and the derivative (3,) by its place
        """
        row = np.zeros(len(self.state))
        row[POSITION], row[BIAS] = by_position, beam
        number, derivative = by_ground
        if number is not None:
            row[_list_columns(np.array([number]))] = derivative
        noise = self._errors.attitude_noise_rad**2 * float(beam @ beam)
        return row, float(row @ self.covariance @ row) + noise

    def update_range(self, row: FloatArray, misfit_m: float, variance_m2: float) -> None:
        """Update by a range: measured less predicted, and the variance (1 sigma squared) of that.

        row (state,) of `predict_range`;  variance_m2 of the state's share and the range's own
        """
        gain = self.covariance @ row / variance_m2
        self.state = self.state + gain * misfit_m
        covariance = self.covariance - variance_m2 * np.outer(gain, gain)
        self.covariance = 0.5 * (covariance + covariance.T)

    def _solve_update(
        self,
        camera: ProjectingCamera,
        stated: Pose,
        numbers: IndexArray,
        seen: Sightings,
        shared_px: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Solve an update: state, covariance, squared normalised residuals (n,)."""
        prior, noise = self.state, self._errors.attitude_noise_rad
        state = prior
        for _ in range(ROUNDS):
            turn = Rotation.from_rotvec(state[BIAS]) * stated.camera_from_body
            pose = Pose(stated.position_m + state[POSITION], turn)
            places = self._nominal[numbers] + state[_list_columns(numbers)].reshape(-1, 3)
            pixels, by_pose = predict(camera, pose, places)
            if not np.isfinite(pixels).all():
                text = "a window or landmark left the camera's view during the update"
                raise NoSolutionError(text, ReasonCode.NOT_SETTLED)
            rows = _SightingRows(by_pose, numbers)
            cross = rows.multiply(self.covariance).T  # (state, 2 n)
            turns = by_pose[:, :, 3:].reshape(-1, 3)
            noise_px2 = noise**2 * turns @ turns.T
            shared = shared_px.reshape(2 * len(numbers), -1)
            noise_px2 += shared @ shared.T
            for k, covariance in enumerate(seen.covariances_px2):
                noise_px2[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += covariance
            total = rows.multiply(cross) + noise_px2
            factor = cho_factor(0.5 * (total + total.T))
            misfits = (seen.pixels - pixels).ravel() + rows.multiply((state - prior)[:, None])[:, 0]
            step = cross @ cho_solve(factor, misfits)
            state = prior + step
        covariance = self.covariance - cross @ cho_solve(factor, cross.T)
        # a residual after the update has the covariance R S^-1 R
        left = noise_px2 @ cho_solve(factor, misfits)
        spread = noise_px2 @ cho_solve(factor, noise_px2)
        count = len(numbers)
        blocks = spread.reshape(count, 2, count, 2)[np.arange(count), :, np.arange(count)]
        both = left.reshape(-1, 2)
        squares = np.einsum("ni,nij,nj->n", both, np.linalg.pinv(blocks), both)
        return state, 0.5 * (covariance + covariance.T), squares


@dataclass(frozen=True)
class _SightingRow:
    """The two rows of a sighting's derivative: values (2, 9) in columns (9,) of the state."""

    values: FloatArray
    columns: IndexArray


class _SightingRows:
    """Derivatives of sightings by the state, of which each depends on nine unknowns."""

    def __init__(self, by_pose: FloatArray, numbers: IndexArray) -> None:
        # a pose's step and the ground's opposite one move a pixel alike
        self._by_pose, self._by_place = by_pose, -by_pose[:, :, :3]
        self._numbers = numbers

    def get_row(self, k: int) -> _SightingRow:
        """Return the rows of a sighting."""
        columns = np.r_[POSITION, BIAS, _list_columns(self._numbers[k : k + 1])]
        return _SightingRow(np.concatenate([self._by_pose[k], self._by_place[k]], axis=1), columns)

    def multiply(self, matrix: NDArray[np.floating]) -> FloatArray:
        """Multiply the derivative (2 n, state) by a matrix (state, m)."""
        pose = self._by_pose.reshape(-1, 6)
        product: FloatArray = pose @ matrix[np.r_[POSITION, BIAS]]
        ground = matrix[_list_columns(self._numbers)].reshape(len(self._numbers), 3, -1)
        product += np.matmul(self._by_place, ground).reshape(product.shape)
        return product


def _list_columns(numbers: IndexArray) -> IndexArray:
    """List the columns (3 k,) of ground points in the state."""
    columns: IndexArray = (TRACK + 3 * np.asarray(numbers)[:, None] + np.arange(3)).ravel()
    return columns
