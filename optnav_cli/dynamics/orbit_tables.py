"""How a body turns and where its neighbours stand over an arc, as polynomials for compiled loops.

Rotation and places are taken at fixed times, whole multiples of a spacing, and read between them
by polynomials of degree 5 through the six nearest: a state depends on its time alone, not on the
arc that it was asked with. Errors: 1e-6 m at the Moon's surface (900 s), 4 mm of Mars' place about
Phobos (a hundredth of its orbit).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import CENTURY_S, Ephemeris, Neighbour
from catalog.bodies.epochs import DAY_S
from catalog.errors import DataError, NoSolutionError
from catalog.geometry.kernel import kernel

MAX_SPACING_S, MIN_SPACING_S = 900.0, 10.0
NODES = 6
# Nodes about an interval from the middle outwards: those beyond the kernels' end are done without.
STENCILS = (-2, -1, -3, 0, -4, -5, 1)  # where the first node stands, in intervals
MAX_INTERVALS = 200_000  # 5 years at 900 s
TURN_SHARE, ORBIT_SHARE = 60.0, 100.0  # intervals a turn of the body, an orbit about its planet

Node = tuple[FloatArray, FloatArray]
Piece = tuple[FloatArray, FloatArray, FloatArray]


def spacing_s(body: Body) -> float:
    """Seconds between nodes: 900, less for a body that turns or circles its planet quickly."""
    degrees_a_day = abs(body.rotation.meridian_deg_by_day[1])
    spacing = MAX_SPACING_S
    if degrees_a_day > 0.0:
        spacing = min(spacing, 360.0 / degrees_a_day * DAY_S / TURN_SHARE)
    if body.orbit is not None:
        degrees = abs(body.orbit.mean_anomaly_deg_by_century[1])
        spacing = min(spacing, CENTURY_S * 360.0 / max(degrees, 1.0) / ORBIT_SHARE)
    return max(float(math.floor(spacing)), MIN_SPACING_S)


class ArcTables:
    """Rotation and neighbours of one body, kept for all arcs that are asked for."""

    def __init__(
        self, motion: Ephemeris, neighbours: list[Neighbour], field_from_body: FloatArray
    ) -> None:
        """field_from_body  (3, 3) rotation to the axes of the gravity field."""
        self._motion, self._neighbours = motion, neighbours
        self._field_from_body = field_from_body
        self.spacing_s = spacing_s(motion.body)
        self._nodes: dict[int, Node | DataError] = {}
        self._pieces: dict[int, Piece] = {}
        self._kept: tuple[int, int] | None = None  # intervals that stand together, end excluded
        self._together: Piece = (np.empty(0), np.empty(0), np.empty(0))

    def span(self, first_s: float, last_s: float) -> tuple[float, Piece]:
        """Cut the tables to a span of time, TDB s.

        Returns the start of the first interval, rotations (k, 3, 3) from inertial axes to the
        field's there, rotation vectors (k, 6, 3) from there on and places (k, 6, n, 3) of the
        neighbours, m, both as coefficients by powers of the share of the interval.
        Raises DataError for times that the ephemeris does not cover, NoSolutionError for years.
        """
        first = math.floor(first_s / self.spacing_s)
        last = math.floor(last_s / self.spacing_s) + 1
        if last - first > MAX_INTERVALS:
            raise NoSolutionError(
                f"the arc takes {(last_s - first_s) / DAY_S:.0f} days; wanted at most "
                f"{MAX_INTERVALS * self.spacing_s / DAY_S:.0f}"
            )
        kept = self._kept
        if kept is None or first < kept[0] or last > kept[1]:
            if kept is not None and first <= kept[1] and last >= kept[0]:
                first, last = min(first, kept[0]), max(last, kept[1])
            pieces = [self._piece(interval) for interval in range(first, last)]
            rotations, turns, places = (np.array(parts) for parts in zip(*pieces, strict=True))
            kept = self._kept = first, last
            self._together = rotations, turns, places
        return kept[0] * self.spacing_s, self._together

    def _piece(self, interval: int) -> Piece:
        """One interval's rotation at its start, rotation vectors and places."""
        if interval not in self._pieces:
            begin, nodes = self._stencil(interval)
            # the rotation that vectors count from: that of the start, or near it
            reference = nodes[max(-begin, 0)][0]
            vectors = Rotation.from_matrix([node[0] @ reference.T for node in nodes]).as_rotvec()
            powers = _POWERS[begin]
            self._pieces[interval] = (
                reference,
                _polynomial(powers, vectors),
                _polynomial(powers, np.array([node[1] for node in nodes])),
            )
        return self._pieces[interval]

    def _stencil(self, interval: int) -> tuple[int, list[Node]]:
        """Where the first of the nodes stands that an interval is read by, and the nodes."""
        failed: DataError | None = None
        for begin in STENCILS:
            nodes = [self._node(interval + begin + number) for number in range(NODES)]
            covered = [node for node in nodes if not isinstance(node, DataError)]
            if len(covered) == NODES:
                return begin, covered
            inner = self._node(interval)
            failed = inner if isinstance(inner, DataError) else failed
            failed = failed or next(node for node in nodes if isinstance(node, DataError))
        raise failed or DataError(f"{self._motion.name}: does not cover the arc")

    def _node(self, number: int) -> Node | DataError:
        if number not in self._nodes:
            try:
                self._nodes[number] = self._taken(number * self.spacing_s)
            except DataError as error:
                self._nodes[number] = error
        return self._nodes[number]

    def _taken(self, tdb_s: float) -> Node:
        rotation = self._field_from_body @ self._motion.body_from_inertial(tdb_s)
        places = [self._motion.position_m(name, tdb_s) for name in self._neighbours]
        return rotation, np.array(places, dtype=np.float64).reshape(-1, 3)


def _powers_from_values(begin: int) -> FloatArray:
    """Matrix (6, 6) that makes coefficients of a polynomial of its values at begin, begin + 1..."""
    nodes = np.arange(begin, begin + NODES, dtype=np.float64)
    return np.linalg.inv(np.vander(nodes, NODES, increasing=True)).astype(np.float64)


_POWERS = {begin: _powers_from_values(begin) for begin in STENCILS}


def _polynomial(powers: FloatArray, values: FloatArray) -> FloatArray:
    """Coefficients (6, ...) of values (6, ...), summed in one order whatever the shape."""
    out = np.zeros_like(values)
    for row in range(NODES):
        for column in range(NODES):
            out[row] += powers[row, column] * values[column]
    return out


class ArcWorld(NamedTuple):
    """All that moves a craft over an arc, as the kernels take it; times are seconds past its start.

    gm, radius_m                of the field
    pull_table, gradient_table  as `harmonic_tables` gives them
    start_s, spacing_s          of the tables below
    rotations, turns, places    as `ArcTables` gives them; the Sun is the last of the neighbours
    gms, radii_m                (n,) of the neighbours
    body_radius_m               of the shadow
    sunlight                    area over mass times reflectivity, m^2/kg
    sees_sunlight               whether its pressure is needed: it, or a derivative by it
    """

    gm: float
    radius_m: float
    pull_table: tuple[FloatArray, FloatArray]
    gradient_table: tuple[FloatArray, FloatArray]
    start_s: float
    spacing_s: float
    rotations: FloatArray
    turns: FloatArray
    places: FloatArray
    gms: FloatArray
    radii_m: FloatArray
    body_radius_m: float
    sunlight: float
    sees_sunlight: bool


@kernel
def interval_of(t: float, world: ArcWorld) -> tuple[int, float]:
    """Find the interval of the tables at a time, and the share of it that is past."""
    share = (t - world.start_s) / world.spacing_s
    interval = max(0, min(math.floor(share), world.rotations.shape[0] - 1))
    return interval, share - interval


@kernel
def _interpolated(coefficients: FloatArray, share: float, out: FloatArray) -> None:
    """Write a polynomial (6, n) at a share of its interval into `out` (n,)."""
    for i in range(out.shape[0]):
        total = coefficients[5, i]
        for power in range(4, -1, -1):
            total = total * share + coefficients[power, i]
        out[i] = total


@kernel
def _rotation(first: FloatArray, vector: FloatArray, out: FloatArray) -> None:
    """Write the rotation (3, 3) that a rotation vector (3,) makes of another (3, 3)."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-4:
        sine_factor, cosine_factor = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    else:
        sine_factor, cosine_factor = 1.0 - square / 6.0, 0.5 - square / 24.0
    for column in range(3):
        a, b, c = first[0, column], first[1, column], first[2, column]
        p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
        out[0, column] = a + sine_factor * p + cosine_factor * (y * r - z * q)
        out[1, column] = b + sine_factor * q + cosine_factor * (z * p - x * r)
        out[2, column] = c + sine_factor * r + cosine_factor * (x * q - y * p)


@kernel
def turned(
    state: FloatArray,
    share: float,
    interval: int,
    world: ArcWorld,
    turn: FloatArray,
    local: FloatArray,
) -> None:
    """Write the axes of the body (3, 3), and a state's place in them (3,)."""
    _interpolated(world.turns[interval], share, local)
    _rotation(world.rotations[interval], local, turn)
    for i in range(3):
        local[i] = turn[i, 0] * state[0] + turn[i, 1] * state[1] + turn[i, 2] * state[2]


@kernel
def neighbour(
    state: FloatArray,
    share: float,
    interval: int,
    number: int,
    world: ArcWorld,
    place: FloatArray,
    away: FloatArray,
) -> tuple[float, float]:
    """Write a neighbour's place, and the craft's from it; cubes of both distances."""
    _interpolated(world.places[interval][:, number], share, place)
    for i in range(3):
        away[i] = state[i] - place[i]
    far = place[0] ** 2 + place[1] ** 2 + place[2] ** 2
    near = away[0] ** 2 + away[1] ** 2 + away[2] ** 2
    return far * math.sqrt(far), near * math.sqrt(near)
