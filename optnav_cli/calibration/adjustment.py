"""Many frames at once: their poses, and what is common to them, in one least squares.

A place of the catalog stands at scale * (turned) + origin in the frame that positions are stated
in, each camera is turned by its boresight from what attitudes state, and its focal length may be
off. Frames meet in these numbers alone. So the blocks of the poses are eliminated (Schur's
complement; Triggs et al., "Bundle adjustment - a modern synthesis", 2000), and the time grows with
the number of frames. Stated positions and attitudes are measurements with their sigmas; Tukey's
weights take wrong matches out. Frames err alike about one control point: its scores, summed over
them, raise the covariance of the common numbers (clustered data; Liang and Zeger, 1986).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC, cross_matrix
from optnav_cli.calibration.model import (
    FrameMotion,
    compute_weight_slope,
    differentiate_lens,
    estimate_clustered_excess,
)
from optnav_cli.estimation.least_squares import inverse_of
from optnav_cli.estimation.models.common import AdjustableCamera, Common, CommonNumber, CommonState
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.estimation.robust import TUKEY, scatter, tukey_weights
from optnav_cli.reasons import ReasonCode

MAX_STEPS, SETTLED_SIGMAS = 60, 1e-3
# An attitude or position held exact: far below what any picture shows, far above what doubles lose.
MIN_ATTITUDE_SIGMA, MIN_POSITION_SIGMA_M = 1e-3 * ARCSEC, 1e-3
# A combination counts as observed when the frames cut its prior sigma to less than this share.
OBSERVED = 0.5
# Of what the matches of a frame share, this part of the variance is taken for the catalog's own:
# the same in all frames. The rest goes with the frame's Sun and view. A convention, not a fit.
CATALOG_SHARE = 0.5
# With so many points a number their scores show each direction's excess; fewer show a mean one.
MANY_POINTS = 20
NAMED = 0.25  # share of a unit vector from which a number is named as a part of a combination


@dataclass(frozen=True, eq=False)
class AdjustedFrame:
    """A frame that goes into an adjustment.

    sightings  of control points, places as the catalog has them
    points     (n,) which control point each is: the same number in all frames
    start      the pose to begin with
    position_m, position_sigma_m      as stated; None: not stated
    attitude, attitude_sigma_rad      as stated; 0: exact; None: free
    shared_m2  (3, 3) errors of the position that all matches of the frame share: it looks as if
               the camera stood elsewhere
    motion     of the ship when the picture was taken; needed for a clock
    """

    camera: AdjustableCamera
    sightings: Sightings
    points: IntArray
    start: Pose
    position_m: FloatArray | None = None
    position_sigma_m: float | None = None
    attitude: Rotation | None = None
    attitude_sigma_rad: float | None = None
    shared_m2: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    motion: FrameMotion | None = None

    @property
    def position_spread_m2(self) -> FloatArray | None:
        """(3, 3) between where the camera looks to stand and where it is stated; None: nowhere."""
        if self.position_m is None or self.position_sigma_m is None:
            return None
        return self.shared_m2 + np.eye(3) * max(self.position_sigma_m, MIN_POSITION_SIGMA_M) ** 2

    def correct_shared_errors(self, pose: Pose, covariance: FloatArray) -> tuple[Pose, FloatArray]:
        """Correct pose and covariance (6, 6) for shared errors, as far as the statement tells them.

        The statement tells a part of the shared errors; the others stay in the covariance.
        """
        gain, left = np.zeros((3, 3)), self.shared_m2
        spread = self.position_spread_m2
        position = pose.position_m
        if spread is not None and self.position_m is not None:
            gain = self.shared_m2 @ np.linalg.inv(spread)
            left = self.shared_m2 - gain @ self.shared_m2
            position = position - gain @ (position - self.position_m)
        change = np.eye(6)
        change[:3, :3] -= gain
        pose_covariance = change @ covariance @ change.T
        pose_covariance[:3, :3] += 0.5 * (left + left.T)
        return Pose(position, pose.camera_from_body), pose_covariance


@dataclass(frozen=True, eq=False)
class FrameResult:
    """A frame after the adjustment.

    covariance    (6, 6) of the pose: position m, rotation vector rad in the camera frame
    residuals_px  (n, 2) measured less predicted
    weights       (n,) Tukey's, 0 for a match that is left out
    """

    pose: Pose
    covariance: FloatArray
    residuals_px: FloatArray
    weights: FloatArray


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Poses and common numbers of many frames.

    covariance   (k, k) of the common numbers, the errors that frames share of a point included
    point_excess by how much those raised the matches' part, as a variance; 1: not at all
    off_statements  how far poses lie from positions and attitudes stated of them, sigmas, rms
    steps        of the iteration
    """

    common: CommonState
    covariance: FloatArray
    frames: tuple[FrameResult, ...]
    point_excess: float
    off_statements: float
    steps: int

    @property
    def sigmas(self) -> FloatArray:
        """(k,) of the common numbers."""
        sigmas: FloatArray = np.sqrt(np.diag(self.covariance))
        return sigmas

    def find_inseparable(self) -> list[tuple[str, ...]]:
        """Find what the frames do not observe: names that stand together cannot be separated."""
        if not self.common.numbers:
            return []
        scale = np.array([n.prior_sigma for n in self.common.numbers])
        shares, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        groups: list[tuple[str, ...]] = []
        for share, vector in zip(shares, vectors.T, strict=True):
            if share < OBSERVED**2:
                continue
            parts = zip(self.common.numbers, vector, strict=True)
            names = tuple(dict.fromkeys(n.label for n, size in parts if abs(size) > NAMED))
            if names not in groups:
                groups.append(names)
        return groups


def adjust(
    frames: Sequence[AdjustedFrame], numbers: tuple[CommonNumber, ...], by_direction: bool = False
) -> Adjustment:
    """Adjust frames together.

    by_direction  whether what frames share of points is found for each combination of the numbers,
                  where there are points enough, instead of one factor for all
    Raises NoSolutionError when a pose is open or the iteration does not settle.
    """
    common = CommonState(numbers, np.zeros(len(numbers)))
    poses = [frame.start for frame in frames]
    information = np.diag([n.prior_sigma**-2 for n in numbers]).reshape(len(numbers), len(numbers))
    for step_number in range(1, MAX_STEPS + 1):
        pixels = [
            compute_residuals(frame, pose, common)
            for frame, pose in zip(frames, poses, strict=True)
        ]
        weights = _compute_weights(frames, pixels)
        blocks = [
            _FrameBlock.eliminate_pose(frame, pose, common, weight)
            for frame, pose, weight in zip(frames, poses, weights, strict=True)
        ]
        normal = information + sum((b.reduced for b in blocks), np.zeros_like(information))
        gradient = -information @ common.values
        for block in blocks:
            gradient = gradient + block.reduced_gradient
        covariance = inverse_of(normal) if len(numbers) else normal
        step = covariance @ gradient
        moves = [block.solve_pose_step(step) for block in blocks]
        largest = max(
            [float(np.max(np.abs(m) / b.sigmas)) for m, b in zip(moves, blocks, strict=True)]
            + [float(np.max(np.abs(step) / np.sqrt(np.diag(covariance)), initial=0.0))]
        )
        if not np.isfinite(largest):
            text = "the frames leave what is to be solved for open"
            raise NoSolutionError(text, ReasonCode.DEGENERATE)
        common = CommonState(numbers, common.values + step)
        poses = [pose.moved(move) for pose, move in zip(poses, moves, strict=True)]
        if largest < SETTLED_SIGMAS:
            shares = np.concatenate(weights) if by_direction else None
            excess, raised = _add_shared_points(frames, blocks, covariance, shares)
            covariance = raised + _propagate_shared_errors(frames, poses, blocks, covariance)
            results = tuple(
                FrameResult(
                    *frame.correct_shared_errors(pose, block.propagate_covariance(covariance)),
                    compute_residuals(frame, pose, common),
                    weight,
                )
                for frame, pose, block, weight in zip(frames, poses, blocks, weights, strict=True)
            )
            off = _compute_off_statements(frames, poses, common)
            return Adjustment(common, covariance, results, excess, off, step_number)
    text = f"the adjustment did not settle in {MAX_STEPS} iterations"
    raise NoSolutionError(text, ReasonCode.NOT_SETTLED)


def compute_stated_pose(frame: AdjustedFrame, common: CommonState) -> Pose | None:
    """Compute the pose of a frame whose statements have only common errors; None if not stated."""
    if frame.position_m is None or frame.attitude is None:
        return None
    position_m, attitude, _, _ = _propagate_to_exposure(frame, common)
    if position_m is None or attitude is None:
        return None
    return Pose(position_m, attitude)


def _compute_off_statements(
    frames: Sequence[AdjustedFrame], poses: Sequence[Pose], common: CommonState
) -> float:
    """Compute how far poses lie from their statements, see `Adjustment`."""
    square, count = 0.0, 0
    for frame, pose in zip(frames, poses, strict=True):
        for _, _, off, weight in _linearise_statements(frame, pose, common):
            square += float(off @ weight @ off)
            count += off.size
    return float(np.sqrt(square / max(count, 1)))


def _propagate_to_exposure(
    frame: AdjustedFrame, common: CommonState
) -> tuple[FloatArray | None, Rotation | None, FloatArray, FloatArray]:
    """Propagate stated position and attitude to the clock's time; return their rates, too."""
    name, position, turn = frame.camera.name, frame.position_m, frame.attitude
    turn = None if turn is None else common.boresight(name) * turn
    if frame.motion is None:
        return position, turn, np.zeros(3), np.zeros(3)
    return frame.motion.propagate(position, turn, common.clock_s(name))


def compute_residuals(frame: AdjustedFrame, pose: Pose, common: CommonState) -> FloatArray:
    """Compute residuals (n, 2) from a pose, px; NaN where a point is out of view."""
    places = common.places_m(frame.sightings.points_body_m)
    pixels, _ = predict(common.lens(frame.camera), pose, places)
    residuals: FloatArray = frame.sightings.pixels - pixels
    return residuals


def estimate_shared_errors(frame: AdjustedFrame, stated_covariance_m2: FloatArray) -> FloatArray:
    """Estimate the part of a position's stated covariance (3, 3) beyond its matches' scatter.

    stated_covariance_m2  (3, 3) for the attitude as stated to the run
    Raises NoSolutionError when the matches leave the pose open.
    """
    _, jacobian = predict(frame.camera, frame.start, frame.sightings.points_body_m)
    information = np.linalg.inv(frame.sightings.covariances_px2)
    normal = np.einsum("nia,nij,njb->ab", jacobian, information, jacobian)
    if frame.attitude_sigma_rad is not None:
        weight = max(frame.attitude_sigma_rad, MIN_ATTITUDE_SIGMA) ** -2
        normal[3:, 3:] += np.eye(3) * weight
    covariance = inverse_of(normal)[:3, :3]
    if not np.isfinite(covariance).all():
        raise NoSolutionError("the matches leave the pose open", ReasonCode.DEGENERATE)
    values, vectors = np.linalg.eigh(stated_covariance_m2 - covariance)
    shared: FloatArray = vectors * np.maximum(values, 0.0) @ vectors.T
    return shared


@dataclass(frozen=True, eq=False)
class _FrameBlock:
    """One frame in the normal equations, its pose eliminated.

    inverse   (6, 6) of the pose's own block;  gain (6, k) change of the pose with the common
    reduced   (k, k) and reduced_gradient (k,) what the frame adds to those of the common numbers
    scores    (n, k) of its matches;  chance (n, k, k) their products by chance
    """

    inverse: FloatArray
    gain: FloatArray
    gradient: FloatArray
    reduced: FloatArray
    reduced_gradient: FloatArray
    scores: FloatArray
    chance: FloatArray

    @classmethod
    def eliminate_pose(
        cls, frame: AdjustedFrame, pose: Pose, common: CommonState, weights: FloatArray
    ) -> "_FrameBlock":
        by_pose, by_common, residuals = _compute_jacobians(frame, pose, common)
        seen = weights > 0.0
        by_pose, by_common = by_pose[seen], by_common[seen]
        weighing = np.linalg.inv(frame.sightings.covariances_px2[seen]) * weights[seen, None, None]
        weighted = np.einsum("nij,nj->ni", weighing, residuals[seen])
        normal = np.einsum("nia,nij,njb->ab", by_pose, weighing, by_pose)
        mixed = np.einsum("nia,nij,njb->ab", by_pose, weighing, by_common)
        common_normal = np.einsum("nia,nij,njb->ab", by_common, weighing, by_common)
        gradient = np.einsum("nia,ni->a", by_pose, weighted)
        common_gradient = np.einsum("nia,ni->a", by_common, weighted)
        for rows, columns, off, weight in _linearise_statements(frame, pose, common):
            normal = normal + rows.T @ weight @ rows
            mixed = mixed + rows.T @ weight @ columns
            common_normal = common_normal + columns.T @ weight @ columns
            gradient = gradient + rows.T @ weight @ off
            common_gradient = common_gradient + columns.T @ weight @ off
        inverse = inverse_of(normal)
        gain = inverse @ mixed
        left = by_common - by_pose @ gain
        scores = np.zeros((len(seen), mixed.shape[1]))
        chance = np.zeros((len(seen), mixed.shape[1], mixed.shape[1]))
        scores[seen] = np.einsum("nia,ni->na", left, weighted)
        chance[seen] = np.einsum("nia,nij,njb->nab", left, weighing, left)
        return cls(
            inverse,
            gain,
            gradient,
            common_normal - mixed.T @ gain,
            common_gradient - gain.T @ gradient,
            scores,
            chance,
        )

    @property
    def sigmas(self) -> FloatArray:
        """(6,) of the pose for known common numbers."""
        sigmas: FloatArray = np.sqrt(np.diag(self.inverse))
        return sigmas

    def solve_pose_step(self, step: FloatArray) -> FloatArray:
        """Solve the pose's step (6,) that belongs to one of the common numbers."""
        free_step: FloatArray = self.inverse @ self.gradient
        return free_step - self.gain @ step

    def propagate_covariance(self, covariance: FloatArray) -> FloatArray:
        """Propagate the covariance of the common numbers to that of the pose (6, 6)."""
        by_common: FloatArray = self.gain @ covariance @ self.gain.T
        return self.inverse + by_common


def _compute_jacobians(
    frame: AdjustedFrame, pose: Pose, common: CommonState
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute the change of pixels with pose (n, 2, 6) and common (n, 2, k); residuals (n, 2)."""
    places, camera = frame.sightings.points_body_m, common.lens(frame.camera)
    turned = common.turn.apply(places)
    pixels, by_pose = predict(camera, pose, common.places_m(places))
    by_place = -by_pose[:, :, :3]
    offsets = pixels - np.array(camera.principal_point_px)  # grow with the focal length
    by_common = np.zeros((len(places), 2, len(common.numbers)))
    columns = {
        # exp(w) p = p - [p]x w
        Common.BODY_ROTATION: -by_place @ cross_matrix(common.scale * turned),
        Common.ORIGIN: by_place,
        Common.SCALE: np.einsum("nij,nj->ni", by_place, turned)[:, :, None],
        Common.FOCAL: (offsets / common.focal_factor(camera.name))[:, :, None],
        **differentiate_lens(camera, common, pose, common.places_m(places)),
    }
    for kind, values in columns.items():
        places_of = common.places(kind, camera.name)
        if places_of.size:
            by_common[:, :, places_of] = values
    return by_pose, by_common, frame.sightings.pixels - pixels


def _linearise_statements(
    frame: AdjustedFrame, pose: Pose, common: CommonState
) -> list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Linearise statements by pose (3, 6) and common (3, k); residual (3,), weight (3, 3)."""
    rows_of_statements: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = []
    unknowns = len(common.numbers)
    spread, name = frame.position_spread_m2, frame.camera.name
    position, measured, velocity, rate = _propagate_to_exposure(frame, common)
    clock = common.places(Common.CLOCK, name)
    if spread is not None and position is not None:
        off = position - pose.position_m
        weight: FloatArray = np.linalg.inv(spread).astype(np.float64)
        columns = np.zeros((3, unknowns))
        columns[:, clock] = -velocity[:, None]
        rows_of_statements.append((np.eye(3, 6), columns, off, weight))
    if measured is not None and frame.attitude_sigma_rad is not None:
        off = (measured * pose.camera_from_body.inv()).as_rotvec()
        columns = np.zeros((3, unknowns))
        for kind in (Common.BORESIGHT, Common.MOUNTING):
            places = common.places(kind, name)
            columns[:, places] = -np.eye(3, len(places))
        columns[:, clock] = -rate[:, None]
        weight = np.eye(3) * max(frame.attitude_sigma_rad, MIN_ATTITUDE_SIGMA) ** -2
        rows_of_statements.append((np.eye(3, 6, 3), columns, off, weight))
    return rows_of_statements


def _compute_weights(
    frames: Sequence[AdjustedFrame], residuals: Sequence[FloatArray]
) -> list[FloatArray]:
    """Compute Tukey's weights (n,) of each frame's matches; the cut follows the scatter of all."""
    sizes = []
    for frame, off in zip(frames, residuals, strict=True):
        information = np.linalg.inv(frame.sightings.covariances_px2)
        squares = np.einsum("ni,nij,nj->n", off, information, off)
        # of two numbers: the size of one
        sizes.append(np.sqrt(np.where(np.isfinite(squares), squares, np.inf) / 2.0))
    finite = [size[np.isfinite(size)] for size in sizes]
    spread = scatter(np.concatenate(finite)) if finite else 1.0
    cut = TUKEY * max(spread, 1.0)
    return [tukey_weights(np.minimum(size, 10.0 * cut), cut) for size in sizes]


def _add_shared_points(
    frames: Sequence[AdjustedFrame],
    blocks: Sequence[_FrameBlock],
    covariance: FloatArray,
    weights: FloatArray | None,
) -> tuple[float, FloatArray]:
    """Raise the covariance by errors that frames share of a point; return that factor as well."""
    if not len(covariance):
        return 1.0, covariance
    points = np.concatenate([frame.points for frame in frames])
    scores = np.concatenate([block.scores for block in blocks])
    chance = np.sum([block.chance.sum(axis=0) for block in blocks], axis=0)
    _, of = np.unique(points, return_inverse=True)
    sums = np.zeros((int(of.max(initial=-1)) + 1, scores.shape[1]))
    np.add.at(sums, of, scores)
    expected = float(np.trace(covariance @ chance))
    seen = float(np.einsum("pa,ab,pb->", sums, covariance, sums))
    excess = max(seen / expected, 1.0) if expected > 0.0 else 1.0
    if weights is not None and len(sums) >= MANY_POINTS * len(covariance):
        more = estimate_clustered_excess(sums / compute_weight_slope(weights), chance)
        return excess, covariance + covariance @ more @ covariance
    return excess, covariance + (excess - 1.0) * covariance @ chance @ covariance


def _propagate_shared_errors(
    frames: Sequence[AdjustedFrame],
    poses: Sequence[Pose],
    blocks: Sequence[_FrameBlock],
    covariance: FloatArray,
) -> FloatArray:
    """Propagate errors along the lines of sight, common to all frames, to the covariance (k, k)."""
    moved = np.zeros(len(covariance))
    for frame, pose, block in zip(frames, poses, blocks, strict=True):
        spread = frame.position_spread_m2
        if spread is not None:
            direction = pose.position_m / np.linalg.norm(pose.position_m)
            error = direction * np.sqrt(
                CATALOG_SHARE * max(float(direction @ frame.shared_m2 @ direction), 0.0)
            )
            moved -= block.gain[:3].T @ np.linalg.solve(spread, error)
    shift = covariance @ moved
    return np.outer(shift, shift)
