"""A scenario to a folder of pictures: everything that `optnav simulate` does, in one step."""

from datetime import UTC, datetime
from pathlib import Path

from catalog.progress import Progress
from optnav_cli.output.manifest import hash_file, write_manifest
from optnav_cli.output.replace import check_folder, replacing_folder
from optnav_cli.simulation.run import simulate
from optnav_cli.simulation.scenario import load_scenario

KIND = "pictures"


def simulate_folder(
    scenario_path: Path, pictures: Path, progress: Progress, workers: int | None = None
) -> None:
    """Simulate the pictures of a scenario file and put the folder in place when it is complete.

    workers  threads; all that the process may use if None
    Raises ConfigError or DataError for what cannot be simulated, OutputError for the place.
    """
    started = datetime.now(UTC)
    check_folder(pictures, KIND)  # before any work is done for a place that cannot be used
    scenario = load_scenario(scenario_path)
    with replacing_folder(pictures, KIND) as place:
        simulate(scenario, place, progress, workers)
        write_manifest(
            place,
            KIND,
            command="simulate",
            options={},
            inputs={
                "scenario": {"name": scenario_path.name, "sha256": hash_file(scenario_path)},
                "terrain": [Path(dem.path).name for dem in scenario.dem],
            },
            started=started,
        )
