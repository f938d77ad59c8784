"""An arc of zenith distances as one linear problem: nodes at steps of the motion, sights between.

A node for each sight would cost a filter's step each; sights of an interval are carried from the
node before them in one integration and made into at most as many rows as there are unknowns (QR),
which say all that they say.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.geometry.rotations import ARCSEC
from optnav_cli.estimation.smoother import LinearArc, NodeMeasurement, SmoothedArc
from optnav_cli.orbit.fit.motion import rnb_of
from optnav_cli.orbit.fit.problem import SIZES, FitParameter, OrbitProblem, Trajectory
from optnav_cli.orbit.fit.settings import OF_FIXES
from optnav_cli.orbit.fit.zenith import ZenithSights, zenith_distances

# Of the mean motion: no orbit is lower than this share of the radius; steps in radians at the ends.
LOWEST, STEP_RAD = 0.97, 0.4
MAX_RAD = 120.0  # of the lowest orbit's motion: what is looked at of a long arc
MAX_USED = 300  # sights
# What a direction may differ from the model's, and its vectors but the first two: small orbits'
# eccentricities.
MODEL_ERROR, ECCENTRIC = 3e-3, 0.1
FLAT = 1e-6  # of the stars' moments: below it they lie in one plane
SHAPE_ERROR = 0.1
MAX_FOUND = 4


@dataclass(frozen=True, eq=False)
class SightRows:
    """All sights about a trajectory: measured less computed (n,), rad, and what it depends on.

    design      (n, 6 + p) derivative of the computed one by the node's state and the parameters
    considered  (n, q) by what is considered
    """

    residuals: FloatArray
    design: FloatArray
    considered: FloatArray


@dataclass(eq=False)
class ZenithProblem(OrbitProblem):
    """Sights with the nodes that they are carried from; `between` are the nodes, no fixes."""

    sights: ZenithSights = field(kw_only=True)
    node_of_sight: IntArray = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        number = np.searchsorted(self.times, self.sights.tdb_s, "right") - 1
        self.node_of_sight = np.clip(number, 0, max(len(self.times) - 2, 0))

    @property
    def measured(self) -> str:
        """Name of the measurements that the orbit is fitted to."""
        return "zenith distances"

    @property
    def sizes(self) -> Mapping[str, int]:
        """With two numbers for each star, along east and north."""
        return {**SIZES, "star_catalog": 2 * len(self.sights.names)}

    def part(self, first: int, last: int) -> "ZenithProblem":
        """Cut the problem between two of its nodes."""
        if (first, last) == (0, len(self.times) - 1):
            return self
        ends = float(self.times[first]), float(self.times[last])
        times = self.sights.tdb_s
        inside = self.sights.part((times >= ends[0]) & (times <= ends[1]))
        priors = [p for p in self.priors if ends[0] <= p.tdb_s <= ends[1]]
        return replace(self, sights=inside, priors=priors, between=self.times[first : last + 1])

    def rows(self, at: Trajectory) -> SightRows:
        """The sights about a trajectory."""
        sights, count = self.sights, len(self.sights)
        forces = [p for p in (*self.estimated, *self.considered) if p.name not in OF_FIXES]
        names = [p.name for p in forces]
        motion = self.motion_at(at)
        states, maps = np.empty((count, 6)), np.empty((count, 6, 6))
        pushed = np.empty((count, 6, sum(p.size for p in forces)))
        ends = np.searchsorted(self.node_of_sight, np.arange(len(self.times) + 1))
        for node in np.unique(self.node_of_sight):
            here = slice(int(ends[node]), int(ends[node + 1]))
            start = float(self.times[node])
            carried = motion.partials(at.states[node], start, sights.tdb_s[here], names)
            states[here], maps[here], pushed[here] = carried
        angles, by_place, by_star = zenith_distances(states[:, :3], sights.directions)
        width, q = self.width, sum(p.size for p in self.considered)
        design, considered = np.zeros((count, width)), np.zeros((count, q))
        design[:, :6] = (by_place[:, None] @ maps[:, :3])[:, 0]
        column = 0
        by_forces = (by_place[:, None] @ pushed[:, :3])[:, 0]
        for p in forces:
            _put(p, by_forces[:, column : column + p.size], design, considered)
            column += p.size
        for p in (*self.estimated, *self.considered):
            if p.name in ("vertical", "star_catalog"):
                by = self._by_vertical(states, by_place) if p.name == "vertical" else None
                by = self._by_stars(by_star) if by is None else by
                if p.settings.mode == "estimate":
                    angles = angles + by @ self.value(p, at)
                _put(p, by, design, considered)
        return SightRows(sights.values_rad - angles, design, considered)

    def _by_vertical(self, states: FloatArray, by_place: FloatArray) -> FloatArray:
        """(n, 2) by the error of the vertical forward and across, rad per arc second."""
        axes = np.stack([rnb_of(state) for state in states])
        size = np.linalg.norm(states[:, :3], axis=1)[:, None]
        turned: FloatArray = (axes[:, 1:] @ by_place[:, :, None])[:, :, 0] * size * ARCSEC
        return turned

    def _by_stars(self, by_star: FloatArray) -> FloatArray:
        """(n, 2 stars) by where each star is wrongly taken to stand, rad per arc second."""
        along = (self.sights.star_axes @ by_star[:, :, None])[:, :, 0] * ARCSEC
        derivative = np.zeros((len(along), len(self.sights.names), 2))
        derivative[np.arange(len(along)), self.sights.star_of] = along
        return derivative.reshape(len(along), -1)

    def linearise(
        self, at: Trajectory, weights: FloatArray, sigmas: FloatArray | None = None
    ) -> tuple[LinearArc, FloatArray]:
        """Linearise as the problem of fixes does; weights (sights,)."""
        arc, paths = super().linearise(at, np.empty(0), sigmas)
        measured = [
            NodeMeasurement(node, right, design, np.eye(len(right)))
            for node, design, right in self._whitened(self.rows(at), weights, paths)
        ]
        compressed = [
            _compressed(measurement)[0] if len(measurement.residual) > self.width else measurement
            for measurement in measured
        ]
        return replace(arc, measurements=[*arc.measurements, *compressed]), paths

    def left_over(self, at: Trajectory, weights: FloatArray) -> float:
        """Return the residuals that no change of the nodes' states takes away."""
        return self.remainder(self.rows(at), weights)

    def standardised(
        self, at: Trajectory, found: SmoothedArc, used: BoolArray
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Standardise as the problem of fixes does; the sights of a star are a series."""
        sights = self.sights
        values = self.rows(at).residuals / sights.sigmas_rad
        return values[used], sights.star_of[used], sights.tdb_s[used]

    def remainder(self, rows: SightRows, weights: FloatArray) -> float:
        """Return the part of chi-square that no change of the nodes' states takes away."""
        paths = np.zeros((len(self.times), self.width, rows.considered.shape[1]))
        total = 0.0
        for node, design, right in self._whitened(rows, weights, paths):
            if len(right) > self.width:
                interval = NodeMeasurement(node, right, design, np.eye(len(right)))
                total += _compressed(interval)[1]
        return total

    def _whitened(
        self, rows: SightRows, weights: FloatArray, paths: FloatArray
    ) -> list[tuple[int, FloatArray, FloatArray]]:
        """Each interval's node, design (m, n) and right sides (m, 1 + q), over their sigmas."""
        scale = np.sqrt(weights) / self.sights.sigmas_rad
        whitened = []
        for node in np.unique(self.node_of_sight):
            here = np.flatnonzero((self.node_of_sight == node) & (weights > 0.0))
            if not len(here):
                continue
            design = rows.design[here]
            more = design @ paths[node] + rows.considered[here]
            right = np.concatenate([rows.residuals[here, None], more], axis=1)
            whitened.append((int(node), design * scale[here, None], right * scale[here, None]))
        return whitened


def _put(p: FitParameter, columns: FloatArray, design: FloatArray, considered: FloatArray) -> None:
    if p.settings.mode == "estimate":
        design[:, 6 + p.first : 6 + p.first + p.size] = columns
    else:
        considered[:, p.span] = columns


def _compressed(one: NodeMeasurement) -> tuple[NodeMeasurement, float]:
    """Compress rows to as many as unknowns; also return the squares of the residual left."""
    q, r = np.linalg.qr(one.design)
    right = q.T @ one.residual
    remainder = float((one.residual[:, 0] ** 2).sum() - (right[:, 0] ** 2).sum())
    return NodeMeasurement(one.node, right, r, np.eye(len(r))), remainder


@dataclass(frozen=True, eq=False)
class FirstOrbit:
    """A state (6,) at a time, inertial, and how badly its model fits."""

    tdb_s: float
    state: FloatArray
    cost: float


def first_orbits(sights: ZenithSights, gm: float, radius_m: float) -> list[FirstOrbit]:
    """Circular orbits that may have the sights, the best one first; of two stars in mirrored pairs.

    The sights are of two stars or more.
    """
    fastest = float(np.sqrt(gm / (LOWEST * radius_m) ** 3))
    times = sights.tdb_s - sights.tdb_s[0]
    inside = np.flatnonzero(times <= MAX_RAD / fastest)
    used = inside[np.unique(np.linspace(0, len(inside) - 1, MAX_USED).round().astype(int))]
    times, stars = times[used], sights.directions[used]
    middle = 0.5 * float(times[-1])
    since, cosines = times - middle, np.cos(sights.values_rad[used])
    steps = max(int(np.ceil(fastest * float(times[-1]) / STEP_RAD)), 4)
    rates = fastest * np.arange(1, steps + 1) / steps
    vectors, costs = _fitted(rates, since, stars, cosines)
    moments, axes = np.linalg.eigh(stars.T @ stars / len(stars))
    across = axes[:, 0] if moments[0] < FLAT else None
    candidates = []
    for k, rate in enumerate(rates):
        for cosine_axis, sine_axis in _pairs(vectors[k, 1], vectors[k, 2], across):
            off = [
                float(cosine_axis @ cosine_axis) - 1.0,
                float(sine_axis @ sine_axis) - 1.0,
                2.0 * float(cosine_axis @ sine_axis),
            ]
            cost = float(costs[k]) + float(np.square(off).sum()) / SHAPE_ERROR**2
            left, _, right = np.linalg.svd(np.array([cosine_axis, sine_axis]), full_matrices=False)
            first, second = left @ right
            size = float(gm / rate**2) ** (1.0 / 3.0)
            state = np.concatenate([size * first, size * rate * second])
            candidates.append(FirstOrbit(float(sights.tdb_s[0]) + middle, state, cost))
    return sorted(candidates, key=lambda orbit: orbit.cost)[:MAX_FOUND]


def _fitted(
    rates: FloatArray, since: FloatArray, stars: FloatArray, cosines: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Vectors (k, 5, 3) of 1, cos, sin, cos and sin of twice, and costs (k,) of each rate."""
    angle = rates[:, None] * since
    basis = np.ones((*angle.shape, 5))
    basis[..., 1], basis[..., 2] = np.cos(angle), np.sin(angle)
    basis[..., 3], basis[..., 4] = np.cos(2.0 * angle), np.sin(2.0 * angle)
    rows = (basis[..., None] * stars[:, None]).reshape(len(rates), len(since), 15)
    ridge = np.repeat([ECCENTRIC, 1.0, 1.0, ECCENTRIC, ECCENTRIC], 3) ** -2.0
    normal = rows.transpose(0, 2, 1) @ rows / MODEL_ERROR**2 + np.diag(ridge)
    right = rows.transpose(0, 2, 1) @ cosines / MODEL_ERROR**2
    solution = np.linalg.solve(normal, right[..., None])[..., 0]
    residuals = (rows @ solution[..., None])[..., 0] - cosines
    costs = (residuals**2).sum(axis=1) / MODEL_ERROR**2 + (solution**2 * ridge).sum(axis=1)
    return np.asarray(solution.reshape(-1, 5, 3), np.float64), np.asarray(costs, np.float64)


def _pairs(
    first: FloatArray, second: FloatArray, across: FloatArray | None
) -> list[tuple[FloatArray, FloatArray]]:
    """The two axes; where the stars lie in a plane, with what lies across it, either way."""
    if across is None:
        return [(first, second)]
    first, second = first - (first @ across) * across, second - (second @ across) * across
    a, b = (float(np.sqrt(max(1.0 - float(v @ v), 0.0))) for v in (first, second))
    sign = -1.0 if float(first @ second) > 0.0 else 1.0
    return [(first + side * a * across, second + side * sign * b * across) for side in (1.0, -1.0)]
