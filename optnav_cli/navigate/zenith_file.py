"""zenith.csv of a run: zenith distances of stars from pictures with a limb and a known sky.

The limb tells where the body's centre lies, the stars how the camera is turned: both together are
the vertical against the stars. The body's rotation has no part in it, so its error is taken out
again of the covariances.
"""

from collections.abc import Sequence

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.stars import load_bright_stars
from catalog.errors import DataError
from catalog.geometry.vectors import unit
from optnav_cli.dynamics.forces import NEIGHBOURS
from optnav_cli.fix import Method, Solution
from optnav_cli.frames.folder import Folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.observation import FROM_FILE
from optnav_cli.orbit.fit.folder import stated_turn
from optnav_cli.orbit.fit.zenith import zenith_distances, zenith_row
from optnav_cli.stars.zenith_pair import SightPlace, choose_zenith_pair, list_navigation_stars

LIMB = (Method.HORIZON, Method.HORIZON_SPHERE)
STARS = "stars"
# Of the directions' second moment: below it the pictures do not tell the orbit's plane.
FLAT = 1e-4


def zenith_rows(folder: Folder, solutions: Sequence[Solution]) -> list[dict[str, object]]:
    """The rows of zenith.csv, in the order of time; none where no picture is fit for them.

    solutions  a row for each frame of the folder
    """
    seen = [
        (frame.tdb_s, frame, solution)
        for frame, solution in zip(folder.frames, solutions, strict=True)
        if frame.tdb_s is not None and _is_fit(folder, solution)
    ]
    seen.sort(key=lambda one: one[0])
    if not seen:
        return []
    places = np.array([_inertial(folder, solution, time)[0] for time, _, solution in seen])
    pole = _pole(places)
    catalog, numbers = load_bright_stars(), list_navigation_stars()
    rows: list[dict[str, object]] = []
    before: float | None = None
    for (time, frame, solution), place in zip(seen, places, strict=True):
        if time == before:
            continue  # a second picture of the same time: a star twice would be two measurements
        before = time
        directions = catalog.propagate(time)[numbers]
        where = SightPlace(
            place,
            folder.body.radius_m,
            folder.motion.sun_inertial(time),
            _neighbours(folder, time),
        )
        chosen = choose_zenith_pair(where, pole, directions)
        rows += _rows(frame, directions[chosen], _inertial(folder, solution, time))
    return rows


def _rows(
    frame: Frame, directions: FloatArray, place: tuple[FloatArray, FloatArray]
) -> list[dict[str, object]]:
    """Of the stars (n, 3) of a picture, by its place and covariance."""
    many = np.broadcast_to(place[0], directions.shape)
    values, slopes, _ = zenith_distances(many, directions)
    sigmas = np.sqrt(((slopes @ place[1]) * slopes).sum(axis=1))
    return [
        zenith_row(frame.utc, direction, float(value), float(sigma))
        for direction, value, sigma in zip(directions, values, sigmas, strict=True)
    ]


def _is_fit(folder: Folder, solution: Solution) -> bool:
    """Whether a picture has the limb and an attitude against the stars."""
    stated = folder.settings.attitude == "camera_from_inertial"
    known = solution.attitude_source == STARS or (stated and solution.attitude_source == FROM_FILE)
    return solution.solved and solution.method in LIMB and known


def _inertial(folder: Folder, solution: Solution, time: float) -> tuple[FloatArray, FloatArray]:
    """Place (3,), m, and covariance (3, 3) by the limb and the stars alone, inertial."""
    position, covariance = solution.position_m, solution.covariance_m2
    if position is None or covariance is None:
        raise DataError(f"{solution.file}: a solved row has no position")
    frame = folder.attitude.places
    turn = stated_turn(folder.motion, time)
    place = turn.T @ frame.transform_to_stated(position)
    whole = turn.T @ frame.transform_covariance_to_stated(covariance) @ turn
    # what the body's rotation added when the place was turned to the body's axes
    across = float(place @ place) * np.eye(3) - np.outer(place, place)
    rotation = (folder.motion.error_m(time) / folder.body.radius_m) ** 2
    own = whole - rotation * across
    values, axes = np.linalg.eigh(own)
    least = 1e-4 * float(np.linalg.eigvalsh(whole)[0])
    return place, (axes * np.maximum(values, least)) @ axes.T


def _pole(places: FloatArray) -> FloatArray:
    """(3,) of the plane of places (n, 3); of few or of one line the one nearest to the z axis."""
    ups = places / np.linalg.norm(places, axis=1, keepdims=True)
    moments, axes = np.linalg.eigh(ups.T @ ups / len(ups))
    if moments[1] > FLAT and moments[0] < 0.1 * moments[1]:
        normal: FloatArray = axes[:, 0]
        return normal
    east = np.cross((0.0, 0.0, 1.0), ups[0])
    return unit(np.cross(ups[0], east)) if np.linalg.norm(east) > 1e-6 else np.array([1.0, 0, 0])


def _neighbours(folder: Folder, time: float) -> FloatArray:
    """(n, 3) places of the bright bodies near this one."""
    body = folder.body
    names = [*NEIGHBOURS.get(body.name, ()), *([body.orbit.around] if body.orbit else [])]
    places = [folder.motion.position_m(name, time) for name in names]
    return np.array(places, np.float64).reshape(-1, 3)
