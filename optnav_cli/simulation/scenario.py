"""Scenario files: what is flown over, with which cameras, in which light. One TOML file."""

import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec

from catalog.bodies.body import Body
from catalog.bodies.ephemeris import Ephemeris, load_ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import BUNDLED, load_toml, read_toml_text, resource
from catalog.errors import ConfigError, DataError
from catalog.terrain.dem.file import SHARED, resolve_path
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera, preset_camera
from optnav_cli.simulation.cylinder_scenario import CylinderScenario
from optnav_cli.simulation.descent import Descent
from optnav_cli.simulation.inertial_path import Approach, InertialPath
from optnav_cli.simulation.passes import Portraits, Scenario
from optnav_cli.simulation.scenario_base import FileNames, ScenarioBase
from optnav_cli.simulation.stereo_path import StereoScenario

# Of which kind a file is by its sections, the first that it has; reading it as that kind reports
# what is wrong in it.
KINDS: dict[str, type[ScenarioBase]] = {
    "approach": Approach,
    "descent": Descent,
    "mesh": Portraits,
    "portraits": Portraits,
    "flight": InertialPath,
    "transfer": InertialPath,
    "stereo": StereoScenario,
    "cylinder": CylinderScenario,
}


def load_scenario(path: str | Path) -> ScenarioBase:
    """Read a scenario; paths of terrain, camera and body files come out absolute.

    A file name that is not found beside the scenario is looked for among the shipped ones.
    Raises ConfigError.
    """
    path = Path(path)
    scenario: ScenarioBase = load_toml(path, _kind(path))
    try:
        scenario.check()
        _check_times(scenario, "")
    except (ConfigError, DataError) as error:
        raise ConfigError(f"{path}: {error}") from None
    base = path.resolve().parent

    def camera(name: str) -> str:
        return str(base / name) if name.endswith(".toml") else name

    def shape(name: str) -> str:
        return name if name.startswith((BUNDLED, SHARED)) else str(base / name)

    def kernel(name: str) -> str:
        return name if name.startswith(SHARED) else str(base / name)

    dems = tuple(sorted(scenario.dem, key=lambda dem: dem.priority))
    return msgspec.structs.replace(scenario, dem=dems).with_files(
        FileNames(partial(_data_file, base, path), shape, camera, body=camera, kernel=kernel)
    )


def scenario_copy(scenario: ScenarioBase) -> bytes:
    """All settings of a scenario with their defaults, as JSON; paths shortened to file names."""

    def bare(name: str) -> str:
        return Path(name).name

    copy = scenario.with_files(FileNames(bare, bare, bare, bare, bare))
    return msgspec.json.format(msgspec.json.encode(copy), indent=2) + b"\n"


def scenario_cameras(scenario: ScenarioBase) -> list[Camera]:
    """The cameras that a scenario names, in its order.

    Raises ConfigError for a file that is no camera, or for two cameras of one name.
    """
    names = [mount.name for mount in scenario.mounts()]
    cameras = [load_camera(n) if n.endswith(".toml") else preset_camera(n) for n in names]
    if isinstance(scenario, StereoScenario):  # copies of one
        cameras = [
            replace(c, name=n) for c, n in zip(cameras, scenario.camera_names(), strict=True)
        ]
    for number, camera in enumerate(cameras):
        if camera.name in [other.name for other in cameras[:number]]:
            raise ConfigError(f"[[beside]] has the camera '{camera.name}' again; wanted another")
    return cameras


def scenario_motion(scenario: ScenarioBase, body: Body) -> Ephemeris:
    """Read the rotation of the scenario's body. Raises ConfigError or DataError for a kernel."""
    return load_ephemeris(body, [resolve_path(name, Path.cwd()) for name in scenario.spice.kernels])


def _kind(path: Path) -> type[ScenarioBase]:
    try:
        data = tomllib.loads(read_toml_text(path))
    except (ValueError, RecursionError):
        return Scenario
    return next((kind for section, kind in KINDS.items() if section in data), Scenario)


def _data_file(base: Path, where: Path, name: str) -> str:
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


def _check_times(settings: msgspec.Struct, section: str) -> None:
    """Check every setting named *_utc. Raises DataError, which names section and setting."""
    for name in settings.__struct_fields__:
        value = getattr(settings, name)
        if isinstance(value, msgspec.Struct):
            _check_times(value, name)
        elif name.endswith("_utc") and isinstance(value, str):
            utc_to_tdb_s(value, f"[{section}] {name}" if section else name)
