"""What a flight computer needs: processor time, memory and files of each way to navigate.

Every mode runs in a process of its own on one core in one thread, on one picture (descents: on a
sequence). Times are of the processor, warm; memory is the greatest that is resident over what is
there once all modules are loaded, so it holds the picture, catalogs, maps and all between.
"""

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2
import msgspec
import numba
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.stars import load_bright_stars
from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.pipeline import build
from catalog.places import make_folder
from catalog.progress import Progress
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.cylinder.fit import fit_cylinder
from optnav_cli.cylinder.geometry import CylinderSize
from optnav_cli.cylinder.job import remove_distortion
from optnav_cli.cylinder.profile import measure_profile
from optnav_cli.fix import Method, Solution
from optnav_cli.frames.picture import Picture, load_picture
from optnav_cli.hazard.ground_view import look_down
from optnav_cli.hazard.hazard_map import map_hazard
from optnav_cli.hazard.settings import HazardSettings
from optnav_cli.navigate.autonomous import Navigator
from optnav_cli.navigate.worker import FrameWorker, RunInputs
from optnav_cli.simulation.cylinder_scenario import CylinderSurface, draw_cylinder
from optnav_cli.simulation.descent import Descent
from optnav_cli.simulation.passes import Scenario
from optnav_cli.simulation.scenario_base import ScenarioBase
from optnav_cli.simulation.sections import DetailSettings, SensorSettings
from optnav_cli.simulation.sensor import expose
from optnav_cli.stars.identify import StarIdentifier
from optnav_cli.stars.spots import find_spots
from tests.optnav_cli.made_skies import drawn_sky
from tests.studies import flights
from tests.studies.hazard_fields import make_field, perspective_picture
from tests.studies.tables import StudyReport, StudyTable, columns

RELIEF = "data/moon_gld100_4ppd.tif"
STAR_CATALOGUE = "data/bright_stars.csv"
STARS, HAZARD, CYLINDER = "stars", "hazard map", "cylinder"
PAD_HEIGHT_M, PAD_SUN_DEG, DRAWN_M = 500.0, 20.0, 0.5  # of the hazard map
CYLINDER_M = (0.14, 0.15)  # radius and height
DESCENT_FRAMES, SETTLED_FRAMES = 8, 2  # of a descent; the first of them are not timed
DESCENT_SMALLEST_M = 24.0  # relief in its pictures, which only what is timed needs
EVERYWHERE_M = 1e9  # windows are sought above this height: nowhere
NEVER_M = 0.0
KILO, MEGA = 1024.0, 1e6


@dataclass(frozen=True)
class Mode:
    """A way to navigate by a frame.

    scenario  whose first picture it takes; empty: it draws its own
    catalog   of configs/catalogs that it reads; empty: none
    relief    whether it reads the map of the whole Moon
    method    by which the frame must be solved; None: of no solution.csv
    """

    name: str
    scenario: str = ""
    catalog: str = ""
    relief: bool = False
    method: Method | None = None


MODES = (
    Mode("brightness centre", "phobos_disc", method=Method.BRIGHTNESS_CENTRE),
    Mode("limb over relief", "shnk_200km", relief=True, method=Method.HORIZON),
    Mode("control points", "unk_200km", "tycho", method=Method.CONTROL_POINTS),
    Mode("relative landmarks", "descent_118m", "tycho_descent"),
    Mode("descent, windows and landmarks", "descent_118m", "tycho_descent"),
    Mode(STARS),
    Mode(HAZARD),
    Mode(CYLINDER),
)


@dataclass(frozen=True)
class Cost:
    """What a mode took: seconds of the processor by frame, bytes above the modules and of files."""

    mode: str
    seconds: tuple[float, ...]
    memory_bytes: float
    file_bytes: float
    size_px: tuple[int, int]


def run(output: Path, progress: Progress, rows: str = "", rounds: int = 7) -> list[Cost]:
    """Make pictures and catalogs, and measure every mode in a process of its own.

    output  folder for pictures and catalogs; what is in it is used again
    rows    only modes whose name contains this
    rounds  timed frames after one to warm up
    """
    chosen = [mode for mode in MODES if rows in mode.name]
    if not chosen:
        raise NothingToDoError(f"no row of the study is called '{rows}'")
    make_folder(output)
    for mode in chosen:
        if mode.scenario:
            flights.made_pictures(_scenario(mode), output / "pictures" / mode.scenario, progress)
        else:
            _draw(mode, _drawn_place(mode, output))
        if mode.catalog:
            config = resource(f"configs/catalogs/{mode.catalog}.toml")
            build.run(config, output=output / f"{mode.catalog}.gpkg", progress=progress)
    # of the processes below, before they load the library
    threads = os.environ.get("OPENBLAS_NUM_THREADS")
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    try:
        costs = []
        with progress.stage("measure", len(chosen), "mode") as bar:
            for mode in chosen:
                # once to fill the cache of compiled kernels, which would count as memory
                for count in (1, rounds):
                    with ProcessPoolExecutor(1, get_context("spawn")) as alone:
                        cost = alone.submit(measure, mode, output, count).result()
                costs.append(cost)
                bar.advance()
    finally:
        if threads is None:
            del os.environ["OPENBLAS_NUM_THREADS"]
        else:
            os.environ["OPENBLAS_NUM_THREADS"] = threads
    return costs


def _drawn_place(mode: Mode, folder: Path) -> Path:
    return folder / "drawn" / f"{mode.name}.npz"


def _scenario(mode: Mode) -> ScenarioBase:
    """The scenario of a mode, no longer than needed."""
    scenario = flights.shipped_scenario(mode.scenario)
    if isinstance(scenario, Descent):
        detail = msgspec.structs.replace(scenario.detail, smallest_m=DESCENT_SMALLEST_M)
        scenario = msgspec.structs.replace(scenario, detail=detail)
        return scenario.shortened(DESCENT_FRAMES)
    if mode.relief and isinstance(scenario, Scenario):  # the limb needs the whole Moon
        detail = DetailSettings(seeds=scenario.detail.seeds[:1])
        prior = msgspec.structs.replace(scenario.prior, given=False)
        globe = msgspec.structs.replace(scenario.globe, path=str(resource(RELIEF)))
        scenario = msgspec.structs.replace(
            scenario, dem=(), globe=globe, detail=detail, prior=prior
        )
    return scenario.shortened(1)


def measure(mode: Mode, folder: Path, rounds: int) -> Cost:
    """Time a mode and its memory in this process, which must have done nothing else."""
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    before = _resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # forget the greatest so far
    frames, size, files = _prepare(mode, folder)
    next(frames)  # opens files, fills caches
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        if next(frames, None) is None:
            break
        seconds.append(time.process_time() - start)
    memory = _resident("VmHWM") - before
    return Cost(
        mode.name, tuple(seconds), memory, float(sum(f.stat().st_size for f in files)), size
    )


def _resident(key: str) -> float:
    """Resident memory of this process, bytes: VmRSS now, VmHWM the greatest."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (line,) = (line for line in lines if line.startswith(f"{key}:"))
    return float(line.split()[1]) * KILO


Prepared = tuple[Iterator[bool], tuple[int, int], Sequence[Path]]


def _prepare(mode: Mode, folder: Path) -> Prepared:
    """Frames that are processed one by one, the size of their pictures, and files that are read."""
    if not mode.scenario:
        return _drawn_frames(mode, _drawn_place(mode, folder))
    catalogs = [folder / f"{mode.catalog}.gpkg"] if mode.catalog else []
    relief = resource(RELIEF) if mode.relief else None
    worker = FrameWorker(RunInputs(folder / "pictures" / mode.scenario, catalogs, relief=relief))
    (camera,) = worker.folder.cameras.values()
    size = camera.width_px, camera.height_px
    files = [*catalogs, *([relief] if relief else [])]
    if mode.method is None:
        above = EVERYWHERE_M if "windows" not in mode.name else NEVER_M
        return _descend(worker, above), size, files
    return _solve_again(worker, mode.method), size, files


def _solve_again(worker: FrameWorker, method: Method) -> Iterator[bool]:
    """The first frame again and again, from its file, by a navigator that has seen no other."""
    frame = worker.folder.frames[0]
    camera = worker.folder.cameras[frame.camera]
    while True:
        picture = load_picture(worker.folder.picture_path(frame), camera)
        _check(Navigator(worker.inputs).solve(frame, camera, picture), method)
        yield True


def _descend(worker: FrameWorker, windows_above_m: float) -> Iterator[bool]:
    """The frames of a descent in turn; the first ones before the first that is timed."""
    navigator = worker.make_descent(windows_above_m=windows_above_m)
    if navigator is None:
        raise ValueError("the frames are of no descent")
    for number, frame in enumerate(worker.folder.frames):
        camera = worker.folder.cameras[frame.camera]
        picture = load_picture(worker.folder.picture_path(frame), camera)
        navigator.solve(frame, camera, picture)
        if number + 1 >= SETTLED_FRAMES:
            yield True


def _check(row: Solution, method: Method) -> None:
    if row.method != method:
        raise ValueError(f"solved by {row.method or 'nothing'}, not {method}: {row.reason}")


def _again(call: Callable[[], object]) -> Iterator[bool]:
    while True:
        call()
        yield True


def _draw(mode: Mode, place: Path) -> None:
    """Draw the picture of a mode that has no scenario; in this process, so that no memory counts.

    Pictures of a hazard map come with the azimuth of the light, rad.
    """
    picture, azimuth, full = np.zeros(0, np.float32), 0.0, math.inf
    if mode.name == STARS:
        turn = Rotation.from_euler("xyz", (-60.0, 10.0, 40.0), degrees=True)
        picture = drawn_sky(turn, preset_camera("unk"))
    elif mode.name == HAZARD:
        field = make_field("rough", 1, 1000, DRAWN_M)
        camera = preset_camera("tsnn2_narrow")
        drawn = perspective_picture(field, camera, PAD_HEIGHT_M, PAD_SUN_DEG, DRAWN_M)
        picture, azimuth = drawn.values, field.azimuth_deg()
        full = math.inf if drawn.saturation is None else drawn.saturation
    else:
        light = draw_cylinder(
            preset_camera("lab_20deg"),
            CYLINDER_M,
            (1.34, 0.0, math.radians(40.0)),
            CylinderSurface(gloss=0.15),
        )
        counts = expose(light, SensorSettings(0.8, 90.0), np.random.default_rng(1))
        picture = counts.astype(np.float32)
    place.parent.mkdir(exist_ok=True)
    np.savez(place, picture=np.asarray(picture, np.float32), azimuth=azimuth, full=full)


def _drawn_frames(mode: Mode, place: Path) -> Prepared:
    """Frames of a picture that `_draw` left."""
    with np.load(place) as kept:
        picture, azimuth, full = kept["picture"], float(kept["azimuth"]), float(kept["full"])
    size = picture.shape[1], picture.shape[0]
    if mode.name == STARS:
        stars = load_bright_stars().propagate(None)
        identifier = StarIdentifier(preset_camera("unk"), stars)
        calls = _again(lambda: identifier.attempt(find_spots(picture, 65535.0)))
        return calls, size, [resource(STAR_CATALOGUE)]
    if mode.name == HAZARD:
        camera, whole = (
            preset_camera("tsnn2_narrow"),
            Picture(picture, full if math.isfinite(full) else None),
        )

        def mapped() -> None:
            view = look_down(whole, camera, PAD_HEIGHT_M, PAD_SUN_DEG, azimuth)
            map_hazard(view, HazardSettings())

        return _again(mapped), size, []
    straight = remove_distortion(preset_camera("lab_20deg"))
    cylinder = CylinderSize(*CYLINDER_M)
    fitted = _again(lambda: fit_cylinder(measure_profile(picture, 255.0), straight, cylinder))
    return fitted, size, []


COLUMNS = columns(
    "mode; picture [px]; time_ms = processor time a frame, median [ms] .0f; "
    "longest_ms = longest [ms] .0f; timed; memory_mb = memory over the modules [MB] .0f; "
    "files_mb = catalogs and maps read [MB] .1f"
)
NOTES = (
    "the catalog is of 75 square degrees about Tycho; 41 252 points take 0.83 GB (`make bench`)",
    "source: states no times and no memory. Its catalog of 41 252 points of five levels takes one "
    "to two orders of magnitude less than pictures of the ground; it asks for faster processors",
)


def report(costs: Sequence[Cost]) -> StudyReport:
    """One line a mode."""
    rows = tuple(
        (
            cost.mode,
            f"{cost.size_px[0]} x {cost.size_px[1]}",
            1e3 * float(np.median(cost.seconds)),
            1e3 * max(cost.seconds),
            len(cost.seconds),
            cost.memory_bytes / MEGA,
            cost.file_bytes / MEGA,
        )
        for cost in costs
    )
    return StudyReport((StudyTable("A frame on one core, one thread", COLUMNS, rows),), NOTES)
