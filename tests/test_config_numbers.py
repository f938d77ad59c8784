"""Every number of every config, set to what no file should hold: it loads and works, or says why.

The walk needs no list: it takes the numbers of the shipped files and, by their types, those that
could stand there as well.
"""

import math
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec import inspect

from catalog.bodies.body import BodyFile, SunOrbit, read_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.errors import ConfigError, DataError
from catalog.pipeline.config import BuildConfig, load_build_config
from optnav_cli.archives.frame import ImportTable, load_table
from optnav_cli.camera.camera_file import CameraFileSettings, camera_toml, load_camera
from optnav_cli.control_points.settings import NavigateSettings, load_settings
from optnav_cli.hazard.settings import HazardSettings
from optnav_cli.hazard.settings import load_settings as hazard_settings
from optnav_cli.simulation.descent import Descent
from optnav_cli.simulation.inertial_path import Approach, InertialPath
from optnav_cli.simulation.passes import Portraits, Scenario
from optnav_cli.simulation.scenario import load_scenario, scenario_cameras, scenario_motion

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
VALUES = (
    *(math.nan, math.inf, -math.inf, 1e308, -1e308, 1e-308, 10**30, -(10**30)),
    *(-1.0, 0.0, 1e-3, 1e5, 2**31, 1e12),
)
Steps = tuple[str | int, ...]


def use_body(path: Path) -> None:
    body = read_body(path)
    motion = AnalyticEphemeris(body)
    orbit = body.sun if isinstance(body.sun, SunOrbit) else None
    for tdb_s in (0.0, 1e9, -1e9):
        if orbit is not None and not orbit.is_valid_at(tdb_s):
            continue
        assert np.isfinite(motion.body_from_inertial(tdb_s)).all()
        assert np.isfinite(motion.sun_body(tdb_s)).all()
        motion.error_m(tdb_s)
        if body.orbit is not None:
            motion.position_m(body.orbit.around, tdb_s)


def use_camera(path: Path) -> None:
    camera = load_camera(path)
    rays = camera.unproject(camera.border(8))
    camera.project(rays[np.isfinite(rays).all(axis=1)])
    camera.project([0.0, 0.0, 1.0])
    again = path.with_name("again.toml")
    again.write_text(camera_toml(camera))
    load_camera(again)


def use_scenario(path: Path) -> None:
    from catalog.bodies.body import load_body

    scenario = load_scenario(path)
    scenario_cameras(scenario)
    motion = scenario_motion(scenario, load_body(scenario.body))
    assert scenario.shortened(2).exposures(motion)


CASES: dict[str, tuple[type, Callable[[Path], object]]] = {
    "bodies/moon": (BodyFile, use_body),
    "bodies/phobos": (BodyFile, use_body),
    "bodies/eros": (BodyFile, use_body),
    "imports/near_msi": (ImportTable, load_table),
    "cameras/unk": (CameraFileSettings, use_camera),
    "cameras/apollo15_metric": (CameraFileSettings, use_camera),
    "cameras/tsnn_shtk": (CameraFileSettings, use_camera),
    "templates/build": (BuildConfig, load_build_config),
    "catalogs/phobos": (BuildConfig, load_build_config),
    "templates/navigate": (NavigateSettings, load_settings),
    "templates/hazard": (HazardSettings, lambda path: hazard_settings(path, {})),
    "scenarios/demo": (Scenario, use_scenario),
    "scenarios/structure_100km": (Scenario, use_scenario),
    "scenarios/descent_118m": (Descent, use_scenario),
    "scenarios/transfer": (InertialPath, use_scenario),
    "scenarios/horizon_100km": (InertialPath, use_scenario),
    "scenarios/phobos_disc": (Portraits, use_scenario),
    # a path of minutes: its own numbers are tried alone
    "scenarios/phobos_approach": (Approach, load_scenario),
}


def written(value: Any) -> Iterator[Steps]:
    """Places of the numbers of a file; of tables in a list, those of the first."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    if isinstance(value, list) and value and isinstance(value[0], dict | list):
        items = enumerate(value[:1])
    for key, child in items:
        if isinstance(child, dict | list):
            yield from ((key, *steps) for steps in written(child))
        elif isinstance(child, int | float) and not isinstance(child, bool):
            yield (key,)


def possible(type_: inspect.Type) -> Iterator[Steps]:
    """Places of the numbers that could be set, but for those in lists."""
    if isinstance(type_, inspect.UnionType):
        for part in type_.types:
            yield from possible(part)
    elif isinstance(type_, inspect.StructType):
        for field in type_.fields:
            yield from ((field.encode_name, *steps) for steps in possible(field.type))
    elif isinstance(type_, inspect.IntType | inspect.FloatType):
        yield ()


def with_value(data: Any, steps: Steps, value: object) -> Any:
    """A copy of a file's data with one number changed, or set; None where it has no such place."""
    if not steps:
        return value
    key, rest = steps[0], steps[1:]
    if isinstance(data, list):
        assert isinstance(key, int)
        return [with_value(v, rest, value) if n == key else v for n, v in enumerate(data)]
    changed = with_value(data.get(key, {}), rest, value) if isinstance(data, dict) else None
    return None if changed is None else {**data, key: changed}


def toml(data: dict[str, Any]) -> str:
    """Data as TOML."""

    def text(value: Any) -> str:
        match value:
            case bool():
                return str(value).lower()
            case dict():
                return "{" + ", ".join(f"{k} = {text(v)}" for k, v in value.items()) + "}"
            case list():
                return "[" + ", ".join(map(text, value)) + "]"
            case str():
                return msgspec.json.encode(value).decode()
        return repr(value)

    return "".join(f"{key} = {text(value)}\n" for key, value in data.items())


@pytest.mark.parametrize("name", CASES)
@pytest.mark.filterwarnings("ignore:.*dubious year")
def test_every_number_loads_and_works_or_is_refused(name: str, tmp_path: Path) -> None:
    type_, use = CASES[name]
    shipped = CONFIGS / f"{name}.toml"
    data = tomllib.loads(shipped.read_text())
    data.pop("spice", None)  # kernels are among the shared data, and hold no number of the config
    places = dict.fromkeys([*written(data), *possible(inspect.type_info(type_))])
    path = tmp_path / "edited.toml"
    path.write_text(toml(data))
    with suppress(DataError):
        use(path)
    wrong: list[str] = []
    first = next(other for other in CASES if CASES[other][0] is type_)
    for steps in places:
        # other files of a kind have the same keys: they show what their own numbers lead to
        for value in VALUES if name == first else VALUES[::3]:
            changed = with_value(data, steps, value)
            if changed is None:
                continue
            path.write_text(toml(changed))
            try:
                use(path)
            except (ConfigError, DataError) as error:
                # where a path leads shows when it is flown, and the section says it then
                if not str(error).startswith((str(tmp_path), "[", "the path ")):
                    wrong.append(f"{steps} = {value}: says not where: {error}")
            except Exception as error:
                error.add_note(f"with {steps} = {value}")
                raise
    assert not wrong, "\n".join(wrong)
