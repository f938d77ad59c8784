"""Points where relief does not tell: simulated routes of the KMSS over a coast with fields.

A mosaic of one season is the catalog; pictures show another season, tone and haze, under clouds.
The camera flies 832 km above WGS 84. The grounds, seasons and clouds that the numbers of
configs/models/control_points.toml were set from (`--fit`) are others than those that are scored.
"""

import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyproj
import rasterio
from scipy.spatial.transform import Rotation

from catalog.arrays import ByteArray, Float32Array, FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.epochs import compute_tdb_s_after, utc_from_tdb_s
from catalog.errors import NoSolutionError, NothingToDoError
from catalog.geometry.rotations import ARCSEC
from catalog.pipeline import build
from catalog.progress import Progress, SilentProgress
from optnav_cli.calibration.job import calibrate_folder
from optnav_cli.calibration.model import CalibrateSettings
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.estimation.models.common import Common
from optnav_cli.estimation.models.points import correct_refraction
from optnav_cli.evaluation.figures import FrameError
from optnav_cli.evaluation.files import evaluate_run
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.run_settings import FileAttitude, RunSettings
from optnav_cli.frames.truth import Truth, write_truth
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from tests.studies.coast_ground import CoastGround, add_clouds
from tests.studies.tables import StudyReport, StudyTable, columns

CRS = "EPSG:32637"  # UTM 37N on WGS 84
MIDDLE_M = (500e3, 5_540e3)  # 39 E, 50 N
POSTING_M, FINER = 250.0, 2  # of the mosaic; nodes of the ground to one of it
HEIGHT_M, SPEED_M_S = 832e3, 6.6e3  # over the ellipsoid; of the point below
SPACING_S = 15.0  # of frames: 100 km
START_UTC = "2024-06-10T09:00:00Z"
ATTITUDE_ARCSEC, PRIOR_M = 3.0, 2000.0
MOUNTING_ARCSEC = (40.0, -55.0, 70.0)
NOISE = 0.006  # of full brightness, per pixel
STEP_PX = 16  # of the lattice on which ground under pixels is worked out
CLOUDS = (0.3, 1.0)  # covers of the routes: 33 % of points are found in the source
ROUTES, FRAMES = 28, 4
HALF_M = (270e3, 330e3)  # of a ground, east and north
FITTED, SCORED = (901, 902), (911, 912)  # seeds of grounds
EARTH = load_body("earth")
SOURCE = {"points": 0.33, "frames": 0.45, "n": 36.0, "b": 61.0, "r": 297.0}


@dataclass(frozen=True, eq=False)
class Region:
    """Ground drawn by a seed, with its catalog; `half_m` east and north of its middle."""

    ground: CoastGround
    half_m: tuple[float, float]
    catalog: Path

    @property
    def corner_m(self) -> tuple[float, float]:
        """West and north border, CRS."""
        return MIDDLE_M[0] - self.half_m[0], MIDDLE_M[1] + self.half_m[1]


def make_region(
    seed: int,
    folder: Path,
    half_m: tuple[float, float],
    progress: Progress,
    cell_deg: float = 1.0,
    extra: str = "",
) -> Region:
    """Draw a region, write its mosaic and build its catalog; what is there is used again."""
    folder.mkdir(parents=True, exist_ok=True)
    shape = tuple(int(2.0 * side / POSTING_M) * FINER for side in (half_m[1], half_m[0]))
    ground = CoastGround.draw(seed, (shape[0], shape[1]), POSTING_M / FINER)
    region = Region(ground, half_m, folder / "coast.gpkg")
    write_mosaic(region, folder / "mosaic.tif")
    (folder / "build.toml").write_text(
        '[body]\nname = "earth"\n\n[[image]]\npath = "mosaic.tif"\n\n'
        f"[grid]\ncell_deg = {cell_deg}\n\n[pyramid]\nlevels = 3\n{extra}"
    )
    build.run(folder / "build.toml", output=region.catalog, workers=1, progress=progress)
    return region


def write_mosaic(region: Region, path: Path, season: int = 0) -> None:
    """Write the brightness of a season as a GeoTIFF of bytes; 0 is no data."""
    shown = region.ground.show(season)
    rows, cols = (side // FINER for side in shown.shape)
    mean = cv2.resize(shown, (cols, rows), interpolation=cv2.INTER_AREA)
    west, north = region.corner_m
    affine = rasterio.Affine(POSTING_M, 0.0, west, 0.0, -POSTING_M, north)
    profile = {"driver": "GTiff", "count": 1, "dtype": "uint8", "nodata": 0, "tiled": True}
    with rasterio.open(
        path, "w", width=cols, height=rows, crs=CRS, transform=affine, **profile
    ) as file:
        file.write(np.clip(np.rint(mean * 255.0), 1, 255).astype(np.uint8), 1)


@dataclass(frozen=True, eq=False)
class Shot:
    """A picture with its true pose: body-fixed, m, and camera_from_body."""

    tdb_s: float
    position_m: FloatArray
    attitude: Rotation


def fly(region: Region, frames: int, rng: np.random.Generator) -> list[Shot]:
    """Poses of a route northward or southward over a region, looking down within a degree."""
    to_body = pyproj.Transformer.from_crs(CRS, "EPSG:4978", always_xy=True)
    sign, aside = rng.choice([-1.0, 1.0]), rng.uniform(-1.0, 1.0) * 20e3
    lean = np.radians(rng.uniform(-8.0, 8.0))  # of the track from north
    forward = sign * np.array([np.sin(lean), np.cos(lean)])
    lengths = SPEED_M_S * SPACING_S * (np.arange(frames) - (frames - 1) / 2.0)
    times = compute_tdb_s_after(START_UTC, 86400.0 * rng.integers(0, 60) + lengths / SPEED_M_S)
    shots = []
    for time_s, along in zip(times.tolist(), lengths, strict=True):
        east, north = np.array(MIDDLE_M) + forward * along + np.array([aside, 0.0])
        height = HEIGHT_M + rng.normal(0.0, 3e3)
        place, ahead, top = (
            np.array(to_body.transform(*at))
            for at in (
                (east, north, height),
                (east + forward[0] * 1e3, north + forward[1] * 1e3, height),
                (east, north, height + 1e3),
            )
        )
        down = (place - top) / np.linalg.norm(place - top)
        up_picture = ahead - place - ((ahead - place) @ down) * down
        up_picture /= np.linalg.norm(up_picture)
        level = Rotation.from_matrix(np.stack([np.cross(-up_picture, down), -up_picture, down]))
        tilt = Rotation.from_rotvec(np.radians(rng.normal(0.0, 0.3, 3)))
        shots.append(Shot(time_s, place, tilt * level))
    return shots


def locate_ground(
    camera: Camera, shot: Shot, columns_px: FloatArray, rows_px: FloatArray
) -> FloatArray:
    """Map coordinates (rows, cols, 2) that pixels show, on the ellipsoid and through the air."""
    pixels = np.stack(np.meshgrid(columns_px, rows_px), axis=-1).reshape(-1, 2)
    rays = shot.attitude.inv().apply(camera.unproject(pixels))
    radii = np.array(EARTH.radii_m)
    start, way = shot.position_m / radii, rays / radii
    a, b, c = (way * way).sum(axis=1), way @ start, start @ start - 1.0
    length = (-b - np.sqrt(b * b - a * c)) / a
    straight = shot.position_m + rays * length[:, None]
    # air bends rays towards the nadir by what moves places away from it
    bent = 2.0 * straight - correct_refraction(straight, shot.position_m, EARTH)
    to_map = pyproj.Transformer.from_crs("EPSG:4978", CRS, always_xy=True)
    east, north, _ = to_map.transform(*bent.T)
    places: FloatArray = np.stack([east, north], axis=-1)
    return places.reshape(len(rows_px), len(columns_px), 2)


def take_picture(
    region: Region, shown: Float32Array, camera: Camera, shot: Shot, rng: np.random.Generator
) -> ByteArray:
    """Counts (rows, cols) of 8 bits of the ground as it is shown; 0 beyond the region."""
    across = np.arange(0, camera.width_px + STEP_PX, STEP_PX, dtype=np.float64)
    down = np.arange(0, camera.height_px + STEP_PX, STEP_PX, dtype=np.float64)
    places = locate_ground(camera, shot, across, down)
    (west, north), node_m = region.corner_m, POSTING_M / FINER
    lattice = np.stack(
        [(places[..., 0] - west) / node_m - 0.5, (north - places[..., 1]) / node_m - 0.5], axis=-1
    ).astype(np.float32)
    x, y = np.meshgrid(
        np.arange(camera.width_px, dtype=np.float32) / STEP_PX,
        np.arange(camera.height_px, dtype=np.float32) / STEP_PX,
    )
    at = cv2.remap(lattice, x, y, cv2.INTER_CUBIC)
    # a pixel spans two nodes of the ground, whose blur stands for optics and pixel
    soft = cv2.GaussianBlur(shown, (0, 0), 1.2)
    picture = cv2.remap(soft, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    noise = rng.normal(0.0, NOISE, picture.shape)
    counts: ByteArray = np.clip(np.rint((picture + noise) * 230.0), 0, 255).astype(np.uint8)
    return counts


def draw_view(region: Region, season: int, cover: float, seed: int) -> Float32Array:
    """Brightness of a region in a season with tone, haze and clouds of its own."""
    rng = np.random.default_rng([seed, 7])
    tone, haze, clear = rng.uniform(0.7, 1.4), rng.uniform(0.02, 0.12), rng.uniform(0.6, 0.9)
    shown: Float32Array = (haze + region.ground.show(season) ** tone * clear).astype(np.float32)
    return shown if cover <= 0.0 else add_clouds(shown, seed, cover, POSTING_M / FINER)[0]


def write_route(
    region: Region,
    folder: Path,
    *,
    frames: int,
    season: int,
    cover: float,
    seed: int,
    mounting_arcsec: Sequence[float] = (0.0, 0.0, 0.0),
    prior_m: float = PRIOR_M,
    camera: Camera | None = None,
) -> None:
    """Write a picture folder of a route with truth.csv; mounting_arcsec: what no file states."""
    rng = np.random.default_rng([seed, 3])
    camera = camera or preset_camera("kmss")
    shown = draw_view(region, season, cover, seed)
    settings = RunSettings("earth", "camera_from_body")
    attitude = FileAttitude("camera_from_body", EARTH)
    mounting = Rotation.from_rotvec(np.array(mounting_arcsec) * ARCSEC)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    rows, truths = [], []
    for number, shot in enumerate(fly(region, frames, rng)):
        file, utc = f"frame_{number:02d}.png", utc_from_tdb_s(shot.tdb_s, 3)
        counts = take_picture(region, shown, camera, shot, rng)
        cv2.imwrite(str(folder / file), counts)
        noise = Rotation.from_rotvec(rng.normal(0.0, ATTITUDE_ARCSEC * ARCSEC, 3))
        stated = noise * mounting.inv() * shot.attitude
        prior = shot.position_m + rng.normal(0.0, prior_m, 3)
        row = Frame(file, utc, "kmss", shot.tdb_s, stated, ATTITUDE_ARCSEC * ARCSEC, prior, prior_m)
        rows.append(row)
        truths.append(Truth(file, utc, shot.tdb_s, shot.position_m, shot.attitude))
    write_folder(folder, settings, [camera], rows)
    write_truth(folder / "truth.csv", attitude, truths)


def solve_route(region: Region, pictures: Path, run: Path) -> list[FrameError]:
    """Navigate a route; its frames against the truth, unsolved ones too."""
    with suppress(NothingToDoError):
        navigate_folder(RunInputs(pictures, (region.catalog,)), run, SilentProgress(), workers=1)
    return list(evaluate_run(run, pictures / "truth.csv").frames)


@dataclass(frozen=True)
class RouteFigures:
    """What came of some routes."""

    errors: list[FrameError]
    routes: int
    mounting_arcsec: FloatArray
    mounting_sigma_arcsec: FloatArray


def calibrate_mounting(
    region: Region, folder: Path, frames: int, season: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Solve a mounting from a route with known positions; error and sigma (3,), arc seconds."""
    pictures = folder / "pictures"
    write_route(
        region,
        pictures,
        frames=frames,
        season=season,
        cover=0.3,
        seed=seed,
        mounting_arcsec=MOUNTING_ARCSEC,
        prior_m=10.0,
    )
    kinds, given = (Common.MOUNTING,), RunInputs(pictures, (region.catalog,))
    made = calibrate_folder(
        given, folder / "calibration", kinds, CalibrateSettings(), SilentProgress()
    )
    rows = made.rows()
    values = np.array([float(str(row["change"])) for row in rows])
    sigmas = np.array([float(str(row["sigma"])) for row in rows])
    return values - np.array(MOUNTING_ARCSEC), sigmas


def run(progress: Progress, output: Path, routes: int, frames: int, fit: bool) -> RouteFigures:
    """Fly all routes, half of them over each ground, and calibrate a mounting over each."""
    errors: list[FrameError] = []
    off, sigmas = [], []
    grounds = FITTED if fit else SCORED
    with progress.stage("kmss", routes, "route") as stage:
        for number, seed in enumerate(grounds):
            place = output / str(seed)
            region = make_region(seed, place, HALF_M, SilentProgress())
            own = range(number, routes, len(grounds))
            for route in own:
                cover = CLOUDS[0] + (CLOUDS[1] - CLOUDS[0]) * route / max(routes - 1, 1)
                pictures, drawn = place / f"route-{route:02d}", 100 * seed + route
                season = 1 + route
                write_route(region, pictures, frames=frames, season=season, cover=cover, seed=drawn)
                errors += solve_route(region, pictures, place / f"run-{route:02d}")
                stage.advance()
            with suppress(NoSolutionError, NothingToDoError):
                found = calibrate_mounting(region, place / "mounting", 2 * frames, 50, seed)
                off.append(found[0])
                sigmas.append(found[1])
    return RouteFigures(errors, routes, np.array(off), np.array(sigmas))


ROUTES_TABLE = columns(
    "what = case; routes = routes; frames = frames; points = points in view; "
    "found = share found .2f; "
    "solved = share of frames solved .2f; solved_least = of these wanted .2f; "
    "n_m = sigma N [m] .0f; b_m = sigma B [m] .0f; r_m = sigma R [m] .0f; nees = NEES .2f; "
    "beyond = beyond 4.5 sigma"
)
MOUNTING_TABLE = columns(
    "what = case; x_arcsec = x [arcsec] .1f; y_arcsec = y [arcsec] .1f; z_arcsec = z [arcsec] .1f; "
    "x_sigma = sigma x [arcsec] .1f; y_sigma = sigma y [arcsec] .1f; z_sigma = sigma z [arcsec] .1f"
)


def report(result: RouteFigures) -> StudyReport:
    """Tables of the study."""
    solved = [e for e in result.errors if e.error_rnb_m is not None]
    rnb = np.array([e.error_rnb_m for e in solved]).reshape(-1, 3)
    rms = np.sqrt((rnb**2).mean(axis=0)) if len(solved) else np.full(3, np.nan)
    evidence = [e.solution.evidence for e in result.errors]
    points = sum(e.n_predicted or 0 for e in evidence)
    found = sum(e.n_used or 0 for e in evidence)
    nees = [float(e.nees or 0.0) / 3.0 for e in solved]
    frames = len(result.errors)
    rows = [
        (
            "source, real pictures", 28, 3933, 34665, SOURCE["points"], SOURCE["frames"], None,
            SOURCE["n"], SOURCE["b"], SOURCE["r"], None, None,
        ),
        (
            "optnav, simulated", result.routes, frames, points, found / max(points, 1),
            len(solved) / max(frames, 1), 0.45, float(rms[1]), float(rms[2]), float(rms[0]),
            float(np.mean(nees)) if nees else None, sum(3.0 * n > 27.1 for n in nees),
        ),
    ]  # fmt: skip
    mounting = [
        (f"ground {seed}", *error.tolist(), *sigma.tolist())
        for seed, error, sigma in zip(
            SCORED, result.mounting_arcsec, result.mounting_sigma_arcsec, strict=False
        )
    ]
    return StudyReport(
        (
            StudyTable("Routes of the KMSS under clouds", ROUTES_TABLE, tuple(rows)),
            StudyTable("Error of the calibrated mounting", MOUNTING_TABLE, tuple(mounting)),
        )
    )
