"""Navigate a picture folder: every row of frames.csv becomes a row of solution.csv."""

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import cv2
import msgspec
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import Matcher
from catalog.correlation.surf64 import match_surf
from catalog.errors import DataError, NothingToDoError, UsageError
from catalog.files import replacing_folder
from catalog.progress import Progress
from catalog.store.reader import Catalog
from catalog.terrain.relief.relief import GlobalRelief
from catalog.terrain.relief.sums import load_relief
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import NoFix, Solution
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_picture
from optnav_cli.navigation.autonomous import NavigationInputs, Navigator
from optnav_cli.navigation.control_points.field import ControlPointField, PointLayer
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.output.manifest import hash_files, versions, write_manifest
from optnav_cli.output.overlay import patch_outlines, write_overlay
from optnav_cli.output.recording import Recording, describe
from optnav_cli.output.run_folder import MATCHES, OVERLAYS, RECORDING, SOLUTION, copy_inputs
from optnav_cli.output.tables import write_matches, write_solutions
from optnav_cli.reasons import Reason, ReasonCode

log = logging.getLogger(__name__)

MATCHERS: dict[str, Matcher] = {"ncc": match_ncc, "surf": match_surf}
# A patch that takes up more of the picture's width than this is not outlined.
MAX_OUTLINE = 0.2
# What numpy, scipy, OpenCV and the system raise for numbers that no check foresaw, little memory
# or a file that fails: the fault of one frame, and the others go on. A ValueError may also be a bug
# of ours, so its traceback goes to the details of the log.
FRAME_FAULTS = (np.linalg.LinAlgError, ArithmeticError, ValueError, cv2.error, MemoryError, OSError)


def navigate_folder(
    pictures: Path,
    catalog_paths: Sequence[Path],
    settings: NavigateSettings,
    matcher: str,
    run: Path,
    progress: Progress,
    relief: Path | None = None,
) -> list[Solution]:
    """Navigate all frames of a folder and write the run folder in one step.

    catalog_paths  the first given has priority where it has points
    relief         a terrain model of the whole body for the horizon; else the finest relief that
                   a catalog carries
    Returns the rows of solution.csv. Raises NothingToDoError, after the run is written, when no
    frame was solved; DataError or ConfigError when folder or catalog cannot be used at all.
    """
    started = datetime.now(UTC)
    folder = read_folder(pictures, [Path(name) for name in settings.spice.kernels])
    log.info("rotation of the %s and its Sun by %s", folder.body.name, folder.motion.name)
    with open_catalogs(catalog_paths) as catalogs, replacing_folder(run, "run") as place:
        points = open_field(catalogs, folder.body)
        ground = whole_relief(catalogs, relief, folder.body)
        inertial, match = folder.settings.attitude == "camera_from_inertial", MATCHERS[matcher]
        inputs = NavigationInputs(points, folder.motion, ground, settings, match, inertial)
        copy_inputs(pictures, folder.settings, place)
        about = {
            "optnav": versions()["optnav"],
            "command": "navigate",
            "matcher": matcher,
            "body": folder.body.name,
            "relief": Path(ground.source).name if ground else "",
            "motion": folder.motion.name,
            **{f"catalog {catalog.path.name}": catalog.digest for catalog in catalogs},
        }
        solutions = _navigate_frames(folder, inputs, place, about, progress)
        write_solutions(place / SOLUTION, solutions, folder.attitude)
        write_matches(place / MATCHES, (m for row in solutions for m in row.evidence.matches))
        for (_, point_id), reason in points.damaged.items():
            log.warning("control point %d is left out: %s", point_id, reason)
        solved = sum(solution.solved for solution in solutions)
        usable = (frame.file for frame in folder.frames if frame.problem is None)
        names = [*usable, "run.toml", "frames.csv"]
        write_manifest(
            place,
            "run",
            command="navigate",
            options={"matcher": matcher, "config": msgspec.to_builtins(settings)},
            inputs={
                "pictures": str(pictures),
                "files_sha256": hash_files(pictures, names),
                "catalogs": [
                    {"path": str(catalog.path), "digest": catalog.digest} for catalog in catalogs
                ],
                "relief": ground.source if ground else "",
                "motion": folder.motion.name,
            },
            results={"frames": len(solutions), "solved": solved},
            started=started,
        )
    if not solved:
        raise NothingToDoError(
            f"{run}: none of {len(solutions)} frames was solved; the reasons stand in {SOLUTION}, "
            f"the first: {solutions[0].reason}"
        )
    return solutions


@contextmanager
def open_catalogs(paths: Sequence[Path]) -> Iterator[list[Catalog]]:
    """Open catalogs, and close them at the end.

    Raises UsageError for two of one file name, which matches.csv could not tell apart, and
    DataError for a file that is no whole catalog.
    """
    name, count = Counter(path.name for path in paths).most_common(1)[0]
    if count > 1:
        raise UsageError(
            f"--catalog names {count} files called '{name}'; give each catalog a name of its own"
        )
    with ExitStack() as stack:
        yield [stack.enter_context(Catalog.open(path)) for path in paths]


def open_field(catalogs: Sequence[Catalog], body: Body) -> ControlPointField:
    """The usable control points of catalogs, the first given before the others.

    Raises DataError for a catalog of another body or without usable points.
    """
    return ControlPointField([_layer(catalog, body) for catalog in catalogs])


def whole_relief(
    catalogs: Sequence[Catalog], named: Path | None, body: Body
) -> GlobalRelief | None:
    """The body's relief for the horizon: of the named terrain model, else the finest carried one.

    None where there is none. Raises DataError for a damaged one or a model of a part of the body.
    """
    if named is not None:
        return load_relief(str(named), body)
    carried = [relief for c in catalogs if (relief := c.relief()) is not None]
    return min(carried, key=lambda relief: relief.posting_m, default=None)


def in_order(folder: Folder) -> Iterator[int]:
    """Places of the frames in the order to navigate them: by time, the widest camera first.

    A frame whose time is not known stays behind the one before it.
    """
    keys: list[tuple[float, float]] = []
    for frame in folder.frames:
        camera = folder.cameras.get(frame.camera)
        width = 0.0 if camera is None else camera.width_px / camera.focal_length_px
        last = keys[-1][0] if keys else -np.inf
        keys.append((last if frame.tdb_s is None else frame.tdb_s, -width))
    yield from sorted(range(len(keys)), key=lambda place: keys[place])


def solve_frame(
    folder: Folder, frame: Frame, navigator: Navigator
) -> tuple[Solution, Float32Array | None]:
    """Navigate one frame: its row, and its picture where that could be read.

    Whatever is wrong with the frame becomes the reason of an unsolved row.
    """

    def unsolved(code: ReasonCode, text: str) -> Solution:
        return Solution(frame.file, frame.utc, NoFix(Reason(code, text)))

    if frame.problem:
        return unsolved(ReasonCode.BAD_FRAME, frame.problem), None
    camera = folder.cameras.get(frame.camera)
    if camera is None:
        text = f"camera '{frame.camera}' is not known"
        return unsolved(ReasonCode.UNKNOWN_CAMERA, text), None
    code, values = ReasonCode.BAD_PICTURE, None
    try:
        picture = load_picture(folder.picture_path(frame), camera)
        code, values = ReasonCode.BAD_DATA, picture.values
        return navigator.solve(frame, camera, picture), values
    except DataError as error:
        return unsolved(code, str(error)), values
    except FRAME_FAULTS as error:
        text = failure(frame, "numerical failure", error)
        return unsolved(ReasonCode.NUMERICAL_FAILURE, text), values


def failure(frame: Frame, what: str, error: BaseException) -> str:
    """What failed with a frame, in words; the traceback goes to the details of the log."""
    log.debug("%s: %s", frame.file, what, exc_info=error)
    lines = str(error).splitlines()
    return f"{what} ({type(error).__name__}{': ' if lines else ''}{lines[0] if lines else ''})"


def _navigate_frames(
    folder: Folder,
    inputs: NavigationInputs,
    place: Path,
    about: Mapping[str, str],
    progress: Progress,
) -> list[Solution]:
    """Rows in the order of frames.csv; the frames are navigated in the order of time."""
    solutions: dict[int, Solution] = {}
    navigator = Navigator(inputs)
    with (
        progress.stage("navigate", len(folder.frames), "frame") as bar,
        Recording(
            place / RECORDING, folder.body, inputs.relief, sorted(folder.cameras), about
        ) as recording,
    ):
        for number in in_order(folder):
            frame = folder.frames[number]
            row, picture = solve_frame(folder, frame, navigator)
            solutions[number] = row
            camera, evidence = folder.cameras.get(frame.camera), row.evidence
            try:
                recording.add_frame(row, evidence.matches, camera, picture, evidence.outline)
                if camera is not None and picture is not None:
                    outlines, marks = _patch_outlines(row, camera, inputs.points), evidence.outline
                    overlays = place / OVERLAYS
                    write_overlay(overlays, picture, row, evidence.matches, outlines, marks=marks)
            except FRAME_FAULTS as error:
                if isinstance(error, OSError):  # of the output's place
                    raise
                log.warning("%s: %s", frame.file, failure(frame, "cannot be drawn", error))
            log.log(logging.DEBUG if row.solved else logging.WARNING, "%s", describe(row))
            bar.advance()
    return [solutions[number] for number in sorted(solutions)]


def _patch_outlines(
    row: Solution, camera: Camera, points: ControlPointField
) -> dict[tuple[str, int], list[FloatArray]]:
    """Outlines in the picture of the patches that were tried, by catalog and id."""
    fix, outlines = row.fix, {}
    if fix is None or fix.camera_from_body is None:
        return {}
    for match in row.evidence.matches:
        index = points.index_of(match.catalog, match.cp_id)
        reference = points.reference(index)
        if reference is None:
            continue
        distance = float(np.linalg.norm(points.xyz_m[index] - fix.position_m))
        most = MAX_OUTLINE * (distance / camera.focal_length_px * camera.width_px)
        sizes = [s for s in points.half_sizes_m(index, match.level) if 2.0 * s <= most]
        projection = reference.projection
        height = float(projection.height_of(reference.point.xyz_m))
        pose = fix.position_m, fix.camera_from_body
        outlines[match.catalog, match.cp_id] = patch_outlines(
            projection, height, sizes, camera, *pose
        )
    return outlines


def _layer(catalog: Catalog, body: Body) -> PointLayer:
    meta, usable = catalog.meta, catalog.usable
    if meta.body != body.name:
        raise DataError(
            f"{catalog.path}: is a catalog of {meta.body}; the pictures show {body.name}: "
            "name another catalog, or mend `body` in run.toml"
        )
    if not usable.any():
        raise DataError(
            f"{catalog.path}: none of its {len(catalog)} control points is usable; "
            "see `optnav catalog info`"
        )
    return PointLayer(
        catalog.path.name,
        catalog,
        catalog.grid,
        catalog.ids[usable],
        catalog.xyz_m[usable],
        catalog.records["shadow_limit_deg"][usable],
        np.array([meta.posting_m * 2.0**level for level in range(meta.levels)]),
        meta.radius_m,
        meta.planes,
    )
