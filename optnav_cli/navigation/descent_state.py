"""The joint filter with what its ground points are: windows of the terrain model and landmarks.

A window's error is that of its ground: the mean of a random field over its square, and a part that
all ground of a descent has in common, by the low Sun. So two windows err alike as far as they share
ground, and one that joins the state is tied to those that are in it; else many windows of the same
ground would count as so many measurements. The common part is a point of the state itself, COMMON:
it stays when its windows have left. The sizes are fitted numbers, in FILE (`optnav study fit`).
How far a model is wrong besides is learned from its windows as they join: `WindowSpread`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import msgspec
import numpy as np

from catalog.arrays import FloatArray, IndexArray
from catalog.config import Positive, load_toml, resource
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.descent_filter import GATE, DescentFilter, TrackErrors, Update
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.matching.point_match import PointMatch
from optnav_cli.navigation.descent_windows import OVERSAMPLED, SIDE, Window, WindowKey, overlap

MIN_SUN = np.radians(8.0)  # below it shadows fill the picture and the cotangent runs away
FILE = "configs/models/descent.toml"
# Degrees of freedom that stand for the sizes being right, and how far from it a model may be. One
# window that is matched wrongly counts for no more than the gate of the filter lets pass.
SIZES_DEGREES, MAX_SCALE, MAX_SQUARE = 20.0, 6.0, GATE
# No window: what all windows have in common, in units of their own sigmas.
COMMON = WindowKey(-1, 0, 0, 0)
Share = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]


class DescentErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All fitted numbers of FILE, which says what each is."""

    own_postings: Positive
    slope_postings: Positive
    remainder: Positive
    common: Share
    sunward_postings: Positive
    height_postings: Positive
    fresh_px: Positive
    fresh_share: Share
    landmark_px: Positive
    landmark_shift: Positive
    landmark_height_postings: Positive


@cache
def shipped_sizes() -> DescentErrorSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), DescentErrorSizes)


@dataclass(frozen=True, eq=False)
class Sighting:
    """A ground point of the state in a frame: a window's key or a landmark's number."""

    key: WindowKey | int
    pixel: FloatArray
    covariance_px2: FloatArray


@dataclass(frozen=True, eq=False)
class WindowError:
    """What a window's ground may be off by: (3, 3) root of its covariance, m, body frame."""

    key: WindowKey
    root_m: FloatArray


@dataclass(frozen=True, eq=False)
class WindowGround:
    """What the error of a window's ground follows from.

    axes     (3, 3) east, north, up as columns, body frame
    slope    rms of its heights' slopes;  left_m2 mean variance that its first match leaves over
    """

    key: WindowKey
    axes: FloatArray
    posting_m: float
    slope: float
    left_m2: float

    def error(self, sizes: DescentErrorSizes, scale: float = 1.0) -> WindowError:
        """Its error by some sizes; scale multiplies the level variance, see `WindowSpread`."""
        own = sizes.own_postings * SIDE / self.key.side, sizes.slope_postings * self.slope
        own_m = float(np.hypot(*own)) * self.posting_m
        variance = own_m**2 + sizes.remainder * self.left_m2
        level = float(np.sqrt(scale * variance))
        sigmas = np.array([level, level, sizes.height_postings * self.posting_m])
        return WindowError(self.key, self.axes * sigmas @ self.axes.T)


def window_ground(window: Window, match: PointMatch, by_position: FloatArray) -> WindowGround:
    """What is known of a window's ground when it is first matched.

    by_position (2, 3) derivative of its pixel by the camera's position
    """
    axes = body_from_local(*(float(v) for v in latlon_from_xyz(window.place_m)[:2]))
    left = np.zeros((2, 2))
    if match.covariance_px2 is not None:
        inverse = np.linalg.pinv(by_position @ axes[:, :2])
        left = inverse @ match.covariance_px2 @ inverse.T
    side, posting = window.key.side, window.posting_m
    slope = 0.0
    if window.reference is not None:
        heights = window.reference.heights(0, OVERSAMPLED * side).astype(np.float64)
        down, across = np.gradient(heights, posting / OVERSAMPLED)
        slope = float(np.sqrt(np.nanmean(down**2 + across**2)))
    return WindowGround(window.key, axes, posting, slope, 0.5 * float(np.trace(left)))


@dataclass(frozen=True)
class WindowSpread:
    """How far windows are off, over what the sizes say: the variance of unit weight of a descent.

    A model may be worse than those that the sizes were fitted with, and nobody says so. Its
    windows then contradict each other, and the track, by more than they should.

    squares  sum of the squares of windows that joined, in units of their errors by the sizes
    count    of these windows, each with two degrees of freedom
    """

    squares: float = 0.0
    count: int = 0

    @property
    def scale(self) -> float:
        """What the variance of a window's place is multiplied by: 1 or more."""
        found = (SIZES_DEGREES + self.squares) / (SIZES_DEGREES + 2.0 * self.count)
        return float(np.clip(found, 1.0, MAX_SCALE))

    def with_windows(self, squares: FloatArray, scale: float) -> "WindowSpread":
        """With more windows (n,), whose squares were taken with a scale."""
        added = scale * float(np.minimum(squares, MAX_SQUARE).sum())
        return WindowSpread(self.squares + added, self.count + len(squares))


def tied_errors(
    some: Sequence[WindowError], others: Sequence[WindowError], common: float
) -> FloatArray:
    """Covariance (3 k, 3 n) of the errors of windows with those of others, m^2.

    common  share of the variance that all have in common
    """
    ties = np.empty((len(some), len(others)))
    for i, one in enumerate(some):
        for j, other in enumerate(others):
            if one.key == other.key:
                ties[i, j] = 1.0 + (0.0 if one.key == COMMON else 1e-6)
            elif COMMON in (one.key, other.key):
                ties[i, j] = np.sqrt(common)
            else:
                ties[i, j] = common + (1.0 - common) * overlap(one.key, other.key)
    left, right = (np.array([each.root_m for each in own]) for own in (some, others))
    blocks = np.einsum("ij,iab,jcb->iajc", ties, left, right)
    return np.asarray(blocks.reshape(3 * len(some), 3 * len(others)), dtype=np.float64)


def track_sigmas(settings: InertialSettings) -> TrackErrors:
    """[inertial] in SI units."""
    return TrackErrors(
        settings.position_sigma_m,
        settings.velocity_sigma_m_s,
        settings.acceleration_sigma_m_s2,
        settings.attitude_sigma_arcsec * ARCSEC,
        settings.attitude_drift_arcsec_s * ARCSEC,
        settings.attitude_noise_arcsec * ARCSEC,
    )


class JointState:
    """The filter of a descent, and which ground point is what."""

    def __init__(self, errors: TrackErrors, sizes: DescentErrorSizes | None = None) -> None:
        self.filter = DescentFilter(errors)
        self.sizes = sizes or shipped_sizes()
        self.spread = WindowSpread()
        self.keys: list[WindowKey | int] = [COMMON]
        self._errors = {COMMON: WindowError(COMMON, np.eye(3))}
        self.filter.add_points(np.zeros((1, 3)), np.eye(3))

    def copy(self) -> "JointState":
        """The same, to try an update on."""
        other = object.__new__(JointState)
        other.filter, other.sizes, other.spread = self.filter.copy(), self.sizes, self.spread
        other.keys, other._errors = list(self.keys), dict(self._errors)
        return other

    @property
    def windows(self) -> list[WindowKey]:
        """The windows in the state."""
        return [key for key in self.keys if isinstance(key, WindowKey) and key != COMMON]

    def place_m(self, key: WindowKey | int) -> FloatArray | None:
        """(3,) where a ground point of the state is by now; None for one that is not in it."""
        return self.filter.places_m[self.keys.index(key)] if key in self.keys else None

    @property
    def roots_m(self) -> list[FloatArray]:
        """(3, 3) of the errors of the windows in the state, and of COMMON, in the order of keys."""
        return [self._errors[key].root_m for key in self.keys if isinstance(key, WindowKey)]

    def restore(
        self,
        keys: Sequence[WindowKey | int],
        roots_m: Sequence[FloatArray],
        spread: WindowSpread,
    ) -> None:
        """Name the points of a restored filter, those of windows with the roots of their errors."""
        self.spread = spread
        windows = [key for key in keys if isinstance(key, WindowKey)]
        pairs = zip(windows, roots_m, strict=True)
        self.keys, self._errors = list(keys), {key: WindowError(key, root) for key, root in pairs}

    def join_windows(self, errors: Sequence[WindowError], places_m: FloatArray) -> None:
        """Add windows at places (k, 3), their errors tied to those that share ground with them."""
        known = [number for number, key in enumerate(self.keys) if isinstance(key, WindowKey)]
        old = [self._errors[key] for key in self.keys if isinstance(key, WindowKey)]
        common = self.sizes.common
        by_state = np.zeros((3 * len(errors), len(self.filter.state)))
        first = len(self.filter.state) - 3 * self.filter.count
        columns = (first + 3 * np.array(known)[:, None] + np.arange(3)).ravel()
        across = tied_errors(errors, old, common)
        gain = np.linalg.solve(tied_errors(old, old, common), across.T).T
        by_state[:, columns] = gain
        of_new = tied_errors(errors, errors, common) - gain @ across.T
        mean = gain @ self.filter.state[columns]
        numbers = self.filter.add_points(places_m, 0.5 * (of_new + of_new.T), by_state)
        self.filter.add_offsets(numbers, mean.reshape(-1, 3))
        self.keys += [error.key for error in errors]
        self._errors |= {error.key: error for error in errors}

    def add_landmarks(
        self,
        numbers: Sequence[int],
        camera: Camera,
        stated: Pose,
        places_m: FloatArray,
        covariances_px2: FloatArray,
        ground_sigma_m: float,
    ) -> None:
        """Add landmarks that a frame shows first, where their rays meet the ground (k, 3)."""
        sigmas = np.full(len(numbers), ground_sigma_m)
        self.filter.add_sighted(camera, stated, places_m, covariances_px2, sigmas)
        self.keys += numbers

    def update(self, camera: Camera, stated: Pose, seen: Sequence[Sighting]) -> Update:
        """Update by all sightings of a frame. Raises NoSolutionError, the filter as it was."""
        numbers: IndexArray = np.array([self.keys.index(one.key) for one in seen])
        pixels = np.array([one.pixel for one in seen])
        covariances = np.array([one.covariance_px2 for one in seen])
        places = self.filter.places_m[numbers]
        is_landmark = np.array([isinstance(one.key, int) for one in seen])
        # a shift of the camera moves all of them as what their patches have in common does
        pose = self.filter.pose(stated)
        distance = float(np.linalg.norm(places - pose.position_m, axis=1).mean())
        shared = predict(camera, pose, places)[1][:, :, :3] * is_landmark[:, None, None]
        shared = np.nan_to_num(self.sizes.landmark_shift * distance * shared)
        found = Sightings(places, pixels, covariances)
        return self.filter.update(camera, stated, numbers, found, shared)

    def keep(self, kept: set[WindowKey | int]) -> None:
        """Marginalise all ground points but some, and COMMON."""
        kept = kept | {COMMON}
        self.filter.keep(np.array([key in kept for key in self.keys], dtype=bool))
        self.keys = [key for key in self.keys if key in kept]
        self._errors = {key: error for key, error in self._errors.items() if key in kept}

    def fresh_covariance_px2(self, match: PointMatch) -> FloatArray:
        """(2, 2) of a window's match that another frame would not repeat."""
        fresh: FloatArray = self.sizes.fresh_px**2 * np.eye(2)
        if match.covariance_px2 is not None:
            fresh = fresh + self.sizes.fresh_share * match.covariance_px2
        return fresh

    def sunward_px(
        self, window: Window, by_position: FloatArray, sun_body: FloatArray
    ) -> FloatArray:
        """(2,) by how much a window is found away from the Sun, px; see `sunward_shift_px`."""
        shift = sunward_shift_px(window.place_m, window.posting_m, by_position, sun_body)
        return self.sizes.sunward_postings * shift


def sunward_shift_px(
    place_m: FloatArray, posting_m: float, by_position: FloatArray, sun_body: FloatArray
) -> FloatArray:
    """(2,) of a posting times the cotangent of the Sun's elevation away from the Sun, px.

    by_position (2, 3) derivative of a pixel at place_m (3,) by the camera's position
    """
    up = unit(place_m)
    sine = float(np.clip(sun_body @ up, np.sin(MIN_SUN), 1.0))
    level = sun_body - (sun_body @ up) * up
    length = float(np.linalg.norm(level))
    if length < 1e-6:
        return np.zeros(2)
    # the ground moves a pixel as the camera does the other way
    size = posting_m * np.sqrt(1.0 - sine**2) / sine
    moved: FloatArray = by_position @ (level / length) * size
    return moved
