"""The path past a small body that is itself on its way about a planet, by Newton's law alone.

It is not made from the forces that the navigator predicts with. Body and ship both fall about the
planet, in axes that stay with it, under its point mass and J2; the body pulls the ship by the mass
of its whole shape at even density, centred where its frame is. So the truth holds what the
navigator leaves out or has in error: the planet's flattening, the body's true place and the rest
of its field. The Sun's tide between the two, 1e-7 of the planet's, is left out.
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
from catalog.config import Turn
from catalog.errors import ConfigError
from catalog.terrain.mesh.shape import Shape, load_shape
from optnav_cli.simulation.exposure import Epoch
from optnav_cli.simulation.inertial_path import States, epochs_of, even_ratios, path_frame
from optnav_cli.simulation.scenario_base import ShapeScenario
from optnav_cli.simulation.sections import Distance, Inclination

RELATIVE = 1e-12
TOLERANCE = np.array([1e-3] * 3 + [1e-7] * 3)  # m and m/s: planets are 1e7 m away
LAYERS = 4  # masses from the centre to each face: the field at two radii is right to 1e-4
APART_S = 10.0  # places of the body that its velocity is found from
MAX_S = 5 * 86400.0
STEPS = 4000  # times that distances are looked up between: 1e-5 of them


class ApproachSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A slow way to the lowest point of a path past a small body; see `approach`.

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
        from_km, to_km = self.approach.from_km, self.approach.to_km
        if to_km >= from_km:
            raise ConfigError(
                f"[approach] to_km is {to_km:g}, not below from_km {from_km:g}; "
                "the path comes from far and ends near"
            )

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
