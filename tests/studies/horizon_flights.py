"""Single pictures of the Moon's limb from 50 to 800 km, under Suns from 4 to 60 deg.

Each is a flight with ground, light, path and lens of its own: ground that differs from its model
as the Moon differs from GLD100. The sizes of long shadows' errors were set with one seed and are
scored with another.
"""

from pathlib import Path

import msgspec

from catalog.progress import Progress
from optnav_cli.simulation.scenario_base import ScenarioBase
from tests.studies import flights

NAME = "real_flights"
BASE = "real_horizon_100km"
FITTED_SEED, SCORED_SEED = 70100, 81300
# Height, km, and elevation of the Sun below the camera, deg.
FLIGHTS = (
    (50.0, 4.0),
    (50.0, 20.0),
    (80.0, 4.0),
    (80.0, 60.0),
    (100.0, 6.0),
    (100.0, 35.0),
    (200.0, 4.0),
    (200.0, 25.0),
    (400.0, 5.0),
    (400.0, 45.0),
    (800.0, 8.0),
    (800.0, 30.0),
)
SUN_RANGE_DEG = 1e-3  # a scenario states a range


def scenario(number: int, seed: int) -> ScenarioBase:
    """The flight of FLIGHTS with a number, drawn with a seed of its own beside the others'."""
    height, sun = FLIGHTS[number]
    base = flights.shipped_scenario(BASE)
    parts = msgspec.to_builtins(base)
    orbit = {**parts["orbit"], "altitude_km": height, "passes": 1}
    light = {**parts["sun"], "elevation_deg": (sun - SUN_RANGE_DEG, sun + SUN_RANGE_DEG)}
    changed = {**parts, "seed": seed + number, "orbit": orbit, "sun": light}
    return msgspec.convert(changed, type(base))


def pictures(output: Path, seed: int, count: int | None, progress: Progress) -> list[Path]:
    """Picture folders of the first flights, all of them when None; made unless they are there."""
    numbers = range(len(FLIGHTS))[:count]
    place = output / "pictures" / f"{NAME}_{seed}"
    place.mkdir(parents=True, exist_ok=True)
    return [
        flights.made_pictures(scenario(number, seed), place / f"{number:02d}", progress)
        for number in numbers
    ]
