"""A route through drawn pictures: flown with one lens, told another, calibrated, navigated."""

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree

import msgspec
import numpy as np

from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress
from optnav_cli.calibration.job import Calibration, calibrate_folder
from optnav_cli.calibration.model import CalibrateSettings, estimate_frame_motions
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml, load_camera, preset_camera
from optnav_cli.estimation.models.common import CommonState, common_numbers
from optnav_cli.evaluation.evaluation import Evaluation
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.truth import read_truth
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.simulation.job import simulate_folder
from optnav_cli.simulation.passes import Scenario
from optnav_cli.simulation.scenario import load_scenario
from tests.studies.calibration_routes import KINDS, OFF

GNSS_M, STARS_ARCSEC = 10.0, 10.0
PRIOR_M = 3000.0  # of the navigation with the old and the new camera
OLD_ARCSEC = 400.0  # what an old camera's mounting must be taken for to be navigated with
TOLD, WITH_OLD, WITH_NEW = "told", "told-old", "told-new"


@dataclass(frozen=True, eq=False)
class PictureRoute:
    """What came of the drawn route: the calibration, what is true, the runs with both cameras."""

    calibration: Calibration
    truth: CommonState
    old: Evaluation
    new: Evaluation


def picture_route(
    place: Path, catalog: Path, frames: int, progress: Progress, camera: Camera | None = None
) -> PictureRoute:
    """Draw a route, calibrate by it, and navigate it with the camera of before and after.

    camera  as told; the narrow one of the ship by default
    Pictures that are there are used again.
    """
    told = camera or preset_camera("unk")
    numbers = common_numbers(KINDS, [told.name], 1.0)
    signs = np.array([1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0])
    truth = CommonState(numbers, signs * np.array([OFF[n.kind] for n in numbers]))
    place.mkdir(parents=True, exist_ok=True)
    (place / f"{told.name}.toml").write_text(camera_toml(truth.lens(told)), encoding="utf-8")
    scenario = load_scenario(resource("configs/scenarios/demo.toml"))
    if not isinstance(scenario, Scenario):
        raise TypeError("the demo is no scenario of passes")
    change = msgspec.structs.replace
    flown = change(
        scenario,
        camera=change(scenario.camera, name=str(place / f"{told.name}.toml")),
        orbit=change(scenario.orbit, frames=max(3, frames // 2), passes=2),
        pointing=change(scenario.pointing, roll_sigma_deg=90.0),
        prior=change(scenario.prior, position_sigma_m=GNSS_M),
        attitude=change(scenario.attitude, sigma_arcsec=STARS_ARCSEC),
    )
    simulate_folder(flown, place / "flown", progress)
    _told(place / "flown", place / TOLD, told, truth)
    inputs = RunInputs(place / TOLD, [catalog])
    output = place / "calibration"
    result = calibrate_folder(inputs, output, KINDS, CalibrateSettings(), progress, None)
    found = load_camera(output / "cameras" / f"{told.name}.toml")
    runs = []
    unsure = replace(told, boresight_sigma_arcsec=OLD_ARCSEC)
    for name, lens in ((WITH_OLD, unsure), (WITH_NEW, found)):
        _with_camera(place / TOLD, place / name, lens)
        run = place / f"{name}-run"
        with suppress(NothingToDoError):  # a run without any solution is a figure, too
            navigate_folder(RunInputs(place / name, [catalog]), run, progress, workers=None)
        runs.append(evaluate_run(run, place / "flown" / "truth.csv"))
    return PictureRoute(result, truth, *runs)


def _told(flown: Path, place: Path, told: Camera, truth: CommonState) -> None:
    """The folder as it is told: another camera, no mounting, times that are early."""
    folder = read_folder(flown)
    real = {t.file: t.position_m for t in read_truth(flown / "truth.csv", folder.attitude)}
    mounting, late = truth.boresight(told.name), truth.clock_s(told.name)
    times = [frame.tdb_s or 0.0 for frame in folder.frames]
    motions = estimate_frame_motions(times, [real[frame.file] for frame in folder.frames])
    frames = []
    for frame, motion in zip(folder.frames, motions, strict=True):
        if motion is None or frame.camera_from_body is None:
            raise ValueError(f"{frame.file} has no neighbours, or no attitude")
        before, attitude, _, _ = motion.propagate(frame.position_m, frame.camera_from_body, -late)
        if attitude is not None:
            # the scenario turns the camera; what is told is the ship, a mounting away from it
            stated = mounting.inv() * attitude
            frames.append(replace(frame, position_m=before, camera_from_body=stated))
    rmtree(place, ignore_errors=True)
    write_folder(place, folder.settings, [told], frames, folder.motion)
    _link_pictures(flown, place)


def _with_camera(source: Path, place: Path, camera: Camera) -> None:
    """The told folder with another camera, and a prior like that of a navigation."""
    folder = read_folder(source)
    stated = folder.cameras[camera.name]
    frames: list[Frame] = []
    for frame in folder.frames:
        turn = frame.camera_from_body
        rng = np.random.default_rng([7, len(frames)])
        if turn is None or frame.position_m is None:
            continue
        attitude = camera.apply_boresight(stated.remove_boresight(turn))
        prior = frame.position_m + PRIOR_M * rng.normal(size=3)
        sigma = float(np.hypot(STARS_ARCSEC * ARCSEC, camera.boresight_sigma_rad))
        frames.append(
            replace(
                frame,
                camera_from_body=attitude,
                attitude_sigma_rad=sigma,
                common_sigma_rad=camera.boresight_sigma_rad,
                position_m=prior,
                position_sigma_m=PRIOR_M,
            )
        )
    rmtree(place, ignore_errors=True)
    write_folder(place, folder.settings, [camera], frames, folder.motion)
    _link_pictures(source, place)


def _link_pictures(source: Path, place: Path) -> None:
    for path in sorted(source.glob("*.png")):
        (place / path.name).symlink_to(path.resolve())
