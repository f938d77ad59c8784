"""A scenario to a folder of pictures: everything that `optnav simulate` does, in one step."""

import hashlib
from datetime import UTC, datetime
from pathlib import Path

from catalog.files import check_folder, hash_file, replacing_folder
from catalog.places import check_apart
from catalog.progress import Progress
from optnav_cli.output.manifest import write_manifest
from optnav_cli.simulation.run import simulate
from optnav_cli.simulation.scenario import load_scenario, scenario_copy
from optnav_cli.simulation.scenario_base import ScenarioBase

KIND = "pictures"


def simulate_folder(
    scenario: ScenarioBase | Path, pictures: Path, progress: Progress, workers: int | None = None
) -> None:
    """Simulate the pictures of a scenario and put the folder in place when it is complete.

    scenario  a file, or what `load_scenario` gave
    workers   threads; all that the process may use if None
    Raises ConfigError or DataError for what cannot be simulated, OutputError for the place.
    """
    started = datetime.now(UTC)
    check_folder(pictures, KIND)  # before any work is done for a place that cannot be used
    if isinstance(scenario, Path):
        check_apart(pictures, [scenario])
        path, scenario = scenario, load_scenario(scenario)
        origin = {"name": path.name, "sha256": hash_file(path)}
    else:
        origin = {"sha256": hashlib.sha256(scenario_copy(scenario)).hexdigest()}
    terrain = [*(Path(dem.path).name for dem in scenario.dem), Path(scenario.globe.path).name]
    with replacing_folder(pictures, KIND) as place:
        simulate(scenario, place, progress, workers)
        write_manifest(
            place,
            KIND,
            command="simulate",
            options={},
            inputs={"scenario": origin, "terrain": terrain},
            started=started,
        )
