"""Every shipped config is valid, and the templates say what the defaults are."""

import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from catalog.config import load_toml

CONFIGS = Path(__file__).resolve().parents[1] / "configs"


def load_body(path: Path) -> object:
    from catalog.bodies.body import load_body

    return load_body(path.stem)


def load_camera(path: Path) -> object:
    from optnav_cli.camera.camera_file import load_camera

    return load_camera(path)


def load_photometry(path: Path) -> object:
    from catalog.photometry.sets import load_sets

    return load_sets(path.stem)


def load_build(path: Path) -> object:
    from catalog.pipeline.config import load_build_config

    return load_build_config(path)


def load_scenario(path: Path) -> object:
    from optnav_cli.simulation.scenario import load_scenario

    return load_scenario(path)


def load_import(path: Path) -> object:
    from optnav_cli.archives.frame import load_table

    return load_table(path)


def load_navigate(path: Path) -> object:
    from optnav_cli.control_points.settings import NavigateSettings

    return load_toml(path, NavigateSettings)


def load_hazard(path: Path) -> object:
    from optnav_cli.hazard.settings import HazardSettings

    return load_toml(path, HazardSettings)


def load_calibrate(path: Path) -> object:
    from optnav_cli.calibration.model import load_calibrate_settings

    return load_calibrate_settings(path)


def load_qso(path: Path) -> object:
    from optnav_cli.orbit.qso.settings import load_qso_settings

    return load_qso_settings(path)


def load_orbit_fit(path: Path) -> object:
    from optnav_cli.orbit.fit.settings import load_orbit_settings

    return load_orbit_settings(path)


def load_landing(path: Path) -> object:
    from optnav_cli.orbit.landing.settings import load_landing_settings

    return load_landing_settings(path)


def load_delivery(path: Path) -> object:
    from optnav_cli.orbit.delivery.settings import load_delivery_settings

    return load_delivery_settings(path)


def load_orbit(path: Path) -> object:
    kinds = {"qso": load_qso, "landing": load_landing, "delivery": load_delivery}
    return kinds[path.stem.partition("_")[0]](path)


def load_model(path: Path) -> object:
    from catalog.correlation.relief_albedo import ReliefAlbedo
    from catalog.terrain.error_model import TerrainLaws
    from optnav_cli.control_points.acceptance import AcceptanceLimits
    from optnav_cli.control_points.error_model import PointErrorSizes
    from optnav_cli.cylinder.geometry import CylinderErrorSizes
    from optnav_cli.hazard.settings import HazardModel
    from optnav_cli.navigate.descent.state import DescentErrorSizes
    from optnav_cli.orbit.fit.motion import OrbitNoiseSizes
    from optnav_cli.orbit.fit.parameters import SharedErrorSizes
    from optnav_cli.outline.disc.moments import DiscErrorSizes
    from optnav_cli.outline.limb.limb_rays import HorizonSizes
    from optnav_cli.outline.silhouette.method import SilhouetteErrors

    types: dict[str, type[object]] = {
        "acceptance": AcceptanceLimits,
        "albedo": ReliefAlbedo,
        "terrain": TerrainLaws,
        "control_points": PointErrorSizes,
        "descent": DescentErrorSizes,
        "cylinder": CylinderErrorSizes,
        "disc": DiscErrorSizes,
        "silhouette": SilhouetteErrors,
        "horizon": HorizonSizes,
        "hazard": HazardModel,
        "orbit": OrbitNoiseSizes,
        "orbit_fixes": SharedErrorSizes,
    }
    return load_toml(path, types[path.stem])


LOADERS: dict[str, Callable[[Path], object]] = {
    "bodies": load_body,
    "cameras": load_camera,
    "catalogs": load_build,
    "models": load_model,
    "scenarios": load_scenario,
    "imports": load_import,
    "photometry": load_photometry,
    "orbits": load_orbit,
    "templates/qso": load_qso,
    "templates/landing": load_landing,
    "templates/delivery": load_delivery,
    "templates/build": load_build,
    "templates/scenario": load_scenario,
    "templates/navigate": load_navigate,
    "templates/hazard": load_hazard,
    "templates/calibrate": load_calibrate,
    "templates/orbit": load_orbit_fit,
}
TEMPLATES = [name.partition("/")[2] for name in LOADERS if name.startswith("templates/")]
SHIPPED = {
    path.relative_to(CONFIGS).with_suffix("").as_posix(): path
    for path in sorted(CONFIGS.rglob("*.toml"))
}


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_config_loads(name: str) -> None:
    loader = LOADERS.get(name) or LOADERS[name.partition("/")[0]]
    assert loader(SHIPPED[name]) is not None


def test_all_kinds_of_configs_are_shipped() -> None:
    kinds = {name if name.startswith("templates/") else name.partition("/")[0] for name in SHIPPED}
    assert kinds == set(LOADERS)


def test_nothing_but_configs_is_shipped_as_config() -> None:
    others = [p.name for p in CONFIGS.rglob("*") if p.is_file() and p.suffix != ".toml"]
    assert others == ["README.md"]


def settings(type_: type[msgspec.Struct]) -> Iterator[tuple[str, type[msgspec.Struct] | None]]:
    """(name, struct of a section or None) of each setting of a struct."""
    for field in msgspec.inspect.type_info(type_).fields:  # type: ignore[attr-defined]
        parts = [field.type, *getattr(field.type, "types", ())]
        parts += [getattr(part, "item_type", None) for part in parts]
        structs = [p.cls for p in parts if isinstance(p, msgspec.inspect.StructType)]
        yield field.encode_name, structs[0] if structs else None


def documented(text: str) -> set[tuple[str, str]]:
    """(section, setting) of a template, also of settings in comments: "# name = value"."""
    found, section = set(), ""
    for line in text.splitlines():
        bare = line.removeprefix("#").strip()
        if bare.startswith("["):
            section = bare.partition("]")[0].strip("[] ")
            found.add(section.rpartition(".")[::2])
        elif "=" in bare and bare.partition("=")[0].strip().isidentifier():
            found.add((section, bare.partition("=")[0].strip()))
    return found


def wanted(type_: type[msgspec.Struct]) -> set[tuple[str, str]]:
    """(section, setting) of all that a template should show."""
    found = set()
    for name, struct in settings(type_):
        found.add(("", name))
        if struct is not None:
            found |= {(name, inner) for inner, _ in settings(struct)}
    return found


def config_type(kind: str) -> type[msgspec.Struct]:
    if kind == "build":
        from catalog.pipeline.config import BuildConfig

        return BuildConfig
    if kind == "calibrate":
        from optnav_cli.calibration.model import CalibrateSettings

        return CalibrateSettings
    if kind == "navigate":
        from optnav_cli.control_points.settings import NavigateSettings

        return NavigateSettings
    if kind == "hazard":
        from optnav_cli.hazard.settings import HazardSettings

        return HazardSettings
    if kind == "qso":
        from optnav_cli.orbit.qso.settings import QsoSettings

        return QsoSettings
    if kind == "orbit":
        from optnav_cli.orbit.fit.settings import OrbitFitSettings

        return OrbitFitSettings
    if kind == "delivery":
        from optnav_cli.orbit.delivery.settings import DeliverySettings

        return DeliverySettings
    if kind == "landing":
        from optnav_cli.orbit.landing.settings import LandingSettings

        return LandingSettings
    from optnav_cli.simulation.passes import Scenario

    return Scenario


@pytest.mark.parametrize("kind", TEMPLATES)
def test_a_template_shows_every_setting(kind: str) -> None:
    text = SHIPPED[f"templates/{kind}"].read_text(encoding="utf-8")
    assert wanted(config_type(kind)) - documented(text) == set()


def only_needed(type_: msgspec.inspect.Type, data: Any) -> Any:
    """The part of a config that may not be left out."""
    if isinstance(type_, msgspec.inspect.StructType):
        kept = [field for field in type_.fields if field.required]
        return {f.encode_name: only_needed(f.type, data[f.encode_name]) for f in kept}
    if isinstance(data, list):
        inner = getattr(type_, "item_type", msgspec.inspect.AnyType())
        return [only_needed(inner, item) for item in data]
    return data


@pytest.mark.parametrize("kind", TEMPLATES)
def test_a_template_states_the_defaults(kind: str) -> None:
    """A template without its optional settings means the same as the whole template."""
    type_ = config_type(kind)
    whole = tomllib.loads(SHIPPED[f"templates/{kind}"].read_text(encoding="utf-8"))
    needed = only_needed(msgspec.inspect.type_info(type_), whole)
    if kind == "build":  # the ground is needed, of one kind or the other
        needed["dem"] = [{"path": dem["path"]} for dem in whole["dem"]]
    if kind == "delivery":  # measurements are needed, of one kind or the other
        needed |= {"aim": whole["aim"], "station": whole["station"], "radio": {}}
    assert needed != whole
    stated = msgspec.to_builtins(msgspec.convert(whole, type_))
    default = msgspec.to_builtins(msgspec.convert(needed, type_))
    wrong = {
        name: (stated[name], default[name]) for name in stated if stated[name] != default[name]
    }
    assert wrong == {}


@pytest.mark.parametrize("kind", TEMPLATES)
def test_a_template_is_what_the_command_prints(kind: str) -> None:
    from click.testing import CliRunner

    from optnav_cli.commands.config import command

    result = CliRunner().invoke(command, ["template", kind])
    assert result.exit_code == 0
    assert result.stdout == SHIPPED[f"templates/{kind}"].read_text(encoding="utf-8")
