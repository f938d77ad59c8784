"""Pictures to hazard maps and pads, as `optnav hazard` does."""

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body
from catalog.errors import DataError, NoSolutionError, UsageError
from catalog.files import hash_file
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.projection import Stereographic
from catalog.inputs import check_input
from catalog.progress import Progress
from catalog.store.reader import Catalog
from catalog.terrain.dem.source import DemSource
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import load_camera
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture, load_frame_picture, load_picture
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
from optnav_cli.output.manifest import output_folder
from optnav_cli.output.run_folder import (
    SOLUTION,
    check_run_picture,
    find_run_pictures,
    read_run,
)

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
    settings = inputs.settings
    check_settings(settings)
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
        look = partial(
            look_down, image, camera, light.height_m, light.elevation_deg, light.azimuth_deg
        )
        frame.mapped = map_hazard(look(), settings, look=look)
    except NoSolutionError as error:
        frame.reason = str(error)
    with output_folder(output, KIND, "hazard", [picture, camera_file], "hazard") as out:
        with HazardOutput(out.path, None, settings, many=False) as maps:
            maps.add(frame)
        out.options = msgspec.to_builtins(settings) | msgspec.to_builtins(light)
        out.inputs = {"picture": picture, "sha256": hash_file(picture), "camera": camera_file.name}
        out.results, out.failure = _count_results([frame]), _explain_no_pad([frame])
    return frame


def map_folder(
    path: Path, inputs: HazardInputs, output: Path, progress: Progress
) -> list[MappedFrame]:
    """Map the hazards of the pictures of a folder by the poses of its frames.csv.

    Raises as `map_picture`; what is wrong with one frame is its reason.
    """
    settings = inputs.settings
    check_settings(settings)
    folder = read_folder(path)
    frames = []
    with ExitStack() as stack:
        ground, _ = _open_ground(inputs, folder.body, stack)
        prior = None if inputs.slopes is None else read_slopes(inputs.slopes, folder.body)
        sources = [path, *inputs.list_files()]
        out = stack.enter_context(output_folder(output, KIND, "hazard", sources, "hazard"))
        bar = stack.enter_context(progress.stage("hazard", len(folder.frames), "picture"))
        many = len(folder.frames) > 1
        with HazardOutput(out.path, folder.body, settings, many=many) as maps:
            for row in folder.frames:
                frame = _map_frame(folder, row, ground, inputs, prior)
                maps.add(frame)
                frames.append(frame.drop_pixels())
                bar.advance()
        out.options = msgspec.to_builtins(settings)
        out.inputs = {"folder": path, "body": folder.settings.body}
        out.inputs |= {named.name: hash_file(named) for named in inputs.list_files()}
        out.results, out.failure = _count_results(frames), _explain_no_pad(frames)
    return frames


def map_run(run: Path, inputs: HazardInputs, output: Path, progress: Progress) -> list[str]:
    """Map the hazards of a navigated run, and carry pads from frame to frame in order of time.

    Each frame's pose is refined by windows of the terrain model and of the frame before. Returns
    one line of text per picture and one about the pads. Raises as `map_picture`, and DataError for
    pictures that are not the run's.
    """
    settings = inputs.settings
    check_settings(settings)
    if inputs.height_m is not None:
        raise UsageError("--height-m is for frames without a terrain model; leave it out of a run")
    pictures, known = find_run_pictures(run, inputs.pictures)
    folder = replace(read_folder(run), path=pictures)
    solved = {solution.file: solution for solution in read_run(run).solutions}
    rows = [row for row in folder.frames if row.file in solved]
    rows.sort(key=lambda row: math.inf if row.tdb_s is None else row.tdb_s)
    frames: list[MappedFrame] = []
    with ExitStack() as stack:
        ground, posting_m = _open_ground(inputs, folder.body, stack)
        prior = _open_prior(inputs, folder.body)
        sources = [run, pictures, *inputs.list_files()]
        out = stack.enter_context(output_folder(output, KIND, "hazard", sources, "hazard"))
        bar = stack.enter_context(progress.stage("hazard", len(rows), "picture"))
        descent = Descent(folder, ground, settings, prior, posting_m)
        with HazardOutput(out.path, folder.body, settings, many=True) as maps:
            for row in rows:
                frame = MappedFrame(row.file, folder.cameras.get(row.camera), None, row)
                try:
                    check_run_picture(pictures, row.file, known)
                    descent.map_frame(frame, solved[row.file])
                except (NoSolutionError, DataError) as error:
                    frame.reason = str(error)
                    log.warning("%s: %s", row.file, error)
                maps.add(frame)
                frames.append(frame.drop_pixels())
                bar.advance()
            maps.add_carried(descent.pads)
        if prior is not None:
            _warn_uncovered(prior, descent)
        out.options = msgspec.to_builtins(settings)
        out.inputs = {"run": run, "pictures": pictures, "body": folder.settings.body}
        out.inputs |= {"solution_sha256": hash_file(run / SOLUTION)}
        out.inputs |= {named.name: hash_file(named) for named in inputs.list_files()}
        out.results = _count_results(frames) | {"carried_pads": len(descent.pads)}
        out.failure = _explain_no_pad(frames)
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
    look = partial(look_from, picture, camera, pose, heights)
    view = look()
    if ground is not None and inputs.height_m is not None:
        height_m = float(view.camera_m[2])
        # --height-m may differ by 20 % from the height of a pose over a terrain model.
        if abs(height_m - inputs.height_m) > 0.2 * inputs.height_m:
            raise NoSolutionError(
                f"--height-m is {inputs.height_m:g} m, by its pose over the terrain model the "
                f"camera is {height_m:.6g} m high; leave --height-m out, or mend the pose",
                "height",
            )
    return map_hazard(view, inputs.settings, prior, look=look)


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


def _count_results(frames: list[MappedFrame]) -> dict[str, Any]:
    mapped = [frame.summary for frame in frames if frame.summary is not None]
    return {
        "pictures": len(frames),
        "mapped": len(mapped),
        "squares": sum(summary.squares for summary in mapped),
        "pads": sum(summary.found for summary in mapped),
        "rocks": sum(summary.rocks for summary in mapped),
    }


def _explain_no_pad(frames: list[MappedFrame]) -> str:
    """Explain why no square has a pad; "" where one has."""
    if any(frame.summary is not None and frame.summary.found for frame in frames):
        return ""
    reasons = list(_list_reasons(frames))
    return f"no square has a pad: {'; '.join(reasons[:3])}" + (" ..." if len(reasons) > 3 else "")


def _list_reasons(frames: list[MappedFrame]) -> Iterator[str]:
    for frame in frames:
        if frame.summary is None:
            yield f"{frame.file}: {frame.reason}"
        else:
            yield f"{frame.file}: {frame.summary.first_reason}"
