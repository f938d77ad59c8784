"""The pictures of a [cylinder] scenario, and the tables that go with them."""

import math
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.epochs import compute_tdb_s_after, utc_from_tdb_s
from optnav_cli.camera.camera_file import write_camera
from optnav_cli.camera.coding import Coding
from optnav_cli.frames.run_settings import RUN_TOML
from optnav_cli.frames.tables import CYLINDER_TRUTH, TIMES_AND_CAMERAS
from optnav_cli.simulation.cylinder_picture import draw_cylinder, source_glare
from optnav_cli.simulation.cylinder_scenario import CylinderScenario
from optnav_cli.simulation.run import SENSOR, Simulation, png
from optnav_cli.simulation.scenario import scenario_copy
from optnav_cli.simulation.scenario_base import ScenarioBase
from optnav_cli.simulation.sensor import Besides, expose


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
