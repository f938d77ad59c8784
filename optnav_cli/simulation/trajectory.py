"""Where the camera is, how it is turned and where the Sun stands, frame by frame."""

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from optnav_cli.simulation.approach import approach_states
from optnav_cli.simulation.portraits import portrait_moments
from optnav_cli.simulation.scenario import AnyScenario, Approach, InertialPath, Portraits, Scenario
from optnav_cli.simulation.sections import SunSettings
from optnav_cli.simulation.shot import PLACE, Epoch, Exposure, shots_of
from optnav_cli.simulation.voyage import moments_of, voyage_states


def shots(scenario: AnyScenario, body: Body, motion: Ephemeris | None = None) -> list[Exposure]:
    """All pictures of a scenario in order of time, those of a pass together.

    motion  how the body turns; the analytic theory if None. Passes and portraits do not need it
    Raises ConfigError for a path that cannot be flown.
    """
    motion = motion or AnalyticEphemeris(body)
    if isinstance(scenario, InertialPath):
        return shots_of(scenario, moments_of(scenario, motion, voyage_states(scenario, motion)))
    if isinstance(scenario, Approach):
        return shots_of(scenario, moments_of(scenario, motion, approach_states(scenario, motion)))
    if isinstance(scenario, Portraits):
        return shots_of(scenario, portrait_moments(scenario, body))
    return shots_of(scenario, _passes(scenario, body))


def _passes(scenario: Scenario, body: Body) -> list[Epoch]:
    """The moments of all passes.

    Passes are circular orbits in the body-fixed frame: the body's own turn, 4 m/s at the Moon's
    equator, is left out, since each picture is taken from a position, not from a velocity.
    """
    orbit = scenario.orbit
    radius = body.radius_m + orbit.altitude_km * 1e3
    rate = float(np.sqrt(body.gm_m3_s2 / radius**3))
    start = utc_to_tdb_s(orbit.start_utc)
    found: list[Epoch] = []
    for number in range(orbit.passes):
        rng = np.random.default_rng([scenario.seed, PLACE, number])
        lat, lon = _place(orbit.box_deg, rng)
        heading = np.radians(rng.uniform(*orbit.heading_deg))
        sun = sun_over(scenario.sun, lat, lon, number, orbit.passes, rng)
        axes = body_from_local(lat, lon)
        up = axes[:, 2]
        ahead = axes @ np.array([np.sin(heading), np.cos(heading), 0.0])
        seeds = scenario.detail.seeds
        ground = seeds[number * len(seeds) // orbit.passes] if seeds else None
        for step in range(orbit.frames):
            after = (step - (orbit.frames - 1) / 2.0) * orbit.spacing_s
            angle = rate * after
            found.append(
                Epoch(
                    number=len(found),
                    pass_index=number,
                    tdb_s=start + number * orbit.pass_interval_s + step * orbit.spacing_s,
                    position_m=radius * (np.cos(angle) * up + np.sin(angle) * ahead),
                    forward=np.cos(angle) * ahead - np.sin(angle) * up,
                    sun_body=sun,
                    reported_sun=True,
                    ground_seed=ground,
                )
            )
    return found


def _place(box_deg: tuple[float, float, float, float], rng: np.random.Generator) -> FloatArray:
    """Latitude and longitude (rad) evenly over a box's area."""
    west, south, east, north = np.radians(box_deg)
    lat = np.arcsin(rng.uniform(np.sin(south), np.sin(north)))
    return np.array([lat, west + rng.uniform() * np.mod(east - west, 2.0 * np.pi)])


def sun_over(
    settings: SunSettings, lat: float, lon: float, number: int, count: int,
    rng: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """A unit vector (3,) to the Sun, body frame, that stands over a place as wanted.

    Elevations fill the range in `count` even steps, in an order that mixes them over the passes;
    one that the latitude does not allow becomes the highest that it does.
    """
    low, high = settings.elevation_deg
    # steps by the golden section spread any run of passes over the whole range
    share = np.mod(0.5 / count + number * 0.6180339887498949, 1.0)
    elevation = np.radians(low + (high - low) * share)
    declination = np.radians(settings.subsolar_latitude_deg) * rng.uniform(-1.0, 1.0)
    sine = np.sin(elevation) - np.sin(lat) * np.sin(declination)
    # at a pole every hour is as good
    reach = max(float(np.cos(lat) * np.cos(declination)), 1e-9)
    cosine = np.clip(sine / reach, -1.0, 1.0)
    hour = np.arccos(cosine) * (1.0 if rng.uniform() < 0.5 else -1.0)
    return xyz_from_latlon(declination, lon + hour, 1.0)
