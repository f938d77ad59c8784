"""Passes on circular orbits over a region, and single pictures of a whole small body.

The Sun of a pass is put where it is wanted; each single picture has its own place and Sun.
"""

from typing import Self

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.bodies.epochs import compute_tdb_s_after
from catalog.config import Count, Seconds, Turn
from catalog.errors import ConfigError
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from optnav_cli.simulation.scenario_base import PLACE, Epoch, ScenarioBase, ShapeScenario
from optnav_cli.simulation.sections import Distance, Elevation, Latitude, Phase, SunLatitude

GOLDEN = 0.6180339887498949  # steps by it spread any run of passes over a whole range
NORTH = np.array([0.0, 0.0, 1.0])
MAX_TRIES = 1000  # places and Suns drawn for one picture


class OrbitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Passes on circular orbits, each over its own place.

    box_deg      west, south, east, north of where the middles of the passes lie
    heading_deg  lowest and highest direction of flight there, east of north
    """

    altitude_km: Distance
    box_deg: tuple[Turn, Latitude, Turn, Latitude]
    passes: Count = 1
    frames: Count = 1
    spacing_s: Seconds = 10.0
    heading_deg: tuple[Turn, Turn] = (-180.0, 180.0)
    start_utc: str = "2026-01-01T00:00:00Z"
    pass_interval_s: Seconds = 7200.0


class SunSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The Sun of each pass, morning or evening, as high at the pass' middle as the range says.

    elevation_deg          lowest and highest; the passes share the range evenly
    subsolar_latitude_deg  how far from the equator the Sun stands overhead at most (Moon: 1.54)
    """

    elevation_deg: tuple[Elevation, Elevation] = (10.0, 45.0)
    subsolar_latitude_deg: SunLatitude = 1.5


class Scenario(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Passes on circular orbits under a Sun that is put where it is wanted."""

    orbit: OrbitSettings
    sun: SunSettings = SunSettings()

    def check(self) -> None:
        super().check()
        low, high = self.sun.elevation_deg
        if low > high:
            raise ConfigError(f"[sun] elevation_deg is {low}..{high}; put the lower one first")
        _, south, _, north = self.orbit.box_deg
        if south > north:
            raise ConfigError(
                f"[orbit] box_deg has south {south} above north {north}; "
                "wanted west, south, east, north"
            )

    def shortened(self, frames: int) -> Self:
        """All grounds and Suns stay as long as there is a picture for each."""
        passes = min(self.orbit.passes, frames)
        orbit = msgspec.structs.replace(self.orbit, passes=passes, frames=max(1, frames // passes))
        return msgspec.structs.replace(self, orbit=orbit)

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        """The epochs of all passes.

        Passes are circular orbits in the body-fixed frame: the body's own turn, 4 m/s at the
        Moon's equator, is left out, since each picture is taken from a position, not from a
        velocity.
        """
        orbit = self.orbit
        body = motion.body
        radius = body.radius_m + orbit.altitude_km * 1e3
        rate = float(np.sqrt(body.gm_m3_s2 / radius**3))
        flight: list[Epoch] = []
        for number in range(orbit.passes):
            rng = np.random.default_rng([self.seed, PLACE, number])
            lat, lon = _place(orbit.box_deg, rng)
            heading = np.radians(rng.uniform(*orbit.heading_deg))
            sun = sun_over(self.sun, lat, lon, number, orbit.passes, rng)
            axes = body_from_local(lat, lon)
            up = axes[:, 2]
            ahead = axes @ np.array([np.sin(heading), np.cos(heading), 0.0])
            seeds = self.detail.seeds
            ground = seeds[number * len(seeds) // orbit.passes] if seeds else None
            for step in range(orbit.frames):
                after = (step - (orbit.frames - 1) / 2.0) * orbit.spacing_s
                c, s = np.cos(rate * after), np.sin(rate * after)
                position, forward = radius * (c * up + s * ahead), c * ahead - s * up
                later = number * orbit.pass_interval_s + step * orbit.spacing_s
                tdb_s = float(compute_tdb_s_after(orbit.start_utc, later)[0])
                at = len(flight), number, tdb_s
                flight.append(Epoch(*at, position, forward, sun, True, ground))
        return flight


def _place(box_deg: tuple[float, float, float, float], rng: np.random.Generator) -> FloatArray:
    """Latitude and longitude (rad) evenly over a box's area."""
    west, south, east, north = np.radians(box_deg)
    lat = np.arcsin(rng.uniform(np.sin(south), np.sin(north)))
    return np.array([lat, west + rng.uniform() * np.mod(east - west, 2.0 * np.pi)])


def sun_over(
    settings: SunSettings, lat: float, lon: float, number: int, count: int, rng: np.random.Generator
) -> FloatArray:
    """A unit vector (3,) to the Sun, body frame, that stands over a place as wanted.

    Elevations fill the range in `count` even steps, in an order that mixes them over the passes;
    one that the latitude does not allow becomes the highest that it does.
    """
    low, high = settings.elevation_deg
    share = np.mod(0.5 / count + number * GOLDEN, 1.0)
    elevation = np.radians(low + (high - low) * share)
    declination = np.radians(settings.subsolar_latitude_deg) * rng.uniform(-1.0, 1.0)
    sine = np.sin(elevation) - np.sin(lat) * np.sin(declination)
    # at a pole every hour is as good
    reach = max(float(np.cos(lat) * np.cos(declination)), 1e-9)
    cosine = np.clip(sine / reach, -1.0, 1.0)
    hour = np.arccos(cosine) * (1.0 if rng.uniform() < 0.5 else -1.0)
    return xyz_from_latlon(declination, lon + hour, 1.0)


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
        times = compute_tdb_s_after(
            settings.start_utc, np.arange(settings.frames) * settings.interval_s
        ).tolist()
        distances = 1e3 * np.geomspace(*settings.distance_km, settings.frames)
        low, high = np.radians(settings.phase_deg)
        seeds = self.detail.seeds
        flight: list[Epoch] = []
        for number in range(settings.frames):
            share = np.mod(0.5 / settings.frames + number * GOLDEN, 1.0)
            rng = np.random.default_rng([self.seed, PLACE, number])
            up, sun = _place_and_sun(
                float(low + (high - low) * share), np.radians(settings.subsolar_latitude_deg), rng
            )
            forward = _square_to(up, NORTH)
            seed = seeds[number * len(seeds) // settings.frames] if seeds else None
            position_m = distances[number] * up
            flight.append(
                Epoch(number, number, times[number], position_m, forward, sun, True, seed)
            )
        return flight


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
