"""Distance, bearing and light angle of a lit cylinder by its whole profile, not by its edges alone.

The model draws the mean brightness of each column and the height of the lit ones from the distance
of the axis, its bearing, the angle of the light, and the blur; brightness is linear in what light
and cloth are not known of: the strength of the light, what comes from all sides, a departure of the
cloth from Lambert's law (as Minnaert's law has it, in both angles) and two lobes of gloss. Their
expected sizes are wide enough for cloth, paper and paint, so that covariances hold them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.cylinder.brightness import LOBES, draw_columns
from optnav_cli.cylinder.geometry import (
    CylinderSize,
    IdealLens,
    compute_half_width,
    compute_psi,
    compute_surface_distance,
    load_error_sizes,
)
from optnav_cli.cylinder.profile import CylinderProfile
from optnav_cli.estimation.least_squares import (
    Estimate,
    Linearisation,
    Model,
    VectorPrior,
    inverse_of,
    linearised,
)
from optnav_cli.reasons import Reason, ReasonCode

# Unknowns: distance m, bearing, theta, logarithms of the blur, px, and of half the width of the
# source, rad; then brightness, in units of that of the lit part: the background, what comes from
# all sides, the light, and by what share of it the cloth departs from Lambert's law.
DISTANCE, BEARING, THETA, BLUR, SOURCE, LINEAR, LIGHT = 0, 1, 2, 3, 4, 5, 7
# background, ambient; Lambert's light, Minnaert's powers of incidence and emission, rough facets
EXPECTED = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *(0.0 for _ in LOBES)])
SIGMAS = np.array([0.1, 0.3, 3.0, 0.1, 0.1, 0.3, *(0.2 for _ in LOBES)])
UNKNOWNS = LINEAR + len(EXPECTED)
# a lens in focus, with the pixel's own width; a lamp of a laboratory, or the Sun
WIDTHS, WIDTH_SIGMAS = np.log([0.9, math.radians(1.0)]), np.array([0.35, 0.8])
EDGE_PX = 0.12  # a place error of what is steep: blur that is no Gaussian, an edge that is not even
MODEL_SHARE, DARK_SHARE = 0.004, 0.001  # of a column's brightness, and of the brightest, that the
# model does not draw
STEP = 1e-5  # of numeric derivatives, in each unknown's own size
STARTS = np.radians([*range(-160, 161, 5)])
# wide gloss makes minima of its own, 5 to 15 deg off: a bad fit is followed by other starts
START_GAP, MAX_STARTS, GOOD_MISFIT = math.radians(12.0), 6, 0.6
# sum of squares of the cloth's terms in their expected sizes: beyond it others are looked for
UNLIKELY = 3.0
NEARBY = np.radians([-3.0, 3.0, -6.0, 6.0, -10.0, 10.0])
# Places across the blur where heights are mixed, with their shares, and what light all sides give.
BLUR_SIGMAS = np.linspace(-2.5, 2.5, 11)
BLUR_SHARES = np.exp(-0.5 * BLUR_SIGMAS**2)
DUSK = 0.03
# Independent heights in a picture: by them errors of `study cylinder --fit` to 100 deg have NEES 1.
HEIGHT_COUNT = 19.0
LIMB_PX = 2.5  # columns so near to a limb give no height
MAX_MISFIT = 1.5  # of residuals in units of their errors, rms: no lit cylinder, or of another size
MAX_BLUR_PX = 6.0  # out of focus: beyond it the columns near the limbs mix with the background
MAX_HEIGHT_MISFIT = 0.03  # of the height, rms: no cylinder, or not upright
NARROWEST = math.log(math.radians(0.25))  # a source of less looks the same, whatever it is
MAX_STEPS, SETTLED = 80, 1e-2  # of the fit, and the fall of its cost that ends it
DAMPING, MAX_DAMPING, EASED = 1e-3, 1e7, 0.2
OPEN = Reason(ReasonCode.DEGENERATE, "the profile leaves the angle of the light open")
UNSETTLED = Reason(ReasonCode.NOT_SETTLED, "the fit of the profile does not settle")


@dataclass(frozen=True, eq=False)
class CylinderFit:
    """A lit cylinder as a picture shows it.

    distance_m  from the camera to the axis;  bearing, theta  rad
    covariance  (3, 3) of distance, bearing and theta: m and rad
    misfit      rms of the residuals in units of their errors
    state       (UNKNOWNS,) of the model
    state_covariance, state_noise  (UNKNOWNS, UNKNOWNS): by the stated errors, with what is common
                to pictures, and by the noise of the picture alone
    middle_row_px  of the strip in the lit columns
    """

    distance_m: float
    bearing: float
    theta: float
    covariance: FloatArray
    misfit: float
    state: FloatArray
    state_covariance: FloatArray
    state_noise: FloatArray
    middle_row_px: float


class CostedModel(Model[FloatArray], Protocol):
    """Measurement model whose cost is had without its derivatives."""

    def cost(self, state: FloatArray) -> float: ...


class ProfileModel:
    """Mean brightness of the columns."""

    def __init__(self, profile: CylinderProfile, lens: IdealLens, radius_m: float) -> None:
        self.columns, self._radius, self._lens = profile.columns, radius_m, lens
        self.measured = profile.brightness / profile.bright
        slope = np.gradient(self.measured)
        model = MODEL_SHARE * np.maximum(self.measured, 0.0)
        sigma = np.sqrt((profile.sigma / profile.bright) ** 2 + (EDGE_PX * slope) ** 2 + model**2)
        self.weights = 1.0 / np.maximum(sigma, DARK_SHARE) ** 2
        self.noise_weights = (profile.bright / profile.sigma) ** 2
        self._kept = np.full(LINEAR, np.nan), np.empty((0, 0))

    def draw_design(self, state: FloatArray) -> FloatArray:
        """Draw brightness (n, LIT + 2) by each linear unknown; the last design is cached."""
        if not np.array_equal(self._kept[0], state[:LINEAR]):
            self._kept = state[:LINEAR].copy(), self._draw(state)
        return self._kept[1]

    def _draw(self, state: FloatArray) -> FloatArray:
        lens = self._lens
        return draw_columns(self.columns, state, self._radius, lens.focal_x_px, lens.centre_x_px)

    def cost(self, state: FloatArray) -> float:
        """Compute the cost of `linearise`."""
        off = self.measured - self.draw_design(state) @ _scale_strengths(state)
        return float(self.weights @ (off * off))

    def linearise(self, state: FloatArray) -> Linearisation:
        """Residuals, and derivatives by differences for what is not linear."""
        design, weights = self.draw_design(state), _scale_strengths(state)
        jacobian = np.empty((self.columns.size, UNKNOWNS))
        jacobian[:, LINEAR:] = design
        jacobian[:, LIGHT] = design[:, 2] + design[:, 3:] @ state[LIGHT + 1 :]
        jacobian[:, LIGHT + 1 :] *= state[LIGHT]
        for k in range(LINEAR):
            moved, back = state.copy(), state.copy()
            moved[k] += STEP
            back[k] -= STEP
            jacobian[:, k] = (self._draw(moved) - self._draw(back)) @ weights / (2.0 * STEP)
        return linearised(self.measured - design @ weights, jacobian, self.weights)

    def start_brightness(
        self, state: FloatArray, light: float | None = None
    ) -> tuple[float, FloatArray]:
        """Return the cost and the state (LINEAR,) completed by the best brightness (UNKNOWNS,).

        light  about how strong it is, for the expected sizes of the others
        """
        design = self.draw_design(state)
        if light is None:
            light = 1.0 / max(float(design[:, 2].max()), 1e-3)
        sigmas = SIGMAS * np.where(np.arange(SIGMAS.size) < 2, 1.0, light)
        expected = EXPECTED * light
        normal = (design.T * self.weights) @ design + np.diag(sigmas**-2)
        right = (design.T * self.weights) @ self.measured + expected / sigmas**2
        solved = np.linalg.solve(normal, right)
        residuals, off = self.measured - design @ solved, (solved - expected) / sigmas
        cost = float(self.weights @ residuals**2 + off @ off)
        if solved[2] <= 0.0:
            return np.inf, state
        solved[3:] /= solved[2]
        return cost, np.concatenate([state, solved])


def _scale_strengths(state: FloatArray) -> FloatArray:
    """Scale the linear unknowns of a state to the factors of the columns of `draw_columns`."""
    strengths = state[LINEAR:].copy()
    strengths[3:] *= state[LIGHT]
    return strengths


class HeightModel:
    """Heights of lit columns: the height of the strip over the depth of the surface there.

    Blur mixes a column with its neighbours by their brightness. Near the limb, where heights fall
    off ever faster, that makes it shorter by up to 0.1 px.
    """

    def __init__(self, profile: CylinderProfile, lens: IdealLens, size: CylinderSize) -> None:
        self._columns = profile.height_columns
        self._bearings = np.arctan((self._columns - lens.centre_x_px) / lens.focal_x_px)
        self._heights, self._size, self._lens = profile.heights, size, lens
        self._weights = profile.height_sigma**-2

    def predict(self, state: FloatArray) -> FloatArray:
        """Predict heights (m,), px."""
        lens, size = self._lens, self._size
        distance, axis, theta = state[:3]
        mixed = self._columns + math.exp(state[BLUR]) * BLUR_SIGMAS[:, None]
        bearings = np.arctan((mixed - lens.centre_x_px) / lens.focal_x_px)
        psi = compute_psi(bearings - axis, size.radius_m, distance)
        depth = compute_surface_distance(psi, size.radius_m, distance) * np.cos(bearings)
        seen = np.abs(bearings - axis) < compute_half_width(size.radius_m, distance)
        light = np.maximum(np.cos(psi - theta), 0.0) + DUSK
        shares = BLUR_SHARES[:, None] * np.where(seen, light, 1e-9)
        heights = lens.focal_y_px * size.height_m * (shares / depth).sum(axis=0)
        mean_height: FloatArray = heights / shares.sum(axis=0)
        return mean_height

    def flag_inside(self, state: FloatArray) -> FloatArray:
        """Flag columns that are far enough from the limbs: (m,), 1 or 0."""
        limb = compute_half_width(self._size.radius_m, state[DISTANCE])
        from_limb = limb - np.abs(self._bearings - state[BEARING])
        inside: FloatArray = (from_limb > LIMB_PX / self._lens.focal_x_px).astype(np.float64)
        return inside

    def linearise(self, state: FloatArray) -> Linearisation:
        """Residuals and derivatives by differences."""
        jacobian = np.zeros((self._heights.size, UNKNOWNS))
        for k in (DISTANCE, BEARING):
            moved, back = state.copy(), state.copy()
            moved[k] += STEP
            back[k] -= STEP
            jacobian[:, k] = (self.predict(moved) - self.predict(back)) / (2.0 * STEP)
        residuals, weights = self._weigh_residuals(state)
        return linearised(residuals, jacobian, weights)

    def cost(self, state: FloatArray) -> float:
        """Compute the cost of `linearise`."""
        residuals, weights = self._weigh_residuals(state)
        return float(weights @ (residuals * residuals))

    def _weigh_residuals(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (m,), px, and their weights."""
        residuals = self._heights - self.predict(state)
        weights = self._weights * self.flag_inside(state)
        # neighbouring columns have the same errors of edge and blur: they count as a few
        count = max(float(np.count_nonzero(weights)), 1.0)
        weights = weights * min(1.0, HEIGHT_COUNT / count)
        # a ragged edge, or a body that is none, pulls no further than its share
        scale = np.sqrt(weights) * np.abs(residuals)
        return residuals, weights / np.maximum(scale / 3.0, 1.0)


def fit_cylinder(profile: CylinderProfile, lens: IdealLens, size: CylinderSize) -> CylinderFit:
    """Fit the cylinder that a profile shows. Raises NoSolutionError where it shows none."""
    brightness = ProfileModel(profile, lens, size.radius_m)
    heights = HeightModel(profile, lens, size)
    others: list[CostedModel] = [
        VectorPrior(LINEAR, EXPECTED, SIGMAS, UNKNOWNS),
        VectorPrior(BLUR, WIDTHS, WIDTH_SIGMAS, UNKNOWNS),
        heights,
    ]
    best: Estimate[FloatArray] | None = None
    failure = UNSETTLED.error()
    starts = _choose_starts(profile, brightness, lens, size)
    for number, start in enumerate(starts):
        if number >= 2 and best is not None and _compute_misfit(best) < GOOD_MISFIT:
            break
        try:
            estimate = _settle(brightness, others, start, 1.02 * size.radius_m)
        except NoSolutionError as error:
            failure = error
            continue
        if best is None or estimate.cost < best.cost:
            best = estimate
    if starts and (best is None or _compute_misfit(best) > GOOD_MISFIT):
        best = _refine(brightness, others, starts[0], best, size)
    if best is None:
        raise failure
    if best.terms[1].cost > UNLIKELY:
        best = _refine(brightness, others, best.state, best, size) or best
    return _check_fit(best, brightness, profile, size)


def _refine(
    brightness: ProfileModel,
    others: Sequence[CostedModel],
    near: FloatArray,
    best: Estimate[FloatArray] | None,
    size: CylinderSize,
) -> Estimate[FloatArray] | None:
    """Return the best of a fit and of others that begin near a state with the usual cloth and lamp.

    Cloth of an unlikely kind under a light some degrees off draws nearly the same profile: a
    minimum of its own beside the true one.
    """
    for off in NEARBY:
        nonlinear = [*near[:THETA], near[THETA] + off, *WIDTHS]
        _, start = brightness.start_brightness(np.array(nonlinear))
        if start.size == LINEAR:
            continue
        try:
            tried = _settle(brightness, others, start, 1.02 * size.radius_m)
        except NoSolutionError:
            continue
        if best is None or tried.cost < best.cost:
            best = tried
    return best


def _settle(
    brightness: ProfileModel, others: Sequence[CostedModel], start: FloatArray, nearest_m: float
) -> Estimate[FloatArray]:
    """Fit the models by steps that are damped until they lower the cost.

    The step of `estimation.least_squares.solve` is too bold here: a terminator that is blurred by
    the lens, by the source or by the cloth looks the same over wide ranges.
    Raises NoSolutionError where it does not settle or an unknown is open.
    """
    models: tuple[CostedModel, ...] = (brightness, *others)
    state, damping = start, DAMPING
    terms = tuple(model.linearise(state) for model in models)
    for _ in range(MAX_STEPS):
        normal = np.sum([term.normal for term in terms], axis=0)
        gradient = np.sum([term.gradient for term in terms], axis=0)
        cost = sum(term.cost for term in terms)
        damped = normal + np.diag(damping * np.diag(normal))
        stepped = _limit_step(state, inverse_of(damped) @ gradient, nearest_m)
        # the brightness that is best for the place of the step, or that of the step itself: the
        # first is solved for with a prior that is about right
        _, resolved = brightness.start_brightness(stepped[:LINEAR], stepped[LIGHT])
        trials = [
            trial for trial in (resolved, stepped) if trial.size > LINEAR and trial[LIGHT] > 0.0
        ]
        if not trials:
            damping /= EASED
            continue
        costs = [sum(model.cost(trial) for model in models) for trial in trials]
        least = int(np.argmin(costs))
        fall = cost - costs[least]
        if fall >= 0.0:
            state = trials[least]
            terms = tuple(model.linearise(state) for model in models)
        damping *= EASED if fall >= 0.0 else 1.0 / EASED
        if (0.0 <= fall < SETTLED and damping < DAMPING) or damping > MAX_DAMPING:
            normal = np.sum([term.normal for term in terms], axis=0)
            covariance = inverse_of(normal)
            if not np.isfinite(covariance).all():
                raise OPEN.error()
            return Estimate(state, covariance, covariance, terms)
        if not np.isfinite(fall):
            break
    raise UNSETTLED.error()


def _limit_step(state: FloatArray, step: FloatArray, nearest_m: float) -> FloatArray:
    """Apply a step to a state, limited to where the model has a meaning."""
    limits = np.array([0.3 * state[DISTANCE], 0.1, 0.3, 0.3, 0.7])
    factor = min(1.0, float(np.min(limits / np.maximum(np.abs(step[:LINEAR]), 1e-12))))
    moved = state + factor * step
    moved[DISTANCE] = max(moved[DISTANCE], nearest_m)
    moved[SOURCE] = max(moved[SOURCE], NARROWEST)
    moved[THETA] = (moved[THETA] + math.pi) % (2.0 * math.pi) - math.pi
    return moved


def _choose_starts(
    profile: CylinderProfile, model: ProfileModel, lens: IdealLens, size: CylinderSize
) -> list[FloatArray]:
    """Choose the best states of a coarse search over theta; the lit limb fixes the others.

    Raises NoSolutionError where the lit part has no extent to begin with.
    """
    lit = np.flatnonzero(profile.lit)
    if not lit.size:
        raise NoSolutionError("no lit body in the picture", ReasonCode.NO_BODY)
    if profile.heights.size:
        nearest = lens.focal_y_px * size.height_m / float(np.quantile(profile.heights, 0.97))
    else:  # cut above or below: as if its width were whole
        nearest = lens.focal_x_px * 2.0 * size.radius_m / max(float(lit[-1] - lit[0]), 1.0)
    trials: list[tuple[float, FloatArray]] = []
    for theta in STARTS:
        dark = max(abs(theta) - 0.5 * math.pi, 0.0)
        sine = size.radius_m * math.sin(dark)
        if nearest <= sine:
            continue
        distance = size.radius_m * math.cos(dark) + math.sqrt(nearest**2 - sine**2)
        limb = compute_half_width(size.radius_m, max(distance, 1.05 * size.radius_m))
        edge = lit[-1] + 0.5 if theta >= 0.0 else lit[0] - 0.5
        at = math.atan((edge - lens.centre_x_px) / lens.focal_x_px)
        axis = at - limb if theta >= 0.0 else at + limb
        state = np.array([max(distance, 1.05 * size.radius_m), axis, theta, *WIDTHS])
        trials.append(model.start_brightness(state))
    trials.sort(key=lambda pair: pair[0])
    if not trials or not np.isfinite(trials[0][0]):
        raise NoSolutionError("the profile is not that of a lit cylinder", ReasonCode.LIMB_MISFIT)
    chosen: list[FloatArray] = []
    for cost, state in trials:
        apart = [abs(state[THETA] - other[THETA]) >= START_GAP for other in chosen]
        if np.isfinite(cost) and all(apart) and len(chosen) < MAX_STARTS:
            chosen.append(state)
    return chosen


def _compute_misfit(estimate: Estimate[FloatArray]) -> float:
    """Compute residuals of brightness in units of their errors, rms."""
    brightness = estimate.terms[0]
    return math.sqrt(brightness.cost / brightness.residuals.size)


def _check_fit(
    best: Estimate[FloatArray], model: ProfileModel, profile: CylinderProfile, size: CylinderSize
) -> CylinderFit:
    """Check a solution and add its covariance. Raises NoSolutionError where it is none."""
    brightness, heights = best.terms[0], best.terms[3]
    misfit = _compute_misfit(best)
    used = heights.weights > 0.0
    if used.sum() > 3:
        off = float(np.sqrt(np.mean(heights.residuals[used] ** 2)))
        if off > max(MAX_HEIGHT_MISFIT * float(np.median(profile.heights)), 2.0):
            raise NoSolutionError(
                f"the heights of columns differ from those of an upright cylinder by {off:.1f} px "
                "rms: another body, or not upright",
                ReasonCode.LIMB_MISFIT,
            )
    if misfit > MAX_MISFIT:
        raise NoSolutionError(
            f"the brightness of columns differs by {misfit:.1f} of its errors, rms, from that of a "
            "lit cylinder",
            ReasonCode.LIMB_MISFIT,
        )
    blur = math.exp(best.state[BLUR])
    if blur > MAX_BLUR_PX:
        text = f"out of focus: blurred by {blur:.1f} px, wanted at most {MAX_BLUR_PX:.0f}"
        raise NoSolutionError(text, ReasonCode.BAD_PICTURE)
    if not best.state[LIGHT] > 0.0:
        raise NoSolutionError("the light falls from nowhere", ReasonCode.WRONG_LIGHT)
    # scatter beyond what is stated widens the errors
    covariance = best.covariance[:3, :3] * max(misfit, 1.0) ** 2
    beyond_m2, beyond = load_error_sizes().compute_variances(
        float(best.state[THETA]), float(best.state[DISTANCE])
    )
    covariance[0, 0] += beyond_m2
    covariance[2, 2] += beyond
    gain = brightness.gain(best.covariance)
    noise = (gain / model.noise_weights) @ gain.T
    if heights.residuals.size:
        height_gain = heights.gain(best.covariance)
        noise = noise + (height_gain * profile.height_sigma**2) @ height_gain.T
    distance, bearing, theta = (float(number) for number in best.state[:3])
    middle = 0.5 * sum(profile.rows)
    if profile.heights.size:
        middle = float(np.median(profile.tops + 0.5 * profile.heights))
    unknowns = best.state, best.covariance, noise
    return CylinderFit(distance, bearing, theta, covariance, misfit, *unknowns, middle)
