"""The joint filter with what its ground points are: windows of the terrain model and landmarks.

A window's error is that of its ground (`descent_errors`), so one that joins the state is tied to
those that are in it; else many windows of the same ground would count as so many measurements.
What all windows of a level have in common is a point of the state itself: it stays when its
windows have left.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
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
from optnav_cli.control_points.field import BAND_SIDES_M, NOT_STATED, StatedBands
from optnav_cli.control_points.point_match import PointMatch
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.navigate.descent.filter import GATE, DescentFilter, TrackErrors, Update
from optnav_cli.navigate.descent.windows import (
    SIDE,
    STEP,
    Window,
    WindowField,
    WindowKey,
    compute_overlaps,
)

FILE = "configs/models/descent.toml"
# Side of the ground about an altimeter's beam, postings: no window has an odd one. Points kept.
BEAM_SIDE, KEPT_BEAMS = SIDE - 1, 4
Share = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
# Scales that a descent may have, and how far from 1 one is before anything is known: the logarithm
# of its sigma. The windows of a single frame say more.
SCALES: FloatArray = np.geomspace(0.5, 64.0, 29)
# Windows scatter with longer tails than a Gaussian: as Student's distribution of so many degrees.
# What is matched wrongly is farther off than MAX_SQUARE, and counts as if it were so far.
TAIL_DEGREES, MAX_SQUARE = 8.0, 16.0


class DescentErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All fitted numbers of FILE, which says what each is."""

    own_postings: Positive
    remainder: Positive
    common: Share
    sunward_postings: Positive
    height_postings: Positive
    fresh_px: Positive
    fresh_share: Share
    landmark_px: Positive
    landmark_shift: Positive
    landmark_height_postings: Positive
    stated_shift: Positive
    stated_height: Positive
    stated_width: Positive
    stated_own: Positive
    altimeter_postings: Positive


@cache
def load_descent_sizes() -> DescentErrorSizes:
    """Load the sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), DescentErrorSizes)


@dataclass(frozen=True, eq=False)
class StatedRoots:
    """A window's error by the stated error of the terrain model, in bands of wavelength.

    roots_m    (k, 3, 3) symmetric roots of covariances, m, body frame
    lengths_m  (k,) along the ground, by which the likeness of a band's errors falls to 1/e
    place_m    (3,) of the window
    """

    roots_m: FloatArray
    lengths_m: FloatArray
    place_m: FloatArray


NO_ROOTS = StatedRoots(np.zeros((len(BAND_SIDES_M), 3, 3)), np.ones(len(BAND_SIDES_M)), np.zeros(3))


@dataclass(frozen=True, eq=False)
class WindowError:
    """Error of a window's ground as (3, 3) symmetric roots of covariances, m, body frame.

    common_m  of the covariance of what it has in common with all others of its level
    own_m     of that of the rest, which it shares as far as it shares ground
    stated    of that by the stated error of the terrain model, which neighbours share
    """

    key: WindowKey
    common_m: FloatArray
    own_m: FloatArray
    stated: StatedRoots = NO_ROOTS


@dataclass(frozen=True, eq=False)
class WindowGround:
    """Quantities that the error of a window's ground is computed from.

    axes      (3, 3) east, north, up as columns, body frame
    left_m2   (2, 2) what its first match leaves over, as ground east and north
    pixel_m2  (2, 2) of a pixel's sigma along both axes there, the same way
    stated    errors by the stated error of the terrain model
    place_m   (3,) of the window
    """

    key: WindowKey
    axes: FloatArray
    posting_m: float
    left_m2: FloatArray
    pixel_m2: FloatArray
    stated: StatedBands = NOT_STATED
    place_m: FloatArray = field(default_factory=lambda: np.zeros(3))

    def compute_error(self, sizes: DescentErrorSizes, scale: float = 1.0) -> WindowError:
        """Compute its error; scale multiplies the match's remainder: see `WindowSpread`."""
        sigma_m = sizes.own_postings * SIDE / self.key.side * self.posting_m
        high = sizes.height_postings * self.posting_m
        common = sizes.common * np.diag([sigma_m**2, sigma_m**2, high**2])
        ground_m2 = (1.0 - sizes.common) * np.diag([sigma_m**2, sigma_m**2, high**2])
        shift_m = sizes.stated_own * self.stated.measure_shift_m()
        ground_m2[:2, :2] += shift_m**2 * np.eye(2) + scale * sizes.remainder * self.left_m2
        values, vectors = np.linalg.eigh(ground_m2)
        roots = np.sqrt(common), vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        common_m, own_m = (self.axes @ root @ self.axes.T for root in roots)
        return WindowError(self.key, common_m, own_m, self._compute_stated_roots(sizes))

    def _compute_stated_roots(self, sizes: DescentErrorSizes) -> StatedRoots:
        """Compute the roots of the stated error, band by band."""
        bands = self.stated
        shift, height = (bands.sigmas_m * [sizes.stated_shift, sizes.stated_height]).T
        sigmas = np.stack([shift, shift, height], axis=1)
        roots = np.einsum("ia,ka,ja->kij", self.axes, sigmas, self.axes)
        return StatedRoots(roots, sizes.stated_width * bands.sides_m, self.place_m)

    def compute_level_m2(self, sizes: DescentErrorSizes) -> tuple[FloatArray, FloatArray]:
        """Compute (2, 2) of a match's error, east and north: constant and scaled part."""
        sigma_m = sizes.own_postings * SIDE / self.key.side * self.posting_m
        # the longest waves move all windows of a frame together
        bands_m = sizes.stated_shift * float(np.linalg.norm(self.stated.sigmas_m[:-1, 0]))
        shift_m = sizes.stated_own * self.stated.measure_shift_m()
        sigma_m = math.hypot(sigma_m, bands_m, shift_m)
        stays = sigma_m**2 * np.eye(2) + sizes.fresh_px**2 * self.pixel_m2
        return stays, (sizes.remainder + sizes.fresh_share) * self.left_m2


def make_window_ground(window: Window, match: PointMatch, by_position: FloatArray) -> WindowGround:
    """Describe a window's ground when it is first matched.

    by_position (2, 3) derivative of its pixel by the camera's position
    """
    axes = body_from_local(*(float(v) for v in latlon_from_xyz(window.place_m)[:2]))
    inverse = np.linalg.pinv(by_position @ axes[:, :2])
    left = np.zeros((2, 2))
    if match.covariance_px2 is not None:
        left = inverse @ match.covariance_px2 @ inverse.T
    size_m = window.key.side * window.posting_m
    stated = window.field.points.compute_stated_errors(window.place_m, size_m)
    pixel_m2 = inverse @ inverse.T
    return WindowGround(window.key, axes, window.posting_m, left, pixel_m2, stated, window.place_m)


@dataclass(frozen=True, eq=False)
class WindowSpread:
    """Scale of the windows' errors over their matches' remainders, learned during a descent.

    A model may be worse than those that the sizes were fitted with, and nobody says so. Its
    windows then contradict each other, and the track, by more than they should.

    likelihood  (n,) logarithm of that of the windows that joined, by SCALES
    count       of these windows
    """

    likelihood: FloatArray = field(default_factory=lambda: np.zeros(len(SCALES)))
    count: int = 0

    @property
    def scale(self) -> float:
        """The mean scale, in the logarithm."""
        logs = np.log(SCALES)
        # Before anything is known the logarithm of the scale has a sigma of log 4; the windows of a
        # single frame say more.
        chance = self.likelihood - 0.5 * (logs / np.log(4.0)) ** 2
        weights = np.exp(chance - chance.max())
        return float(np.exp(weights @ logs / weights.sum()))

    def add_windows(
        self,
        grounds: Sequence[WindowGround],
        squares: FloatArray,
        scale: float,
        sizes: DescentErrorSizes,
    ) -> "WindowSpread":
        """Add windows whose squares (n,), of two degrees, were taken with a scale."""
        if not grounds:
            return self
        stays, scaled = (
            np.array(parts)
            for parts in zip(*(ground.compute_level_m2(sizes) for ground in grounds), strict=True)
        )
        taken = stays + scale * scaled
        others = stays[:, None] + SCALES[:, None, None] * scaled[:, None]
        # a miss of any direction, on the mean
        shares = np.einsum("nsij,nji->ns", np.linalg.inv(others), taken) / 2.0
        wide = np.minimum(squares, MAX_SQUARE)[:, None] * shares
        each = 0.5 * np.log(np.linalg.det(others))
        each += 0.5 * (TAIL_DEGREES + 2.0) * np.log1p(wide / TAIL_DEGREES)
        return WindowSpread(self.likelihood - each.sum(axis=0), self.count + len(grounds))


def make_common_key(level: int) -> WindowKey:
    """Make the key of the error that all windows of a level share, in units of their sigmas."""
    return WindowKey(-1 - level, SIDE, 0, 0)


def is_common(key: WindowKey) -> bool:
    """Whether a key is one of `common_key`."""
    return key.level < 0


def make_common_error(level: int) -> WindowError:
    """Make the error that all windows of a level share."""
    return WindowError(make_common_key(level), np.eye(3), np.zeros((3, 3)))


def match_levels(some: Sequence[WindowKey], others: Sequence[WindowKey]) -> FloatArray:
    """Return (k, n) 1 where windows share the common error of a level, else 0."""
    levels, other_levels = (
        [-1 - k.level if is_common(k) else k.level for k in keys] for keys in (some, others)
    )
    return np.equal.outer(levels, other_levels).astype(np.float64)


def correlate_errors(some: Sequence[WindowError], others: Sequence[WindowError]) -> FloatArray:
    """Compute the covariance (3 k, 3 n) of windows' errors with those of others, m^2."""
    keys, other_keys = ([error.key for error in errors] for errors in (some, others))
    ties = compute_overlaps(keys, other_keys)
    ties += 1e-6 * np.array([[key == other for other in other_keys] for key in keys])
    common = (np.array([error.common_m for error in errors]) for errors in (some, others))
    blocks = np.einsum("ij,iab,jcb->iajc", match_levels(keys, other_keys), *common)
    rests = (np.array([error.own_m for error in errors]) for errors in (some, others))
    blocks = blocks + np.einsum("ij,iab,jcb->iajc", ties, *rests)
    stated = [[error.stated for error in errors] for errors in (some, others)]
    places, other_places = (np.array([each.place_m for each in roots]) for roots in stated)
    lengths = np.max([each.lengths_m for each in stated[0] + stated[1]], axis=0)
    apart = np.linalg.norm(places[:, None] - other_places, axis=2)
    ties = np.exp(-apart / lengths[:, None, None])
    bands = (np.array([each.roots_m for each in roots]) for roots in stated)
    blocks = blocks + np.einsum("kij,ikab,jkcb->iajc", ties, *bands, optimize=True)
    tied: FloatArray = blocks.reshape(3 * len(some), 3 * len(others))
    return tied


@dataclass(frozen=True, eq=False)
class Sighting:
    """A ground point of the state in a frame: a window's key or a landmark's number."""

    key: WindowKey | int
    pixel: FloatArray
    covariance_px2: FloatArray


def convert_track_errors(settings: InertialSettings) -> TrackErrors:
    """Convert [inertial] to SI units."""
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
        self.sizes = sizes or load_descent_sizes()
        self.spread = WindowSpread()
        self.keys: list[WindowKey | int] = []
        self._errors: dict[WindowKey, WindowError] = {}

    def copy(self) -> "JointState":
        """Copy the state, to try an update on."""
        other = object.__new__(JointState)
        other.filter, other.sizes, other.spread = self.filter.copy(), self.sizes, self.spread
        other.keys, other._errors = list(self.keys), dict(self._errors)
        return other

    @property
    def windows(self) -> list[WindowKey]:
        """The windows in the state."""
        return [key for key in self.keys if isinstance(key, WindowKey) and not is_common(key)]

    def place_m(self, key: WindowKey | int) -> FloatArray | None:
        """Return the position (3,) of a ground point of the state; None for one not in it."""
        return self.filter.places_m[self.keys.index(key)] if key in self.keys else None

    @property
    def errors(self) -> list[WindowError]:
        """Errors of the windows in the state and of what they share, in the order of keys."""
        return [self._errors[key] for key in self.keys if isinstance(key, WindowKey)]

    def restore(
        self, keys: Sequence[WindowKey | int], errors: Sequence[WindowError], spread: WindowSpread
    ) -> None:
        """Name the points of a restored filter, those of windows with their errors."""
        self.spread = spread
        self.keys, self._errors = list(keys), {error.key: error for error in errors}

    def join_windows(self, errors: Sequence[WindowError], places_m: FloatArray) -> None:
        """Add windows at places (k, 3), their errors tied to those that share ground with them."""
        for level in sorted({error.key.level for error in errors}):
            if make_common_key(level) not in self.keys:
                self.filter.add_points(np.zeros((1, 3)), np.eye(3))
                self.keys.append(make_common_key(level))
                self._errors[make_common_key(level)] = make_common_error(level)
        known = [number for number, key in enumerate(self.keys) if isinstance(key, WindowKey)]
        old = self.errors
        by_state = np.zeros((3 * len(errors), len(self.filter.state)))
        first = len(self.filter.state) - 3 * self.filter.count
        columns = (first + 3 * np.array(known)[:, None] + np.arange(3)).ravel()
        across = correlate_errors(errors, old)
        gain = np.linalg.solve(correlate_errors(old, old), across.T).T
        by_state[:, columns] = gain
        of_new = correlate_errors(errors, errors) - gain @ across.T
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

    def update(
        self, camera: Camera, stated: Pose, seen: Sequence[Sighting], gate: float = GATE
    ) -> Update:
        """Update by all sightings of a frame. Raises NoSolutionError, the filter as it was."""
        numbers: IndexArray = np.array([self.keys.index(sighting.key) for sighting in seen])
        pixels = np.array([sighting.pixel for sighting in seen])
        covariances = np.array([sighting.covariance_px2 for sighting in seen])
        places = self.filter.places_m[numbers]
        is_landmark = np.array([isinstance(sighting.key, int) for sighting in seen])
        # a shift of the camera moves all of them as what their patches have in common does
        pose = self.filter.pose(stated)
        distance = float(np.linalg.norm(places - pose.position_m, axis=1).mean())
        shared = predict(camera, pose, places)[1][:, :, :3] * is_landmark[:, None, None]
        shared = np.nan_to_num(self.sizes.landmark_shift * distance * shared)
        points = Sightings(places, pixels, covariances)
        return self.filter.update(camera, stated, numbers, points, shared, gate)

    def keep(self, kept: set[WindowKey | int]) -> None:
        """Marginalise all ground points but some, what windows share, and the last beams' ones."""
        kept = kept | {key for key in self._errors if is_common(key)}
        beams = [key for key in self._errors if key.side == BEAM_SIDE]
        kept |= set(beams[-KEPT_BEAMS:])
        self.filter.keep(np.array([key in kept for key in self.keys], dtype=bool))
        self.keys = [key for key in self.keys if key in kept]
        self._errors = {key: error for key, error in self._errors.items() if key in kept}

    def compute_fresh_covariance_px2(self, match: PointMatch, scale: float) -> FloatArray:
        """Compute (2, 2) of a window's match that is new in each frame; scale: `WindowSpread`."""
        fresh: FloatArray = self.sizes.fresh_px**2 * np.eye(2)
        if match.covariance_px2 is not None:
            fresh = fresh + scale * self.sizes.fresh_share * match.covariance_px2
        return fresh

    def join_beam(self, windows: WindowField, place_m: FloatArray) -> int:
        """Return the number of the ground point that an altimeter's beam meets at a place (3,).

        Its height errs as windows about it do. The last of such points stay, so that ranges to
        neighbouring ground are not taken for independent ones.
        """
        posting = windows.posting_m(0)
        col, row = (round(float(v) / (STEP * posting)) for v in windows.map.xy_from_xyz(place_m))
        key = WindowKey(0, BEAM_SIDE, row, col)
        if key not in self.keys:
            axes = body_from_local(*(float(v) for v in latlon_from_xyz(place_m)[:2]))
            stated = windows.points.compute_stated_errors(place_m, 0.0)
            none = np.zeros((2, 2))
            ground = WindowGround(key, axes, posting, none, none, stated, place_m)
            # the ground's own height, not that of features by which a window is recognised
            sizes = msgspec.structs.replace(self.sizes, stated_height=1.0)
            self.join_windows([ground.compute_error(sizes)], place_m[None])
        return self.keys.index(key)

    def compute_sunward_px(
        self, window: Window, by_position: FloatArray, sun_body: FloatArray
    ) -> FloatArray:
        """Compute (2,) the window's shift away from the Sun, px; see `compute_sunward_shift_px`."""
        shift = compute_sunward_shift_px(window.place_m, window.posting_m, by_position, sun_body)
        return self.sizes.sunward_postings * shift


def compute_sunward_shift_px(
    place_m: FloatArray, posting_m: float, by_position: FloatArray, sun_body: FloatArray
) -> FloatArray:
    """Compute (2,) a posting times the cotangent of the Sun's elevation, away from the Sun, px.

    by_position (2, 3) derivative of a pixel at place_m (3,) by the camera's position
    """
    up = unit(place_m)
    # Below 8 deg shadows fill the picture and the cotangent runs away.
    sine = float(np.clip(sun_body @ up, np.sin(np.radians(8.0)), 1.0))
    level = sun_body - (sun_body @ up) * up
    length = float(np.linalg.norm(level))
    if length < 1e-6:
        return np.zeros(2)
    # the ground moves a pixel as the camera does the other way
    size = posting_m * np.sqrt(1.0 - sine**2) / sine
    moved: FloatArray = by_position @ (level / length) * size
    return moved
