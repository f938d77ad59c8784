"""Sub-pixel places of a limb: an edge model fitted to the pixels of every profile across it.

A profile is a run of pixels along the row or the column that found the candidate, so that its
pixels are the detector's own and no two profiles of one direction share one. The model is the
body's brightness law across the limb, blurred (see photometry); level, brightness and place are
each profile's own, blur width and law are common to the picture and found from all profiles.
"""

from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.errors import NoSolutionError
from catalog.geometry.kernel import kernel
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.segmentation import Levels
from optnav_cli.outline.limb.candidates import BORDER_PX, Candidates, compute_outward_normals
from optnav_cli.outline.limb.cone import Cone, PixelRays, compute_stretched_rays, measure_distances
from optnav_cli.outline.limb.photometry import (
    compute_limb_laws,
    evaluate_blurred_law,
    get_power_table,
)
from optnav_cli.reasons import ReasonCode

# Profiles reach this far to the dark and to the bright side of the crossing, px along the scan,
# and so deep inside, px and in radii of the limb's bend: further in the ground's pattern rules.
BEFORE_PX, AFTER_PX = 7, 8
MAX_DEPTH_PX, MAX_DEPTH_SHARE = 6.0, 0.35

# What the shares of the second and third law are expected to be, and their 1 sigma.
MIXTURE_PRIOR, MIXTURE_SIGMA = 0.0, 0.5
# Search of blur and shares: differences, largest move, turns.
SHAPE_STEPS = np.array([0.005, 0.02, 0.02])
MAX_SHAPE_MOVE = np.array([0.3, 0.7, 0.7])
SKY_PRIOR_SIGMAS = 3.0
LOCAL_FREEDOM = 6.0  # weight of the picture's mean scatter beside a profile's own, in pixels


@dataclass(frozen=True, eq=False)
class Profiles:
    """Pixels across the limb, n profiles of m pixels.

    values  (n, m)  counts
    depth   (n, m)  distance inside the fitted cone's curve, px; NaN for a pixel not to be used
    start   (n,)    depth at which the threshold was crossed
    laws    (3, n, POWERS)  series of the laws that the body's is a mixture of
    """

    values: FloatArray
    depth: FloatArray
    start: FloatArray
    laws: FloatArray

    def subset(self, kept: IntArray) -> "Profiles":
        """Those of an index array."""
        laws = np.ascontiguousarray(self.laws[:, kept])
        return Profiles(self.values[kept], self.depth[kept], self.start[kept], laws)


@dataclass(frozen=True)
class EdgeShape:
    """Properties that all edges of a picture share.

    blur_px    sigma of the blur, the pixel's own width included
    mixture    shares of the second and the third law
    variance   of a pixel of the sky, counts^2;  gain of one of the body beyond it, over its counts
    common_sigma_px  what the errors of blur and mixture move all edges by
    """

    blur_px: float
    mixture: tuple[float, float]
    variance: float
    gain: float
    common_sigma_px: float = 0.0


@kernel
def _fit_profiles(
    values: FloatArray,
    depth: FloatArray,
    start: FloatArray,
    law: FloatArray,
    table: FloatArray,
    common: FloatArray,
    state: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Fit level, brightness and depth of each edge by Gauss-Newton.

    common  blur, sky, variance, gain and saturation of the picture
    state (n, 3): level, brightness, depth; where to start, and the answer

    Returns (n, 3): variance of the depth, chi-square, freedom, NaN where it fails; and the
    normalised residuals (n, m), 0 where a pixel is not used.
    """
    blur, sky, variance, gain, saturation = common
    n, m = values.shape
    result, residual = np.empty((n, 3)), np.zeros((n, m))
    shares = np.empty(law.shape[1])
    prior = 1.0 / (SKY_PRIOR_SIGMAS * SKY_PRIOR_SIGMAS * variance)
    for i in range(n):
        level, bright, edge_depth = state[i, 0], state[i, 1], state[i, 2]
        total, used, depth_variance = 0.0, 0, np.nan
        for k in range(law.shape[1]):
            shares[k] = law[i, k] * blur ** (0.5 * k)
        for turn in range(12):
            a00, a01, a02, a11, a12, a22 = prior, 0.0, 0.0, 0.0, 0.0, 0.0
            b0, b1, b2 = prior * (sky - level), 0.0, 0.0
            total, used = 0.0, 0
            for j in range(m):
                residual[i, j] = 0.0
                if np.isnan(depth[i, j]):
                    continue
                shape, slope = evaluate_blurred_law(
                    table, shares, (depth[i, j] - edge_depth) / blur, blur
                )
                model = level + bright * shape
                if model >= saturation and values[i, j] >= saturation:
                    continue
                spread = variance + gain * max(model - sky, 0.0)
                weight = 1.0 / spread
                miss = values[i, j] - model
                # a star or a rod in the profile must not drag the edge
                if turn > 1 and miss * miss > 25.0 * spread:
                    weight *= 5.0 * np.sqrt(spread) / abs(miss)
                p2 = -bright * slope
                a00 += weight
                a01 += weight * shape
                a02 += weight * p2
                a11 += weight * shape * shape
                a12 += weight * shape * p2
                a22 += weight * p2 * p2
                b0 += weight * miss
                b1 += weight * shape * miss
                b2 += weight * p2 * miss
                residual[i, j] = miss * np.sqrt(weight)
                total += weight * miss * miss
                used += 1
            # the inverse of the symmetric 3 x 3 matrix by its cofactors
            c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
            c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
            determinant = a00 * c00 + a01 * c01 + a02 * c02
            if used < 5 or not determinant > 1e-30:
                used = 0
                break
            move = (c02 * b0 + c12 * b1 + c22 * b2) / determinant
            depth_variance = c22 / determinant
            level += (c00 * b0 + c01 * b1 + c02 * b2) / determinant
            bright = max(bright + (c01 * b0 + c11 * b1 + c12 * b2) / determinant, 0.2 * bright)
            edge_depth += min(max(move, -1.0), 1.0)
            if abs(move) < 2e-4 and turn > 1:
                break
        # An edge lies within 4 px of where its threshold was crossed.
        if used < 5 or not abs(edge_depth - start[i]) < 4.0:
            result[i, :] = np.nan
            residual[i, :] = 0.0
            continue
        state[i, 0], state[i, 1], state[i, 2] = level, bright, edge_depth
        result[i, 0], result[i, 1], result[i, 2] = depth_variance, total, used - 3
    return result, residual


class _Fitter:
    """Repeated fits of the same profiles, each started from the last solution."""

    def __init__(self, profiles: Profiles, sky: float, saturation: float) -> None:
        self.profiles, self.sky, self.saturation = profiles, sky, saturation
        n = len(profiles.start)
        bright = np.nanmax(np.where(np.isnan(profiles.depth), np.nan, profiles.values), axis=1)
        self.state = np.stack([np.full(n, sky), np.maximum(bright - sky, 1.0), profiles.start], 1)
        self.result = np.empty((n, 3))

    def run(self, shape: EdgeShape) -> FloatArray:
        """Normalised residuals (n, m) after fitting every profile with a common shape."""
        second, third = shape.mixture
        seen, laws = self.profiles, self.profiles.laws
        law = (1.0 - second - third) * laws[0] + second * laws[1] + third * laws[2]
        common = np.array([shape.blur_px, self.sky, shape.variance, shape.gain, self.saturation])
        self.result, residual = _fit_profiles(
            seen.values, seen.depth, seen.start, law, get_power_table(), common, self.state
        )
        return residual

    def count_located(self) -> int:
        """Count the profiles with an edge under the last shape."""
        return int(np.isfinite(self.result[:, 0]).sum())


def fit_common_shape(profiles: Profiles, levels: Levels, saturation: float) -> EdgeShape:
    """Fit blur, law and noise of a picture's edges to some of its profiles.

    Raises NoSolutionError when no profile has an edge.
    """
    fitter = _Fitter(profiles.subset(_select_profiles(profiles)), levels.sky, saturation)
    # Lit pixels scatter by about 2 % of their brightness, before it is measured.
    gain = 0.02**2 * (levels.bright - levels.sky)
    shape = EdgeShape(0.9, (MIXTURE_PRIOR, MIXTURE_PRIOR), levels.noise**2, gain)
    for _ in range(2):
        refined, jacobian, residual = _refine_shape(fitter, shape)
        shape = replace(refined, gain=_estimate_gain(fitter, refined))
    return replace(
        shape, common_sigma_px=_estimate_common_sigma(fitter, refined, jacobian, residual)
    )


def locate_edges(
    profiles: Profiles, shape: EdgeShape, levels: Levels, saturation: float
) -> tuple[FloatArray, FloatArray]:
    """Return the depth (n,) of each edge inside the fitted cone's curve and its 1-sigma error, px.

    Both NaN where no edge fits.
    """
    fitter = _Fitter(profiles, levels.sky, saturation)
    fitter.run(shape)
    spread, total, freedom = fitter.result.T
    good = np.isfinite(spread)
    mean = float(total[good].sum()) / max(float(freedom[good].sum()), 1.0)
    factor = (total + LOCAL_FREEDOM * mean) / (freedom + LOCAL_FREEDOM)
    depth = np.where(good, fitter.state[:, 2], np.nan)
    # The model leaves 0.01 px of a single edge: the pixel's square, the cusps.
    return depth, np.sqrt(spread * np.maximum(factor, 0.5) + 0.01**2)


def compute_edge_residuals(
    profiles: Profiles, shape: EdgeShape, levels: Levels, saturation: float
) -> tuple[FloatArray, FloatArray]:
    """Distances (m,) of pixels inside their edges, px, and residuals (m,) in sigmas.

    Of the pixels used in as many profiles as find the common shape.
    """
    fitter = _Fitter(profiles.subset(_select_profiles(profiles)), levels.sky, saturation)
    residuals = fitter.run(shape)
    used = (residuals != 0.0) & np.isfinite(residuals)
    return (fitter.profiles.depth - fitter.state[:, 2:])[used], residuals[used]


def _select_profiles(profiles: Profiles) -> IntArray:
    """Choose the profiles that determine the common blur and law; return their numbers."""
    n = len(profiles.start)
    # 300 profiles determine blur and law.
    return np.unique(np.linspace(0, n - 1, min(n, 300)).astype(np.int64))


def _refine_shape(fitter: _Fitter, start: EdgeShape) -> tuple[EdgeShape, FloatArray, FloatArray]:
    """Find the shape with the smallest residuals by Gauss-Newton with finite differences.

    Also returns the last Jacobian and the residuals.
    """

    def compute_residuals(values: FloatArray) -> FloatArray:
        second, third = float(values[1]), float(values[2])
        residual = fitter.run(replace(start, blur_px=float(values[0]), mixture=(second, third)))
        # a smooth cut keeps single bad profiles from shaping all
        cut = residual / np.sqrt(1.0 + (residual / 4.0) ** 2)
        return np.append(cut.ravel(), (values[1:] - MIXTURE_PRIOR) / MIXTURE_SIGMA)

    best = np.array([start.blur_px, *start.mixture])
    at_best = compute_residuals(best)
    # A profile without an edge leaves no residual. So that losing edges is no improvement, each
    # step keeps half of them; at some mixtures the law turns dark and none is left.
    least_located = 0.5 * fitter.count_located()
    if least_located == 0.0:
        raise NoSolutionError(
            "no limb point has an edge that stands out of the noise", ReasonCode.NOISY_LIMB
        )
    for _ in range(6):
        columns = [compute_residuals(best + step) - at_best for step in np.diag(SHAPE_STEPS)]
        jacobian = np.stack(columns, axis=1) / SHAPE_STEPS
        move = -np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ at_best)
        move = np.clip(move, -MAX_SHAPE_MOVE, MAX_SHAPE_MOVE)
        for _ in range(4):
            better = best + move
            better[0] = np.clip(better[0], 0.35, 4.0)
            at_better = compute_residuals(better)
            improved = float(at_better @ at_better) < float(at_best @ at_best)
            improved = improved and fitter.count_located() >= least_located
            if improved:
                break
            move *= 0.4
        if not improved:
            break
        best, at_best = better, at_better
        if (np.abs(move) < SHAPE_STEPS).all():
            break
    refined = replace(start, blur_px=float(best[0]), mixture=(float(best[1]), float(best[2])))
    return refined, jacobian, at_best


def _estimate_common_sigma(
    fitter: _Fitter, shape: EdgeShape, jacobian: FloatArray, residual: FloatArray
) -> float:
    """Estimate how far one sigma of the common shape moves the edges on average, px."""
    freedom = max(int((residual != 0.0).sum()) - 3 * len(fitter.state), 1)
    scale = max(float(residual @ residual) / freedom, 1.0)
    covariance = scale * np.linalg.inv(jacobian.T @ jacobian)
    moved = np.zeros(3)
    for k, step in enumerate(np.diag(SHAPE_STEPS)):
        ends = []
        for sign in (1.0, -1.0):
            values = np.array([shape.blur_px, *shape.mixture]) + sign * step
            blur, second, third = (float(value) for value in values)
            fitter.run(replace(shape, blur_px=blur, mixture=(second, third)))
            placed = np.isfinite(fitter.result[:, 0])
            ends.append(float(fitter.state[placed, 2].mean()) if placed.any() else 0.0)
        moved[k] = (ends[0] - ends[1]) / (2.0 * SHAPE_STEPS[k])
    return float(np.sqrt(max(float(moved @ covariance @ moved), 0.0)))


def _estimate_gain(fitter: _Fitter, shape: EdgeShape) -> float:
    """Variance that a pixel of the body has beyond the sky's, over its brightness."""
    residual = fitter.run(shape)
    inside = fitter.profiles.depth - fitter.state[:, 2:] > 1.5 * shape.blur_px
    above = np.maximum(fitter.profiles.values - fitter.sky, 0.0)
    use = inside & (residual != 0.0) & (np.abs(residual) < 5.0)
    if use.sum() < 20:
        return shape.gain
    stated = shape.variance + shape.gain * above[use]
    # three unknowns of each profile have drawn the residuals in
    freedom = float(np.nansum(fitter.result[:, 2])) / max(float((residual != 0.0).sum()), 1.0)
    excess = residual[use] ** 2 * stated / max(freedom, 0.2) - shape.variance
    return max(float(excess.sum() / above[use].sum()), 1e-4 * shape.gain)


def sample_profiles(
    picture: Float32Array,
    camera: Camera,
    limb: Candidates,
    where: PixelRays,
    cone: Cone,
    sun_camera: FloatArray | None,
) -> tuple[Profiles, IntArray, FloatArray]:
    """Profiles across the limb, their pixels (n, m, 2), the bend (n,) of the curve, 1 / px."""
    height, width = picture.shape
    middle = np.rint(limb.pixels).astype(np.int64)
    steps = np.arange(-BEFORE_PX, AFTER_PX + 1)
    places = middle[:, None] + steps[:, None] * limb.scan.astype(np.int64)[:, None]
    x, y = places[..., 0], places[..., 1]
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    values = picture[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(np.float64)

    distance, inward = measure_distances(cone, where)
    along = np.stack([-inward[:, 1], inward[:, 0]], axis=1)
    slope = np.hypot(where.by_x @ cone.axis, where.by_y @ cone.axis)
    # of the ray, not of the cone: a small body's limb may lie a tenth of its radius off the curve
    sine = np.sqrt(np.maximum(1.0 - (where.rays @ cone.axis) ** 2, 1e-30))
    rad_per_px: FloatArray = slope / sine
    rays = compute_stretched_rays(camera, places.astype(np.float64), cone.stretch)
    depth = cone.measure_depth(rays) / rad_per_px[:, None]
    # two pixels along the curve's tangent the curve has bent away by 2^2 / 2 radius
    aside = compute_stretched_rays(
        camera, limb.pixels + np.array([[[2.0]], [[-2.0]]]) * along, cone.stretch
    )
    bend = -0.5 * ((cone.measure_depth(aside) / rad_per_px).mean(axis=0) - distance)
    deepest = np.minimum(MAX_DEPTH_PX, np.maximum(MAX_DEPTH_SHARE / np.maximum(bend, 1e-6), 2.5))
    usable = inside & (depth < distance[:, None] + deepest[:, None])
    usable &= camera.contains(places.astype(np.float64), BORDER_PX - 3) & np.isfinite(values)
    depth = np.where(usable, depth, np.nan)

    normal = compute_outward_normals(where, inward, cone.stretch)
    ray = unit(np.linalg.solve(cone.stretch, where.rays.T).T)
    middle_phase = 1.0 if sun_camera is None else -float(cone.axis_camera() @ sun_camera)
    laws = compute_limb_laws(normal, ray, sun_camera, cone.angle, rad_per_px, middle_phase)
    return Profiles(values, depth, distance, laws), places, bend
