"""The pictures of a scenario, as the command makes them, without a word."""

from pathlib import Path

from catalog.progress import SilentProgress
from optnav_cli.simulation.job import simulate_folder
from optnav_cli.simulation.scenario_base import ScenarioBase


def simulate(scenario: ScenarioBase | Path, folder: Path, workers: int | None = None) -> None:
    """Make the folder of a scenario."""
    simulate_folder(scenario, folder, SilentProgress(), workers)
