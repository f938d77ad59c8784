"""The build of a catalog, stage by stage on a workspace; what is done is not done again."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

import catalog
from catalog.bodies.body import Body, load_body
from catalog.control_point import ControlPoint
from catalog.errors import ConfigError, NothingToDoError, UsageError
from catalog.files import check_file
from catalog.jobs import MAX_WORKERS, usage
from catalog.jobs.cluster import check_address, start_cluster_workers
from catalog.jobs.usage import Account, StageAccount
from catalog.jobs.workers import count_cores, make_workers
from catalog.jobs.workspace import MARK, ChunkResults, Workspace, compute_stage_key, encode_records
from catalog.pipeline import check, render, write
from catalog.pipeline.comparison import report_fit
from catalog.pipeline.config import BuildConfig, ConfigText
from catalog.pipeline.context import DemRecord, IngestRun
from catalog.pipeline.ingest import Bbox, MeshRecord
from catalog.pipeline.inputs import BuildInputs, prepare_inputs
from catalog.pipeline.relief import read_stored_relief
from catalog.pipeline.render import RenderedCell, SelectedCell
from catalog.pipeline.write import CatalogExtras, find_published, record_published
from catalog.places import lock_output
from catalog.progress import Progress, SilentProgress, log_stage
from catalog.store.connection import SIDECARS, is_catalog_file
from catalog.store.patches import PreparedPoint
from catalog.terrain.dem.file import resolve_path

log = logging.getLogger(__name__)

STAGES = ("ingest", "render", "select", "check", "write")


@dataclass
class BuildReport:
    """Result of a run; output and digest are set once the catalog is written."""

    work: Path
    account: Account
    dems: list[DemRecord | MeshRecord] = field(default_factory=list)
    output: Path | None = None
    points: int = 0
    usable: int = 0
    digest: str = ""


def run(
    source: Path | ConfigText,
    work: Path | None = None,
    *,
    stages: Sequence[str] = STAGES,
    output: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    bbox: Bbox | None = None,
    progress: Progress | None = None,
) -> BuildReport:
    """Run stages of a build; results of earlier runs with the same settings are used.

    source   a config file, or a config that stands in none
    work     the work folder; without it OUTPUT.work beside the output. It is kept.
    stages   some of STAGES, run in their order
    output   the catalog, for the write stage
    workers  processes; 1 works in this one, None takes all cores
    scheduler  tcp://HOST:PORT of a dask cluster, whose workers do the work instead of processes
             here; the terrain models and the work folder have the same paths there
    bbox     west, south, east, north (deg): only cells whose middle lies inside
    Raises an OptnavError; NothingToDoError when the catalog, though written, has no usable point.
    """
    wanted = [stage for stage in STAGES if stage in stages]
    if "write" in wanted and output is None:
        raise UsageError("the write stage needs a place for the catalog; name it with -o")
    if workers is not None and not 1 <= workers <= MAX_WORKERS:
        raise UsageError(f"--workers {workers}: wanted 1 to {MAX_WORKERS}")
    if output is not None:
        check_file(
            output, is_catalog_file, SIDECARS
        )  # before hours of work for a place that cannot be used
    if work is None:
        if output is None:
            raise UsageError("name a work folder with --work")
        work = output.with_name(output.name + ".work")
    if isinstance(source, Path):
        source = ConfigText.read(source)
    if scheduler is not None:
        check_address(scheduler)
        # workers elsewhere have another working folder
        source, work = replace(source, path=source.path.absolute()), work.absolute()
    config = source.load()
    try:
        body = load_body(config.body.name, source.path.parent)
    except ConfigError as error:
        raise ConfigError(f"{source.path}: [body] name: {error}") from None
    try:
        body = body.choose_photometry(config.photometry)
    except ConfigError as error:
        raise ConfigError(f"{source.path}: {error}") from None
    missing = body.describe_missing_photometry()
    if missing:
        log.warning("%s", missing)
    with ExitStack() as held:
        if output is not None:
            held.enter_context(lock_output(output))
        workspace = Workspace(work)
        held.enter_context(workspace.lock())
        build = _Build(
            workspace, config, source, body, workers, scheduler, progress or SilentProgress()
        )
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
        source: ConfigText,
        body: Body,
        workers: int | None,
        scheduler: str | None,
        progress: Progress,
    ) -> None:
        self.workspace, self.config, self.config_path = workspace, config, source.path
        self.config_text = source.text
        self.body, self.progress = body, progress
        self.count = workers or count_cores()
        if scheduler is None:
            self.workers = make_workers(self.count)
        else:  # self.count threads read terrain models, here
            names = [dem.path for dem in config.dem] + [mesh.path for mesh in config.mesh]
            names += [image.path for image in config.image]
            named = [resolve_path(name, source.path.parent) for name in names]
            self.workers = start_cluster_workers(scheduler, [workspace.path(MARK), *named])
        self.account = Account(f"optnav {catalog.__version__}", self.workers.count)

    def run(self, wanted: Sequence[str], bbox: Bbox | None, output: Path | None) -> BuildReport:
        """All wanted stages in order; a stage whose forerunner is not done is refused."""
        report = BuildReport(self.workspace.folder, self.account)
        with self._measure_stage("ingest") as stage:  # every run begins with it
            ground = self.config, self.config_path, self.body
            run = IngestRun(self.workspace, *ground, self.count, self.progress, stage)
            inputs = prepare_inputs(run, bbox)
            report.dems, self.account.cells = inputs.dems, inputs.cells
        rendered = self._find_results(inputs, "render", RenderedCell)
        checked = self._find_results(inputs, "check", ControlPoint)
        prepared = self._find_results(inputs, "write", PreparedPoint)
        points: list[ControlPoint] | None = None
        if "render" in wanted:
            with self._measure_stage("render") as stage:
                self._run_chunks(rendered, render.render_chunk, inputs, inputs.chunks, stage)
        if "select" in wanted:
            with self._measure_stage("select") as stage:
                self._select(inputs, rendered, stage)
        if "check" in wanted:
            with self._measure_stage("check") as stage:
                chosen = self._read_chosen(inputs)
                if "write" in wanted:  # from the patches that are cut for checking
                    function = check.check_and_prepare_chunk
                    self._run_chunks(checked, function, inputs, chosen, stage, prepared)
                else:
                    self._run_chunks(checked, check.check_chunk, inputs, chosen, stage)
                points = self._read_points(inputs, checked)
        if "write" in wanted and output is not None:
            with self._measure_stage("write") as stage:
                if points is None:
                    self._read_chosen(inputs)  # refuses, before the checks are missed
                    points = self._read_points(inputs, checked)
                self._write(inputs, points, prepared, output, report, stage)
            if report.usable == 0:
                judged = self.account
                reasons = ", ".join(f"{count} {reason}" for reason, count in judged.reasons.items())
                raise NothingToDoError(
                    f"{output}: written, but none of its {judged.points} control points is usable "
                    f"({reasons}); no data wants more ground around the cells or smaller "
                    "patches ([pyramid] levels, size), the rest is judged by [check]"
                )
        return report

    @contextmanager
    def _measure_stage(self, name: str) -> Iterator[StageAccount]:
        """Measure a stage; its account is on the disk before the next one begins."""
        stage = StageAccount(name)
        with stage.measure_block(), log_stage(name):
            yield stage
        self.account.stages.append(stage)
        data = msgspec.json.format(msgspec.json.encode(self.account), indent=2)
        self.workspace.put(usage.FILE, data)

    def _find_results(self, inputs: BuildInputs, stage: str, type_: type[Any]) -> ChunkResults:
        return ChunkResults(self.workspace, stage, inputs.keys[stage], type_)

    def _run_chunks(
        self,
        results: ChunkResults,
        function: Callable[[Any, Any], Sequence[Any]],
        inputs: BuildInputs,
        chunks: Sequence[Sequence[Any]],
        stage: StageAccount,
        beside: ChunkResults | None = None,
    ) -> None:
        if beside is not None:  # first, for they are as large as those that are made
            self.workspace.keep_only(beside.stage, {beside.key})
        with self.progress.stage(stage.name, sum(map(len, chunks)), "cell") as shown:
            made = results.make(
                function, inputs.context, chunks, self.workers, stage, shown, beside
            )
            for _ in made:
                pass
        self.workspace.keep_only(stage.name, {results.key})

    def _select(self, inputs: BuildInputs, rendered: ChunkResults, stage: StageAccount) -> None:
        key = inputs.keys["select"]
        if self.workspace.read_records(_select_name(key), SelectedCell) is not None:
            stage.kept = 1
            return
        records = rendered.read_all(len(inputs.chunks))
        if records is None:
            raise self._make_missing_error("render")
        with self.progress.stage("select", total=len(records), unit="cell") as shown:
            chosen = render.select(inputs.context, records)
            self.workspace.put(_select_name(key), encode_records(chosen))
            shown.advance(len(records))
        stage.done = 1
        self.workspace.keep_only("select", {key})

    def _read_chosen(self, inputs: BuildInputs) -> list[list[SelectedCell]]:
        """Selected records cut as their cells were cut for rendering; some pieces have none."""
        name = _select_name(inputs.keys["select"])
        records = self.workspace.read_records(name, SelectedCell)
        if records is None:
            raise self._make_missing_error("select")
        by_cell = {record.cell: record for record in records}
        return [[by_cell[cell] for cell in chunk if cell in by_cell] for chunk in inputs.chunks]

    def _read_points(self, inputs: BuildInputs, checked: ChunkResults) -> list[ControlPoint]:
        """The points of all checked pieces, judged in the account."""
        records = checked.read_all(len(inputs.chunks))
        if records is None:
            raise self._make_missing_error("check")
        # a cell at a model's edge may have ground, yet none where its place is: no point there
        points = [point for point in records if math.isfinite(point.radius_m)]
        report_fit(inputs.context, points)
        self.account.judge((point.usable, point.flags) for point in points)
        return points

    def _write(
        self,
        inputs: BuildInputs,
        points: Sequence[ControlPoint],
        prepared: ChunkResults,
        output: Path,
        report: BuildReport,
        stage: StageAccount,
    ) -> None:
        if not points:
            raise NothingToDoError(
                f"{self.config_path}: no cell has room for a control point on the terrain models; "
                "wanted finest patches that lie on them whole: "
                "lower [pyramid] size or posting_m, or give more ground"
            )
        relief = inputs.relief
        key = compute_stage_key(
            inputs.keys["write"],
            *(
                inputs.sources(),
                self.config_text,
                relief and relief.key,
                inputs.errors,
                inputs.image,
            ),
        )
        written = find_published(self.workspace, key, output)
        if written is not None:
            stage.kept = len(inputs.chunks)
        else:
            self.workspace.keep_only("write", {prepared.key})  # first, for they are as large as it
            shape = read_stored_relief(self.workspace, relief) if relief is not None else None
            written = write.write(
                inputs.context,
                write.group_points(inputs.chunks, points),
                output,
                extras=CatalogExtras(
                    inputs.sources(),
                    self.config_text,
                    shape,
                    inputs.errors,
                    inputs.comparison,
                    inputs.image,
                ),
                results=prepared,
                workers=self.workers,
                progress=self.progress,
                account=stage,
            )
            record_published(self.workspace, key, written.path)
        self.workspace.keep_only("write", set())  # the catalog has it all now
        report.output, report.points = written.path, written.count
        report.usable, report.digest = written.usable, written.digest

    def _make_missing_error(self, stage: str) -> UsageError:
        return UsageError(
            f"{self.workspace.folder}: holds no complete result of `{stage}` for this config; "
            f"first run: optnav {stage} {self.config_path} --work {self.workspace.folder}"
        )


def _select_name(key: str) -> str:
    return f"select-{key}/records.bin"
