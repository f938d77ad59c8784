"""The autonomous loop's figures: flights without any prior, over Tycho and all over the Moon.

Over Tycho both cameras of the ship fly the shipped scenarios with nothing stated but time, Sun and
an attitude that is off by 10 arc seconds an axis; the ground beyond Tycho's 118 m model is the
948 m model of the whole Moon. The navigator has Tycho's 118 m catalog on top of a 948 m one of the
surroundings. All over the Moon single fisheye pictures from 50 to 800 km count how many frames are
solved, by which arc of lit limb they truly show. None may be wrong by more than 5 of its own
sigmas.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from catalog.arrays import FloatArray
from catalog.config import resource
from catalog.errors import NothingToDoError
from catalog.pipeline import build
from catalog.places import make_folder
from catalog.progress import Progress
from catalog.terrain.dem.file import resolve_path
from optnav_cli.camera.camera import Camera
from optnav_cli.evaluation.figures import FrameError, compute_figures
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.truth import Truth, read_truth
from tests.studies import flights
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, tally

WIDE, NARROW = "shnk", "unk"
# What the loop must see of the ground about Tycho from 400 km: 20 deg of arc about the flights.
SURROUNDINGS_DEG = (-50.0, -66.0, 28.0, -20.0)
SURROUNDINGS = f'[body]\nname = "moon"\n\n[[dem]]\npath = "{flights.GLOBE}"\n'
AZIMUTHS = 720
ENOUGH_ARC_DEG = 140.0
MIN_SOLVED = 0.95
MAX_SIGMAS = 5.0


@dataclass(frozen=True)
class LoopCase(flights.Case):
    """One line of the table: a scenario, whose camera counts, and the figures to reach, m.

    star_sensor  whether horizontal_m is for exact attitudes, so that the star sensor's part is
                 added in quadrature
    """

    scenario: str
    camera: str
    horizontal_m: float
    height_m: float
    star_sensor: bool = False


@dataclass(frozen=True, eq=False)
class LoopResult:
    """The frames of a row's camera."""

    row: LoopCase
    frames: tuple[FrameError, ...]

    @property
    def limit_m(self) -> float:
        """What the horizontal error may be; the star sensor adds its part in quadrature."""
        limit = self.row.horizontal_m
        return flights.limit_with_star_sensor(limit, self.frames) if self.row.star_sensor else limit


class ShareResult(NamedTuple):
    """The frames of a scenario and the arc of lit limb that each truly shows, deg."""

    scenario: str
    frames: tuple[FrameError, ...]
    arcs_deg: tuple[float, ...]


class LoopResults(NamedTuple):
    """Both tables."""

    rows: list[LoopResult]
    shares: list[ShareResult]


ROWS = (
    LoopCase("wide camera, 100 km", "tycho_100km", WIDE, 30.0, 30.0),
    LoopCase("wide camera, 200 km", "tycho_200km", WIDE, 30.0, 30.0),
    LoopCase("wide camera, 400 km", "tycho_400km", WIDE, 40.0, 30.0),
    LoopCase("narrow camera, 200 km", "tycho_200km", NARROW, 30.0, 150.0, star_sensor=True),
    LoopCase("narrow camera, 400 km", "tycho_400km", NARROW, 20.0, 50.0, star_sensor=True),
)
SHARES = ("horizon_050km", "horizon_100km", "horizon_200km", "horizon_800km")


def run(output: Path, progress: Progress, frames: int | None = None, rows: str = "") -> LoopResults:
    """Fly, navigate and evaluate; pictures that are there already are used again.

    output  folder for catalogs, pictures, runs and figures.json
    frames  pictures of a scenario, its own number when None
    rows    only rows and scenarios whose name contains this
    Raises ConfigError where the shared data are not named.
    """
    relief = resolve_path(flights.GLOBE, Path.cwd())
    make_folder(output)
    tycho = output / "tycho.gpkg"
    build.run(resource("configs/catalogs/tycho.toml"), output=tycho, progress=progress)
    around = output / "surroundings.toml"
    catalogs = [tycho, flights.built_catalog(around, SURROUNDINGS, progress, SURROUNDINGS_DEG)]

    def fly(name: str) -> ShareResult:
        pictures = flights.shipped_pictures(output, name, frames, progress)
        # scenarios that are flown without a prior state a star sensor's attitudes themselves
        if any(frame.position_m is not None for frame in read_folder(pictures).frames):
            pictures = flights.with_star_sensor(pictures, priors=False)
        errors = flights.navigated(pictures, catalogs, output / "runs" / name, progress, relief)
        return ShareResult(name, errors, _lit_arcs_deg(pictures))

    results = LoopResults([], [])
    flown: dict[str, ShareResult] = {}
    for row in (r for r in ROWS if rows in r.name):
        if row.scenario not in flown:
            flown[row.scenario] = fly(row.scenario)
        every = flown[row.scenario].frames
        own = tuple(frame for frame in every if frame.camera == row.camera)
        results.rows.append(LoopResult(row, own))
        write_figures(output / flights.FIGURES, results)
    for name in (s for s in SHARES if rows in s):
        results.shares.append(fly(name))
        write_figures(output / flights.FIGURES, results)
    if not any(results):
        raise NothingToDoError(f"no row of the study is called '{rows}'")
    return results


def lit_arc_deg(camera: Camera, truth: Truth, sun_body: FloatArray, radius_m: float) -> float:
    """Azimuth about the nadir of the lit limb that truly lies inside a picture, deg; a sphere's."""
    distance = float(np.linalg.norm(truth.position_m))
    up = truth.position_m / distance
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    azimuth = np.arange(AZIMUTHS) * 2.0 * np.pi / AZIMUTHS
    around = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * np.cross(up, side)
    # the limb is where the line of sight touches: its normal stands at acos(R / r) from the nadir
    cosine = radius_m / distance
    normal = cosine * up + np.sqrt(1.0 - cosine**2) * around
    pixels = camera.project_from_body(
        normal * radius_m, truth.position_m, truth.camera_from_body.as_matrix()
    )
    height, width = camera.shape
    with np.errstate(invalid="ignore"):
        inside = (pixels > -0.5).all(axis=1)
        inside &= (pixels[:, 0] < width - 0.5) & (pixels[:, 1] < height - 0.5)
    return float((inside & (normal @ sun_body > 0.0)).mean()) * 360.0


def _lit_arcs_deg(pictures: Path) -> tuple[float, ...]:
    """Azimuths of lit limb that the pictures of a folder truly show."""
    folder = read_folder(pictures)
    truths = {t.file: t for t in read_truth(pictures / "truth.csv", folder.attitude)}
    return tuple(
        0.0
        if frame.sun_body is None
        else lit_arc_deg(
            folder.cameras[frame.camera], truths[frame.file], frame.sun_body, folder.body.radius_m
        )
        for frame in folder.frames
    )


ROW_COLUMNS = columns(
    "case; solved; frames; horizontal, rms [m] .1f; horizontal_limit_m = asked ≤ [m] .0f; "
    "height, rms [m] .1f; height_limit_m = asked ≤ [m] .0f; NEES .2f; worst [σ] .1f"
)
SHARE_COLUMNS = columns(
    f"scenario = arc of lit limb; enough_solved = ≥ {ENOUGH_ARC_DEG:.0f}°, solved; "
    "enough_frames = of; less, solved; less_frames = of; worst [σ] .1f; methods"
)


def report(results: LoopResults) -> StudyReport:
    """Both tables, and how many frames are wrong by more than MAX_SIGMAS."""
    tables, notes = [], []
    if results.rows:
        tables.append(StudyTable("", ROW_COLUMNS, tuple(_row_cells(row) for row in results.rows)))
    if results.shares:
        shares = [_share_cells(share.scenario, [share]) for share in results.shares]
        if len(shares) > 1:
            shares.append(_share_cells("together", results.shares))
            notes.append(f"wanted: {100 * MIN_SOLVED:.0f} % of those with an arc of 140°")
        tables.append(StudyTable("", SHARE_COLUMNS, tuple(shares)))
    every = [frame for row in results.rows for frame in row.frames]
    every += [frame for share in results.shares for frame in share.frames]
    wrong = sum(flights.sigmas_off(frame) > MAX_SIGMAS for frame in every)
    notes.append(
        f"wrong by more than {MAX_SIGMAS:.0f} of their own sigmas: {wrong} of {len(every)}"
    )
    return StudyReport(tuple(tables), tuple(notes))


def _row_cells(result: LoopResult) -> tuple[Cell, ...]:
    solved = [frame for frame in result.frames if frame.nees is not None]
    start = (result.row.name, len(solved), len(result.frames))
    limits = (result.limit_m, result.row.height_m)
    if not solved:
        return (*start, None, limits[0], None, limits[1], None, None)
    f = compute_figures(result.frames)
    errors = (f.horizontal_rms_m, limits[0], f.height_rms_m, limits[1])
    return (*start, *errors, f.nees, max(flights.sigmas_off(frame) for frame in solved))


def _share_cells(name: str, shares: Sequence[ShareResult]) -> tuple[Cell, ...]:
    pairs = [pair for s in shares for pair in zip(s.frames, s.arcs_deg, strict=True)]
    counts: list[int] = []
    for wide in (True, False):
        group = [frame for frame, arc in pairs if (arc >= ENOUGH_ARC_DEG) is wide]
        counts += [sum(frame.nees is not None for frame in group), len(group)]
    worst = max((flights.sigmas_off(frame) for frame, _ in pairs), default=0.0)
    methods = [frame.solution.method for frame, _ in pairs if frame.nees is not None]
    return (name, *counts, worst, tally(methods))


def write_figures(path: Path, results: LoopResults) -> None:
    """The tables, and every frame of them with its arc of lit limb."""
    single = flights.frames_table(
        {r.row.name: r.frames for r in results.rows}
        | {share.scenario: share.frames for share in results.shares}
    )
    pairs = ((s, *pair) for s in results.shares for pair in zip(s.frames, s.arcs_deg, strict=True))
    rows = tuple((share.scenario, frame.file, arc) for share, frame, arc in pairs)
    arcs = StudyTable("arcs", columns("scenario; file; arc_deg = lit limb [°] .1f"), rows)
    StudyReport((*report(results).tables, single, arcs)).write(path)
