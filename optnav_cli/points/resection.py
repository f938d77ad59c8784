"""A camera's pose from points that a person picked, without a first guess; the lens may err.

The start comes from OpenCV (SQPNP of Terzakis and Lourakis, ECCV 2020, for four points and more,
P3P for three). The fit has the errors of the lens beside the pose, each with the prior that the
camera file states: its focal length by a factor, its principal point by a shift. Blunders go by the
stated sigmas alone: each point's residual over what the fit leaves of its own error (Baarda's data
snooping).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.estimation.least_squares import Estimate, Iteration, solve
from optnav_cli.estimation.models.points import Pose, ProjectingCamera, predict
from optnav_cli.fix import LensEstimate
from optnav_cli.points.model import (
    AttitudePrior,
    LensErrors,
    LensPoints,
    LensPose,
    LensPrior,
    PickedLikelihood,
    PickedSightings,
    StatedAttitude,
    chi_square_quantile,
    estimate_inflation,
    make_lens_estimate,
    move_with_lens,
)
from optnav_cli.reasons import Reason, ReasonCode

# A point is left out, and a whole fit refused, when chance makes as much so rarely.
GATE_PROBABILITY, FIT_PROBABILITY = 0.9995, 0.9999
FREE_FOCAL = 0.3  # error of a focal length that the points alone shall tell
MAX_LEFT_OUT = 0.34  # of the points: more are no blunders, but wrong coordinates or a wrong lens
MIN_LEFT = 1e-3  # of a point's variance in its residual: less is rounding
MAX_SAMPLES = 100
MAX_LEFT_IN_TURN = 10
MIN_DEPTH = 0.05  # of a ray's length along the boresight: OpenCV's poses need points before a plane
OWN_LINE = 3.0  # sigmas that points must stand off a common line
SAME_PLACE_SIGMAS = 5.0
RIVAL_COST = 11.8  # another pose whose cost is less than 3 sigmas of two numbers higher
HOPELESS = 10.0  # times that cost promised by a step end its search; rivals' had up to 1.6
# A mirror image that is nearer leaves the way of the lean open. Found on nadir pictures of 5 points
# (seed 2): leans that noise made stood up to 135 sigmas from theirs; `study points` scores it.
NEAR_MIRROR_SIGMAS = 150.0
_OPEN = Reason(ReasonCode.DEGENERATE, "the points do not fix position and attitude")
_UNSETTLED = Reason(ReasonCode.NOT_SETTLED, "the position did not settle in 40 iterations")
_ITERATION = Iteration(40, 1e-4, _OPEN, _UNSETTLED, each_unknown=True, damped=True)


@dataclass(frozen=True)
class PickedPose:
    """A pose from picked points.

    covariance    (6, 6) position, m, body frame, and rotation vector, rad, camera frame
    used          (n,) which points it rests on
    residuals_px  (n, 2) of all points, measured less predicted
    cost, freedom squared residuals in units of their covariance, and their expectation
    focal         what the lens is longer by, as a share, as far as the points tell
    lens          what was estimated of the lens; None where it counts as exact
    """

    pose: Pose
    covariance: FloatArray
    used: BoolArray
    residuals_px: FloatArray
    cost: float
    freedom: int
    focal: float
    lens: LensEstimate | None = None

    @property
    def fits(self) -> bool:
        """Whether the points agree within their sigmas, with few left out."""
        agree = self.freedom <= 0 or self.cost < chi_square_quantile(FIT_PROBABILITY, self.freedom)
        return agree and 1.0 - self.used.mean() <= MAX_LEFT_OUT

    @property
    def position_covariance_m2(self) -> FloatArray:
        """(3, 3), body frame."""
        return self.covariance[:3, :3]

    @property
    def attitude_sigma_rad(self) -> float:
        """1 sigma an axis, root mean square."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


@dataclass(frozen=True, eq=False)
class PickedResection:
    """Points of one picture and how a pose follows from them.

    rays      (n, 3) unit vectors of the pixels, camera frame
    attitude  None where it is free
    """

    camera: ProjectingCamera
    points: PickedSightings
    rays: FloatArray
    lens: LensPrior
    attitude: AttitudePrior | None = None

    @property
    def fewest(self) -> int:
        """Points without which there is no one solution."""
        return 4 if self.attitude is None else 2

    def solve(self, near: PickedPose | None = None) -> PickedPose:
        """Fit a pose to the points, blunders left out.

        near  a pose that they fitted from places that were little different

        Raises NoSolutionError for too few points, points on a line or in one pixel, points that
        disagree, and two poses that the points do not tell apart.
        """
        self._check_spread()
        if near is not None and near.fits:
            again = self._fit_without_blunders(near.used, near.pose)
            if again is not None and again.fits:
                return again
        everything = np.ones(len(self.points), dtype=bool)
        best = self._fit_without_blunders(everything)
        if best is None or not best.fits:
            best = self._fit_samples(best)
        if best is not None and not best.used.all() and len(self.points) <= MAX_LEFT_IN_TURN:
            best = self._try_leaving_one_out(best)
        if best is None:
            raise NoSolutionError("no pose fits the points", ReasonCode.POINTS_DISAGREE)
        other = self.find_rival(best)
        # the start may have been on the wrong side of the points' plane
        return other if other is not None and other.cost < best.cost else best

    def find_rival(self, picked: PickedPose) -> PickedPose | None:
        """Find another pose that the points fit about as well, with their plane tilted over."""
        if self.attitude is not None:
            return None
        start = _make_mirror_pose(picked.pose, self.points.places_m[picked.used])
        try:
            other = self._fit(picked.used, start, most=HOPELESS * (picked.cost + RIVAL_COST))
        except NoSolutionError:
            return None
        apart = other.pose.position_m - picked.pose.position_m
        covariance = picked.position_covariance_m2 + other.position_covariance_m2
        if float(apart @ np.linalg.solve(covariance, apart)) < SAME_PLACE_SIGMAS**2:
            return None
        return other if other.cost < picked.cost + RIVAL_COST else None

    @property
    def any_lens(self) -> "PickedResection":
        """The points with a focal length of which nothing is stated."""
        return replace(self, lens=replace(self.lens, focal=FREE_FOCAL))

    def fit_another_lens(self, picked: PickedPose) -> PickedPose | None:
        """Fit a focal length that the points ask for against what is stated of it."""
        if picked.freedom <= 2:
            return None
        try:
            # weighted as the first fit is: a nearer pose makes more of the places' errors, and with
            # them a lower cost of any lens
            other = self.any_lens._fit(picked.used, picked.pose, rounds=1)
        except NoSolutionError:
            return None
        return other if picked.cost - other.cost > chi_square_quantile(FIT_PROBABILITY, 1) else None

    def expand_over_leans(self, picked: PickedPose) -> PickedPose:
        """Widen a pose's covariance by other leans that fit the points nearly as well.

        From nearly above, the curvature at the best pose tells less than half of the error.
        """
        if self.attitude is not None or len(self.points) < self.fewest:
            return picked
        points = self.points.subset(picked.used)
        mirror = _make_mirror_pose(picked.pose, points.places_m)
        to_mirror = mirror.position_m - picked.pose.position_m
        stated = picked.position_covariance_m2
        if float(to_mirror @ np.linalg.solve(stated, to_mirror)) > NEAR_MIRROR_SIGMAS**2:
            return picked
        estimate = self._estimate(picked.used, picked.pose)
        wide = PickedLikelihood(self.camera, points, self.lens, estimate).covariance(mirror)
        wider = wide[:6, :6] * estimate_inflation(picked.cost, picked.freedom)
        return replace(picked, covariance=wider)

    def solve_three(self) -> list[PickedPose]:
        """Find all poses, up to four, from which three points are seen so."""
        self._check_spread()
        everything = np.ones(len(self.points), dtype=bool)
        poses: list[PickedPose] = []
        for start in self._start_three():
            try:
                pose = self._fit(everything, start)
            except NoSolutionError:
                continue
            places = [other.pose.position_m for other in poses]
            reach = np.linalg.norm(pose.pose.position_m - self.points.places_m[0])
            if all(np.linalg.norm(pose.pose.position_m - p) > 1e-6 * reach for p in places):
                poses.append(pose)
        return poses

    def _check_spread(self) -> None:
        """Raise NoSolutionError where points are too few, or stand on a line."""
        count = len(self.points)
        if count < min(self.fewest, 3):
            raise NoSolutionError(
                f"{count} {'point is' if count == 1 else 'points are'} too few: wanted 4 and more, "
                "2 with a stated attitude",
                ReasonCode.FEW_POINTS,
            )
        sigma = float(np.median(self.points.sigma_px))
        out = self.points.pixels - self.points.pixels.mean(axis=0)
        along, across = np.linalg.svd(out, compute_uv=False)[:2] / np.sqrt(count)
        if along < OWN_LINE * sigma:
            raise NoSolutionError("all points lie on one pixel", ReasonCode.DEGENERATE)
        if self.attitude is None and across < OWN_LINE * sigma:
            text = "all points lie on a line: the camera may stand anywhere around it"
            raise NoSolutionError(text, ReasonCode.DEGENERATE)

    def _fit_without_blunders(
        self, used: BoolArray, start: Pose | None = None
    ) -> PickedPose | None:
        """Fit some points; drop the worst point until all pass the gate."""
        picked: PickedPose | None = None
        while used.sum() >= self.fewest:
            try:
                start = self._start(used) if start is None else start
                estimate = self._estimate(used, start)
            except (NoSolutionError, cv2.error):
                return picked
            picked = self._build_pose(estimate, used)
            squares, gates = self._test_residuals(estimate, used)
            out = squares > gates
            # with nothing left over a wrong point cannot be told from the right ones
            if not out.any() or picked.freedom <= 2:
                return self._restore_agreeing(picked)
            used = used.copy()
            used[np.flatnonzero(used)[np.argmax(squares / gates)]] = False
            start = picked.pose if picked.cost < 1e4 * max(picked.freedom, 1) else None
        return picked

    def _restore_agreeing(self, picked: PickedPose) -> PickedPose:
        """Restore points that agree with the fit of the others."""
        if picked.used.all():
            return picked
        squares = self._compute_squares(picked.pose, picked.residuals_px)
        agreeing = picked.used | (squares < chi_square_quantile(GATE_PROBABILITY, 2))
        if (agreeing == picked.used).all():
            return picked
        try:
            estimate = self._estimate(agreeing, picked.pose)
        except NoSolutionError:
            return picked
        squares, gates = self._test_residuals(estimate, agreeing)
        return picked if (squares > gates).any() else self._build_pose(estimate, agreeing)

    def _fit_samples(self, best: PickedPose | None) -> PickedPose | None:
        """Fit from four points at a time, among many blunders; return the best."""
        gate = 9.0 * chi_square_quantile(GATE_PROBABILITY, 2)
        tried: list[tuple[int, float, Pose]] = []
        for some in _draw_samples(len(self.points), self.fewest):
            used = np.zeros(len(self.points), dtype=bool)
            used[list(some)] = True
            try:
                pose = self._start(used)
            except (NoSolutionError, cv2.error):
                continue
            squares = self._compute_squares(pose)
            inside = squares < gate
            tried.append((-int(inside.sum()), float(squares[inside].sum()), pose))
        for count, _, pose in sorted(tried, key=lambda attempt: attempt[:2])[:3]:
            if -count < self.fewest:
                break
            picked = self._fit_without_blunders(self._compute_squares(pose) < gate, pose)
            if picked is not None and (
                best is None or (picked.fits, picked.used.sum()) > (best.fits, best.used.sum())
            ):
                best = picked
        return best

    def _compute_squares(self, pose: Pose, off_px: FloatArray | None = None) -> FloatArray:
        """Return squares (n,) of residuals over errors, by the stated lens unless given."""
        seen = self.points.sightings(self.camera, pose)
        if off_px is None:
            off_px = self.points.pixels - predict(self.camera, pose, self.points.places_m)[0]
        squares = np.einsum("ni,nij,nj->n", off_px, np.linalg.inv(seen.covariances_px2), off_px)
        return np.where(np.isfinite(squares), squares, np.inf)

    def _try_leaving_one_out(self, best: PickedPose) -> PickedPose:
        """Leave out each point in turn, where few points stand against one; return the best fit.

        A blunder among six may draw the fit to the other side of the points' plane.
        """
        for number in range(len(self.points)):
            used = np.ones(len(self.points), dtype=bool)
            used[number] = False
            try:
                picked = self._fit(used, self._start(used))
            except (NoSolutionError, cv2.error):
                continue
            other = self.find_rival(picked)
            if other is not None and other.cost < picked.cost:
                picked = other
            if (picked.used.sum(), -picked.cost) > (best.used.sum(), -best.cost):
                best = picked if picked.fits else best
        return best

    def _start(self, used: BoolArray) -> Pose:
        """Compute a pose from some points without any guess. Raises NoSolutionError."""
        if self.attitude is not None:
            return self._start_by_rays(used, self.attitude.camera_from_body)
        before = used & (self.rays[:, 2] > MIN_DEPTH)
        if before.sum() < self.fewest:
            raise NoSolutionError("too few points stand before the camera", ReasonCode.FEW_POINTS)
        places, middle, image = self._normalise_places(before)
        solved, turns, shifts, _ = cv2.solvePnPGeneric(
            places, image, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
        if not solved:
            raise NoSolutionError("no pose fits the points", ReasonCode.POINTS_DISAGREE)
        return _convert_pose(turns[0], shifts[0], middle)

    def _start_by_rays(self, used: BoolArray, turn: Rotation) -> Pose:
        """Find where rays of a known attitude through the points meet nearest."""
        rays = turn.inv().apply(self.rays[used])
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        places = self.points.places_m[used]
        normal, right = across.sum(axis=0), np.einsum("nij,nj->i", across, places)
        return Pose(np.linalg.solve(normal, right), turn)

    def _start_three(self) -> Iterator[Pose]:
        if self.attitude is not None:
            yield self._start(np.ones(3, dtype=bool))
            return
        places, middle, image = self._normalise_places(np.ones(len(self.points), dtype=bool))
        count, turns, shifts = cv2.solveP3P(places, image, np.eye(3), None, cv2.SOLVEPNP_P3P)
        for number in range(count):
            yield _convert_pose(turns[number], shifts[number], middle)

    def _normalise_places(self, used: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return places less their mean, that mean, and points of the plane at distance 1."""
        middle = self.points.places_m[used].mean(axis=0)
        rays = self.rays[used]
        return self.points.places_m[used] - middle, middle, rays[:, :2] / rays[:, 2:]

    def _fit(
        self, used: BoolArray, start: Pose, most: float = np.inf, rounds: int = 2
    ) -> PickedPose:
        """Fit some points, see `_estimate`."""
        return self._build_pose(self._estimate(used, start, most, rounds), used)

    def _estimate(
        self, used: BoolArray, start: Pose, most: float = np.inf, rounds: int = 2
    ) -> Estimate[LensPose]:
        """Estimate pose and lens from some points. Raises NoSolutionError.

        most    cost that ends it, see `Iteration.max_cost`
        rounds  of weighting: those of places hang on the distance, which is known after one
        """
        points, lens = self.points.subset(used), self.lens
        iteration = replace(_ITERATION, max_cost=most)
        state = LensPose(start, 0.0, np.zeros(2))
        for _ in range(rounds):
            models: list[LensPoints | LensErrors | StatedAttitude] = [
                LensPoints(self.camera, points.sightings(self.camera, state.pose), lens)
            ]
            if lens.sigmas.size:
                models.append(LensErrors(lens))
            if self.attitude is not None:
                turn, sigma = self.attitude.camera_from_body, self.attitude.sigma_rad
                models.append(StatedAttitude(turn, sigma, 6 + lens.sigmas.size))
            estimate = solve(models, state, partial(move_with_lens, lens=lens), iteration)
            state = estimate.state
        return estimate

    def _build_pose(self, estimate: Estimate[LensPose], used: BoolArray) -> PickedPose:
        state = estimate.state
        pixels, _ = predict(self.camera, state.pose, self.points.places_m)
        middle = self.lens.middle_px
        predicted = middle + state.shift_px + (1.0 + state.focal) * (pixels - middle)
        cost, freedom = estimate.cost, estimate.degrees_of_freedom
        covariance = estimate.covariance[:6, :6] * estimate_inflation(cost, freedom)
        left_px = self.points.pixels - predicted
        sigmas = np.sqrt(np.diag(estimate.covariance)[6:] * estimate_inflation(cost, freedom))
        lens = make_lens_estimate(state, sigmas, self.lens)
        return PickedPose(state.pose, covariance, used, left_px, cost, freedom, state.focal, lens)

    def _test_residuals(
        self, estimate: Estimate[LensPose], used: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return squares (n,) of residuals over the errors that the fit leaves them; gates (n,)."""
        measured = estimate.measured
        variances = np.linalg.inv(measured.weights)
        by_state = measured.jacobian
        left = variances - by_state @ estimate.covariance @ by_state.transpose(0, 2, 1)
        # a point that alone fixes something leaves no residual along it: nothing to judge there
        left += variances * MIN_LEFT
        squares = np.einsum(
            "ni,nij,nj->n", measured.residuals, np.linalg.inv(left), measured.residuals
        )
        level = 1.0 - (1.0 - GATE_PROBABILITY) * min(1.0, 20.0 / max(int(used.sum()), 1))
        return squares, np.full(squares.shape, chi_square_quantile(level, 2))


def _draw_samples(count: int, size: int) -> Iterator[tuple[int, ...]]:
    samples = list(combinations(range(count), size)) if count <= 12 else []
    generator = np.random.default_rng(0)
    if not samples:
        for _ in range(MAX_SAMPLES):
            yield tuple(int(i) for i in generator.choice(count, size, replace=False))
        return
    for number in generator.permutation(len(samples))[:MAX_SAMPLES]:
        yield samples[number]


def _convert_pose(turn: ArrayLike, shift: ArrayLike, middle: FloatArray) -> Pose:
    camera_from_body = Rotation.from_rotvec(np.asarray(turn, np.float64).ravel())
    position = -camera_from_body.inv().apply(np.asarray(shift, np.float64).ravel())
    return Pose(middle + position, camera_from_body)


def _make_mirror_pose(pose: Pose, places_m: FloatArray) -> Pose:
    """Mirror the plane of the points: a distant camera sees them nearly so from the new pose.

    The plane is mirrored in depth: seen from far off only perspective tells both apart.
    """
    middle = places_m.mean(axis=0)
    turn = pose.camera_from_body.as_matrix()
    sight = turn @ (middle - pose.position_m)
    depth = sight / np.linalg.norm(sight)
    normal = np.linalg.svd(places_m - middle)[2][2]
    mirror = np.eye(3) - 2.0 * np.outer(depth, depth)
    other = mirror @ turn @ (np.eye(3) - 2.0 * np.outer(normal, normal))
    return Pose(middle - other.T @ sight, Rotation.from_matrix(other))


def try_solve(problem: PickedResection) -> PickedPose | None:
    try:
        return problem.solve()
    except NoSolutionError:
        return None
