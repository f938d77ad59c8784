"""What pip installs works on its own: the wheel, in an empty environment, outside the checkout."""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
NEWEST = CHECKOUT / "build" / "newest-env" / "bin" / "python"


def call(*args: str | Path, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program away from the checkout; what it said is in the failure."""
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
    result = subprocess.run(
        [str(arg) for arg in args], cwd=folder, env=clean, capture_output=True, text=True
    )
    assert result.returncode == 0, f"{args[0]}: {result.stdout}\n{result.stderr}"
    return result


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, built with the backend that the lock pins."""
    folder = tmp_path_factory.mktemp("wheel")
    call(
        sys.executable, "-m", "build", "--wheel", "--no-isolation", "-o", folder, CHECKOUT,
        folder=folder,
    )  # fmt: skip
    (path,) = folder.glob("*.whl")
    return path


def newer_pythons() -> Iterator[str]:
    """Interpreters that may be newer than the one of the tests, the newest first.

    OPTNAV_NEWEST_PYTHON names the one to take; `make newest` makes one with all libraries.
    """
    if named := os.environ.get("OPTNAV_NEWEST_PYTHON"):
        yield named
        return
    if NEWEST.exists():
        yield str(NEWEST)
    for minor in range(sys.version_info.minor + 5, sys.version_info.minor, -1):
        if found := shutil.which(f"python3.{minor}"):
            yield found
        versions = Path.home() / ".pyenv" / "versions"
        yield from map(str, sorted(versions.glob(f"3.{minor}.*/bin/python")))


def newest_python() -> str:
    """The newest interpreter that has the libraries, numba among them; skips without one."""
    script = "import sys, numba, rasterio, cv2, scipy, pyproj, trimesh; print(sys.version_info[1])"
    for python in newer_pythons():
        found = subprocess.run([python, "-c", script], capture_output=True, text=True, check=False)
        if found.returncode == 0 and int(found.stdout) > sys.version_info.minor:
            return python
    ours = ".".join(map(str, sys.version_info[:2]))
    pytest.skip(f"no Python newer than {ours} with optnav's libraries here; `make newest` makes it")


@pytest.fixture(scope="session", params=["this Python", "newest Python"])
def installed(
    request: pytest.FixtureRequest, wheel: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The bin folder of an empty environment with the wheel in it.

    The libraries come from the environment of the interpreter through a path file, so that no
    network is needed; the checkout's own path file in there is not followed.
    """
    python = sys.executable if request.param == "this Python" else newest_python()
    folder = tmp_path_factory.mktemp("installed")
    call(python, "-m", "venv", "--without-pip", folder, folder=folder)
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    call(
        sys.executable, "-m", "pip", "--python", scripts / "python", "install", "--quiet",
        "--no-deps", "--no-index", wheel, folder=folder,
    )  # fmt: skip

    def paths(of: str | Path) -> list[str]:
        script = "import sysconfig as s; print(s.get_path('purelib')); print(s.get_path('platlib'))"
        return call(of, "-c", script, folder=folder).stdout.splitlines()

    site = Path(paths(scripts / "python")[0])
    (site / "libraries.pth").write_text("\n".join(sorted({*paths(python)})) + "\n")
    share_compiled_kernels(site)
    return scripts


def share_compiled_kernels(site: Path) -> None:
    """Let the installed package find the kernels that the checkout has compiled already.

    Compiling them anew takes a minute. Numba takes a stored kernel only where size and time of
    its source file are those that it was compiled from, so the files get the times of the checkout.
    """
    for package in ("catalog", "optnav_cli"):
        for source in (CHECKOUT / package).rglob("*.py"):
            copy = site / source.relative_to(CHECKOUT)
            assert copy.read_bytes() == source.read_bytes()
            shutil.copystat(source, copy)
        for kernel in (CHECKOUT / package).rglob("__pycache__/*.nb[ic]"):
            copy = site / kernel.relative_to(CHECKOUT)
            copy.parent.mkdir(exist_ok=True)
            shutil.copy2(kernel, copy)


def test_the_wheel_holds_all_modules_configs_and_data(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for package in ("catalog", "optnav_cli"):
        sources = {p.relative_to(CHECKOUT).as_posix() for p in (CHECKOUT / package).rglob("*.py")}
        assert sources <= names
    configs = {
        f"catalog/{p.relative_to(CHECKOUT).as_posix()}"
        for p in (CHECKOUT / "configs").rglob("*.toml")
    }
    assert configs <= names
    assert "catalog/data/tycho_gld100_256ppd.tif" in names
    assert "catalog/data/moon_gld100_4ppd.tif" in names
    for example in ("picture_folder", "picked_points"):
        folder = (CHECKOUT / "catalog/data" / example).rglob("*")
        assert {p.relative_to(CHECKOUT).as_posix() for p in folder if p.is_file()} <= names
    assert not [name for name in names if name.startswith("tests")]


def test_the_installed_package_is_the_one_that_runs(installed: Path, tmp_path: Path) -> None:
    script = (
        "import catalog, optnav_cli; from catalog.config import resource; "
        "print(catalog.__file__, optnav_cli.__file__, resource('configs/bodies/moon.toml'))"
    )
    for place in call(installed / "python", "-c", script, folder=tmp_path).stdout.split():
        assert place.startswith(str(installed.parent))


def test_the_installed_command_prints_templates(installed: Path, tmp_path: Path) -> None:
    text = call(installed / "optnav", "config", "template", "build", folder=tmp_path).stdout
    assert text == (CHECKOUT / "configs/templates/build.toml").read_text(encoding="utf-8")


def test_the_demo_runs_without_a_checkout(installed: Path, tmp_path: Path) -> None:
    """With one of its twelve pictures, and points checked by fewer trials: a slow test does all."""
    (config,) = installed.parent.rglob("catalog/configs/catalogs/tycho.toml")
    sparing = "[check]\ntrials = 3\nplaces = 1\n[render]\ncandidates = 4\n"
    config.write_text(config.read_text(encoding="utf-8") + sparing, encoding="utf-8")
    (scenario,) = installed.parent.rglob("catalog/configs/scenarios/demo.toml")
    text = scenario.read_text(encoding="utf-8")
    assert "passes = 2\nframes = 6\n" in text
    fewer = text.replace("passes = 2\nframes = 6\n", "passes = 1\nframes = 1\n")
    scenario.write_text(fewer, encoding="utf-8")
    result = call(installed / "optnav", "demo", "-o", "out", folder=tmp_path)
    out = tmp_path / "out"
    assert "report: " in result.stdout
    for name in (
        "tycho.gpkg", "pictures/truth.csv", "run/solution.csv", "run/matches.csv", "run/run.mcap",
        "run/manifest.json", "run/evaluation.json", "run/evaluation.csv", "report.html",
    ):  # fmt: skip
        assert (out / name).stat().st_size > 0, name
    evaluation = json.loads((out / "run/evaluation.json").read_text(encoding="utf-8"))
    assert evaluation["frames"] == 1
    assert evaluation["solved"] == 1
    assert "Traceback" not in result.stderr
