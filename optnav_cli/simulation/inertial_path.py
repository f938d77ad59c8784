"""Real paths: an orbit about a body in inertial space, and the approach to one from far away.

The body turns under the path by its motion (theory or SPICE kernels), the Sun stands where it does
at the date. Gravity is that of the navigator's predictions (point mass, J2, C22, tides), or of a
[flight] that of more degrees; what those leave out is added to a [flight] as noise of its known
size, so that no prediction is exact.
"""

from pathlib import Path
from typing import Annotated, NamedTuple, Self

import msgspec
import numpy as np
from msgspec import Meta
from scipy.integrate import solve_ivp

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import compute_tdb_s_after, utc_to_tdb_s
from catalog.config import Count, Seconds, Turn
from catalog.errors import ConfigError
from catalog.terrain.mesh.shape import Shape, load_shape
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.dynamics.orbit_settings import Degrees, ForcesSettings
from optnav_cli.simulation.scenario_base import ROUGHNESS, Epoch, ScenarioBase, ShapeScenario
from optnav_cli.simulation.sections import Distance, Inclination

States = tuple[FloatArray, FloatArray]

MAX_APPROACH_S = 20 * 86400.0
APPROACH_STEPS = 400  # places that times are found between: 1e-6 of the distance
RELATIVE = 1e-12
TOLERANCE = np.array([1e-3] * 3 + [1e-7] * 3)  # m and m/s: planets are 1e7 m away
LAYERS = 4  # masses from the centre to each face: the field at two radii is right to 1e-4
APART_S = 10.0  # places of the body that its velocity is found from
MAX_S = 5 * 86400.0
STEPS = 4000  # times that distances are looked up between: 1e-5 of them


class FlightSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One orbit in inertial space, moved by gravity alone, under the Sun of its date.

    lowest_km, highest_km  heights of its ends over the reference sphere
    inclination_deg        to the equator of the start
    node_deg               longitude on the body of the ascending node at the start
    lowest_at_deg          from the node to the lowest point, along the flight
    start_at_deg           from the node to where the first picture is taken
    degree                 of its gravity: 2, as the navigator predicts; orbits are fitted with 50
    rough_gravity          also what this degree leaves out, of its known size, by the seed
    """

    lowest_km: Distance
    highest_km: Distance
    inclination_deg: Inclination = 90.0
    node_deg: Turn = 0.0
    lowest_at_deg: Turn = 0.0
    start_at_deg: Turn = 0.0
    start_utc: str = "2026-01-01T00:00:00Z"
    frames: Count = 1
    spacing_s: Seconds = 60.0
    degree: Degrees = 2
    rough_gravity: bool = True


class TransferSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """An approach to the lowest point of a path that comes from far away.

    from_km, to_km   heights over the reference sphere of the first and the last, lowest picture
    excess_speed_km_s  speed against the body that the path would have far away from it
    frames           pictures at distances from the centre in even ratios
    inclination_deg, node_deg, lowest_at_deg  as in [flight], at the arrival
    """

    from_km: Distance = 100_000.0
    to_km: Distance = 100.0
    excess_speed_km_s: Annotated[float, Meta(ge=1e-3, le=100.0)] = 0.9
    inclination_deg: Inclination = 60.0
    node_deg: Turn = 0.0
    lowest_at_deg: Turn = 0.0
    arrival_utc: str = "2026-01-01T00:00:00Z"
    frames: Annotated[int, Meta(ge=2, le=100_000)] = 60


class InertialPath(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A real path in inertial space under the Sun of its date: one of the two."""

    flight: FlightSettings | None = None
    transfer: TransferSettings | None = None

    def check(self) -> None:
        super().check()
        flight, transfer = self.flight, self.transfer
        if flight is not None and transfer is not None:
            raise ConfigError("there are [flight] and [transfer]; give one of them")
        if flight is not None and flight.lowest_km > flight.highest_km:
            raise ConfigError(
                f"[flight] lowest_km is {flight.lowest_km:g}, above highest_km "
                f"{flight.highest_km:g}; exchange them"
            )
        if transfer is not None:
            _check_ends("transfer", transfer.from_km, transfer.to_km)

    def shortened(self, frames: int) -> Self:
        """A flight ends earlier, a transfer takes larger steps."""
        flight, transfer = self.flight, self.transfer
        if flight is not None:
            flight = msgspec.structs.replace(flight, frames=min(flight.frames, frames))
        if transfer is not None:
            fewer = min(transfer.frames, max(frames, 2))
            transfer = msgspec.structs.replace(transfer, frames=fewer)
        return msgspec.structs.replace(self, flight=flight, transfer=transfer)

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        """Raises ConfigError for a path that meets the body or comes from nearer than wanted."""
        if self.flight is not None:
            states = flight_states(self.flight, motion, self.seed)
        else:
            states = transfer_states(self.transfer or TransferSettings(), motion)
        return epochs_of(self, motion, states)


def _check_ends(section: str, from_km: float, to_km: float) -> None:
    if to_km >= from_km:
        raise ConfigError(
            f"[{section}] to_km is {to_km:g}, not below from_km {from_km:g}; the path comes from "
            "far and ends near"
        )


def epochs_of(scenario: ScenarioBase, motion: Ephemeris, states: States) -> list[Epoch]:
    """All times when pictures are taken, with the ship's place in the body-fixed frame.

    Raises ConfigError for a path that meets the body.
    """
    epochs: list[Epoch] = []
    stated = scenario.attitude.relative_to == "body"
    seed = next(iter(scenario.detail.seeds), None)
    for number, (tdb_s, state) in enumerate(zip(*states, strict=True)):
        body_from_inertial = motion.body_from_inertial(float(tdb_s))
        position, velocity = (body_from_inertial @ v for v in (state[:3], state[3:]))
        up = position / np.linalg.norm(position)
        # straight towards the body there is no forward; then the body's north will do
        for ahead in (velocity, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])):
            level = ahead - (ahead @ up) * up
            if np.linalg.norm(level) > 1e-6 * np.linalg.norm(ahead):
                break
        height = float(np.linalg.norm(position)) - motion.body.radius_m
        if height < motion.body.plausible_heights_m[1]:
            raise ConfigError(
                f"the path comes down to {height / 1e3:.1f} km over the reference sphere of "
                f"{motion.body.name}, where mountains are; raise it"
            )
        forward, sun = level / np.linalg.norm(level), motion.sun_body(float(tdb_s))
        epochs.append(Epoch(number, 0, float(tdb_s), position, forward, sun, stated, seed))
    return epochs


def flight_states(flight: FlightSettings, motion: Ephemeris, seed: int) -> States:
    """Times (n,), TDB s, and inertial states (n, 6), m and m/s, of a [flight]."""
    body = motion.body
    low, high = (body.radius_m + 1e3 * h for h in (flight.lowest_km, flight.highest_km))
    speed = float(np.sqrt(2.0 * body.gm_m3_s2 * high / (low * (low + high))))
    start = utc_to_tdb_s(flight.start_utc)
    times = compute_tdb_s_after(flight.start_utc, flight.spacing_s * np.arange(flight.frames))
    frame = path_frame(motion, start, flight.inclination_deg, flight.node_deg, flight.lowest_at_deg)
    anomaly = np.radians(flight.start_at_deg - flight.lowest_at_deg)
    position, velocity = _on_conic(body.gm_m3_s2, low, speed, anomaly)
    state = np.concatenate([frame @ position, frame @ velocity])
    orbit = OrbitMotion(Forces(motion, ForcesSettings(degree=flight.degree)))
    if not flight.rough_gravity:
        return times, orbit.propagate(state, start, times)[0]
    states = [state]
    for number in range(1, flight.frames):
        rng = np.random.default_rng([seed, ROUGHNESS, number])
        state = orbit.propagate(state, times[number - 1], times[number : number + 1])[0][0]
        left_out = np.linalg.cholesky(orbit.noise(state, flight.spacing_s))
        state = state + left_out @ rng.normal(size=6)
        states.append(state)
    return times, np.array(states)


def transfer_states(transfer: TransferSettings, motion: Ephemeris) -> States:
    """Times (n,), TDB s, and inertial states (n, 6), m and m/s, of a [transfer]."""
    body = motion.body
    low, far = (body.radius_m + 1e3 * h for h in (transfer.to_km, transfer.from_km))
    excess = 1e3 * transfer.excess_speed_km_s
    speed = float(np.sqrt(excess**2 + 2.0 * body.gm_m3_s2 / low))
    arrival = utc_to_tdb_s(transfer.arrival_utc)
    frame = path_frame(
        motion, arrival, transfer.inclination_deg, transfer.node_deg, transfer.lowest_at_deg
    )
    state = np.concatenate([frame @ [low, 0.0, 0.0], frame @ [0.0, speed, 0.0]])
    orbit = OrbitMotion(Forces(motion))
    longest = min(1.5 * far / excess, MAX_APPROACH_S)
    back = np.concatenate([[0.0], np.geomspace(10.0, longest, APPROACH_STEPS)])
    distances = np.linalg.norm(orbit.propagate(state, arrival, arrival - back)[0][:, :3], axis=1)
    ages, farthest = even_ratios(distances, back, (far, low), transfer.frames)
    if farthest < far:
        raise ConfigError(
            f"[transfer] comes from {(farthest - body.radius_m) / 1e3:.0f} km at most "
            f"within {longest / 86400.0:.0f} days, not from {transfer.from_km:.0f} km; "
            "raise excess_speed_km_s or change the arrival"
        )
    times = compute_tdb_s_after(transfer.arrival_utc, -ages)
    return times, orbit.propagate(state, arrival, times)[0]


def even_ratios(
    distances: FloatArray, ages: FloatArray, ends: tuple[float, float], count: int
) -> tuple[FloatArray, float]:
    """When a path comes by distances in even ratios, the first and last of which are `ends`.

    distances, ages  (n,) of the path from the lowest point back: from the centre and how long ago
    Returns (count,) how long ago, and the greatest distance up to which the path only rises.
    """
    rising = distances[1:] > distances[:-1]
    end = len(ages) if rising.all() else int(np.argmin(rising)) + 1
    far, low = ends
    # distance grows as the square of time near the lowest point
    rise = np.sqrt(np.maximum(distances[:end] - low, 0.0))
    wanted = np.sqrt(np.geomspace(far, low, count) - low)
    return np.interp(wanted, rise, ages[:end]), float(distances[end - 1])


def path_frame(
    motion: Ephemeris, tdb_s: float, inclination_deg: float, node_deg: float, lowest_at_deg: float
) -> FloatArray:
    """Rotation (3, 3), inertial from a path's own axes: x to the lowest point, y onward, z up."""
    tilt, node, lowest = np.radians([inclination_deg, node_deg, lowest_at_deg])
    body_from_path = _about_z(node) @ _about_x(tilt) @ _about_z(lowest)
    inertial_from_path: FloatArray = motion.body_from_inertial(tdb_s).T @ body_from_path
    return inertial_from_path


def _on_conic(gm: float, low: float, speed: float, anomaly: float) -> tuple[FloatArray, FloatArray]:
    """Place and velocity at a true anomaly of the path through (low, 0) at velocity (0, speed)."""
    momentum = low * speed
    eccentricity = low * speed**2 / gm - 1.0
    c, s = np.cos(anomaly), np.sin(anomaly)
    r = momentum**2 / gm / (1.0 + eccentricity * c)
    position = r * np.array([c, s, 0.0])
    return position, gm / momentum * np.array([-s, eccentricity + c, 0.0])


def _about_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


class ApproachSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A slow way to the lowest point of a path past a small body.

    from_km, to_km   from the body's centre: the first picture and the last, lowest one
    speed_m_s        at the lowest point, against the body
    frames           pictures at distances from the centre in even ratios
    inclination_deg, node_deg, lowest_at_deg  as in [flight], at the arrival
    """

    from_km: Distance = 300.0
    to_km: Distance = 20.0
    speed_m_s: Annotated[float, Meta(ge=1e-3, le=1e5)] = 30.0
    inclination_deg: Inclination = 90.0
    node_deg: Turn = 0.0
    lowest_at_deg: Turn = 0.0
    arrival_utc: str = "2026-01-01T00:00:00Z"
    frames: Annotated[int, Meta(ge=2, le=100_000)] = 60


class Approach(ShapeScenario, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A real path past a small body under the Sun of its date."""

    approach: ApproachSettings

    def check(self) -> None:
        super().check()
        _check_ends("approach", self.approach.from_km, self.approach.to_km)

    def shortened(self, frames: int) -> Self:
        """Return the path in larger steps."""
        fewer = max(2, min(self.approach.frames, frames))
        approach = msgspec.structs.replace(self.approach, frames=fewer)
        return msgspec.structs.replace(self, approach=approach)

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        return epochs_of(self, motion, approach_states(self, motion))


def approach_states(scenario: Approach, motion: Ephemeris) -> States:
    """Times (n,), TDB s, and inertial states (n, 6) about the body, m and m/s, of an [approach].

    Raises ConfigError for a path that does not come from as far as wanted, DataError for a shape
    model that cannot be used.
    """
    settings, body = scenario.approach, motion.body
    pull = _Pull(motion, masses_of(load_shape(scenario.mesh, Path.cwd(), body), body))
    arrival = utc_to_tdb_s(settings.arrival_utc)
    low, far = 1e3 * settings.to_km, 1e3 * settings.from_km
    frame = path_frame(
        motion, arrival, settings.inclination_deg, settings.node_deg, settings.lowest_at_deg
    )
    state = np.concatenate([low * frame[:, 0], settings.speed_m_s * frame[:, 1]])
    centre = pull.body_state(arrival)
    longest = min(5.0 * far / settings.speed_m_s, MAX_S)

    def rates(t: float, y: FloatArray) -> FloatArray:
        ship, moon = y[:6], y[6:]
        by_body = pull.of_body(t, ship[:3] - moon[:3])
        return np.concatenate(
            [ship[3:], pull.of_planet(t, ship[:3]) + by_body, moon[3:], pull.of_planet(t, moon[:3])]
        )

    start = np.concatenate([centre + state, centre])
    span, tolerances = (arrival, arrival - longest), np.tile(TOLERANCE, 2)
    path = solve_ivp(
        rates, span, start, "DOP853", dense_output=True, rtol=RELATIVE, atol=tolerances
    )
    back = longest * np.linspace(0.0, 1.0, STEPS) ** 2
    flown = path.sol(arrival - back)
    distances = np.linalg.norm(flown[:3] - flown[6:9], axis=0)
    ages, farthest = even_ratios(distances, back, (far, low), settings.frames)
    if farthest < far:
        raise ConfigError(
            f"[approach] comes from {farthest / 1e3:.0f} km at most within "
            f"{longest / 3600.0:.0f} hours, not from {settings.from_km:g} km; raise speed_m_s or "
            "change the arrival"
        )
    times = compute_tdb_s_after(settings.arrival_utc, -ages)
    flown = path.sol(times)
    return times, (flown[:6] - flown[6:]).T


class Masses(NamedTuple):
    """Point masses (n, 3), m, body frame, and what each pulls with (n,), m^3/s^2."""

    places_m: FloatArray
    gm_m3_s2: FloatArray


def masses_of(shape: Shape, body: Body) -> Masses:
    """A shape at even density as point masses, their centre at the origin of the body's frame."""
    corners = shape.vertices[shape.faces]
    # a pyramid from the centre to each face; on a hollow they cancel by their sign
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    cuts = np.linspace(0.0, 1.0, LAYERS + 1)
    cubes = np.diff(cuts**3)
    heights = 0.75 * np.diff(cuts**4) / cubes
    places = (heights[:, None, None] * corners.mean(axis=1)).reshape(-1, 3)
    shares = (cubes[:, None] * volumes).ravel() / volumes.sum()
    return Masses(places - shares @ places, body.gm_m3_s2 * shares)


class _Pull:
    """Gravity of a body and of its planet, axes of the stars; none of a planet without [orbit]."""

    def __init__(self, motion: Ephemeris, masses: Masses) -> None:
        self._motion, self._masses = motion, masses
        orbit = motion.body.orbit
        self._planet = None if orbit is None else load_body(orbit.around)
        self._planet_turns = None if self._planet is None else AnalyticEphemeris(self._planet)

    def body_state(self, tdb_s: float) -> FloatArray:
        """The body's place and velocity (6,) about its planet; zero without one."""
        orbit = self._motion.body.orbit
        if orbit is None:
            return np.zeros(6)
        times = (tdb_s + dt for dt in (0.0, -APART_S, APART_S))
        now, before, after = (-self._motion.position_m(orbit.around, t) for t in times)
        return np.concatenate([now, (after - before) / (2.0 * APART_S)])

    def of_body(self, tdb_s: float, offset_m: FloatArray) -> FloatArray:
        """On a ship `offset_m` (3,) from the body, m/s^2."""
        body_from_inertial = self._motion.body_from_inertial(tdb_s)
        offsets = body_from_inertial @ offset_m - self._masses.places_m
        share = self._masses.gm_m3_s2 / np.einsum("ij,ij->i", offsets, offsets) ** 1.5
        pull: FloatArray = -(share @ offsets) @ body_from_inertial
        return pull

    def of_planet(self, tdb_s: float, place_m: FloatArray) -> FloatArray:
        """At a place (3,) about the planet, m/s^2: point mass and J2."""
        planet, turns = self._planet, self._planet_turns
        if planet is None or turns is None:
            return np.zeros(3)
        r = float(np.linalg.norm(place_m))
        pull = -planet.gm_m3_s2 * place_m / r**3
        if planet.gravity is None:
            return pull
        pole = turns.body_from_inertial(tdb_s)[2]
        up = float(pole @ place_m) / r
        size = 1.5 * planet.gravity.j2 * (1e3 * planet.gravity.radius_km / r) ** 2
        # the textbook's J2 (Vallado, "Fundamentals of Astrodynamics"), written with the pole
        bent = (1.0 - 5.0 * up**2) * place_m / r + 2.0 * up * pole
        pull -= planet.gm_m3_s2 / r**2 * size * bent
        return pull
