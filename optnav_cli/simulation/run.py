"""The pictures of a scenario, and the tables that go with them."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import cv2
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import Ephemeris
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.rotations import ARCSEC
from catalog.rasters import TERRAIN, handle_read_errors, open_raster
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.dem.source import DemSettings
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import AltimeterSettings, Attitude, FileAttitude, RunSettings
from optnav_cli.frames.truth import Truth, write_truth
from optnav_cli.simulation.descent import Descent, write_model
from optnav_cli.simulation.globe_ground import GlobeGround
from optnav_cli.simulation.region_ground import RegionGround, truth_terrain
from optnav_cli.simulation.scenario import scenario_cameras, scenario_copy, scenario_motion
from optnav_cli.simulation.scenario_base import Exposure, FileNames, ScenarioBase, TruthGround
from optnav_cli.simulation.sections import AltimeterSection, SensorSettings
from optnav_cli.simulation.sensor import Counts, expose
from optnav_cli.simulation.stereo_path import StereoScenario, StereoTerrain
from optnav_cli.simulation.surroundings import MeshGround, Surroundings

# Streams of random numbers, apart from those of the trajectory.
SENSOR, CALIBRATION, ALTIMETER = 17, 31, 47

# Steps to where an altimeter's beam meets rough ground: each leaves the slope's share of the error.
RANGE_ROUNDS = 12


class Simulation:
    """The pictures of a scenario; other processes are sent the scenario alone and begin anew."""

    packages: ClassVar = ("optnav_cli",)  # see `catalog.jobs.cluster`

    def __init__(self, scenario: ScenarioBase) -> None:
        self.scenario = scenario

    def __reduce__(self) -> tuple[object, ...]:
        return Simulation, (self.scenario,)

    def files(self) -> list[Path]:
        """All files that the pictures are made from. Raises DataError for one that is damaged."""
        rasters: list[str] = []
        names: list[str] = []

        def noted(name: str) -> str:
            names.append(name)
            return name

        def raster(name: str) -> str:
            rasters.append(name)
            return name

        self.scenario.with_files(FileNames(raster, noted, noted, noted, noted))
        paths = {path for name in names if (path := resolve_path(name, Path())).is_file()}
        for name in rasters:
            path = resolve_path(name, Path())
            with open_raster(path, TERRAIN) as dataset, handle_read_errors(path):
                paths.update(map(Path, dataset.files))  # of a label its image, the parts of a VRT
        return sorted(paths)

    @cached_property
    def motion(self) -> Ephemeris:
        """Rotation of the body."""
        body = load_body(self.scenario.body)
        if self.scenario.photometry:
            body = body.choose_photometry(self.scenario.photometry)
        return scenario_motion(self.scenario, body)

    @cached_property
    def cameras(self) -> list[Camera]:
        """The cameras of the scenario."""
        return scenario_cameras(self.scenario)

    @cached_property
    def _sensors(self) -> list[SensorSettings]:
        """The sensor of each camera as it is."""
        stated = self.scenario.sensor
        blurs = [max(0.0, stated.psf_sigma_px + off[0]) for off in self._calibration_errors]
        return [msgspec.structs.replace(stated, psf_sigma_px=blur) for blur in blurs]

    @cached_property
    def _calibration_errors(self) -> list[tuple[float, Rotation | None]]:
        """Errors of each camera against its file, drawn by the sigmas of the file.

        The blur, px, and a turn of the whole camera that stated attitudes do not know.
        """
        errors: list[tuple[float, Rotation | None]] = []
        drawn = self.scenario.world.camera == "drawn"
        for number, camera in enumerate(self.cameras):
            rng = np.random.default_rng([self.scenario.seed, CALIBRATION, number])
            off = rng.normal(size=4) if drawn else np.zeros(4)
            turned = drawn and camera.boresight_sigma_rad > 0.0
            turn = Rotation.from_rotvec(camera.boresight_sigma_rad * off[1:]) if turned else None
            errors.append((float((camera.psf_error_px or 0.0) * off[0]), turn))
        return errors

    @cached_property
    def flight(self) -> list[Exposure]:
        """All pictures to take."""
        exposures = []
        for exposure in self.scenario.exposures(self.motion):
            turn = self._calibration_errors[exposure.camera][1]
            if turn is not None:
                stated = turn * exposure.reported_camera_from_body
                exposure = replace(exposure, reported_camera_from_body=stated)
            exposures.append(exposure)
        return exposures

    @cached_property
    def names(self) -> list[str]:
        """The files of the pictures."""
        return [exposure.file for exposure in self.flight]

    @property
    def attitude(self) -> Attitude:
        """Which rotation the quaternions of frames.csv and truth.csv are."""
        inertial = self.scenario.attitude.relative_to == "inertial"
        return "camera_from_inertial" if inertial else "camera_from_body"

    @cached_property
    def _ground(self) -> TruthGround:
        return truth_ground(self.scenario, self.motion.body, self.cameras, self.flight)

    @cached_property
    def _surroundings(self) -> list[Surroundings]:
        return [Surroundings(self.scenario, camera, self.motion) for camera in self.cameras]

    def picture(self, number: int) -> bytes:
        """A picture of the flight as PNG, the same in any order."""
        exposure, scenario = self.flight[number], self.scenario
        rng = np.random.default_rng([scenario.seed, SENSOR, exposure.index])
        radiance = self._ground.radiance(self.cameras[exposure.camera], exposure)
        around = self._surroundings[exposure.camera]
        sensor = self._sensors[exposure.camera]
        counts = expose(radiance, sensor, rng, around.besides(exposure, radiance))
        return png(around.with_hot_pixels(counts))

    def write_tables(self, folder: Path) -> None:
        """Write frames.csv, truth.csv, the cameras and the scenario into a folder."""
        scenario, cameras, motion = self.scenario, self.cameras, self.motion
        mount = scenario.mount if isinstance(scenario, StereoScenario) else ()
        settings = RunSettings(scenario.body, self.attitude, scenario.track, mount)
        section = getattr(scenario, "altimeter", msgspec.UNSET)
        if section:
            beam = AltimeterSettings(section.beam)
            settings = msgspec.structs.replace(settings, altimeter=beam)
        start = self.flight[0].tdb_s if self.flight else 0.0
        frames = [_frame(e, scenario, cameras[e.camera].name, start) for e in self.flight]
        if section:
            frames = [
                frame if e.camera else self._with_range(frame, e, section)
                for frame, e in zip(frames, self.flight, strict=True)
            ]
        # cameras as their calibration knows them: of a known blur, that of these pictures
        psf = scenario.sensor.psf_sigma_px
        known = [c if c.psf_sigma_px is None else replace(c, psf_sigma_px=psf) for c in cameras]
        write_folder(folder, settings, known, frames, motion)
        truths = [
            Truth(e.file, e.utc, e.tdb_s, e.position_m, e.camera_from_body) for e in self.flight
        ]
        write_truth(folder / "truth.csv", FileAttitude(self.attitude, motion.body, motion), truths)
        (folder / "scenario.json").write_bytes(scenario_copy(scenario))
        if isinstance(scenario, Descent) and scenario.model:
            write_model(scenario.model, scenario, motion.body, self.flight, folder)

    def _with_range(self, frame: Frame, exposure: Exposure, section: AltimeterSection) -> Frame:
        """A frame with the range of an altimeter beside its camera; without where it meets none."""
        ground, radius = self._ground, self.motion.body.radius_m
        if not isinstance(ground, RegionGround | StereoTerrain):
            return frame
        ray = section.direction @ exposure.camera_from_body.as_matrix()
        height, along = 0.0, np.nan
        for _ in range(RANGE_ROUNDS):
            along = float(distance_to_sphere(exposure.position_m, ray[None], radius + height)[0])
            if not np.isfinite(along):
                return frame
            lat, lon, _ = (float(v) for v in latlon_from_xyz(exposure.position_m + along * ray))
            height = ground.height_m(exposure, lat, lon)
        rng = np.random.default_rng([self.scenario.seed, ALTIMETER, exposure.index])
        measured = section.measure(along, rng)
        return replace(frame, range_m=measured, range_sigma_m=section.sigma_m)


class Taken(msgspec.Struct, frozen=True):
    """A picture as PNG, and the seconds that it took."""

    data: bytes
    seconds: float


def take(simulation: Simulation, numbers: Sequence[int]) -> list[Taken]:
    """Some pictures of a flight."""
    taken = []
    for number in numbers:
        started = time.monotonic()
        data = simulation.picture(number)
        taken.append(Taken(data, round(time.monotonic() - started, 3)))
    return taken


def truth_ground(
    scenario: ScenarioBase, body: Body, cameras: list[Camera], flight: list[Exposure]
) -> TruthGround:
    """The ground that a scenario's cameras share: a shape model, a region's or the whole body's."""
    if isinstance(scenario, StereoScenario):
        return StereoTerrain(scenario, body, flight)
    if scenario.shape is not None:
        return MeshGround(scenario.shape, scenario.detail, body)
    if scenario.dem:
        terrain = truth_terrain(scenario, body, flight)
        return RegionGround(terrain, cameras, flight, scenario.world, near=scenario.is_near_ground)
    model = DemSettings(scenario.globe.path)
    return GlobeGround.of_model(model, scenario.detail, body, len(cameras), scenario.world)


def _frame(exposure: Exposure, scenario: ScenarioBase, camera: str, start_s: float) -> Frame:
    attitude = scenario.attitude
    sigma_m = scenario.prior.component_sigma_m
    sigma = None if attitude.free else attitude.sigma_arcsec * ARCSEC
    if scenario.track:
        sigma_m, sigma = scenario.track.compute_row_sigmas(exposure.tdb_s - start_s)
    return Frame(
        file=exposure.file,
        utc=exposure.utc,
        camera=camera,
        tdb_s=exposure.tdb_s,
        camera_from_body=exposure.reported_camera_from_body,
        attitude_sigma_rad=sigma,
        position_m=exposure.prior_m,
        # a prior without error is still a prior; the search needs some room
        position_sigma_m=None if exposure.prior_m is None else max(sigma_m, 1.0),
        sun_body=exposure.sun_body if exposure.reported_sun else None,
    )


def png(counts: Counts) -> bytes:
    """Counts (rows, columns) as a PNG file."""
    # the strongest compression costs seconds a picture and saves a tenth
    done, data = cv2.imencode(".png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 3])
    if not done:
        raise ValueError(f"no PNG of an array {counts.dtype} {counts.shape}")
    return data.tobytes()
