"""An arc's fixes, the numbers common to them, and both as one linear problem about a trajectory.

A fix is body-fixed: h = Q(t + d) x(t + d) + s height up + b, with Q = body from inertial, the clock
offset d of its camera or run, the relative focal error s, and the map's offset b. A focal length
wrong by s moves a fix by its height times s along the vertical; one of picked points by its
distance times s along the line of sight.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.geometry.vectors import unit
from optnav_cli.estimation.smoother import LinearArc, NodeMeasurement, SmoothedArc
from optnav_cli.orbit.fit.motion import ArcMotion, rnb_of
from optnav_cli.orbit.fit.parameters import (
    SIZES,
    FitParameter,
    SharedErrorSizes,
    parameters_of,
    shared_errors,
)
from optnav_cli.orbit.fit.scalars import ScalarArc, ScalarRows, ScalarSet
from optnav_cli.orbit.fit.settings import ParameterSettings
from optnav_cli.orbit.fit.zenith import ZenithSights

SAME_TIME_S = 1e-3  # fixes of one node
# Of the first state where no prior states one: a share of the distance, but no more sigmas of a fix
# than leave the covariance digits; once the state's own sigmas are known, so many of these. About
# the state of the step before, so it moves no orbit.
OPEN_SHARE, OPEN_SIGMAS, OPEN_AGAIN = 0.1, 1e4, 1e3


@dataclass(frozen=True, eq=False)
class OrbitFix:
    """A solved frame: its place (3,), m, body-fixed as files state it, and covariance (3, 3).

    method   that solved it; empty: its error is like no other's
    time_sigma_s  1 sigma of its time; None: not stated
    timing_m2     (3, 3) what that adds to its covariance
    sight_m  (3,) from the ground in the middle of its picture to the craft; None: straight up
    """

    file: str
    utc: str
    tdb_s: float
    run: str
    camera: str
    position_m: FloatArray
    covariance_m2: FloatArray
    method: str = ""
    sight_m: FloatArray | None = None
    time_sigma_s: float | None = None
    timing_m2: FloatArray | None = None

    @property
    def sighted_m2(self) -> FloatArray:
        """Covariance (3, 3) without that of the time, which no other fix shares."""
        return self.covariance_m2 if self.timing_m2 is None else self.covariance_m2 - self.timing_m2


@dataclass(frozen=True, eq=False)
class OrbitPrior:
    """A state (6,) and its covariance (6, 6), inertial, m and m/s, at a time, from elsewhere."""

    tdb_s: float
    state: FloatArray
    covariance: FloatArray
    source: str


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States (N, 6) of the nodes, inertial, and the parameters (p,) estimated."""

    states: FloatArray
    parameters: FloatArray


@dataclass(eq=False)
class OrbitProblem:
    """Measurements of an arc: fixes with their nodes, and scalar ones between nodes.

    between   (n,) TDB s: further times that are nodes; with scalar ones they span these
    sights    zenith distances;  tracking  further sets of scalar measurements
    shared_sizes  of what near fixes have in common; None: those that ship

    A linear arc has the state, the parameters estimated and, last, the numbers that near fixes have
    in common. These are linear and about 0: a trajectory does not hold them.
    """

    motion: ArcMotion
    fixes: list[OrbitFix]
    priors: list[OrbitPrior]
    parameters: list[ParameterSettings]
    radius_m: float
    between: FloatArray = field(default_factory=lambda: np.empty(0))
    shared_sizes: SharedErrorSizes | None = None
    sights: ZenithSights | None = field(default=None, kw_only=True)
    tracking: Sequence[ScalarSet] = field(default=(), kw_only=True)
    times: FloatArray = field(init=False)
    node_of: list[int] = field(init=False)
    prior_nodes: list[int] = field(init=False)

    def __post_init__(self) -> None:
        self.fixes = sorted(self.fixes, key=lambda fix: fix.tdb_s)
        self.estimated, self.considered = parameters_of(
            self.parameters, self.motion.thrusts, self.sizes
        )
        every = sorted([f.tdb_s for f in self.fixes] + [p.tdb_s for p in self.priors])
        times: list[float] = []
        for time in every:
            if not times or time - times[-1] > SAME_TIME_S:
                times.append(time)
        near = np.array(times or [np.inf])
        free = [float(time) for time in self.between if np.abs(near - time).min() > SAME_TIME_S]
        self.times = np.sort(np.array([*times, *free]))
        self.scalars = ScalarArc(self.sets, self.times)
        self.node_of = [self._node(fix.tdb_s) for fix in self.fixes]
        self.prior_nodes = [self._node(prior.tdb_s) for prior in self.priors]
        ephemeris = self.ephemeris
        self._turns = [ephemeris.body_from_inertial(fix.tdb_s) for fix in self.fixes]

        places = np.array([fix.position_m for fix in self.fixes]).reshape(-1, 3)
        stamps = np.array([fix.tdb_s for fix in self.fixes])
        covariances = np.array([fix.sighted_m2 for fix in self.fixes]).reshape(-1, 3, 3)
        methods = [fix.method for fix in self.fixes]
        self.shared = shared_errors(
            places, covariances, stamps, methods, self.radius_m, self.shared_sizes
        )

    def _node(self, time: float) -> int:
        return int(np.argmin(np.abs(self.times - time)))

    @property
    def measured(self) -> str:
        """Name of the measurements that the orbit is fitted to."""
        names = ["fixes"] if self.fixes or not self.sets else []
        return " and ".join(dict.fromkeys([*names, *(part.measured for part in self.sets)]))

    @property
    def sets(self) -> tuple[ScalarSet, ...]:
        """The sets of scalar measurements."""
        every = (self.sights, *self.tracking)
        return tuple(part for part in every if part is not None and len(part))

    @property
    def count(self) -> int:
        """Number of measurements: fixes, then scalar ones."""
        return len(self.fixes) + len(self.scalars)

    @property
    def ephemeris(self) -> Ephemeris:
        return self.motion.ephemeris

    @property
    def sizes(self) -> Mapping[str, int]:
        """Number of components of each parameter; 1 where not named."""
        sizes = dict(SIZES)
        for part in self.sets:
            sizes |= part.sizes
        return sizes

    @property
    def width(self) -> int:
        """Size of the state with the parameters estimated, without errors common to near fixes."""
        return 6 + sum(parameter.size for parameter in self.estimated)

    def prior_covariance(self, parameters: Sequence[FitParameter]) -> FloatArray:
        """(p, p) of parameters before the fixes are looked at."""
        return np.array(block_diag(np.empty((0, 0)), *(p.covariance for p in parameters)))

    def inertial(self, number: int) -> FloatArray:
        """A fix's place (3,), inertial."""
        position: FloatArray = self.turn(number).T @ self.fixes[number].position_m
        return position

    def turn(self, number: int, offset_s: float = 0.0) -> FloatArray:
        """Rotation (3, 3), stated body frame from inertial, so long after a fix."""
        turn = self._turns[number]
        if offset_s:
            turn = self.ephemeris.body_from_inertial(self.fixes[number].tdb_s + offset_s)
        stated: FloatArray = self.ephemeris.body.catalog_frame.rotate_to_stated(turn.T).T
        return stated

    def value(self, parameter: FitParameter, trajectory: Trajectory) -> FloatArray:
        """Return the estimate of a parameter; 0 where it is only considered."""
        if parameter.settings.mode == "consider":
            return np.zeros(parameter.size)
        return trajectory.parameters[parameter.span]

    def motion_at(self, at: Trajectory) -> ArcMotion:
        """The motion with the force parameters as estimated."""
        of_forces = [p for p in self.estimated if p.moves_craft]
        return self.motion.with_added({p.name: self.value(p, at) for p in of_forces})

    def clock(self, number: int, trajectory: Trajectory) -> float:
        """Return the delay of a fix after its time stamp, s."""
        fix = self.fixes[number]
        clocks = [p for p in self.estimated if p.name == "clock" and p.applies(fix.camera, fix.run)]
        return float(sum(float(self.value(p, trajectory)[0]) for p in clocks))

    def measure(
        self, number: int, trajectory: Trajectory
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Residual (3,) of a fix, its derivatives (3, 6 + p), and (3, q) by what is considered."""
        fix, node = self.fixes[number], self.node_of[number]
        applying = [
            p for p in (*self.estimated, *self.considered) if p.applies(fix.camera, fix.run)
        ]
        offset = self.clock(number, trajectory)
        state, bring = trajectory.states[node], np.eye(6)
        after = fix.tdb_s + offset - float(self.times[node])
        if after:
            state, bring = self.motion_at(trajectory).carry(state, float(self.times[node]), after)
        turn = self.turn(number, offset)
        computed = turn @ state[:3]
        design = np.zeros((3, self.width))
        design[:, :6] = turn @ bring[:3]
        of_considered = np.zeros((3, sum(p.size for p in self.considered)))
        for p in applying:
            derivative = self._derivative(p, number, turn, state, offset)
            computed = computed + self._moved(p, derivative, trajectory)
            if p.settings.mode == "estimate":
                design[:, 6 + p.first : 6 + p.first + p.size] = derivative
            else:
                of_considered[:, p.span] = derivative
        return fix.position_m - computed, design, of_considered

    def split(self, number: int) -> tuple[FloatArray, FloatArray]:
        """(3, q) by which a fix moves with what near ones have in common, and (3, 3) its own."""
        fix = self.fixes[number]
        moved, unshared = self.shared.split(number, fix.sighted_m2)
        return moved, unshared if fix.timing_m2 is None else unshared + fix.timing_m2

    def rows(self, at: Trajectory) -> ScalarRows:
        """Linearise the scalar measurements about a trajectory."""
        parameters = (self.estimated, self.considered)
        return self.scalars.rows(self.motion_at(at), at.states, at.parameters, parameters)

    def left_over(self, at: Trajectory, weights: FloatArray) -> float:
        """Return the part of chi-square that no change of the nodes' states takes away."""
        if not self.sets:
            return 0.0
        return self.scalars.remainder(self.rows(at), weights[len(self.fixes) :])

    def standardised(
        self, at: Trajectory, found: SmoothedArc, used: BoolArray
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Residuals (n,) over their sigmas, number (n,) of the series of each, and TDB s (n,).

        The axes R, N, B of fixes are three series; what near fixes have in common is taken off.
        Scalar measurements have those of their sets.
        """
        rows, numbers = [], np.flatnonzero(used[: len(self.fixes)])
        for number in numbers:
            node, residual = self.node_of[number], self.measure(int(number), at)[0]
            moved, unshared = self.split(int(number))
            residual = residual - moved @ found.deviations[node, self.width :, 0]
            axes = rnb_of(at.states[node]) @ self.turn(int(number)).T
            root = np.linalg.cholesky(axes @ unshared @ axes.T)
            rows.append(solve_triangular(root, axes @ residual, lower=True))
        times = np.repeat([self.fixes[number].tdb_s for number in numbers], 3)
        values, series = np.array(rows).ravel(), np.tile(np.arange(3), len(rows))
        if not self.sets:
            return values, series, times
        kept, scalars = used[len(self.fixes) :], self.scalars
        standardised = self.rows(at).residuals / scalars.sigmas
        return (
            np.concatenate([values, standardised[kept]]),
            np.concatenate([series, scalars.series[kept] + 3]),
            np.concatenate([times, scalars.tdb_s[kept]]),
        )

    def _derivative(
        self, p: FitParameter, number: int, turn: FloatArray, state: FloatArray, offset: float
    ) -> FloatArray:
        """(3, size) of a fix's place by a parameter of fixes."""
        fix = self.fixes[number]
        if p.name == "map_offset":
            return np.eye(3)
        if p.name == "focal" and fix.sight_m is not None:
            return fix.sight_m[:, None]
        if p.name == "focal":
            height = float(np.linalg.norm(fix.position_m)) - self.radius_m
            return (height * unit(fix.position_m))[:, None]
        turned = self.turn(number, offset + 0.5) - self.turn(number, offset - 0.5)
        velocity: FloatArray = turn @ state[3:] + turned @ state[:3]
        return velocity[:, None]

    def _moved(self, p: FitParameter, derivative: FloatArray, at: Trajectory) -> FloatArray:
        """Return the effect of a parameter on the computed place; that of the clock is in it."""
        if p.name == "clock":
            return np.zeros(3)
        moved: FloatArray = derivative @ self.value(p, at)
        return moved

    def part(self, first: int, last: int) -> "OrbitProblem":
        """Cut the problem between two of its nodes, both and the priors there included."""
        if (first, last) == (0, len(self.times) - 1):
            return self
        inside = [k for k, node in enumerate(self.node_of) if first <= node <= last]
        priors = [
            p
            for p, node in zip(self.priors, self.prior_nodes, strict=True)
            if first <= node <= last
        ]
        fixes, between = [self.fixes[k] for k in inside], np.empty(0)
        tracking, sights = list(self.tracking), self.sights
        if self.sets:
            between = self.times[first : last + 1]
            tracking = [part.cut(between[0], between[-1]) for part in tracking]
            sights = None if sights is None else sights.cut(between[0], between[-1])
        return replace(
            self,
            fixes=fixes,
            priors=priors,
            between=between,
            sights=sights,
            tracking=tracking,
        )

    def linearise(
        self, at: Trajectory, weights: FloatArray, sigmas: FloatArray | None = None
    ) -> tuple[LinearArc, FloatArray]:
        """The linear problem about a trajectory, and the paths (N, n, q) of what is considered.

        n is the width with what near fixes have in common.

        weights  (measurements,) of each; 0 leaves one out
        sigmas   (6,) of the first state as the step before had them
        """
        n, count = self.width + self.shared.width, len(self.times)
        common = np.arange(self.width, n)
        fading = self.shared.fading(self.times)
        estimated = [p for p in self.estimated if p.moves_craft]
        considered = [p for p in self.considered if p.moves_craft]
        q = sum(p.size for p in self.considered)
        transitions, noises = np.tile(np.eye(n), (count - 1, 1, 1)), np.zeros((count - 1, n, n))
        defects = np.zeros((count - 1, n, 1 + q))
        paths = np.zeros((count, n, q))
        motion = self.motion_at(at)
        names = [p.name for p in (*estimated, *considered)]
        for i, step in enumerate(motion.steps(at.states[:-1], self.times, names)):
            transitions[i, :6, :6] = step.transition
            defects[i, :6, 0] = step.state - at.states[i + 1]
            noises[i, :6, :6] = step.noise
            transitions[i, common, common] = fading[i]
            noises[i, common, common] = 1.0 - fading[i] ** 2
            column = 0
            pushed = np.zeros((6, q))
            for p in (*estimated, *considered):
                gamma = step.by_parameters[:, column : column + p.size]
                column += p.size
                if p.settings.mode == "estimate":
                    transitions[i, :6, 6 + p.first : 6 + p.first + p.size] = gamma
                else:
                    pushed[:, p.span] = gamma
            paths[i + 1, :6] = step.transition @ paths[i, :6] + pushed
        measurements = [
            self._measurement(number, at, paths, weight)
            for number, weight in enumerate(weights[: len(self.fixes)])
            if weight > 0.0
        ]
        for prior, node in zip(self.priors, self.prior_nodes, strict=True):
            residual = np.zeros((6, 1 + q))
            residual[:, 0] = prior.state - at.states[node]
            residual[:, 1:] = paths[node, :6]
            measurements.append(NodeMeasurement(node, residual, np.eye(6, n), prior.covariance))
        if self.sets:
            scalar_weights = weights[len(self.fixes) :]
            moved = paths[:, : self.width]
            measurements += self.scalars.compressed(self.rows(at), scalar_weights, moved, n)
        offset = np.zeros((n, 1 + q))
        offset[6 : self.width, 0] = -at.parameters
        arc = LinearArc(
            transitions, defects, noises, measurements, offset, self._open_prior(at, sigmas)
        )
        return arc, paths

    def _measurement(
        self, number: int, at: Trajectory, paths: FloatArray, weight: float
    ) -> NodeMeasurement:
        residual, design, of_considered = self.measure(number, at)
        node = self.node_of[number]
        moved, unshared = self.split(number)
        design = np.concatenate([design, moved], axis=1)
        more = design @ paths[node] + of_considered
        columns = np.concatenate([residual[:, None], more], axis=1)
        return NodeMeasurement(node, columns, design, unshared / weight)

    def _open_prior(self, at: Trajectory, known: FloatArray | None) -> FloatArray:
        """Covariance of the first node: the state open, the parameters as stated before."""
        position = at.states[0, :3]
        spreads = [np.trace(fix.covariance_m2) / 3.0 for fix in self.fixes]
        open_m = OPEN_SHARE * float(np.linalg.norm(position))
        if spreads:
            open_m = min(open_m, OPEN_SIGMAS * float(np.sqrt(np.median(spreads))))
        sigmas = np.full(6, open_m)
        sigmas[3:] /= self.motion.radian_s(position)
        if known is not None:
            sigmas = np.clip(OPEN_AGAIN * known, sigmas / OPEN_SIGMAS, sigmas)
        known_before = self.prior_covariance(self.estimated)
        common = np.eye(self.shared.width)
        return np.array(block_diag(np.diag(sigmas**2), known_before, common))
