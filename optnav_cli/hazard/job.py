"""Pictures to hazard maps and pads, as `optnav hazard` does."""

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import DataError, NoSolutionError, NothingToDoError, UsageError
from catalog.files import hash_file, replace_folder
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.projection import Stereographic
from catalog.inputs import check_input
from catalog.places import check_apart
from catalog.progress import Progress, log_stage
from catalog.store.reader import Catalog
from catalog.terrain.dem.source import DemSource
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.frames import Frame, picture_path
from optnav_cli.frames.picture import Picture, load_frame_picture, load_picture
from optnav_cli.frames.run_settings import RUN_TOML, read_run_settings
from optnav_cli.hazard.descent import Descent
from optnav_cli.hazard.ground_view import Heights, KnownPose, look_down, look_from
from optnav_cli.hazard.hazard_map import (
    HazardMap,
    PriorSlopes,
    check_settings,
    map_hazard,
    measure_prior,
    read_slopes,
)
from optnav_cli.hazard.output import HazardOutput, MappedFrame
from optnav_cli.hazard.settings import KIND, OPTIONS, HazardSettings, load_settings
from optnav_cli.output.manifest import read_manifest, write_manifest
from optnav_cli.output.run_folder import SOLUTION, read_run

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StatedLight:
    """A picture without a pose: height over the ground and where the Sun stands.

    azimuth_deg  clockwise from the picture's upper edge
    """

    height_m: float
    elevation_deg: float
    azimuth_deg: float


@dataclass(frozen=True)
class HazardInputs:
    """Inputs of a hazard map other than the pictures.

    catalog, dem  heights of the ground: one of them, or none
    height_m      over the ground, where neither is named
    nodata        stored value of pixels of `dem` without data; None: as the file says
    """

    settings: HazardSettings
    slopes: Path | None = None
    catalog: Path | None = None
    dem: Path | None = None
    height_m: float | None = None
    nodata: float | None = None
    pictures: Path | None = None

    def list_files(self) -> list[Path]:
        return [path for path in (self.slopes, self.catalog, self.dem) if path is not None]


def map_pictures(
    pictures: Path,
    output: Path,
    config: Path | None,
    camera: Path | None,
    given: Mapping[str, Any],
    progress: Progress,
) -> list[str]:
    """Run `optnav hazard` with its options; return one line of text per picture.

    Raises UsageError for options that do not go together, and as the functions below.
    """
    options = dict(given)
    settings = load_settings(config, {key: options.pop(key) for key in OPTIONS})
    sun = options.pop("sun_elevation_deg"), options.pop("sun_azimuth_deg")
    inputs = HazardInputs(settings, **options)
    alone = {"--camera": camera, "--sun-elevation-deg": sun[0], "--sun-azimuth-deg": sun[1]}
    if pictures.is_dir():
        for name, value in alone.items():
            if value is not None:
                raise UsageError(
                    f"{name} is for a single picture; {pictures} is a folder, whose files say it"
                )
        if (pictures / SOLUTION).is_file():
            return map_run(pictures, inputs, output, progress)
        if inputs.pictures is not None:
            raise UsageError(
                f"--pictures is for a run; {pictures} has no {SOLUTION}, and its pictures lie in it"
            )
        return _describe_results(map_folder(pictures, inputs, output, progress))
    check_input(pictures, "picture", "name a picture, or a folder of them")
    for name, value in {**alone, "--height-m": inputs.height_m}.items():
        if value is None:
            raise UsageError(f"{pictures} is no folder: a single picture needs {name}, too")
    light = StatedLight(float(inputs.height_m or 0.0), float(sun[0] or 0.0), float(sun[1] or 0.0))
    return _describe_results([map_picture(pictures, Path(str(camera)), light, inputs, output)])


def _describe_results(frames: list[MappedFrame]) -> list[str]:
    return [
        f"{frame.file}: {frame.reason}"
        if frame.summary is None
        else f"{frame.file}: pads in {frame.summary.found} of {frame.summary.squares} squares"
        for frame in frames
    ]


def map_picture(
    picture: Path, camera_file: Path, light: StatedLight, inputs: HazardInputs, output: Path
) -> MappedFrame:
    """Map the hazards of one picture whose camera looks straight down.

    Raises DataError for files that cannot be used, NothingToDoError without a pad in any square;
    the output folder is written then, too.
    """
    started = datetime.now(UTC)
    settings = inputs.settings
    check_settings(settings)
    check_apart(output, [picture, camera_file])
    for path in inputs.list_files():
        raise UsageError(
            f"{path}: needs a place on the body; a single picture has none: give a "
            "folder whose frames have poses"
        )
    camera = load_camera(camera_file)
    image = load_picture(picture, camera)
    frame = MappedFrame(picture.name, camera, image)
    for remark in image.remarks:
        log.warning("%s", remark)
    try:
        view = look_down(image, camera, light.height_m, light.elevation_deg, light.azimuth_deg)
        frame.mapped = map_hazard(view, settings)
    except NoSolutionError as error:
        frame.reason = str(error)
    origin = {"picture": picture, "sha256": hash_file(picture), "camera": camera_file.name}
    options = msgspec.to_builtins(settings) | msgspec.to_builtins(light)
    with log_stage("hazard"), replace_folder(output, KIND) as partial:
        with HazardOutput(partial, None, settings, many=False) as out:
            out.add(frame)
        write_manifest(
            partial, KIND, command="hazard", options=options, inputs=origin,
            results=_count_results([frame]), started=started,
        )  # fmt: skip
    _check_found([frame])
    return frame


def map_folder(
    path: Path, inputs: HazardInputs, output: Path, progress: Progress
) -> list[MappedFrame]:
    """Map the hazards of the pictures of a folder by the poses of its frames.csv.

    Raises as `map_picture`; what is wrong with one frame is its reason.
    """
    started = datetime.now(UTC)
    settings = inputs.settings
    check_settings(settings)
    check_apart(output, [path, *inputs.list_files()])
    folder = read_folder(path)
    frames = []
    with ExitStack() as stack:
        ground, _ = _open_ground(inputs, folder.body, stack)
        prior = None if inputs.slopes is None else read_slopes(inputs.slopes, folder.body)
        stack.enter_context(log_stage("hazard"))
        partial = stack.enter_context(replace_folder(output, KIND))
        bar = stack.enter_context(progress.stage("hazard", len(folder.frames), "picture"))
        many = len(folder.frames) > 1
        with HazardOutput(partial, folder.body, settings, many=many) as out:
            for row in folder.frames:
                frame = _map_frame(folder, row, ground, inputs, prior)
                out.add(frame)
                frames.append(frame.drop_pixels())
                bar.advance()
        origin: dict[str, object] = {"folder": path, "body": folder.settings.body}
        origin |= {named.name: hash_file(named) for named in inputs.list_files()}
        write_manifest(
            partial, KIND, command="hazard", options=msgspec.to_builtins(settings), inputs=origin,
            results=_count_results(frames), started=started,
        )  # fmt: skip
    _check_found(frames)
    return frames


def map_run(run: Path, inputs: HazardInputs, output: Path, progress: Progress) -> list[str]:
    """Map the hazards of a navigated run, and carry pads from frame to frame in order of time.

    Each frame's pose is refined by windows of the terrain model and of the frame before. Returns
    one line of text per picture and one about the pads. Raises as `map_picture`, and DataError for
    pictures that are not the run's.
    """
    started = datetime.now(UTC)
    settings = inputs.settings
    check_settings(settings)
    if inputs.height_m is not None:
        raise UsageError("--height-m is for frames without a terrain model; leave it out of a run")
    pictures, known = _find_pictures(run, inputs.pictures)
    check_apart(output, [run, pictures, *inputs.list_files()])
    folder = replace(read_folder(run), path=pictures)
    solved = {solution.file: solution for solution in read_run(run).solutions}
    rows = [row for row in folder.frames if row.file in solved]
    rows.sort(key=lambda row: math.inf if row.tdb_s is None else row.tdb_s)
    frames: list[MappedFrame] = []
    with ExitStack() as stack:
        ground, posting_m = _open_ground(inputs, folder.body, stack)
        prior = _open_prior(inputs, folder.body)
        stack.enter_context(log_stage("hazard"))
        partial = stack.enter_context(replace_folder(output, KIND))
        bar = stack.enter_context(progress.stage("hazard", len(rows), "picture"))
        descent = Descent(folder, ground, settings, prior, posting_m)
        with HazardOutput(partial, folder.body, settings, many=True) as out:
            for row in rows:
                frame = MappedFrame(row.file, folder.cameras.get(row.camera), None, row)
                try:
                    _check_picture(pictures, row.file, known)
                    descent.map_frame(frame, solved[row.file])
                except (NoSolutionError, DataError) as error:
                    frame.reason = str(error)
                    log.warning("%s: %s", row.file, error)
                out.add(frame)
                frames.append(frame.drop_pixels())
                bar.advance()
            out.add_carried(descent.pads)
        if prior is not None:
            _warn_uncovered(prior, descent)
        origin: dict[str, object] = {"run": run, "pictures": pictures, "body": folder.settings.body}
        origin |= {"solution_sha256": hash_file(run / SOLUTION)}
        origin |= {named.name: hash_file(named) for named in inputs.list_files()}
        results = _count_results(frames) | {"carried_pads": len(descent.pads)}
        write_manifest(
            partial, KIND, command="hazard", options=msgspec.to_builtins(settings), inputs=origin,
            results=results, started=started,
        )  # fmt: skip
    _check_found(frames)
    return [*_describe_results(frames), descent.describe()]


def _warn_uncovered(prior: PriorSlopes, descent: Descent) -> None:
    """Warn of carried pads that the slope map does not cover."""
    missed = [
        str(pad.number)
        for pad in descent.pads
        if not math.isfinite(pad.shares.get("prior_slope_deg", math.nan))
    ]
    if missed:
        log.warning(
            "%s: does not cover %d of %d pads (%s); their slopes are from brightness alone: name a "
            "map that covers them",
            prior.path, len(missed), len(descent.pads), ", ".join(missed[:5]),
        )  # fmt: skip


def _find_pictures(run: Path, pictures: Path | None) -> tuple[Path, dict[str, str | None]]:
    """Find the folder of a run's pictures, and their hashes by name."""
    inputs = read_manifest(run).get("inputs")
    inputs = inputs if isinstance(inputs, dict) else {}
    hashes = inputs.get("files_sha256")
    if pictures is None:
        named = inputs.get("pictures")
        if not isinstance(named, str) or not Path(named).is_dir():
            raise DataError(
                f"{run}: its pictures are not in {named or 'any folder that it names'}; name their "
                "folder with --pictures"
            )
        pictures = Path(named)
    if not pictures.is_dir():
        raise DataError(f"{pictures}: there is no such folder; wanted that of the run's pictures")
    if (pictures / RUN_TOML).is_file():
        body, stated = (read_run_settings(at / RUN_TOML)[1].name for at in (run, pictures))
        if body != stated:
            raise DataError(
                f"{pictures}: its pictures show {stated}, {run} is a run at {body}; name the "
                "folder that the run was made from"
            )
    return pictures, hashes if isinstance(hashes, dict) else {}


def _check_picture(pictures: Path, file: str, known: Mapping[str, str | None]) -> None:
    """Raise DataError for a picture that is not the one that the run solved."""
    wanted = known.get(file)
    path = picture_path(pictures, file)
    if wanted is not None and path.is_file() and hash_file(path) != wanted:
        raise DataError(
            f"{path}: is not the picture that the run was made from (another SHA-256); name the "
            "folder of the run's pictures with --pictures"
        )


def _open_prior(inputs: HazardInputs, body: Body) -> PriorSlopes | None:
    """Open the slope map, or take the slopes of the terrain model on its own postings."""
    if inputs.slopes is not None:
        return read_slopes(inputs.slopes, body)
    return None if inputs.dem is None else measure_prior(inputs.dem, body, inputs.nodata)


def _map_frame(
    folder: Folder,
    row: Frame,
    ground: Heights | None,
    inputs: HazardInputs,
    prior: PriorSlopes | None,
) -> MappedFrame:
    """Map the hazards of one frame, or give the reason why not."""
    camera = folder.cameras.get(row.camera)
    frame = MappedFrame(row.file, camera, None, row)
    try:
        if row.problem or camera is None:
            raise NoSolutionError(row.problem or f"there is no camera '{row.camera}'", "bad_row")
        frame.picture = load_frame_picture(folder.path, row.file, camera)
        for remark in frame.picture.remarks:
            log.warning("%s", remark)
        frame.mapped = _map_pose(folder, row, camera, frame.picture, ground, inputs, prior)
    except (NoSolutionError, DataError) as error:
        frame.reason = str(error)
        log.warning("%s: %s", row.file, error)
    return frame


def _map_pose(
    folder: Folder,
    row: Frame,
    camera: Camera,
    picture: Picture,
    ground: Heights | None,
    inputs: HazardInputs,
    prior: PriorSlopes | None,
) -> HazardMap:
    if row.position_m is None or row.camera_from_body is None or row.sun_body is None:
        raise NoSolutionError(
            "frames.csv has no position or attitude for it; fill them in, or take it alone with "
            "--height-m, --sun-elevation-deg and --sun-azimuth-deg",
            "no_pose",
        )
    pose = KnownPose(row.position_m, row.camera_from_body, row.sun_body, folder.body.radius_m)
    above = float(np.linalg.norm(row.position_m)) - pose.radius_m
    heights: Heights | float = 0.0 if ground is None else ground
    if ground is None and inputs.height_m is not None:
        heights = above - inputs.height_m
    view = look_from(picture, camera, pose, heights)
    if ground is not None and inputs.height_m is not None:
        height_m = float(view.camera_m[2])
        # --height-m may differ by 20 % from the height of a pose over a terrain model.
        if abs(height_m - inputs.height_m) > 0.2 * inputs.height_m:
            raise NoSolutionError(
                f"--height-m is {inputs.height_m:g} m, by its pose over the terrain model the "
                f"camera is {height_m:.6g} m high; leave --height-m out, or mend the pose",
                "height",
            )
    return map_hazard(view, inputs.settings, prior)


def _open_ground(
    inputs: HazardInputs, body: Body, stack: ExitStack
) -> tuple[Heights | None, float | None]:
    """Open the named model or catalog: heights of the ground above the body's sphere.

    Also returns the posting of a terrain model, m.
    """
    if inputs.dem is not None and inputs.catalog is not None:
        raise UsageError("--dem and --catalog both give heights of the ground; name one of them")
    if inputs.dem is None and inputs.nodata is not None:
        raise UsageError("--nodata is of a terrain model; name one with --dem")
    if inputs.dem is not None:
        source = DemSource.open_alone(inputs.dem, body, inputs.nodata)
        stack.callback(source.close)
        return lambda lat, lon: source.heights_at(lat, lon).astype(np.float64), source.posting_m
    if inputs.catalog is not None:
        catalog = stack.enter_context(Catalog.open(inputs.catalog))
        if catalog.meta.body != body.name or catalog.meta.planes is not None:
            raise DataError(
                f"{inputs.catalog}: is no catalog of {body.name} on its sphere; name another one"
            )
        return lambda lat, lon: _sample_catalog(catalog, lat, lon), None
    return None, None


def _sample_catalog(catalog: Catalog, lat: FloatArray, lon: FloatArray) -> FloatArray:
    """Sample heights at latitudes and longitudes (rad) from the nearest point's finest patches."""
    lat, lon = np.asarray(lat), np.asarray(lon)
    middle = float(np.degrees(lat.mean())), float(np.degrees(lon.ravel()[lon.size // 2]))
    point = catalog.point(catalog.nearest(*middle))
    radius = catalog.meta.radius_m
    x, y = Stereographic.xy_from_latlon(point.projection(radius), lat, lon)
    sampled = np.full(lat.shape, np.nan)
    for patch in reversed(catalog.patches(point.id)):
        half = 0.5 * (patch.size - 1)
        heights = sample_bicubic(
            patch.heights_m, half - y / patch.posting_m, half + x / patch.posting_m
        )
        sampled = np.where(np.isfinite(heights), heights, sampled)
    return sampled


def _count_results(frames: list[MappedFrame]) -> dict[str, object]:
    mapped = [frame.summary for frame in frames if frame.summary is not None]
    return {
        "pictures": len(frames),
        "mapped": len(mapped),
        "squares": sum(summary.squares for summary in mapped),
        "pads": sum(summary.found for summary in mapped),
    }


def _check_found(frames: list[MappedFrame]) -> None:
    if any(frame.summary is not None and frame.summary.found for frame in frames):
        return
    reasons = list(_list_reasons(frames))
    raise NothingToDoError(
        f"no square has a pad: {'; '.join(reasons[:3])}" + (" ..." if len(reasons) > 3 else "")
    )


def _list_reasons(frames: list[MappedFrame]) -> Iterator[str]:
    for frame in frames:
        if frame.summary is None:
            yield f"{frame.file}: {frame.reason}"
        else:
            yield f"{frame.file}: {frame.summary.first_reason}"
