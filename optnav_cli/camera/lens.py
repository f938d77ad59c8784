"""Compiled lens models: one point in the camera frame to a pixel, with derivatives.

Pinhole with the Brown-Conrady distortion in OpenCV's order k1 k2 p1 p2 k3 (OpenCV documentation,
"Camera Calibration and 3D Reconstruction"), and the fisheye of Kannala and Brandt (IEEE TPAMI 28,
2006) as OpenCV's fisheye module writes it, whose case without coefficients is the equidistant lens.
A lens is a model number and its parameters:

    focal length px, principal point x, y px, five coefficients, limit, image circle radius px

Beyond `limit` the model folds back (pinhole: squared tangent of the off-axis angle; fisheye: the
angle itself): no pixel belongs to a ray there, so the answer is NaN. The kernels stay in one file,
because the cache of compiled code sees changes of a kernel's own file only.
"""

import math

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel

Derivatives = tuple[float, float, float, float, float, float]

PINHOLE, FISHEYE = 0, 1
PARAMETERS = 10
LIMIT, CIRCLE = 8, 9
_STEPS = 60  # bisection alone would reach the last digit within these
# A distortion polynomial fitted to a real lens says nothing at 84 degrees from the axis.
MAX_TANGENT = 10.0
_RADII = 4000  # the edge is found to a part in 4000 of MAX_TANGENT, then refined
_AZIMUTHS = 72


@kernel
def _brown(p: FloatArray, a: float, b: float) -> tuple[float, float, float, float, float]:
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
def _fisheye_radius(p: FloatArray, angle: float) -> tuple[float, float]:
    """Distance from the principal point in focal lengths, and its derivative."""
    t = angle * angle
    k1, k2, k3, k4 = p[3], p[4], p[5], p[6]
    radius = angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
    return radius, slope


@kernel
def _pixel(model: int, p: FloatArray, x: float, y: float, z: float) -> tuple[float, float]:
    """Pixel of one point in the camera frame."""
    if model == PINHOLE:
        if not z > 0.0:
            return math.nan, math.nan
        u, v = x / z, y / z
        if not u * u + v * v <= p[LIMIT]:
            return math.nan, math.nan
        u, v, _, _, _ = _brown(p, u, v)
    else:
        across = math.sqrt(x * x + y * y)
        angle = math.atan2(across, z)
        if not angle <= p[LIMIT] or (across == 0.0 and not z > 0.0):
            return math.nan, math.nan
        radius, _ = _fisheye_radius(p, angle)
        scale = radius / across if across > 0.0 else 1.0 / z
        u, v = scale * x, scale * y
    u, v = p[0] * u, p[0] * v
    if u * u + v * v > p[CIRCLE] * p[CIRCLE]:
        return math.nan, math.nan
    return u + p[1], v + p[2]


@kernel
def _derivatives(model: int, p: FloatArray, x: float, y: float, z: float) -> Derivatives:
    """Derivatives of the pixel: x by x, y, z, then y by x, y, z; px per unit of the point."""
    f = p[0]
    if model == PINHOLE:
        a, b = x / z, y / z
        _, _, xx, xy, yy = _brown(p, a, b)
        g = f / z
        return g * xx, g * xy, -g * (xx * a + xy * b), g * xy, g * yy, -g * (xy * a + yy * b)
    squared = x * x + y * y
    across = math.sqrt(squared)
    range2 = squared + z * z
    radius, slope = _fisheye_radius(p, math.atan2(across, z))
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
        else:
            value, slope = _fisheye_radius(p, r)
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
def _invert_brown(p: FloatArray, u: float, v: float) -> tuple[float, float]:
    """Undistorted a, b of distorted u, v; NaN where the model reaches u, v from no valid ray."""
    limit = p[LIMIT]
    if not limit < math.inf:
        return u, v
    distance = math.sqrt(u * u + v * v)
    if distance == 0.0 and p[5] == 0.0 and p[6] == 0.0:
        return 0.0, 0.0
    start = _invert_radius(PINHOLE, p, distance, math.sqrt(limit)) / max(distance, 1e-300)
    a, b = start * u, start * v
    x, y, xx, xy, yy = _brown(p, a, b)
    miss = math.sqrt((x - u) ** 2 + (y - v) ** 2)
    for _ in range(_STEPS):
        determinant = xx * yy - xy * xy
        da = (yy * (u - x) - xy * (v - y)) / determinant
        db = (xx * (v - y) - xy * (u - x)) / determinant
        x, y, xx, xy, yy = _brown(p, a + da, b + db)
        now = math.sqrt((x - u) ** 2 + (y - v) ** 2)
        if not now < miss:
            break
        a, b, miss = a + da, b + db, now
    # a step of the valid edge is left for rounding
    if miss > 1e-13 * (1.0 + distance) or a * a + b * b > limit * (1.0 + 1e-12):
        return math.nan, math.nan
    return a, b


@kernel
def _ray(model: int, p: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """Unit vector in the camera frame that a pixel looks along."""
    u, v = x - p[1], y - p[2]
    if not u * u + v * v <= p[CIRCLE] * p[CIRCLE]:
        return math.nan, math.nan, math.nan
    u, v = u / p[0], v / p[0]
    if model == PINHOLE:
        u, v = _invert_brown(p, u, v)
        scale = 1.0 / math.sqrt(1.0 + u * u + v * v)
        return u * scale, v * scale, scale
    distance = math.sqrt(u * u + v * v)
    if distance == 0.0:
        return 0.0, 0.0, 1.0
    farthest, _ = _fisheye_radius(p, p[LIMIT])
    if not distance <= farthest:
        return math.nan, math.nan, math.nan
    angle = _invert_radius(FISHEYE, p, distance, p[LIMIT])
    scale = math.sin(angle) / distance
    return u * scale, v * scale, math.cos(angle)


@kernel
def project_points(model: int, p: FloatArray, points: FloatArray, pixels: FloatArray) -> None:
    """Write pixels (n, 2) of points (n, 3) in the camera frame."""
    for i in range(points.shape[0]):
        pixels[i, 0], pixels[i, 1] = _pixel(model, p, points[i, 0], points[i, 1], points[i, 2])


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
    for i in range(points.shape[0]):
        dx = points[i, 0] - position[0]
        dy = points[i, 1] - position[1]
        dz = points[i, 2] - position[2]
        x = r[0, 0] * dx + r[0, 1] * dy + r[0, 2] * dz
        y = r[1, 0] * dx + r[1, 1] * dy + r[1, 2] * dz
        z = r[2, 0] * dx + r[2, 1] * dy + r[2, 2] * dz
        pixels[i, 0], pixels[i, 1] = _pixel(model, p, x, y, z)


@kernel
def project_with_derivatives(
    model: int, p: FloatArray, points: FloatArray, pixels: FloatArray, jacobians: FloatArray
) -> None:
    """Write pixels (n, 2) and their derivatives (n, 2, 3) by the points (n, 3), camera frame."""
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        pixels[i, 0], pixels[i, 1] = _pixel(model, p, x, y, z)
        if math.isnan(pixels[i, 0]):
            jacobians[i] = math.nan
            continue
        d = _derivatives(model, p, x, y, z)
        jacobians[i, 0, 0], jacobians[i, 0, 1], jacobians[i, 0, 2] = d[0], d[1], d[2]
        jacobians[i, 1, 0], jacobians[i, 1, 1], jacobians[i, 1, 2] = d[3], d[4], d[5]


@kernel
def rays_of_pixels(model: int, p: FloatArray, pixels: FloatArray, rays: FloatArray) -> None:
    """Write unit rays (n, 3), camera frame, of pixels (n, 2)."""
    for i in range(pixels.shape[0]):
        rays[i, 0], rays[i, 1], rays[i, 2] = _ray(model, p, pixels[i, 0], pixels[i, 1])


def brown_limit(coefficients: tuple[float, ...]) -> float:
    """Squared tangent of the off-axis angle up to which the Brown model is one to one.

    coefficients  k1 k2 p1 p2 k3, or none;  returns infinity without distortion.
    """
    if not any(coefficients):
        return math.inf
    low, high = 0.0, MAX_TANGENT
    for _ in range(3):
        radii = np.linspace(low, high, _RADII)
        folded = np.flatnonzero(_least_determinant(radii, coefficients) <= 0.0)
        if folded.size == 0:
            return high * high
        # folded[0] > 0: on the axis the determinant is 1, at `low` it was positive
        low, high = float(radii[folded[0] - 1]), float(radii[folded[0]])
    return low * low


def _least_determinant(radii: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    """Smallest Jacobian determinant of the distortion over all azimuths, at each radius."""
    k1, k2, p1, p2, k3 = coefficients
    azimuth = np.linspace(0.0, 2.0 * np.pi, _AZIMUTHS, endpoint=False)
    a, b = radii[:, None] * np.cos(azimuth), radii[:, None] * np.sin(azimuth)
    s = (radii * radii)[:, None]
    radial = 1.0 + s * (k1 + s * (k2 + s * k3))
    slope = 2.0 * (k1 + s * (2.0 * k2 + 3.0 * s * k3))
    xx = radial + slope * a * a + 2.0 * p1 * b + 6.0 * p2 * a
    yy = radial + slope * b * b + 6.0 * p1 * b + 2.0 * p2 * a
    xy = slope * a * b + 2.0 * p1 * a + 2.0 * p2 * b
    # Both eigenvalues must be positive; past a double fold the determinant is positive again.
    determinant = np.where(xx + yy > 0.0, xx * yy - xy * xy, -1.0)
    least: FloatArray = determinant.min(axis=1)
    return least


def fisheye_limit(coefficients: tuple[float, ...]) -> float:
    """Off-axis angle, rad, up to which the Kannala-Brandt radius grows; pi at most.

    coefficients  k1 k2 k3 k4
    """
    k1, k2, k3, k4 = coefficients
    roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    real = roots.real[(np.abs(roots.imag) < 1e-12 * np.abs(roots)) & (roots.real > 0.0)]
    return float(min(np.pi, np.sqrt(real.min()))) if real.size else float(np.pi)
