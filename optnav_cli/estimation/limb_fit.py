"""A camera's position from directions to the limb of a sphere, a spheroid or a triaxial ellipsoid.

Source: Zhukov 2025, ch. 2. Dividing body-fixed vectors by the semi-axes turns the ellipsoid into
the unit sphere, whose limb lies on a circular cone about the centre's direction e_0 with the half
angle chi: e_i . e_0 = cos chi. With s = e_0 / cos chi that is linear, e_i . s = 1. The linear
answer is biased on short arcs, so it only starts a least-squares fit of true angles: those between
the measured rays and the body's tangent cone, by their first-order distance F / |grad F|, exact
for the sphere up to the cube of the angle.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.kernel import kernel
from optnav_cli.reasons import ReasonCode


@kernel
def inverse_of(m: FloatArray) -> FloatArray:
    """Inverse of a symmetric 3 x 3 matrix by cofactors; NaN when it is singular."""
    out = np.empty((3, 3))
    a = m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1]
    b = m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2]
    c = m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0]
    det = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
    size = m[0, 0] * m[1, 1] * m[2, 2]
    scale = 1.0 / det if det > 1e-14 * size else np.nan
    out[0, 0], out[0, 1], out[0, 2] = a * scale, b * scale, c * scale
    out[1, 0], out[1, 1] = out[0, 1], (m[0, 0] * m[2, 2] - m[0, 2] * m[2, 0]) * scale
    out[1, 2] = (m[0, 1] * m[2, 0] - m[0, 0] * m[2, 1]) * scale
    out[2, 0], out[2, 1] = out[0, 2], out[1, 2]
    out[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]) * scale
    return out


@kernel
def mirrored(upper: FloatArray) -> FloatArray:
    """A symmetric matrix (3, 3) whose upper triangle is filled, with the lower one too."""
    for k in range(3):
        for m in range(k):
            upper[k, m] = upper[m, k]
    return upper


CORRELATION_DEG = 30.0  # errors of points farther apart count as independent
BINS = 72
MIN_LEFT = 0.05  # of a direction's scatter; the fit takes more of it on the shortest arcs
MIN_FREEDOM = 2.0


def correlated_covariance(
    rates: FloatArray,
    residuals: FloatArray,
    information: FloatArray,
    noise_m2: FloatArray,
    azimuths: FloatArray,
) -> FloatArray:
    """Covariance (3, 3), m^2, in no direction below the stated noise.

    rates        (n, 3) d residual / d position, rad a m;  residuals (n,) rad
    information  (n,)   rad^-2, weight of each point in the fit
    noise_m2     (3, 3) inverse of the fit's normal matrix
    azimuths     (n,)   rad about the nadir, -pi..pi
    """
    meat, expected, windows = _meat(rates, residuals, information, noise_m2, azimuths)
    return np.asarray(_sandwich(noise_m2, meat, expected, windows))


@kernel
def azimuths_about_nadir(rays: FloatArray, position: FloatArray) -> FloatArray:
    """Azimuth (n,) of rays (n, 3) about the nadir, rad, from an origin fixed by the position."""
    u = position / np.sqrt((position * position).sum())
    least = np.argmin(np.abs(u))
    first = -u[least] * u
    first[least] += 1.0
    first /= np.sqrt((first * first).sum())
    second = np.cross(u, first)
    out = np.empty(rays.shape[0])
    for i in range(out.size):
        x = rays[i, 0] * first[0] + rays[i, 1] * first[1] + rays[i, 2] * first[2]
        y = rays[i, 0] * second[0] + rays[i, 1] * second[1] + rays[i, 2] * second[2]
        out[i] = np.arctan2(y, x)
    return out


@kernel
def _meat(
    rows: FloatArray, residuals: FloatArray, weights: FloatArray, inverse: FloatArray,
    azimuths: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:  # fmt: skip
    """Products of scores, those apart weighted by Bartlett's triangle, and their expectation.

    The expectation is for errors of the stated size that bins do not share. With N_b the part of a
    bin in the normal matrix N, the fit leaves E g_b g_c' = (b = c) N_b - N_b inv(N) N_c.
    Returns both (3, 3), and how many windows of CORRELATION_DEG the points fill.
    """
    scores, normals = np.zeros((BINS, 3)), np.zeros((BINS, 3, 3))
    for i in range(azimuths.size):
        at = int((azimuths[i] / (2.0 * np.pi) + 0.5) * BINS) % BINS
        for k in range(3):
            scaled = weights[i] * rows[i, k]
            scores[at, k] += scaled * residuals[i]
            for m in range(k, 3):
                normals[at, k, m] += scaled * rows[i, m]
    for i in range(BINS):
        mirrored(normals[i])
    reach = round(CORRELATION_DEG * BINS / 360.0)
    meat, expected, seen = np.zeros((3, 3)), np.zeros((3, 3)), 0
    score, normal = np.empty(3), np.empty((3, 3))
    for i in range(BINS):
        if normals[i, 0, 0] + normals[i, 1, 1] + normals[i, 2, 2] == 0.0:
            continue
        seen += 1
        score[:] = 0.0
        normal[:] = 0.0
        for lag in range(1 - reach, reach):
            share = 1.0 - abs(lag) / reach
            other = (i + lag) % BINS
            for k in range(3):
                score[k] += share * scores[other, k]
                for m in range(3):
                    normal[k, m] += share * normals[other, k, m]
        for k in range(3):
            for m in range(3):
                meat[k, m] += scores[i, k] * score[m]
                left = normals[i, k, m]
                for a in range(3):
                    for b in range(3):
                        left -= normals[i, k, a] * inverse[a, b] * normal[b, m]
                expected[k, m] += left
    return meat, expected, seen * (360.0 / BINS) / CORRELATION_DEG


@kernel
def _sandwich(
    noise: FloatArray, meat: FloatArray, expected: FloatArray, windows: float
) -> FloatArray:
    """Covariance (3, 3) from scores that are correlated over a window.

    In units of the stated noise the scatter of the scores is compared with what the fit would have
    left of it. Few windows know the scatter of a direction badly: half of the answer is that of
    all three together. It is raised for what an estimate from so few may miss, and in no
    direction falls below the stated noise.
    """
    lower = np.linalg.cholesky(noise)
    upper = np.ascontiguousarray(lower.T)
    seen, left = upper @ meat @ lower, upper @ expected @ lower
    values, vectors = np.linalg.eigh(left)
    root = vectors / np.sqrt(np.maximum(values, MIN_LEFT)) @ vectors.T
    pooled = np.trace(seen) / max(np.trace(left), 3.0 * MIN_LEFT)
    own = 0.5 * (root @ seen @ root + pooled * np.eye(3))
    own *= 1.0 + 2.0 / max(1.5 * windows - 3.0, MIN_FREEDOM)
    values, vectors = np.linalg.eigh(0.5 * (own + own.T))
    raised = vectors * np.maximum(values, 1.0) @ vectors.T
    covariance: FloatArray = lower @ raised @ upper
    return covariance


MIN_LIMB_POINTS = 4  # three unknowns, one equation a point, and one left to see an error by
MAX_ITERATIONS = 20
STEP_SIGMAS = 1e-3  # a step below this share of its own sigma changes nothing that matters


@dataclass(frozen=True)
class LimbFit:
    """A position that fits limb directions.

    position_m      (3,) camera, body frame
    covariance_m2   (3, 3) sandwich of the residuals, in no direction below the stated noise
    noise_m2        (3, 3) what the stated sigmas alone give, errors independent
    gain_m          (3, n) d position / d angle of each ray, m a rad; to propagate shared errors
    rates           (n, 3) d residual / d position, rad a m
    information     (n,)   rad^-2, weight of each point: robust share over stated variance
    residuals       (n,) rad, measured ray less tangent cone, positive away from the body
    weights         (n,) final share 0..1 that the robust weights leave of each point
    """

    position_m: FloatArray
    covariance_m2: FloatArray
    noise_m2: FloatArray
    gain_m: FloatArray
    rates: FloatArray
    information: FloatArray
    residuals: FloatArray
    weights: FloatArray


def linear_position(directions: ArrayLike, radii_m: ArrayLike) -> FloatArray:
    """Position (3,), m, by the linear least squares e . s = 1 alone.

    directions (n, 3) to the limb, body frame, any length;  radii_m (3,) semi-axes.
    Raises NoSolutionError when they are no cone about a body.
    """
    rays, radii = _checked(directions, radii_m)
    stretched, _ = _stretch(rays, radii)
    return _begin(stretched, np.ones(len(rays)), radii)


def fit_limb(
    directions: ArrayLike,
    sigmas: ArrayLike,
    radii_m: ArrayLike,
    *,
    scales: ArrayLike | None = None,
    start_m: ArrayLike | None = None,
    cut: float = np.inf,
) -> LimbFit:
    """Position from limb directions, by angles to the tangent cone.

    directions (n, 3)  to the limb, body frame, any length
    sigmas     (n,)    rad, stated error of each, independent of the others
    radii_m    (3,)    semi-axes along body x, y, z
    scales     (n,)    size of the body at each ray in units of the ellipsoid: terrain on the limb
    start_m    (3,)    where to begin; the linear answer when None
    cut        rad     Tukey's biweight is nought beyond it; infinite: plain least squares

    Raises NoSolutionError for too few points, a camera inside the body, or no convergence.
    """
    rays, radii = _checked(directions, radii_m)
    sigma = np.asarray(sigmas, dtype=np.float64)
    weights = np.full(len(rays), 1.0) / (sigma * sigma)
    sizes = np.ones(len(rays)) if scales is None else np.ascontiguousarray(scales, np.float64)
    stretched, lengths = _stretch(rays, radii)
    if start_m is None:
        start = _begin(stretched, weights, radii)
    else:
        start = np.array(start_m, dtype=np.float64)
    done, position, noise, gain, rates, residuals, shares = _fit(
        stretched, lengths, weights, radii, sizes, start, float(cut)
    )
    if not done:
        raise NoSolutionError(
            "the fit of the limb does not settle on a position outside the body",
            ReasonCode.NOT_SETTLED,
        )
    information = weights * shares
    covariance = correlated_covariance(
        rates, residuals, information, noise, azimuths_about_nadir(rays, position)
    )
    return LimbFit(position, covariance, noise, gain, rates, information, residuals, shares)


def _checked(directions: ArrayLike, radii_m: ArrayLike) -> tuple[FloatArray, FloatArray]:
    rays = np.ascontiguousarray(directions, dtype=np.float64)
    if rays.ndim != 2 or rays.shape[1] != 3:
        raise ValueError(f"expected directions (n, 3), got {rays.shape}")
    if len(rays) < MIN_LIMB_POINTS:
        raise NoSolutionError(
            f"{len(rays)} limb points; {MIN_LIMB_POINTS} are needed", ReasonCode.NOISY_LIMB
        )
    return rays, np.ascontiguousarray(radii_m, dtype=np.float64)


def _begin(stretched: FloatArray, weights: FloatArray, radii: FloatArray) -> FloatArray:
    start = _linear(stretched, weights, radii)
    if not np.isfinite(start[0]):
        raise NoSolutionError(
            "the limb points do not lie on a cone about the body", ReasonCode.LIMB_MISFIT
        )
    return start


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
        length = np.sqrt(a * a + b * b + c * c)
        out[i, 0], out[i, 1], out[i, 2] = a / length, b / length, c / length
        lengths[i] = length / np.sqrt(x * x + y * y + z * z)
    return out, lengths


@kernel
def _linear(stretched: FloatArray, weights: FloatArray, radii: FloatArray) -> FloatArray:
    """The least-squares s of e . s = 1 in the stretched frame, as a position; NaN if it is none."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for i in range(stretched.shape[0]):
        for k in range(3):
            scaled = weights[i] * stretched[i, k]
            right[k] += scaled
            for m in range(k, 3):
                normal[k, m] += scaled * stretched[i, m]
    inverse = inverse_of(mirrored(normal))
    s = inverse @ right
    square = s[0] ** 2 + s[1] ** 2 + s[2] ** 2
    # R = -R_0 e_0 / sin chi, and with |s| = 1 / cos chi: e_0 / sin chi = s / sqrt(|s|^2 - 1)
    if not square > 1.0:
        return np.full(3, np.nan)
    position: FloatArray = -s * radii / np.sqrt(square - 1.0)
    return position


@kernel
def _residual(
    ray: FloatArray, length: float, size: float, u: FloatArray, distance: float,
    scale: FloatArray, row: FloatArray,
) -> float:  # fmt: skip
    """Angle of a ray beyond the tangent cone, rad; its derivative by the position goes to `row`.

    ray (3,) unit and `length` from `_stretch`;  size of the body at this ray, in semi-axes
    u (3,) unit, `distance`: the position in the stretched frame;  scale (3,) inverse semi-axes
    """
    a, b, c = ray[0], ray[1], ray[2]
    cos_a = -(a * u[0] + b * u[1] + c * u[2])
    # across the line to the centre: of length sin a
    p, q, r = a + cos_a * u[0], b + cos_a * u[1], c + cos_a * u[2]
    sin_a = np.sqrt(p * p + q * q + r * r) + 1e-30
    sin_x = size / distance
    cos_x = np.sqrt(max(1.0 - sin_x * sin_x, 1e-30))
    sine = sin_a * cos_x - cos_a * sin_x
    # how fast that angle in the stretched frame changes with the true one, as the ray turns
    gx, gy = (u[0] + cos_a * a) * scale[0], (u[1] + cos_a * b) * scale[1]
    gz = (u[2] + cos_a * c) * scale[2]
    rate = np.sqrt(gx * gx + gy * gy + gz * gz) / (length * sin_a) + 1e-30
    f, g = 1.0 / (sin_a * distance * rate), sin_x / (cos_x * distance * rate)
    row[0] = (p * f + u[0] * g) * scale[0]
    row[1] = (q * f + u[1] * g) * scale[1]
    row[2] = (r * f + u[2] * g) * scale[2]
    answer: float = sine / rate
    return answer


@kernel
def _fit(
    stretched: FloatArray, lengths: FloatArray, weights: FloatArray, radii: FloatArray,
    sizes: FloatArray, start: FloatArray, cut: float,
) -> tuple[
    bool, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray
]:  # fmt: skip
    """Whether the fit settled; position, inverse of the normal matrix, and as `LimbFit` has them
    gain, rates, residuals and weights.
    """
    n = stretched.shape[0]
    position, scale = start.copy(), 1.0 / radii
    rows, residuals, shares, used = np.empty((n, 3)), np.empty(n), np.ones(n), np.empty(n)
    inverse, row, largest = np.full((3, 3), np.nan), np.empty(3), sizes.max()
    done = False
    for _ in range(MAX_ITERATIONS):
        p = position * scale
        distance = np.sqrt((p * p).sum())
        if not distance > largest:
            break
        p /= distance
        normal, right = np.zeros((3, 3)), np.zeros(3)
        for i in range(n):
            r = _residual(stretched[i], lengths[i], sizes[i], p, distance, scale, row)
            q = r / cut
            # Tukey's biweight
            shares[i] = (1.0 - q * q) ** 2 if abs(q) < 1.0 else 0.0
            residuals[i], used[i] = r, weights[i] * shares[i]
            for k in range(3):
                rows[i, k] = row[k]
                scaled = used[i] * row[k]
                right[k] -= scaled * r
                for m in range(k, 3):
                    normal[k, m] += scaled * row[m]
        inverse = inverse_of(mirrored(normal))
        step = inverse @ right
        gained = (step * right).sum()  # squared size of the step in its own sigmas
        if not gained < np.inf:
            break
        position += step
        if gained < STEP_SIGMAS**2:
            done = True
            break
    gain = np.empty((3, n))
    for i in range(n):
        for k in range(3):
            gain[k, i] = -used[i] * (
                inverse[k, 0] * rows[i, 0] + inverse[k, 1] * rows[i, 1] + inverse[k, 2] * rows[i, 2]
            )
    return done, position, inverse, gain, rows, residuals, shares
