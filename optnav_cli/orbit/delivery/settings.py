"""What a user sets about the accuracy of a delivery."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import load_toml, resolve_config
from catalog.errors import ConfigError, DataError
from optnav_cli.orbit.qso.settings import FOLDER

DELIVERY_KIND = "delivery"
STAGES_CSV, BOXES_CSV, ARRIVALS_CSV = "stages.csv", "boxes.csv", "arrivals.csv"

Coordinate = Annotated[float, msgspec.Meta(ge=-1e10, le=1e10)]  # km
Speed = Annotated[float, msgspec.Meta(ge=-1e3, le=1e3)]  # km/s
Small = Annotated[float, msgspec.Meta(ge=0.0, le=1e9)]
Above = Annotated[float, msgspec.Meta(gt=0.0, le=1e9)]
Days = Annotated[float, msgspec.Meta(gt=0.0, le=1e4)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=0.5)]
Trials = Annotated[int, msgspec.Meta(ge=100, le=2_000_000)]
Degrees = Annotated[float, msgspec.Meta(ge=-360.0, le=360.0)]


class AimSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [aim]: B-plane coordinates of the arrival and the time of the pericentre."""

    xi_km: Coordinate
    eta_km: Coordinate
    pericentre: str


class InjectionSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [injection]: 1 sigma of its velocity, m/s, along it and of both components across."""

    along_m_s: Small = 1.0
    across_m_s: Small = 5.0


class BurnSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [burns]: 1 sigma of what a correction does, and the bound of all errors in sigmas.

    size, direction_deg  of both axes across;  fixed_m_s  a component, its length is bounded
    """

    size: Share = 0.00333333
    direction_deg: Annotated[float, msgspec.Meta(ge=0.0, le=20.0)] = 0.16666667
    fixed_m_s: Small = 0.01
    bound_sigmas: Annotated[float, msgspec.Meta(ge=1.0, le=6.0)] = 3.0


class StationSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A [[station]] on the Earth, place on a sphere."""

    name: str
    lat_deg: Annotated[float, msgspec.Meta(ge=-90.0, le=90.0)]
    lon_deg: Degrees


class RadioSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [radio]: 1 sigma of ranges and range rates, and what is considered.

    arc_days  of measurements before a correction;  every_s between them;  range_bias_m,
    rate_bias_mm_s  of each station;  place_m  of a station, an axis;  troposphere_m, ionosphere_m
    at the zenith;  light_pressure  its acceleration, m/s^2 at the Earth's distance, and share
    """

    arc_days: Days = 3.0
    every_s: Annotated[float, msgspec.Meta(ge=10.0, le=86_400.0)] = 1800.0
    range_m: Above = 10.0
    rate_mm_s: Above = 0.5
    range_bias_m: Small = 10.0
    rate_bias_mm_s: Small = 0.1
    place_m: Small = 1.0
    troposphere_m: Small = 0.1
    ionosphere_m: Small = 1.0
    light_pressure_m_s2: Small = 6e-8
    light_pressure_share: Share = 0.1
    min_elevation_deg: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 10.0


class OpticalSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [optical] fixes against the target or the centre, whichever is nearer.

    direction_arcsec  across the line of sight;  range_share  along it, of the range;  least_m
    of either;  bias_share  of both that all fixes of an arc have in common, considered
    """

    arc_days: Days = 1.0
    every_s: Annotated[float, msgspec.Meta(ge=10.0, le=86_400.0)] = 3600.0
    direction_arcsec: Above = 10.0
    range_share: Above = 1e-3
    least_m: Above = 30.0
    bias_share: Share = 0.3


class ThrustSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [thrust] of an electric engine: its errors are a first-order Markov sequence.

    start_day, end_day  since the start;  size, direction_deg  1 sigma;  correlation_days
    """

    acceleration_m_s2: Above
    start_day: Annotated[float, msgspec.Meta(ge=0.0, le=1e4)]
    end_day: Days
    size: Share = 0.05
    direction_deg: Annotated[float, msgspec.Meta(ge=0.0, le=20.0)] = 1.0
    correlation_days: Days = 3.0


class DeliverySection(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [delivery] section; see configs/templates/delivery.toml."""

    target: str
    start: str
    position_km: tuple[Coordinate, Coordinate, Coordinate]
    velocity_km_s: tuple[Speed, Speed, Speed]
    centre: Literal["sun", "earth"]
    corrections_days: Annotated[tuple[Days, ...], msgspec.Meta(min_length=1, max_length=20)]
    trials: Trials = 100_000
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**53)] = 1


class DeliverySettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The whole file."""

    delivery: DeliverySection
    aim: AimSettings | None = None
    injection: InjectionSettings = InjectionSettings()
    burns: BurnSettings = BurnSettings()
    station: tuple[StationSettings, ...] = ()
    radio: RadioSettings | None = None
    optical: OpticalSettings | None = None
    thrust: ThrustSettings | None = None


def load_delivery_settings(path: Path) -> DeliverySettings:
    """Settings of a file, or of one that ships ("bundled:NAME"). Raises ConfigError."""
    settings = load_toml(resolve_config(path, FOLDER), DeliverySettings)
    section = settings.delivery
    try:
        utc_to_tdb_s(section.start, "[delivery] start")
        if settings.aim is not None:
            utc_to_tdb_s(settings.aim.pericentre, "[aim] pericentre")
    except DataError as error:
        raise ConfigError(f"{path}: {error}") from None
    days = section.corrections_days
    if list(days) != sorted(set(days)):
        raise ConfigError(
            f"{path}: [delivery] corrections_days is {list(days)}; wanted times in order"
        )
    if settings.radio is None and settings.optical is None:
        raise ConfigError(
            f"{path}: it has neither [radio] nor [optical]; add one: without measurements no "
            "correction can be found"
        )
    if settings.radio is not None and not settings.station:
        raise ConfigError(f"{path}: [radio] needs a [[station]]; add at least one")
    if settings.thrust is not None and settings.thrust.end_day <= settings.thrust.start_day:
        raise ConfigError(f"{path}: [thrust] ends before it starts; wanted end_day > start_day")
    return settings
