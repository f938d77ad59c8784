"""A scenario: what is flown over, with which cameras, in which light. One TOML file."""

import tomllib
from pathlib import Path

import msgspec

from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris, motion_of
from catalog.config import load_toml, resource
from catalog.errors import ConfigError
from catalog.terrain.dem.file import BUNDLED, SHARED, path_of
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.mesh.file import MeshSettings
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera, preset_camera
from optnav_cli.frames.run_settings import SpiceSettings
from optnav_cli.simulation.sections import (
    ApproachSettings,
    AttitudeSettings,
    CameraSettings,
    DetailSettings,
    FlightSettings,
    GlareSettings,
    GlobeSettings,
    MountedCamera,
    OrbitSettings,
    PointingSettings,
    PortraitSettings,
    PriorSettings,
    SensorSettings,
    SkySettings,
    StructureSettings,
    SunSettings,
    TransferSettings,
)


class ScenarioBase(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What every scenario file says, as it is written.

    beside  further cameras of the same ship; all take their pictures at the same times
    """

    camera: CameraSettings
    beside: tuple[MountedCamera, ...] = ()
    dem: tuple[DemSettings, ...] = (DemSettings("tycho_gld100_256ppd.tif"),)
    body: str = "moon"
    seed: int = 1
    globe: GlobeSettings = GlobeSettings()
    detail: DetailSettings = DetailSettings()
    pointing: PointingSettings = PointingSettings()
    sensor: SensorSettings = SensorSettings()
    prior: PriorSettings = PriorSettings()
    attitude: AttitudeSettings = AttitudeSettings()
    spice: SpiceSettings = SpiceSettings()
    sky: SkySettings = SkySettings()
    glare: GlareSettings = GlareSettings()
    structure: tuple[StructureSettings, ...] = ()

    def mounts(self) -> tuple[MountedCamera, ...]:
        """All cameras, the first one as [pointing] turns the ship."""
        return (MountedCamera(self.camera.name), *self.beside)


class Scenario(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Passes on circular orbits under a Sun that is put where it is wanted."""

    orbit: OrbitSettings
    sun: SunSettings = SunSettings()


class InertialPath(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A real path in inertial space under the Sun of its date: one of the two."""

    flight: FlightSettings | None = None
    transfer: TransferSettings | None = None


class ShapeScenario(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What is flown over is a small body, whose ground is a shape model refined by [detail]."""

    mesh: MeshSettings
    dem: tuple[DemSettings, ...] = ()


class Portraits(ShapeScenario, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Single pictures of a small body from all sides."""

    portraits: PortraitSettings


class Approach(ShapeScenario, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A real path past a small body under the Sun of its date."""

    approach: ApproachSettings


AnyScenario = Scenario | InertialPath | Portraits | Approach


def load_scenario(path: str | Path) -> AnyScenario:
    """Read a scenario; paths of terrain and camera files come out absolute.

    A file name that is not found beside the scenario is looked for among the shipped ones.
    Raises ConfigError.
    """
    path = Path(path)
    scenario: AnyScenario = load_toml(path, _kind(path))
    _check(scenario, path)
    base = path.resolve().parent
    if isinstance(scenario, ShapeScenario) and not scenario.mesh.path.startswith((BUNDLED, SHARED)):
        mesh = msgspec.structs.replace(scenario.mesh, path=str(base / scenario.mesh.path))
        scenario = msgspec.structs.replace(scenario, mesh=mesh)
    dems = tuple(
        msgspec.structs.replace(dem, path=_data_file(dem.path, base, path))
        for dem in sorted(scenario.dem, key=lambda d: d.priority)
    )
    kernels = (k if k.startswith(SHARED) else str(base / k) for k in scenario.spice.kernels)
    return msgspec.structs.replace(
        scenario,
        dem=dems,
        globe=msgspec.structs.replace(
            scenario.globe, path=_data_file(scenario.globe.path, base, path)
        ),
        camera=CameraSettings(_camera_file(scenario.camera.name, base)),
        beside=tuple(
            msgspec.structs.replace(mount, name=_camera_file(mount.name, base))
            for mount in scenario.beside
        ),
        spice=SpiceSettings(tuple(kernels)),
    )


def scenario_cameras(scenario: AnyScenario) -> list[Camera]:
    """The cameras that a scenario names, in its order.

    Raises ConfigError for a file that is no camera, or for two cameras of one name.
    """
    names = [mount.name for mount in scenario.mounts()]
    cameras = [load_camera(n) if n.endswith(".toml") else preset_camera(n) for n in names]
    for number, camera in enumerate(cameras):
        if camera.name in [other.name for other in cameras[:number]]:
            raise ConfigError(f"[[beside]] has the camera '{camera.name}' again; wanted another")
    return cameras


def scenario_motion(scenario: AnyScenario, body: Body) -> Ephemeris:
    """How the scenario's body turns. Raises ConfigError or DataError for a kernel."""
    return motion_of(body, [path_of(name, Path.cwd()) for name in scenario.spice.kernels])


def fewer_pictures(scenario: AnyScenario, frames: int) -> AnyScenario:
    """The same scenario with fewer pictures a camera, for a quick look.

    Passes keep all grounds and Suns as long as there is a picture for each; a flight ends earlier;
    an approach and portraits take larger steps.
    """
    if isinstance(scenario, Scenario):
        orbit = scenario.orbit
        passes = min(orbit.passes, frames)
        short = msgspec.structs.replace(orbit, passes=passes, frames=max(1, frames // passes))
        return msgspec.structs.replace(scenario, orbit=short)
    if isinstance(scenario, Portraits):
        fewer = min(scenario.portraits.frames, frames)
        portraits = msgspec.structs.replace(scenario.portraits, frames=fewer)
        return msgspec.structs.replace(scenario, portraits=portraits)
    if isinstance(scenario, Approach):
        fewer = max(2, min(scenario.approach.frames, frames))
        approach = msgspec.structs.replace(scenario.approach, frames=fewer)
        return msgspec.structs.replace(scenario, approach=approach)
    flight, transfer = scenario.flight, scenario.transfer
    if flight is not None:
        flight = msgspec.structs.replace(flight, frames=min(flight.frames, frames))
    if transfer is not None:
        transfer = msgspec.structs.replace(transfer, frames=min(transfer.frames, max(frames, 2)))
    return msgspec.structs.replace(scenario, flight=flight, transfer=transfer)


def _kind(path: Path) -> type[AnyScenario]:
    """Of which kind a file is by its sections; reading it as that reports what is wrong."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError):
        return Scenario
    if "approach" in data:
        return Approach
    if "mesh" in data or "portraits" in data:
        return Portraits
    return InertialPath if "flight" in data or "transfer" in data else Scenario


def _camera_file(name: str, base: Path) -> str:
    return str(base / name) if name.endswith(".toml") else name


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


def _check(scenario: AnyScenario, where: Path) -> None:
    for dem in scenario.dem:
        if dem.feather_km:
            raise ConfigError(
                f"{where}: [[dem]] feather_km is {dem.feather_km:g}; wanted 0: "
                "simulated ground has hard edges, only builds blend"
            )
    if scenario.globe.detail and not scenario.dem:
        raise ConfigError(
            f"{where}: [globe] has detail, and there is no [[dem]] that it could lie around; "
            "put the relief of a whole body into [detail]"
        )
    if isinstance(scenario, InertialPath):
        _check_voyage(scenario, where)
        return
    if isinstance(scenario, ShapeScenario):
        _check_shape(scenario, where)
        return
    low, high = scenario.sun.elevation_deg
    if low > high:
        raise ConfigError(f"{where}: [sun] elevation_deg is {low}..{high}; put the lower one first")
    _, south, _, north = scenario.orbit.box_deg
    if south > north:
        raise ConfigError(
            f"{where}: [orbit] box_deg has south {south} above north {north}; "
            "wanted west, south, east, north"
        )


def _check_shape(scenario: Portraits | Approach, where: Path) -> None:
    if scenario.dem:
        raise ConfigError(f"{where}: there are [[dem]] and mesh; give one of them")
    if isinstance(scenario, Approach):
        from_km, to_km = scenario.approach.from_km, scenario.approach.to_km
        if to_km >= from_km:
            raise ConfigError(
                f"{where}: [approach] to_km is {to_km:g}, not below from_km {from_km:g}; "
                "the path comes from far and ends near"
            )
        return
    low, high = scenario.portraits.phase_deg
    if low > high:
        raise ConfigError(
            f"{where}: [portraits] phase_deg is {low:g}..{high:g}; put the lower one first"
        )


def _check_voyage(scenario: InertialPath, where: Path) -> None:
    flight, transfer = scenario.flight, scenario.transfer
    if flight is not None and transfer is not None:
        raise ConfigError(f"{where}: there are [flight] and [transfer]; give one of them")
    if flight is not None and flight.lowest_km > flight.highest_km:
        raise ConfigError(
            f"{where}: [flight] lowest_km is {flight.lowest_km:g}, above highest_km "
            f"{flight.highest_km:g}; exchange them"
        )
    if transfer is not None and transfer.to_km >= transfer.from_km:
        raise ConfigError(
            f"{where}: [transfer] to_km is {transfer.to_km:g}, not below from_km "
            f"{transfer.from_km:g}; the path comes from far and ends near"
        )
