"""zenith.csv of a run: zenith distances of stars from pictures with a limb and a known sky.

The limb gives the direction to the body's centre, the stars the camera's attitude: together they
give the vertical against the stars. The body's rotation has no part in it, so its error is removed
from the covariances.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.stars import load_bright_stars
from catalog.errors import DataError
from catalog.geometry.vectors import unit
from optnav_cli.dynamics.forces import NEIGHBOURS
from optnav_cli.fix import Method, Solution
from optnav_cli.frames.folder import FROM_FILE, Folder
from optnav_cli.frames.frames import Frame
from optnav_cli.orbit.fit.folder import stated_turn
from optnav_cli.orbit.fit.zenith import zenith_distances, zenith_row

FAINTEST, POLARIS = 1.25, "Polaris"
# Between a star and the body's edge, the Sun, and another body: what their light spoils.
LIMB_DEG, SUN_DEG, NEIGHBOUR_DEG = 5.0, 30.0, 5.0
VERTICAL_DEG = 5.0  # a star in the zenith says little: the distance has no sign there


@cache
def list_navigation_stars() -> IntArray:
    """List the numbers of the 21 stars in `load_bright_stars`."""
    stars = load_bright_stars()
    bright = stars.magnitudes <= FAINTEST
    return np.flatnonzero(bright | (np.array(stars.names) == POLARIS)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class SightPlace:
    """Observer of stars, inertial axes.

    place_m     (3,) of the craft from the body's centre, whose radius is radius_m
    sun         (3,) towards the Sun;  neighbours_m  (n, 3) places of other bright bodies
    """

    place_m: FloatArray
    radius_m: float
    sun: FloatArray
    neighbours_m: FloatArray

    def find_visible(self, directions: FloatArray) -> BoolArray:
        """Find which stars (n, 3) may be looked at."""
        up, distance = unit(self.place_m), float(np.linalg.norm(self.place_m))
        edge = np.arcsin(min(self.radius_m / distance, 1.0)) + np.radians(LIMB_DEG)
        height = directions @ up
        seen: BoolArray = (height > -np.cos(edge)) & (height < np.cos(np.radians(VERTICAL_DEG)))
        seen &= directions @ unit(self.sun) < np.cos(np.radians(SUN_DEG))
        for neighbour in self.neighbours_m:
            there = unit(neighbour - self.place_m)
            seen &= directions @ there < np.cos(np.radians(NEIGHBOUR_DEG))
        return seen


def choose_zenith_pair(place: SightPlace, pole: FloatArray, directions: FloatArray) -> list[int]:
    """Choose the star nearest to an orbit's pole and that nearest to its plane, by number.

    pole        (3,) of the orbit, either way
    directions  (n, 3) of the stars to choose from

    Fewer than two where fewer are visible.
    """
    from_pole = np.abs(directions @ unit(pole))
    seen = np.flatnonzero(place.find_visible(directions))
    if not len(seen):
        return []
    chosen = [int(seen[np.argmax(from_pole[seen])])]
    others = seen[seen != chosen[0]]
    if len(others):
        chosen.append(int(others[np.argmin(from_pole[others])]))
    return chosen


def make_zenith_rows(folder: Folder, solutions: Sequence[Solution]) -> list[dict[str, object]]:
    """Make the rows of zenith.csv in the order of time; none where no picture is suitable.

    solutions  a row for each frame of the folder
    """
    seen = [
        (frame.tdb_s, frame, solution)
        for frame, solution in zip(folder.frames, solutions, strict=True)
        if frame.tdb_s is not None and _is_fit(folder, solution)
    ]
    seen.sort(key=lambda sight: sight[0])
    if not seen:
        return []
    places = np.array(
        [_convert_to_inertial(folder, solution, time)[0] for time, _, solution in seen]
    )
    pole = _find_pole(places)
    catalog, numbers = load_bright_stars(), list_navigation_stars()
    rows: list[dict[str, object]] = []
    before: float | None = None
    for (time, frame, solution), position in zip(seen, places, strict=True):
        if time == before:
            continue  # a second picture of the same time: a star twice would be two measurements
        before = time
        directions = catalog.propagate(time)[numbers]
        where = SightPlace(
            position,
            folder.body.radius_m,
            folder.motion.sun_inertial(time),
            _list_neighbours(folder, time),
        )
        chosen = choose_zenith_pair(where, pole, directions)
        rows += _make_rows(frame, directions[chosen], _convert_to_inertial(folder, solution, time))
    return rows


def _make_rows(
    frame: Frame, directions: FloatArray, fix: tuple[FloatArray, FloatArray]
) -> list[dict[str, object]]:
    """Make rows of the stars (n, 3) of a picture from its position and covariance."""
    many = np.broadcast_to(fix[0], directions.shape)
    values, slopes, _ = zenith_distances(many, directions)
    sigmas = np.sqrt(((slopes @ fix[1]) * slopes).sum(axis=1))
    return [
        zenith_row(frame.utc, direction, float(value), float(sigma))
        for direction, value, sigma in zip(directions, values, sigmas, strict=True)
    ]


def _is_fit(folder: Folder, solution: Solution) -> bool:
    """Whether a picture has the limb and an attitude against the stars."""
    stated = folder.settings.attitude == "camera_from_inertial"
    known = solution.attitude_source == "stars" or (
        stated and solution.attitude_source == FROM_FILE
    )
    return solution.solved and solution.method in (Method.HORIZON, Method.HORIZON_SPHERE) and known


def _convert_to_inertial(
    folder: Folder, solution: Solution, time: float
) -> tuple[FloatArray, FloatArray]:
    """Convert a fix to inertial axes: position (3,), m, and covariance of limb and stars alone."""
    position, covariance = solution.position_m, solution.covariance_m2
    if position is None or covariance is None:
        raise DataError(f"{solution.file}: a solved row has no position")
    frame = folder.attitude.places
    turn = stated_turn(folder.motion, time)
    position = turn.T @ frame.transform_to_stated(position)
    total = turn.T @ frame.transform_covariance_to_stated(covariance) @ turn
    # what the body's rotation added when the position was turned to the body's axes
    across = float(position @ position) * np.eye(3) - np.outer(position, position)
    rotation = (folder.motion.error_m(time) / folder.body.radius_m) ** 2
    limb_covariance = total - rotation * across
    values, axes = np.linalg.eigh(limb_covariance)
    least = 1e-4 * float(np.linalg.eigvalsh(total)[0])
    return position, (axes * np.maximum(values, least)) @ axes.T


def _find_pole(places: FloatArray) -> FloatArray:
    """Find the pole (3,) of the plane of positions (n, 3); if ambiguous, nearest to the z axis."""
    ups = places / np.linalg.norm(places, axis=1, keepdims=True)
    moments, axes = np.linalg.eigh(ups.T @ ups / len(ups))
    # Below a second moment of 1e-4 the pictures do not show the orbit's plane.
    if moments[1] > 1e-4 and moments[0] < 0.1 * moments[1]:
        normal: FloatArray = axes[:, 0]
        return normal
    east = np.cross((0.0, 0.0, 1.0), ups[0])
    return unit(np.cross(ups[0], east)) if np.linalg.norm(east) > 1e-6 else np.array([1.0, 0, 0])


def _list_neighbours(folder: Folder, time: float) -> FloatArray:
    """Return positions (n, 3) of the bright bodies near this one."""
    body = folder.body
    names = [*NEIGHBOURS.get(body.name, ()), *([body.orbit.around] if body.orbit else [])]
    places = [folder.motion.position_m(name, time) for name in names]
    return np.array(places, np.float64).reshape(-1, 3)
