"""Right and wrong situations of a picture: what the gates of a pose are measured with.

A situation is a picture with what is stated about it. A right one states a pose near the true one.
A wrong one has a picture, a pose or a Sun that cannot belong together, so that any position found
in it is found by chance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.ncc import match_ncc
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import squared_distance, unit
from optnav_cli.control_points import method as control_points
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.fix import GateMargins, PositionPrior, UnsolvedFrameError
from optnav_cli.frames.folder import FROM_FILE, Observation
from optnav_cli.reasons import ReasonCode
from tests.studies import smooth_pictures

RIGHT, WRONG_SUN = "right", "wrong Sun"
WINDOW = (0.6, 1.0)  # side of the part of a picture that is shown, over its shorter side
STAR_SENSOR_RAD = 10.0 * ARCSEC  # half of the exact attitudes become as uncertain as this
SMOOTH_SIZES_PX = (256, 512, 1024, 2048)  # of pictures without ground
MIN_POINTS = 4  # in view: with fewer a right situation is not counted as one
SUN_TURN = (np.pi / 2.0, np.pi)  # about the vertical: the light comes from another side


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A picture whose pose is known.

    observation     with its stated attitude
    position_m      (3,) of the camera, body frame: the truth, or an archive's label
    camera_from_body  the true attitude; None where only the stated one is known
    prior_sigma_m   lowest and highest sigma of priors; they are drawn about position_m
    apart_rad       how far, at least, ground is another ground, seen from the body's centre
    """

    observation: Observation
    position_m: FloatArray
    camera_from_body: Rotation | None
    prior_sigma_m: tuple[float, float]
    apart_rad: float


@dataclass(frozen=True, eq=False)
class Situation:
    """A picture to be navigated, and by which name it is counted."""

    kind: str
    observation: Observation
    prior: PositionPrior


@dataclass(frozen=True)
class SituationOutcome:
    """What navigation made of a situation.

    kind     RIGHT or a key of WRONG
    code     why it is unsolved, empty when it is solved
    margins  of the pose; None where there was none to judge
    points   expected in view, from the pose that was reached; None where none was searched
    sigmas   distance of the position from the truth in its own sigmas, where both are known
    """

    case: str
    kind: str
    code: str
    margins: GateMargins | None = None
    sigmas: float | None = None
    points: int | None = None

    @property
    def is_poor(self) -> bool:
        """Whether it is unsolved with so few points in view that no gate was asked."""
        return not self.solved and self.points is not None and self.points < MIN_POINTS

    @property
    def solved(self) -> bool:
        """Whether the situation gave a position."""
        return not self.code


def right(view: PosedPicture, rng: np.random.Generator) -> Situation:
    """A part of the picture with a position and an attitude that are off as they are stated."""
    shown = _window(view.observation, rng)
    if shown.attitude_sigma_rad == 0.0 and rng.random() < 0.5:
        turn = Rotation.from_rotvec(rng.normal(0.0, STAR_SENSOR_RAD, 3))
        shown = replace(
            shown,
            camera_from_body=turn * shown.camera_from_body,
            attitude_sigma_rad=STAR_SENSOR_RAD,
        )
    low, high = np.log(view.prior_sigma_m)
    sigma = float(np.exp(rng.uniform(low, high)))
    place = view.position_m
    if view.camera_from_body is not None:  # a label is off already
        place = place + rng.normal(0.0, sigma, 3)
    return Situation(RIGHT, shown, PositionPrior.isotropic(place, sigma, FROM_FILE))


Spoiled = Callable[[Situation, PosedPicture, "Surround", np.random.Generator], Situation]


@dataclass(frozen=True, eq=False)
class Surround:
    """What wrong situations are made with: places of a catalog, pictures of other bodies."""

    places_m: FloatArray
    strangers: Sequence[Float32Array]


def other_ground(
    good: Situation, view: PosedPicture, around: Surround, rng: np.random.Generator
) -> Situation:
    """The pose and the Sun stated as if the same picture were of another part of the catalog."""
    directions, below = unit(around.places_m), unit(good.prior.position_m)
    cosines = directions @ below
    far = np.flatnonzero(cosines < np.cos(view.apart_rad))
    chosen = rng.choice(far) if len(far) else int(np.argmin(cosines))
    axis = np.cross(below, directions[chosen])
    angle = np.arctan2(np.linalg.norm(axis), cosines[chosen])
    turn = Rotation.from_rotvec(unit(axis) * angle)
    seen = good.observation
    moved = replace(
        seen,
        camera_from_body=seen.camera_from_body * turn.inv(),
        sun_body=turn.apply(seen.sun_body),
    )
    place = replace(good.prior, position_m=turn.apply(good.prior.position_m))
    return replace(good, observation=moved, prior=place)


def mirrored(
    good: Situation, view: PosedPicture, around: Surround, rng: np.random.Generator
) -> Situation:
    """The picture left for right."""
    camera = good.observation.camera
    x, y = camera.principal_point_px
    values = good.observation.picture.values[:, ::-1]
    return _with_picture(good, values, (camera.width_px - 1.0 - x, y))


def turned(
    good: Situation, view: PosedPicture, around: Surround, rng: np.random.Generator
) -> Situation:
    """The picture by one to three quarters of a turn."""
    values, (x, y) = good.observation.picture.values, good.observation.camera.principal_point_px
    for _ in range(rng.integers(1, 4)):
        x, y = y, values.shape[1] - 1.0 - x
        values = np.rot90(values)
    return _with_picture(good, values, (x, y))


def wrong_sun(
    good: Situation, view: PosedPicture, around: Surround, rng: np.random.Generator
) -> Situation:
    """The Sun as high, and in another direction."""
    angle = rng.uniform(*SUN_TURN) * rng.choice([-1.0, 1.0])
    turn = Rotation.from_rotvec(unit(view.position_m) * angle)
    sun = turn.apply(good.observation.sun_body)
    return replace(good, observation=replace(good.observation, sun_body=sun))


def noise(
    good: Situation, view: PosedPicture, around: Surround, rng: np.random.Generator
) -> Situation:
    """A picture of the same spectrum and the same brightnesses, whose phases mean nothing."""
    values = good.observation.picture.values
    random = np.angle(np.fft.rfft2(rng.normal(size=values.shape)))
    drawn = np.fft.irfft2(np.abs(np.fft.rfft2(values)) * np.exp(1j * random), s=values.shape)
    made = np.empty(values.size, dtype=np.float32)
    made[np.argsort(drawn, axis=None)] = np.sort(values, axis=None)
    return _with_picture(good, made.reshape(values.shape))


def other_body(
    good: Situation, view: PosedPicture, around: Surround, rng: np.random.Generator
) -> Situation:
    """A picture of another body, its lit part as large as the window."""
    stranger = around.strangers[int(rng.integers(len(around.strangers)))]
    lit = stranger > 0.25 * float(np.quantile(stranger, 0.99))
    rows, columns = (np.flatnonzero(lit.any(axis=axis)) for axis in (1, 0))
    cut = stranger[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    height, width = good.observation.picture.values.shape
    filled = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)
    return _with_picture(good, filled.astype(np.float32))


def smooth(
    good: Situation, view: PosedPicture, around: Surround, rng: np.random.Generator
) -> Situation:
    """A picture without ground, of some size and depth; a defocused one shows ground mirrored."""
    seen = good.observation
    size, bits = int(rng.choice(SMOOTH_SIZES_PX)), int(rng.choice(smooth_pictures.BITS))
    kind = str(rng.choice(smooth_pictures.KINDS))
    sharp = np.ascontiguousarray(seen.picture.values[:, ::-1])
    values = smooth_pictures.draw_smooth_picture(size, bits, kind, sharp, rng)
    factor = size / seen.camera.width_px
    x, y = seen.camera.principal_point_px
    camera = replace(
        seen.camera.with_focal_factor(factor),
        width_px=size,
        height_px=size,
        principal_point_px=((x + 0.5) * factor - 0.5, (y + 0.5) * factor - 0.5),
    )
    picture = replace(seen.picture, values=values, saturation=2.0**bits - 1.0)
    return replace(good, observation=replace(seen, camera=camera, picture=picture))


WRONG: dict[str, Spoiled] = {
    "other ground": other_ground,
    "mirrored": mirrored,
    "turned": turned,
    WRONG_SUN: wrong_sun,
    "noise": noise,
    "other body": other_body,
    "smooth": smooth,
}


TRUE_PLACE = (RIGHT, WRONG_SUN)  # a position near the truth is possible, and right


def situations(
    view: PosedPicture, around: Surround, rng: np.random.Generator, n_right: int, n_wrong: int
) -> list[Situation]:
    """Right situations of a picture, and so many wrong ones of each kind that can be made."""
    found = [right(view, rng) for _ in range(n_right)]
    for kind, spoiled in WRONG.items():
        if kind != "other body" or around.strangers:
            for _ in range(n_wrong):
                found.append(replace(spoiled(right(view, rng), view, around, rng), kind=kind))
    return found


def outcome(
    case: str, situation: Situation, view: PosedPicture, points: ControlPointField
) -> SituationOutcome:
    """Navigate a situation by control points."""
    kind = situation.kind
    try:
        fix = control_points.navigate(
            situation.observation, situation.prior, points, NavigateSettings(), match_ncc
        )
    except UnsolvedFrameError as error:
        tried = error.evidence
        return SituationOutcome(case, kind, error.code, tried.margins, points=tried.n_predicted)
    except NoSolutionError as error:
        return SituationOutcome(case, kind, error.code)
    sigmas = None
    if kind in TRUE_PLACE and view.camera_from_body is not None:
        off = fix.position_m - view.position_m
        sigmas = float(np.sqrt(squared_distance(off, fix.covariance_m2)))
    return SituationOutcome(
        case, kind, ReasonCode.NONE, fix.evidence.margins, sigmas, fix.evidence.n_predicted
    )


def _window(seen: Observation, rng: np.random.Generator) -> Observation:
    """A square part of a picture, with the camera that would take it."""
    camera, values = seen.camera, seen.picture.values
    side = int(rng.uniform(*WINDOW) * min(values.shape))
    top, left = (int(rng.integers(size - side + 1)) for size in values.shape)
    x, y = camera.principal_point_px
    part = replace(camera, width_px=side, height_px=side, principal_point_px=(x - left, y - top))
    picture = replace(seen.picture, values=values[top : top + side, left : left + side].copy())
    return replace(seen, camera=part, picture=picture)


def _with_picture(
    good: Situation, values: FloatArray | Float32Array, centre_px: tuple[float, float] | None = None
) -> Situation:
    """The same situation with another picture, and perhaps another principal point."""
    seen = good.observation
    camera = seen.camera
    if centre_px is not None:
        camera = replace(camera, principal_point_px=centre_px)
    picture = replace(seen.picture, values=np.ascontiguousarray(values, dtype=np.float32))
    return replace(good, observation=replace(seen, camera=camera, picture=picture))
