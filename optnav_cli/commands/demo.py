"""`optnav demo`: the main job, from terrain to positions, on the bundled Tycho model."""

from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

import click

from optnav_cli.console import (
    ConsoleProgress,
    has_cached_kernels,
    pass_progress,
    report_compilation,
)
from optnav_cli.options import OptnavCommand, OutputOption, workers_option

KIND = "demo"
# As wide as the demo's own, with a quarter of its pixels: a quarter of the time, the same kernels.
CAMERA_AHEAD = """
name = "ahead"
model = "pinhole"
width_px = 1024
height_px = 1024
focal_length_px = 2091.9
principal_point_px = [511.5, 511.5]
psf_sigma_px = 0.7
psf_error_px = 0.05
"""


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
    from catalog.config import resource
    from catalog.files import check_folder
    from catalog.pipeline import build
    from catalog.places import lock_output, make_folder
    from optnav_cli.evaluation.files import evaluate_run, format_table, write_evaluation
    from optnav_cli.navigate.job import navigate_folder
    from optnav_cli.navigate.worker import RunInputs
    from optnav_cli.output.manifest import write_manifest
    from optnav_cli.pages import write_report
    from optnav_cli.simulation.job import simulate_folder

    config = resource("configs/catalogs/tycho.toml")
    scenario = resource("configs/scenarios/demo.toml")
    catalog, pictures, run = output / "tycho.gpkg", output / "pictures", output / "run"
    report = output / "report.html"

    check_folder(output, KIND)
    with lock_output(output):
        make_folder(output)
        # First of all, so that the same command knows a demo that was stopped as its own.
        inputs = {"config": config.name, "scenario": scenario.name}
        write_manifest(
            output, KIND, command="demo", options={}, inputs=inputs, started=datetime.now(UTC)
        )
        report_compilation()
        with _compile_ahead(scenario, workers) as is_built:
            build.run(config, output=catalog, workers=workers, progress=progress)
            is_built(catalog)
            simulate_folder(scenario, pictures, progress, workers)
            navigate_folder(RunInputs(pictures, [catalog]), run, progress, workers=workers)
        evaluation = evaluate_run(run, pictures / "truth.csv")
        write_evaluation(evaluation, run)
        write_report(run, report)
    click.echo(format_table(evaluation))
    click.echo(f"\nreport: {report}")


@contextmanager
def _compile_ahead(scenario: Path, workers: int | None) -> Iterator[Callable[[Path], None]]:
    """Let a process beside compile what later stages need, where nothing is compiled yet.

    It simulates two pictures in a temporary folder while the catalog is built, and navigates them
    once the function that is given here hears of the catalog. Each stage then finds its kernels in
    the cache, or waits for those that are just compiled. Its failure costs no more than time.
    """
    import multiprocessing
    import tempfile

    from catalog.jobs.workers import LocalPool, count_cores

    if (workers or count_cores()) < 2 or has_cached_kernels():
        yield lambda catalog: None
        return
    others = {child.pid for child in multiprocessing.active_children()}
    with tempfile.TemporaryDirectory(prefix="optnav-", ignore_cleanup_errors=True) as folder:
        work, pool = Path(folder), LocalPool(1)
        executor = pool.executor()
        executor.submit(_simulate_ahead, scenario, work)
        beside = [child for child in multiprocessing.active_children() if child.pid not in others]
        try:
            yield lambda catalog: _submit(executor, _navigate_ahead, work, catalog)
        finally:
            pool.stop_now()
            for child in beside:  # which writes no more then
                child.join()


def _submit(executor: Executor, function: Callable[..., None], *of: Path) -> None:
    """Submit work, unless the process that was to do it has died."""
    with suppress(BrokenExecutor):
        executor.submit(function, *of)


def _simulate_ahead(scenario: Path, place: Path) -> None:
    import logging

    from msgspec.structs import replace

    from catalog.progress import SilentProgress
    from optnav_cli.simulation.job import simulate_folder
    from optnav_cli.simulation.passes import Scenario
    from optnav_cli.simulation.scenario import load_scenario
    from optnav_cli.simulation.sections import MainCamera

    logging.disable()  # the demo tells people what happens
    camera = place / "ahead.toml"
    camera.write_text(CAMERA_AHEAD, encoding="utf-8")
    flight = load_scenario(scenario)
    if isinstance(flight, Scenario):
        orbit = replace(flight.orbit, passes=1, frames=2)
        flight = replace(flight, orbit=orbit, camera=MainCamera(str(camera)))
    simulate_folder(flight, place / "pictures", SilentProgress(), workers=1)


def _navigate_ahead(place: Path, catalog: Path) -> None:
    from catalog.progress import SilentProgress
    from optnav_cli.navigate.job import navigate_folder
    from optnav_cli.navigate.worker import RunInputs

    given = RunInputs(place / "pictures", [catalog])
    navigate_folder(given, place / "run", SilentProgress(), workers=1)
