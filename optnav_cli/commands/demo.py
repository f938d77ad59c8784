"""`optnav demo`: the main job, from terrain to positions, on the bundled Tycho model."""

from datetime import UTC, datetime
from pathlib import Path

import click

from optnav_cli.console import ConsoleProgress, announce_compilation, pass_progress
from optnav_cli.options import OptnavCommand, workers_option
from optnav_cli.parameters import OutputOption

KIND = "demo"


@click.command(
    cls=OptnavCommand, short_help="The main job on the bundled Tycho terrain, with a report."
)
@click.option(
    "-o",
    "--output",
    cls=OutputOption,
    default="optnav-demo",
    show_default=True,
    help="Folder for the results; an earlier demo in it is replaced.",
)
@workers_option
@pass_progress
def command(progress: ConsoleProgress, output: Path, workers: int | None) -> None:
    """Do the main job on the bundled terrain model of the crater Tycho.

    Builds a control-point catalog, simulates 12 pictures over a richer terrain, navigates them,
    compares the positions with the truth and writes a report. Each step is a command of its own;
    stopped, the same command goes on.

    \b
    Example:
      optnav demo -o demo
    """
    from catalog.build import build
    from catalog.config import resource
    from catalog.files import check_folder
    from catalog.places import claimed, make_folder
    from optnav_cli.evaluation.files import evaluate_run, write_evaluation
    from optnav_cli.evaluation.table import format_table
    from optnav_cli.output.manifest import write_manifest
    from optnav_cli.report import write_report
    from optnav_cli.runs.frame_worker import RunInputs
    from optnav_cli.runs.navigate_folder import navigate_folder
    from optnav_cli.runs.simulate_folder import simulate_folder

    config = resource("configs/catalogs/tycho.toml")
    scenario = resource("configs/scenarios/demo.toml")
    catalog, pictures, run = output / "tycho.gpkg", output / "pictures", output / "run"
    report = output / "report.html"

    check_folder(output, KIND)
    with claimed(output):
        make_folder(output)
        # First of all, so that the same command knows a demo that was stopped as its own.
        inputs = {"config": config.name, "scenario": scenario.name}
        write_manifest(
            output, KIND, command="demo", options={}, inputs=inputs, started=datetime.now(UTC)
        )
        announce_compilation()
        build.run(config, output=catalog, workers=workers, progress=progress)
        simulate_folder(scenario, pictures, progress, workers)
        navigate_folder(RunInputs(pictures, [catalog]), run, progress, workers=workers)
        evaluation = evaluate_run(run, pictures / "truth.csv")
        write_evaluation(evaluation, run)
        write_report(run, report)
    click.echo(format_table(evaluation))
    click.echo(f"\nreport: {report}")
