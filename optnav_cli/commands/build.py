"""`optnav build`: a control-point catalog from terrain models, all stages."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress, tell
from optnav_cli.options import (
    BoundingBox,
    bbox_option,
    output_option,
    path_argument,
    scheduler_option,
    work_option,
    workers_option,
)


@click.command(short_help="Build a control-point catalog from terrain models.")
@path_argument("config")
@output_option("The catalog file (GeoPackage); an earlier catalog is replaced.")
@work_option(required=False)
@workers_option
@scheduler_option
@bbox_option
@click.option(
    "--check",
    metavar="CATALOG",
    type=click.Path(path_type=Path),
    help="Compare the new catalog with this one; exit code 5 if its content differs.",
)
@pass_progress
def command(
    progress: ConsoleProgress,
    config: Path,
    output: Path,
    work: Path | None,
    workers: int | None,
    scheduler: str | None,
    bbox: BoundingBox | None,
    check: Path | None,
) -> None:
    """Build a control-point catalog from the terrain models that CONFIG names.

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
      optnav build moon.toml -o south.gpkg --bbox -180,-90,180,-60
      optnav build moon.toml -o moon.gpkg --check release.gpkg
      optnav build moon.toml -o moon.gpkg --scheduler tcp://head:8786
    """
    from catalog.build.build import run
    from optnav_cli.commands.catalog import compare_and_tell, require_reference
    from optnav_cli.output.wording import account_lines

    announce_compilation()
    if check is not None:
        require_reference(check, output)  # before hours of work
    report = run(
        config, work, output=output, workers=workers, scheduler=scheduler, bbox=bbox,
        progress=progress,
    )  # fmt: skip
    tell(account_lines(report.account))
    click.echo(f"{output}: {report.points} control points, {report.usable} usable")
    click.echo(f"digest: {report.digest}")
    if check is not None:
        compare_and_tell(check, output, progress)
