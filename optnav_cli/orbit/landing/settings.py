"""What a user sets about a landing."""

from pathlib import Path
from typing import Annotated

import msgspec

from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import load_toml, resolve_config
from catalog.errors import ConfigError, DataError
from catalog.terrain.mesh.file import MeshSettings
from optnav_cli.orbit.qso.settings import BUNDLED_MESH, FOLDER, MoonForces

LANDING_KIND = "landing"
LANDING_CSV, PATH_CSV, IMPULSE_CSV = "landing.csv", "path.csv", "impulse.csv"

Lat = Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)]
Lon = Annotated[float, msgspec.Meta(ge=-180.0, le=360.0)]
Vector = tuple[
    Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)],
    Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)],
    Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)],
]
Small = Annotated[float, msgspec.Meta(ge=0.0, le=1e5)]
Above = Annotated[float, msgspec.Meta(gt=0.0, le=1e5)]
Trials = Annotated[int, msgspec.Meta(ge=0, le=100_000)]


class DepartureSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Where a landing departs: a quasi-satellite orbit, or a state.

    distance_km, lead_deg  from the surface, so much before the longitude of the target
    position_m, velocity_m_s  inertial, instead of an orbit
    """

    distance_km: Annotated[float, msgspec.Meta(ge=0.1, le=1e4)] = 50.0
    lead_deg: Annotated[float, msgspec.Meta(ge=0.0, le=90.0)] = 20.0
    position_m: Vector | None = None
    velocity_m_s: Vector | None = None


class BeamSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Four beams of the laser altimeter and of the Doppler radar.

    off_deg  of each beam off their axis;  roll_deg_s  how fast the craft turns about it: the feet
    of beams that only sink move 2 m/s, so that errors of the ground would not average out
    lean_deg  of the axis off the vertical on the descent, about which it turns: upright, the beams
    see a disc of ground that holds six of its errors; the craft stands up above to_m
    every_s, near_every_s  between ranges of the transfer and of the descent
    from_m  height below which the Doppler measures, to_m  the altimeter's last
    """

    off_deg: Annotated[float, msgspec.Meta(ge=0.5, le=45.0)] = 5.0
    roll_deg_s: Annotated[float, msgspec.Meta(ge=-10.0, le=10.0)] = 2.0
    lean_deg: Annotated[float, msgspec.Meta(ge=0.0, le=30.0)] = 8.0
    noise_m: Above = 3.0
    every_s: Annotated[float, msgspec.Meta(ge=1.0, le=600.0)] = 10.0
    near_every_s: Annotated[int, msgspec.Meta(ge=1, le=100)] = 1
    to_m: Above = 500.0
    doppler_noise_m_s: Annotated[float, msgspec.Meta(gt=0.0, le=10.0)] = 0.05
    doppler_from_m: Above = 3000.0


class ErrorSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """1 sigma of the start, a length each of three components, and of what engines do.

    accelerometer  how far the measured change of a burn is off, a share of it
    """

    position_km: Small = 3.0
    velocity_m_s: Small = 1.0
    size: Annotated[float, msgspec.Meta(ge=0.0, le=0.5)] = 0.01
    direction_deg: Annotated[float, msgspec.Meta(ge=0.0, le=20.0)] = 0.5
    accelerometer: Annotated[float, msgspec.Meta(ge=0.0, le=0.5)] = 0.001


class SurfaceSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The model of the ground and how wrong it is.

    error_m, error_length_m  of heights, 1 sigma, and over what length they are alike
    near_error_m  the same about the target, where pictures were taken before
    """

    mesh: MeshSettings = BUNDLED_MESH
    error_m: Small = 20.0
    error_length_m: Above = 200.0
    near_error_m: Small = 5.0


class LandingSection(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [landing] section; see configs/templates/landing.toml."""

    time: str
    target_lat_deg: Lat
    target_lon_deg: Lon
    body: str = "phobos"
    transfer_s: Annotated[float, msgspec.Meta(ge=60.0, le=36_000.0)] = 1800.0
    corrections_s: tuple[Above, ...] = (900.0, 1500.0)
    aim_height_km: Annotated[float, msgspec.Meta(ge=0.6, le=30.0)] = 8.0
    descent_m_s: Annotated[float, msgspec.Meta(ge=1.0, le=100.0)] = 15.0
    touchdown_m_s: Annotated[float, msgspec.Meta(ge=0.1, le=10.0)] = 1.75
    trials: Trials = 200
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**53)] = 1


class LandingSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The whole file."""

    landing: LandingSection
    departure: DepartureSettings = DepartureSettings()
    beams: BeamSettings = BeamSettings()
    errors: ErrorSettings = ErrorSettings()
    surface: SurfaceSettings = SurfaceSettings()
    forces: MoonForces = MoonForces()


def load_landing_settings(path: Path) -> LandingSettings:
    """Settings of a file, or of one that ships ("bundled:NAME"). Raises ConfigError."""
    settings = load_toml(resolve_config(path, FOLDER), LandingSettings)
    section, departure = settings.landing, settings.departure
    try:
        utc_to_tdb_s(section.time, "time")
    except DataError as error:
        raise ConfigError(f"{path}: [landing] {error}") from None
    late = [s for s in section.corrections_s if s >= section.transfer_s]
    if late or list(section.corrections_s) != sorted(set(section.corrections_s)):
        raise ConfigError(
            f"{path}: [landing] corrections_s is {list(section.corrections_s)}; wanted times in "
            f"order, before the arrival after {section.transfer_s:g} s"
        )
    if (departure.position_m is None) != (departure.velocity_m_s is None):
        raise ConfigError(
            f"{path}: [departure] has position_m or velocity_m_s alone; give both, or neither for "
            "an orbit"
        )
    return settings
