"""`optnav ingest | render | select | check | write`: each stage of a build alone."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress, tell
from optnav_cli.options import (
    BoundingBox,
    F,
    bbox_option,
    output_option,
    path_argument,
    scheduler_option,
    work_option,
    workers_option,
)

WHAT = {
    "ingest": "Read the terrain models that CONFIG names, average them and find their cells.",
    "render": "Shortlist points in each cell and render them under all Suns.",
    "select": "Choose among each cell's shortlist the points to check.",
    "check": "Check the chosen points: uniqueness, foreign shadows, recognition trials.",
}
ON_WORKERS = ("render", "check")


def _same(command: F) -> F:
    return command


def _stage(name: str) -> click.Command:
    """The command of one stage, with the options that all of them take."""
    elsewhere = scheduler_option if name in ON_WORKERS else _same

    @click.command(name, help=f"{WHAT[name]}\n\n{_example(name)}")
    @path_argument("config")
    @work_option(required=True)
    @workers_option
    @elsewhere
    @bbox_option
    @pass_progress
    def command(
        progress: ConsoleProgress,
        config: Path,
        work: Path,
        workers: int | None,
        bbox: BoundingBox | None,
        scheduler: str | None = None,
    ) -> None:
        from catalog.build.build import run
        from optnav_cli.output.wording import account_lines

        announce_compilation()
        report = run(
            config, work, stages=(name,), workers=workers, scheduler=scheduler, bbox=bbox,
            progress=progress,
        )  # fmt: skip
        tell(account_lines(report.account))
        click.echo(f"{work}: {name} is done for {report.account.cells} cells")

    return command


def _example(name: str, more: str = "") -> str:
    return (
        "The stage works on what the stages before it left in the workspace; give it the same "
        "CONFIG and --bbox as these.\n\n"
        f"\b\nExample:\n  optnav {name} moon.toml --work moon.work{more}"
    )


ingest = _stage("ingest")
render = _stage("render")
select = _stage("select")
check = _stage("check")


@click.command(help=f"Write the catalog file.\n\n{_example('write', ' -o moon.gpkg')}")
@path_argument("config")
@output_option("The catalog file (GeoPackage); an earlier catalog is replaced.")
@work_option(required=True)
@workers_option
@scheduler_option
@bbox_option
@pass_progress
def write(
    progress: ConsoleProgress,
    config: Path,
    output: Path,
    work: Path,
    workers: int | None,
    scheduler: str | None,
    bbox: BoundingBox | None,
) -> None:
    """Write the catalog file (its help is given above)."""
    from catalog.build.build import run
    from optnav_cli.output.wording import account_lines

    report = run(
        config, work, stages=("write",), output=output, workers=workers,
        scheduler=scheduler, bbox=bbox, progress=progress,
    )  # fmt: skip
    tell(account_lines(report.account))
    click.echo(f"{output}: {report.points} control points, {report.usable} usable")
    click.echo(f"digest: {report.digest}")
