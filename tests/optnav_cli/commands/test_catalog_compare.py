"""`optnav catalog compare` and `optnav build --check`: how a pipeline guards a release."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from catalog.store.verify import verify
from optnav_cli.main import run

CONFIG = '[body]\nname = "moon"\n[[dem]]\npath = "dem.tif"\n[pyramid]\nlevels = 2\nsize = 48\n'
SIZE, PER_DEG = 256, 64.0


class Said(NamedTuple):
    """What a command came to."""

    code: int
    out: str
    err: str


class World:
    """A folder with a terrain model and a config, in which commands are run."""

    def __init__(self, folder: Path, capture: pytest.CaptureFixture[str]) -> None:
        self.folder, self.capture = folder, capture

    def write_dem(self, more_m: float = 0.0) -> None:
        """A rough square of 4 degrees; one of its corners is raised by more_m."""
        rng = np.random.default_rng(5)
        heights = np.zeros((SIZE, SIZE), np.float32)
        for step in (4, 8, 16, 32):
            coarse = rng.normal(0.0, 12.0 * step, (SIZE // step, SIZE // step))
            heights += np.kron(coarse, np.ones((step, step))).astype(np.float32)
        heights[: SIZE // 2, : SIZE // 2] += np.float32(more_m)
        with rasterio.open(
            self.folder / "dem.tif", "w", driver="GTiff", dtype="float32", count=1, width=SIZE,
            height=SIZE, crs="+proj=longlat +R=1737400 +no_defs",
            transform=Affine(1 / PER_DEG, 0, 9.0, 0, -1 / PER_DEG, 22.0),
        ) as file:  # fmt: skip
            file.write(heights, 1)

    def optnav(self, *args: object) -> Said:
        self.capture.readouterr()
        code = run(["-q", *(str(arg) for arg in args)])
        return Said(code, *self.capture.readouterr())

    def build(self, output: str, *more: object) -> Said:
        return self.optnav(
            "build", self.folder / "moon.toml", "-o", self.folder / output, "--work",
            self.folder / "work", "--workers", 1, "--bbox", "10,19,12,21", *more,
        )  # fmt: skip

    def __truediv__(self, name: str) -> Path:
        return self.folder / name


@pytest.fixture
def world(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Iterator[World]:
    """A world with release.gpkg built from it."""
    before = logging.getLogger().handlers[:]
    made = World(tmp_path, capfd)
    made.write_dem()
    (tmp_path / "moon.toml").write_text(CONFIG)
    assert made.build("release.gpkg").code == 0
    yield made
    logging.captureWarnings(False)
    for handler in set(logging.getLogger().handlers) - set(before):
        logging.getLogger().removeHandler(handler)


def test_a_rebuilt_catalog_passes_the_check_and_a_changed_model_does_not(world: World) -> None:
    again = world.build("new.gpkg", "--check", world / "release.gpkg")
    assert again.code == 0, again.err
    assert "content: the same" in again.out
    world.write_dem(more_m=40.0)
    (world / "release.gpkg").chmod(0o444)
    differs = world.build("new.gpkg", "--check", world / "release.gpkg")
    assert differs.code == 5
    assert "radius of points in place: " in differs.out or "moved: " in differs.out
    assert "not content: source dem.tif: " in differs.out
    (line,) = differs.err.splitlines()
    assert line.startswith(f"optnav: {world / 'new.gpkg'}: differs from {world / 'release.gpkg'}: ")
    assert verify(world / "new.gpkg").sound  # written all the same
    assert f"digest: {verify(world / 'new.gpkg').stated}" in differs.out
    told = world.optnav("catalog", "compare", world / "release.gpkg", world / "new.gpkg")
    assert (told.code, told.err) == (5, differs.err)
    assert told.out in differs.out


def test_the_table_is_written_and_named(world: World) -> None:
    table = world / "all.csv"
    said = world.optnav(
        "catalog", "compare", world / "release.gpkg", world / "release.gpkg", "-o", table
    )
    assert said.code == 0
    assert f"table: {table}: 0 points" in said.out
    assert table.read_text().startswith("id,change,moved_m")
    assert table.read_text().count("\n") == 1


def test_a_check_that_cannot_be_made_is_told_before_any_work(world: World) -> None:
    """Damage, no such file, and the very catalog that is to be replaced."""
    release = (world / "release.gpkg").read_bytes()
    (world / "work").rename(world / "old-work")
    same = world.build("release.gpkg", "--check", world / "release.gpkg")
    assert (same.code, "keep a copy" in same.err) == (2, True)
    (world / "link.gpkg").symlink_to(world / "release.gpkg")
    assert world.build("link.gpkg", "--check", world / "release.gpkg").code == 2
    assert world.build("new.gpkg", "--check", world / "none.gpkg").code == 3
    data = bytearray(release)
    data[2 * 65536 - 1000 :: 65536] = bytes(b ^ 1 for b in data[2 * 65536 - 1000 :: 65536])
    (world / "damaged.gpkg").write_bytes(data)
    damaged = world.build("new.gpkg", "--check", world / "damaged.gpkg")
    assert (damaged.code, "is damaged" in damaged.err) == (3, True)
    assert not (world / "new.gpkg").exists()
    assert not (world / "work").exists()
    assert (world / "release.gpkg").read_bytes() == release
