"""A camera's position from directions to the limb of a sphere, a spheroid or a triaxial ellipsoid.

Source: Zhukov 2025, ch. 2. Dividing body-fixed vectors by the semi-axes turns the ellipsoid into
the unit sphere, whose limb lies on a circular cone about the centre's direction e_0 with the half
angle chi: e_i . e_0 = cos chi. With s = e_0 / cos chi that is linear, e_i . s = 1. The linear
answer is biased on short arcs, so it only starts a least-squares fit of true angles: those between
the measured rays and the body's tangent cone, by their first-order distance F / |grad F|, exact
for the sphere up to the cube of the angle.

Beside a silhouette of any shape, which the caller predicts anew after each step, a position is
corrected from angles alone. Robust weights are Tukey's there, about a width that follows the
scatter: wide while the position is far off, narrow in the end.
"""

from operator import add

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.kernel import kernel
from optnav_cli.estimation.consider import azimuth_correlated, azimuths_about_nadir
from optnav_cli.estimation.least_squares import (
    Estimate,
    Iteration,
    Linearisation,
    inverse_of,
    linearised,
    mirrored,
    solve,
)
from optnav_cli.estimation.robust import TUKEY, scatter, tukey, tukey_weights
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

MIN_LIMB_POINTS = 4  # three unknowns, one equation a point, and one left to see an error by
_UNSETTLED = Reason(
    ReasonCode.NOT_SETTLED, "the fit of the limb does not settle on a position outside the body"
)
ITERATION = Iteration(20, 1e-3, undetermined=_UNSETTLED, unsettled=_UNSETTLED)
ROUNDS = 6  # of weights and solution; later ones change a thousandth of a sigma
# Of weights that are given: the step that they make is the only one.
_OPEN = Reason(ReasonCode.DEGENERATE, "the limb points leave a direction of the position open")
ONE_STEP = Iteration(1, np.inf, undetermined=_OPEN, unsettled=NO_REASON)


class LimbModel:
    """Angles between rays and the tangent cone of an ellipsoid, as measurements of a position.

    Arguments as `fit_limb`. Residuals are measured ray less cone, positive away from the body.
    """

    def __init__(
        self,
        rays: FloatArray,
        sigmas: FloatArray,
        radii_m: FloatArray,
        scales: FloatArray | None,
        cut: float,
    ) -> None:
        self._stretched, self._lengths = _stretch(rays, radii_m)
        self._stated = np.full(len(rays), 1.0) / (sigmas * sigmas)
        self._sizes = np.ones(len(rays)) if scales is None else scales
        self._radii, self._cut = radii_m, cut

    def solve_linear(self) -> FloatArray:
        """Position (3,) by e . s = 1. Raises NoSolutionError for what is no cone about a body."""
        start = _solve_linear(self._stretched, self._stated, self._radii)
        if not np.isfinite(start[0]):
            raise NoSolutionError(
                "the limb points do not lie on a cone about the body", ReasonCode.LIMB_MISFIT
            )
        return start

    def linearise(self, state: FloatArray) -> Linearisation:
        """The angles from a position (3,). Raises NoSolutionError for one inside the body."""
        equations = _compute_equations(
            self._stretched, self._lengths, self._stated, self._radii, self._sizes, state, self._cut
        )
        if not equations[2] < np.inf:
            raise _UNSETTLED.error()
        return Linearisation(*equations)


def solve_linear_position(directions: ArrayLike, radii_m: ArrayLike) -> FloatArray:
    """Position (3,), m, by the linear least squares e . s = 1 alone.

    directions (n, 3) to the limb, body frame, any length;  radii_m (3,) semi-axes.
    Raises NoSolutionError when they are no cone about a body.
    """
    rays, radii = _check_directions(directions, radii_m)
    return LimbModel(rays, np.ones(len(rays)), radii, None, np.inf).solve_linear()


def fit_limb(
    directions: ArrayLike,
    sigmas: ArrayLike,
    radii_m: ArrayLike,
    *,
    scales: ArrayLike | None = None,
    start_m: ArrayLike | None = None,
    cut: float = np.inf,
) -> Estimate[FloatArray]:
    """Position (3,), m, body frame, from limb directions, by angles to the tangent cone.

    directions (n, 3)  to the limb, body frame, any length
    sigmas     (n,)    rad, stated error of each, independent of the others
    radii_m    (3,)    semi-axes along body x, y, z
    scales     (n,)    size of the body at each ray in units of the ellipsoid: terrain on the limb
    start_m    (3,)    where to begin; the linear answer when None
    cut        rad     Tukey's biweight is nought beyond it; infinite: plain least squares

    The covariance is that of errors which neighbours share. Raises NoSolutionError for too few
    points, a camera inside the body, or no convergence.
    """
    rays, radii = _check_directions(directions, radii_m)
    sizes = None if scales is None else np.ascontiguousarray(scales, np.float64)
    model = LimbModel(rays, np.asarray(sigmas, np.float64), radii, sizes, float(cut))
    start = model.solve_linear() if start_m is None else np.array(start_m, np.float64)
    fit = solve([model], start, add, ITERATION)
    azimuths = azimuths_about_nadir(rays, fit.state)
    covariance = azimuth_correlated(fit.measured, fit.noise, azimuths)
    return Estimate(fit.state, covariance, fit.noise, fit.terms)


def _check_directions(directions: ArrayLike, radii_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    rays = np.ascontiguousarray(directions, dtype=np.float64)
    if rays.ndim != 2 or rays.shape[1] != 3:
        raise ValueError(f"expected directions (n, 3), got {rays.shape}")
    if len(rays) < MIN_LIMB_POINTS:
        raise NoSolutionError(
            f"{len(rays)} limb points; {MIN_LIMB_POINTS} are needed", ReasonCode.NOISY_LIMB
        )
    return rays, np.ascontiguousarray(radii_m, dtype=np.float64)


@kernel
def _stretch(rays: FloatArray, radii: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit rays (n, 3) in the frame where the body is the unit sphere, and by what they grew.

    A ray of unit length in the body frame has the length (n,) there before it is made unit again.
    """
    out, lengths = np.empty(rays.shape), np.empty(rays.shape[0])
    p, q, r = 1.0 / radii[0], 1.0 / radii[1], 1.0 / radii[2]
    for i in range(rays.shape[0]):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        a, b, c = x * p, y * q, z * r
        square = a * a + b * b + c * c
        unit = 1.0 / np.sqrt(square)
        out[i, 0], out[i, 1], out[i, 2] = a * unit, b * unit, c * unit
        lengths[i] = np.sqrt(square / (x * x + y * y + z * z))
    return out, lengths


@kernel
def _solve_linear(stretched: FloatArray, weights: FloatArray, radii: FloatArray) -> FloatArray:
    """The least-squares s of e . s = 1 in the stretched frame, as a position; NaN if it is none."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for i in range(stretched.shape[0]):
        for k in range(3):
            scaled = weights[i] * stretched[i, k]
            right[k] += scaled
            for m in range(k, 3):
                normal[k, m] += scaled * stretched[i, m]
    mirrored(normal)
    # of arcs so short that only rounding is left of the determinant there is no cone
    if not np.linalg.det(normal) > 1e-14 * normal[0, 0] * normal[1, 1] * normal[2, 2]:
        return np.full(3, np.nan)
    s = inverse_of(normal) @ right
    square = s[0] ** 2 + s[1] ** 2 + s[2] ** 2
    # R = -R_0 e_0 / sin chi, and with |s| = 1 / cos chi: e_0 / sin chi = s / sqrt(|s|^2 - 1)
    if not square > 1.0:
        return np.full(3, np.nan)
    position: FloatArray = -s * radii / np.sqrt(square - 1.0)
    return position


@kernel
def _compute_equations(
    stretched: FloatArray,
    lengths: FloatArray,
    stated: FloatArray,
    radii: FloatArray,
    sizes: FloatArray,
    position: FloatArray,
    cut: float,
) -> tuple[FloatArray, FloatArray, float, FloatArray, FloatArray, FloatArray]:
    """The fields of `Linearisation` at a position; the cost is infinite inside the body."""
    n = len(stated)
    rows, residuals, weights = np.empty((n, 3)), np.empty(n), np.empty(n)
    normal, gradient, cost = np.zeros((3, 3)), np.zeros(3), 0.0
    p = position / radii
    distance = np.sqrt((p * p).sum())
    if not distance > sizes.max():
        return normal, gradient, np.inf, residuals, rows, weights
    ux, uy, uz = p / distance
    sx, sy, sz = 1.0 / radii
    nearness, sharpness = 1.0 / distance, 1.0 / cut
    n00, n01, n02, n11, n12, n22, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    # few divisions, for these and the roots take the time
    for i in range(n):
        a, b, c = stretched[i, 0], stretched[i, 1], stretched[i, 2]
        cos_a = -(a * ux + b * uy + c * uz)
        # across the line to the centre: of length sin a
        x, y, z = a + cos_a * ux, b + cos_a * uy, c + cos_a * uz
        sin_a = np.sqrt(x * x + y * y + z * z)
        sin_x = sizes[i] * nearness
        cos_x = np.sqrt(max(1.0 - sin_x * sin_x, 1e-30))
        # the angle in the stretched frame changes with the true one, as the ray turns, as fast as
        # this gradient is long, over `lengths` and sin a
        gx, gy, gz = (ux + cos_a * a) * sx, (uy + cos_a * b) * sy, (uz + cos_a * c) * sz
        slowness = lengths[i] / (np.sqrt(gx * gx + gy * gy + gz * gz) + 1e-30)
        f = -slowness * nearness
        g = f * sin_a * sin_x / cos_x
        j0, j1, j2 = (x * f + ux * g) * sx, (y * f + uy * g) * sy, (z * f + uz * g) * sz
        r = (sin_a * cos_x - cos_a * sin_x) * sin_a * slowness
        w = stated[i] * tukey(r * sharpness)
        rows[i, 0], rows[i, 1], rows[i, 2] = j0, j1, j2
        residuals[i], weights[i] = r, w
        cost += w * r * r
        w0, w1, w2 = w * j0, w * j1, w * j2
        n00, n01, n02 = n00 + w0 * j0, n01 + w0 * j1, n02 + w0 * j2
        n11, n12, n22 = n11 + w1 * j1, n12 + w1 * j2, n22 + w2 * j2
        g0, g1, g2 = g0 + w0 * r, g1 + w1 * r, g2 + w2 * r
    normal[0, 0], normal[0, 1], normal[0, 2] = n00, n01, n02
    normal[1, 0], normal[1, 1], normal[1, 2] = n01, n11, n12
    normal[2, 0], normal[2, 1], normal[2, 2] = n02, n12, n22
    gradient[0], gradient[1], gradient[2] = g0, g1, g2
    return normal, gradient, cost, residuals, rows, weights


class SilhouetteModel:
    """Angles beside a silhouette, known to first order about a position (3,), m.

    offsets (n,) rad there;  jacobian (n, 3) of the offsets, their sign turned;  weights (n,)
    """

    def __init__(
        self, position: FloatArray, offsets: FloatArray, jacobian: FloatArray, weights: FloatArray
    ) -> None:
        self._position, self._weights = position, weights
        self._offsets, self._jacobian = offsets, jacobian

    def linearise(self, state: FloatArray) -> Linearisation:
        """The angles from a position (3,)."""
        residuals = self._offsets - self._jacobian @ (state - self._position)
        return linearised(residuals, self._jacobian, self._weights)


def solve_silhouette_step(
    position: FloatArray,
    offsets: FloatArray,
    rates: FloatArray,
    sigmas: FloatArray,
    azimuths: FloatArray,
    least_cut: float,
) -> Estimate[FloatArray]:
    """The position (3,), m, after a step, with its covariance as if it were the last.

    position  (3,)   m, where the silhouette was predicted
    offsets   (n,)   rad, rays beyond the silhouette along its normal
    rates     (n, 3) d offset / d position, rad a m
    sigmas    (n,)   rad, stated error of each, independent of the others
    azimuths  (n,)   rad about the nadir
    least_cut rad    errors below it are never outvoted as a whole

    The residuals are those after the step, to first order. Raises NoSolutionError for too few
    points or points that leave a direction open.
    """
    if len(offsets) < MIN_LIMB_POINTS:
        raise NoSolutionError(
            f"{len(offsets)} limb points; {MIN_LIMB_POINTS} are needed", ReasonCode.NOISY_LIMB
        )
    stated = 1.0 / (sigmas * sigmas)
    # begun by the absolute values' minimum, which a third of outliers does not carry away
    weights = stated
    for number in range(2 * ROUNDS):
        model = SilhouetteModel(position, offsets, -rates, weights)
        fit = solve([model], position, add, ONE_STEP)
        after = model.linearise(fit.state)
        sigma = scatter(after.residuals)
        if number < ROUNDS:
            size = max(sigma, least_cut / TUKEY)
            weights = stated / np.maximum(np.abs(after.residuals) / size, 1.0)
        elif number < 2 * ROUNDS - 1:
            weights = stated * tukey_weights(after.residuals, max(TUKEY * sigma, least_cut))
    covariance = azimuth_correlated(after, fit.noise, azimuths)
    return Estimate(fit.state, covariance, fit.noise, (after,))
