"""Poses of a descent refined by windows of ground, and the covariance of places in pictures.

A pose moves what a picture shows on the map. Windows of the picture on the ground are matched with
a reference on the same grid: a terrain model drawn under the same Sun, or the ground of an earlier
frame. Their shifts give the pose, with the reference's own place considered as one unknown shift.

How the errors of a pose and of its reference correlate is unknown, as both may rest on the same
terrain model. They are combined by covariance intersection, which is right for any correlation:
S. J. Julier, J. K. Uhlmann, A non-divergent estimation algorithm in the presence of unknown
correlations, Proc. American Control Conference, 1997.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.vectors import unit
from optnav_cli.estimation.models.points import differentiate_places
from optnav_cli.hazard.ground_view import Heights, KnownPose, PictureOnGround, average_boxes

MIN_SCORE = 0.4  # correlation of a window; peaks of unrelated ground rarely reach it
MIN_WINDOWS = 4  # two more unknown shifts than windows of a plane's shift and scale determine
MIN_WIDE, MAX_WIDE = 14, 48  # nodes of a window: fewer hold too little ground to be told apart
CORE_BORDERS = 1 / 6, 3 / 8  # left out of a picture whose middle gives the common shift
MAX_ALONG = 7  # windows along each side of a picture
MAX_REACH = 200  # nodes that the common shift is sought within
WINDOW_SIGMA = 0.15  # nodes: 1 sigma of a matched window, a coordinate; measured scatter raises it
HUBER = 1.5  # sigmas beyond which a window counts less
MAX_SIGMAS = 4.0  # of a window's residual
SHARES = np.linspace(0.02, 0.98, 25)  # of the information taken from the pose
PARAMETERS = 9  # position (3), turn (3), height of the ground, the reference's shift (2)


@dataclass(frozen=True, eq=False)
class UncertainPose:
    """A pose with its covariance.

    covariance  (7, 7) of position, m, of a turn about the body's axes, rad, and of the height of
                the ground, m
    local_m     1 sigma of single places beside it, a coordinate: relief that is not known
    raised_m    how far the ground stands over its model
    """

    pose: KnownPose
    covariance: FloatArray
    local_m: float = 0.0
    raised_m: float = 0.0

    @classmethod
    def make(
        cls, pose: KnownPose, covariance_m2: FloatArray, attitude_sigma: float, ground_m: float
    ) -> "UncertainPose":
        """Make one of a position with its covariance; 1 sigma of attitude, rad, and of heights."""
        full = np.zeros((7, 7))
        full[:3, :3] = covariance_m2
        # Exact numbers have no inverse: 0.01" and 1 mm are as good as none.
        full[3:6, 3:6] = max(attitude_sigma, 5e-8) ** 2 * np.eye(3)
        full[6, 6] = max(ground_m, 1e-3) ** 2
        return cls(pose, full)

    def compute_place_covariance(self, view: PictureOnGround, x: float, y: float) -> FloatArray:
        """Compute the covariance (2, 2), m^2, x and y, of a place on the map of a view."""
        by_pose = compute_place_jacobian(view, self.pose, np.array([[x, y]]))[0]
        placed: FloatArray = by_pose @ self.covariance @ by_pose.T + self.local_m**2 * np.eye(2)
        return placed


class WindowMatches(NamedTuple):
    """Matched windows: middles (n, 2) and shifts to the reference (n, 2), x and y on the map, m."""

    places_m: FloatArray
    shifts_m: FloatArray


class Reference(NamedTuple):
    """Ground on the grid of a view, resampled to step_m and wider by `margin` nodes on each side.

    brightness  (rows + 2 margin, cols + 2 margin), NaN where there is none
    picture     (rows, cols) the view itself at step_m, with its mask `shown`
    covariance  (2, 2) of the reference's own place, m^2
    shared      whether the pose may rest on the same ground, so that window errors are shared, too
    shift_m     (2,) that all windows are known to be off by
    """

    brightness: Float32Array
    picture: Float32Array
    shown: BoolArray
    step_m: float
    margin: int
    covariance: FloatArray
    shared: bool
    shift_m: tuple[float, float] = (0.0, 0.0)


def compute_place_jacobian(
    view: PictureOnGround, pose: KnownPose, places_m: FloatArray
) -> FloatArray:
    """Compute how places on a view's map move with the pose.

    places_m  (n, 2) x and y on the map
    Returns (n, 2, 7): by the camera's position (3, body frame, m), a turn of the camera about the
    body's axes (3, rad), and the height of the ground (m).
    """
    local = view.placed.body_from_local
    level_m = float(np.linalg.norm(pose.position_m)) - pose.radius_m - float(view.camera_m[2])
    points = view.placed.points(places_m[:, 0], places_m[:, 1], np.full(len(places_m), level_m))
    jacobian: FloatArray = local[:, :2].T @ differentiate_places(
        points - pose.position_m, local[:, 2]
    )
    return jacobian


def sample_ground(
    values: Float32Array, known: BoolArray, source: PictureOnGround, x: FloatArray, y: FloatArray,
    view: PictureOnGround,
) -> Float32Array:  # fmt: skip
    """Sample a map on the grid of another view at places x, y of a view's map; NaN outside."""
    rows, cols = source.brightness.shape
    east, north = source.placed.xy_from_latlon(*view.placed.latlon(x, y))
    col = (east / source.cell_m + 0.5 * (cols - 1)).astype(np.float32)
    row = (0.5 * (rows - 1) - north / source.cell_m).astype(np.float32)
    filled = np.where(known, values, np.float32(0.0)).astype(np.float32)
    border = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_CONSTANT}
    sampled = cv2.remap(filled, col, row, **border)  # type: ignore[call-overload]
    share = cv2.remap(known.astype(np.float32), col, row, **border)  # type: ignore[call-overload]
    return np.where(share > 0.99, sampled, np.float32(np.nan)).astype(np.float32)


def make_grid(view: PictureOnGround, step_m: float, margin: int) -> tuple[FloatArray, FloatArray]:
    """Make x and y of nodes of step_m about the middle of a view, wider by a margin."""
    counts = [int(size * view.cell_m / step_m + 1e-6) + 2 * margin for size in view.valid.shape]
    east = (np.arange(counts[1]) - 0.5 * (counts[1] - 1)) * step_m
    north = (0.5 * (counts[0] - 1) - np.arange(counts[0])) * step_m
    x, y = np.meshgrid(east, north)
    return x, y


def coarsen_view(view: PictureOnGround, step_m: float) -> tuple[Float32Array, BoolArray]:
    """Average a view to nodes of step_m, as `make_grid` places them; also whether it shows them."""
    x, y = make_grid(view, step_m, 0)
    many = max(1, round(step_m / view.cell_m))
    smooth = average_boxes(view.brightness, many + 1 - many % 2)
    return sample_view(view, smooth, x, y)


def sample_view(
    view: PictureOnGround, values: Float32Array, x: FloatArray, y: FloatArray
) -> tuple[Float32Array, BoolArray]:
    """Sample values at places of the view's own map."""
    sampled = sample_ground(values, view.valid, view, x, y, view)
    shown = np.isfinite(sampled)
    return np.where(shown, sampled, np.float32(0.0)).astype(np.float32), shown


def draw_terrain(
    view: PictureOnGround, heights: Heights, step_m: float, margin: int, radius_m: float
) -> Float32Array:
    """Draw a terrain model under the view's Sun at the nodes of `make_grid`; NaN where unknown."""
    from catalog.rendering.map_view import render_map_quickly

    x, y = make_grid(view, step_m, margin)
    wanted = x.shape
    side = max(wanted)  # maps are square
    full = np.full((side, side), np.nan, np.float32)
    top, left = (side - wanted[0]) // 2, (side - wanted[1]) // 2
    part = slice(top, top + wanted[0]), slice(left, left + wanted[1])
    full[part] = heights(*view.placed.latlon(x, y))
    bright = render_map_quickly(
        full, step_m, view.sun, radius_m=radius_m, view_local=unit(view.camera_m)
    )
    return bright[part]


def match_windows(view: PictureOnGround, reference: Reference, reach: int) -> WindowMatches:
    """Match windows of a view with its reference: one common shift first, then each window.

    reach  nodes that windows may be off the common shift
    """
    none = WindowMatches(np.empty((0, 2)), np.empty((0, 2)))
    picture, ground = _filter_high(reference.picture), _filter_high(reference.brightness)
    margin = reference.margin
    known = np.isfinite(reference.brightness)
    rows, cols = picture.shape
    if min(rows, cols) < MIN_WIDE:
        return none
    common = None
    for border in CORE_BORDERS:  # a wrong scale shifts the rim of a wide core by too much
        core = [slice(round(border * size), round((1.0 - border) * size)) for size in (rows, cols)]
        if common is None and reference.shown[core[0], core[1]].mean() >= 0.9:
            wider = tuple(slice(part.start, part.stop + 2 * margin) for part in core)
            common = _find_peak(_correlate(ground[wider], picture[core[0], core[1]]))
    if common is None:
        return none
    row0, col0 = round(common[0]) - margin, round(common[1]) - margin
    wide = int(np.clip(min(rows, cols) // 4, MIN_WIDE, MAX_WIDE))
    places, shifts = [], []
    for row in _place_windows(rows, wide):
        for col in _place_windows(cols, wide):
            top, left = row + margin + row0 - reach, col + margin + col0 - reach
            bottom, right = top + wide + 2 * reach, left + wide + 2 * reach
            if min(top, left) < 0 or bottom > ground.shape[0] or right > ground.shape[1]:
                continue
            window = slice(row, row + wide), slice(col, col + wide)
            area = slice(top, bottom), slice(left, right)
            if reference.shown[window].mean() < 1.0 or known[area].mean() < 0.9:
                continue
            peak = _find_peak(_correlate(ground[area], picture[window]))
            if peak is None:
                continue
            down, across = peak[0] - reach + row0, peak[1] - reach + col0
            middle = row + 0.5 * (wide - 1), col + 0.5 * (wide - 1)
            places.append((middle[1] - 0.5 * (cols - 1), 0.5 * (rows - 1) - middle[0]))
            shifts.append((across, -down))
    if not places:
        return none
    return WindowMatches(reference.step_m * np.array(places), reference.step_m * np.array(shifts))


def _filter_high(values: Float32Array) -> Float32Array:
    """Subtract the surroundings of 17 nodes: albedo and light vary slowly. NaN becomes 0."""
    known = np.isfinite(values)
    filled = np.where(known, values, np.float32(0.0)).astype(np.float32)
    share = average_boxes(known.astype(np.float32), 17)
    means = average_boxes(filled, 17) / np.maximum(share, np.float32(1e-6))
    return np.where(known, filled - means, np.float32(0.0)).astype(np.float32)


def _correlate(ground: Float32Array, window: Float32Array) -> FloatArray:
    if float(window.std()) <= 0.0 or any(a < b for a, b in zip(ground.shape, window.shape)):
        return np.zeros((1, 1))
    score = cv2.matchTemplate(
        np.ascontiguousarray(ground), np.ascontiguousarray(window), cv2.TM_CCOEFF_NORMED
    )
    return np.where(np.isfinite(score), score, 0.0).astype(np.float64)


def _find_peak(score: FloatArray) -> tuple[float, float] | None:
    """Find the peak by parabolas; None for one that is low or at the border."""
    row, col = (int(at) for at in np.unravel_index(int(np.argmax(score)), score.shape))
    if score[row, col] < MIN_SCORE or not (
        0 < row < score.shape[0] - 1 and 0 < col < score.shape[1] - 1
    ):
        return None

    def interpolate(low: float, middle: float, high: float) -> float:
        bend = low - 2.0 * middle + high
        return 0.0 if bend >= 0.0 else 0.5 * (low - high) / bend

    down = interpolate(*score[row - 1 : row + 2, col])
    across = interpolate(*score[row, col - 1 : col + 2])
    return row + down, col + across


def _place_windows(size: int, wide: int) -> list[int]:
    """Place windows side by side along a side, with gaps where there would be too many."""
    many = min(size // wide, MAX_ALONG)
    return [round(at) for at in np.linspace(0, size - wide, many)]


def refine_pose(
    given: UncertainPose,
    at: UncertainPose,
    view: PictureOnGround,
    matches: WindowMatches,
    reference: Reference,
) -> UncertainPose | None:
    """Refine a pose by matched windows of the view by `at`; None where too few of them agree.

    The share of information that is taken from the pose is the one under which the middle of the
    view is placed best.
    """
    if len(matches.places_m) < MIN_WINDOWS:
        return None
    jacobian = _make_rows(view, at.pose, matches.places_m)
    middle = _make_rows(view, at.pose, np.zeros((1, 2)))[0]
    shifts_m = matches.shifts_m - reference.shift_m
    before = np.zeros(PARAMETERS)
    before[:3] = given.pose.position_m - at.pose.position_m
    before[3:6] = (given.pose.camera_from_body.inv() * at.pose.camera_from_body).as_rotvec()
    before[6] = given.raised_m - at.raised_m
    best: tuple[float, _Refinement] | None = None
    for share in SHARES:
        covariance = np.zeros((PARAMETERS, PARAMETERS))
        covariance[:7, :7] = given.covariance / share
        covariance[7:, 7:] = (reference.covariance + 1e-6 * np.eye(2)) / (1.0 - share)
        sigma = WINDOW_SIGMA * reference.step_m
        if reference.shared:
            sigma /= math.sqrt(1.0 - share)
        solved = _solve(jacobian, shifts_m, before, covariance, sigma)
        if solved is not None and reference.shared and solved.factor > 1.0:
            # a model whose windows scatter more is off by more in common
            covariance[7:, 7:] *= solved.factor
            solved = _solve(jacobian, shifts_m, before, covariance, sigma)
        if solved is None:
            continue
        placed = middle[:, :7] @ solved.covariance[:7, :7] @ middle[:, :7].T
        if best is None or float(np.trace(placed)) < best[0]:
            best = float(np.trace(placed)), solved
    if best is None:
        return None
    change, covariance, factor = best[1]
    turn = Rotation.from_rotvec(change[3:6])
    moved = replace(
        at.pose,
        position_m=at.pose.position_m + change[:3],
        camera_from_body=at.pose.camera_from_body * turn.inv(),
    )
    # windows of a frame of about the same pixels scatter by what the relief below both moves them
    local = given.local_m if reference.shared else WINDOW_SIGMA * reference.step_m * factor**0.5
    return UncertainPose(moved, covariance[:7, :7], local, at.raised_m + float(change[6]))


def _make_rows(view: PictureOnGround, at: KnownPose, places_m: FloatArray) -> FloatArray:
    """Make rows (n, 2, 9) of shifts by all parameters: the reference's own shift counts less."""
    by_pose = compute_place_jacobian(view, at, places_m)
    shift = np.broadcast_to(-np.eye(2), (len(places_m), 2, 2))
    return np.concatenate([by_pose, shift], axis=2)


class _Refinement(NamedTuple):
    """Parameters (9,), their covariance, and the windows' variance over the stated one."""

    change: FloatArray
    covariance: FloatArray
    factor: float


def _solve(
    jacobian: FloatArray,
    shifts_m: FloatArray,
    before: FloatArray,
    covariance: FloatArray,
    sigma_m: float,
) -> _Refinement | None:
    """Solve for the parameters robustly; None where windows disagree."""
    prior = np.linalg.inv(covariance)
    weights: FloatArray = np.ones(len(shifts_m))
    change: FloatArray = np.zeros(PARAMETERS)
    for _ in range(6):
        used = (jacobian * weights[:, None, None]).reshape(-1, PARAMETERS)
        normal = prior + used.T @ jacobian.reshape(-1, PARAMETERS) / sigma_m**2
        wanted = prior @ before + used.T @ shifts_m.ravel() / sigma_m**2
        change = np.asarray(np.linalg.solve(normal, wanted), np.float64)
        off = np.linalg.norm(shifts_m - jacobian @ change, axis=1) / sigma_m
        # The median scatter of right windows may exceed the stated one.
        scale = max(1.0, float(np.median(off)) / 1.18)
        weights = np.asarray(np.minimum(1.0, HUBER * scale / np.maximum(off, 1e-9)), np.float64)
        weights[off > MAX_SIGMAS * scale] = 0.0
    good = weights > 0.0
    if good.sum() < max(MIN_WINDOWS, 0.5 * len(good)):
        return None
    factor = max(1.0, float(np.sum(weights * off**2)) / max(2.0 * good.sum() - 4.0, 1.0))
    used = (jacobian * weights[:, None, None]).reshape(-1, PARAMETERS)
    normal = prior + used.T @ jacobian.reshape(-1, PARAMETERS) / (factor * sigma_m**2)
    return _Refinement(change, np.linalg.inv(normal), factor)
