"""The parts of the bench; each does its work in processes of their own and prints what it found."""

import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import ParamSpec, TypeVar

from catalog.jobs.workers import count_cores
from optnav_cli.output.wording import format_account
from tests.bench.global_moon import builds, hillshade
from tests.bench.global_moon.clock import Used
from tests.bench.global_moon.place import MODEL_PPD, raster_path, size_of

P = ParamSpec("P")
R = TypeVar("R")

BUILD_S, PASSES, WORKER_GB, SPEED_UP, FILE_GB = 720.0, 12.0, 2.0, 1.8, 1.5  # the figures' limits
WORKERS = 2
STRIP_DEG = 7.2  # of the parts that compare builds: 1/50 of the cells, all latitudes
SHORTLIST_PPD = 64  # 474 m


class Bench:
    """The parts, in their order; each prints what it found."""

    def __init__(self, folder: Path, model: Path, ppd: int, strip_deg: float) -> None:
        self.folder, self.model, self.ppd, self.strip_deg = folder, model, ppd, strip_deg
        self.raster = raster_path(folder, ppd)
        self.shade: Used | None = None
        self.peaks: dict[int, tuple[int, int]] = {}

    def ground(self) -> None:
        """Make the raster; compare it with the real ground where their postings agree."""
        print(f"ground: {self.raster}", flush=True)
        for line in apart(_ground_lines, self.model, self.raster, self.ppd // MODEL_PPD):
            print(line)

    def hillshade(self) -> None:
        """The yardstick."""
        self.shade = hillshade.one_pass(self.raster, self.folder)
        rate = size_of(self.raster) / 2e6 / self.shade.wall_s
        print(f"hillshade: {_seconds(self.shade)}, {rate:.0f} Mpx/s")

    def build(self) -> None:
        """The catalog, from the raster."""
        self._whole_build("full", self.raster, self.ppd)

    def real(self) -> None:
        """The catalog from the real model."""
        self._whole_build("model", self.model, MODEL_PPD)

    def catalog(self) -> None:
        """Figures of the catalog built last."""
        path = builds.results(self.folder, "full")[0]
        if not path.is_file():
            raise SystemExit(f"{path}: is not there; the part `build` makes it")
        for line in apart(_catalog_lines, path, self.strip_deg >= 360.0):
            print(line)

    def workers(self) -> None:
        """One worker against two on a strip; the same bytes."""
        base = self._overviews()
        made = {}
        for name, count in (("one", 1), ("two", 2)):
            made[count] = builds.build(
                self.folder, name, self.raster,
                workers=count, strip_deg=STRIP_DEG, overviews_of=base,
            )  # fmt: skip
        one, two = made[1], made[2]
        gain = one.per_cell.wall_s / two.per_cell.wall_s
        print(
            f"workers: {one.account.cells} cells, render to write: 1 worker "
            f"{one.per_cell.wall_s:.1f} s, 2 workers {two.per_cell.wall_s:.1f} s: "
            f"{gain:.2f} times as fast (wanted {SPEED_UP:g})"
        )
        for stage in builds.PER_CELL:
            a, b = one.stage(stage), two.stage(stage)
            print(
                f"  {stage:8} {a.seconds:7.1f} s {b.seconds:7.1f} s, processor {a.cpu_s:7.1f} s "
                f"{b.cpu_s:7.1f} s"
            )
        same = apart(_digests, [one.catalog, two.catalog])
        print("  digests " + ("are the same" if len(set(same)) == 1 else f"DIFFER: {same}"))

    def nodes96(self) -> None:
        """The size of a catalog with patches of 96 nodes, from a strip."""
        made = builds.build(
            self.folder, "nodes96", self.raster,
            workers=WORKERS, strip_deg=STRIP_DEG, size=96, overviews_of=self._overviews(),
        )  # fmt: skip
        points = made.account.points or 0
        size_gb = size_of(made.catalog) / points * builds.CELLS / 1e9 if points else float("nan")
        print(f"96 nodes: {size_gb:.2f} GB for {builds.CELLS} points, from {points} of a strip")

    def selection(self) -> None:
        """Selection alone, from the real model and from a raster at 474 m."""
        finer = raster_path(self.folder, SHORTLIST_PPD)
        for line in apart(_ground_lines, self.model, finer, SHORTLIST_PPD // MODEL_PPD):
            print(line)
        for raster in (self.model, finer):
            for line in apart(_shortlist_lines, raster, self.folder):
                print(line)

    def _whole_build(self, name: str, raster: Path, ppd: int) -> None:
        builds.warm_up(self.folder)
        made = builds.build(self.folder, name, raster, workers=WORKERS, strip_deg=self.strip_deg)
        what = ""
        if self.strip_deg < 360.0:
            what = f", scaled up from {made.account.cells}"
        print(
            f"build at {ppd} px/deg, {WORKERS} workers of {count_cores()} cores: "
            f"{_seconds(made.used)}"
        )
        for line in format_account(made.account):
            print(f"  {line}")
        moon = made.whole_moon
        wanted = f" (wanted {BUILD_S / 60.0:.0f})" if raster == self.raster else ""
        print(
            f"  {builds.CELLS} cells{what}: {moon.wall_s / 60.0:.1f} min{wanted}, "
            f"processors {moon.cpu_s / 60.0:.1f} min"
        )
        if self.shade is not None and raster == self.raster:
            print(
                f"  {moon.wall_s / self.shade.wall_s:.1f} passes of hillshade by the clock "
                f"(wanted {PASSES:g}), {moon.cpu_s / self.shade.cpu_s:.1f} by processor time"
            )
        self.peaks[ppd] = made.peak_bytes
        for at, (own, worker) in sorted(self.peaks.items()):
            print(
                f"  peak memory at {at} px/deg: coordinator {own / 1e9:.2f} GB, a worker "
                f"{worker / 1e9:.2f} GB (wanted {WORKER_GB:g})"
            )
        points = made.account.points or 1
        size_gb = size_of(made.catalog) / points * builds.CELLS / 1e9
        print(f"  catalog {size_gb:.2f} GB{what} (wanted {FILE_GB:g})", flush=True)

    def _overviews(self) -> str:
        """A build whose work folder has this raster's overviews, made now when there is none."""
        work = builds.results(self.folder, "full")[1]
        if not work.is_dir():
            builds.build(self.folder, "full", self.raster, workers=WORKERS, strip_deg=1.0)
        return "full"


def _seconds(used: Used) -> str:
    return f"{used.wall_s:.1f} s by the clock, {used.cpu_s:.1f} s of processors"


def apart(function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Call in a process of its own.

    A process hands its memory's high-water mark on to those that it starts: this one must stay
    small, or the builds would be told its mark for theirs.
    """
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *args, **kwargs).result()


def _ground_lines(model: Path, raster: Path, factor: int) -> list[str]:
    from tests.bench.global_moon import likeness, terrain

    def tell(share: str) -> None:
        print(f"\r  {share}", end="", file=sys.stderr, flush=True)

    started = time.monotonic()
    if terrain.make(model, raster, factor, tell):
        lines = [f"  {raster.name} made in {time.monotonic() - started:.0f} s"]
    else:
        lines = [f"  {raster.name} is there, by the same recipe"]
    crop = likeness.real_crop()
    if likeness.fits(raster, crop):
        made = likeness.statistics(likeness.crop_of(raster, crop), crop)
        lines.append("  against GLD100's own 118 m about Tycho:")
        lines.append(likeness.table(likeness.statistics(crop.heights, crop), made))
    return lines


def _catalog_lines(path: Path, whole: bool) -> list[str]:
    from tests.bench.global_moon.figures import catalog_lines

    return list(catalog_lines(path, whole))


def _digests(paths: list[Path]) -> list[str]:
    from tests.bench.global_moon.figures import digest_of

    return [digest_of(path) for path in paths]


def _shortlist_lines(raster: Path, folder: Path) -> list[str]:
    from tests.bench.global_moon.shortlist import shortlist_lines

    return list(shortlist_lines(raster, folder))


PARTS: dict[str, Callable[[Bench], None]] = {
    "ground": Bench.ground,
    "hillshade": Bench.hillshade,
    "build": Bench.build,
    "catalog": Bench.catalog,
    "workers": Bench.workers,
    "nodes96": Bench.nodes96,
    "real": Bench.real,
    "selection": Bench.selection,
}
