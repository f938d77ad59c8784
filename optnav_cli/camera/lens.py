"""Compiled lens models: one point in the camera frame to a pixel, with derivatives.

Pinhole with Brown-Conrady distortion (k1 k2 p1 p2 k3) or all of OpenCV's terms, and the fisheye of
Kannala and Brandt (IEEE TPAMI 28, 2006), equidistant without coefficients; all as OpenCV orders
their terms. A lens is a model number and its parameters:

    focal length along x px, principal point x, y px, five coefficients, limit, image circle radius
    along x px, focal length along y by that along x; of the pinhole with all terms also k4 k5 k6
    s1 s2 s3 s4, the tilt (3, 3) of the sensor and its inverse

Beyond `limit` (pinhole: squared tangent of the off-axis angle; fisheye: angle) the answer is NaN.
"""

import math

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel

Derivatives = tuple[float, float, float, float, float, float]

PINHOLE, FISHEYE, OPENCV = 0, 1, 2
PARAMETERS = 36
LIMIT, CIRCLE, ASPECT, TERMS, TILT, LEVEL = 8, 9, 10, 11, 18, 27  # where each begins
_STEPS = 60  # bisection alone would reach the last digit within these
# A distortion polynomial fitted to a real lens says nothing at 84 degrees from the axis.
MAX_TANGENT = 10.0
_RADII = 4000  # the edge is found to a part in 4000 of MAX_TANGENT, then refined
_AZIMUTHS = 72
BLOCK = 512  # points that are projected side by side


@kernel
def _distort_brown(p: FloatArray, a: float, b: float) -> tuple[float, float, float, float, float]:
    """Distorted x, y of undistorted a, b, and the symmetric derivative xx, xy, yy."""
    k1, k2, p1, p2, k3 = p[3], p[4], p[5], p[6], p[7]
    s = a * a + b * b
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    slope = 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))  # d radial / da = slope * a
    x = a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a)
    y = b * radial + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b
    xx = radial + slope * a * a + 2.0 * p1 * b + 6.0 * p2 * a
    yy = radial + slope * b * b + 6.0 * p1 * b + 2.0 * p2 * a
    xy = slope * a * b + 2.0 * p1 * a + 2.0 * p2 * b
    return x, y, xx, xy, yy


@kernel
def _distort_opencv(
    p: FloatArray, a: float, b: float
) -> tuple[float, float, float, float, float, float]:
    """Distorted x, y of undistorted a, b before the tilt, and derivatives xa, xb, ya, yb."""
    k1, k2, p1, p2, k3 = p[3], p[4], p[5], p[6], p[7]
    k4, k5, k6, s1, s2, s3, s4 = p[11], p[12], p[13], p[14], p[15], p[16], p[17]
    s = a * a + b * b
    above, below = 1.0 + s * (k1 + s * (k2 + s * k3)), 1.0 + s * (k4 + s * (k5 + s * k6))
    radial = above / below
    slope = 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))
    slope = (slope - radial * 2.0 * (k4 + s * (2.0 * k5 + 3.0 * s * k6))) / below
    x = a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a) + s * (s1 + s * s2)
    y = b * radial + p1 * (s + 2.0 * b * b) + 2.0 * p2 * a * b + s * (s3 + s * s4)
    prism_x, prism_y = 2.0 * (s1 + 2.0 * s * s2), 2.0 * (s3 + 2.0 * s * s4)  # by half of s
    xa = radial + slope * a * a + 2.0 * p1 * b + 6.0 * p2 * a + prism_x * a
    yb = radial + slope * b * b + 6.0 * p1 * b + 2.0 * p2 * a + prism_y * b
    both = slope * a * b + 2.0 * p1 * a + 2.0 * p2 * b
    return x, y, xa, both + prism_x * b, both + prism_y * a, yb


@kernel
def _tilt_point(p: FloatArray, start: int, x: float, y: float) -> tuple[float, float, float]:
    """A point of the picture plane turned by the nine parameters from `start` on, and its depth."""
    depth = p[start + 6] * x + p[start + 7] * y + p[start + 8]
    u = (p[start] * x + p[start + 1] * y + p[start + 2]) / depth
    v = (p[start + 3] * x + p[start + 4] * y + p[start + 5]) / depth
    return u, v, depth


@kernel
def _compute_fisheye_radius(p: FloatArray, angle: float) -> tuple[float, float]:
    """Distance from the principal point in focal lengths, and its derivative."""
    t = angle * angle
    k1, k2, k3, k4 = p[3], p[4], p[5], p[6]
    radius = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
    return radius, slope


@kernel
def _compute_off_axis(across: float, z: float) -> float:
    """atan2 of across >= 0 and z, by Cephes' rational function: no call, so that loops vectorise.

    Source: S. L. Moshier, Cephes Math Library, atan.c; relative error below 2e-16.
    """
    size = abs(z)
    low, high = min(across, size), max(across, size)
    near = low > 0.66 * high
    t = (low - high if near else low) / (low + high if near else high)
    s = t * t
    above = -8.750608600031904e-1 * s - 1.615753718733365e1
    above = ((above * s - 7.500855792314705e1) * s - 1.2288666844901361e2) * s - 6.485021904942025e1
    below = (s + 2.485846490142306e1) * s + 1.650270098316988542e2
    below = ((below * s + 4.328810604912903e2) * s + 4.853903996359137e2) * s + 1.945506571482614e2
    angle = t + t * s * above / below
    angle = angle + 0.25 * math.pi if near else angle
    angle = 0.5 * math.pi - angle if across > size else angle
    return math.pi - angle if z < 0.0 else angle


@kernel
def _compute_fisheye_scale(p: FloatArray, across2: float, z: float) -> float:
    """Focal lengths from the principal point for each unit across the axis; NaN beyond the limit.

    across2  squared distance from the axis
    """
    across = math.sqrt(across2)
    angle = _compute_off_axis(across, z)
    radius, _ = _compute_fisheye_radius(p, angle)
    scale = radius / across if across > 0.0 else 1.0 / z
    seen = angle <= p[LIMIT] and (across > 0.0 or z > 0.0)
    return scale if seen else math.nan


@kernel
def _project_point(model: int, p: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Pixel of one point in the camera frame, through a pinhole or a fisheye."""
    if model == PINHOLE:
        if not z > 0.0:
            return math.nan, math.nan
        u, v = x / z, y / z
        if not u * u + v * v <= p[LIMIT]:
            return math.nan, math.nan
        u, v, _, _, _ = _distort_brown(p, u, v)
    else:
        scale = _compute_fisheye_scale(p, x * x + y * y, z)
        u, v = scale * x, scale * y
    u, v = p[0] * u, p[0] * v
    if not u * u + v * v <= p[CIRCLE] * p[CIRCLE]:
        return math.nan, math.nan
    return u + p[1], p[ASPECT] * v + p[2]


@kernel
def _project_opencv_point(p: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Pixel of one point in the camera frame, through a pinhole with all terms."""
    if not z > 0.0:
        return math.nan, math.nan
    u, v = x / z, y / z
    if not u * u + v * v <= p[LIMIT]:
        return math.nan, math.nan
    u, v, _, _, _, _ = _distort_opencv(p, u, v)
    u, v, _ = _tilt_point(p, TILT, u, v)
    u, v = p[0] * u, p[0] * v
    if u * u + v * v > p[CIRCLE] * p[CIRCLE]:
        return math.nan, math.nan
    return u + p[1], p[ASPECT] * v + p[2]


@kernel
def _differentiate_opencv(p: FloatArray, x: float, y: float, z: float) -> Derivatives:
    """Compute `_differentiate_pixel` of a pinhole with all terms."""
    a, b = x / z, y / z
    u, v, ua, ub, va, vb = _distort_opencv(p, a, b)
    u, v, depth = _tilt_point(p, TILT, u, v)
    # of the tilt: each row less the point's share of the depth's row
    t00, t01 = (p[18] - u * p[24]) / depth, (p[19] - u * p[25]) / depth
    t10, t11 = (p[21] - v * p[24]) / depth, (p[22] - v * p[25]) / depth
    g = p[0] / z
    xa, xb = g * (t00 * ua + t01 * va), g * (t00 * ub + t01 * vb)
    ya, yb = g * (t10 * ua + t11 * va), g * (t10 * ub + t11 * vb)
    return xa, xb, -(xa * a + xb * b), ya, yb, -(ya * a + yb * b)


@kernel
def _differentiate_pixel(model: int, p: FloatArray, x: float, y: float, z: float) -> Derivatives:
    """Derivatives of the pixel: x by x, y, z, then y by x, y, z; px per unit of the point.

    As if pixels were square.
    """
    f = p[0]
    if model == PINHOLE:
        a, b = x / z, y / z
        _, _, xx, xy, yy = _distort_brown(p, a, b)
        g = f / z
        return g * xx, g * xy, -g * (xx * a + xy * b), g * xy, g * yy, -g * (xy * a + yy * b)
    squared = x * x + y * y
    across = math.sqrt(squared)
    range2 = squared + z * z
    radius, slope = _compute_fisheye_radius(p, _compute_off_axis(across, z))
    # across the radius the pixel moves by `around`, along it by `along`, per unit of the point
    along = slope * z / range2
    around = radius / across if across > 0.0 else 1.0 / z
    c, s = (x / across, y / across) if across > 0.0 else (1.0, 0.0)
    xy = f * (along - around) * c * s
    depth = -f * slope / range2
    xx, yy = f * (along * c * c + around * s * s), f * (along * s * s + around * c * c)
    return xx, xy, depth * x, xy, yy, depth * y


@kernel
def _invert_radius(model: int, p: FloatArray, wanted: float, highest: float) -> float:
    """Undistorted radius (pinhole: tangent, fisheye: angle) of a distorted one.

    Newton's steps, replaced by bisection where they leave the bracket; the forward function rises
    from 0 to its value at `highest`.
    """
    low, high = 0.0, highest
    r = min(wanted, highest)
    for _ in range(_STEPS):
        if model == PINHOLE:
            s = r * r
            value = r * (1.0 + s * (p[3] + s * (p[4] + s * p[7])))
            slope = 1.0 + s * (3.0 * p[3] + s * (5.0 * p[4] + s * 7.0 * p[7]))
        elif model == OPENCV:
            s = r * r
            above = 1.0 + s * (p[3] + s * (p[4] + s * p[7]))
            below = 1.0 + s * (p[11] + s * (p[12] + s * p[13]))
            value = r * above / below
            slope = above + 2.0 * s * (p[3] + s * (2.0 * p[4] + 3.0 * s * p[7]))
            slope -= value * 2.0 * r * (p[11] + s * (2.0 * p[12] + 3.0 * s * p[13]))
            slope /= below
        else:
            value, slope = _compute_fisheye_radius(p, r)
        error = value - wanted
        if error == 0.0:
            return r
        if error > 0.0:
            high = r
        else:
            low = r
        step = r - error / slope if slope > 0.0 else math.nan
        if not (low < step < high):
            step = 0.5 * (low + high)
        if abs(step - r) <= 2e-16 * step:
            return step
        r = step
    return r


@kernel
def _distort_pinhole(
    model: int, p: FloatArray, a: float, b: float
) -> tuple[float, float, float, float, float, float]:
    """Compute `_distort_opencv` of either pinhole."""
    if model == OPENCV:
        return _distort_opencv(p, a, b)
    x, y, xx, xy, yy = _distort_brown(p, a, b)
    return x, y, xx, xy, xy, yy


@kernel
def _invert(model: int, p: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Undistorted a, b of distorted u, v; NaN where the model reaches u, v from no valid ray."""
    limit = p[LIMIT]
    if model == OPENCV:
        u, v, depth = _tilt_point(p, LEVEL, u, v)
        if not depth > 0.0:
            return math.nan, math.nan
    if not limit < math.inf:
        return u, v
    distance = math.sqrt(u * u + v * v)
    if distance == 0.0:
        return 0.0, 0.0  # no term moves the centre
    start = _invert_radius(model, p, distance, math.sqrt(limit)) / distance
    a, b = start * u, start * v
    x, y, xa, xb, ya, yb = _distort_pinhole(model, p, a, b)
    miss = math.sqrt((x - u) ** 2 + (y - v) ** 2)
    for _ in range(_STEPS):
        determinant = xa * yb - xb * ya
        da = (yb * (u - x) - xb * (v - y)) / determinant
        db = (xa * (v - y) - ya * (u - x)) / determinant
        x, y, xa, xb, ya, yb = _distort_pinhole(model, p, a + da, b + db)
        now = math.sqrt((x - u) ** 2 + (y - v) ** 2)
        if not now < miss:
            break
        a, b, miss = a + da, b + db, now
    # a step of the valid edge is left for rounding
    if miss > 1e-13 * (1.0 + distance) or a * a + b * b > limit * (1.0 + 1e-12):
        return math.nan, math.nan
    return a, b


@kernel
def _invert_pixel(model: int, p: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Unit vector in the camera frame that a pixel looks along."""
    u, v = x - p[1], (y - p[2]) / p[ASPECT]
    if not u * u + v * v <= p[CIRCLE] * p[CIRCLE]:
        return math.nan, math.nan, math.nan
    u, v = u / p[0], v / p[0]
    if model != FISHEYE:
        # with a constant model it compiles to a loop for that model: 1.2 times as fast
        u, v = _invert(PINHOLE, p, u, v) if model == PINHOLE else _invert(OPENCV, p, u, v)
        scale = 1.0 / math.sqrt(1.0 + u * u + v * v)
        return u * scale, v * scale, scale
    distance = math.sqrt(u * u + v * v)
    if distance == 0.0:
        return 0.0, 0.0, 1.0
    farthest, _ = _compute_fisheye_radius(p, p[LIMIT])
    if not distance <= farthest:
        return math.nan, math.nan, math.nan
    angle = _invert_radius(FISHEYE, p, distance, p[LIMIT])
    scale = math.sin(angle) / distance
    return u * scale, v * scale, math.cos(angle)


@kernel
def project_opencv(
    p: FloatArray, points: FloatArray, pixels: FloatArray, jacobians: FloatArray
) -> None:
    """Compute `project_with_derivatives` of a pinhole with all terms.

    A kernel of its own: its length would make those of the other lenses slower by half and more.
    """
    q = p[ASPECT]
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        pixels[i, 0], pixels[i, 1] = _project_opencv_point(p, x, y, z)
        if math.isnan(pixels[i, 0]):
            jacobians[i] = math.nan
            continue
        d = _differentiate_opencv(p, x, y, z)
        jacobians[i, 0, 0], jacobians[i, 0, 1], jacobians[i, 0, 2] = d[0], d[1], d[2]
        jacobians[i, 1, 0], jacobians[i, 1, 1], jacobians[i, 1, 2] = q * d[3], q * d[4], q * d[5]


@kernel
def project_points(model: int, p: FloatArray, points: FloatArray, pixels: FloatArray) -> None:
    """Write pixels (n, 2) of points (n, 3) in the camera frame."""
    for i in range(points.shape[0]):
        pixels[i, 0], pixels[i, 1] = _project_point(
            model, p, points[i, 0], points[i, 1], points[i, 2]
        )


@kernel
def project_body_points(
    model: int,
    p: FloatArray,
    points: FloatArray,
    position: FloatArray,
    camera_from_body: FloatArray,
    pixels: FloatArray,
) -> None:
    """Write pixels (n, 2) of points (n, 3) in the body frame, seen from a position (3,)."""
    r = camera_from_body
    count = points.shape[0]
    xs, ys, zs, scales = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for first in range(0, count, BLOCK):
        size = min(BLOCK, count - first)
        for k in range(size):
            i = first + k
            dx = points[i, 0] - position[0]
            dy = points[i, 1] - position[1]
            dz = points[i, 2] - position[2]
            xs[k] = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
            ys[k] = r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz
            zs[k] = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
        # loops of their own over plain arrays: the processor takes several points at once
        if model == PINHOLE:
            for k in range(size):
                a, b = xs[k] / zs[k], ys[k] / zs[k]
                seen = (zs[k] > 0.0) & (a * a + b * b <= p[LIMIT])
                a, b, _, _, _ = _distort_brown(p, a, b)
                xs[k], ys[k], scales[k] = a, b, 1.0 if seen else math.nan
        else:
            for k in range(size):
                scales[k] = _compute_fisheye_scale(p, xs[k] * xs[k] + ys[k] * ys[k], zs[k])
        for k in range(size):
            i = first + k
            u, v = p[0] * (scales[k] * xs[k]), p[0] * (scales[k] * ys[k])
            inside = u * u + v * v <= p[CIRCLE] * p[CIRCLE]
            pixels[i, 0] = u + p[1] if inside else math.nan
            pixels[i, 1] = p[ASPECT] * v + p[2] if inside else math.nan


@kernel
def project_with_derivatives(
    model: int, p: FloatArray, points: FloatArray, pixels: FloatArray, jacobians: FloatArray
) -> None:
    """Write pixels (n, 2) and their derivatives (n, 2, 3) by the points (n, 3), camera frame."""
    q = p[ASPECT]
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        pixels[i, 0], pixels[i, 1] = _project_point(model, p, x, y, z)
        if math.isnan(pixels[i, 0]):
            jacobians[i] = math.nan
            continue
        d = _differentiate_pixel(model, p, x, y, z)
        jacobians[i, 0, 0], jacobians[i, 0, 1], jacobians[i, 0, 2] = d[0], d[1], d[2]
        jacobians[i, 1, 0], jacobians[i, 1, 1], jacobians[i, 1, 2] = q * d[3], q * d[4], q * d[5]


@kernel
def invert_pixels(model: int, p: FloatArray, pixels: FloatArray, rays: FloatArray) -> None:
    """Write unit rays (n, 3), camera frame, of pixels (n, 2)."""
    for i in range(pixels.shape[0]):
        rays[i, 0], rays[i, 1], rays[i, 2] = _invert_pixel(model, p, pixels[i, 0], pixels[i, 1])


def find_pinhole_limit(parameters: FloatArray) -> float:
    """Squared tangent of the off-axis angle up to which a distortion is one to one.

    parameters  of a lens with five coefficients, or with all of OpenCV's terms
    Returns infinity without distortion.
    """
    if not parameters[3:8].any() and not parameters[TERMS:TILT].any():
        return math.inf
    low, high = 0.0, MAX_TANGENT
    for _ in range(3):
        radii = np.linspace(low, high, _RADII)
        least = np.empty(_RADII)
        _find_least_determinants(parameters, radii, least)
        folded = np.flatnonzero(least <= 0.0)
        if folded.size == 0:
            return high * high
        # folded[0] > 0: on the axis the determinant is 1, at `low` it was positive
        low, high = float(radii[folded[0] - 1]), float(radii[folded[0]])
    return low * low


@kernel
def _find_least_determinants(p: FloatArray, radii: FloatArray, least: FloatArray) -> None:
    """Write the smallest Jacobian determinant of the distortion over all azimuths, at each radius.

    Not positive either where the radial terms have a pole or the tilted sensor ends.
    """
    for i in range(radii.shape[0]):
        least[i] = math.inf
        s = radii[i] * radii[i]
        below = 1.0 + s * (p[11] + s * (p[12] + s * p[13]))
        for j in range(_AZIMUTHS):
            azimuth = 2.0 * math.pi * j / _AZIMUTHS
            x, y, xa, xb, ya, yb = _distort_opencv(
                p, radii[i] * math.cos(azimuth), radii[i] * math.sin(azimuth)
            )
            _, _, depth = _tilt_point(p, TILT, x, y)
            # both eigenvalues: past a double fold the determinant is positive again
            valid = below > 0.0 and xa + yb > 0.0 and depth > 0.0
            least[i] = min(least[i], xa * yb - xb * ya if valid else -1.0)


def find_fisheye_limit(coefficients: tuple[float, ...]) -> float:
    """Off-axis angle, rad, up to which the Kannala-Brandt radius grows; pi at most.

    coefficients  k1 k2 k3 k4
    """
    k1, k2, k3, k4 = coefficients
    roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = roots.real[(np.abs(roots.imag) < 1e-12 * np.abs(roots)) & (roots.real > 0.0)]
    return float(min(np.pi, np.sqrt(real.min()))) if real.size else float(np.pi)
