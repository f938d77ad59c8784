"""Builds of the whole Moon or a strip of it, each `optnav build` as a user runs it, and timed."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import msgspec

from catalog.jobs.usage import FILE, Account, StageAccount
from tests.bench.global_moon.clock import Used, run
from tests.bench.global_moon.place import CHECKOUT

CELLS = 41_252  # of 1 degree on a sphere
TRIALS = 5
PER_CELL = ("render", "select", "check", "write")  # stages whose work grows with the cells


class Build(NamedTuple):
    """A build that was done; `used` counts the whole command, with its start and libraries."""

    catalog: Path
    account: Account
    used: Used

    def stage(self, name: str) -> StageAccount:
        """What one stage used."""
        return next(stage for stage in self.account.stages if stage.name == name)

    @property
    def per_cell(self) -> Used:
        """Of the stages whose work grows with the cells."""
        stages = [self.stage(name) for name in PER_CELL]
        return Used(sum(s.seconds for s in stages), sum(s.cpu_s for s in stages))

    @property
    def whole_moon(self) -> Used:
        """What a build of all cells would use, scaled up from a strip's."""
        more = CELLS / self.account.cells - 1.0
        return Used(*(a + more * b for a, b in zip(self.used, self.per_cell)))

    @property
    def peak_bytes(self) -> tuple[int, int]:
        """Greatest memory of the coordinating process and of a worker."""
        total = self.account.total()
        return total.peak.bytes, total.worker_peak.bytes if total.worker_peak else 0


def build(
    folder: Path, name: str, raster: Path, *, workers: int, strip_deg: float = 360.0,
    size: int = 80, overviews_of: str | None = None,
) -> Build:  # fmt: skip
    """Build a catalog of five levels from nothing, or from the overviews of another build.

    folder, name  the catalog is folder/bench_NAME.gpkg; an earlier one of this name is removed
    strip_deg     only the cells of so many degrees of longitude, from pole to pole
    Raises SystemExit when the command fails.
    """
    remove(folder, name)
    catalog, work, config = results(folder, name)
    config.write_text(
        f'[body]\nname = "moon"\n\n[[dem]]\npath = {json.dumps(str(raster.resolve()))}\n\n'
        f"[grid]\ncell_deg = 1.0\n\n[pyramid]\nlevels = 5\nsize = {size}\n\n"
        f"[check]\ntrials = {TRIALS}\n",
        encoding="utf-8",
    )
    if overviews_of is not None:
        _share_overviews(results(folder, overviews_of)[1], work)
    words = ["build", str(config), "-o", str(catalog), "--work", str(work)]
    words += ["--workers", str(workers)]
    if strip_deg < 360.0:
        words += ["--bbox", f"0,-90,{strip_deg:g},90"]
    used = run_optnav(*words)
    return Build(catalog, read_account(folder, name), used)


def run_optnav(*words: str) -> Used:
    """Run the command. Raises SystemExit when it fails."""
    return run([sys.executable, "-m", "optnav_cli.main", *words], stdout=subprocess.DEVNULL)


def warm_up(folder: Path) -> None:
    """Compile all kernels, which the first build on a machine does once: two cells of Tycho."""
    remove(folder, "warm")
    catalog, work, _ = results(folder, "warm")
    config = CHECKOUT / "configs" / "catalogs" / "tycho.toml"
    run_optnav("build", str(config), "-o", str(catalog), "--work", str(work), "--workers", "1",
               "--bbox", "-12,-44,-9,-43")  # fmt: skip
    remove(folder, "warm")


def results(folder: Path, name: str) -> tuple[Path, Path, Path]:
    """The catalog, work folder and config of a build."""
    stem = folder / f"bench_{name}"
    return stem.with_suffix(".gpkg"), stem.with_suffix(".work"), stem.with_suffix(".toml")


def read_account(folder: Path, name: str) -> Account:
    """What a build of this name used."""
    return msgspec.json.decode((results(folder, name)[1] / FILE).read_bytes(), type=Account)


def remove(folder: Path, name: str) -> None:
    """Take away what an earlier build of this name left."""
    for path in results(folder, name):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _share_overviews(source: Path, work: Path) -> None:
    """A new work folder with the overviews of another, as links: they are only ever replaced."""

    def others(folder: str, names: list[str]) -> set[str]:
        top = Path(folder) == source
        return {name for name in names if top and not name.startswith(("dem-", "optnav-"))}

    shutil.copytree(source, work, ignore=others, copy_function=os.link)
