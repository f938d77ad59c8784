"""Single pictures of a whole small body, each from its own place and under its own Sun."""

from typing import Self

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import tdb_s_after
from catalog.config import Count, Seconds
from catalog.errors import ConfigError
from optnav_cli.simulation.exposure import PLACE, Epoch
from optnav_cli.simulation.passes import GOLDEN
from optnav_cli.simulation.scenario_base import ShapeScenario
from optnav_cli.simulation.sections import Distance, Phase, SunLatitude

NORTH = np.array([0.0, 0.0, 1.0])
MAX_TRIES = 1000  # places and Suns drawn for one picture


class PortraitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Single pictures of a whole body from all sides.

    distance_km            from the body's centre: of the first picture and of the last one
    phase_deg              lowest and highest angle at the body between the camera and the Sun
    subsolar_latitude_deg  how far from the equator the Sun stands overhead at most
    """

    distance_km: tuple[Distance, Distance]
    frames: Count = 1
    phase_deg: tuple[Phase, Phase] = (20.0, 70.0)
    subsolar_latitude_deg: SunLatitude = 26.0
    start_utc: str = "2026-01-01T00:00:00Z"
    interval_s: Seconds = 86400.0


class Portraits(ShapeScenario, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Single pictures of a small body from all sides."""

    portraits: PortraitSettings

    def check(self) -> None:
        super().check()
        low, high = self.portraits.phase_deg
        if low > high:
            raise ConfigError(
                f"[portraits] phase_deg is {low:g}..{high:g}; put the lower one first"
            )

    def shortened(self, frames: int) -> Self:
        fewer = min(self.portraits.frames, frames)
        portraits = msgspec.structs.replace(self.portraits, frames=fewer)
        return msgspec.structs.replace(self, portraits=portraits)

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        """When and from where the pictures are taken.

        Distances go from the first to the last in even ratios, phases fill their range in even
        steps in an order that mixes them; places are drawn evenly over all directions from the
        body. Raises ConfigError for a distance within the body and for a phase under no Sun that
        it has.
        """
        settings = self.portraits
        body = motion.body
        lowest = body.radius_m + body.plausible_heights_m[1]
        if 1e3 * min(settings.distance_km) <= lowest:
            raise ConfigError(
                f"[portraits] distance_km comes down to {min(settings.distance_km):g} km from the "
                f"centre of {body.name}, whose ground may reach {lowest / 1e3:g} km; wanted more"
            )
        times = tdb_s_after(
            settings.start_utc, np.arange(settings.frames) * settings.interval_s
        ).tolist()
        distances = 1e3 * np.geomspace(*settings.distance_km, settings.frames)
        low, high = np.radians(settings.phase_deg)
        seeds = self.detail.seeds
        found: list[Epoch] = []
        for number in range(settings.frames):
            share = np.mod(0.5 / settings.frames + number * GOLDEN, 1.0)
            rng = np.random.default_rng([self.seed, PLACE, number])
            up, sun = _place_and_sun(
                float(low + (high - low) * share), np.radians(settings.subsolar_latitude_deg), rng
            )
            forward = _square_to(up, NORTH)
            seed = seeds[number * len(seeds) // settings.frames] if seeds else None
            position_m = distances[number] * up
            found.append(Epoch(number, number, times[number], position_m, forward, sun, True, seed))
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
    level /= np.linalg.norm(level)
    return level
