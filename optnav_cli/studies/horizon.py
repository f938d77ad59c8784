"""The horizon's figures: single pictures of the whole Moon, solved from their limb, and the truth.

Every row takes the pictures of a shipped scenario (ground of 32 pixels a degree with seeded relief
below) and solves each from its limb alone: as a sphere's, and over a relief of 16 cells a degree;
with the exact attitude, and with one that is off by 10 arc seconds an axis. Nothing else is told
but the Sun. Errors are those over the ground below the camera and in height; far away those of
direction and range.
"""

import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError, NothingToDoError
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress
from catalog.terrain.dem.file import path_of
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.relief.sums import load_relief
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.truth import read_truth
from optnav_cli.navigation import horizon
from optnav_cli.navigation.neighbour import View, other_body
from optnav_cli.navigation.outline import detect_limb, mask_neighbour
from optnav_cli.studies.horizon_table import CaseFigures, FrameResult, Row, figures_of
from optnav_cli.studies.pictures import GLOBE, SEED, STAR_SENSOR_ARCSEC, shipped_pictures

ROWS = (
    Row("nadir 50 km", "horizon_050km", 250.0, 280.0, 100.0),
    Row("nadir 100 km", "horizon_100km", 200.0, 230.0, 100.0),
    Row("nadir 200 km", "horizon_200km", 150.0, 200.0, 100.0),
    Row("nadir 800 km", "horizon_800km", 150.0, 200.0, 250.0),
    Row("30° off nadir 100 km", "off_nadir_100km", 500.0, 500.0, 300.0),
    Row("30° off nadir 200 km", "off_nadir_200km", 500.0, 500.0, 300.0),
    Row("thin crescent 50 km", "crescent_050km"),
    Row("thin crescent 80 km", "crescent_080km"),
    Row("far 10 000 km", "far_010000km", range_share=0.0002),
    Row("far 20 000 km", "far_020000km", range_share=0.0005),
    Row("far 50 000 km", "far_050000km", range_share=0.001),
    Row("far 100 000 km", "far_100000km", range_share=0.002),
)


@dataclass(frozen=True, eq=False)
class RowResult:
    """A row's figures: sphere and relief, each with exact attitude and with the star sensor's."""

    row: Row
    sphere: CaseFigures
    terrain: CaseFigures
    sphere_star: CaseFigures
    terrain_star: CaseFigures


def run(
    output: Path, progress: Progress, frames: int | None = None, rows: str = ""
) -> list[RowResult]:
    """Make the pictures, solve and compare; pictures that are there already are used again.

    output  folder for pictures and figures.json
    frames  pictures of a scenario, its own number when None
    rows    only rows whose name contains this
    Raises ConfigError where the shared data are not named.
    """
    globe = path_of(GLOBE, Path.cwd())
    chosen = [row for row in ROWS if rows in row.name]
    if not chosen:
        raise NothingToDoError(f"no row of the study is called '{rows}'")
    output.mkdir(parents=True, exist_ok=True)
    results = []
    for row in chosen:
        folder = read_folder(shipped_pictures(output, row.scenario, frames, progress))
        results.append(measure(row, folder, load_relief(str(globe), folder.body)))
        _write(output / "figures.json", results)
    return results


def measure(row: Row, folder: Folder, relief: GlobalRelief) -> RowResult:
    """Solve every picture of a folder in four ways and compare with its truth.csv."""
    found: dict[tuple[bool, bool], list[FrameResult]] = {
        (terrain, star): [] for terrain in (False, True) for star in (False, True)
    }
    for frame in _frames(row, folder, relief):
        found[frame.terrain, frame.star_sensor].append(frame)
    figures = {case: figures_of(frames) for case, frames in found.items()}
    return RowResult(
        row, figures[False, False], figures[True, False], figures[False, True], figures[True, True]
    )


def _frames(row: Row, folder: Folder, relief: GlobalRelief) -> Iterator[FrameResult]:
    rng = np.random.default_rng(SEED)
    sigma = STAR_SENSOR_ARCSEC * ARCSEC
    truths = {t.file: t for t in read_truth(folder.path / "truth.csv", folder.attitude)}
    for frame in folder.frames:
        slip = Rotation.from_rotvec(rng.normal(0.0, sigma, 3))
        attitude, sun = frame.camera_from_body, frame.sun_body
        if attitude is None or sun is None:
            continue
        camera = folder.cameras[frame.camera]
        picture = loaded = load_picture(folder.path / frame.file, camera)
        for star_sensor, turned in ((False, attitude), (True, slip * attitude)):
            try:
                if row.far and frame.tdb_s is not None:
                    view = View(camera, turned, sigma if star_sensor else 0.0, sun)
                    other = other_body(folder.motion, frame.tdb_s)
                    picture = mask_neighbour(loaded, view, folder.body, relief, other)
                begin = time.process_time()
                limb = detect_limb(picture, camera, turned, sun, folder.body)
            except NoSolutionError as error:
                for terrain in (False, True):
                    yield FrameResult(frame.file, terrain, star_sensor, reason=str(error))
                continue
            finding = time.process_time() - begin
            for terrain in (False, True):
                begin = time.process_time()
                try:
                    fix = horizon.navigate(
                        limb, camera, turned, sigma if star_sensor else 0.0, sun, folder.body,
                        relief if terrain else None,
                    )  # fmt: skip
                except NoSolutionError as error:
                    yield FrameResult(frame.file, terrain, star_sensor, reason=str(error))
                    continue
                seconds = finding + time.process_time() - begin
                truth = truths[frame.file].position_m
                yield _compared(frame.file, terrain, star_sensor, fix, truth, folder.body, seconds)


def _compared(
    file: str, terrain: bool, star_sensor: bool, fix: horizon.HorizonFix, truth: FloatArray,
    body: Body, seconds: float,
) -> FrameResult:  # fmt: skip
    """A fix against the true position (3,)."""
    error = fix.position_m - truth
    distance = float(np.linalg.norm(truth))
    up = truth / distance
    height = float(error @ up)
    below = fix.position_m / np.linalg.norm(fix.position_m)
    over = float(np.arctan2(np.linalg.norm(np.cross(below, up)), below @ up))
    return FrameResult(
        file, terrain, star_sensor,
        ssp_m=over * body.radius_m,
        height_m=height,
        range_share=height / distance,
        direction_arcsec=over / ARCSEC,
        nees=float(error @ np.linalg.solve(fix.covariance_m2, error)) / 3.0,
        arc_deg=fix.arc_deg,
        seconds=seconds,
    )  # fmt: skip


def _write(path: Path, results: list[RowResult]) -> None:
    content = [asdict(result) for result in results]
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
