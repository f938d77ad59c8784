"""Flights of the study of descents: pictures over several grounds, their catalogs and tracks.

What a picture shows does not depend on the inertial track, so each ground is flown with several
tracks of drawn errors. The catalog's model is that of the truth without what lies below its
posting, or one that is wrong besides; of the ways over a 12 m model, each ground's own.
"""

import time
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.config import resource
from catalog.errors import DataError
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from catalog.progress import Progress
from catalog.rasters import TERRAIN, handle_read_errors, open_raster
from catalog.terrain.dem.source import DemSettings
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import camera_toml, preset_camera
from optnav_cli.fix import NoFix, Solution
from optnav_cli.frames.picture import load_frame_picture
from optnav_cli.frames.run_settings import InertialSettings
from optnav_cli.frames.truth import Truth, read_truth
from optnav_cli.navigate.worker import FrameWorker, RunInputs
from optnav_cli.reasons import Reason, ReasonCode
from optnav_cli.simulation import descent
from optnav_cli.simulation.descent import Descent, track_errors
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.sections import AltimeterSection, MainCamera, TruthSettings
from tests.studies import flights

CATALOG, MODEL = "tycho_descent", "tycho_gld100_256ppd.tif"
SPACING_S, SUNS_DEG = 10.0, ((10.0, 20.0), (12.0, 12.0), (18.0, 18.0), (10.0, 10.0), (20.0, 20.0))
LOW_M = 6500.0  # where the published descent on a 118 m model ends
# The descent whose landmarks are flown alone: lower and slower, so that pictures overlap.
LOW_FROM_KM, LOW_S, LOW_SPEED_M_S, LOW_SPACING_S, LOW_TILT_DEG = 10.0, 80.0, 700.0, 4.0, 10.0
# How the ground of Way.MOON differs, and what its catalog states of that.
MOON_TRUTH = TruthSettings(
    model_error="gld100", albedo="fractal", phase_law="other", camera="drawn"
)
STATED = "gld100"
RANGE_SIGMA_M = 1.0  # of its altimeter
# Pixels of its camera along each of the wide one's: the model's error is the limit, not the pixel,
# and pictures are drawn four times as fast.
BINNED = 2
WRONG_M = 3.0  # rms error of the wrong model
# Cells of a catalog of the 12 m model, deg, and its patches, which overlap so.
FINE_CELL_DEG, FINE_PYRAMID = 0.03, "\n[pyramid]\nsize = 128\nlevels = 4\n"


# The Luna-25 region at 70 S by its 474 m model: end of the path, deg east and north, and its Suns.
SOUTH_MODEL, SOUTH_END_DEG = "shared:moon/boguslawsky_gld100_64ppd.tif", (36.0, -71.0)
SOUTH_SUNS_DEG = ((5.0, 20.0), (8.0, 8.0), (12.0, 12.0), (16.0, 16.0), (20.0, 20.0))
SOUTH_CELL_DEG = 0.8


class Way(StrEnum):
    """Which way is flown; the names of picture folders begin with it."""

    LONG = "descent"
    LOW = "low"
    FINE = "fine"  # over a 12 m model
    MOON = "moon"  # over ground that differs from its 118 m model as the Moon does from GLD100
    SOUTH = "south"  # the same of a 474 m model

    @property
    def differs(self) -> bool:
        """Whether the ground differs as the Moon does, with fewer pixels and an altimeter."""
        return self in (Way.MOON, Way.SOUTH)


@dataclass(frozen=True, eq=False)
class FlownFrame:
    """A frame of a flight: height over the ground below, error east, north, up, NEES a degree."""

    height_m: float
    error_m: FloatArray | None
    nees: float | None
    solution: Solution
    last: bool


def scenario_of(ground: int, way: Way = Way.LONG) -> Descent:
    """A shipped descent over another ground under another Sun; LOW: from 10 km."""
    name = "descent_12m" if way is Way.FINE else "descent_118m"
    scenario = load_scenario(resource(f"configs/scenarios/{name}.toml"))
    if not isinstance(scenario, Descent):
        raise TypeError(f"{name} is no descent")
    descent = msgspec.structs.replace(scenario.descent, spacing_s=SPACING_S)
    seed, relief = scenario.seed + ground, scenario.detail.seeds[0] + ground
    sun = SUNS_DEG[ground % len(SUNS_DEG)]
    if way is Way.LOW:
        seed, relief, sun = seed + 10, relief + 2, scenario.sun.elevation_deg
        descent = msgspec.structs.replace(
            descent,
            from_km=LOW_FROM_KM,
            duration_s=LOW_S,
            speed_m_s=(LOW_SPEED_M_S, descent.speed_m_s[1]),
            tilt_deg=(LOW_TILT_DEG, 0.0),
            spacing_s=LOW_SPACING_S,
        )
    if way is Way.SOUTH:
        sun = SOUTH_SUNS_DEG[ground % len(SOUTH_SUNS_DEG)]
        descent = msgspec.structs.replace(descent, end_deg=SOUTH_END_DEG)
        scenario = msgspec.structs.replace(scenario, dem=(DemSettings(path=SOUTH_MODEL),))
    if way.differs:
        altimeter = AltimeterSection(sigma_m=RANGE_SIGMA_M)
        scenario = msgspec.structs.replace(scenario, truth=MOON_TRUTH, altimeter=altimeter)
    return msgspec.structs.replace(
        scenario,
        seed=seed,
        descent=descent,
        sun=msgspec.structs.replace(scenario.sun, elevation_deg=sun),
        detail=msgspec.structs.replace(scenario.detail, seeds=(relief,)),
    )


def pictures_of(output: Path, ground: int, way: Way, progress: Progress) -> Path:
    """The pictures of a way over a ground, in a study's folder; made unless they are there."""
    place, scenario = output / "pictures" / f"{way}-{ground}", scenario_of(ground, way)
    if way.differs:
        camera = flights.text_file(output / "binned.toml", camera_toml(binned_camera()))
        scenario = msgspec.structs.replace(scenario, camera=MainCamera(str(camera)))
    return flights.made_pictures(scenario, place, progress)


def binned_camera() -> Camera:
    """The descent's camera with each BINNED x BINNED pixels as one."""
    camera = preset_camera("tsnn2_wide")
    x, y = camera.principal_point_px
    return replace(
        camera,
        name="binned",
        width_px=camera.width_px // BINNED,
        height_px=camera.height_px // BINNED,
        focal_length_px=camera.focal_length_px / BINNED,
        principal_point_px=((x + 0.5) / BINNED - 0.5, (y + 0.5) / BINNED - 0.5),
    )


def catalog_of(
    output: Path, pictures: Path, way: Way, progress: Progress, *, wrong: int = 0
) -> Path:
    """The catalog that pictures of a way are flown by; built unless it is there.

    Of ground that differs it states the model's error, as STATED.
    wrong  seed of the errors of a wrong model; 0: the model of the truth
    """
    text = resource(f"configs/catalogs/{CATALOG}.toml").read_text(encoding="utf-8")
    line, name = f'path = "bundled:{MODEL}"\n', "tycho"
    if way is Way.FINE:
        name = pictures.name
        model = (pictures / descent.MODEL).relative_to(output).as_posix()
        text = text.replace(line, f'path = "{model}"\n')
        text = text.replace("cell_deg = 0.2\n", f"cell_deg = {FINE_CELL_DEG}\n") + FINE_PYRAMID
    elif wrong:
        name = f"wrong-{wrong}"
        model = write_wrong_model(output / f"{name}.tif", wrong).name
        text = text.replace(line, f'path = "{model}"\n')
    elif way is Way.SOUTH:
        name = "south"
        text = text.replace(line, f'path = "{SOUTH_MODEL}"\nproduct = "{STATED}"\n')
        text = text.replace("cell_deg = 0.2\n", f"cell_deg = {SOUTH_CELL_DEG}\n")
    elif way is Way.MOON:
        name, text = "stated", text.replace(line, f'{line}product = "{STATED}"\n')
    return flights.built_catalog(output / f"{name}.toml", text, progress)


def write_wrong_model(path: Path, seed: int) -> Path:
    """The bundled model with errors of WRONG_M rms that are one to two postings wide."""
    source = resource(f"data/{MODEL}")
    with open_raster(source, TERRAIN) as dataset, handle_read_errors(source):
        heights = dataset.read(1).astype(np.float32)
        crs, transform = dataset.crs, dataset.transform
    heights += descent.model_error(heights.shape, WRONG_M, np.random.default_rng(seed))
    return flights.written_model(path, heights, crs, transform)


def fly(
    pictures: Path,
    catalog: Path,
    seed: int,
    seconds: list[float],
    acceleration_m_s2: float = 0.0,
    windows_above_m: float = 0.0,
    *,
    ranges: bool = False,
) -> list[FlownFrame]:
    """Fly pictures with a track of drawn errors; seconds gets those of the processor, a frame.

    ranges  whether the altimeter's are used
    """
    worker = FrameWorker(RunInputs(pictures, [catalog]))
    try:
        folder = worker.folder
        truths = read_truth(pictures / "truth.csv", folder.attitude)
        track = InertialSettings(acceleration_sigma_m_s2=acceleration_m_s2)
        times = tuple(truth.tdb_s - truths[0].tdb_s for truth in truths)
        places, turns = track_errors(track, times, seed)
        navigator = worker.make_descent(track, windows_above_m)
        if navigator is None:
            raise TypeError(f"{pictures} is no descent")
        found = []
        for k, (frame, truth) in enumerate(zip(folder.frames, truths, strict=True)):
            stated = replace(
                frame,
                position_m=truth.position_m - places[k],
                camera_from_body=Rotation.from_rotvec(turns[k]).inv() * truth.camera_from_body,
                range_m=frame.range_m if ranges else None,
            )
            camera = folder.cameras[frame.camera]
            try:
                picture = load_frame_picture(pictures, frame.file, camera)
            except DataError as error:  # all of it in shadow, as under the Sun of ground 33
                reason = Reason(ReasonCode.BAD_PICTURE, str(error))
                solution = Solution(frame.file, frame.utc, NoFix(reason))
            else:
                started = time.process_time()
                solution = navigator.solve(stated, camera, picture)
                seconds.append(time.process_time() - started)
            ground = folder.body.radius_m + (navigator.ground_m(truth.position_m) or 0.0)
            found.append(_flown(solution, truth, ground, last=k == len(truths) - 1))
        return found
    finally:
        worker.close()


def _flown(solution: Solution, truth: Truth, ground_m: float, *, last: bool) -> FlownFrame:
    lat, lon, distance = (float(v) for v in latlon_from_xyz(truth.position_m))
    height = distance - ground_m
    fix = solution.fix
    if fix is None:
        return FlownFrame(height, None, None, solution, last)
    off = fix.position_m - truth.position_m
    nees = float(off @ np.linalg.solve(fix.covariance_m2, off)) / 3.0
    return FlownFrame(height, off @ body_from_local(lat, lon), nees, solution, last)
