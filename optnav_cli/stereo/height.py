"""Height over the ground from two pictures of one time, by plane sweep and windows.

h = f B / d: the second picture is laid on the first through the ground found so far, windows tell
what is missing, and so on from wide blurred windows to sharp ones of 64 px. The height is that of
the ship's origin over the mean ground below it, of an area of 192 px.

An error of the mounting moves all windows alike: it is stated apart from the scatter.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import cross_matrix
from catalog.geometry.vectors import perpendicular_basis
from optnav_cli.estimation.least_squares import inverse_of
from optnav_cli.estimation.robust import TUKEY, scatter, tukey_weights
from optnav_cli.reasons import ReasonCode
from optnav_cli.stereo.rig import Rig, resample

MIN_SCORE = 0.5  # correlation of a window of one ground; noise alone gives 0.1
MIN_SHARE = 0.999  # of a window that lies in both pictures
MIN_TEXTURE = 1e-4  # smaller eigenvalue of the gradients' products, brightness in its scatter
GRADIENT_BLUR_PX = 1.0
STEP_PX = 16  # between windows: those of 64 px overlap by three quarters
Gradients = tuple[Float32Array, Float32Array]  # along x and y
# Windows and blur, px, of the rounds: wide and blurred ones bear the shifts that relief leaves.
ROUNDS = ((160, 4.0), (96, 2.0), (64, 1.0), (64, 0.0), (64, 0.0))
TEMPLATE_PX = 192  # of the first search
MIN_PEAK, MIN_LEAD = 0.4, 1.1  # correlation there, and how much a rival's must stay below
RIVAL_PX = 12.0  # farther from the peak another one is a rival
BAND_PX = 5.0  # from the line on which the second camera sees a ray: 400" of mounting
MAX_SHARE = 0.45  # of the picture's width that the parallax may take
AREA_PX = 96.0  # about the point below: the ground that the height is over
MIN_WINDOWS = 6
MAX_LEFT_PX = 1.0  # a window that is still off by more in the last round found something else
FARTHEST_SIGMAS = 3.0  # a parallax smaller than so many sigmas tells no height
MAX_ASIDE_PX = 3.0  # mean shift across the base: the mounting is not what it is said to be
SPREAD_NODES = 2.0  # sigma of the smoothing between rounds, windows


@dataclass(frozen=True, eq=False)
class Shifts:
    """Shifts of windows on a grid (rows, cols).

    x, y         (rows, cols) middles of the windows, px
    shift_px     (rows, cols, 2)
    covariance   (rows, cols, 2, 2) px², from what is left of the brightness
    usable       (rows, cols)
    overlap      how many windows share the ground of one: their errors are not apart
    """

    x: FloatArray
    y: FloatArray
    shift_px: FloatArray
    covariance: FloatArray
    usable: BoolArray
    overlap: float


def measure_shifts(left: Float32Array, right: Float32Array, size: int, blur_px: float) -> Shifts:
    """Measure shifts of windows of a size (px, odd or even) between two pictures on one grid.

    left, right  (rows, cols); NaN where there is none
    blur_px      of both before: a wide blur takes larger shifts
    """
    valid = np.isfinite(left) & np.isfinite(right)
    a, b = (_normalise(image, valid, size, blur_px) for image in (left, right))
    mean_of, difference = 0.5 * (a + b), a - b
    gradients = _differentiate(mean_of)
    # Noise of the gradients goes with that of the difference: smoothed ones have little of it.
    smooth = _differentiate(np.asarray(cv2.GaussianBlur(mean_of, (0, 0), GRADIENT_BLUR_PX)))
    first, rows, cols = size // 2, *left.shape

    def average(image: Float32Array) -> FloatArray:
        filtered = cv2.boxFilter(image, cv2.CV_32F, (size, size), borderType=cv2.BORDER_CONSTANT)
        nodes: FloatArray = filtered[first::STEP_PX, first::STEP_PX].astype(np.float64)
        return nodes

    def average_products(first_gradients: Gradients, second_gradients: Gradients) -> FloatArray:
        rows_of = [[average(p * q) for q in second_gradients] for p in first_gradients]
        products_of = np.moveaxis(np.array(rows_of), (0, 1), (-2, -1))
        symmetric: FloatArray = 0.5 * (products_of + np.swapaxes(products_of, -1, -2))
        return symmetric

    normal = average_products(smooth, gradients)
    offset = np.stack([average(g * difference) for g in smooth], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        score = np.nan_to_num(average(a * b) / np.sqrt(average(a * a) * average(b * b)))
    usable = average(valid.astype(np.float32)) >= MIN_SHARE
    usable &= (score >= MIN_SCORE) & (np.linalg.eigvalsh(normal)[..., 0] > MIN_TEXTURE)
    inverse = np.linalg.inv(np.where(usable[..., None, None], normal, np.eye(2)))
    shift = np.where(usable[..., None], np.einsum("...ij,...j->...i", inverse, offset), 0.0)
    unexplained = average(difference * difference) - np.einsum("...i,...i->...", shift, offset)
    covariance = inverse @ average_products(smooth, smooth) @ inverse
    covariance *= (np.maximum(unexplained, 1e-9) / size**2)[..., None, None]
    half_px = 0.0 if size % 2 else 0.5  # the box of an even size reaches farther up and left
    x, y = np.meshgrid(
        np.arange(first, cols, STEP_PX) - half_px, np.arange(first, rows, STEP_PX) - half_px
    )
    return Shifts(x, y, shift, covariance, usable, max(1.0, (size / STEP_PX) ** 2))


def _normalise(image: Float32Array, valid: BoolArray, size: int, blur_px: float) -> Float32Array:
    """Subtract the mean of the window about each pixel, divide by its scatter."""
    plain = np.where(valid, image, 0.0).astype(np.float32)
    if blur_px > 0.0:
        plain = cv2.GaussianBlur(plain, (0, 0), blur_px).astype(np.float32)
    level = cv2.boxFilter(plain, cv2.CV_32F, (size, size))
    centred = plain - level
    spread = np.sqrt(np.maximum(cv2.boxFilter(centred * centred, cv2.CV_32F, (size, size)), 1e-12))
    levelled: Float32Array = np.where(valid, centred / spread, 0.0).astype(np.float32)
    return levelled


def _differentiate(image: Float32Array) -> Gradients:
    """Return central differences along x and y."""
    half = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return (
        np.asarray(cv2.filter2D(image, cv2.CV_32F, half), np.float32),
        np.asarray(cv2.filter2D(image, cv2.CV_32F, half.T.copy()), np.float32),
    )


@dataclass(frozen=True, eq=False)
class StereoHeight:
    """A height of the ship's origin over the mean ground below it.

    sigma_m           by the windows: noise, and the relief about the plane through them
    sigma_mounting_m  by the mounting's stated error, the same in all pairs
    inverse_m         (rows, cols) 1/m, of the ground along the rays of the first camera's pixels
    """

    height_m: float
    sigma_m: float
    sigma_mounting_m: float
    windows: int
    inverse_m: FloatArray

    @property
    def whole_sigma_m(self) -> float:
        """Sigma of windows and mounting together."""
        return float(np.hypot(self.sigma_m, self.sigma_mounting_m))


def measure_height(
    first: Float32Array, second: Float32Array, rig: Rig, down: FloatArray
) -> StereoHeight:
    """Measure the height that a pair of pictures shows.

    first, second  (rows, cols) brightness of the cameras of the rig
    down           (3,) unit vector, ship frame
    Raises NoSolutionError, with the reason, where the pictures tell none.
    """
    rays = rig.compute_grid_rays()
    inverse = _guess_height(first, second, rig, rays, down)
    for size, blur in ROUNDS:
        through = resample(second, _predict_second_pixels(rig, rays, inverse))
        shifts = measure_shifts(first, through, size, blur)
        nodes = _Nodes.locate(rig, rays, inverse, shifts)
        inverse = nodes.smooth_to_grid(inverse.shape)
    return _average_height(rig, nodes, down, inverse)


def refine_inverse(
    first: Float32Array, second: Float32Array, rig: Rig, inverse: FloatArray, share: float
) -> FloatArray | None:
    """Refine inverse distances (rows, cols) by parallax; None where too few windows show it.

    share  widest sigma of a window's inverse distance, of that distance: near the direction of
           the base there is no parallax
    """
    rays = rig.compute_grid_rays()
    for size, blur in ROUNDS[2:]:
        through = resample(second, _predict_second_pixels(rig, rays, inverse))
        nodes = _Nodes.locate(rig, rays, inverse, measure_shifts(first, through, size, blur))
        sure = nodes.usable & (nodes.sigma < share * np.abs(nodes.inverse))
        if int(sure.sum()) < MIN_WINDOWS:
            return None
        inverse = replace(nodes, usable=sure).smooth_to_grid(inverse.shape)
    return inverse


def _guess_height(
    first: Float32Array, second: Float32Array, rig: Rig, rays: FloatArray, down: FloatArray
) -> FloatArray:
    """Guess inverse distances (rows, cols), 1/m, of level ground by one large window."""
    rows, cols = first.shape
    there = rig.first.project(down[None, :])[0]
    half = TEMPLATE_PX // 2
    if min(rows, cols) < TEMPLATE_PX + 2:
        raise NoSolutionError(
            f"pictures of {cols} x {rows} px are too small; wanted {TEMPLATE_PX + 2} px a side",
            ReasonCode.FEW_POINTS,
        )
    if not rig.first.camera.contains(there, half + 1.0):
        text = "the ground below lies outside the picture, or at its edge"
        raise NoSolutionError(text, ReasonCode.OUTSIDE_FRAME)
    column, row = (round(float(value)) for value in there)
    # what the second camera would see were it turned as the first one: parallax alone is left
    far = resample(second, rig.second.project(rays))
    level = float(np.nanmean(far)) if np.isfinite(far).any() else 0.0
    template = first[row - half : row + half, column - half : column + half]
    filled = np.where(np.isfinite(far), far, level).astype(np.float32)
    scores = cv2.matchTemplate(filled, template, cv2.TM_CCOEFF_NORMED)
    middle = rays[row, column]
    base = rig.second.place_m - rig.first.place_m
    _, by_vector = rig.first.linearise_projection(middle[None, :])
    along = -(by_vector[0] @ base)  # px for one 1/m
    y, x = np.mgrid[: scores.shape[0], : scores.shape[1]].astype(np.float64)
    x, y = x + half - column, y + half - row
    length = float(np.linalg.norm(along))
    forward = (x * along[0] + y * along[1]) / length
    aside = (x * along[1] - y * along[0]) / length
    ours = (np.abs(aside) <= BAND_PX) & (forward > -BAND_PX) & (forward < MAX_SHARE * cols)
    limited = np.where(ours, scores, -1.0)
    best = int(np.argmax(limited))
    peak, parallax = float(limited.flat[best]), float(forward.flat[best])
    rival = float(np.max(np.where(np.abs(forward - parallax) > RIVAL_PX, limited, -1.0)))
    if peak < MIN_PEAK:
        text = f"the pictures do not show one ground: the best correlation is {peak:.2f}"
        raise NoSolutionError(text, ReasonCode.LOW_SCORE)
    if peak < MIN_LEAD * rival:
        text = f"a second parallax correlates nearly as well ({rival:.2f} and {peak:.2f})"
        raise NoSolutionError(text, ReasonCode.RIVAL)
    inverse = max(parallax, 0.5) / length
    # level ground: P . down is the same along all rays
    depth = float(middle @ down) / inverse
    inverse_distances: FloatArray = np.maximum(rays @ down, 0.05) / depth
    return inverse_distances


def _predict_second_pixels(rig: Rig, rays: FloatArray, inverse: FloatArray) -> FloatArray:
    """Predict pixels (rows, cols, 2) of the second camera that show what those of the first do."""
    base = rig.second.place_m - rig.first.place_m
    return rig.second.project(rays - base * inverse[..., None])


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Windows on their grid (rows, cols): inverse distances with sigmas, 1/m."""

    shifts: Shifts
    rays: FloatArray
    inverse: FloatArray
    sigma: FloatArray
    px_per_inverse: FloatArray
    along_px: FloatArray
    aside_px: FloatArray
    usable: BoolArray

    @classmethod
    def locate(cls, rig: Rig, rays: FloatArray, inverse: FloatArray, shifts: Shifts) -> "_Nodes":
        at = np.stack([shifts.y, shifts.x]).astype(np.float32)
        here = cv2.remap(inverse.astype(np.float64), at[1], at[0], cv2.INTER_LINEAR)
        rays_of_nodes = rig.first.unproject(np.stack([shifts.x, shifts.y], axis=-1))
        flat = rays_of_nodes.reshape(-1, 3)
        base = rig.second.place_m - rig.first.place_m
        seen_from = flat - base * here.reshape(-1, 1)
        _, by_vector = rig.first.linearise_projection(seen_from)
        # px of the first camera's grid for one 1/m: the second camera turned as the first
        move = -(by_vector @ base).reshape(*here.shape, 2)
        information = np.linalg.inv(shifts.covariance + 1e-9 * np.eye(2))
        weight = np.einsum("...i,...ij,...j->...", move, information, move)
        gained = np.einsum("...i,...ij,...j->...", move, information, shifts.shift_px) / weight
        length = np.linalg.norm(move, axis=-1)
        aside = move[..., 0] * shifts.shift_px[..., 1] - move[..., 1] * shifts.shift_px[..., 0]
        return cls(
            shifts,
            rays_of_nodes,
            here + gained,
            1.0 / np.sqrt(weight),
            length,
            gained * length,
            aside / length,
            shifts.usable & np.isfinite(weight),
        )

    def smooth_to_grid(self, shape: tuple[int, ...]) -> FloatArray:
        """Smooth inverse distances over neighbouring windows, for all pixels (rows, cols)."""
        if int(self.usable.sum()) < MIN_WINDOWS:
            raise NoSolutionError(
                f"only {int(self.usable.sum())} windows show one ground in both pictures",
                ReasonCode.FEW_POINTS,
            )
        # a plane bears the holes; what the windows have beyond it fades out there
        design = np.stack(
            [np.ones(self.inverse.size), self.shifts.x.ravel(), self.shifts.y.ravel()]
        )
        plane, kept = _fit_robust_plane(design.T, self.inverse.ravel(), self.usable.ravel())
        weights = (self.usable & kept.reshape(self.usable.shape)).astype(np.float64)
        beyond = np.where(
            weights > 0.0, self.inverse - (plane @ design).reshape(self.inverse.shape), 0
        )
        share = cv2.GaussianBlur(weights, (0, 0), SPREAD_NODES, borderType=cv2.BORDER_CONSTANT)
        mean = cv2.GaussianBlur(
            beyond * weights, (0, 0), SPREAD_NODES, borderType=cv2.BORDER_CONSTANT
        )
        mean = mean / np.maximum(share, 0.05)
        rows, cols = shape
        x, y = np.meshgrid(np.arange(cols, dtype=np.float64), np.arange(rows, dtype=np.float64))
        on_grid = (
            ((x - self.shifts.x[0, 0]) / STEP_PX).astype(np.float32),
            ((y - self.shifts.y[0, 0]) / STEP_PX).astype(np.float32),
        )
        more = cv2.remap(mean, *on_grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        smooth: FloatArray = plane[0] + plane[1] * x + plane[2] * y + more
        return np.maximum(smooth, 0.2 * float(np.median(self.inverse[self.usable])))


def _fit_robust_plane(
    design: FloatArray, values: FloatArray, usable: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Fit a plane (k,) to values (n,) by a design (n, k); return also which values it rests on."""
    weights: FloatArray = usable.astype(np.float64)
    plane: FloatArray = np.zeros(design.shape[1])
    for _ in range(6):
        root = np.sqrt(weights)
        plane = np.asarray(np.linalg.lstsq(design * root[:, None], values * root)[0])
        off = values - design @ plane
        spread = max(scatter(off[usable]), 1e-12)
        weights = np.where(usable, tukey_weights(off, TUKEY * spread), 0.0).astype(np.float64)
    return plane, weights > 0.0


def _average_height(rig: Rig, nodes: _Nodes, down: FloatArray, inverse: FloatArray) -> StereoHeight:
    """Average the height over the windows about the point below."""
    _check_parallax(rig, nodes)
    aside = float(np.median(nodes.aside_px[nodes.usable]))
    if abs(aside) > MAX_ASIDE_PX:
        raise NoSolutionError(
            f"the pictures are shifted by {aside:.1f} px across the base: the mounting is not as "
            "run.toml says",
            ReasonCode.POINTS_DISAGREE,
        )
    steady = nodes.usable & (nodes.inverse > 0.0)
    steady &= np.abs(nodes.along_px) <= MAX_LEFT_PX
    points = rig.first.place_m + nodes.rays / np.maximum(nodes.inverse, 1e-9)[..., None]
    depth = points @ down
    level = points - depth[..., None] * down
    focal = rig.first.camera.coarse_focal_px
    distance = np.linalg.norm(level, axis=-1) / np.maximum(depth, 1e-9) * focal
    chosen = steady & (distance <= AREA_PX)
    count = int(chosen.sum())
    if count < MIN_WINDOWS:
        text = f"only {count} windows of the ground below agree in both pictures"
        raise NoSolutionError(text, ReasonCode.FEW_POINTS)
    at, z = level[chosen], depth[chosen]
    across = np.stack(perpendicular_basis(down))
    design = np.column_stack([np.ones(count), at @ across.T])
    _, kept = _fit_robust_plane(design, z, np.ones(count, bool))
    # d depth / d inverse distance along the ray
    slope = (nodes.rays[chosen] @ down) / nodes.inverse[chosen] ** 2
    noise = slope * nodes.sigma[chosen]
    weight = np.where(kept, 1.0 / noise**2, 0.0)
    normal = design.T @ (weight[:, None] * design)
    covariance = inverse_of(normal)
    if not np.isfinite(covariance).all():
        text = "the windows of the ground below lie on a line"
        raise NoSolutionError(text, ReasonCode.DEGENERATE)
    plane = covariance @ design.T @ (weight * z)
    off = (z - design @ plane)[kept]
    # of so many windows that share ground only a part errs by itself
    apart = max(float(kept.sum()) / nodes.shifts.overlap, 1.0)
    excess = max(1.0, float(np.mean(off**2 * weight[kept])) * apart / max(apart - 3.0, 1.0))
    sigma = float(np.sqrt(covariance[0, 0] * nodes.shifts.overlap * excess))
    mounting = _propagate_mounting(rig, nodes, chosen, slope)
    return StereoHeight(float(plane[0]), sigma, mounting, int(kept.sum()), inverse)


def _check_parallax(rig: Rig, nodes: _Nodes) -> None:
    """Raise NoSolutionError where all windows together do not tell the ground from the sky."""
    weight = np.where(nodes.usable, nodes.sigma**-2, 0.0)
    total = float(weight.sum())
    mean = float((weight * nodes.inverse).sum()) / total
    sigma = float(np.sqrt(nodes.shifts.overlap / total))
    if mean < FARTHEST_SIGMAS * sigma:
        per = float(np.median(nodes.px_per_inverse[nodes.usable]))
        raise NoSolutionError(
            f"the parallax is {mean * per:.3f} px with a sigma of {sigma * per:.3f}: the ground is "
            f"too far off for a base of {rig.base_m:g} m, or the mounting is not as run.toml says",
            ReasonCode.DEGENERATE,
        )


def _propagate_mounting(rig: Rig, nodes: _Nodes, chosen: BoolArray, slope: FloatArray) -> float:
    """Propagate the stated errors of both mountings to the height, m."""
    rays, inverse = nodes.rays[chosen], nodes.inverse[chosen]
    base = rig.second.place_m - rig.first.place_m
    sights = rays - base * inverse[:, None]
    _, by_vector = rig.first.linearise_projection(sights)
    move = -(by_vector @ base)
    length = np.linalg.norm(move, axis=1)
    variance = 0.0
    for vectors, error in ((sights, rig.second.error_rad), (rays, rig.first.error_rad)):
        # a turn w of the camera moves what it sees by w x v
        turned = np.einsum("nij,njk->nik", by_vector, -cross_matrix(vectors))
        along = np.einsum("ni,nik->nk", move, turned) / (length**2)[:, None]
        variance += float(((slope @ along / len(slope)) ** 2).sum()) * error**2
    return float(np.sqrt(variance))
