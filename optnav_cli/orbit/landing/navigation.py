"""Navigation on a digital surface: a craft's state from ranges along the beams of an altimeter.

Source: Tuchin, thesis (2010), chapter 2, (7): least squares with the expected state as a prior. The
model of the surface is wrong alike over kilometres; its error is considered in the weights, with
the correlation of neighbouring points of the ground. Weights take a part of that error as each
ray's own, without which fits do not settle; the covariance is what those weights leave of errors of
the model's vertices, between which its faces average. A range over relief has many minima: weights
that fall with the residual open the way in the first two steps, a fit that the residuals refute
starts again beside, and so does one that does not settle: wrong minima hold most of those. Beams
that met the ground say more than their lengths: a state under which they pass beside the body is
wrong, however well the others fit. What no start makes fit is refused.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import NoSolutionError
from optnav_cli.orbit.landing.rays import DigitalSurface, GroundHits
from optnav_cli.orbit.qso.motion import MoonMotion, split
from optnav_cli.reasons import ReasonCode

QUICK_STEPS, MAX_STEPS = 5, 12  # the source has 5; more where no start settles in these
WIDE_M = (2000.0, 300.0)  # residuals that count half in the first steps
MIN_SLANT = 0.2  # |g'u|: flatter beams tell more of the ground than of the craft
STEP_S = 60.0
SETTLED, FULL_STEPS = 0.05, 3  # of a sigma; steps after which halves are taken
# Weighted residuals, rms over their expectation, beyond which a fit is wrong: n of them scatter by
# 1 / sqrt(2 n). Right fits of the grounds of seeds 1 and 3 reach 1.13 with 204.
CHI_SIGMAS = 5.0
# Of the beams, that met the ground and by the model meet none, or the reverse, though not flat:
# right fits of those grounds have at most one of 194; a wrong one that looked right had 61 of 163.
MAX_MISSED = 0.05
RESTARTS, LONG_STARTS = 20, 4
MIN_RANGES = 6
# Of the variance of heights that weights take as not shared by neighbours: with less, fits settle
# on wrong states; found on the grounds of seed 1 of the study landing, whose figures are of seed 5.
ROUGH = 0.1
NEAR_M = 4000.0  # from a target; twice as far off the model is as wrong as anywhere


@dataclass(frozen=True)
class SurfaceError:
    """Error of the surface's model: 1 sigma of its heights and their correlation length.

    near_m, site  1 sigma within NEAR_M of a place (3,), body frame, which pictures have shown
    """

    sigma_m: float
    length_m: float
    near_m: float = 0.0
    site: tuple[float, float, float] | None = None

    def sigma(self, points: FloatArray) -> FloatArray:
        """(n,) 1 sigma at points (n, 3)."""
        if self.site is None or self.near_m >= self.sigma_m:
            return np.full(len(points), self.sigma_m)
        distance = np.linalg.norm(points - np.array(self.site), axis=1) / NEAR_M
        share = np.clip(distance - 1.0, 0.0, 1.0)
        sigmas: FloatArray = self.near_m + (self.sigma_m - self.near_m) * share
        return sigmas

    def covariance(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """(n, m) of the heights' errors at points (n, 3) and (m, 3)."""
        squares = np.einsum("ij,ij->i", points, points)[:, None]
        apart = squares + np.einsum("ij,ij->i", others, others) - 2.0 * points @ others.T
        sizes = np.outer(self.sigma(points), self.sigma(others))
        covariances: FloatArray = sizes * np.exp(-np.sqrt(np.maximum(apart, 0.0)) / self.length_m)
        return covariances


@dataclass(frozen=True, eq=False)
class BeamRanges:
    """Ranges of one flight.

    tdb_s     (n,) times
    rays      (n, k, 3) unit beams, body frame
    range_m   (n, k) measured, NaN where the ground was not met
    noise_m   1 sigma
    """

    tdb_s: FloatArray
    rays: FloatArray
    range_m: FloatArray
    noise_m: float


@dataclass(frozen=True, eq=False)
class RangeFix:
    """A state at the first time (6,) inertial with its covariance (6, 6).

    chi    weighted residuals, rms over their expectation;  ranges  how many
    missed share of the beams of which the state has it wrong whether they meet the ground
    steps  of the start that fitted;  starts  how many it took
    settled  whether its last step was short
    weighted (6, 6) what the covariance would be, were the weights the inverse of the errors'
    """

    state: FloatArray
    covariance: FloatArray
    weighted: FloatArray
    chi: float
    ranges: int
    missed: float
    steps: int
    starts: int
    settled: bool = True

    @property
    def fits(self) -> bool:
        """Whether neither the residuals nor the beams that meet nothing refute it."""
        return self.chi < 1.0 + CHI_SIGMAS / np.sqrt(2.0 * self.ranges) and self.missed < MAX_MISSED


@dataclass(frozen=True, eq=False)
class GroundEstimate:
    """Height of the ground over its model at places, estimated from the ranges of a flight.

    mean (m,), covariance (m, m), m and m^2;  with_state  (6, m) covariance with the fix's state
    """

    mean: FloatArray
    covariance: FloatArray
    with_state: FloatArray

    def moved(self, transition: FloatArray) -> "GroundEstimate":
        """Return it with the state at another time, to which a transition (6, 6) leads."""
        return GroundEstimate(self.mean, self.covariance, transition @ self.with_state)


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Ranges about a state: residuals (m,), by the state (m, 6), points of the ground (m, 3).

    shorter  (m,) by how much a range is shorter where the ground is 1 m higher
    faces    (m,) of the model's mesh that the points lie on
    missed   share of the beams of which the state has it wrong whether they meet the ground
    """

    residuals: FloatArray
    jacobian: FloatArray
    points: FloatArray
    shorter: FloatArray
    faces: IntArray
    missed: float


class RangeNavigator:
    """Fits states to ranges over a model of the ground."""

    def __init__(
        self,
        motion: MoonMotion,
        ground: DigitalSurface,
        error: SurfaceError,
        max_steps: int = MAX_STEPS,
    ) -> None:
        self._motion, self._ground, self._error = motion, ground, error
        self._max_steps = max_steps

    def fit(
        self, ranges: BeamRanges, prior: FloatArray, prior_covariance: FloatArray, seed: int = 0
    ) -> RangeFix:
        """The state at the first time from a prior (6,) with its covariance (6, 6).

        Raises NoSolutionError when too few beams meet the ground or no start makes them fit.
        """
        if np.isfinite(ranges.range_m).sum() < MIN_RANGES:
            raise NoSolutionError(
                f"{int(np.isfinite(ranges.range_m).sum())} beams meet the ground; "
                f"wanted {MIN_RANGES}",
                ReasonCode.NO_SOLUTION,
            )
        rng = np.random.default_rng(seed)
        spread = np.linalg.cholesky(prior_covariance)
        asides = np.concatenate([np.zeros((1, 6)), rng.normal(size=(RESTARTS, 6)) @ spread.T])
        quick = [(aside, min(QUICK_STEPS, self._max_steps)) for aside in asides]
        tries = [*quick, *((aside, self._max_steps) for aside in asides[:LONG_STARTS])]
        least = np.inf
        for number, (aside, most) in enumerate(tries, start=1):
            before = (prior, prior_covariance)
            fix = self._from(ranges, prior + aside, before, (number, most))
            if fix is None:
                continue
            least = min(least, fix.chi)
            if fix.settled and fix.fits:
                return fix
        left = f"{least:.1f} sigmas are left" if np.isfinite(least) else "all lead astray"
        raise NoSolutionError(
            f"no state fits the ranges from {RESTARTS + 1} starts: none settles, {left}",
            ReasonCode.NO_SOLUTION,
        )

    def ground(self, ranges: BeamRanges, fix: RangeFix, places: FloatArray) -> GroundEstimate:
        """Estimate the ground at places (m, 3) near the surface from the ranges of a fix."""
        before = self._error.covariance(places, places)
        parts = self._linearised(ranges, fix.state)
        if parts is None:
            return GroundEstimate(np.zeros(len(places)), before, np.zeros((6, len(places))))
        corners, shares = self._corners(parts)
        by_corners = self._error.covariance(places, corners.reshape(-1, 3))
        by_corners = by_corners.reshape(len(places), -1, 3)
        cross = -np.einsum("naj,aj->na", by_corners, shares) * parts.shorter
        weighing = self._weighing(ranges, parts)
        gains = _solved(weighing, cross.T).T
        by_ranges = fix.weighted @ _solved(weighing, parts.jacobian).T  # the state's error
        # the state is estimated from the same ranges: its error is in their residuals
        by_state = -gains @ parts.jacobian
        errors = self._errors(ranges, parts)
        with_state = by_ranges @ (errors @ gains.T - cross.T) + fix.covariance @ by_state.T
        spread = (gains @ errors - 2.0 * cross) @ gains.T + before
        spread += by_state @ (2.0 * with_state - fix.covariance @ by_state.T)
        covariance = 0.5 * (spread + spread.T)
        return GroundEstimate(gains @ parts.residuals, covariance, with_state)

    def _from(
        self,
        ranges: BeamRanges,
        state: FloatArray,
        prior: tuple[FloatArray, FloatArray],
        start: tuple[int, int],
    ) -> RangeFix | None:
        """The fit from one start, its number and most steps; None where it goes astray."""
        expected, prior_covariance = prior
        information = np.linalg.inv(prior_covariance)
        wide, settled = len(WIDE_M), False
        number, most = start
        for step in range(most + wide):
            parts = self._linearised(ranges, state)
            if parts is None:
                return None
            jacobian = parts.jacobian
            if step < wide:
                weights = 1.0 / (1.0 + (parts.residuals / WIDE_M[step]) ** 2) / 100.0**2
                weighted = weights[:, None] * jacobian
            else:
                weighted = _solved(self._weighing(ranges, parts), jacobian)
            normal = jacobian.T @ weighted + information
            gradient = weighted.T @ parts.residuals + information @ (expected - state)
            change = np.linalg.solve(normal, gradient)
            # at the edges of a mesh's faces the slope jumps: half steps end the turning to and fro
            state = state + (0.5 if step > wide + FULL_STEPS else 1.0) * change
            settled = bool(step >= wide and change @ normal @ change < 6.0 * SETTLED**2)
            if settled:
                break
        parts = self._linearised(ranges, state)
        if parts is None:
            return None
        residuals, count = parts.residuals, len(parts.residuals)
        weighing, jacobian = self._weighing(ranges, parts), parts.jacobian
        both = _solved(weighing, np.column_stack([jacobian, residuals]))
        square = residuals @ both[:, 6]
        weighted = np.linalg.inv(jacobian.T @ both[:, :6] + information).astype(np.float64)
        gains = weighted @ both[:, :6].T
        covariance = gains @ self._errors(ranges, parts) @ gains.T
        covariance += weighted @ information @ weighted
        off = state - expected
        square += off @ information @ off
        chi, steps = float(np.sqrt(square / count)), step + 1 - wide
        missed = parts.missed
        return RangeFix(state, covariance, weighted, chi, count, missed, steps, number, settled)

    def _linearised(self, ranges: BeamRanges, state: FloatArray) -> _Linearised | None:
        """Linearise ranges over ground that is not flat to the beam; None for too few."""
        flown = self._motion.propagate(state, ranges.tdb_s, STEP_S, transition=True)
        states, transitions = split(flown)
        turns = body_from_inertial(self._motion.moon, ranges.tdb_s)
        beams = ranges.rays.shape[1]
        places = np.repeat(np.einsum("nij,nj->ni", turns, states[:, :3]), beams, axis=0)
        if not np.isfinite(places).all() or np.linalg.norm(places, axis=1).min() < 5e3:
            return None
        rays = ranges.rays.reshape(-1, 3)
        hits: GroundHits = self._ground.ranges(places, rays)
        slant = -np.einsum("ij,ij->i", hits.normals, rays)
        residuals = ranges.range_m.ravel() - hits.range_m
        good = np.isfinite(residuals) & (slant > MIN_SLANT)
        if good.sum() < MIN_RANGES:
            return None
        met, meets = np.isfinite(ranges.range_m.ravel()), np.isfinite(hits.range_m)
        wrong = met & ~meets | ~met & meets & (slant > MIN_SLANT)
        by_place = np.repeat(turns @ transitions[:, :3], beams, axis=0)[good]
        gradient = hits.normals[good] / slant[good, None]
        jacobian = np.einsum("ni,nij->nj", gradient, by_place)
        missed, points = float(wrong.sum() / met.sum()), hits.points[good]
        up = points / np.linalg.norm(points, axis=1)[:, None]
        shorter = np.einsum("ni,ni->n", gradient, up)
        return _Linearised(residuals[good], jacobian, points, shorter, hits.faces[good], missed)

    def _weighing(self, ranges: BeamRanges, parts: _Linearised) -> FloatArray:
        """(m, m) whose inverse are the weights: noise, and the surface's error along the ranges."""
        points, shorter = parts.points, parts.shorter
        matrix = (1.0 - ROUGH) * self._error.covariance(points, points) * np.outer(shorter, shorter)
        matrix[np.diag_indices(len(points))] += ROUGH * (self._error.sigma(points) * shorter) ** 2
        matrix[np.diag_indices(len(points))] += ranges.noise_m**2
        return matrix

    def _errors(self, ranges: BeamRanges, parts: _Linearised) -> FloatArray:
        """(m, m) covariance of the ranges: noise, and what the model's vertices are wrong by."""
        corners, shares = self._corners(parts)
        count, flat = len(corners), corners.reshape(-1, 3)
        moved = shares * parts.shorter[:, None]
        every = self._error.covariance(flat, flat).reshape(count, 3, count, 3)
        total: FloatArray = np.einsum("ai,aibj,bj->ab", moved, every, moved, optimize=True)
        total[np.diag_indices(count)] += ranges.noise_m**2
        return total

    def _corners(self, parts: _Linearised) -> tuple[FloatArray, FloatArray]:
        """(m, 3, 3) of the faces that ranges end on, and (m, 3) what each says of the point."""
        corners = self._ground.mesh.corners[parts.faces]
        shares = np.linalg.solve(corners.transpose(0, 2, 1), parts.points[..., None])[..., 0]
        return corners, shares.astype(np.float64)


def beams_about(
    axis: FloatArray, off_rad: float, turned_rad: float | FloatArray = 0.0
) -> FloatArray:
    """Four unit beams (..., 4, 3) at an angle off unit axes (..., 3), square about it.

    turned_rad  (...) how far the craft has turned about each axis
    """
    helper = np.where(np.abs(axis[..., 2:3]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v = np.cross(axis, u)
    around = np.radians([45.0, 135.0, 225.0, 315.0]) + np.asarray(turned_rad)[..., None]
    sides = (
        np.cos(around)[..., None] * u[..., None, :] + np.sin(around)[..., None] * v[..., None, :]
    )
    directions: FloatArray = np.cos(off_rad) * axis[..., None, :] + np.sin(off_rad) * sides
    return directions


def _solved(matrix: FloatArray, right: FloatArray) -> FloatArray:
    solution: FloatArray = np.linalg.solve(matrix, right).astype(np.float64)
    return solution
