"""A scenario to a folder of pictures, as `optnav simulate` does, and an example to start from."""

import hashlib
import logging
import math
import shutil
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import msgspec
import numba
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import compute_tdb_s_after, utc_from_tdb_s
from catalog.config import resource
from catalog.errors import ConfigError, OutputError
from catalog.files import hash_file, replace_folder
from catalog.jobs.cluster import check_address, start_cluster_workers
from catalog.jobs.usage import StageAccount
from catalog.jobs.workers import SerialWorkers, Workers
from catalog.jobs.workspace import (
    ChunkResults,
    Workspace,
    compute_stage_key,
    hash_contents,
    hash_package,
)
from catalog.places import check_apart
from catalog.progress import Progress, SilentProgress, log_stage
from optnav_cli.camera.camera import Coding
from optnav_cli.camera.camera_file import camera_toml, write_camera
from optnav_cli.frames.run_settings import RUN_TOML
from optnav_cli.frames.tables import CYLINDER_TRUTH, FRAMES, PICKED_POINTS, TIMES_AND_CAMERAS
from optnav_cli.output.manifest import is_finished, list_versions, open_workspace, write_manifest
from optnav_cli.simulation.cylinder_scenario import CylinderScenario, draw_cylinder, source_glare
from optnav_cli.simulation.run import SENSOR, Simulation, Taken, png, take
from optnav_cli.simulation.scenario import load_scenario, scenario_copy
from optnav_cli.simulation.scenario_base import ScenarioBase
from optnav_cli.simulation.sensor import Besides, expose

log = logging.getLogger(__name__)

KIND, STAGE = "pictures", "simulate"
TEMPLATE = "folder template"


class CylinderSimulation(Simulation):
    """The pictures of a cylinder; the truth is in terms of the light, not of a body."""

    def __init__(self, scenario: CylinderScenario) -> None:
        super().__init__(scenario)
        self._own = scenario

    def __reduce__(self) -> tuple[object, ...]:
        return CylinderSimulation, (self._own,)

    def files(self) -> list[Path]:
        return []

    @cached_property
    def _states(self) -> FloatArray:
        return self._own.states()

    @cached_property
    def names(self) -> list[str]:
        return [f"frame_{number:04d}.png" for number in range(len(self._states))]

    def picture(self, number: int) -> bytes:
        section, camera = self._own.cylinder, self.cameras[0]
        _, distance, theta, _, _ = (float(value) for value in self._states[number])
        axis = math.radians(section.bearing_deg)
        placement = (distance, axis, theta)
        light = draw_cylinder(
            camera, (section.radius_m, section.height_m), placement, section.surface
        )
        glare = source_glare(camera, axis, theta, section.surface)
        rng = np.random.default_rng([self._own.seed, SENSOR, number])
        return png(expose(light, self._own.sensor, rng, Besides(veil=glare)))

    def write_tables(self, folder: Path) -> None:
        section, camera = self._own.cylinder, self.cameras[0]
        text = f'target = "cylinder"\nradius_m = {section.radius_m!r}\n'
        text += f"height_m = {section.height_m!r}\n"
        text += f"light_half_width_deg = {section.surface.light_half_width_deg!r}\n"
        (folder / RUN_TOML).write_text(text, encoding="utf-8")
        (folder / "cameras").mkdir(exist_ok=True)
        write_camera(folder / "cameras", replace(camera, coding=Coding("linear")))
        times = [
            utc_from_tdb_s(float(time), 3)
            for time in compute_tdb_s_after(section.start_utc, self._states[:, 0])
        ]
        heads = [{"file": name, "utc": utc} for name, utc in zip(self.names, times, strict=True)]
        TIMES_AND_CAMERAS.write(
            folder / "frames.csv", ({**head, "camera": camera.name} for head in heads)
        )
        CYLINDER_TRUTH.write(
            folder / "truth.csv",
            (
                {
                    **head,
                    "d_m": distance - section.radius_m,
                    "theta_deg": math.degrees(theta),
                    "bearing_deg": section.bearing_deg,
                    "vx_m_s": vx,
                    "vy_m_s": vy,
                }
                for head, (_, distance, theta, vx, vy) in zip(
                    heads, self._states.tolist(), strict=True
                )
            ),
        )
        (folder / "scenario.json").write_bytes(scenario_copy(self._own))


def simulation_of(scenario: ScenarioBase) -> Simulation:
    """The simulation of a scenario of any kind."""
    if isinstance(scenario, CylinderScenario):
        return CylinderSimulation(scenario)
    return Simulation(scenario)


def simulate_folder(
    scenario: ScenarioBase | Path,
    pictures: Path,
    progress: Progress,
    workers: int | None = None,
    scheduler: str | None = None,
) -> None:
    """Simulate the pictures of a scenario and put the folder in place when it is complete.

    What was stopped goes on with the pictures that are not done; a folder that is there already,
    whole and from the same scenario, is left as it is.

    scenario   a file, or what `load_scenario` gave
    workers    threads; all that the process may use if None. Their number changes no byte
    scheduler  tcp://HOST:PORT of a dask cluster, whose workers take the pictures instead
    Raises ConfigError or DataError for what cannot be simulated, OutputError for the place.
    """
    started = datetime.now(UTC)
    if scheduler is not None:
        check_address(scheduler)
    if isinstance(scenario, Path):
        check_apart(pictures, [scenario])
    with log_stage(STAGE), open_workspace(pictures, KIND) as workspace:
        if isinstance(scenario, Path):
            path, scenario = scenario, load_scenario(scenario)
            origin = {"name": path.name, "sha256": hash_file(path)}
        else:
            origin = {"sha256": hashlib.sha256(scenario_copy(scenario)).hexdigest()}
        simulation = simulation_of(scenario)
        missing = simulation.motion.body.describe_missing_photometry()
        if missing:
            log.warning("%s", missing)
        key = _key(simulation, workspace)
        if is_finished(pictures, key):
            log.info("%s: is there already, from the same scenario", pictures)
            return
        if workers is not None:
            numba.set_num_threads(max(1, min(workers, numba.get_num_threads())))
        crew: Workers = SerialWorkers()
        if scheduler is not None:
            crew = start_cluster_workers(scheduler, simulation.files())
        results = ChunkResults(workspace, STAGE, key, Taken)
        workspace.keep_only(STAGE, {key})
        terrain = [*(Path(dem.path).name for dem in scenario.dem), Path(scenario.globe.path).name]
        try:
            with replace_folder(pictures, KIND) as staging:
                # first, as a model of the ground can be refused
                simulation.write_tables(staging)
                _take(simulation, results, crew, staging, progress)
                write_manifest(
                    staging,
                    KIND,
                    command="simulate",
                    options={},
                    inputs={"scenario": origin, "terrain": terrain},
                    results={"quaternions": simulation.attitude},
                    started=started,
                    key=key,
                )
        except ConfigError:
            # the scenario must change, and nothing that was kept is for another one
            workspace.keep_only(STAGE, set())
            raise
        finally:
            crew.close()


def _take(
    simulation: Simulation, results: ChunkResults, workers: Workers, place: Path, progress: Progress
) -> None:
    """Put all pictures into a folder, those of a stopped run first."""
    numbers = [[number] for number in range(len(simulation.names))]
    with progress.stage(STAGE, len(numbers), "picture") as bar:
        made = results.make(take, simulation, numbers, workers, StageAccount(STAGE), bar)
        with closing(made):
            for number in made:
                (taken,) = results.read(number) or take(simulation, [number])
                file = simulation.names[number]
                (place / file).write_bytes(taken.data)
                event: dict[str, object] = {"stage": STAGE, "frame": file, "status": "simulated"}
                event |= {"method": None, "seconds": taken.seconds}
                log.debug("%s: simulated in %s s", file, taken.seconds, extra=event)


def _key(simulation: Simulation, workspace: Workspace) -> str:
    """Hash of all that the pictures depend on."""
    return compute_stage_key(
        [hash_package(), hash_package("optnav_cli"), list_versions()],
        msgspec.to_builtins(simulation.scenario),
        [camera_toml(camera) for camera in simulation.cameras],
        repr(simulation.motion.body),
        hash_contents(simulation.files(), workspace, SilentProgress()),
    )


# Example folders, and the table whose columns their README lists.
EXAMPLES = {
    "folder": ("data/picture_folder/run.toml", FRAMES),
    "points": ("data/picked_points/run.toml", PICKED_POINTS),
}


def write_template_folder(place: Path, kind: str = "folder") -> None:
    """Copy an example folder that ships with optnav, of EXAMPLES; its README lists the columns.

    Raises OutputError for a place that holds anything: somebody may have worked on it.
    """
    if place.is_dir() and any(place.iterdir()):
        raise OutputError(f"{place}: the folder is not empty; name another place")
    started = datetime.now(UTC)
    name, table = EXAMPLES[kind]
    example = resource(name).parent
    with replace_folder(place, TEMPLATE) as new:
        shutil.copytree(example, new, dirs_exist_ok=True, copy_function=shutil.copyfile)
        readme = new / "README.md"
        text = readme.read_text(encoding="utf-8").replace("COLUMNS", table.format_markdown())
        readme.write_text(text, encoding="utf-8")
        write_manifest(new, TEMPLATE, command="config", options={}, inputs={}, started=started)
