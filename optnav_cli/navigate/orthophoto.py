"""Solved frames laid on the ground: `optnav export RUN --ortho`, one GeoTIFF a frame.

Each map pixel's place on the terrain model is projected into the picture; places behind other
ground, beyond the picture or without a height have no value. A second band says how far off a
place is, 1 sigma, horizontal: by the stated error of heights along the line of sight, and by the
pose. Position and attitude err together, since both came from the same points: as the matches of
the frame leave them, scaled to the stated covariance of the position. With too few matches both
count as independent, which states too much.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from affine import Affine
from numpy.typing import NDArray

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.body import Body
from catalog.errors import DataError, NoSolutionError
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.kernel import kernel
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.projection import Stereographic
from catalog.geometry.rotations import cross_matrix
from catalog.geometry.vectors import unit
from catalog.progress import Progress
from catalog.rasters import encode_geotiff
from catalog.store.geopackage import format_stereographic_wkt
from catalog.terrain.dem.source import DemSource
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.points import differentiate_places
from optnav_cli.fix import MatchRow, Solution
from optnav_cli.frames.picture import load_picture
from optnav_cli.frames.tables import ORTHO
from optnav_cli.output.manifest import hash_files, output_folder
from optnav_cli.output.run_folder import (
    MATCHES,
    SOLUTION,
    RunFolder,
    check_run_picture,
    find_run_pictures,
)
from optnav_cli.reasons import ReasonCode

KIND, STAGE = "orthophotos", "ortho"
ORTHO_CSV = "ortho.csv"
LATTICE = 33  # rays a side that find the ground of a picture
MAX_EMISSION_DEG = 75.0  # beyond it a pixel smears over four times its width
MAX_SIDE = 8192  # map pixels; a wider picture is laid out coarser
MIN_MATCHES = 4
STRIP = 256  # map rows at once


@dataclass(frozen=True)
class OrthoSettings:
    """Options of an orthophoto export.

    dem         heights of the ground;  dem_sigma_m  their 1 sigma
    posting_m   of the map; None: the median ground size of a picture's pixel
    pictures    the picture folder; None: as the run's manifest says
    """

    dem: Path
    dem_sigma_m: float = 0.0
    posting_m: float | None = None
    pictures: Path | None = None


@dataclass(frozen=True)
class MapFrame:
    """The map of one picture: `size` (rows, cols) pixels of `posting_m`, from (west, north) m."""

    projection: Stereographic
    west_m: float
    north_m: float
    posting_m: float
    size: tuple[int, int]

    def nodes(self, first: int, last: int) -> tuple[FloatArray, FloatArray]:
        """Map x and y (rows, cols), m, of the pixels' centres in rows first to last."""
        cols = self.west_m + (np.arange(self.size[1]) + 0.5) * self.posting_m
        rows = self.north_m - (np.arange(first, last) + 0.5) * self.posting_m
        x, y = np.meshgrid(cols, rows)
        return x, y


@dataclass(frozen=True, eq=False)
class SolvedPose:
    """A camera at position_m (3,), turned by camera_from_body (3, 3), and its joint covariance.

    covariance  (6, 6)  of the position, m^2, and of the turn in the camera's frame, rad^2
    """

    camera: Camera
    position_m: FloatArray
    camera_from_body: FloatArray
    covariance: FloatArray

    def compute_sigmas(self, points_m: FloatArray, dem_m: float) -> FloatArray:
        """Horizontal 1 sigma (n,), m, root mean square of two axes, of places (n, 3) as mapped."""
        up = unit(points_m)
        moved = differentiate_places(points_m - self.position_m, up)
        # a turn of the camera's frame is the opposite one of the body's
        turned = -moved[:, :, 3:6] @ self.camera_from_body.T
        slopes = np.concatenate([moved[:, :, :3], turned], axis=2)
        pose = np.einsum("nij,jk,nik->n", slopes, self.covariance, slopes)
        sideways = moved[:, :, 6] - up
        heights = dem_m**2 * (sideways**2).sum(axis=1)
        sigmas: FloatArray = np.sqrt(0.5 * (pose + heights))
        return sigmas


def export_orthophotos(
    run: RunFolder, settings: OrthoSettings, output: Path, progress: Progress
) -> list[dict[str, object]]:
    """Write the solved frames of a run as GeoTIFFs into a folder; return the rows of ortho.csv.

    Frames that cannot be laid out have a row with the reason. Raises DataError for a terrain model
    or pictures that cannot be used, NothingToDoError, after the folder is written, for no frame.
    """
    pictures, known = find_run_pictures(run.path, settings.pictures)
    sources = [run.path, settings.dem, pictures]
    with output_folder(output, KIND, "export", sources, STAGE) as out:
        dem = DemSource.open_alone(settings.dem, run.attitude.body)
        rows: list[dict[str, object]] = []
        try:
            with progress.stage(STAGE, len(run.solutions), "frame") as bar:
                for solution in run.solutions:
                    row: dict[str, object] = {"file": solution.file, "status": "unsolved"}
                    try:
                        check_run_picture(pictures, solution.file, known)
                        row |= _export_frame(run, solution, pictures, (dem, settings), out.path)
                    except (NoSolutionError, DataError) as error:
                        row["reason"] = str(error)
                    rows.append(row)
                    bar.advance()
        finally:
            dem.close()
        ORTHO.write(out.path / ORTHO_CSV, rows)
        made = sum(row["status"] == "solved" for row in rows)
        out.options = {"posting_m": settings.posting_m, "dem_sigma_m": settings.dem_sigma_m}
        out.inputs = {
            "run": run.path,
            "files_sha256": hash_files(run.path, [SOLUTION, MATCHES]),
            "pictures": pictures,
            "dem": hash_files(settings.dem.parent, [settings.dem.name]),
        }
        out.results = {"frames": len(rows), "made": made}
        if not made:
            out.failure = f"{run.path}: no frame could be laid out; the first: {rows[0]['reason']}"
    return rows


def _export_frame(
    run: RunFolder,
    solution: Solution,
    pictures: Path,
    ground: tuple[DemSource, OrthoSettings],
    place: Path,
) -> dict[str, object]:
    dem, settings = ground
    camera = run.cameras.get(solution.file)
    if not solution.solved or camera is None:
        words = solution.reason or "the frame has no camera"
        raise NoSolutionError(f"is not solved: {words}", ReasonCode.OUTSIDE_FRAME)
    matches = [row for row in run.matches if row.file == solution.file and row.used]
    pose = make_pose(solution, camera, matches)
    frame = lay_out_map(pose, run.attitude.body, settings.posting_m)
    picture = load_picture(pictures / solution.file, camera)
    values, sigmas = map_picture(pose, frame, dem, picture.values, settings.dem_sigma_m)
    seen = np.isfinite(values)
    if not seen.any():
        raise NoSolutionError(
            f"{settings.dem}: has no heights of the ground in the picture", ReasonCode.OUTSIDE_FRAME
        )
    name = Path(solution.file).with_suffix(".tif")
    target = place / name
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(_encode(values, sigmas, frame, run.attitude.body))
    lat_deg, lon_deg = (math.degrees(v) for v in (frame.projection.lat, frame.projection.lon))
    return {
        "status": "solved",
        "ortho": name.as_posix(),
        "lat_deg": lat_deg,
        "lon_deg": lon_deg,
        "posting_m": frame.posting_m,
        "covered": float(seen.mean()),
        "sigma_median_m": float(np.median(sigmas[seen])),
        "sigma_max_m": float(sigmas[seen].max()),
    }


def make_pose(solution: Solution, camera: Camera, matches: list[MatchRow]) -> SolvedPose:
    """The pose of a solved frame, with position and attitude tied by its used matches.

    Raises NoSolutionError for a frame without an attitude.
    """
    position, turn = solution.position_m, solution.camera_from_body
    if position is None or solution.covariance_m2 is None or turn is None:
        raise NoSolutionError("the solution has no attitude", ReasonCode.NO_ATTITUDE)
    matrix = turn.as_matrix()
    sigma = solution.attitude_sigma_rad or 0.0
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = solution.covariance_m2
    covariance[3:, 3:] = np.eye(3) * sigma**2
    if sigma > 0.0 and len(matches) >= MIN_MATCHES:
        sight = (np.array([m.cp_position_m for m in matches]) - position) @ matrix.T
        slopes = camera.project_with_jacobian(sight)[1]
        both = np.concatenate([-slopes @ matrix, -slopes @ cross_matrix(sight)], axis=2)
        rows = both.reshape(-1, 6)
        residuals = np.array([m.residual_px for m in matches if m.residual_px is not None])
        noise = max(float((residuals**2).mean()) if residuals.size else 0.0, 1e-4)
        normal = rows.T @ rows / noise
        normal[3:, 3:] += np.eye(3) / sigma**2
        joint = np.linalg.inv(normal)
        covariance = joint * np.trace(solution.covariance_m2) / np.trace(joint[:3, :3])
    return SolvedPose(camera, position, matrix, covariance)


def lay_out_map(pose: SolvedPose, body: Body, posting_m: float | None) -> MapFrame:
    """The map of the ground that a picture shows, up to MAX_EMISSION_DEG.

    Raises NoSolutionError where the picture shows none.
    """
    camera = pose.camera
    steps = [np.linspace(0.0, side - 1.0, LATTICE) for side in (camera.width_px, camera.height_px)]
    pixels = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    rays = unit(camera.unproject(pixels)) @ pose.camera_from_body
    distance = distance_to_sphere(pose.position_m, rays, body.radius_m)
    points = pose.position_m + distance[:, None] * rays
    seen = np.isfinite(distance)
    seen[seen] = -(rays[seen] * unit(points[seen])).sum(axis=1) > math.cos(
        math.radians(MAX_EMISSION_DEG)
    )
    if not seen.any():
        raise NoSolutionError(
            f"the picture shows no ground below {MAX_EMISSION_DEG:g} deg of emission",
            ReasonCode.OUTSIDE_FRAME,
        )
    lat, lon, _ = latlon_from_xyz(points[seen].mean(axis=0))
    projection = Stereographic(float(lat), float(lon), body.radius_m)
    x, y = projection.xy_from_xyz(points[seen])
    fine = posting_m or float(np.median(distance[seen])) * camera.angular_resolution
    step = max(fine, float(max(np.ptp(x), np.ptp(y))) / MAX_SIDE)
    west, south = (step * math.floor(float(v.min()) / step) for v in (x, y))
    cols, rows = (
        max(1, math.ceil((float(v.max()) - low) / step)) for v, low in ((x, west), (y, south))
    )
    return MapFrame(projection, west, south + rows * step, step, (rows, cols))


def map_picture(
    pose: SolvedPose, frame: MapFrame, dem: DemSource, counts: NDArray[np.generic], dem_m: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Counts of a picture and horizontal 1 sigma, m, of each map pixel (rows, cols); NaN: none.

    counts  (height, width) of the picture, NaN without a value;  dem_m  1 sigma of heights
    """
    values = np.full(frame.size, np.nan, np.float32)
    sigmas = np.full(frame.size, np.nan, np.float32)
    picture = np.asarray(counts, dtype=np.float32)
    strips = [(n, min(n + STRIP, frame.size[0])) for n in range(0, frame.size[0], STRIP)]
    grids = [dem.heights_at(*frame.projection.latlon(*frame.nodes(*strip))) for strip in strips]
    ground = np.concatenate(grids)
    for first, last in strips:
        x, y = frame.nodes(first, last)
        points = frame.projection.points(x, y, ground[first:last].astype(np.float64))
        flat = points.reshape(-1, 3)
        pixels = pose.camera.project_from_body(flat, pose.position_m, pose.camera_from_body)
        known = np.isfinite(pixels).all(axis=1) & pose.camera.contains(pixels)
        known &= ~find_hidden(pose.position_m, points, frame, ground, first).ravel()
        at = np.where(known[:, None], pixels, 0.0).astype(np.float32).reshape(*x.shape, 2)
        column, row = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        strip = cv2.remap(picture, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        values[first:last] = np.where(known.reshape(x.shape), strip, np.nan)
        known &= np.isfinite(values[first:last]).ravel()
        errors = np.full(len(flat), np.nan)
        errors[known] = pose.compute_sigmas(flat[known], dem_m)
        sigmas[first:last] = errors.reshape(x.shape)
    return values, sigmas


def find_hidden(
    position_m: FloatArray,
    points_m: FloatArray,
    frame: MapFrame,
    ground_m: NDArray[np.float32],
    first: int,
) -> BoolArray:
    """Whether other ground of the map stands before places, seen from a camera; (rows, cols).

    points_m  (rows, cols, 3) of map rows from `first` on;  ground_m  heights of the whole map
    """
    radius = np.linalg.norm(points_m, axis=-1, keepdims=True)
    up, sight = points_m / radius, unit(position_m - points_m)
    rise = (sight * up).sum(axis=-1, keepdims=True)
    level = sight - rise * up
    length = np.maximum(np.linalg.norm(level, axis=-1), 1e-9)
    # how a step of the ground toward the camera goes over the map
    x, y = frame.projection.xy_from_xyz(up * frame.projection.radius_m)
    ahead = up * frame.projection.radius_m + frame.posting_m * level / length[..., None]
    to_x, to_y = frame.projection.xy_from_xyz(ahead)
    steps = np.stack([(y - to_y), (to_x - x)], axis=-1) / frame.posting_m
    slopes = rise[..., 0] / length
    hidden = np.zeros(slopes.shape, np.bool_)
    highest = float(np.max(ground_m, initial=-np.inf, where=np.isfinite(ground_m)))
    scale = frame.posting_m, frame.projection.radius_m
    _mark_hidden(ground_m, first, steps, slopes, highest, scale, hidden)
    return hidden


@kernel
def _mark_hidden(
    ground: NDArray[np.float32],
    first: int,
    steps: FloatArray,
    slopes: FloatArray,
    highest: float,
    scale: tuple[float, float],
    hidden: BoolArray,
) -> None:
    """Follow each line of sight over the map, a pixel at a time, until it is above all ground.

    steps  (rows, cols, 2) map rows and columns that a pixel's length of ground leads to;
    slopes  of the lines of sight at their places;  scale  a pixel's length and the body's radius
    """
    rows, cols = ground.shape
    posting, radius = scale
    for i in range(hidden.shape[0]):
        for j in range(hidden.shape[1]):
            start = ground[first + i, j]
            if not np.isfinite(start):
                continue
            row, col, along = float(first + i), float(j), 0.0
            while True:
                row += steps[i, j, 0]
                col += steps[i, j, 1]
                along += posting
                height = start + along * slopes[i, j] + along * along / (2.0 * radius)
                if height > highest or not (0.0 <= row < rows - 1 and 0.0 <= col < cols - 1):
                    break
                r, c = int(row), int(col)
                v, u = row - r, col - c
                above = (1.0 - v) * ((1.0 - u) * ground[r, c] + u * ground[r, c + 1])
                above += v * ((1.0 - u) * ground[r + 1, c] + u * ground[r + 1, c + 1])
                if along > 1.5 * posting and above > height:
                    hidden[i, j] = True
                    break


def _encode(
    values: NDArray[np.float32], sigmas: NDArray[np.float32], frame: MapFrame, body: Body
) -> bytes:
    centre = math.degrees(frame.projection.lat), math.degrees(frame.projection.lon)
    wkt = format_stereographic_wkt(body.name, "the picture", body.radius_m, centre)
    step = frame.posting_m
    profile = {
        "crs": rasterio.CRS.from_wkt(wkt),
        "transform": Affine(step, 0.0, frame.west_m, 0.0, -step, frame.north_m),
        "nodata": np.nan,
    }
    return encode_geotiff({"counts": values, "horizontal sigma, m": sigmas}, profile)
