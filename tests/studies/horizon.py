"""The horizon's figures: single pictures of the whole Moon, solved from their limb, and the truth.

Every row takes the pictures of a shipped scenario (ground of 32 pixels a degree with seeded relief
below) and solves each from its limb alone: as a sphere's, and over a relief of 16 cells a degree;
with the exact attitude, and with one that is off by 10 arc seconds an axis. Nothing else is stated
but the Sun. In real rows the pictures show ground that differs from that model as the Moon does, at
all scales and in albedo, and the relief's error is stated as GLD100's. Errors are those over the
ground below the camera and in height; far away those of direction and range.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from catalog.places import make_folder
from catalog.progress import Progress
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.relief.sums import load_relief
from optnav_cli.fix import Fix
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import read_truth
from optnav_cli.outline.limb import method as horizon
from optnav_cli.outline.method import solve_outline
from optnav_cli.outline.neighbour import CameraView, find_other_body
from optnav_cli.outline.one_body import detect_limb
from tests.studies import flights, horizon_flights
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms

DIRECTION_ARCSEC, DIRECTION_STAR_ARCSEC = 5.0, 20.0  # what far rows ask for
MAX_SSP_M = 600.0
BETTER = 10.0  # times, of relief against sphere over the ground
NEES = (0.7, 1.4)


@dataclass(frozen=True)
class HorizonCase(flights.Case):
    """One line of the table, a scenario, and what is asked of the terrain-aware horizon.

    ssp_m, ssp_star_m  rms over the ground with exact attitude and with the star sensor's
    height_m           rms of the height
    range_share        rms of the range as a share of it, of a far row
    Nothing is asked of a crescent but that no solution is wrong by 5 of its own sigmas.
    """

    scenario: str
    ssp_m: float | None = None
    ssp_star_m: float | None = None
    height_m: float | None = None
    range_share: float | None = None

    @property
    def far(self) -> bool:
        """Whether the Earth may stand beside the Moon."""
        return self.range_share is not None

    @property
    def ground(self) -> str:
        """Over which ground it flies; each has a table."""
        return flights.ground_of(self.scenario)


@dataclass(frozen=True)
class LimbFix:
    """A picture solved in one way; without a solution only the reason counts.

    ssp_m, direction_arcsec  angle at the body's centre between the true and the found position, as
                             metres of ground and as an angle: the direction of the centre is off
                             by as much
    nees                     normalised error squared over its expectation
    seconds                  of the processor, edges included
    """

    terrain: bool
    star_sensor: bool
    ssp_m: float = np.nan
    height_m: float = np.nan
    range_share: float = np.nan
    direction_arcsec: float = np.nan
    nees: float = np.nan
    seconds: float = np.nan
    reason: str = ""


@dataclass(frozen=True)
class CaseFigures:
    """Figures over the pictures of a row solved in one way; NaN where none is solved."""

    frames: int
    solved: int
    ssp_rms_m: float
    ssp_max_m: float
    height_rms_m: float
    range_rms_share: float
    direction_rms_arcsec: float
    nees: float
    worst_sigmas: float
    median_seconds: float
    reasons: tuple[str, ...]


ROWS = (
    HorizonCase("real nadir 50 km", "real_horizon_050km", 250.0, 280.0, 100.0),
    HorizonCase("real nadir 100 km", "real_horizon_100km", 200.0, 230.0, 100.0),
    HorizonCase("real nadir 200 km", "real_horizon_200km", 150.0, 200.0, 100.0),
    HorizonCase("real flights 50-800 km, Sun 4-60°", horizon_flights.NAME),
    HorizonCase("nadir 50 km", "horizon_050km", 250.0, 280.0, 100.0),
    HorizonCase("nadir 100 km", "horizon_100km", 200.0, 230.0, 100.0),
    HorizonCase("nadir 200 km", "horizon_200km", 150.0, 200.0, 100.0),
    HorizonCase("nadir 800 km", "horizon_800km", 150.0, 200.0, 250.0),
    HorizonCase("30° off nadir 100 km", "off_nadir_100km", 500.0, 500.0, 300.0),
    HorizonCase("30° off nadir 200 km", "off_nadir_200km", 500.0, 500.0, 300.0),
    HorizonCase("thin crescent 50 km", "crescent_050km"),
    HorizonCase("thin crescent 80 km", "crescent_080km"),
    HorizonCase("far 10 000 km", "far_010000km", range_share=0.0002),
    HorizonCase("far 20 000 km", "far_020000km", range_share=0.0005),
    HorizonCase("far 50 000 km", "far_050000km", range_share=0.001),
    HorizonCase("far 100 000 km", "far_100000km", range_share=0.002),
)


@dataclass(frozen=True, eq=False)
class HorizonResult:
    """A row's figures: sphere and relief, each with exact attitude and with the star sensor's."""

    row: HorizonCase
    sphere: CaseFigures
    terrain: CaseFigures
    sphere_star: CaseFigures
    terrain_star: CaseFigures


def run(
    output: Path, progress: Progress, frames: int | None = None, rows: str = ""
) -> list[HorizonResult]:
    """Make the pictures, solve and compare; pictures that are there already are used again.

    output  folder for pictures and figures.json
    frames  pictures of a scenario, its own number when None
    rows    only rows whose name contains this
    Raises ConfigError where the shared data are not named.
    """
    globe = resolve_path(flights.GLOBE, Path.cwd())
    chosen = flights.rows_named(ROWS, rows)
    make_folder(output)
    results: list[HorizonResult] = []
    for row in chosen:
        if row.scenario == horizon_flights.NAME:
            made = horizon_flights.pictures(output, horizon_flights.SCORED_SEED, frames, progress)
        else:
            made = [flights.shipped_pictures(output, row.scenario, frames, progress)]
        folders = [read_folder(each) for each in made]
        relief = load_relief(str(globe), folders[0].body, flights.stated_error_of(row.scenario))
        results.append(measure(row, folders, relief))
        StudyReport((*report(results).tables, _ways(results))).write(output / flights.FIGURES)
    return results


def measure(row: HorizonCase, folders: Sequence[Folder], relief: GlobalRelief) -> HorizonResult:
    """Solve every picture of the folders in four ways and compare with their truth.csv."""
    every = [fix for folder in folders for fix in _frames(row, folder, relief)]
    ways = ((False, False), (True, False), (False, True), (True, True))
    own = ([f for f in every if (f.terrain, f.star_sensor) == way] for way in ways)
    return HorizonResult(row, *map(figures_of, own))


def _frames(row: HorizonCase, folder: Folder, relief: GlobalRelief) -> Iterator[LimbFix]:
    rng = np.random.default_rng(flights.SEED)
    sigma = flights.STAR_SENSOR_ARCSEC * ARCSEC
    truths = {t.file: t for t in read_truth(folder.path / "truth.csv", folder.attitude)}
    for frame in folder.frames:
        slip = Rotation.from_rotvec(rng.normal(0.0, sigma, 3))
        attitude, sun = frame.camera_from_body, frame.sun_body
        if attitude is None or sun is None:
            continue
        camera = folder.cameras[frame.camera]
        picture = loaded = load_picture(folder.picture_path(frame), camera)
        for star_sensor, turned in ((False, attitude), (True, slip * attitude)):
            off = sigma if star_sensor else 0.0
            try:
                if row.far and frame.tdb_s is not None:
                    view = CameraView(camera, turned, off, sun)
                    other = find_other_body(folder.motion, frame.tdb_s)
                    _, picture = solve_outline(loaded, view, folder.body, relief, other)
                begin = time.process_time()
                limb = detect_limb(picture, camera, turned, sun, folder.body)
            except NoSolutionError as error:
                for terrain in (False, True):
                    yield LimbFix(terrain, star_sensor, reason=str(error))
                continue
            finding = time.process_time() - begin
            for terrain, over in ((False, None), (True, relief)):
                begin = time.process_time()
                try:
                    fix = horizon.navigate(limb, camera, turned, off, sun, folder.body, over)
                except NoSolutionError as error:
                    yield LimbFix(terrain, star_sensor, reason=str(error))
                    continue
                seconds = finding + time.process_time() - begin
                truth = truths[frame.file].position_m
                yield _compared(terrain, star_sensor, fix, truth, folder.body, seconds)


def _compared(
    terrain: bool, star_sensor: bool, fix: Fix, truth: FloatArray, body: Body, seconds: float
) -> LimbFix:
    """A fix against the true position (3,)."""
    error = fix.position_m - truth
    distance = float(np.linalg.norm(truth))
    up = truth / distance
    height = float(error @ up)
    below = fix.position_m / np.linalg.norm(fix.position_m)
    over = float(np.arctan2(np.linalg.norm(np.cross(below, up)), below @ up))
    return LimbFix(
        terrain,
        star_sensor,
        ssp_m=over * body.radius_m,
        height_m=height,
        range_share=height / distance,
        direction_arcsec=over / ARCSEC,
        nees=float(error @ np.linalg.solve(fix.covariance_m2, error)) / 3.0,
        seconds=seconds,
    )


def figures_of(frames: Sequence[LimbFix]) -> CaseFigures:
    """Figures over frames that were solved in the same way."""
    good = [frame for frame in frames if not frame.reason]

    def values(name: str) -> list[float]:
        return [getattr(frame, name) for frame in good]

    nees = np.array([frame.nees for frame in good])
    return CaseFigures(
        frames=len(frames),
        solved=len(good),
        ssp_rms_m=rms(values("ssp_m")),
        ssp_max_m=max((frame.ssp_m for frame in good), default=float("nan")),
        height_rms_m=rms(values("height_m")),
        range_rms_share=rms(values("range_share")),
        direction_rms_arcsec=rms(values("direction_arcsec")),
        nees=float(nees.mean()) if good else float("nan"),
        worst_sigmas=float(np.sqrt(3.0 * nees.max())) if good else float("nan"),
        median_seconds=float(np.median([f.seconds for f in good])) if good else float("nan"),
        reasons=tuple(frame.reason for frame in frames if frame.reason),
    )


NEAR_COLUMNS = columns(
    "case; solved; frames; sphere, SSP [m] .0f; sphere_height_m = height [m] .0f; "
    "terrain, SSP [m] .0f; ssp_limit_m = asked ≤ [m] .0f; ssp_max_m = max [m] .0f; "
    "terrain_height_m = height [m] .0f; height_limit_m = asked ≤ [m] .0f; "
    "star_ssp_m = SSP, 10″ [m] .0f; star_ssp_limit_m = asked ≤ [m] .0f; "
    "better = better [times] .0f"
)
FAR_COLUMNS = columns(
    "case; solved; frames; sphere, range [%] .4f; "
    "terrain, range [%] .4f; range_limit = asked ≤ [%] .2f; "
    "direction [″] .1f; direction_limit = asked ≤ [″] .0f; "
    "star_direction = direction, 10″ [″] .1f; star_direction_limit = asked ≤ [″] .0f"
)
COMMON_COLUMNS = columns("NEES .2f; star_nees = NEES, 10″ .2f; worst [σ] .1f; CPU [ms] .0f")


def report(results: Sequence[HorizonResult]) -> StudyReport:
    """Near rows, far rows (rms), and why frames were not solved."""
    tables = []
    for far, heads in ((False, NEAR_COLUMNS), (True, FAR_COLUMNS)):
        for ground in flights.GROUNDS:
            chosen = [r for r in results if r.row.far is far and r.row.ground == ground]
            if chosen:
                rows = tuple(map(_cells, chosen))
                tables.append(StudyTable(ground, (*heads, *COMMON_COLUMNS), rows))
    notes = []
    for result in results:
        notes += flights.not_solved(result.row.name, result.terrain.reasons)
    notes.append(
        f"wanted besides: max {MAX_SSP_M:.0f} m, {BETTER:.0f} times better than the sphere, "
        f"NEES {NEES[0]}-{NEES[1]}, worst below 5 σ"
    )
    return StudyReport(tuple(tables), tuple(notes))


def _cells(result: HorizonResult) -> tuple[Cell, ...]:
    row, sphere, terrain, star = result.row, result.sphere, result.terrain, result.terrain_star
    own: tuple[Cell, ...]
    if row.range_share is None:
        ground = (terrain.ssp_rms_m, row.ssp_m, terrain.ssp_max_m)
        height = (terrain.height_rms_m, row.height_m)
        with_star = (star.ssp_rms_m, row.ssp_star_m, sphere.ssp_rms_m / terrain.ssp_rms_m)
        own = (sphere.ssp_rms_m, sphere.height_rms_m, *ground, *height, *with_star)
    else:
        shares = (sphere.range_rms_share, terrain.range_rms_share, row.range_share)
        direction = (terrain.direction_rms_arcsec, DIRECTION_ARCSEC)
        off = (star.direction_rms_arcsec, DIRECTION_STAR_ARCSEC)
        own = (*(100.0 * share for share in shares), *direction, *off)
    worst = max(terrain.worst_sigmas, star.worst_sigmas)
    common = (terrain.nees, star.nees, worst, terrain.median_seconds * 1e3)
    return (row.name, terrain.solved, terrain.frames, *own, *common)


def _ways(results: Sequence[HorizonResult]) -> StudyTable:
    """All figures of every row solved in each of the four ways."""
    names = [field.name for field in fields(CaseFigures) if field.name != "reasons"]
    heads = columns("; ".join(["case", "way", *names]))
    rows = tuple(
        (result.row.name, way, *(getattr(getattr(result, way), name) for name in names))
        for result in results
        for way in ("sphere", "terrain", "sphere_star", "terrain_star")
    )
    return StudyTable("ways", heads, rows)
