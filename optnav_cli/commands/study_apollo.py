"""`optnav study apollo`: a real Apollo 15 picture navigated over bundled terrain."""

from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress


@click.command(short_help="Navigate a real Apollo 15 picture over bundled terrain.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default="optnav-apollo",
    show_default=True,
    help="Folder for the catalog, the pictures and the run.",
)
@click.option(
    "--matcher",
    type=click.Choice(["ncc", "surf"]),
    default="ncc",
    show_default=True,
    help="How a control point is recognised.",
)
@pass_progress
def command(progress: ConsoleProgress, output: Path, matcher: str) -> None:
    """Build the catalog below Apollo 15 metric frame 0297 and navigate the frame.

    Prints how many control points were recognised, the residual, and the correction to the pose
    in the frame's ISIS cube with its sigma.

    \b
    Example:
      optnav study apollo -o apollo
    """
    from optnav_cli.studies.apollo import format_result, run

    announce_compilation()
    click.echo(format_result(run(output, progress, matcher)))
