"""Floors: a module imports only from lower floors, and no modules import in a circle."""

import ast
import graphlib
import re
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGES = ("catalog", "optnav_cli")

# Lowest first. An image arrives with the first floor of optnav_cli.
FLOORS = (
    {"catalog.errors", "catalog.arrays"},
    {"catalog.inputs", "catalog.keywords", "catalog.special_values"},
    {"catalog.places"},
    {"catalog.config", "catalog.progress", "catalog.files", "catalog.cache", "catalog.geometry"},
    {"catalog.raster_files", "catalog.photometry"},
    {"catalog.rasters"},
    {"catalog.bodies", "catalog.tables"},
    {"catalog.terrain", "catalog.control_point"},
    {"catalog.rendering", "catalog.correlation"},
    {"catalog.selection", "catalog.store"},
    {"catalog.jobs", "catalog.inspect"},
    {"catalog.pipeline"},
    {"catalog.api"},
    {"optnav_cli.reasons", "optnav_cli.options"},
    {"optnav_cli.fix", "optnav_cli.estimation"},
    {"optnav_cli.camera"},
    {"optnav_cli.frames"},
    {"optnav_cli.dynamics", "optnav_cli.output"},
    {
        "optnav_cli.archives",
        "optnav_cli.control_points",
        "optnav_cli.evaluation",
        "optnav_cli.outline",
        "optnav_cli.simulation",
    },
    {"optnav_cli.report"},
    {"optnav_cli.cylinder", "optnav_cli.hazard", "optnav_cli.points", "optnav_cli.stars"},
    {"optnav_cli.orbit"},
    {"optnav_cli.navigate"},
    {"optnav_cli.calibration", "optnav_cli.stereo"},
    {"optnav_cli.pages"},
    {"optnav_cli.api"},
    {"optnav_cli.console"},
    {"optnav_cli.options"},
    {"optnav_cli.commands"},
    {"optnav_cli.main"},
)
FLOOR_OF = {unit: number for number, units in enumerate(FLOORS, start=1) for unit in units}


def unit_of(module: str) -> str:
    """The part of the house a module belongs to: package and folder, or package and file."""
    return ".".join(module.split(".")[:2])


def modules(root: Path = CHECKOUT) -> Iterator[tuple[str, Path]]:
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            yield ".".join(parts).removesuffix(".__init__"), path


def is_module(name: str, root: Path) -> bool:
    """Whether a full name is that of a file or a package."""
    place = root.joinpath(*name.split("."))
    return place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()


def imports(module: str, path: Path, root: Path = CHECKOUT) -> Iterator[str]:
    """Full names of the project's modules that a module imports, wherever in it."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*above, base]).rstrip(".")
            # `from catalog import config` names a module, `from catalog.config import x` has it
            names = [f"{base}.{alias.name}" for alias in node.names]
            names = [name if base in PACKAGES or is_module(name, root) else base for name in names]
        else:
            continue
        yield from (name for name in names if name.split(".")[0] in PACKAGES)


def faults(root: Path = CHECKOUT) -> list[str]:
    """What breaks the house's rule, one line each."""
    found = []
    for module, path in modules(root):
        unit = unit_of(module)
        if module not in PACKAGES and unit not in FLOOR_OF:
            found.append(f"{unit} stands on no floor")
            continue
        for name in imports(module, path, root):
            other = unit_of(name)
            if other == unit or name in PACKAGES or name.endswith(".__version__"):
                continue
            if other not in FLOOR_OF:
                found.append(f"{module} imports {name}, which stands on no floor")
            elif FLOOR_OF[other] >= FLOOR_OF.get(unit, 0):
                found.append(f"{module} imports {name}, which is not on a lower floor")
    return sorted(set(found))


def circle(root: Path = CHECKOUT) -> list[str]:
    """Modules each of which imports the next, the first one again last; empty where there are none.

    Imports for types alone count: they make a reader go in a circle as well.
    """
    graph = {module: set(imports(module, path, root)) - {module} for module, path in modules(root)}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def test_modules_import_only_from_lower_floors() -> None:
    assert faults() == []


def test_each_unit_of_the_floors_is_there() -> None:
    there = {unit_of(module) for module, _ in modules()}
    assert set(FLOOR_OF) == there - set(PACKAGES)


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert circle() == []


def test_a_circle_is_found_where_types_alone_are_imported(tmp_path: Path) -> None:
    folder = tmp_path / "catalog" / "terrain"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("from catalog.terrain import b\n")
    (folder / "b.py").write_text("if TYPE_CHECKING:\n    from .c import d\n")
    assert circle(tmp_path) == []
    (folder / "c.py").write_text("def f():\n    import catalog.terrain.a\n")
    assert set(circle(tmp_path)) == {f"catalog.terrain.{name}" for name in "abc"}


@pytest.mark.parametrize(
    ("path", "text", "fault"),
    [
        ("catalog/weather/wind.py", "", "catalog.weather stands on no floor"),
        ("catalog/errors.py", "import optnav_cli.main", "imports optnav_cli.main"),
        ("catalog/terrain/a.py", "from catalog.correlation.ncc import f", "catalog.correlation"),
        ("catalog/bodies/a.py", "def f():\n  from ..terrain import b", "imports catalog.terrain"),
        ("catalog/errors.py", "from catalog import config", "imports catalog.config"),
    ],
)
def test_a_breach_of_the_floors_is_found(path: str, text: str, fault: str, tmp_path: Path) -> None:
    file = tmp_path / path
    file.parent.mkdir(parents=True)
    file.write_text(text)
    assert any(fault in line for line in faults(tmp_path))


def test_files_of_one_folder_may_import_each_other(tmp_path: Path) -> None:
    folder = tmp_path / "catalog" / "terrain"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("from catalog.terrain.b import c\nfrom . import d\n")
    assert faults(tmp_path) == []


def test_pytest_enters_every_folder_of_tests(pytestconfig: pytest.Config):
    """Its own list of folders to skip has `build` and `dist` in it."""
    skipped = pytestconfig.getini("norecursedirs")
    folders = {path.parent for path in (CHECKOUT / "tests").rglob("test_*.py")}
    names = {part for folder in folders for part in folder.relative_to(CHECKOUT).parts}
    assert not [name for name in names if any(fnmatch(name, skip) for skip in skipped)]


def test_each_extra_is_imported_somewhere() -> None:
    """Of pyproject.toml, all but those of the tests' own tools, which commands start."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    texts = "".join(
        path.read_text(encoding="utf-8")
        for folder in (*PACKAGES, "tests")
        for path in (CHECKOUT / folder).rglob("*.py")
    )
    extras = project["optional-dependencies"]
    for name in set(extras) - {"test"}:
        for requirement in extras[name]:
            package = re.split(r"[>=<!~ \[]", requirement)[0].replace("-", "_")
            assert re.search(rf"(import|from) {package}\b|[\"']{package}[\"'.]", texts), requirement
