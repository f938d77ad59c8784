"""A scenario: what is flown over, with which camera, in which light. One TOML file."""

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from catalog.config import load_toml, resource
from catalog.errors import ConfigError
from catalog.terrain.dem_file import BUNDLED, SHARED
from catalog.terrain.source import DemSettings
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera, preset_camera

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]
Count = Annotated[int, Meta(ge=1)]
Latitude = Annotated[float, Meta(ge=-90.0, le=90.0)]
Elevation = Annotated[float, Meta(ge=-90.0, le=90.0)]


class GlobeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ground outside the terrain models, all round the body; smooth where there are some."""

    path: str = "moon_gld100_4ppd.tif"


class DetailSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Relief added below the posting of the first terrain model, or else of the globe.

    It is made by catalog.terrain.detail.

    seeds  one ground each; passes take them in turn, in equal parts. Empty adds nothing
    """

    seeds: tuple[int, ...] = (1,)
    smallest_m: Positive = 30.0
    rms_slope_deg: NotNegative = 3.0
    saturation: NotNegative = 0.05


class CameraSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """name: a shipped camera, or a path to a camera file, relative to the scenario."""

    name: str


class OrbitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Passes on circular orbits, each over its own place.

    box_deg      west, south, east, north of where the middles of the passes lie
    heading_deg  lowest and highest direction of flight there, east of north
    """

    altitude_km: Positive
    box_deg: tuple[float, Latitude, float, Latitude]
    passes: Count = 1
    frames: Count = 1
    spacing_s: Positive = 10.0
    heading_deg: tuple[float, float] = (-180.0, 180.0)
    start_utc: str = "2026-01-01T00:00:00Z"
    pass_interval_s: Positive = 7200.0


class PointingSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Boresight and roll about the way down and forward, each with its scatter (1 sigma a frame).

    forward_deg, right_deg  where the boresight meets the ground from the point below, as angles
    """

    forward_deg: float = 0.0
    right_deg: float = 0.0
    roll_deg: float = 0.0
    tilt_sigma_deg: NotNegative = 0.0
    roll_sigma_deg: NotNegative = 0.0


class SunSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The Sun of each pass, morning or evening, as high at the pass' middle as the range says.

    elevation_deg          lowest and highest; the passes share the range evenly
    subsolar_latitude_deg  how far from the equator the Sun stands overhead at most (Moon: 1.54)
    """

    elevation_deg: tuple[Elevation, Elevation] = (10.0, 45.0)
    subsolar_latitude_deg: NotNegative = 1.5


class SensorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """psf_sigma_px: the lens' blur; snr: of the mean lit signal, shot and read noise together."""

    psf_sigma_px: NotNegative = 0.7
    snr: Positive = 50.0
    read_noise_e: NotNegative = 10.0
    bits: Annotated[int, Meta(ge=6, le=16)] = 8
    exposure: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.85


class PriorSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """position_sigma_m: 1 sigma a component of the error added to the prior position."""

    position_sigma_m: NotNegative = 3000.0


class AttitudeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """sigma_arcsec: 1 sigma an axis of the error added to the attitude, 0 for exact.

    free  the attitude in frames.csv is a first guess only: its sigma is left empty
    """

    sigma_arcsec: NotNegative = 0.0
    free: bool = False


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A scenario file as it is written; `base_dir` is where its relative paths begin."""

    camera: CameraSettings
    orbit: OrbitSettings
    dem: tuple[DemSettings, ...] = (DemSettings("tycho_gld100_256ppd.tif"),)
    body: str = "moon"
    seed: int = 1
    globe: GlobeSettings = GlobeSettings()
    detail: DetailSettings = DetailSettings()
    pointing: PointingSettings = PointingSettings()
    sun: SunSettings = SunSettings()
    sensor: SensorSettings = SensorSettings()
    prior: PriorSettings = PriorSettings()
    attitude: AttitudeSettings = AttitudeSettings()


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario; paths of terrain and camera files come out absolute.

    A file name that is not found beside the scenario is looked for among the shipped ones.
    Raises ConfigError.
    """
    path = Path(path)
    scenario = load_toml(path, Scenario)
    _check(scenario, path)
    base = path.resolve().parent
    dems = tuple(
        msgspec.structs.replace(dem, path=_data_file(dem.path, base, path))
        for dem in sorted(scenario.dem, key=lambda d: d.priority)
    )
    globe = GlobeSettings(_data_file(scenario.globe.path, base, path))
    camera = scenario.camera.name
    if camera.endswith(".toml"):
        camera = str(base / camera)
    return msgspec.structs.replace(scenario, dem=dems, globe=globe, camera=CameraSettings(camera))


def scenario_camera(scenario: Scenario) -> Camera:
    """The camera that a scenario names. Raises ConfigError."""
    name = scenario.camera.name
    return load_camera(name) if name.endswith(".toml") else preset_camera(name)


def _data_file(name: str, base: Path, where: Path) -> str:
    # its folder need not be there to read the scenario; opening the model asks for it
    if name.startswith(SHARED):
        return name
    # written as in a build config, too
    name, bundled = name.removeprefix(BUNDLED), name.startswith(BUNDLED)
    beside = base / name
    if beside.exists() and not bundled:
        return str(beside)
    try:
        return str(resource(f"data/{name}"))
    except ConfigError as error:
        raise ConfigError(
            f"{where}: there is no terrain model '{name}' beside the scenario, and {error}"
        ) from None


def _check(scenario: Scenario, where: Path) -> None:
    for dem in scenario.dem:
        if dem.feather_km:
            raise ConfigError(
                f"{where}: [[dem]] feather_km is {dem.feather_km:g}; wanted 0: "
                "simulated ground has hard edges, only builds blend"
            )
    low, high = scenario.sun.elevation_deg
    if low > high:
        raise ConfigError(f"{where}: [sun] elevation_deg is {low}..{high}; put the lower one first")
    _, south, _, north = scenario.orbit.box_deg
    if south > north:
        raise ConfigError(
            f"{where}: [orbit] box_deg has south {south} above north {north}; "
            "wanted west, south, east, north"
        )
