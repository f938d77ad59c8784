"""Pads carried along navigated descents: where they are, and how safe against a single picture's.

The narrow camera looks straight down on rough drawn ground (38 % above 7 deg) from 1500 to 50 m.
The run's poses err by what their covariance states, half of it in common to all frames, as those
of a filter do. The run's terrain model is the ground at 20 m with smooth errors of 0.5 m rms, which
make 1 deg of slope. Numbers of the hazard map are fitted on other fields, those of windows on
fields 1 and 2.
"""

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import rasterio
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import NothingToDoError
from catalog.files import hash_file
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress, SilentProgress
from catalog.rasters import encode_geotiff
from catalog.store.geopackage import format_stereographic_wkt
from catalog.terrain.slopes import CRITICAL_DEG, DANGEROUS_DEG
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.fix import Fix, Method, Solution
from optnav_cli.frames.folder import read_folder, write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_frame_picture
from optnav_cli.frames.run_settings import RunSettings
from optnav_cli.frames.tables import CARRIED_PADS, PADS
from optnav_cli.hazard.ground_view import KnownPose, look_from, resize_grid
from optnav_cli.hazard.hazard_map import map_hazard
from optnav_cli.hazard.job import HazardInputs, map_run
from optnav_cli.hazard.settings import CARRIED_FILE, PADS_FILE, HazardSettings
from optnav_cli.output.manifest import write_manifest
from optnav_cli.output.run_folder import copy_inputs
from optnav_cli.output.tables import write_solutions
from tests.studies.hazard_fields import (
    DRAWN_M,
    JUDGED_M,
    RADIUS_M,
    SITE,
    GroundField,
    make_field,
    perspective_picture,
    sun_vector,
)
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

HEIGHTS_M = (1500.0, 1000.0, 500.0, 200.0, 50.0)
SUNS = (20.0, 5.0)
PAD_M = 20.0
POSTING_M, MODEL_ERROR_M, MODEL_ERROR_NODES = 20.0, 0.5, 1.5
POSITION_SIGMA_M = 0.01  # of the height over the ground, per axis; half of its variance in common
LEAST_SIGMA_M = 1.0
ATTITUDE_SIGMA = 10.0 * ARCSEC
SINGLE_M = 500.0  # height of the picture that a pad is chosen from alone
MOST_SIGMAS = 3.0


@dataclass(frozen=True)
class JudgedPlace:
    """A pad against the truth.

    height_m  of its last picture;  error_m  of its place, horizontal;  sigmas  Mahalanobis distance
    """

    height_m: float
    error_m: float
    sigma_m: float
    sigmas: float
    dangerous: float
    critical: float


@dataclass(frozen=True, eq=False)
class DescentFigures:
    """Pads carried, and shares above 7 and 15 deg of others, by the Sun.

    single   pads of the picture from 500 m by itself;  squares  of the same picture in the run
    """

    carried: dict[float, list[JudgedPlace]]
    single: dict[float, list[tuple[float, float]]]
    squares: dict[float, list[tuple[float, float]]]
    fields: int


def run(progress: Progress, fields: int = 1, first: int = 3) -> DescentFigures:
    """Fly so many descents under each Sun, over fields of seeds from `first` up."""
    carried: dict[float, list[JudgedPlace]] = {sun: [] for sun in SUNS}
    single: dict[float, list[tuple[float, float]]] = {sun: [] for sun in SUNS}
    squares: dict[float, list[tuple[float, float]]] = {sun: [] for sun in SUNS}
    with progress.stage("descents", 2 * fields, "descent") as bar:
        for seed in range(first, first + fields):
            ground = make_field("rough", seed)
            for sun in SUNS:
                with tempfile.TemporaryDirectory() as place:
                    flown = FlownDescent.make(ground, sun, Path(place))
                    carried[sun] += flown.judge_run()
                    squares[sun] += flown.judge_squares()
                    single[sun] += flown.judge_single()
                bar.advance()
    return DescentFigures(carried, single, squares, fields)


@dataclass(frozen=True, eq=False)
class FlownDescent:
    """Pictures, run and terrain model of a descent.

    truth  camera's place by file: east and north of the field's middle, above the sphere, m
    """

    ground: GroundField
    sun_deg: float
    place: Path
    camera: Camera
    truth: dict[str, tuple[float, float, float]]

    @classmethod
    def make(cls, ground: GroundField, sun_deg: float, place: Path) -> "FlownDescent":
        """Draw the pictures and write the run, whose poses err."""
        camera = preset_camera("tsnn2_narrow")
        rng = np.random.default_rng([ground.seed, round(sun_deg), 5])
        local = SITE.body_from_local
        sun = local @ sun_vector(sun_deg, ground.azimuth_deg())
        down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]) @ local.T)
        pictures, run_folder = place / "pictures", place / "run"
        pictures.mkdir()
        run_folder.mkdir()
        common = rng.standard_normal(3)
        frames, solutions = [], []
        flown = cls(ground, sun_deg, place, camera, {})
        over = 0.0, 0.0
        for number, height_m in enumerate(HEIGHTS_M):
            if height_m < SINGLE_M and over == (0.0, 0.0):
                over = flown.choose_target()  # the craft flies to the best pad of that picture
            part = cut_field(ground, height_m, over)
            picture = perspective_picture(part, camera, height_m, sun_deg, DRAWN_M)
            file = f"{number}_{height_m:.0f}m.png"
            cv2.imwrite(str(pictures / file), picture.values.astype(np.uint16) * 16)
            flown.truth[file] = (*over, float(part.heights.mean()) + height_m)
            position = SITE.points(*flown.truth[file])
            sigma = max(POSITION_SIGMA_M * height_m, LEAST_SIGMA_M)
            drawn = math.sqrt(0.5) * (common + rng.standard_normal(3))
            turn = Rotation.from_rotvec(ATTITUDE_SIGMA * rng.standard_normal(3))
            utc = f"2026-01-01T00:{number:02d}:00Z"
            solved = position + sigma * drawn, turn * down
            frame = Frame(
                file, utc, camera.name, 0.0, solved[1], ATTITUDE_SIGMA, solved[0], 100.0, sun
            )  # fmt: skip
            frames.append(frame)
            covariance = sigma**2 * np.eye(3)
            fix = Fix(Method.DESCENT, solved[0], covariance, solved[1], ATTITUDE_SIGMA)
            solutions.append(Solution(file, utc, fix))
        settings = RunSettings("moon", "camera_from_body")
        write_folder(pictures, settings, [camera], frames)
        copy_inputs(pictures, settings, run_folder)
        write_solutions(run_folder / "solution.csv", solutions, read_folder(pictures).attitude)
        hashes = {frame.file: hash_file(pictures / frame.file) for frame in frames}
        write_manifest(
            run_folder, "run", command="navigate", options={}, started=datetime.now(UTC),
            inputs={"pictures": str(pictures), "files_sha256": hashes},
        )  # fmt: skip
        write_model(ground, place / "model.tif")
        return flown

    def judge_run(self) -> list[JudgedPlace]:
        """Map the run and judge the pads that it carries to the height of the single picture."""
        out = self.place / "hazard"
        inputs = HazardInputs(HazardSettings(), dem=self.place / "model.tif")
        try:
            map_run(self.place / "run", inputs, out, SilentProgress())
        except NothingToDoError:
            return []
        judged = []
        for row in CARRIED_PADS.rows(out / CARRIED_FILE):
            pixel = np.array([row.number("x_px") or 0.0, row.number("y_px") or 0.0])
            height_m = HEIGHTS_M[int(row["file"][0])]
            x, y = self.find_true_place(row["file"], pixel)
            angles = (math.radians(row.number(f"{name}_deg") or 0.0) for name in ("lat", "lon"))
            off = np.array(SITE.xy_from_latlon(*angles), float).ravel() - (x, y)
            east, north = (row.number(f"sigma_{name}_m") or 0.0 for name in ("east", "north"))
            both = (row.number("correlation") or 0.0) * east * north
            covariance = np.array([[east**2, both], [both, north**2]])
            distance = math.sqrt(float(off @ np.linalg.solve(covariance, off)))
            sigma = math.sqrt(0.5 * float(np.trace(covariance)))
            shares = self.measure_shares(x, y)
            judged.append(JudgedPlace(height_m, math.hypot(*off), sigma, distance, *shares))
        return judged

    def judge_squares(self) -> list[tuple[float, float]]:
        """Judge the pads that the run has in the squares of the picture from 500 m."""
        number = str(HEIGHTS_M.index(SINGLE_M))
        found = []
        for row in PADS.rows(self.place / "hazard" / PADS_FILE):
            if row["file"].startswith(number) and row["x_px"]:
                pixel = np.array([row.number("x_px") or 0.0, row.number("y_px") or 0.0])
                found.append(self.measure_shares(*self.find_true_place(row["file"], pixel)))
        return found

    def judge_single(self) -> list[tuple[float, float]]:
        """Judge the pads of the picture from 500 m by itself, with its true pose."""
        return [self.measure_shares(*place) for _, place in self._choose_alone()]

    def choose_target(self) -> tuple[float, float]:
        """Choose the node of the pad with the least expected danger in the picture from 500 m."""
        x, y = min(self._choose_alone())[1]
        return DRAWN_M * round(x / DRAWN_M), DRAWN_M * round(y / DRAWN_M)

    def _choose_alone(self) -> list[tuple[float, tuple[float, float]]]:
        """Choose the pads of the picture from 500 m: expected share above 7 deg and true place."""
        file = next(name for name in self.truth if name.endswith(f"_{SINGLE_M:.0f}m.png"))
        local = SITE.body_from_local
        down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]) @ local.T)
        sun = local @ sun_vector(self.sun_deg, self.ground.azimuth_deg())
        picture = load_frame_picture(self.place / "pictures", file, self.camera)
        pose = KnownPose(SITE.points(*self.truth[file]), down, sun, RADIUS_M)
        view = look_from(picture, self.camera, pose, self.truth[file][2] - SINGLE_M)
        return [
            (
                pad.shares["expected_dangerous_share"],
                self.find_true_place(file, np.array(view.find_pixel(*pad.cell))),
            )
            for pad in map_hazard(view, HazardSettings()).pads
            if pad.cell is not None
        ]

    def find_true_place(self, file: str, pixel: FloatArray) -> tuple[float, float]:
        """Find what ground a pixel shows: x east and y north of the field's middle, m."""
        ray = self.camera.unproject(pixel)
        heights = self.ground.heights
        middle = 0.5 * (len(heights) - 1)
        east, north, height_m = self.truth[file]
        h = float(heights.mean())
        x = y = 0.0
        for _ in range(8):
            x = east + (height_m - h) * float(ray[0] / ray[2])
            y = north - (height_m - h) * float(ray[1] / ray[2])
            col, row = x / DRAWN_M + middle, middle - y / DRAWN_M
            place = np.full((1, 1), col, np.float32), np.full((1, 1), row, np.float32)
            h = float(cv2.remap(heights, *place, cv2.INTER_LINEAR)[0, 0])
        return x, y

    def measure_shares(self, x: float, y: float) -> tuple[float, float]:
        """Measure the shares of a pad above 7 and 15 deg."""
        degrees, half = self.ground.degrees, round(0.5 * PAD_M / JUDGED_M)
        middle = 0.5 * (len(degrees) - 1)
        row, col = round(middle - y / JUDGED_M + 0.5), round(middle + x / JUDGED_M + 0.5)
        on = np.nan_to_num(degrees[row - half : row + half, col - half : col + half])
        return float((on > DANGEROUS_DEG).mean()), float((on > CRITICAL_DEG).mean())


def cut_field(ground: GroundField, height_m: float, over: tuple[float, float]) -> GroundField:
    """Cut what a picture from this height over a place shows of a field, and 100 m around it."""
    many = len(ground.heights)
    wide = min(many, 2 * round((0.5 * height_m + 100.0) / DRAWN_M))
    first = [
        round(0.5 * (many - wide) + along / DRAWN_M) for along in (-over[1], over[0])
    ]  # row, column
    rows, cols = (slice(at, at + wide) for at in first)
    return replace(ground, heights=np.ascontiguousarray(ground.heights[rows, cols]))


def write_model(ground: GroundField, path: Path) -> None:
    """Write the terrain model of 20 m, with smooth errors of 0.5 m rms."""
    size = int(len(ground.heights) * DRAWN_M / POSTING_M)
    many = round(size * POSTING_M / DRAWN_M)
    first = (len(ground.heights) - many) // 2
    part = slice(first, first + many)
    coarse = resize_grid(np.ascontiguousarray(ground.heights[part, part]), (size, size))
    noise = np.random.default_rng([ground.seed, 8]).standard_normal((size, size))
    error = gaussian_filter(noise, MODEL_ERROR_NODES)
    heights = (coarse + MODEL_ERROR_M * error / error.std()).astype(np.float32)
    centre = math.degrees(SITE.lat), math.degrees(SITE.lon)
    wkt = format_stereographic_wkt("moon", "the field", RADIUS_M, centre)
    half = 0.5 * size * POSTING_M
    grid = rasterio.Affine(POSTING_M, 0.0, -half, 0.0, -POSTING_M, half)
    profile = {"crs": rasterio.CRS.from_wkt(wkt), "transform": grid, "nodata": np.nan}
    path.write_bytes(encode_geotiff({"height, m": heights}, profile, {}))


_COLUMNS = columns(
    "sun = Sun [deg] .0f; picture = last picture; pads .0f; error = place, rms [m] .2f;"
    "sigma = stated per axis [m] .2f; nees = NEES .2f; worst = worst [σ] .1f;"
    "pads_7 = pads > 7° [%] .1f; pads_15 = pads > 15° [%] .2f"
)


def _list_rows(figures: DescentFigures) -> Iterator[tuple[Cell, ...]]:
    for sun, pads in figures.carried.items():
        for height in (*HEIGHTS_M, None):
            kept = [
                p
                for p in pads
                if p.height_m == height or (height is None and p.height_m <= SINGLE_M)
            ]
            if kept:
                rms = math.sqrt(float(np.mean([p.error_m**2 for p in kept])))
                nees = float(np.mean([p.sigmas**2 for p in kept])) / 2.0
                yield (
                    *(
                        sun,
                        "500 m and below" if height is None else f"{height:g} m",
                        len(kept),
                        rms,
                    ),
                    *(float(np.median([p.sigma_m for p in kept])), nees),
                    max(p.sigmas for p in kept),
                    *(
                        100.0 * float(np.mean([getattr(p, n) for p in kept]))
                        for n in ("dangerous", "critical")
                    ),
                )
        for words, found in (
            ("500 m, all of its squares", figures.squares),
            ("500 m alone", figures.single),
        ):
            shares = np.array(found[sun])
            empty = [None] * 4
            yield sun, words, len(shares), *empty, *(100.0 * shares.mean(axis=0)).tolist()


def report(figures: DescentFigures) -> StudyReport:
    """Make the table of pads by the height of their last picture."""
    table = StudyTable(
        f"Pads of {PAD_M:g} m carried along {figures.fields} descents under each Sun",
        _COLUMNS,
        tuple(_list_rows(figures)),
    )
    note = (
        f"Poses err by {POSITION_SIGMA_M:.0%} of the height, at least {LEAST_SIGMA_M:g} m, and by "
        '10". The worst place may be 3 sigma off; pads that are carried to 500 m and below may not '
        "be worse than those of the picture from 500 m alone."
    )
    return StudyReport((table,), (note,))
