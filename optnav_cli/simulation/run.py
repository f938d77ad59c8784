"""A whole scenario into a picture folder."""

from dataclasses import replace
from pathlib import Path

import cv2
import numba
import numpy as np

from catalog.bodies.body import Body, load_body
from catalog.errors import OutputError
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress, SilentProgress
from catalog.terrain.dem.source import DemSettings
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import Attitude, FileAttitude, RunSettings
from optnav_cli.frames.truth import Truth, write_truth
from optnav_cli.simulation.exposure import Exposure, TruthGround
from optnav_cli.simulation.globe_ground import GlobeGround
from optnav_cli.simulation.mesh_ground import MeshGround
from optnav_cli.simulation.region_ground import RegionGround, truth_terrain
from optnav_cli.simulation.scenario import (
    load_scenario,
    scenario_cameras,
    scenario_copy,
    scenario_motion,
)
from optnav_cli.simulation.scenario_base import ScenarioBase
from optnav_cli.simulation.sensor import Counts, expose
from optnav_cli.simulation.surroundings import Surroundings

SENSOR = 17  # stream of random numbers, apart from those of the trajectory


def simulate(
    scenario: ScenarioBase | str | Path,
    folder: Path,
    progress: Progress | None = None,
    workers: int | None = None,
) -> None:
    """Write pictures, frames.csv, truth.csv, the cameras and the scenario into an empty folder.

    scenario  a file, or what `load_scenario` gave
    folder    is made where it is missing
    workers   threads; all that the process may use if None. Their number changes no byte
    Raises ConfigError or DataError for what cannot be simulated, OutputError for the folder.
    """
    if isinstance(scenario, str | Path):
        scenario = load_scenario(scenario)
    if workers is not None:
        numba.set_num_threads(max(1, min(workers, numba.get_num_threads())))
    body = load_body(scenario.body)
    cameras = scenario_cameras(scenario)
    motion = scenario_motion(scenario, body)
    flight = scenario.exposures(motion)
    ground = truth_ground(scenario, body, cameras, flight)
    surroundings = [Surroundings(scenario, camera, motion) for camera in cameras]
    progress = progress or SilentProgress()
    folder.mkdir(parents=True, exist_ok=True)
    with progress.stage("simulate", total=len(flight), unit="picture") as stage:
        for exposure in flight:
            rng = np.random.default_rng([scenario.seed, SENSOR, exposure.index])
            radiance = ground.radiance(cameras[exposure.camera], exposure)
            around = surroundings[exposure.camera]
            counts = expose(radiance, scenario.sensor, rng, around.besides(exposure, radiance))
            _write_png(folder / exposure.file, around.with_hot_pixels(counts))
            stage.advance()
    inertial = scenario.attitude.relative_to == "inertial"
    name: Attitude = "camera_from_inertial" if inertial else "camera_from_body"
    settings = RunSettings(body=scenario.body, attitude=name)
    frames = [_frame(e, scenario, cameras[e.camera].name) for e in flight]
    # cameras as their calibration knows them: of a known blur, that of these pictures
    psf = scenario.sensor.psf_sigma_px
    calibrated = [c if c.psf_sigma_px is None else replace(c, psf_sigma_px=psf) for c in cameras]
    write_folder(folder, settings, calibrated, frames, motion)
    truths = [Truth(e.file, e.utc, e.tdb_s, e.position_m, e.camera_from_body) for e in flight]
    write_truth(folder / "truth.csv", FileAttitude(name, body, motion), truths)
    (folder / "scenario.json").write_bytes(scenario_copy(scenario))


def truth_ground(
    scenario: ScenarioBase, body: Body, cameras: list[Camera], flight: list[Exposure]
) -> TruthGround:
    """The ground that a scenario's cameras share: a shape model, a region's or the whole body's."""
    if scenario.shape is not None:
        return MeshGround(scenario.shape, scenario.detail, body)
    if scenario.dem:
        return RegionGround(truth_terrain(scenario, body, flight), cameras, flight)
    model = DemSettings(scenario.globe.path)
    return GlobeGround.of_model(model, scenario.detail, body, kept=len(cameras))


def _frame(exposure: Exposure, scenario: ScenarioBase, camera: str) -> Frame:
    attitude = scenario.attitude
    # a prior without error is still a prior; the search needs some room
    sigma_m = None if exposure.prior_m is None else max(scenario.prior.position_sigma_m, 1.0)
    return Frame(
        file=exposure.file,
        utc=exposure.utc,
        camera=camera,
        tdb_s=exposure.tdb_s,
        camera_from_body=exposure.reported_camera_from_body,
        attitude_sigma_rad=None if attitude.free else attitude.sigma_arcsec * ARCSEC,
        position_m=exposure.prior_m,
        position_sigma_m=sigma_m,
        sun_body=exposure.sun_body if exposure.reported_sun else None,
    )


def _write_png(path: Path, counts: Counts) -> None:
    # the strongest compression costs seconds a picture and saves a tenth
    done, data = cv2.imencode(".png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise ValueError(f"no PNG of an array {counts.dtype} {counts.shape}")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
