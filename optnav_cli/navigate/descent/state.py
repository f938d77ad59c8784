"""The joint filter with what its ground points are: windows of the terrain model and landmarks.

A window's error is that of its ground (`descent_errors`), so one that joins the state is tied to
those that are in it; else many windows of the same ground would count as so many measurements.
What all windows of a level have in common is a point of the state itself: it stays when its
windows have left.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray, IndexArray
from catalog.geometry.rotations import ARCSEC
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.point_match import PointMatch
from optnav_cli.estimation.models.points import Pose, Sightings, predict
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.navigate.descent.errors import (
    DescentErrorSizes,
    WindowError,
    WindowSpread,
    correlate_errors,
    is_common,
    load_descent_sizes,
    make_common_error,
    make_common_key,
)
from optnav_cli.navigate.descent.filter import GATE, DescentFilter, TrackErrors, Update
from optnav_cli.navigate.descent.windows import Window, WindowKey


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
        self,
        keys: Sequence[WindowKey | int],
        errors: Sequence[WindowError],
        spread: WindowSpread,
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
        """Marginalise all ground points but some, and what windows have in common."""
        kept = kept | {key for key in self._errors if is_common(key)}
        self.filter.keep(np.array([key in kept for key in self.keys], dtype=bool))
        self.keys = [key for key in self.keys if key in kept]
        self._errors = {key: error for key, error in self._errors.items() if key in kept}

    def compute_fresh_covariance_px2(self, match: PointMatch, scale: float) -> FloatArray:
        """Compute (2, 2) of a window's match that is new in each frame; scale: `WindowSpread`."""
        fresh: FloatArray = self.sizes.fresh_px**2 * np.eye(2)
        if match.covariance_px2 is not None:
            fresh = fresh + scale * self.sizes.fresh_share * match.covariance_px2
        return fresh

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
