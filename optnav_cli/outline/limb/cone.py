"""A cone through limb candidates: robustly, through any camera model.

The limb of a sphere is a circular cone of rays: with s = axis / cos(half angle) every ray e of it
has e.s = 1 (Zhukov 2025, ch. 2), so three rays give a cone and least squares is linear. An
ellipsoid becomes a sphere by stretching space, and its limb's rays with it.
Samples of three candidates propose cones; the one most candidates agree with, in place and in the
direction of the rise, is fitted to them. Distances are in pixels, along the picture's own normal.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.geometry.kernel import kernel
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera

BASE_TOLERANCE_PX = 1.5
MIN_COSINE = float(np.cos(np.radians(40.0)))  # between a candidate's gradient and the cone's normal


@dataclass(frozen=True, eq=False)
class Cone:
    """A cone of rays in the space where the body is a sphere.

    stretch   (3, 3)  takes camera-frame vectors there; the unit matrix for a sphere
    axis      (3,)    unit vector to the body's centre, there
    angle     half angle, rad, there
    """

    stretch: FloatArray
    axis: FloatArray
    angle: float

    def axis_camera(self) -> FloatArray:
        """Unit vector (3,) to the body's centre, camera frame."""
        return unit(np.linalg.solve(self.stretch, self.axis))

    def measure_depth(self, rays: FloatArray) -> FloatArray:
        """Measure depth (...) of stretched unit rays (..., 3) in the cone, rad; < 0 in the sky."""
        # of unit vectors: the chord keeps small angles exact, and is quicker than the cross product
        x, y, z = np.moveaxis(rays - self.axis, -1, 0)
        chord = np.sqrt(x * x + y * y + z * z)
        depth: FloatArray = self.angle - 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
        return depth


class PixelRays(NamedTuple):
    """Rays of pixels in the stretched space, and how they turn with the pixel.

    rays        (n, 3)  unit vectors; NaN where the lens sees nothing
    by_x, by_y  (n, 3)  change per pixel to the right and down
    """

    rays: FloatArray
    by_x: FloatArray
    by_y: FloatArray

    def subset(self, kept: BoolArray | IntArray) -> "PixelRays":
        """Those that a mask or an index array keeps."""
        return PixelRays(self.rays[kept], self.by_x[kept], self.by_y[kept])


def compute_stretched_rays(camera: Camera, pixels: FloatArray, stretch: FloatArray) -> FloatArray:
    """Unit rays (..., 3) of pixels (..., 2) in the stretched space."""
    rays = camera.unproject(pixels)
    if (stretch == np.eye(3)).all():
        return rays
    return unit(rays @ stretch.T)


def compute_pixel_rays(camera: Camera, pixels: FloatArray, stretch: FloatArray) -> PixelRays:
    """Rays of pixels (n, 2) with their derivatives, by differences half a pixel to each side."""
    half = 0.5
    shifts = np.array([[0.0, 0.0], [half, 0.0], [-half, 0.0], [0.0, half], [0.0, -half]])
    rays = compute_stretched_rays(camera, pixels[None] + shifts[:, None], stretch)
    return PixelRays(rays[0], rays[1] - rays[2], rays[3] - rays[4])


def measure_distances(cone: Cone, where: PixelRays) -> tuple[FloatArray, FloatArray]:
    """Signed distance (n,) of pixels to the cone's curve, px, and the unit inward normal (n, 2).

    Positive inside. Exact for a small step; the curve's own bend is in the angle.
    """
    slope = np.stack([where.by_x @ cone.axis, where.by_y @ cone.axis], axis=-1)
    along = where.rays @ cone.axis
    sine = np.sqrt(np.maximum(1.0 - along**2, 1e-30))
    size = np.maximum(np.linalg.norm(slope, axis=-1), 1e-30)
    return cone.measure_depth(where.rays) * sine / size, slope / size[:, None]


@kernel
def _score(
    s: FloatArray,
    rays: FloatArray,
    by_x: FloatArray,
    by_y: FloatArray,
    gradient: FloatArray,
    relief: float,
    least: float,
) -> float:
    """Score the agreement of candidates with the cone e.s = 1, each 0 to 1; 0 if below `least`."""
    length2 = s[0] * s[0] + s[1] * s[1] + s[2] * s[2]
    tangent = np.sqrt(length2 - 1.0)
    far = 2.01 * (relief * tangent * tangent) ** 2
    total = 0.0
    for i in range(rays.shape[0]):
        if total + (rays.shape[0] - i) <= least:
            return 0.0
        value = rays[i, 0] * s[0] + rays[i, 1] * s[1] + rays[i, 2] * s[2] - 1.0
        gx = by_x[i, 0] * s[0] + by_x[i, 1] * s[1] + by_x[i, 2] * s[2]
        gy = by_y[i, 0] * s[0] + by_y[i, 1] * s[1] + by_y[i, 2] * s[2]
        # most are far off, which needs no root to be seen: (a + b)^2 <= 2 a^2 + 2 b^2
        if value * value > far + 2.01 * BASE_TOLERANCE_PX**2 * (gx * gx + gy * gy):
            continue
        size = np.sqrt(gx * gx + gy * gy)
        # |s| sin(angle) = tan(angle): turns the value into rad, and rad into px by the slope
        tolerance = BASE_TOLERANCE_PX + relief * tangent * tangent / max(size, 1e-12)
        misfit = value / (size * tolerance)
        if misfit * misfit >= 1.0:
            continue
        if gx * gradient[i, 0] + gy * gradient[i, 1] < MIN_COSINE * size:
            continue
        total += 1.0 - misfit * misfit
    return total


@kernel
def _find_best_cone(
    samples: IntArray,
    rays: FloatArray,
    by_x: FloatArray,
    by_y: FloatArray,
    gradient: FloatArray,
    relief: float,
    max_s2: float,
) -> tuple[float, FloatArray]:
    """Find the best-scored cone, |s|^2 up to `max_s2`, through triples of candidates."""
    best, best_s = 0.0, np.zeros(3)
    for k in range(samples.shape[0]):
        a, b, c = rays[samples[k, 0]], rays[samples[k, 1]], rays[samples[k, 2]]
        # e.s = 1 for three rays: s = (b x c + c x a + a x b) / (a . b x c)
        normal = np.cross(b, c) + np.cross(c, a) + np.cross(a, b)
        volume = np.dot(a, np.cross(b, c))
        if abs(volume) < 1e-14:
            continue
        s = normal / volume
        if not 1.0 < np.dot(s, s) < max_s2:
            continue
        score = _score(s, rays, by_x, by_y, gradient, relief, best)
        if score > best:
            best, best_s = score, s
    return best, best_s


def find_cone(
    where: PixelRays, gradient: FloatArray, stretch: FloatArray, relief: float, seed: int = 0
) -> tuple[Cone, BoolArray] | None:
    """Find the cone that most candidates agree with, and which they are; None when there is none.

    gradient (n, 2) of brightness at the candidates, any length;  relief in body radii.
    """
    n = len(where.rays)
    if n < 3:
        return None
    generator = np.random.default_rng(seed)
    unit = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    # At most 2500 candidates vote, drawn at random, on cones through 600 triples.
    some = generator.permutation(n)[:2500]
    samples = generator.integers(0, len(some), (600, 3))
    drawn = PixelRays(*(part[some] for part in where))
    # squared length of s = axis / cos(angle) at the lowest height; infinite without relief
    # A camera lower than twice the relief sees no limb but the nearest hill; in the flat cones of
    # such heights the tolerance for relief would take in all edges.
    sine = 1.0 / (1.0 + 2.0 * relief)
    max_s2 = 1.0 / (1.0 - sine * sine) if relief > 0.0 else np.inf
    score, s = _find_best_cone(samples, *drawn, unit[some], relief, max_s2)
    if score <= 0.0:
        return None
    cone = _make_cone(s, stretch)
    agrees = find_agreeing(cone, where, unit, relief)
    for _ in range(6):
        if agrees.sum() < 3:
            return None
        fitted = fit_cone(where, agrees, cone)
        if fitted is None:
            break
        cone = fitted
        again = find_agreeing(cone, where, unit, relief)
        if (again == agrees).all():
            break
        agrees = again
    return cone, agrees


def find_agreeing(cone: Cone, where: PixelRays, gradient: FloatArray, relief: float) -> BoolArray:
    """Find which candidates (n,) lie near a cone's curve and rise along its normal."""
    distance, inward = measure_distances(cone, where)
    slope = np.hypot(where.by_x @ cone.axis, where.by_y @ cone.axis)
    rad_per_px = slope / max(np.sin(cone.angle), 1e-12)
    limit = BASE_TOLERANCE_PX + relief * np.tan(cone.angle) / np.maximum(rad_per_px, 1e-12)
    cosine = (inward * gradient).sum(axis=1) / np.maximum(np.linalg.norm(gradient, axis=1), 1e-12)
    agrees: BoolArray = (np.abs(distance) < limit) & (cosine > MIN_COSINE)
    return agrees


def fit_cone(where: PixelRays, used: BoolArray, start: Cone) -> Cone | None:
    """Least squares of e.s = 1 over the used pixels, each weighed to a pixel's distance."""
    s = start.axis / np.cos(start.angle)
    rays = where.rays[used]
    slope = np.hypot(where.by_x[used] @ s, where.by_y[used] @ s)
    weight = 1.0 / np.maximum(slope, 1e-12)
    solved, _, rank, _ = np.linalg.lstsq(rays * weight[:, None], weight, rcond=None)
    if rank < 3 or not float(solved @ solved) > 1.0:
        return None
    return _make_cone(solved, start.stretch)


def _make_cone(s: FloatArray, stretch: FloatArray) -> Cone:
    length = float(np.linalg.norm(s))
    return Cone(stretch, s / length, float(np.arctan(np.sqrt(length * length - 1.0))))
