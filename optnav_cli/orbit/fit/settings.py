"""What a user can set about the fit of an orbit; every key has a default that works."""

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from catalog.config import Positive, load_toml
from catalog.errors import ConfigError
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.frames.run_settings import SpiceSettings

KIND = "orbit"  # of the output folder

Name = Literal[
    "clock",
    "focal",
    "map_offset",
    "acceleration",
    "srp",
    "vertical",
    "star_catalog",
    "range_bias",
    "range_rate_bias",
    "station_clock",
    "station_place",
    "troposphere",
    "ephemeris",
]
Mode = Literal["estimate", "consider"]
NoiseModel = Literal["white", "mean", "nuisance", "none"]
PARAMETERS: tuple[Name, ...] = ("clock", "focal", "map_offset", "acceleration", "srp")
# Of a parameter whose section states none: larger than any that a flight has.
PRIOR_SIGMAS: dict[Name, float] = {
    "clock": 10.0,
    "focal": 0.01,
    "map_offset": 1000.0,
    "acceleration": 1e-5,
    "srp": 0.02,
    "vertical": 0.1,
    "star_catalog": 0.01,
    "range_bias": 20.0,
    "range_rate_bias": 1e-3,
    "station_clock": 1e-3,
    "station_place": 1.0,
    "troposphere": 1.0,
    "ephemeris": 5.0,
}
UNITS: dict[str, str] = {
    "clock": "s",
    "focal": "",
    "map_offset": "m",
    "acceleration": "m/s2",
    "srp": "m2/kg",
    "vertical": "arcsec",
    "star_catalog": "arcsec",
    "range_bias": "m",
    "range_rate_bias": "m/s",
    "station_clock": "s",
    "station_place": "sigma",
    "troposphere": "sigma",
    "ephemeris": "m",
}
# Parameters of the fixes of a camera or of a run, of all zenith distances, and of signals from
# stations; the others move the craft.
OF_FIXES: tuple[Name, ...] = ("clock", "focal", "map_offset")
OF_SIGHTS: tuple[Name, ...] = ("vertical", "star_catalog")
OF_SIGNALS: tuple[Name, ...] = (
    "range_bias",
    "range_rate_bias",
    "station_clock",
    "station_place",
    "troposphere",
    "ephemeris",
)
OF_PASSES: tuple[Name, ...] = ("range_bias", "range_rate_bias", "station_clock")
CONSIDERED: tuple[Name, ...] = ("station_place", "troposphere", "ephemeris")
OF_MEASUREMENTS: tuple[Name, ...] = (*OF_FIXES, *OF_SIGHTS, *OF_SIGNALS)

Vector = tuple[
    Annotated[float, Meta(ge=-1e13, le=1e13)],
    Annotated[float, Meta(ge=-1e13, le=1e13)],
    Annotated[float, Meta(ge=-1e13, le=1e13)],
]


class NoiseSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[noise]: what the forces leave out.

    model            white acceleration, a constant mean one, white in the weights of the fixes
                     (nuisance), or none
    density_m2_s3    of white acceleration, an axis; unset: of what the field leaves out
    """

    model: NoiseModel = "white"
    density_m2_s3: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None


class FixesSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[fixes]: what is common to them.

    time_sigma_s  1 sigma of their times, where frames.csv states no utc_sigma_s: 0.29 of stamps of
                  whole seconds
    """

    time_sigma_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 0.0


class ParameterSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[parameter]]: a number common to fixes, or to the arc.

    camera, run  whose fixes it belongs to; of a run, the name of its folder; "": all
    prior_sigma  s, a share, m, m/s^2, m^2/kg or arc seconds; unset: wide
    mode         estimate it, or only consider that it is not known
    per          of signals: one number for each station, or for each of its passes
    """

    name: Name
    camera: str = ""
    run: str = ""
    prior_sigma: Positive | None = None
    mode: Mode = "estimate"
    per: Literal["station", "pass"] = "station"

    @property
    def sigma(self) -> float:
        """1 sigma before the fixes are looked at."""
        return PRIOR_SIGMAS[self.name] if self.prior_sigma is None else self.prior_sigma

    @property
    def label(self) -> str:
        """Label of a parameter: its name, and whose it is."""
        whose = " ".join(filter(None, (self.camera, self.run)))
        return f"{self.name} of {whose}" if whose else self.name


class OrbitPriorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[[prior]]: what is known of the orbit without the fixes: a state, or the file of another.

    frame                inertial (ICRF axes at the body's centre) or body-fixed
    position_sigma_m, velocity_sigma_m_s  1 sigma a component, where there is no covariance
    covariance           (21,) of the state, lower triangle row by row, m and m/s, its frame
    oem                  a CCSDS OEM; with its own covariance, or the sigmas above
    """

    utc: str = ""
    frame: Literal["inertial", "body"] = "inertial"
    position_m: Vector | None = None
    velocity_m_s: Vector | None = None
    position_sigma_m: Positive | None = None
    velocity_sigma_m_s: Positive | None = None
    covariance: tuple[float, ...] = ()
    oem: str = ""

    def check(self) -> None:
        """Raise ConfigError for one that states no orbit."""
        stated = bool(self.utc) and self.position_m is not None and self.velocity_m_s is not None
        if stated == bool(self.oem):
            raise ConfigError(
                "[[prior]] states utc, position_m and velocity_m_s, or names an oem; give either"
            )
        if self.covariance and len(self.covariance) != 21:
            raise ConfigError(
                f"[[prior]] covariance has {len(self.covariance)} numbers; wanted the 21 of the "
                "lower triangle, row by row"
            )
        spread = self.position_sigma_m is not None and self.velocity_sigma_m_s is not None
        if not (spread or self.covariance or self.oem):
            raise ConfigError(
                "[[prior]] says nothing of its errors; add position_sigma_m and "
                "velocity_sigma_m_s, or a covariance"
            )
        if not all(map(math.isfinite, self.covariance)):
            raise ConfigError("[[prior]] covariance has a number that is not finite; mend it")


class OrbitFitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The whole config of a fit; see configs/templates/orbit.toml.

    step_s             between the rows of orbit.csv that are no fixes
    gate_probability   a right fix is left out with this probability
    """

    step_s: Annotated[float, Meta(ge=1.0, le=1e6)] = 60.0
    gate_probability: Annotated[float, Meta(gt=0.0, lt=0.1)] = 1e-5
    forces: ForcesSettings = ForcesSettings()
    noise: NoiseSettings = NoiseSettings()
    fixes: FixesSettings = FixesSettings()
    parameter: tuple[ParameterSettings, ...] = ()
    prior: tuple[OrbitPriorSettings, ...] = ()
    spice: SpiceSettings = SpiceSettings()


def load_orbit_settings(path: Path) -> OrbitFitSettings:
    """The settings of a file. Raises ConfigError for a wrong one."""
    settings = load_toml(path, OrbitFitSettings)
    try:
        settings.forces.check()
        for prior in settings.prior:
            prior.check()
        check_parameters(settings.parameter)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return settings


def check_parameters(parameters: tuple[ParameterSettings, ...]) -> None:
    """Raise ConfigError for one that is there twice, or has a camera that cannot matter."""
    seen = set()
    for parameter in parameters:
        if parameter.label in seen:
            raise ConfigError(f"[[parameter]] {parameter.label} is there twice; remove one")
        owned = parameter.name in OF_FIXES
        if not owned and (parameter.camera or parameter.run):
            what = "is common to all zenith distances" if parameter.name in OF_SIGHTS else ""
            what = "belongs to signals of stations" if parameter.name in OF_SIGNALS else what
            what = what or "moves the craft, whatever camera looks"
            raise ConfigError(f"[[parameter]] {parameter.name} {what}; remove camera and run")
        if parameter.per == "pass" and parameter.name not in OF_PASSES:
            raise ConfigError(
                f"[[parameter]] {parameter.name} has no number for each pass; remove per, or name "
                f"one of {', '.join(OF_PASSES)}"
            )
        seen.add(parameter.label)
