"""Real paths: an orbit about a body in inertial space, and the approach to one from far away.

The body turns under the path by its motion (theory or SPICE kernels), the Sun stands where it does
at the date. Gravity is that of the navigator's predictions (point mass, J2, C22, tides); what those
leave out is added to a [flight] as noise of its known size, so that no prediction is exact.
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import ConfigError
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.integrator import OrbitMotion
from optnav_cli.simulation.scenario import AnyScenario, InertialPath
from optnav_cli.simulation.sections import FlightSettings, TransferSettings
from optnav_cli.simulation.shot import ROUGHNESS, Epoch

States = tuple[FloatArray, FloatArray]

MAX_APPROACH_S = 20 * 86400.0
APPROACH_STEPS = 400  # places that times are found between: 1e-6 of the distance


def voyage_states(voyage: InertialPath, motion: Ephemeris) -> States:
    """Times (n,), TDB s, and inertial states (n, 6), m and m/s, of a voyage's pictures.

    Raises ConfigError for a path that does not come from as far as wanted.
    """
    if voyage.flight is not None:
        return flight_states(voyage.flight, motion, voyage.seed)
    return transfer_states(voyage.transfer or TransferSettings(), motion)


def moments_of(scenario: AnyScenario, motion: Ephemeris, states: States) -> list[Epoch]:
    """All times when pictures are taken, with the ship's place in the body-fixed frame.

    Raises ConfigError for a path that meets the body.
    """
    found: list[Epoch] = []
    seeds = scenario.detail.seeds
    for number, (tdb_s, state) in enumerate(zip(*states, strict=True)):
        turn = motion.body_from_inertial(float(tdb_s))
        position, velocity = turn @ state[:3], turn @ state[3:]
        up = position / np.linalg.norm(position)
        # straight towards the body there is no forward; then the body's north will do
        for ahead in (velocity, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])):
            level = ahead - (ahead @ up) * up
            if np.linalg.norm(level) > 1e-6 * np.linalg.norm(ahead):
                break
        _check_height(motion.body, position)
        found.append(
            Epoch(
                number=number,
                pass_index=0,
                tdb_s=float(tdb_s),
                position_m=position,
                forward=level / np.linalg.norm(level),
                sun_body=motion.sun_body(float(tdb_s)),
                reported_sun=scenario.attitude.relative_to == "body",
                ground_seed=seeds[0] if seeds else None,
            )
        )
    return found


def flight_states(flight: FlightSettings, motion: Ephemeris, seed: int) -> States:
    """Times (n,), TDB s, and inertial states (n, 6), m and m/s, of a [flight]."""
    body = motion.body
    low, high = (body.radius_m + 1e3 * h for h in (flight.lowest_km, flight.highest_km))
    speed = float(np.sqrt(2.0 * body.gm_m3_s2 * high / (low * (low + high))))
    start = utc_to_tdb_s(flight.start_utc)
    times = start + flight.spacing_s * np.arange(flight.frames, dtype=np.float64)
    frame = path_frame(motion, start, flight.inclination_deg, flight.node_deg, flight.lowest_at_deg)
    place, velocity = _on_conic(
        body.gm_m3_s2, low, speed, np.radians(flight.start_at_deg - flight.lowest_at_deg)
    )
    state = np.concatenate([frame @ place, frame @ velocity])
    orbit = OrbitMotion(Forces(motion))
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
    rising = distances[1:] > distances[:-1]
    end = len(back) if rising.all() else int(np.argmin(rising)) + 1
    if distances[end - 1] < far:
        raise ConfigError(
            f"[transfer] comes from {(distances[end - 1] - body.radius_m) / 1e3:.0f} km at most "
            f"within {longest / 86400.0:.0f} days, not from {transfer.from_km:.0f} km; "
            "raise excess_speed_km_s or change the arrival"
        )
    wanted = np.geomspace(far, low, transfer.frames)
    # distance grows as the square of time near the lowest point
    ago = np.interp(
        np.sqrt(wanted - low), np.sqrt(np.maximum(distances[:end] - low, 0.0)), back[:end]
    )
    times = arrival - ago
    return times, orbit.propagate(state, arrival, times)[0]


def path_frame(
    motion: Ephemeris, tdb_s: float, inclination_deg: float, node_deg: float, lowest_at_deg: float
) -> FloatArray:
    """Rotation (3, 3), inertial from a path's own axes: x to the lowest point, y onward, z up."""
    tilt, node, lowest = np.radians([inclination_deg, node_deg, lowest_at_deg])
    body_from_path = _about_z(node) @ _about_x(tilt) @ _about_z(lowest)
    return np.asarray(motion.body_from_inertial(tdb_s).T @ body_from_path)


def _on_conic(gm: float, low: float, speed: float, anomaly: float) -> tuple[FloatArray, FloatArray]:
    """Place and velocity at a true anomaly of the path through (low, 0) at velocity (0, speed)."""
    momentum = low * speed
    eccentricity = low * speed**2 / gm - 1.0
    c, s = np.cos(anomaly), np.sin(anomaly)
    r = momentum**2 / gm / (1.0 + eccentricity * c)
    place = r * np.array([c, s, 0.0])
    return place, gm / momentum * np.array([-s, eccentricity + c, 0.0])


def _check_height(body: Body, position: FloatArray) -> None:
    height = float(np.linalg.norm(position)) - body.radius_m
    if height < body.plausible_heights_m[1]:
        raise ConfigError(
            f"the path comes down to {height / 1e3:.1f} km over the reference sphere of "
            f"{body.name}, where mountains are; raise it"
        )


def _about_z(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle: float) -> FloatArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
