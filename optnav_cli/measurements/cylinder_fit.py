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

import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.kernel import kernel
from optnav_cli.estimation.least_squares import (
    Estimate,
    Linearisation,
    Model,
    VectorPrior,
    inverse_of,
    linearised,
)
from optnav_cli.measurements.cylinder import CylinderSize, half_width, psi_of, surface_distance
from optnav_cli.measurements.cylinder_profile import CylinderProfile
from optnav_cli.reasons import Reason, ReasonCode

STRIPS, DUSK_STRIPS = 48, 12  # of the seen surface that is lit by all, and by a part, of the source
DARKEST, STEEPEST = 0.02, 1.5  # least cosine under a logarithm, largest angle of a tangent
HALF_ROOT = math.sqrt(0.5)
REACH_SIGMAS = 6.5  # of the blur that are drawn
LOBES = (8.0, 20.0, 50.0)  # exponents of the lobes of gloss
# Unknowns: distance m, bearing, theta, logarithms of the blur, px, and of half the width of the
# source, rad; then brightness, in units of that of the lit part: the background, what comes from
# all sides, the light, and by what share of it the cloth departs from Lambert's law.
DISTANCE, BEARING, THETA, BLUR, SOURCE, LINEAR, LIGHT = 0, 1, 2, 3, 4, 5, 7
# background, ambient; Lambert's light, Minnaert's powers of incidence and emission, rough facets
EXPECTED = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *(0.0 for _ in LOBES)])
SIGMAS = np.array([0.1, 0.3, 3.0, 0.1, 0.1, 0.3, *(0.2 for _ in LOBES)])
LIT = len(EXPECTED) - 2  # of them, those of the light
UNKNOWNS = LINEAR + len(EXPECTED)
# a lens in focus, with the pixel's own width; a lamp of a laboratory, or the Sun
WIDTHS, WIDTH_SIGMAS = np.log([0.9, math.radians(1.0)]), np.array([0.35, 0.8])
EDGE_PX = 0.12  # a place error of what is steep: blur that is no Gaussian, an edge that is not even
MODEL_SHARE, DARK_SHARE = 0.004, 0.001  # of a column's brightness, and of the brightest, that the
# model does not draw
STEP = 1e-5  # of numeric derivatives, in each unknown's own size
STARTS = np.radians([*range(-160, 161, 5)])
LIMB_PX = 2.5  # columns so near to a limb give no height
MAX_MISFIT = 12.0  # of residuals in units of their errors, rms: no lit cylinder
# Light that grazes all that is seen: gloss and cloth look like another angle of the light, more
# than the terms here hold. Errors of trials with rough and glossy cloth, 1 sigma at 137 deg, grow
# about as the cube of the angle beyond 100 deg: of the distance in radii, of theta in rad.
GRAZING, GRAZING_SPAN = math.radians(100.0), math.radians(37.0)
GRAZING_RADII, GRAZING_RAD = 0.07, math.radians(8.0)
MAX_HEIGHT_MISFIT = 0.03  # of the height, rms: no cylinder, or not upright
MAX_STEPS, SETTLED = 80, 1e-3  # of the fit, and the fall of its cost that ends it
DAMPING, MAX_DAMPING, EASED = 1e-3, 1e7, 0.2
OPEN = Reason(ReasonCode.DEGENERATE, "the profile leaves the angle of the light open")
UNSETTLED = Reason(ReasonCode.NOT_SETTLED, "the fit of the profile does not settle")


@dataclass(frozen=True)
class IdealLens:
    """A pinhole lens: focal lengths and principal point, px."""

    focal_x_px: float
    focal_y_px: float
    centre_x_px: float
    centre_y_px: float


@dataclass(frozen=True, eq=False)
class CylinderFit:
    """A lit cylinder as a picture shows it.

    distance_m  from the camera to the axis;  bearing, theta  rad
    covariance  (3, 3) of distance, bearing and theta: m and rad, with what is common to pictures
    noise       (3, 3) the same of the noise of the picture alone
    misfit      rms of the residuals in units of their errors
    state       (UNKNOWNS,) of the model
    middle_row_px  of the strip in the lit columns
    """

    distance_m: float
    bearing: float
    theta: float
    covariance: FloatArray
    noise: FloatArray
    misfit: float
    state: FloatArray
    middle_row_px: float


@kernel
def _lit_brightness(
    psi: float, middle: float, theta: float, source: float, found: FloatArray
) -> None:
    """Brightness by each of the linear unknowns from the light on, into found (LIT,).

    psi, middle  of a lit point of the surface: its angle and its bearing from the axis
    source       half the width of the source, rad
    """
    emission = math.cos(psi + middle)
    # the mean over the source of the sine of its height, which may be a part of it alone; both
    # agree to the last digit where they meet, for the sake of the derivatives
    up = 0.5 * math.pi - abs(psi - theta)
    cosine = 0.0
    if up >= source:
        cosine = math.sin(up) * math.sin(source) / source
    elif up > -source:
        cosine = (1.0 - math.cos(up + source)) / (2.0 * source)
    found[0] = cosine
    found[1] = cosine * math.log(max(cosine, DARKEST))
    found[2] = cosine * math.log(max(emission, DARKEST))
    found[3] = 0.0
    if (psi - theta) * (psi + middle) > 0.0:  # Oren and Nayar's share of rough facets
        one, other = abs(psi - theta), abs(psi + middle)
        found[3] = cosine * math.sin(max(one, other)) * math.tan(min(one, other, STEEPEST))
    # half way between the directions to the light and to the camera
    half = max(math.cos(psi - 0.5 * (theta - middle)), 0.0)
    risen = min(max(0.5 + 0.5 * up / source, 0.0), 1.0)
    for k in range(len(LOBES)):
        found[4 + k] = risen * half ** LOBES[k]


@kernel
def _drawn(
    columns: FloatArray, state: FloatArray, radius: float, focal: float, centre: float
) -> FloatArray:
    """Brightness (n, LIT + 2) of columns (n,) by each linear unknown.

    The lit surface is cut into strips from the terminator to the limb, finer where a part of the
    source has risen. Brightness is linear over each of them, and what of it a blurred column holds
    is written down in closed form, so that the result is smooth in all unknowns.
    """
    distance, axis, theta = state[0], state[1], state[2]
    blur, source = math.exp(state[3]), math.exp(state[4])
    found = np.zeros((columns.size, LIT + 2))
    found[:, 0] = 1.0
    widest = math.acos(radius / distance)
    limb = math.asin(radius / distance)
    one = np.ones(1)
    low, high = centre + focal * math.tan(axis - limb), centre + focal * math.tan(axis + limb)
    _add_strip(columns, low, high, blur, one, one, found[:, 1:2])
    side = 1.0 if theta >= 0.0 else -1.0
    # measured to the lit side, from the terminator on
    risen = min(max(abs(theta) - 0.5 * math.pi + source, -widest), widest)
    begun = min(max(abs(theta) - 0.5 * math.pi - source, -widest), widest)
    far = min(abs(theta) + 0.5 * math.pi + source, widest)
    here, there = np.empty(LIT), np.empty(LIT)
    left = 0.0
    for j in range(DUSK_STRIPS + STRIPS + 1):
        if j <= DUSK_STRIPS:
            psi = begun + (risen - begun) * j / DUSK_STRIPS
        else:
            psi = risen + (far - risen) * (j - DUSK_STRIPS) / STRIPS
        psi *= side
        middle = math.atan2(radius * math.sin(psi), distance - radius * math.cos(psi))
        right = centre + focal * math.tan(axis + middle)
        _lit_brightness(psi, middle, theta, source, there)
        if j > 0 and side > 0.0:
            _add_strip(columns, left, right, blur, here, there, found[:, 2:])
        elif j > 0:
            _add_strip(columns, right, left, blur, there, here, found[:, 2:])
        left = right
        here[:] = there
    return found


@kernel
def _add_strip(
    columns: FloatArray,
    left: float,
    right: float,
    blur: float,
    here: FloatArray,
    there: FloatArray,
    found: FloatArray,
) -> None:
    """Add a strip from left to right, px, whose k brightnesses go from here to there, to (n, k)."""
    width = right - left
    if not width > 0.0:
        return
    reach = REACH_SIGMAS * blur
    begin = max(math.floor(left - reach - columns[0]), 0)
    end = min(math.ceil(right + reach - columns[0]) + 1, columns.size)
    for i in range(begin, end):
        low, high = (left - columns[i]) / blur, (right - columns[i]) / blur
        whole = 0.5 * (math.erf(high * HALF_ROOT) - math.erf(low * HALF_ROOT))
        bells = math.exp(-0.5 * low * low) - math.exp(-0.5 * high * high)
        # the mean of how far along the strip the light of the column comes from
        along = (bells * blur / math.sqrt(2.0 * math.pi) + (columns[i] - left) * whole) / width
        for k in range(here.size):
            found[i, k] += whole * here[k] + along * (there[k] - here[k])


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

    def design(self, state: FloatArray) -> FloatArray:
        """(n, LIT + 2) brightness by each linear unknown."""
        lens = self._lens
        return _drawn(self.columns, state, self._radius, lens.focal_x_px, lens.centre_x_px)

    def linearise(self, state: FloatArray) -> Linearisation:
        """Residuals, and derivatives by differences for what is not linear."""
        design, weights = self.design(state), _strengths(state)
        jacobian = np.empty((self.columns.size, UNKNOWNS))
        jacobian[:, LINEAR:] = design
        jacobian[:, LIGHT] = design[:, 2] + design[:, 3:] @ state[LIGHT + 1 :]
        jacobian[:, LIGHT + 1 :] *= state[LIGHT]
        for k in range(LINEAR):
            moved, back = state.copy(), state.copy()
            moved[k] += STEP
            back[k] -= STEP
            jacobian[:, k] = (self.design(moved) - self.design(back)) @ weights / (2.0 * STEP)
        return linearised(self.measured - design @ weights, jacobian, self.weights)

    def started(self, state: FloatArray, light: float | None = None) -> tuple[float, FloatArray]:
        """The state (LINEAR,) with the best brightness (UNKNOWNS,), and its cost.

        light  about how strong it is, for the expected sizes of the others
        """
        design = self.design(state)
        if light is None:
            light = 1.0 / max(float(design[:, 2].max()), 1e-3)
        sigmas = SIGMAS * np.where(np.arange(SIGMAS.size) < 2, 1.0, light)
        expected = EXPECTED * light
        normal = (design.T * self.weights) @ design + np.diag(sigmas**-2)
        right = (design.T * self.weights) @ self.measured + expected / sigmas**2
        found = np.linalg.solve(normal, right)
        residuals, off = self.measured - design @ found, (found - expected) / sigmas
        cost = float(self.weights @ residuals**2 + off @ off)
        if found[2] <= 0.0:
            return np.inf, state
        found[3:] /= found[2]
        return cost, np.concatenate([state, found])


def _strengths(state: FloatArray) -> FloatArray:
    """The linear unknowns of a state as what the columns of `_drawn` are multiplied by."""
    found = state[LINEAR:].copy()
    found[3:] *= state[LIGHT]
    return found


class HeightModel:
    """Heights of lit columns: the height of the strip over the depth of the surface there."""

    def __init__(self, profile: CylinderProfile, lens: IdealLens, size: CylinderSize) -> None:
        self._bearings = np.arctan((profile.height_columns - lens.centre_x_px) / lens.focal_x_px)
        self._heights, self._size, self._lens = profile.heights, size, lens
        self._weights = profile.height_sigma**-2

    def predicted(self, state: FloatArray) -> FloatArray:
        """(m,) px."""
        distance, axis = state[DISTANCE], state[BEARING]
        psi = psi_of(self._bearings - axis, self._size.radius_m, distance)
        depth = surface_distance(psi, self._size.radius_m, distance) * np.cos(self._bearings)
        found: FloatArray = self._lens.focal_y_px * self._size.height_m / depth
        return found

    def inside(self, state: FloatArray) -> FloatArray:
        """(m,) 1 where a column is far enough from the limbs, else 0."""
        limb = half_width(self._size.radius_m, state[DISTANCE])
        away = limb - np.abs(self._bearings - state[BEARING])
        found: FloatArray = (away > LIMB_PX / self._lens.focal_x_px).astype(np.float64)
        return found

    def linearise(self, state: FloatArray) -> Linearisation:
        """Residuals and derivatives by differences."""
        residuals = self._heights - self.predicted(state)
        jacobian = np.zeros((self._heights.size, UNKNOWNS))
        for k in (DISTANCE, BEARING):
            moved, back = state.copy(), state.copy()
            moved[k] += STEP
            back[k] -= STEP
            jacobian[:, k] = (self.predicted(moved) - self.predicted(back)) / (2.0 * STEP)
        weights = self._weights * self.inside(state)
        # neighbouring columns have the same errors of edge and blur: they count as a few
        count = max(float(np.count_nonzero(weights)), 1.0)
        weights = weights * min(1.0, 25.0 / count)
        # a ragged edge, or a body that is none, pulls no further than its share
        scale = np.sqrt(weights) * np.abs(residuals)
        return linearised(residuals, jacobian, weights / np.maximum(scale / 3.0, 1.0))


def fit_cylinder(profile: CylinderProfile, lens: IdealLens, size: CylinderSize) -> CylinderFit:
    """The cylinder that a profile shows. Raises NoSolutionError where it shows none."""
    brightness = ProfileModel(profile, lens, size.radius_m)
    heights = HeightModel(profile, lens, size)
    others: list[Model[FloatArray]] = [
        VectorPrior(LINEAR, EXPECTED, SIGMAS, UNKNOWNS),
        VectorPrior(BLUR, WIDTHS, WIDTH_SIGMAS, UNKNOWNS),
        heights,
    ]
    best: Estimate[FloatArray] | None = None
    failure = UNSETTLED.error()
    for start in _starts(profile, brightness, lens, size):
        try:
            estimate = _settled(brightness, others, start, 1.02 * size.radius_m)
        except NoSolutionError as error:
            failure = error
            continue
        if best is None or estimate.cost < best.cost:
            best = estimate
    if best is None:
        raise failure
    return _checked(best, brightness, profile, size)


def _settled(
    brightness: ProfileModel,
    others: Sequence[Model[FloatArray]],
    start: FloatArray,
    nearest_m: float,
) -> Estimate[FloatArray]:
    """The state that fits the models, by steps that are damped until they lower the cost.

    The step of `estimation.least_squares.solve` is too bold here: a terminator that is blurred by
    the lens, by the source or by the cloth looks the same over wide ranges.
    Raises NoSolutionError where it does not settle or an unknown is open.
    """
    models: tuple[Model[FloatArray], ...] = (brightness, *others)
    state, damping = start, DAMPING
    terms = tuple(model.linearise(state) for model in models)
    for _ in range(MAX_STEPS):
        normal = np.sum([term.normal for term in terms], axis=0)
        gradient = np.sum([term.gradient for term in terms], axis=0)
        cost = sum(term.cost for term in terms)
        damped = normal + np.diag(damping * np.diag(normal))
        trial = _moved(state, inverse_of(damped) @ gradient, nearest_m)
        _, trial = brightness.started(trial[:LINEAR], trial[LIGHT])
        if trial.size == LINEAR:
            damping /= EASED
            continue
        tried = tuple(model.linearise(trial) for model in models)
        fall = cost - sum(term.cost for term in tried)
        if fall >= 0.0:
            state, terms = trial, tried
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


def _moved(state: FloatArray, step: FloatArray, nearest_m: float) -> FloatArray:
    """A state after a step, kept where the model has a meaning."""
    limits = np.array([0.3 * state[DISTANCE], 0.1, 0.3, 0.3, 0.7])
    factor = min(1.0, float(np.min(limits / np.maximum(np.abs(step[:LINEAR]), 1e-12))))
    moved = state + factor * step
    moved[DISTANCE] = max(moved[DISTANCE], nearest_m)
    moved[THETA] = (moved[THETA] + math.pi) % (2.0 * math.pi) - math.pi
    return moved


def _starts(
    profile: CylinderProfile, model: ProfileModel, lens: IdealLens, size: CylinderSize
) -> list[FloatArray]:
    """The best two states of a coarse search over theta; the limb on the lit side fixes the rest.

    Raises NoSolutionError where the lit part has no extent to begin with.
    """
    lit = np.flatnonzero(profile.lit)
    if not lit.size:
        raise NoSolutionError("no lit body in the picture", ReasonCode.NO_BODY)
    if profile.heights.size:
        nearest = lens.focal_y_px * size.height_m / float(np.quantile(profile.heights, 0.97))
    else:  # cut above or below: as if its width were whole
        nearest = lens.focal_x_px * 2.0 * size.radius_m / max(float(lit[-1] - lit[0]), 1.0)
    found: list[tuple[float, FloatArray]] = []
    for theta in STARTS:
        dark = max(abs(theta) - 0.5 * math.pi, 0.0)
        sine = size.radius_m * math.sin(dark)
        if nearest <= sine:
            continue
        distance = size.radius_m * math.cos(dark) + math.sqrt(nearest**2 - sine**2)
        limb = half_width(size.radius_m, max(distance, 1.05 * size.radius_m))
        edge = lit[-1] + 0.5 if theta >= 0.0 else lit[0] - 0.5
        at = math.atan((edge - lens.centre_x_px) / lens.focal_x_px)
        axis = at - limb if theta >= 0.0 else at + limb
        state = np.array([max(distance, 1.05 * size.radius_m), axis, theta, *WIDTHS])
        found.append(model.started(state))
    found.sort(key=lambda pair: pair[0])
    if not found or not np.isfinite(found[0][0]):
        raise NoSolutionError("the profile is not that of a lit cylinder", ReasonCode.LIMB_MISFIT)
    return [state for cost, state in found[:2] if np.isfinite(cost)]


def _checked(
    best: Estimate[FloatArray], model: ProfileModel, profile: CylinderProfile, size: CylinderSize
) -> CylinderFit:
    """The solution with its covariance. Raises NoSolutionError where it is none."""
    brightness, heights = best.terms[0], best.terms[3]
    misfit = math.sqrt(brightness.cost / brightness.residuals.size)
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
            f"the brightness of columns differs by {misfit:.0f} of its errors, rms, from that of a "
            "lit cylinder",
            ReasonCode.LIMB_MISFIT,
        )
    if not best.state[LIGHT] > 0.0:
        raise NoSolutionError("the light falls from nowhere", ReasonCode.WRONG_LIGHT)
    # scatter beyond what is stated widens the errors
    covariance = best.covariance[:3, :3] * max(misfit, 1.0) ** 2
    beyond = (max(abs(float(best.state[THETA])) - GRAZING, 0.0) / GRAZING_SPAN) ** 3
    covariance[0, 0] += (GRAZING_RADII * size.radius_m * beyond) ** 2
    covariance[2, 2] += (GRAZING_RAD * beyond) ** 2
    gain = brightness.gain(best.covariance)[:3]
    noise = (gain / model.noise_weights) @ gain.T
    if heights.residuals.size:
        own = heights.gain(best.covariance)[:3]
        noise = noise + (own * profile.height_sigma**2) @ own.T
    distance, bearing, theta = (float(number) for number in best.state[:3])
    middle = 0.5 * sum(profile.rows)
    if profile.heights.size:
        middle = float(np.median(profile.tops + 0.5 * profile.heights))
    return CylinderFit(distance, bearing, theta, covariance, noise, misfit, best.state, middle)
