"""The build of a catalog, stage by stage on a workspace; what is done is not done again."""

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

import catalog
from catalog.bodies.body import Body, load_body
from catalog.control_point import ControlPoint
from catalog.errors import ConfigError, NothingToDoError, UsageError
from catalog.geometry.cells import CellGrid
from catalog.progress import Progress, SilentProgress
from catalog.stages import check, render, select, write
from catalog.stages.chunked import read_chunks, run_chunks
from catalog.stages.code_key import code_key
from catalog.stages.context import StageContext
from catalog.stages.ingest import Bbox, DemRecord, chunks_of, covered_cells, ingest
from catalog.stages.records import encode_records
from catalog.stages.settings import BuildConfig, load_build_config
from catalog.stages.workers import available_cores, workers_of
from catalog.stages.workspace import Workspace, stage_key
from catalog.store.features import reasons_text
from catalog.store.partial import check_place

STAGES = ("ingest", "render", "select", "check", "write")
MANIFEST = "manifest.json"
MOST_OVERSAMPLING = 4.0  # a posting finer than the terrain model by more shows nothing new
MOST_NODES_ACROSS = 8192  # of a cell: a grid of 268 MB, of which a worker holds several


@dataclass
class StageAccount:
    """What a stage did: pieces done now, pieces found done, seconds."""

    name: str
    done: int = 0
    kept: int = 0
    seconds: float = 0.0


@dataclass
class BuildReport:
    """What came of a run; points, usable and digest are there once the catalog is written."""

    work: Path
    dems: list[DemRecord]
    cells: int
    accounts: list[StageAccount] = field(default_factory=list)
    output: Path | None = None
    points: int = 0
    usable: int = 0
    digest: str = ""


def run(
    config_path: Path,
    work: Path | None = None,
    *,
    stages: Sequence[str] = STAGES,
    output: Path | None = None,
    workers: int | None = None,
    bbox: Bbox | None = None,
    progress: Progress | None = None,
) -> BuildReport:
    """Run stages of a build; results of earlier runs with the same settings are used.

    work     the work folder; without it OUTPUT.work beside the output. It is kept.
    stages   some of STAGES, run in their order
    output   the catalog, for the write stage
    workers  processes; 1 works in this one, None takes all cores
    bbox     west, south, east, north (deg): only cells whose middle lies inside
    Raises an OptnavError; NothingToDoError when the catalog, though written, has no usable point.
    """
    wanted = [stage for stage in STAGES if stage in stages]
    if "write" in wanted and output is None:
        raise UsageError("the write stage needs a place for the catalog; name it with -o")
    if workers is not None and workers < 1:
        raise UsageError(f"--workers {workers}: wanted 1 or more")
    if output is not None:
        check_place(output)  # before hours of work for a place that cannot be used
    if work is None:
        if output is None:
            raise UsageError("name a work folder with --work")
        work = output.with_name(output.name + ".work")
    config = load_build_config(config_path)
    try:
        body = load_body(config.body.name)
    except ConfigError as error:
        raise ConfigError(f"{config_path}: [body] name: {error}") from None
    workspace = Workspace(work)
    with workspace.locked():
        build = _Build(workspace, config, config_path, body, workers, progress or SilentProgress())
        try:
            return build.run(wanted, bbox, output)
        finally:
            build.workers.close()


class _Build:
    """One run on a workspace that is held."""

    def __init__(
        self,
        workspace: Workspace,
        config: BuildConfig,
        config_path: Path,
        body: Body,
        workers: int | None,
        progress: Progress,
    ) -> None:
        self.workspace, self.config, self.config_path = workspace, config, config_path
        self.body, self.progress = body, progress
        self.count = workers or available_cores()
        self.workers = workers_of(self.count)
        self.keys: dict[str, str] = {}

    def run(self, wanted: Sequence[str], bbox: Bbox | None, output: Path | None) -> BuildReport:
        """All wanted stages in order; a stage whose forerunner is not done is refused."""
        report = BuildReport(self.workspace.folder, [], 0)
        with _timed(report, "ingest"):
            context, chunks = self._ingest(bbox, report)
        if "render" in wanted:
            with _timed(report, "render") as account:
                self._run_chunks(render.render_chunk, render.Record, context, chunks, account)
        if "select" in wanted:
            with _timed(report, "select") as account:
                self._select(context, len(chunks), account)
        if "check" in wanted:
            with _timed(report, "check") as account:
                chosen = _pieces(self._chosen(), chunks)
                self._run_chunks(check.check_chunk, check.Record, context, chosen, account)
        if "write" in wanted and output is not None:
            with _timed(report, "write"):
                chosen = _pieces(self._chosen(), chunks)
                self._write(context, len(chosen), output, report)
        return report

    def _ingest(
        self, bbox: Bbox | None, report: BuildReport
    ) -> tuple[StageContext, list[list[int]]]:
        """The settled world; cheap when the overviews are there, so every stage begins with it."""
        mosaic, report.dems = ingest(
            self.workspace,
            self.config.dem,
            self.config_path.parent,
            self.body,
            self.count,
            self.progress,
        )
        grid = CellGrid(self.config.grid.cell_deg)
        posting = self.config.pyramid.posting_m or mosaic.posting_m
        self._check_posting(posting, mosaic.posting_m)
        reach = posting * self.config.pyramid.size * 2 ** (self.config.pyramid.levels - 1)
        if reach > self.body.radius_m:
            raise ConfigError(
                f"{self.config_path}: [pyramid] the coarsest patch would be {reach / 1e3:.0f} km "
                f"wide on a body of {self.body.radius_m / 1e3:.0f} km radius; "
                "wanted fewer levels, a smaller size or a finer posting_m"
            )
        cells = covered_cells(mosaic, grid, bbox)
        report.cells = int(cells.size)
        # paths and ranks do not matter by themselves: what was read, and in which order, does
        read = [(dem.sha256, dem.folder) for dem in report.dems]
        key = stage_key(code_key(), self.body.name, read, cells.tolist())
        self.keys = {"ingest": key}
        for stage, parts in (
            ("render", (self.config.grid, self.config.pyramid, posting, self.config.render)),
            ("select", (self.config.select,)),
            ("check", (self.config.check,)),
        ):
            key = stage_key(key, stage, parts)
            self.keys[stage] = key
        self.workspace.put(MANIFEST, msgspec.json.format(self._manifest(report), indent=2))
        return StageContext(self.body, mosaic, grid, posting, self.config), chunks_of(grid, cells)

    def _check_posting(self, posting_m: float, finest_m: float) -> None:
        """Refuse a posting that shows nothing more, or more nodes in a cell than memory holds."""
        if posting_m < finest_m / MOST_OVERSAMPLING:
            raise ConfigError(
                f"{self.config_path}: [pyramid] posting_m is {posting_m:g}, but the finest terrain "
                f"model has {finest_m:.6g} m; wanted at least {finest_m / MOST_OVERSAMPLING:.6g}, "
                "or leave it out"
            )
        across = math.radians(self.config.grid.cell_deg) * self.body.radius_m / posting_m
        if across > MOST_NODES_ACROSS:
            raise ConfigError(
                f"{self.config_path}: a cell of {self.config.grid.cell_deg:g} deg is {across:.0f} "
                f"nodes of {posting_m:g} m wide; wanted at most {MOST_NODES_ACROSS}: set a smaller "
                "[grid] cell_deg or a coarser [pyramid] posting_m"
            )

    def _manifest(self, report: BuildReport) -> bytes:
        return msgspec.json.encode(
            {
                "software": f"optnav {catalog.__version__}",
                "body": self.body.name,
                "dems": report.dems,
                "cells": report.cells,
                "keys": self.keys,
                "config": self.config,
            }
        )

    def _run_chunks(
        self,
        function: Callable[[Any, Any], Sequence[msgspec.Struct]],
        type_: type[Any],
        context: StageContext,
        chunks: Sequence[Sequence[Any]],
        account: StageAccount,
    ) -> None:
        stage, key = account.name, self.keys[account.name]
        account.done, account.kept = run_chunks(
            self.workspace,
            stage,
            key,
            function,
            type_,
            context,
            chunks,
            self.workers,
            self.progress,
        )
        self.workspace.keep_only(stage, {key})

    def _select(self, context: StageContext, count: int, account: StageAccount) -> None:
        key = self.keys["select"]
        if self.workspace.records(_select_name(key), select.Record) is not None:
            account.kept = 1
            return
        records = read_chunks(self.workspace, "render", self.keys["render"], count, render.Record)
        if records is None:
            raise self._missing("render")
        records.sort(key=lambda record: record.cell)
        with self.progress.stage("select", total=len(records), unit="cell") as shown:
            chosen = select.select(context, records)
            self.workspace.put(_select_name(key), encode_records(chosen))
            shown.advance(len(records))
        account.done = 1
        self.workspace.keep_only("select", {key})

    def _chosen(self) -> list[select.Record]:
        records = self.workspace.records(_select_name(self.keys["select"]), select.Record)
        if records is None:
            raise self._missing("select")
        return records

    def _write(self, context: StageContext, count: int, output: Path, report: BuildReport) -> None:
        records = read_chunks(self.workspace, "check", self.keys["check"], count, check.Record)
        if records is None:
            raise self._missing("check")
        points: list[ControlPoint] = [record.point(context) for record in records]
        # a cell at a model's edge may have ground, yet none where its place is: no point there
        points = [point for point in points if math.isfinite(point.radius_m)]
        if not points:
            raise NothingToDoError(
                f"{self.config_path}: no cell has room for a control point on the terrain models; "
                "wanted finest patches that lie on them whole: "
                "lower [pyramid] size or posting_m, or give more ground"
            )
        written = write.write(
            context,
            points,
            output,
            sources=_sources(report.dems),
            config_text=self.config_path.read_text(encoding="utf-8-sig"),
            workers=self.workers,
            progress=self.progress,
        )
        report.output, report.points = written.path, written.count
        report.usable, report.digest = written.usable, written.digest
        if written.usable == 0:
            raise NothingToDoError(
                f"{output}: written, but none of its {written.count} control points is usable "
                f"({_reasons(points)}); no data wants more ground around the cells or smaller "
                "patches ([pyramid] levels, size), the rest is judged by [check]"
            )

    def _missing(self, stage: str) -> UsageError:
        return UsageError(
            f"{self.workspace.folder}: holds no complete result of `{stage}` for this config; "
            f"first run: optnav {stage} {self.config_path} --work {self.workspace.folder}"
        )


def _sources(dems: Sequence[DemRecord]) -> dict[str, str]:
    """Hashes of the terrain models by name; of two with one name the second tells its priority."""
    sources: dict[str, str] = {}
    for dem in dems:
        name = dem.name if dem.name not in sources else f"{dem.name} ({dem.priority})"
        sources[name] = dem.sha256
    return sources


def _reasons(points: Sequence[ControlPoint]) -> str:
    """What keeps points from use, the most frequent first: "3 no data, 1 flat"."""
    counts = Counter(reasons_text(flag) for point in points for flag in point.flags)
    return ", ".join(f"{count} {reason}" for reason, count in counts.most_common())


def _select_name(key: str) -> str:
    return f"select-{key}/records.bin"


def _pieces(
    records: Sequence[select.Record], chunks: Sequence[Sequence[int]]
) -> list[list[select.Record]]:
    """Selected records cut as their cells were cut for rendering; empty pieces left out."""
    by_cell = {record.cell: record for record in records}
    pieces = [[by_cell[cell] for cell in chunk if cell in by_cell] for chunk in chunks]
    return [piece for piece in pieces if piece]


@contextmanager
def _timed(report: BuildReport, name: str) -> Iterator[StageAccount]:
    account = StageAccount(name)
    started = time.monotonic()
    yield account
    account.seconds = time.monotonic() - started
    report.accounts.append(account)
