"""`optnav build`: a control-point catalog from terrain models, all stages."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import (
    BoundingBox,
    bbox_option,
    output_option,
    path_argument,
    work_option,
    workers_option,
)


@click.command(short_help="Build a control-point catalog from terrain models.")
@path_argument("config")
@output_option("The catalog file (GeoPackage); an earlier catalog is replaced.")
@work_option(required=False)
@workers_option
@bbox_option
@pass_progress
def command(
    progress: ConsoleProgress,
    config: Path,
    output: Path,
    work: Path | None,
    workers: int | None,
    bbox: BoundingBox | None,
) -> None:
    """Build a control-point catalog from the terrain models that CONFIG names.

    All stages: ingest, render, select, check, write. A stopped build goes on where it was when the
    same command is given again. Ends with exit code 4 when no point is usable.

    \b
    Example:
      optnav build moon.toml -o moon.gpkg
      optnav build moon.toml -o south.gpkg --bbox -180,-90,180,-60
    """
    from catalog.stages.build import run

    announce_compilation()
    report = run(config, work, output=output, workers=workers, bbox=bbox, progress=progress)
    click.echo(f"{output}: {report.points} control points, {report.usable} usable")
    click.echo(f"digest: {report.digest}")
