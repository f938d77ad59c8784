"""The camera's place by construction: circles of equal angle, tori about pairs of points.

Source: the Vector-T procedure for pictures of the Earth from an orbit. Circles: a homography takes
the picture to a plane; the middle of the picture and two opposite points of a circle about it stand
on a line there, and the camera sees both halves under the same known angle. Tori: the camera sees
each of three pairs of points under a known angle. Both use less than all that the points say; they
stay as a check of the least squares, and for the study of what they cost.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError
from catalog.geometry.latlon import body_from_local, latlon_from_xyz, xyz_from_latlon
from catalog.geometry.vectors import unit
from optnav_cli.estimation.models.points import Pose
from optnav_cli.reasons import ReasonCode

MIN_CIRCLE_POINTS, MIN_TORUS_POINTS = 4, 3
CIRCLE_STEPS = 720
MAX_ROUNDS = 12
MAX_NEWTON = 50
SETTLED = 1e-9  # of the distance
STEP = 0.2  # of a sigma, for derivatives

CircleGround = Literal["map", "flat", "tangent"]


@dataclass(frozen=True, eq=False)
class Picks:
    """Picked points: places (n, 3), m, and image points (n, 2) of the plane at distance 1.

    half_side  tangent of the angle from the middle to the nearer side of the picture
    """

    places_m: FloatArray
    image: FloatArray
    half_side: float


def fit_homography(image: FloatArray, plane: FloatArray) -> FloatArray:
    """Fit the matrix (3, 3) that takes points (n, 2) to points (n, 2) of a plane; n is 4 or more.

    By the singular vector of the 2n x 9 system of Hartley and Zisserman (2004), ch. 4, in
    coordinates of unit size.
    """
    (a, from_image), (b, from_plane) = _normalise_points(image), _normalise_points(plane)
    homogeneous = np.column_stack([a, np.ones(len(a))])
    zero = np.zeros_like(homogeneous)
    rows = np.concatenate(
        [
            np.hstack([homogeneous, zero, -homogeneous * b[:, :1]]),
            np.hstack([zero, homogeneous, -homogeneous * b[:, 1:]]),
        ]
    )
    matrix: FloatArray = np.linalg.inv(from_plane) @ np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return matrix @ from_image


def apply_homography(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Project points (n, 2) by a homography."""
    projected = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    points_plane: FloatArray = projected[:, :2] / projected[:, 2:]
    return points_plane


def locate_by_circles(picks: Picks, ground: CircleGround = "tangent") -> FloatArray:
    """Locate the camera (3,), m, by two circles in the plane of the main vertical.

    ground  map: latitude and longitude are the map; the ends of the chords are put on the sphere,
            and the plane is that of the far ones and the local vertical, as the source prints it;
            flat: the points' east and north are a map, the body's curvature is left out;
            tangent: points are moved to the tangent plane along lines of sight, in rounds

    Raises NoSolutionError for fewer than four points and where the circles do not meet above.
    """
    if len(picks.image) < MIN_CIRCLE_POINTS:
        text = f"circles need {MIN_CIRCLE_POINTS} points; there are {len(picks.image)}"
        raise NoSolutionError(text, ReasonCode.FEW_POINTS)
    if ground == "map":
        return _locate_on_map(picks)
    base = picks.places_m.mean(axis=0)
    lat, lon, _ = latlon_from_xyz(base)
    axes = body_from_local(float(lat), float(lon))
    local = (picks.places_m - base) @ axes
    camera = _locate_above_plane(fit_homography(picks.image, local[:, :2]), picks.half_side)
    if ground == "tangent":
        for _ in range(MAX_ROUNDS):
            share = local[:, 2] / (camera[2] - local[:, 2])
            flat = local + (local - camera) * share[:, None]
            last = camera
            camera = _locate_above_plane(fit_homography(picks.image, flat[:, :2]), picks.half_side)
            if np.linalg.norm(camera - last) < SETTLED * np.linalg.norm(camera):
                break
    position: FloatArray = base + axes @ camera
    return position


def _locate_on_map(picks: Picks) -> FloatArray:
    """Locate the camera (3,) where a homography leads to latitude and longitude.

    The ground bulges by 50 m in a narrow picture from 420 km, and the map does not: without any
    other error the place is 4 km off horizontally and 16 km in height.
    """
    lat, lon, radius = latlon_from_xyz(picks.places_m)
    middle = float(np.angle(np.exp(1j * lon).mean()))
    lon_offsets = np.angle(np.exp(1j * (lon - middle)))
    matrix = fit_homography(picks.image, np.column_stack([lat, lon_offsets]))

    def project_to_ground(image: FloatArray) -> FloatArray:
        north, east = apply_homography(matrix, image).T
        return xyz_from_latlon(north, east + middle, np.full(len(image), radius.mean()))

    under = project_to_ground(np.zeros((1, 2)))[0]
    angle = np.linspace(0.0, 2.0 * np.pi, CIRCLE_STEPS, endpoint=False)
    circle = picks.half_side * np.column_stack([np.cos(angle), np.sin(angle)])
    ground = project_to_ground(circle)
    top = int(np.argmax(np.linalg.norm(ground - under, axis=1)))
    far, near = ground[top], ground[(top + CIRCLE_STEPS // 2) % CIRCLE_STEPS]
    along = unit(far - near)
    up = unit(under - (under @ along) * along)
    axes = np.array([along, up])
    a, b, c = ((point - under) @ axes.T for point in (far, under, near))
    centres = np.array(
        [_find_circle_centre(a, b, picks.half_side), _find_circle_centre(b, c, picks.half_side)]
    )
    line = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    foot = centres[0] + ((b - centres[0]) @ line) * line
    position: FloatArray = under + (2.0 * foot - b) @ axes
    return position


def _find_circle_centre(first: FloatArray, second: FloatArray, half_side: float) -> FloatArray:
    """Find the centre (2,) of the circle from which a chord is seen under atan(half_side)."""
    chord = second - first
    normal = np.array([-chord[1], chord[0]])
    normal = normal if normal[1] > 0.0 else -normal
    # of length |chord|, so that the distance is |chord| / (2 tan alpha)
    centre: FloatArray = 0.5 * (first + second) + normal / (2.0 * half_side)
    return centre


def locate_by_tori(picks: Picks, start_m: FloatArray) -> FloatArray:
    """Locate the camera (3,), m, by the angles between the three points that stand widest.

    Newton's method from a start (3,), to the nearest of up to four places.
    Raises NoSolutionError for fewer than three points and where it does not settle.
    """
    if len(picks.image) < MIN_TORUS_POINTS:
        text = f"tori need {MIN_TORUS_POINTS} points; there are {len(picks.image)}"
        raise NoSolutionError(text, ReasonCode.FEW_POINTS)
    some = list(_choose_widest_three(picks.image))
    rays = np.column_stack([picks.image[some], np.ones(3)])
    angles = _compute_angles(rays)
    places, camera = picks.places_m[some], start_m
    for _ in range(MAX_NEWTON):
        seen, by_place = _linearise_angles(places, camera)
        try:
            step = np.linalg.solve(by_place, angles - seen)
        except np.linalg.LinAlgError:
            break
        # far from the solution a full step may leave the sky
        reach = 0.3 * float(np.linalg.norm(camera - places[0]))
        size = float(np.linalg.norm(step))
        camera = camera + step * min(1.0, reach / max(size, 1e-12))
        if size < SETTLED * np.linalg.norm(camera - places[0]):
            return camera
    raise NoSolutionError("the tori do not meet near the start", ReasonCode.NOT_SETTLED)


def propagate_covariance(
    construct: Callable[[Picks], FloatArray],
    picks: Picks,
    sigma_image: FloatArray,
    sigma_m: FloatArray,
    lens: tuple[float, float],
) -> FloatArray:
    """Propagate errors of picks and lens to the covariance (3, 3), m^2, of a constructed place.

    sigma_image, sigma_m  (n,) of the points in the plane at distance 1, and of the places
    lens                  relative error of the focal length; of the principal point, as sigma_image
    """
    middle = construct(picks)
    moved: list[FloatArray] = []
    for number in range(len(picks.image)):
        for axis in range(2):
            image = picks.image.copy()
            image[number, axis] += STEP * sigma_image[number]
            moved.append(construct(replace(picks, image=image)) - middle)
        for axis in range(3 if sigma_m[number] > 0.0 else 0):
            places = picks.places_m.copy()
            places[number, axis] += STEP * sigma_m[number]
            moved.append(construct(replace(picks, places_m=places)) - middle)
    focal, centre = lens
    if focal > 0.0:
        factor = 1.0 + STEP * focal
        longer = replace(picks, image=picks.image / factor, half_side=picks.half_side / factor)
        moved.append(construct(longer) - middle)
    for axis in range(2 if centre > 0.0 else 0):
        image = picks.image.copy()
        image[:, axis] += STEP * centre
        moved.append(construct(replace(picks, image=image)) - middle)
    columns = np.array(moved) / STEP
    return columns.T @ columns


def fit_attitude_at(place_m: FloatArray, picks: Picks) -> Pose:
    """Fit the attitude from which a camera at a place (3,) sees the points best."""
    rays = np.column_stack([picks.image, np.ones(len(picks.image))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    sights = picks.places_m - place_m
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    turn, _ = Rotation.align_vectors(rays, sights)
    return Pose(place_m, turn)


def _locate_above_plane(matrix: FloatArray, half_side: float) -> FloatArray:
    """Locate the camera (3,) over the plane: east, north and up of its origin."""
    angle = np.linspace(0.0, 2.0 * np.pi, CIRCLE_STEPS, endpoint=False)
    circle = half_side * np.column_stack([np.cos(angle), np.sin(angle)])
    middle = apply_homography(matrix, np.zeros((1, 2)))[0]
    distances = np.linalg.norm(apply_homography(matrix, circle) - middle, axis=1)
    top = int(np.argmax(distances))
    before, highest, after = distances[top - 1], distances[top], distances[(top + 1) % CIRCLE_STEPS]
    # between steps by a parabola: a quarter of a degree here turns the camera by a kilometre
    bend = before - 2.0 * highest + after
    share = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    direction = angle[top] + share * (angle[1] - angle[0])
    ends = half_side * np.array([np.cos(direction), np.sin(direction)])
    far, near = apply_homography(matrix, np.array([ends, -ends]))
    along = (far - middle) / np.linalg.norm(far - middle)
    alpha = np.arctan(half_side)
    # with the middle as origin: both chords begin there, so both circles go through it
    chords = float((far - middle) @ along), float((near - middle) @ along)
    if not chords[1] < 0.0 < chords[0]:
        raise NoSolutionError("the picture looks past the ground", ReasonCode.NO_SOLUTION)
    centres = np.array([(chord / 2.0, abs(chord) / (2.0 * np.tan(alpha))) for chord in chords])
    line = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    foot = centres[0] - (centres[0] @ line) * line
    x, up = 2.0 * foot  # the origin mirrored in the line of centres
    return np.array([*(middle + x * along), up])


def _normalise_points(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Move points (n, 2) to their mean, scale them to unit size; return also the matrix of that."""
    middle = points.mean(axis=0)
    scale = 1.0 / float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean() / 2.0))
    matrix = np.diag([scale, scale, 1.0])
    matrix[:2, 2] = -scale * middle
    return (points - middle) * scale, matrix


def _choose_widest_three(image: FloatArray) -> tuple[int, int, int]:
    """Choose the three outer points whose triangle is largest, by index."""
    out = np.linalg.norm(image - image.mean(axis=0), axis=1)
    outer = sorted(int(i) for i in np.argsort(-out)[:12])

    def area(three: tuple[int, ...]) -> float:
        (ax, ay), (bx, by) = image[three[1]] - image[three[0]], image[three[2]] - image[three[0]]
        return abs(float(ax * by - ay * bx))

    a, b, c = max(combinations(outer, 3), key=area)
    return a, b, c


def _compute_angles(rays: FloatArray) -> FloatArray:
    """Compute the angles (3,) between three rays (3, 3): first two, last two, outer two."""
    others = np.roll(rays, -1, axis=0)
    crossed = np.linalg.norm(np.cross(rays, others), axis=1)
    angles: FloatArray = np.arctan2(crossed, (rays * others).sum(axis=1))
    return angles


def _linearise_angles(places_m: FloatArray, camera_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the angles between places (3, 3) from a camera; derivatives (3, 3) by its place."""
    sights = places_m - camera_m
    distances = np.linalg.norm(sights, axis=1, keepdims=True)
    rays = sights / distances
    angles = _compute_angles(rays)
    others, far = np.roll(rays, -1, axis=0), np.roll(distances, -1, axis=0)
    cosine = np.cos(angles)[:, None]
    by_cosine = -(others - cosine * rays) / distances - (rays - cosine * others) / far
    return angles, -by_cosine / np.sin(angles)[:, None]
