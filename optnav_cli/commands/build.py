"""`optnav build`: a catalog from terrain models; each of its stages alone is a command, too."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from catalog.errors import UsageError
from optnav_cli.console import ConsoleProgress, pass_progress, report_compilation, report_lines
from optnav_cli.options import (
    PATH,
    OptnavCommand,
    bbox_option,
    output_option,
    path_argument,
    scheduler_option,
    work_option,
    workers_option,
)

if TYPE_CHECKING:
    from catalog.pipeline.build import BuildReport
    from catalog.pipeline.config import ConfigText

CATALOG_ENDINGS = (".gpkg", "")
_scheduler_option = scheduler_option(
    "the terrain models and the work folder", " Ingest stays here, with --workers threads."
)
CATALOG_HELP = "The catalog file (GeoPackage); an earlier catalog is replaced."


@click.command(
    "build", cls=OptnavCommand, short_help="Build a control-point catalog from terrain models."
)
@click.argument("config", type=PATH, nargs=-1, required=True)
@click.option(
    "--body",
    metavar="NAME",
    help="Which body terrain models in place of CONFIG show; moon by default.",
)
@output_option(CATALOG_HELP, CATALOG_ENDINGS)
@work_option(required=False)
@workers_option
@_scheduler_option
@bbox_option
@click.option(
    "--check",
    metavar="CATALOG",
    type=PATH,
    help="Compare the new catalog with this one; exit code 5 if its content differs.",
)
@pass_progress
def build(
    progress: ConsoleProgress,
    /,
    config: tuple[Path, ...],
    body: str | None,
    output: Path,
    check: Path | None,
    **options: Any,
) -> None:
    """Build a control-point catalog from the terrain models that CONFIG names.

    Instead of CONFIG one or more terrain models (GeoTIFF, PDS, ISIS cube, VRT) may be given, the
    first used before the others, with --body and the defaults of all settings; the catalog keeps
    the config that says so. `bundled:NAME` is a config, or a model, that ships with optnav.

    All stages: ingest, render, select, check, write. A stopped build goes on where it was when the
    same command is given again. Ends with exit code 4 when no point is usable.

    With --scheduler the work is done by the workers of a dask cluster that runs already, started on
    each machine with `dask worker tcp://HOST:PORT --nworkers N --nthreads 1` from an environment
    with the same optnav. The catalog has the same content.

    With --check the new catalog is written, then compared with an older one as `optnav catalog
    compare` does; a pipeline guards a release so.

    \b
    Example:
      optnav build moon.toml -o moon.gpkg
      optnav build dem.tif --body moon -o moon.gpkg
      optnav build moon.toml -o south.gpkg --bbox -180,-90,180,-60
      optnav build moon.toml -o moon.gpkg --check release.gpkg
      optnav build moon.toml -o moon.gpkg --scheduler tcp://head:8786
    """
    from catalog.pipeline.build import run
    from optnav_cli.commands.catalog import report_comparison, require_reference

    source = _choose_source(config, body)
    report_compilation()
    if check is not None:
        require_reference(check, output)  # before hours of work
    report = run(source, output=output, progress=progress, **options)
    _report_catalog(output, report)
    if check is not None:
        report_comparison(check, output, progress)


def _choose_source(given: Sequence[Path], body: str | None) -> "Path | ConfigText":
    """The config that is given, or that of the terrain models given. Raises UsageError."""
    from catalog.pipeline.config import RASTERS, ConfigText
    from catalog.terrain.mesh.file import MESHES

    rasters = [path for path in given if path.suffix.lower() in RASTERS]
    if len(rasters) == len(given):
        return ConfigText.make_from_rasters(rasters, body or "moon")
    (config,) = [path for path in given if path not in rasters][:1]
    if config.suffix.lower() in MESHES:
        raise UsageError(
            f"{config}: a shape model does not state its units; name it in the [[mesh]] section "
            "of a config (`optnav config template build` prints one)"
        )
    if len(given) > 1:
        raise UsageError(
            f"{config}: is no terrain model by its name ({', '.join(RASTERS)}); give one config, "
            "or terrain models alone"
        )
    if body is not None:
        raise UsageError(
            f"--body {body}: {config} is a config, which names its body itself as [body] name; "
            "leave --body out"
        )
    return config


def _make_stage_command(
    name: str, text: str, *, on_workers: bool = False, writes: bool = False
) -> click.Command:
    """The command of one stage, with the options that all of them take.

    on_workers  whether a cluster can do it;  writes  whether its result is the catalog
    """

    def call(
        progress: ConsoleProgress, /, config: Path, output: Path | None = None, **options: Any
    ) -> None:
        from catalog.pipeline.build import run

        report_compilation()
        report = run(config, stages=(name,), output=output, progress=progress, **options)
        if output is None:
            _report_account(report)
            click.echo(f"{options['work']}: {name} is done for {report.account.cells} cells")
        else:
            _report_catalog(output, report)

    options = [path_argument("config")]
    options += [output_option(CATALOG_HELP, CATALOG_ENDINGS)] if writes else []
    options += [work_option(required=True), workers_option]
    options += [_scheduler_option] if on_workers else []
    command: Callable[..., None] = pass_progress(call)
    for option in reversed([*options, bbox_option]):
        command = option(command)
    example = f"optnav {name} moon.toml --work moon.work{' -o moon.gpkg' if writes else ''}"
    return click.command(
        name,
        cls=OptnavCommand,
        help=f"{text}\n\nThe stage works on what the stages before it left in the workspace; give "
        f"it the same CONFIG and --bbox as these.\n\n\b\nExample:\n  {example}",
    )(command)


def _report_account(report: "BuildReport") -> None:
    from optnav_cli.output.wording import format_account

    report_lines(format_account(report.account))


def _report_catalog(output: Path, report: "BuildReport") -> None:
    _report_account(report)
    click.echo(f"{output}: {report.points} control points, {report.usable} usable")
    click.echo(f"digest: {report.digest}")


ingest = _make_stage_command(
    "ingest", "Read the terrain models that CONFIG names, average them and find their cells."
)
render = _make_stage_command(
    "render", "Shortlist points in each cell and render them under all Suns.", on_workers=True
)
select = _make_stage_command("select", "Choose among each cell's shortlist the points to check.")
check = _make_stage_command(
    "check",
    "Check the chosen points: uniqueness, foreign shadows, recognition trials.",
    on_workers=True,
)
write = _make_stage_command("write", "Write the catalog file.", on_workers=True, writes=True)
