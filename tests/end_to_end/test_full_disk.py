"""Full and read-only places, real small file systems: a clear word, and the old file stays whole.

The file systems are mounted in a name space of their own, which goes with the process in it.
"""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from optnav_cli.main import run

CHECKOUT = Path(__file__).resolve().parents[2]
CONFIG = '[body]\nname = "moon"\n[[dem]]\npath = "dem.tif"\n[pyramid]\nlevels = 2\nsize = 48\n'
OPTNAV = f"{shlex.quote(sys.executable)} -m optnav_cli.main -q"
SIZE, PER_DEG = 256, 64.0


class Said(NamedTuple):
    """What the command came to, and what lies in the small file system afterwards."""

    code: int
    err: str
    left: list[str]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a terrain model, a config, its catalog and workspace, an older catalog
    (`old.gpkg`, of a config with another text) and an empty folder."""
    folder = tmp_path_factory.mktemp("made")
    rng = np.random.default_rng(5)
    heights = np.zeros((SIZE, SIZE), np.float32)
    for step in (4, 8, 16, 32):
        coarse = rng.normal(0.0, 12.0 * step, (SIZE // step, SIZE // step))
        heights += np.kron(coarse, np.ones((step, step))).astype(np.float32)
    with rasterio.open(
        folder / "dem.tif", "w", driver="GTiff", dtype="float32", count=1, width=SIZE, height=SIZE,
        crs="+proj=longlat +R=1737400 +no_defs",
        transform=Affine(1 / PER_DEG, 0, 9.0, 0, -1 / PER_DEG, 22.0),
    ) as file:  # fmt: skip
        file.write(heights, 1)
    (folder / "moon.toml").write_text(CONFIG)
    (folder / "small").mkdir()
    (folder / "old.toml").write_text(f"{CONFIG}# of last year\n")
    for name in ("old", "moon"):
        words = ["-q", "build", str(folder / f"{name}.toml"), "-o", str(folder / f"{name}.gpkg")]
        assert run([*words, "--workers", "1", "--bbox", "10,19,12,21"]) == 0
    return folder


@pytest.fixture
def on_small(made: Path) -> Callable[..., Said]:
    """Run a command in `made` with a file system of some bytes mounted at `small`."""
    unshare = shutil.which("unshare")
    if unshare is None or sys.platform != "linux":
        pytest.skip("needs Linux with unshare to mount a small file system")
    alone = [unshare, "--mount"] if os.geteuid() == 0 else [unshare, "-r", "--mount"]
    probe = [*alone, "mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(made / "small")]
    if subprocess.run(probe, capture_output=True, check=False).returncode != 0:
        pytest.skip("may not mount a small file system here")

    def call(size: int, before: str, command: str) -> Said:
        script = (
            f"mount -t tmpfs -o size={size} tmpfs small && {{ {before}; }} || exit 99\n"
            f"{command}\ncode=$?\nls -A small\nexit $code"
        )
        done = subprocess.run(
            [*alone, "bash", "-c", script], cwd=made, capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHONPATH": str(CHECKOUT)},
        )  # fmt: skip
        return Said(done.returncode, done.stderr, done.stdout.split())

    return call


BUILD = f"{OPTNAV} build moon.toml --workers 1 --bbox 10,19,12,21"
WHOLE = "cmp -s old.gpkg small/moon.gpkg && echo whole"


def one_line(said: Said, *words: str) -> None:
    assert said.code == 3, said
    (line,) = said.err.splitlines()
    assert line.startswith("optnav: ")
    for word in words:
        assert word in line


def test_a_full_disk_leaves_the_old_catalog_whole(
    made: Path, on_small: Callable[..., Said]
) -> None:
    """The old catalog and half of the new one fit."""
    size = (made / "moon.gpkg").stat().st_size
    copy = "cp old.gpkg small/moon.gpkg"
    command = f"{BUILD} -o small/moon.gpkg --work moon.gpkg.work; code=$?; {WHOLE}; (exit $code)"
    said = on_small(size * 3 // 2, copy, command)
    one_line(said, "small/moon.gpkg: cannot be written", "free some space")
    assert said.left == ["whole", "moon.gpkg"]
    room = on_small(size * 5 // 2, copy, command)
    assert room.code == 0, room  # what failed was the room


def test_a_full_disk_under_the_workspace_is_told(made: Path, on_small: Callable[..., Said]) -> None:
    said = on_small(32 * 1024, "true", f"{BUILD} -o new.gpkg --work small/work")
    # the TIFF library says so, too, before we do
    *library, line = said.err.splitlines()
    assert all("No space left" in word for word in library)
    one_line(said._replace(err=line), "small/work", "No space left", "free space")
    assert not (made / "new.gpkg").exists()


def test_a_read_only_place_is_told_and_the_old_catalog_stays(
    made: Path, on_small: Callable[..., Said]
) -> None:
    ready = "cp old.gpkg small/moon.gpkg && mount -o remount,ro small"
    said = on_small(
        1 << 24,
        ready,
        f"{BUILD} -o small/moon.gpkg --work moon.gpkg.work; c=$?; {WHOLE}; (exit $c)",
    )
    one_line(said, "small/moon.gpkg: cannot be written", "ead-only file system")
    assert said.left == ["whole", "moon.gpkg"]


@pytest.mark.parametrize("ending", ["geojson", "csv", "gpkg"])
def test_a_layer_that_does_not_fit_leaves_the_old_one(
    ending: str, made: Path, on_small: Callable[..., Said]
) -> None:
    place = f"small/points.{ending}"
    export = f"{OPTNAV} catalog export moon.gpkg -o"
    fill = "cat /dev/zero > small/rest 2>/dev/null; true"
    said = on_small(
        1 << 20,
        f"{export} {place} > /dev/null && cp {place} old && {{ {fill}; }}",
        f"{export} {place}; code=$?; cmp -s old {place} && echo whole; (exit $code)",
    )
    one_line(said, place, "cannot be written")
    assert said.left[0] == "whole"
    assert not any("partial" in name for name in said.left)
