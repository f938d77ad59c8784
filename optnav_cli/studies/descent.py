"""A descent to 2 km by windows and landmarks: errors by height, and what breaks them.

Pictures are of several grounds; what a picture shows does not depend on the inertial track, so each
is flown with several tracks of drawn errors. The catalog's model is that of the truth without what
lies below its posting; in one row it is wrong besides. A table without pictures compares landmarks
in one state with the pose against landmarks as independent points.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
from rasterio.io import MemoryFile
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.config import resource
from catalog.files import starts_with, write_output
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from catalog.progress import Progress
from catalog.rasters import TERRAIN, open_raster, reading_raster
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.estimation.descent_filter import DescentFilter
from optnav_cli.estimation.models.points import Sightings, predict
from optnav_cli.fix import Solution
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.frames.truth import Truth, read_truth
from optnav_cli.runs.frame_worker import FrameWorker, RunInputs
from optnav_cli.simulation.descent import Descent, track_errors
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.studies import descent_measurements, flights
from optnav_cli.studies.descent_measurements import Formulation
from optnav_cli.studies.tables import Cell, StudyReport, StudyTable, columns, rms

SCENARIO, CATALOG, MODEL = "descent_118m", "tycho_descent", "tycho_gld100_256ppd.tif"
SPACING_S, SUNS_DEG = 10.0, ((10.0, 20.0), (12.0, 12.0), (18.0, 18.0), (10.0, 10.0), (20.0, 20.0))
LOW_M = 6500.0  # where the published descent on a 118 m model ends
# The descent whose landmarks are flown alone: lower and slower, so that pictures overlap.
LOW_FROM_KM, LOW_S, LOW_SPEED_M_S, LOW_SPACING_S, LOW_TILT_DEG = 10.0, 80.0, 700.0, 4.0, 10.0
WRONG_M, WRONG_POSTINGS = 3.0, 0.6  # of the model; sigma of its smoothing: 1-2 postings wide
ACCELERATION_M_S2 = 0.02
MEASURED_RUNS, TIMED_LANDMARKS, TIMED_UPDATES = 40, 60, 20


@dataclass(frozen=True)
class DescentCase(flights.Case):
    """A row: heights over the ground (m), what is wrong, and the figures wanted."""

    lowest_m: float
    highest_m: float
    wanted: str
    acceleration_m_s2: float = 0.0
    wrong: bool = False
    landmarks: bool = False


CASES = (
    DescentCase("118 m, 20-6.5 km", LOW_M, 3e4, "6 / 8"),
    DescentCase("118 m, 6.5-2 km, absolute", 0.0, LOW_M, "8 / 12"),
    DescentCase("model wrong by 3 m rms, 20-6.5 km", LOW_M, 3e4, "15 / 25", wrong=True),
    DescentCase("model wrong by 3 m rms, 6.5-2 km", 0.0, LOW_M, "15 / 25", wrong=True),
    DescentCase("track with 0.02 m/s², 20-6.5 km", LOW_M, 3e4, "6 / 8", ACCELERATION_M_S2),
    DescentCase("track with 0.02 m/s², 6.5-2 km", 0.0, LOW_M, "8 / 12", ACCELERATION_M_S2),
    DescentCase("no windows below 6.5 km", 0.0, LOW_M, "40 at 2 km", landmarks=True),
)
ALONE = [case for case in CASES if case.landmarks]


@dataclass(frozen=True, eq=False)
class FlownFrame:
    """A frame of a flight: height over the ground below, error east, north, up, NEES a degree."""

    height_m: float
    error_m: FloatArray | None
    nees: float | None
    solution: Solution
    last: bool


@dataclass(frozen=True, eq=False)
class DescentResult:
    """Frames by case; the descents without pictures; ms of a frame and of the filter."""

    frames: dict[str, list[FlownFrame]]
    measured: dict[Formulation, list[descent_measurements.Errors]]
    frame_ms: float
    filter_ms: float


def run(
    output: Path,
    progress: Progress,
    grounds: int = 5,
    first: int = 0,
    tracks: int = 3,
    landmarks_only: bool = False,
    rows: str = "",
) -> DescentResult:
    """Fly all cases; catalogs and pictures go into `output`, and are used again.

    grounds, tracks  pictures of so many grounds, each flown with so many drawn tracks
    first            number of the first ground
    landmarks_only   only the row without windows near the ground
    """
    output.mkdir(exist_ok=True, parents=True)
    chosen = flights.rows_named(ALONE if landmarks_only else CASES, rows)
    text = resource(f"configs/catalogs/{CATALOG}.toml").read_text(encoding="utf-8")
    catalog = flights.built_catalog(output / "tycho.toml", text, progress)
    wrong = catalog
    if any(case.wrong for case in chosen):
        model = write_wrong_model(output / "wrong.tif")
        own = text.replace(f"bundled:{MODEL}", model.name)
        wrong = flights.built_catalog(output / "wrong.toml", own, progress)
    frames: dict[str, list[FlownFrame]] = {case.name: [] for case in chosen}
    seconds: list[float] = []
    done: dict[tuple[int, int, float, bool, bool], list[FlownFrame]] = {}
    with progress.stage("fly", len(chosen) * grounds * tracks, "descent") as bar:
        for ground in range(first, first + grounds):
            for case in chosen:
                pictures = flights.made_pictures(
                    scenario_of(ground, low=case.landmarks), _place(output, ground, case), progress
                )
                for track in range(tracks):
                    key = ground, track, case.acceleration_m_s2, case.wrong, case.landmarks
                    if key not in done:
                        used = wrong if case.wrong else catalog
                        done[key] = fly(pictures, used, case, 100 * ground + track, seconds)
                    frames[case.name] += [
                        f for f in done[key] if case.lowest_m <= f.height_m < case.highest_m
                    ]
                    bar.advance()
    camera = preset_camera("tsnn2_wide")
    measured = {
        formulation: [
            descent_measurements.fly(camera, formulation, seed) for seed in range(MEASURED_RUNS)
        ]
        for formulation in Formulation
    }
    # the first frames compile kernels and make windows that the later ones find made
    frame_ms = 1e3 * float(np.median(seconds)) if seconds else float("nan")
    return DescentResult(frames, measured, frame_ms, filter_ms())


def scenario_of(ground: int, *, low: bool) -> Descent:
    """The shipped descent over another ground under another Sun; low: from 10 km alone."""
    scenario = load_scenario(resource(f"configs/scenarios/{SCENARIO}.toml"))
    if not isinstance(scenario, Descent):
        raise TypeError(f"{SCENARIO} is no descent")
    descent = msgspec.structs.replace(scenario.descent, spacing_s=SPACING_S)
    seed, relief, sun = 7300 + ground, 31 + ground, SUNS_DEG[ground % len(SUNS_DEG)]
    if low:
        seed, relief, sun = seed + 10, relief + 2, scenario.sun.elevation_deg
        descent = msgspec.structs.replace(
            descent,
            from_km=LOW_FROM_KM,
            duration_s=LOW_S,
            speed_m_s=(LOW_SPEED_M_S, descent.speed_m_s[1]),
            tilt_deg=(LOW_TILT_DEG, 0.0),
            spacing_s=LOW_SPACING_S,
        )
    return msgspec.structs.replace(
        scenario,
        seed=seed,
        descent=descent,
        sun=msgspec.structs.replace(scenario.sun, elevation_deg=sun),
        detail=msgspec.structs.replace(scenario.detail, seeds=(relief,)),
    )


def fly(
    pictures: Path, catalog: Path, case: DescentCase, seed: int, seconds: list[float]
) -> list[FlownFrame]:
    """Fly pictures with a track of drawn errors; seconds gets those of the processor, a frame."""
    worker = FrameWorker(RunInputs(pictures, [catalog]))
    try:
        folder = worker.folder
        truths = read_truth(pictures / "truth.csv", folder.attitude)
        track = InertialSettings(acceleration_sigma_m_s2=case.acceleration_m_s2)
        times = tuple(truth.tdb_s - truths[0].tdb_s for truth in truths)
        places, turns = track_errors(track, times, seed)
        navigator = worker.descent(track, LOW_M if case.landmarks else 0.0)
        if navigator is None:
            raise TypeError(f"{pictures} is no descent")
        found = []
        for k, (frame, truth) in enumerate(zip(folder.frames, truths, strict=True)):
            stated = replace(
                frame,
                position_m=truth.position_m - places[k],
                camera_from_body=Rotation.from_rotvec(turns[k]).inv() * truth.camera_from_body,
            )
            camera = folder.cameras[frame.camera]
            picture = load_picture(folder.picture_path(frame), camera)
            started = time.process_time()
            solution = navigator.solve(stated, camera, picture)
            seconds.append(time.process_time() - started)
            ground = folder.body.radius_m + (navigator.ground_m(truth.position_m) or 0.0)
            found.append(_flown(solution, truth, ground, last=k == len(truths) - 1))
        return found
    finally:
        worker.close()


def write_wrong_model(path: Path) -> Path:
    """The bundled model with errors of WRONG_M rms that are one to two postings wide."""
    source = resource(f"data/{MODEL}")
    with open_raster(source, TERRAIN) as dataset, reading_raster(source):
        heights = dataset.read(1).astype(np.float32)
        profile = {"crs": dataset.crs, "transform": dataset.transform, "dtype": "float32"}
    noise = np.random.default_rng(3).normal(size=heights.shape).astype(np.float32)
    noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), WRONG_POSTINGS), np.float32)
    heights += noise * np.float32(WRONG_M / float(noise.std()))
    size = {"height": heights.shape[0], "width": heights.shape[1], "count": 1}
    with MemoryFile() as memory:
        with memory.open(driver="GTiff", compress="deflate", **profile, **size) as made:
            made.write(heights, 1)
        data = memory.read()
    if not (path.is_file() and path.read_bytes() == data):
        write_output(path, data, starts_with(data[:4]))
    return path


def filter_update() -> Callable[[], object]:
    """An update of the filter with TIMED_LANDMARKS landmarks, to be timed."""
    camera, rng = preset_camera("tsnn2_wide"), np.random.default_rng(1)
    errors = descent_measurements.ERRORS
    (stated, *_), _ = descent_measurements.drawn_poses(rng, errors)
    pixels = rng.uniform(0.05, 0.95, (TIMED_LANDMARKS, 2)) * camera.width_px
    flown = DescentFilter(errors)
    rays = camera.unproject(pixels) @ stated.camera_from_body.as_matrix()
    down = rays @ stated.position_m / float(np.linalg.norm(stated.position_m))
    places = stated.position_m - (descent_measurements.FROM_M / down)[:, None] * rays
    one = np.tile(0.09 * np.eye(2), (TIMED_LANDMARKS, 1, 1))
    numbers = flown.add_sighted(camera, stated, places, one, np.full(TIMED_LANDMARKS, 30.0))
    seen, _ = predict(camera, flown.pose(stated), flown.places_m)
    return lambda: flown.update(camera, stated, numbers, Sightings(places, seen, one))


def filter_ms() -> float:
    """Milliseconds of the processor for such an update."""
    update, taken = filter_update(), []
    for _ in range(TIMED_UPDATES):
        started = time.process_time()
        update()
        taken.append(time.process_time() - started)
    return 1e3 * float(np.median(taken))


def _place(output: Path, ground: int, case: DescentCase) -> Path:
    return output / "pictures" / f"{'low' if case.landmarks else 'descent'}-{ground}"


def _flown(solution: Solution, truth: Truth, ground_m: float, *, last: bool) -> FlownFrame:
    lat, lon, distance = (float(v) for v in latlon_from_xyz(truth.position_m))
    height = distance - ground_m
    fix = solution.fix
    if fix is None:
        return FlownFrame(height, None, None, solution, last)
    off = fix.position_m - truth.position_m
    nees = float(off @ np.linalg.solve(fix.covariance_m2, off)) / 3.0
    return FlownFrame(height, off @ body_from_local(lat, lon), nees, solution, last)


COLUMNS = columns(
    "case; solved; frames; horizontal, a component [m] .1f; height [m] .1f; "
    "largest horizontal [m] .1f; largest height [m] .1f; at the end, horizontal [m] .1f; "
    "asked for [m]; NEES .2f; windows a frame .1f; landmarks a frame .1f"
)
MEASURED = columns(
    "landmarks; descents; along at 2 km [m] .1f; across [m] .1f; up [m] .1f; NEES .2f; "
    "nees_end = NEES at 2 km .2f"
)
TIMES = columns("what; time [ms] .0f; asked for [ms]")


def report(result: DescentResult) -> StudyReport:
    """The tables, and why frames were not solved."""
    notes = []
    for case, frames in result.frames.items():
        reasons = [f.solution.reason for f in frames if f.nees is None]
        notes += flights.not_solved(case, reasons)
    wanted = {case.name: case.wanted for case in CASES}
    rows = tuple(_cells(name, frames, wanted[name]) for name, frames in result.frames.items())
    measured = tuple(_measured(name, runs) for name, runs in result.measured.items())
    times = (
        ("a frame of 1310 x 1310 px, median", result.frame_ms, "500"),
        (f"of it an update of the filter with {TIMED_LANDMARKS} landmarks", result.filter_ms, "20"),
    )
    return StudyReport(
        (
            StudyTable("A descent by windows and landmarks", COLUMNS, rows),
            StudyTable("Landmarks from 6.5 to 2 km, without pictures", MEASURED, measured),
            StudyTable("Time of one processor", TIMES, times),
        ),
        tuple(notes),
    )


def _cells(name: str, frames: Sequence[FlownFrame], wanted: str) -> tuple[Cell, ...]:
    solved = [f for f in frames if f.error_m is not None]
    if not solved:
        return (name, 0, len(frames), None, None, None, None, None, wanted, None, None, None)
    errors = np.array([f.error_m for f in solved])
    level = np.linalg.norm(errors[:, :2], axis=1)
    ends = [float(away) for away, f in zip(level, solved, strict=True) if f.last]
    sizes: list[Cell] = [rms(errors[:, :2].ravel()), rms(errors[:, 2])]
    sizes += [float(level.max()), float(np.abs(errors[:, 2]).max()), rms(ends) if ends else None]
    counts: list[Cell] = [
        float(np.mean([f.nees for f in solved])),
        float(np.mean([f.solution.n_windows or 0 for f in solved])),
        float(np.mean([f.solution.n_landmarks or 0 for f in solved])),
    ]
    return (name, len(solved), len(frames), *sizes, wanted, *counts)


def _measured(
    formulation: Formulation, runs: Sequence[descent_measurements.Errors]
) -> tuple[Cell, ...]:
    ends = np.array([each.error_m[-1] for each in runs])
    cells: list[Cell] = [formulation.label, len(runs)]
    cells += [rms(ends[:, axis]) for axis in range(3)]
    cells += [float(np.mean([each.nees for each in runs]))]
    return (*cells, float(np.mean([each.nees[-1] for each in runs])))
