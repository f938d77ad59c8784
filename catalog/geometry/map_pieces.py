"""Lines and areas of a sphere as pieces of a map of longitude and latitude, cut at ±180 degrees.

Straight lines of the map take the place of great circles, so points are added until both agree. An
area that holds a pole goes on to the map's edge there.
"""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np

from catalog.arrays import BoolArray, FloatArray
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.vectors import unit

MAX_DEVIATION = 0.01  # of the map's straight line from the great circle, share of its length
MIN_DEVIATION = 1e-5  # rad: 17 m on the Moon, below which nothing is added
MAX_ROUNDS = 20  # each halves what deviates
MIN_AREA_DEG2 = 1e-12  # less is what rounding leaves along a cut

Follow = Callable[[float, float], FloatArray]


def split_line(directions: FloatArray) -> list[FloatArray]:
    """A line through directions (n, 3) of any length as lines (m, 2) of lon, lat in degrees."""
    lon_lat = _project_to_map(_refine_directions(directions, closed=False))
    turns = _count_turns(lon_lat[:, 0])
    pieces, current = [], [lon_lat[0]]
    for number, (start, end) in enumerate(pairwise(lon_lat)):
        turn, next_turn = turns[number : number + 2]
        if turn != next_turn:
            _, crossing = _find_crossing(start, end, turn, next_turn)
            pieces.append(np.array([*current, crossing]) - [360.0 * turn, 0.0])
            current = [crossing]
        current.append(end)
    pieces.append(np.array(current) - [360.0 * turns[-1], 0.0])
    return [piece for piece in pieces if np.ptp(piece, axis=0).any()]


def split_area(ring: FloatArray) -> list[FloatArray]:
    """An area as closed rings (m, 2) of lon, lat in degrees, counter-clockwise.

    ring  (n, 3) directions of any length around the area, which lies at the left of who walks on
          the sphere; the last is joined to the first. The area is less than half of the sphere.
    """
    lon_lat = _project_to_map(_refine_directions(ring, closed=True))
    corners = lon_lat[:-1]
    round_the_pole = lon_lat[-1, 0] - lon_lat[0, 0]
    if abs(round_the_pole) > 180.0:  # eastward with the area at the left: about the north pole
        corners = _extend_to_pole(lon_lat, math.copysign(360.0, round_the_pole))
    turns = _count_turns(corners[:, 0])
    pieces = []
    for turn in range(int(turns.min()), int(turns.max()) + 1):
        low = 360.0 * turn - 180.0
        for part in clip_ring(corners, corners[:, 0] - low, lambda p: -p[:, 1]):
            high = low + 360.0 - part[:, 0]
            pieces += [
                piece - [360.0 * turn, 0.0] for piece in clip_ring(part, high, _take_latitude)
            ]
    return [
        np.vstack([piece, piece[:1]]) for piece in pieces if _compute_area(piece) > MIN_AREA_DEG2
    ]


def _extend_to_pole(lon_lat: FloatArray, way_round: float) -> FloatArray:
    """A ring (n, 2) about a pole, its last point a turn from its first, with the way to the pole.

    It begins and ends at the map's edge, so that no seam is left inside of the map.
    """
    turns = _count_turns(lon_lat[:, 0])
    here = int(np.flatnonzero(np.diff(turns))[0])
    edge, crossing = _find_crossing(lon_lat[here], lon_lat[here + 1], turns[here], turns[here + 1])
    turned = lon_lat[1 : here + 1] + [way_round, 0.0]
    end, pole = edge + way_round, math.copysign(90.0, way_round)
    ring = [crossing], lon_lat[here + 1 :], turned, [[end, crossing[1]], [end, pole], [edge, pole]]
    return np.vstack(ring)


def _find_crossing(
    start: FloatArray, end: FloatArray, turn: float, next_turn: float
) -> tuple[float, FloatArray]:
    """Where a step crosses the map's edge: the longitude, and the point."""
    edge = 360.0 * max(turn, next_turn) - 180.0
    share = (edge - start[0]) / (end[0] - start[0])
    return edge, np.array([edge, start[1] + share * (end[1] - start[1])])


def clip_ring(
    ring: FloatArray,
    depth: FloatArray,
    along: Callable[[FloatArray], FloatArray],
    follow: Follow | None = None,
    period: float = 1e9,
) -> list[FloatArray]:
    """The parts of a ring inside a region whose border is one line, open or closed.

    ring    (n, 2) corners, counter-clockwise
    depth   (n,) how far inside the region they lie; 0 at its border, negative outside
    along   where points (m, 2) of the border lie along it, growing with the region at the left
    follow  points (k, 2) of the border after such a place, along it for a length but not at its
            end; none for a straight one
    period  after which a closed border begins again

    Returns rings (m, 2), counter-clockwise; the ring itself where all of it lies inside.
    """
    inside = depth > 0.0
    if inside.all():
        return [ring]
    chains = _collect_chains(ring, depth, inside)
    if not chains:
        return []
    entries = along(np.array([chain[0] for chain in chains]))
    exits = along(np.array([chain[-1] for chain in chains]))
    pieces, left = [], set(range(len(chains)))
    while left:
        first = number = min(left)
        parts: list[FloatArray] = []
        while number != first or not parts:
            left.discard(number)
            parts.append(chains[number])
            # along the border, at whose left the ring's inside lies, it comes in again next
            open_ends = sorted(left | {first})
            ahead = (entries[open_ends] - exits[number]) % period
            after = open_ends[int(np.argmin(ahead))]
            if follow is not None:
                parts.append(follow(float(exits[number]), float(ahead.min())))
            number = after
        pieces.append(np.concatenate(parts))
    return pieces


def _collect_chains(ring: FloatArray, depth: FloatArray, inside: BoolArray) -> list[FloatArray]:
    """The runs of corners inside, each from where the ring comes in to where it goes out."""
    order = (np.arange(len(ring)) + int(np.argmin(inside))) % len(ring)  # begin outside
    chains, current = [], []
    for here, there in zip(order, np.roll(order, -1)):
        if inside[here]:
            current.append(ring[here])
        if inside[here] != inside[there]:
            share = depth[here] / (depth[here] - depth[there])
            current.append(ring[here] + share * (ring[there] - ring[here]))
            if inside[here]:
                chains.append(np.array(current))
                current = []
    return chains


def _refine_directions(directions: FloatArray, closed: bool) -> FloatArray:
    """Unit vectors with more between them where the map's straight lines are off."""
    points = unit(directions)
    if closed:
        points = np.vstack([points, points[:1]])
    for _ in range(MAX_ROUNDS):
        start, end = points[:-1], points[1:]
        middle = start + end
        length = np.linalg.norm(middle, axis=1, keepdims=True)
        middle = np.where(length > 1e-9, middle / np.maximum(length, 1e-9), start)
        lat, lon, _ = latlon_from_xyz(points)
        step = (np.diff(lon) + np.pi) % (2.0 * np.pi) - np.pi
        on_map = xyz_from_latlon((lat[:-1] + lat[1:]) / 2.0, lon[:-1] + step / 2.0, 1.0)
        deviation = np.linalg.norm(on_map - middle, axis=1)
        allowed = MAX_DEVIATION * np.linalg.norm(end - start, axis=1)
        off = np.flatnonzero(deviation > np.maximum(allowed, MIN_DEVIATION))
        if not off.size:
            break
        points = np.insert(points, off + 1, middle[off], axis=0)
    return points


def _project_to_map(points: FloatArray) -> FloatArray:
    """Longitudes without jumps, and latitudes, of unit vectors (n, 3), degrees (n, 2)."""
    lat, lon, _ = latlon_from_xyz(points)
    return np.degrees(np.column_stack([np.unwrap(lon), lat]))


def _take_latitude(points: FloatArray) -> FloatArray:
    return points[:, 1]


def _count_turns(lon_deg: FloatArray) -> FloatArray:
    """Count the turns that longitudes (n,) lie east of -180 to 180 degrees."""
    return np.floor((lon_deg + 180.0) / 360.0)


def _compute_area(ring: FloatArray) -> float:
    """Area (deg^2) of a ring on the map, positive where it goes counter-clockwise."""
    x, y = ring.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2.0
