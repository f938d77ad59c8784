"""Errors along the motion (R, N, B), their statistics, and whether covariances are honest.

Also the limits that a pipeline sets for them.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv

from catalog.arrays import FloatArray
from catalog.errors import DifferenceError, NothingToDoError
from catalog.geometry.rotations import rnb_axes
from optnav_cli.fix import Method, Solution
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.frames.truth import Truth
from optnav_cli.output.wording import format_length
from optnav_cli.reasons import ReasonCode, format_distinct

Forward = Literal["motion", "north"]
# True attitudes as far as this from the solved ones are no errors of navigation, and another frame
# that brings them so much nearer is the one that they were written in.
FAR_RAD = np.radians(1.0)

# camera_from_body of a file's rotation and of inertial_from_body, by what the rotation is
READINGS: Mapping[str, Callable[[Rotation, Rotation], Rotation]] = {
    "camera_from_body": lambda written, inertial_from_body: written,
    "body_from_camera": lambda written, inertial_from_body: written.inv(),
    "camera_from_inertial": lambda written, inertial_from_body: written * inertial_from_body,
    "inertial_from_camera": lambda written, inertial_from_body: written.inv() * inertial_from_body,
}
FROM_AFAR = tuple(reversed(Method))  # as an approaching craft uses them
BEYOND_SIGMAS = 5.0  # of the error as a whole: the root of its normalised square
CONFIDENCE = 0.95


class Placed(Protocol):
    """Where a camera was when: tdb_s in TDB s past J2000, position_m (3,) body frame, m."""

    @property
    def tdb_s(self) -> float: ...

    @property
    def position_m(self) -> FloatArray: ...


class TimedPlace(NamedTuple):
    """A position (3,), m, body frame, and its time, TDB s past J2000."""

    tdb_s: float
    position_m: FloatArray


def find_motion_axes(places: Sequence[Placed]) -> list[tuple[FloatArray, Forward]]:
    """Find axes R, N, B as rows (3, 3) for each position, and what N rests on.

    N points along the chord between the neighbours in time that belong to the same pass, as the
    body sees it; where there is none, or the motion is vertical, N is local north ("north").
    Positions of one time (several cameras) share their neighbours.
    """
    order = sorted(range(len(places)), key=lambda index: places[index].tdb_s)
    axes: list[tuple[FloatArray, Forward]] = [(np.eye(3), "north")] * len(places)
    for rank, index in enumerate(order):
        here = places[index]
        before = _find_next_in_time(places, order[:rank][::-1], here)
        after = _find_next_in_time(places, order[rank + 1 :], here)
        start = before if before is not None and is_same_pass(before, here) else here
        end = after if after is not None and is_same_pass(here, after) else here
        axes[index] = _compute_axes(here.position_m, end.position_m - start.position_m)
    return axes


def _find_next_in_time(
    places: Sequence[Placed], order: Sequence[int], here: Placed
) -> Placed | None:
    """Find the first in order that is of another time."""
    others = (places[index] for index in order)
    # cameras of one moment differ by up to 0.01 s
    return next((other for other in others if abs(other.tdb_s - here.tdb_s) > 0.01), None)


def is_same_pass(earlier: Placed, later: Placed) -> bool:
    """Whether two positions are neighbours in time on one pass, in this order."""
    gap_s = later.tdb_s - earlier.tdb_s
    nearest = min(float(np.linalg.norm(camera.position_m)) for camera in (earlier, later))
    # Frames further apart than 1200 s or 60 deg on the ground are not neighbours of one pass: the
    # chord between them is off the direction of motion by more than a few degrees. Motion slows as
    # the power 1.5 of the distance (Kepler), so beyond 2000 km the gap may grow like that.
    if not 0.0 < gap_s <= 1200.0 * max(1.0, nearest / 2.0e6) ** 1.5:
        return False
    speed = float(np.linalg.norm(later.position_m - earlier.position_m)) / gap_s
    cosine = earlier.position_m @ later.position_m
    cosine = cosine / np.linalg.norm(earlier.position_m) / np.linalg.norm(later.position_m)
    near = bool(cosine >= np.cos(np.radians(60.0)))
    # below 1 m/s the camera stands still, above 20 km/s it is another pass
    return near and 1.0 <= speed <= 20e3


def _compute_axes(position: FloatArray, motion: FloatArray) -> tuple[FloatArray, Forward]:
    length = float(np.linalg.norm(motion))
    up = position / np.linalg.norm(position)
    # 2 % of the motion across the vertical still give a direction
    if length > 0.0 and np.linalg.norm(np.cross(up, motion)) >= 0.02 * length:
        return rnb_axes(position, motion), "motion"
    north = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(up, north)) < 1e-9:  # at a pole any direction does
        north = np.array([1.0, 0.0, 0.0])
    return rnb_axes(position, north), "north"


def identify_other_frame(
    solutions: Sequence[Solution], truths: Sequence[Truth], attitude: FileAttitude
) -> str:
    """Identify the truth's quaternions where they are not what `attitude` names; else "".

    attitude  as the truth was read with
    """
    by_file = {truth.file: truth for truth in truths}
    angles: dict[str, list[float]] = {name: [] for name in READINGS}
    for solution in solutions:
        if solution.camera_from_body is None:
            continue
        truth = by_file[solution.file]
        if not truth.has_attitude:
            continue
        inertial_from_body = attitude.inertial_from_body(truth.tdb_s)
        written = attitude.convert_for_file(truth.camera_from_body, truth.tdb_s)
        for name, reading in READINGS.items():
            true = reading(written, inertial_from_body)
            angles[name].append(float((solution.camera_from_body * true.inv()).magnitude()))
    if not angles[attitude.name]:
        return ""
    off = {name: float(np.median(values)) for name, values in angles.items()}
    best = min(off, key=off.__getitem__)
    stated = off[attitude.name]
    return best if stated > FAR_RAD and off[best] < min(FAR_RAD, 0.1 * stated) else ""


def describe_method(method: str) -> str:
    """Return a method's name for people; an unknown name stays as it is."""
    return Method(method).label if method in FROM_AFAR else method or "unnamed"


def rank_method(method: str) -> tuple[int, str]:
    """Rank methods from afar to near, unknown ones last."""
    return (FROM_AFAR.index(Method(method)) if method in FROM_AFAR else len(FROM_AFAR), method)


@dataclass(frozen=True, eq=False)
class FrameError:
    """One frame against its truth; what does not apply is None.

    forward             what the direction N rests on: motion, or local north
    error_rnb_m         (3,)  solution minus truth along R, N, B
    sigma_rnb_m         (3,)  what the solution states
    nees                error squared over the stated covariance, expectation 3
    attitude_error_rad  angle between the solved and the true attitude
    n_checked, n_wrong  control points kept, and how many of them were found more than 3 px from
                        where they truly are; None where truth or camera is not known
    height_m            true distance from the centre of the body less its reference radius
    distance_m          true distance from the centre
    camera              name of the camera, empty where it is not known
    """

    file: str
    utc: str
    solution: Solution
    forward: Forward
    height_m: float
    error_rnb_m: FloatArray | None = None
    sigma_rnb_m: FloatArray | None = None
    nees: float | None = None
    attitude_error_rad: float | None = None
    n_checked: int | None = None
    n_wrong: int | None = None
    distance_m: float = math.nan
    camera: str = ""

    @property
    def range_error(self) -> tuple[float, float] | None:
        """Error along R and its stated sigma, as shares of the distance to the surface."""
        if self.error_rnb_m is None or self.sigma_rnb_m is None or not self.height_m > 0.0:
            return None
        error, sigma = float(self.error_rnb_m[0]), float(self.sigma_rnb_m[0])
        return error / self.height_m, sigma / self.height_m

    @property
    def direction_error(self) -> tuple[float, float] | None:
        """Angle (rad) between the solved and the true direction to the centre, its stated rms."""
        if self.error_rnb_m is None or self.sigma_rnb_m is None:
            return None
        r, n, b = (float(v) for v in self.error_rnb_m)
        across = math.hypot(float(self.sigma_rnb_m[1]), float(self.sigma_rnb_m[2]))
        return math.atan2(math.hypot(n, b), self.distance_m + r), across / self.distance_m


@dataclass(frozen=True)
class Spread:
    """Statistics of one component's errors; sigma (about the mean) is None for a single frame."""

    bias: float
    sigma: float | None
    rms: float
    max: float


@dataclass(frozen=True)
class Figures:
    """Statistics of a set of frames; lengths in m, angles in rad.

    horizontal_rms_m   rms of sqrt(N^2 + B^2)
    inside_3_sigma     (R, N, B) share of frames inside 3 stated sigmas
    nees               mean of the error squared over its expectation: 1 for an honest covariance
    nees_range         where `nees` lies in 95 % of cases when the covariance is honest
    attitude_rms       angle of the attitude error, rms
    n_predicted ...    control points, summed over the solved frames
    n_wrong            wrong ones among n_checked kept control points; None where no frame has a
                       camera and true attitude to check them by
    north_frames       frames whose N is local north for want of neighbours
    beyond_5_sigma     solved frames whose error is more than 5 times what its covariance states:
                       1.5e-5 of them if it is honest
    """

    frames: int
    solved: int
    r: Spread
    n: Spread
    b: Spread
    horizontal_rms_m: float
    horizontal_max_m: float
    inside_3_sigma: tuple[float, float, float]
    nees: float
    nees_range: tuple[float, float]
    attitude_rms: float | None
    attitude_max: float | None
    n_predicted: int
    n_matched: int
    n_used: int
    n_wrong: int
    n_checked: int | None
    north_frames: int
    unsolved_reasons: Mapping[ReasonCode, int]
    beyond_5_sigma: int = 0

    @property
    def height_rms_m(self) -> float:
        """rms of the error along R."""
        return self.r.rms


@dataclass(frozen=True)
class MethodFigures:
    """Statistics of one method on the pictures of one camera.

    of_frames             pictures of the camera
    range_rms             error along R over the distance to the surface, rms; None at the surface
    direction_rms         error of the direction to the centre, rad, rms
    """

    method: str
    camera: str
    of_frames: int
    figures: Figures
    range_rms: float | None
    direction_rms: float


def compute_method_figures(frames: Sequence[FrameError]) -> list[MethodFigures]:
    """Compute figures of solved frames by method and camera, from afar to near."""
    groups: dict[tuple[str, str], list[FrameError]] = {}
    for frame in frames:
        if frame.error_rnb_m is not None:
            groups.setdefault((frame.solution.method, frame.camera), []).append(frame)
    figures = []
    for method, camera in sorted(groups, key=lambda key: (*rank_method(key[0]), key[1])):
        group = groups[method, camera]
        ranges = [f.range_error[0] for f in group if f.range_error is not None]
        angles = [f.direction_error[0] for f in group if f.direction_error is not None]
        figures.append(
            MethodFigures(
                method,
                camera,
                sum(frame.camera == camera for frame in frames),
                compute_figures(group),
                _compute_rms(np.array(ranges)) if ranges else None,
                _compute_rms(np.array(angles)),
            )
        )
    return figures


def compute_figures(frames: Sequence[FrameError]) -> Figures:
    """Add frames up. Raises NothingToDoError when none of them is solved."""
    good = [frame for frame in frames if frame.error_rnb_m is not None]
    reasons = Counter(f.solution.reason_code for f in frames if f.error_rnb_m is None)
    if not good:
        words = "; ".join(f"{code.label} ({count})" for code, count in reasons.most_common(3))
        raise NothingToDoError(
            f"none of the {len(frames)} frames is solved, so there is nothing to evaluate: {words}"
        )
    errors = np.array([frame.error_rnb_m for frame in good])
    sigmas = np.array([frame.sigma_rnb_m for frame in good])
    horizontal = np.hypot(errors[:, 1], errors[:, 2])
    inside = (np.abs(errors) <= 3.0 * sigmas).mean(axis=0)
    nees = np.array([frame.nees for frame in good])
    terms = 3 * len(good)
    tails = (0.5 - CONFIDENCE / 2.0, 0.5 + CONFIDENCE / 2.0)
    low, high = (2.0 * float(gammaincinv(terms / 2.0, tail)) / terms for tail in tails)
    angles = [f.attitude_error_rad for f in good if f.attitude_error_rad is not None]
    checked = [f for f in good if f.n_wrong is not None]
    return Figures(
        frames=len(frames),
        solved=len(good),
        r=_compute_spread(errors[:, 0]),
        n=_compute_spread(errors[:, 1]),
        b=_compute_spread(errors[:, 2]),
        horizontal_rms_m=_compute_rms(horizontal),
        horizontal_max_m=float(horizontal.max()),
        inside_3_sigma=(float(inside[0]), float(inside[1]), float(inside[2])),
        nees=float(nees.mean()) / 3.0,
        nees_range=(low, high),
        attitude_rms=_compute_rms(np.array(angles)) if angles else None,
        attitude_max=max(angles) if angles else None,
        n_predicted=sum(f.solution.n_predicted or 0 for f in good),
        n_matched=sum(f.solution.n_matched or 0 for f in good),
        n_used=sum(f.solution.n_used or 0 for f in good),
        n_wrong=sum(f.n_wrong or 0 for f in checked),
        n_checked=sum(f.n_checked or 0 for f in checked) if checked else None,
        north_frames=sum(f.forward == "north" for f in good),
        unsolved_reasons=dict(sorted(reasons.items())),
        beyond_5_sigma=int((nees > BEYOND_SIGMAS**2).sum()),
    )


def make_unsolved_figures(frames: Sequence[FrameError]) -> Figures:
    """Make the figures of frames none of which is solved: only their number and reasons."""
    reasons = Counter(frame.solution.reason_code for frame in frames)
    nan, spread = math.nan, Spread(math.nan, None, math.nan, math.nan)
    errors = (spread, spread, spread, nan, nan, (nan, nan, nan), nan, (nan, nan), None, None)
    return Figures(len(frames), 0, *errors, 0, 0, 0, 0, 0, 0, dict(sorted(reasons.items())))


def _compute_spread(values: FloatArray) -> Spread:
    sigma = float(values.std(ddof=1)) if len(values) > 1 else None
    return Spread(float(values.mean()), sigma, _compute_rms(values), float(np.abs(values).max()))


def _compute_rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@dataclass(frozen=True)
class Limits:
    """Limits of the figures; None for no limit.

    max_horizontal_m, max_height_m  rms of the errors along and across; of the height
    min_solved  solved frames: how many (int), or the share of all (float, 0 to 1)
    max_nees    mean of the error squared over its covariance, a degree of freedom: 1 if honest
    max_wrong   solved frames whose error is beyond 5 stated sigmas
    """

    max_horizontal_m: float | None = None
    max_height_m: float | None = None
    min_solved: int | float | None = None
    max_nees: float | None = None
    max_wrong: int | None = None


class LimitCheck(NamedTuple):
    """A figure beside its limit; `words` say how it passes it."""

    name: str
    limit: float
    figure: float
    kept: bool
    words: str


def list_limit_checks(figures: Figures, limits: Limits) -> list[LimitCheck]:
    """List the limits that are set, with figures; without a solved frame just min_solved."""
    return [
        *_check_solved(figures, limits),
        *(_check_errors(figures, limits) if figures.solved else ()),
    ]


def check_limits(figures: Figures, limits: Limits) -> None:
    """Raise DifferenceError naming the figures that pass their limits."""
    passed = [check.words for check in list_limit_checks(figures, limits) if not check.kept]
    if passed:
        raise DifferenceError("; ".join(passed))


def _check_solved(figures: Figures, limits: Limits) -> Iterator[LimitCheck]:
    limit = limits.min_solved
    if limit is None:
        return
    share = isinstance(limit, float)
    figure = figures.solved / max(figures.frames, 1) if share else figures.solved
    words, wanted = f"{figures.solved} of {figures.frames} frames are solved", f"{limit}"
    if share:
        percent, wanted = (f"{n} %" for n in format_distinct(100.0 * figure, 100.0 * limit, 1))
        words = f"{words} ({percent})"
    yield LimitCheck(
        "min_solved", limit, figure, figure >= limit, f"{words}, fewer than the limit of {wanted}"
    )


def _check_errors(figures: Figures, limits: Limits) -> Iterator[LimitCheck]:
    beyond = f"{figures.beyond_5_sigma} of {figures.solved} solved frames are off by more than "
    for name, figure, words in (
        ("max_horizontal_m", figures.horizontal_rms_m, "horizontal error {} (rms)"),
        ("max_height_m", figures.height_rms_m, "height error {} (rms)"),
        ("max_nees", figures.nees, "normalised error squared {}"),
        ("max_wrong", figures.beyond_5_sigma, f"{beyond}{BEYOND_SIGMAS:g} stated sigmas, which"),
    ):
        limit = getattr(limits, name)
        if limit is not None:
            metres = " m" if name.endswith("_m") else ""
            shown, most = format_length(figure) if metres else f"{figure:.3g}", f"{limit:g}{metres}"
            if abs(figure - limit) < 0.01 * limit:
                shown, most = (f"{n}{metres}" for n in format_distinct(figure, limit, 2))
            text = f"{words.format(shown)} passes the limit of {most}"
            # not >, so that a figure which is no number is reported
            yield LimitCheck(name, limit, figure, figure <= limit, text)
