"""What the studies of flights share: pictures of shipped scenarios, star sensors, tables of frames.

What a picture shows does not depend on the stated pose, so one folder of pictures serves exact
attitudes, those of a star sensor and flights without a prior.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array
from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.files import make_prefix_test, write_output
from catalog.geometry.rotations import ARCSEC
from catalog.pipeline import build
from catalog.pipeline.ingest import Bbox
from catalog.progress import Progress
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.error_model import StatedError
from optnav_cli.evaluation.figures import FrameError
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.simulation import descent
from optnav_cli.simulation.job import simulate_folder
from optnav_cli.simulation.scenario import load_scenario, scenario_copy
from optnav_cli.simulation.scenario_base import ScenarioBase
from tests.studies.tables import Cell, StudyTable, columns

GLOBE = "shared:moon/moon_gld100_32ppd.tif"  # the ground of shipped scenarios
# Its catalog, 948 m with wide cells.
MOON = f'[body]\nname = "moon"\n\n[[dem]]\npath = "{GLOBE}"\n\n[grid]\ncell_deg = 3.0\n'
STAR_SENSOR_ARCSEC = 10.0
# What 10 arc seconds of attitude cost on the ground, both axes: 1.41 x 10" = 0.069 m a kilometre.
STAR_SENSOR_M_PER_KM = 0.07
SEED = 10
FIGURES = "figures.json"  # a flight study's tables, with those of single frames, in its folder


# Grounds that scenarios fly over, as tables of studies are called; the first one is that of real_*.
GROUNDS = ("Ground off as the Moon's is from GLD100", "The simulator's own ground")


def ground_of(scenario: str) -> str:
    """Over which of GROUNDS a shipped scenario flies."""
    return GROUNDS[0] if scenario.startswith("real_") else GROUNDS[1]


# What is stated of models of 118 m that are right but for relief below their nodes, and of a better
# one than GLD100; where nothing is, control points take GLD100's.
RIGHT = StatedError(error_m=0.5)
BETTER = StatedError(error_m=7.0, resolution_km=0.4)


def stated_error_of(scenario: str) -> StatedError:
    """What is stated of the relief's error that a shipped scenario flies over: that of real_*."""
    return StatedError("gld100") if ground_of(scenario) == GROUNDS[0] else StatedError()


def points_error_of(scenario: str) -> StatedError:
    """What the catalog of control points states of the terrain model below a shipped scenario."""
    if ground_of(scenario) == GROUNDS[1] or scenario.endswith("_right"):
        return RIGHT
    return BETTER if scenario.endswith("_better") else StatedError()


@dataclass(frozen=True)
class Case:
    """A row of a study."""

    name: str


R = TypeVar("R", bound=Case)


def rows_named(rows: Sequence[R], part: str) -> list[R]:
    """The rows whose name contains a text, or one of several between bars.

    Raises NothingToDoError when there is none.
    """
    chosen = [row for row in rows if any(each in row.name for each in part.split("|"))]
    if not chosen:
        raise NothingToDoError(f"no row of the study is called '{part}'")
    return chosen


def check_shared_files(scenarios: Iterable[str]) -> None:
    """Raise ConfigError for a shared albedo map that shipped scenarios need and that is missing."""
    for name in scenarios:
        albedo_map = shipped_scenario(name).world.albedo_map
        if albedo_map:
            resolve_path(albedo_map.path, Path.cwd())


def written_model(path: Path, heights: Float32Array, crs: object, transform: object) -> Path:
    """A drawn terrain model as GeoTIFF; left alone when it is there already."""
    data = descent.geotiff(heights, crs, transform)
    if not (path.is_file() and path.read_bytes() == data):
        write_output(path, data, make_prefix_test(data[:4]))
    return path


def shipped_scenario(name: str) -> ScenarioBase:
    """A scenario of configs/scenarios."""
    return load_scenario(resource(f"configs/scenarios/{name}.toml"))


def shipped_pictures(output: Path, name: str, frames: int | None, progress: Progress) -> Path:
    """The picture folder of a shipped scenario; made unless the same one is there.

    output  the study's folder;  frames  pictures of the scenario, its own number when None
    """
    scenario = shipped_scenario(name)
    if frames is not None:
        scenario = scenario.shortened(frames)
    return made_pictures(scenario, output / "pictures" / name, progress)


def made_pictures(scenario: ScenarioBase, place: Path, progress: Progress) -> Path:
    """The picture folder of a scenario; made unless the same one is there."""
    place.parent.mkdir(exist_ok=True)
    mark = place / "scenario.json"
    if not (mark.is_file() and mark.read_bytes() == scenario_copy(scenario)):
        simulate_folder(scenario, place, progress)
    return place


def navigated(
    pictures: Path,
    catalogs: Sequence[Path],
    place: Path,
    progress: Progress,
    relief: Path | None = None,
) -> tuple[FrameError, ...]:
    """Navigate pictures into a run folder and compare every frame with its truth."""
    place.parent.mkdir(exist_ok=True)
    # without a solution the run is written all the same, and that is a figure too
    with suppress(NothingToDoError):
        navigate_folder(RunInputs(pictures, catalogs, relief=relief), place, progress)
    return tuple(evaluate_run(place, pictures / "truth.csv").frames)


def text_file(path: Path, text: str) -> Path:
    """A file with this text; left alone when it is right, so that rows can share a folder."""
    if not (path.is_file() and path.read_text(encoding="utf-8") == text):
        write_output(path, text.encode(), make_prefix_test(text.encode()[:40]))
    return path


def built_catalog(config: Path, text: str, progress: Progress, bbox: Bbox | None = None) -> Path:
    """The catalog beside a build configuration that is written with this text."""
    text_file(config, text)
    catalog = config.with_suffix(".gpkg")
    build.run(config, output=catalog, bbox=bbox, progress=progress)
    return catalog


def with_star_sensor(pictures: Path, *, priors: bool = True) -> Path:
    """The same pictures with attitudes that are off as a star sensor's are.

    priors  False: and without positions
    """
    sigma = STAR_SENSOR_ARCSEC * ARCSEC
    word = f"{STAR_SENSOR_ARCSEC:g}arcsec"
    place = pictures.with_name(f"{pictures.name}-{word}" + ("" if priors else "-noprior"))
    folder = read_folder(pictures)
    rng = np.random.default_rng(SEED)
    frames = []
    for frame in folder.frames:
        turn = Rotation.from_rotvec(rng.normal(0.0, sigma, 3))
        attitude = None if frame.camera_from_body is None else turn * frame.camera_from_body
        stated = replace(frame, camera_from_body=attitude, attitude_sigma_rad=sigma)
        if not priors:
            stated = replace(stated, position_m=None, position_sigma_m=None)
        frames.append(stated)
    write_folder(place, folder.settings, folder.cameras.values(), frames)
    for name in [*(frame.file for frame in frames), "truth.csv"]:
        link = place / name
        link.unlink(missing_ok=True)
        os.link(pictures / name, link)
    return place


def limit_with_star_sensor(limit_m: float, frames: Sequence[FrameError]) -> float:
    """A limit of the horizontal error and what a star sensor adds at the frames' heights, m."""
    heights_km = np.array([frame.height_m for frame in frames]) / 1e3
    extra = np.mean((STAR_SENSOR_M_PER_KM * heights_km) ** 2)
    return float(np.hypot(limit_m, np.sqrt(extra)))


def sigmas_off(frame: FrameError) -> float:
    """How far a solved frame is off in its own sigmas; 0 for an unsolved one."""
    return 0.0 if frame.nees is None else float(np.sqrt(frame.nees))


def not_solved(case: str, reasons: Sequence[str]) -> list[str]:
    """How many frames of a case were not solved, by reason."""
    return [f"{case}: {reasons.count(why)} not solved: {why}" for why in sorted(set(reasons))]


FRAME_COLUMNS = columns(
    "case; file; distance [m] .0f; method; prior; error R [m] .1f; error N [m] .1f; "
    "error B [m] .1f; sigmas = off [σ] .1f; reason"
)


def frames_table(cases: Mapping[str, Sequence[FrameError]]) -> StudyTable:
    """Every frame of a study by case: what it was solved by, and its error or why it has none."""
    return StudyTable(
        "frames", FRAME_COLUMNS, tuple(_cells(case, f) for case, own in cases.items() for f in own)
    )


def _cells(case: str, frame: FrameError) -> tuple[Cell, ...]:
    solved, solution = frame.error_rnb_m is not None, frame.solution
    error = [None] * 3 if frame.error_rnb_m is None else [float(v) for v in frame.error_rnb_m]
    sigmas = sigmas_off(frame) if solved else None
    start = (case, frame.file, frame.distance_m, solution.method, solution.prior)
    return (*start, *error, sigmas, solution.reason)
