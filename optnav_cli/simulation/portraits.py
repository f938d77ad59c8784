"""Single pictures of a whole small body, each from its own place and under its own Sun."""

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import ConfigError
from optnav_cli.simulation.scenario import Portraits
from optnav_cli.simulation.shot import PLACE, Epoch

MAX_TRIES = 1000  # places and Suns drawn for one picture
GOLDEN = 0.6180339887498949


def portrait_moments(scenario: Portraits, body: Body) -> list[Epoch]:
    """When and from where the pictures are taken.

    Distances go from the first to the last in even ratios, phases fill their range in even steps in
    an order that mixes them; places are drawn evenly over all directions from the body.
    Raises ConfigError for a distance within the body and for a phase under no Sun that it has.
    """
    settings = scenario.portraits
    lowest = body.radius_m + body.plausible_heights_m[1]
    if 1e3 * min(settings.distance_km) <= lowest:
        raise ConfigError(
            f"[portraits] distance_km comes down to {min(settings.distance_km):g} km from the "
            f"centre of {body.name}, whose ground may reach {lowest / 1e3:g} km; wanted more"
        )
    start = utc_to_tdb_s(settings.start_utc)
    distances = 1e3 * np.geomspace(*settings.distance_km, settings.frames)
    low, high = np.radians(settings.phase_deg)
    seeds = scenario.detail.seeds
    found: list[Epoch] = []
    for number in range(settings.frames):
        share = np.mod(0.5 / settings.frames + number * GOLDEN, 1.0)
        rng = np.random.default_rng([scenario.seed, PLACE, number])
        up, sun = _place_and_sun(
            float(low + (high - low) * share), np.radians(settings.subsolar_latitude_deg), rng
        )
        found.append(
            Epoch(
                number=number,
                pass_index=number,
                tdb_s=start + number * settings.interval_s,
                position_m=distances[number] * up,
                forward=_square_to(up, np.array([0.0, 0.0, 1.0])),
                sun_body=sun,
                reported_sun=True,
                ground_seed=seeds[number * len(seeds) // settings.frames] if seeds else None,
            )
        )
    return found


def _place_and_sun(
    phase: float, highest: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Unit vectors from the body's centre to a camera and the Sun, a phase angle (rad) apart.

    highest  rad  the Sun's latitude at most, north or south
    """
    for _ in range(MAX_TRIES):
        up, aside = rng.normal(size=(2, 3))
        up /= np.linalg.norm(up)
        sun = np.cos(phase) * up + np.sin(phase) * _square_to(up, aside)
        if abs(float(sun[2])) <= np.sin(highest):
            return up, sun
    raise ConfigError(
        f"[portraits] the Sun's latitude stays within {np.degrees(highest):g} deg, and under none "
        f"of {MAX_TRIES} places it stood so at a phase of {np.degrees(phase):.0f} deg; raise "
        "subsolar_latitude_deg"
    )


def _square_to(up: FloatArray, wanted: FloatArray) -> FloatArray:
    """The unit vector nearest to a wanted direction that is square to `up`."""
    level = wanted - (wanted @ up) * up
    if np.linalg.norm(level) < 1e-6:
        level = np.array([1.0, 0.0, 0.0]) - up[0] * up
    return np.asarray(level / np.linalg.norm(level))
