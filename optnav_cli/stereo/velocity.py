"""Side velocity from two pictures of one camera, a step of time apart, over ground of known shape.

A ground point P of the later ship frame was at R P + T in the earlier one: R by the attitudes, the
shift T of the ship by the windows. Errors: of the windows, of the turn between the attitudes (the
height times it: it dominates), and of the height, which scales the shift.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import cross_matrix
from optnav_cli.estimation.least_squares import inverse_of
from optnav_cli.estimation.robust import TUKEY, scatter, tukey_weights
from optnav_cli.reasons import ReasonCode
from optnav_cli.stereo.height import (
    MIN_LEAD,
    MIN_PEAK,
    MIN_WINDOWS,
    RIVAL_PX,
    StereoHeight,
    measure_shifts,
    refine_inverse,
)
from optnav_cli.stereo.rig import Eye, Rig, resample

# Ground under an altimeter's beam against the level ground assumed, 1 sigma, as a share of the
# height: 7 deg of slope over a tenth of the height.
LEVEL_SHARE = 0.012
MIN_PARALLAX_PX = 5.0  # between two pictures of one camera, for the ground's shape
MAX_INVERSE_SHARE = 0.02  # of a window's inverse distance: its widest sigma
SHAPE_ROUNDS = 2
MAX_SIGMAS = 4.0  # between what ranges and pictures say of the sink
TEMPLATE_PX = 256  # of the search
ROUNDS = ((96, 2.0), (64, 1.0), (64, 0.0))
MAX_LEFT_PX = 1.0


@dataclass(frozen=True, eq=False)
class Step:
    """Motion known between two pictures.

    seconds         from the earlier to the later
    before_from_now rotation of ship frames by the attitudes;  turn_sigma_rad its error an axis
    down            (3,) unit vector, later ship frame
    """

    seconds: float
    before_from_now: Rotation
    turn_sigma_rad: float
    down: FloatArray


@dataclass(frozen=True, eq=False)
class SideVelocity:
    """Velocity (3,) of the ship over the ground, later ship frame, m/s, and its covariance."""

    velocity_m_s: FloatArray
    covariance: FloatArray

    @property
    def side_sigma_m_s(self) -> float:
        """1 sigma of x and y, per component."""
        return float(np.sqrt(0.5 * np.trace(self.covariance[:2, :2])))


def measure_velocity(
    before: tuple[Float32Array, StereoHeight],
    now: tuple[Float32Array, StereoHeight],
    eye: Eye,
    step: Step,
) -> SideVelocity:
    """Measure the velocity between two pictures of a camera, each with the height of its time.

    Raises NoSolutionError where the pictures share too little ground.
    """
    picture, height = now
    turn = step.before_from_now.as_matrix()
    shift = turn @ step.down * (before[1].height_m - height.height_m)
    shift = shift + _search_shift(before[0], now, eye, turn, shift)
    inverse = height.inverse_m
    for size, blur in ROUNDS:
        through = _resample_earlier(before[0], inverse, eye, turn, shift)
        windows = measure_shifts(picture, through, size, blur)
        at = np.stack([windows.x, windows.y]).astype(np.float32)
        here = cv2.remap(inverse, at[0], at[1], cv2.INTER_LINEAR)[windows.usable]
        pixels = np.stack([windows.x, windows.y], axis=-1)[windows.usable]
        if len(pixels) < MIN_WINDOWS:
            raise NoSolutionError(
                f"only {len(pixels)} windows show one ground in the pictures of both times",
                ReasonCode.FEW_POINTS,
            )
        places = eye.place_m + eye.unproject(pixels) / here[:, None]
        _, by_vector = eye.linearise_projection(places - turn.T @ (eye.place_m - shift))
        by_shift = by_vector @ turn.T
        moved = windows.shift_px[windows.usable]
        covariances = windows.covariance[windows.usable] + 1e-9 * np.eye(2)
        information = np.linalg.inv(covariances).astype(np.float64)
        change, normal, weights = _fit_robust_shift(by_shift, moved, information)
        shift = shift + change
    left = moved - by_shift @ change
    covariance = inverse_of(normal)
    squares = np.einsum("ni,nij,nj->n", left, information, left) * weights
    excess = max(1.0, float(squares.sum()) / max(2.0 * float(weights.sum()), 1.0))
    noise = covariance * windows.overlap * excess  # windows share ground: their errors, too
    # a turn w of the earlier frame moves R P by w x R P
    turned = -cross_matrix(places @ turn.T)
    weighing = information * weights[:, None, None]
    by_turn = covariance @ np.einsum("nia,nij,njk,nkb->ab", by_shift, weighing, by_shift, turned)
    of_turn = by_turn @ by_turn.T * step.turn_sigma_rad**2
    scale = height.whole_sigma_m / height.height_m
    total = noise + of_turn + np.outer(shift, shift) * scale**2
    back = turn.T / step.seconds
    # where the ship is now, less where it was: the shift, seen along the axes of now
    return SideVelocity(back @ shift, back @ total @ back.T)


@dataclass(frozen=True, eq=False)
class BeamRange:
    """An altimeter's range from the camera's place, m, and its 1 sigma.

    beam  (3,) unit vector, ship frame
    """

    beam: FloatArray
    range_m: float
    sigma_m: float


def lay_level_ground(eye: Eye, seen: BeamRange, down: FloatArray) -> StereoHeight:
    """Lay level ground through the point that an altimeter measures; down (3,) ship frame."""
    rays = Rig(eye, eye).compute_grid_rays()
    cosine = float(seen.beam @ down)
    depth = seen.range_m * cosine
    height_m = depth + float(eye.place_m @ down)
    sigma = float(np.hypot(seen.sigma_m * cosine, LEVEL_SHARE * height_m))
    return StereoHeight(height_m, sigma, 0.0, 0, np.maximum(rays @ down, 0.05) / depth)


def measure_one_eyed_velocity(
    before: tuple[Float32Array, BeamRange, FloatArray],
    now: tuple[Float32Array, BeamRange],
    eye: Eye,
    step: Step,
) -> SideVelocity:
    """Measure the velocity between two pictures of one camera, each with an altimeter's range.

    before  picture, range and down (3,), all of the earlier ship frame;  now  the later ones

    The motion shows the ground's shape up to a scale, and the later range gives that. Raises
    NoSolutionError as `measure_velocity`, and for ranges that contradict the pictures.
    """
    earlier = lay_level_ground(eye, before[1], before[2])
    height = lay_level_ground(eye, now[1], step.down)
    turn, said = step.before_from_now.as_matrix(), earlier.height_m - height.height_m
    try:
        velocity = measure_velocity((before[0], earlier), (now[0], height), eye, step)
    except NoSolutionError:
        # ranges that are wrong hide the ground from the search: without a sink it may be found
        earlier = replace(earlier, height_m=height.height_m)
        velocity = measure_velocity((before[0], earlier), (now[0], height), eye, step)
    for _ in range(SHAPE_ROUNDS):
        shift = step.seconds * turn @ velocity.velocity_m_s
        shaped = _shape_ground(before[0], now, height, eye, turn, shift)
        if shaped is None:
            break
        height = shaped
        velocity = measure_velocity((before[0], earlier), (now[0], height), eye, step)
    sank = step.seconds * float(velocity.velocity_m_s @ step.down)
    sink_m2 = step.seconds**2 * float(step.down @ velocity.covariance @ step.down)
    relief = LEVEL_SHARE * (said + 2.0 * height.height_m)
    sigma = float(np.sqrt(sink_m2 + relief**2 + before[1].sigma_m ** 2 + now[1].sigma_m ** 2))
    if abs(sank - said) > MAX_SIGMAS * sigma:
        raise NoSolutionError(
            f"the altimeter's ranges of {before[1].range_m:.1f} and {now[1].range_m:.1f} m say "
            f"that the ship sank by {said:.1f} m, the pictures {sank:.1f} m, with a sigma of "
            f"{sigma:.1f} m",
            ReasonCode.RANGE_REFUSED,
        )
    return velocity


def _shape_ground(
    before: Float32Array,
    now: tuple[Float32Array, BeamRange],
    height: StereoHeight,
    eye: Eye,
    turn: FloatArray,
    shift: FloatArray,
) -> StereoHeight | None:
    """Shape the ground by the parallax of a motion; None where that is too small.

    turn (3, 3), shift (3,)  of the ship from now to before
    """
    picture, seen = now
    parallax = float(np.linalg.norm(shift)) / height.height_m * eye.camera.focal_length_px
    if parallax < MIN_PARALLAX_PX:
        return None
    other = replace(
        eye,
        # a point P of now was at R P + T, and the camera at its place: R'(place - T) of now
        place_m=turn.T @ (eye.place_m - shift),
        ship_from_camera=Rotation.from_matrix(turn.T) * eye.ship_from_camera,
    )
    shape = refine_inverse(picture, before, Rig(eye, other), height.inverse_m, MAX_INVERSE_SHARE)
    if shape is None:
        return None
    column, row = (round(float(v)) for v in eye.project(seen.beam[None])[0])
    rows, cols = shape.shape
    if not (0 <= row < rows and 0 <= column < cols):
        return None
    # along the beam the ground lies as far off as the altimeter says
    shape = shape / (float(shape[row, column]) * seen.range_m)
    sigma = height.height_m * seen.sigma_m / seen.range_m
    return StereoHeight(height.height_m, sigma, 0.0, 0, shape)


def _resample_earlier(
    before: Float32Array, inverse: FloatArray, eye: Eye, turn: FloatArray, shift: FloatArray
) -> Float32Array:
    """Resample the earlier picture on the grid of the later one, over the ground, by a shift."""
    rows, cols = inverse.shape
    x, y = np.meshgrid(np.arange(cols, dtype=np.float64), np.arange(rows, dtype=np.float64))
    places = eye.place_m + eye.unproject(np.stack([x, y], axis=-1)) / inverse[..., None]
    return resample(before, eye.project(places @ turn.T + (shift - eye.place_m)))


def _search_shift(
    before: Float32Array,
    now: tuple[Float32Array, StereoHeight],
    eye: Eye,
    turn: FloatArray,
    shift: FloatArray,
) -> FloatArray:
    """Search for a correction (3,) of a shift, by one large window in the middle of the picture."""
    picture, height = now
    through = _resample_earlier(before, height.inverse_m, eye, turn, shift)
    seen = np.isfinite(through)
    if not seen.any():
        raise NoSolutionError("the pictures of both times share no ground", ReasonCode.FEW_POINTS)
    filled = np.where(seen, through, float(through[seen].mean())).astype(np.float32)
    rows, cols = picture.shape
    half = min(TEMPLATE_PX, rows - 2, cols - 2) // 2
    row, column = rows // 2, cols // 2
    template = picture[row - half : row + half, column - half : column + half]
    scores = cv2.matchTemplate(filled, template, cv2.TM_CCOEFF_NORMED)
    best_row, best_column = np.unravel_index(int(np.argmax(scores)), scores.shape)
    peak = float(scores[best_row, best_column])
    y, x = np.mgrid[: scores.shape[0], : scores.shape[1]]
    outside_peak = np.hypot(y - best_row, x - best_column) > RIVAL_PX
    rival = float(scores[outside_peak].max(initial=-1.0))
    if peak < MIN_PEAK or peak < MIN_LEAD * rival:
        raise NoSolutionError(
            f"the ground of the pair before is not found (correlation {peak:.2f}, the next "
            f"{rival:.2f})",
            ReasonCode.LOW_SCORE,
        )
    moved = np.array([best_column + half - column, best_row + half - row], dtype=np.float64)
    middle = np.array([[float(column), float(row)]])
    inverse = float(height.inverse_m[row, column])
    point = eye.place_m + eye.unproject(middle) / inverse
    _, by_vector = eye.linearise_projection(point - turn.T @ (eye.place_m - shift))
    change: FloatArray = np.linalg.pinv(by_vector[0] @ turn.T) @ moved
    return change


def _fit_robust_shift(
    by_shift: FloatArray, moved: FloatArray, information: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fit a change of the shift (3,) to windows; its normal matrix (3, 3), weights (n,)."""
    weights = np.ones(len(moved))
    change, normal = np.zeros(3), np.eye(3)
    for _ in range(6):
        weighing = information * weights[:, None, None]
        normal = np.einsum("nia,nij,njb->ab", by_shift, weighing, by_shift)
        covariance = inverse_of(normal)
        if not np.isfinite(covariance).all():
            text = "the windows of both times leave the motion open"
            raise NoSolutionError(text, ReasonCode.DEGENERATE)
        change = covariance @ np.einsum("nia,nij,nj->a", by_shift, weighing, moved)
        left = moved - by_shift @ change
        size = np.sqrt(0.5 * np.einsum("ni,nij,nj->n", left, information, left))
        weights = tukey_weights(size, TUKEY * max(scatter(size), 1.0))
        if not weights.any():
            raise NoSolutionError(
                "the windows of both times contradict each other", ReasonCode.POINTS_DISAGREE
            )
    return change, normal, weights
