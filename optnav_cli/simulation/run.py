"""A whole scenario into a picture folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numba
import numpy as np

from catalog.bodies.body import Body, load_body
from catalog.errors import OutputError
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress, SilentProgress
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import Attitude, FileAttitude, RunSettings, SpiceSettings
from optnav_cli.frames.truth import Truth, write_truth
from optnav_cli.simulation.frame import Renderer
from optnav_cli.simulation.globe_frame import GlobeRenderer
from optnav_cli.simulation.globe_heights import GlobeHeights, read_globe
from optnav_cli.simulation.globe_terrain import GlobeTerrain
from optnav_cli.simulation.mesh_frame import MeshRenderer
from optnav_cli.simulation.scenario import (
    AnyScenario,
    ShapeScenario,
    load_scenario,
    scenario_cameras,
    scenario_motion,
)
from optnav_cli.simulation.sections import DetailSettings, GlobeDetailSettings
from optnav_cli.simulation.sensor import Counts, expose
from optnav_cli.simulation.shot import Exposure
from optnav_cli.simulation.surroundings import Surroundings
from optnav_cli.simulation.trajectory import shots
from optnav_cli.simulation.truth_mesh import TruthMesh
from optnav_cli.simulation.truth_terrain import TruthTerrain

SENSOR = 17  # stream of random numbers, apart from those of the trajectory


def simulate(
    scenario: AnyScenario | str | Path,
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
    flight = shots(scenario, body, motion)
    renderers = _renderers(scenario, body, cameras, flight)
    surroundings = [Surroundings(scenario, camera, motion) for camera in cameras]
    progress = progress or SilentProgress()
    folder.mkdir(parents=True, exist_ok=True)
    with progress.stage("simulate", total=len(flight), unit="picture") as stage:
        for shot in flight:
            rng = np.random.default_rng([scenario.seed, SENSOR, shot.index])
            radiance = renderers[shot.camera].radiance(shot)
            around = surroundings[shot.camera]
            counts = expose(radiance, scenario.sensor, rng, around.besides(shot, radiance))
            _write_png(folder / shot.file, around.with_hot_pixels(counts))
            stage.advance()
    inertial = scenario.attitude.relative_to == "inertial"
    name: Attitude = "camera_from_inertial" if inertial else "camera_from_body"
    settings = RunSettings(body=scenario.body, attitude=name)
    frames = [_frame(shot, scenario, cameras[shot.camera].name) for shot in flight]
    calibrated = [_calibrated(camera, scenario) for camera in cameras]
    write_folder(folder, settings, calibrated, frames, motion)
    truths = [Truth(s.file, s.utc, s.tdb_s, s.position_m, s.camera_from_body) for s in flight]
    write_truth(folder / "truth.csv", FileAttitude(name, body, motion), truths)
    (folder / "scenario.json").write_bytes(scenario_copy(scenario))


def _renderers(
    scenario: AnyScenario, body: Body, cameras: list[Camera], flight: list[Exposure]
) -> list[Renderer] | list[GlobeRenderer] | list[MeshRenderer]:
    """One renderer a camera; they share the ground."""
    if isinstance(scenario, ShapeScenario):
        ground = TruthMesh(scenario, body)
        return [MeshRenderer(ground, camera) for camera in cameras]
    if scenario.dem:
        terrain = truth_terrain(scenario, body, flight)
        return [
            Renderer(terrain, camera, [shot for shot in flight if shot.camera == number])
            for number, camera in enumerate(cameras)
        ]
    heights = GlobeHeights(read_globe(DemSettings(scenario.globe.path), body), body.radius_m)
    grounds = {
        seed: GlobeTerrain(
            heights,
            None if seed is None else _detail(seed, scenario.detail, body, heights.posting_m),
            kept=len(cameras),
        )
        for seed in scenario.detail.seeds or (None,)
    }
    return [GlobeRenderer(heights, grounds, camera) for camera in cameras]


def _detail(
    seed: int, settings: DetailSettings | GlobeDetailSettings, body: Body, posting_m: float
) -> SyntheticRelief:
    return SyntheticRelief(
        seed, posting_m, body.radius_m,
        smallest_m=min(settings.smallest_m, posting_m),
        rms_slope_deg=settings.rms_slope_deg, saturation=settings.saturation,
    )  # fmt: skip


def truth_terrain(scenario: AnyScenario, body: Body, flight: Sequence[Exposure]) -> TruthTerrain:
    """The ground of a scenario. Raises ConfigError or DataError for terrain that cannot be used."""
    first = DemSource.open(scenario.dem[0], Path.cwd(), body)
    details: dict[int | None, SyntheticRelief | None] = {None: None}
    for seed in scenario.detail.seeds:
        details[seed] = _detail(seed, scenario.detail, body, first.posting_m)
    globe = DemSettings(scenario.globe.path)
    if not scenario.globe.detail:
        return TruthTerrain(body, scenario.dem, globe, details)
    posting_m = DemSource.open(globe, Path.cwd(), body).posting_m
    around: dict[int | None, SyntheticRelief] = {
        seed: _detail(seed, scenario.globe.detail, body, posting_m)
        for seed in scenario.detail.seeds
    }
    cameras_m = [shot.position_m for shot in flight]
    return TruthTerrain(body, scenario.dem, globe, details, around, cameras_m)


def scenario_copy(scenario: AnyScenario) -> bytes:
    """All settings of a scenario with their defaults, as JSON; paths shortened to file names."""
    bare = msgspec.structs.replace(
        scenario,
        dem=tuple(msgspec.structs.replace(d, path=Path(d.path).name) for d in scenario.dem),
        globe=msgspec.structs.replace(scenario.globe, path=Path(scenario.globe.path).name),
        camera=msgspec.structs.replace(scenario.camera, name=Path(scenario.camera.name).name),
        beside=tuple(
            msgspec.structs.replace(mount, name=Path(mount.name).name) for mount in scenario.beside
        ),
        spice=SpiceSettings(tuple(Path(name).name for name in scenario.spice.kernels)),
    )
    if isinstance(bare, ShapeScenario):
        mesh = msgspec.structs.replace(bare.mesh, path=Path(bare.mesh.path).name)
        bare = msgspec.structs.replace(bare, mesh=mesh)
    return msgspec.json.format(msgspec.json.encode(bare), indent=2) + b"\n"


def _frame(shot: Exposure, scenario: AnyScenario, camera: str) -> Frame:
    attitude = scenario.attitude
    return Frame(
        file=shot.file,
        utc=shot.utc,
        camera=camera,
        tdb_s=shot.tdb_s,
        camera_from_body=shot.reported_camera_from_body,
        attitude_sigma_rad=None if attitude.free else attitude.sigma_arcsec * ARCSEC,
        position_m=shot.prior_m,
        # a prior without error is still a prior; the search needs some room
        position_sigma_m=(
            None if shot.prior_m is None else max(scenario.prior.position_sigma_m, 1.0)
        ),
        sun_body=shot.sun_body if shot.reported_sun else None,
    )


def _calibrated(camera: Camera, scenario: AnyScenario) -> Camera:
    """The camera as its calibration knows it: of a known blur, that of these pictures."""
    if camera.psf_sigma_px is None:
        return camera
    return replace(camera, psf_sigma_px=scenario.sensor.psf_sigma_px)


def _write_png(path: Path, counts: Counts) -> None:
    # the strongest compression costs seconds a picture and saves a tenth
    done, data = cv2.imencode(".png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise ValueError(f"no PNG of an array {counts.dtype} {counts.shape}")
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
