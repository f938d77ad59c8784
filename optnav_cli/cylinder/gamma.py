"""Gamma of a picture of a lit cylinder, by the shape of the upper and lower edges of its strip.

A lens blurs a straight edge evenly to both sides: in light, the shape of an edge is odd about its
half level, whatever the lens. Counts with a gamma stretch the dark side. Edges of many columns,
which fall on the pixels in all ways, show gamma and the shape together. The method is ours.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from catalog.arrays import Float32Array, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Coding
from optnav_cli.cylinder.fit import DISTANCE, THETA, CylinderFit, fit_cylinder
from optnav_cli.cylinder.geometry import CylinderSize, IdealLens
from optnav_cli.cylinder.profile import CylinderProfile, measure_profile

# Prior of gamma, 1 sigma: 1 of linear counts and 2.4 of screens lie inside.
GAMMA, GAMMA_SIGMA = 1.6, 0.7
MIN_GAMMA, MAX_GAMMA = 0.5, 4.0
STARTS = (1.0, 1.4, 1.8, 2.2, 2.6)  # a wrong gamma with another shape is a minimum of its own
ALIKE = 4.0  # samples that err alike, by which minima differ less than their costs say
# Pixels from an edge, between which its shape is a straight line; beyond, all or no light.
KNOTS_PX = np.array([*np.arange(0.0, 2.1, 0.25), 2.5, 3.0, 3.5, 4.0, 4.5])
BLUR_PX, SHAPE_SIGMA = 0.9, 0.1  # prior of the shape: blurred by a Gaussian; 1 sigma of a knot
REACH_PX, LEVEL_PX = 5, 8  # sampled to both sides of an edge; rows inside that give its level
MARGIN_COLUMNS = 3  # beside a limb, where the blur mixes columns with the background
BLOCK_COLUMNS = 8  # neighbouring columns have the same errors of shape: they count as one
MIN_EDGES = 16
STEP = 1e-4  # of numeric derivatives: of gamma, a share of the light, px
MAX_STEPS, SETTLED = 40, 1e-4  # of the fit; the step of gamma and shape that ends it
DAMPING, EASED, RAISED, MAX_DAMPING = 1e-2, 0.2, 10.0, 1e8
MAX_SHIFT_PX = 0.5  # of an edge in a step
DARKEST = 1e-4  # of full scale: darker levels have no power
# 1 sigma of gamma besides that of the edges: a lens' blur that the knots do not hold. Chosen, not
# fitted, so that 3 sigmas hold the pictures without a stated coding of `study cylinder`.
MODEL_SIGMA = 0.25


@dataclass(frozen=True, eq=False)
class CodedFit:
    """A fit to counts of unknown gamma, with 1 sigma of it: the covariances hold its error."""

    fit: CylinderFit
    gamma: float
    gamma_sigma: float


def fit_coded_cylinder(
    values: Float32Array,
    saturation: float | None,
    profile: CylinderProfile,
    lens: IdealLens,
    size: CylinderSize,
) -> CodedFit:
    """Fit the cylinder of a picture (rows, columns) whose counts have an unknown gamma.

    saturation  full scale; None for no limit
    profile     of the counts as they are

    Raises NoSolutionError where it shows none.
    """
    full = float(values.max()) if saturation is None else saturation

    def measure_decoded(gamma: float) -> CylinderProfile:
        light = Coding("gamma", gamma).decode(values, full).astype(np.float32)
        return measure_profile(light, saturation)

    gamma, edge_sigma = estimate_gamma(values, profile, full)
    sigma = min(float(np.hypot(edge_sigma, MODEL_SIGMA)), GAMMA_SIGMA)
    fit = fit_cylinder(measure_decoded(gamma), lens, size)
    moves = []
    for other in (gamma - sigma, gamma + sigma):
        try:
            moves.append(fit_cylinder(measure_decoded(other), lens, size).state - fit.state)
        except NoSolutionError:
            continue
    if not moves:
        raise NoSolutionError(
            f"with a gamma {sigma:.2f} off, which is unknown, the fit does not settle: state the "
            "camera's [coding]"
        )
    by_gamma = np.array(moves)
    by_gamma[:, THETA] = (by_gamma[:, THETA] + np.pi) % (2.0 * np.pi) - np.pi
    beyond = by_gamma.T @ by_gamma / len(moves)
    first = slice(DISTANCE, THETA + 1)
    fit = replace(
        fit,
        covariance=fit.covariance + beyond[first, first],
        state_covariance=fit.state_covariance + beyond,
    )
    return CodedFit(fit, gamma, sigma)


@dataclass(frozen=True, eq=False)
class EdgeSamples:
    """Counts about the ends of columns, over full scale.

    offsets  (n,) rows from the nearest row of each end, inwards
    values   (m, n);  levels (m, n) of the strip, led on over the edge by a line
    halves   (m,) where values pass half the level, in the offsets' terms
    columns  (m,)
    dark, noise  level and 1 sigma of what is behind
    """

    offsets: FloatArray
    values: FloatArray
    levels: FloatArray
    halves: FloatArray
    columns: FloatArray
    dark: float
    noise: float

    def start(self, gamma: float) -> FloatArray:
        """Start ends (m,) in light for a gamma and the expected blur."""
        level, dark = self.levels[:, 0], self.dark
        light = (0.5 * (level + dark)) ** gamma - dark**gamma
        share = np.clip(light / np.maximum(level**gamma - dark**gamma, 1e-12), 1e-3, 1.0 - 1e-3)
        ends: FloatArray = self.halves - BLUR_PX * ndtri(share)
        return ends

    def predict(self, state: FloatArray, ends: FloatArray) -> FloatArray:
        """Predict values (m, n) by gamma and half the shape of an edge (1 + k,), and ends (m,)."""
        gamma, from_edge = state[0], self.offsets - ends[:, None]
        shape = np.concatenate([[0.0], state[1:], [0.5]])
        half = np.sign(from_edge) * np.interp(np.abs(from_edge), KNOTS_PX, shape)
        risen = np.clip(0.5 + half, 0.0, 1.0)
        dark, bright = self.dark**gamma, self.levels**gamma
        return np.asarray((dark + (bright - dark) * risen) ** (1.0 / gamma), np.float64)


def sample_edges(values: Float32Array, profile: CylinderProfile, full: float) -> EdgeSamples:
    """Sample the upper and lower ends of the lit columns of a picture (rows, columns)."""
    inner = slice(MARGIN_COLUMNS, max(profile.heights.size - MARGIN_COLUMNS, MARGIN_COLUMNS))
    columns, tops = profile.height_columns[inner].astype(np.intp), profile.tops[inner]
    offsets = np.arange(-REACH_PX, REACH_PX + 1)
    inside = np.arange(REACH_PX + 1, REACH_PX + 1 + LEVEL_PX)
    parts = []
    for side, ends in ((1, tops), (-1, tops + profile.heights[inner])):
        rows = np.rint(ends).astype(np.intp)
        outer = rows - side * REACH_PX
        kept = (outer >= 0) & (outer < len(values))
        near, at = rows[kept, None], columns[kept, None]
        slope, level = np.polyfit(inside, values[near + side * inside, at].T / full, 1)
        levels = level[:, None] + slope[:, None] * np.maximum(offsets, 0)
        sampled = values[near + side * offsets, at] / full
        parts.append((sampled, levels, side * (ends[kept] - rows[kept]), columns[kept]))
    sampled, levels, halves, at = (np.concatenate(part) for part in zip(*parts, strict=True))
    behind = sampled[:, :2] if len(sampled) else np.zeros((1, 2))
    return EdgeSamples(
        offsets.astype(np.float64),
        sampled.astype(np.float64),
        np.maximum(levels, DARKEST).astype(np.float64),
        halves.astype(np.float64),
        at.astype(np.float64),
        max(float(np.median(behind)), DARKEST),
        max(float(np.std(behind)), 0.5 / full),
    )


def estimate_gamma(
    values: Float32Array, profile: CylinderProfile, full: float
) -> tuple[float, float]:
    """Estimate the gamma of a picture (rows, columns) and its sigma; the prior where none shows.

    full  counts of full scale
    """
    if profile.heights.size and float(np.median(profile.heights)) < 2 * (REACH_PX + LEVEL_PX):
        return GAMMA, GAMMA_SIGMA
    samples = sample_edges(values, profile, full)
    if len(samples.columns) < MIN_EDGES:
        return GAMMA, GAMMA_SIGMA
    fits = [_GammaFit(samples, gamma) for gamma in STARTS]
    # the minima differ little: their mean, by how likely each is, holds more often than the best
    costs, gammas = np.array([fit.cost for fit in fits]), np.array([fit.state[0] for fit in fits])
    scale = ALIKE * max(costs.min() / (samples.values.size - len(samples.columns)), 1.0)
    shares = np.exp(-0.5 * (costs - costs.min()) / scale)
    shares /= shares.sum()
    gamma = float(shares @ gammas)
    sigmas = np.array([fit.estimate_gamma_sigma() for fit in fits])
    return gamma, float(np.sqrt(shares @ (sigmas**2 + (gammas - gamma) ** 2)))


class _GammaFit:
    """Gamma and shape (1 + k,) and ends (m,) that fit samples, by damped steps from a gamma."""

    def __init__(self, samples: EdgeSamples, gamma: float) -> None:
        self._samples = samples
        shape = ndtr(KNOTS_PX[1:-1] / BLUR_PX) - 0.5
        self._expected = np.array([GAMMA, *shape])
        self._sigmas = np.array([GAMMA_SIGMA, *(SHAPE_SIGMA for _ in shape)])
        self.state, self.ends = np.array([gamma, *shape]), samples.start(gamma)
        self.cost, self._off = self._compute_cost(self.state, self.ends)
        damping = DAMPING
        for _ in range(MAX_STEPS):
            state, ends = self._step(damping)
            cost, off = self._compute_cost(state, ends)
            damping *= EASED if cost <= self.cost else RAISED
            if cost <= self.cost:
                settled = float(np.abs(state - self.state).max()) < SETTLED
                self.state, self.ends, self.cost, self._off = state, ends, cost, off
                if settled:
                    break
            elif damping > MAX_DAMPING:
                break

    def _compute_cost(self, state: FloatArray, ends: FloatArray) -> tuple[float, FloatArray]:
        """Compute the sum of squares in units of their errors, and the residuals (m, n)."""
        off = self._samples.values - self._samples.predict(state, ends)
        beyond = (state - self._expected) / self._sigmas
        return float((off**2).sum() / self._samples.noise**2 + (beyond**2).sum()), off

    def _reduce(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the normal matrix without the ends, scores (m, 1 + k) of edges, steps of ends.

        The latter as those of a state that stays (m,) less shares (m, 1 + k) of its step.
        """
        by = np.stack(
            [
                self._differentiate(self.state + step, self.state - step, self.ends, self.ends)
                for step in STEP * np.eye(self.state.size)
            ],
            axis=-1,
        )
        by_end = self._differentiate(self.state, self.state, self.ends + STEP, self.ends - STEP)
        by_end_squared = (by_end**2).sum(axis=1) + 1e-9
        shares = np.einsum("ei,eij->ej", by_end, by) / by_end_squared[:, None]
        left = (by - by_end[:, :, None] * shares[:, None, :]) / self._samples.noise
        normal = np.einsum("eij,eik->jk", left, left) + np.diag(self._sigmas**-2.0)
        scores = np.einsum("eij,ei->ej", left, self._off / self._samples.noise)
        return normal, scores, (by_end * self._off).sum(axis=1) / by_end_squared, shares

    def _differentiate(
        self, up: FloatArray, down: FloatArray, ends_up: FloatArray, ends_down: FloatArray
    ) -> FloatArray:
        high, low = self._samples.predict(up, ends_up), self._samples.predict(down, ends_down)
        slope: FloatArray = (high - low) / (2.0 * STEP)
        return slope

    def _step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        normal, scores, shifts, shares = self._reduce()
        right = scores.sum(axis=0) - (self.state - self._expected) / self._sigmas**2
        state = self.state + np.linalg.solve(normal + damping * np.diag(np.diag(normal)), right)
        state[0] = np.clip(state[0], MIN_GAMMA, MAX_GAMMA)
        shifts = shifts - shares @ (state - self.state)
        return state, self.ends + np.clip(shifts, -MAX_SHIFT_PX, MAX_SHIFT_PX)

    def estimate_gamma_sigma(self) -> float:
        """Estimate 1 sigma of gamma, by how blocks of columns differ, no less than by the noise."""
        normal, scores, _, _ = self._reduce()
        covariance = np.linalg.inv(normal)
        blocks = np.floor(self._samples.columns / BLOCK_COLUMNS)
        sums = np.array([scores[blocks == block].sum(axis=0) for block in np.unique(blocks)])
        spread = covariance @ (sums.T @ sums) @ covariance
        return float(np.sqrt(max(spread[0, 0], covariance[0, 0])))
