"""Navigate a picture folder: every row of frames.csv becomes a row of solution.csv."""

import logging
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.errors import NothingToDoError
from catalog.files import replacing_folder
from catalog.progress import Progress
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.navigation.autonomous import NavigationInputs, Navigator
from optnav_cli.navigation.control_points.field import ControlPointField
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.output.manifest import hash_files, write_manifest
from optnav_cli.output.overlay import patch_outlines, write_overlay
from optnav_cli.output.recording import Recording, describe
from optnav_cli.output.run_folder import MATCHES, OVERLAYS, RECORDING, SOLUTION, copy_inputs
from optnav_cli.output.tables import write_matches, write_solutions
from optnav_cli.runs.catalogs import open_field, opened, whole_relief
from optnav_cli.runs.frame_job import MATCHERS, FrameResult, in_order, solve_frame
from optnav_cli.solution import MatchRow, Solution

log = logging.getLogger(__name__)


# A patch that takes up more of the picture's width than this is not outlined.
MAX_OUTLINE = 0.2


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
    with opened(catalog_paths) as catalogs, replacing_folder(run, "run") as place:
        points = open_field(catalogs, folder)
        ground = whole_relief(catalogs, relief, folder)
        inertial = folder.settings.attitude == "camera_from_inertial"
        world = NavigationInputs(
            points, folder.motion, ground, settings, MATCHERS[matcher], inertial
        )
        copy_inputs(pictures, folder.settings, place)
        solutions, matches = _navigate_frames(folder, world, place, progress)
        write_solutions(place / SOLUTION, solutions, folder.attitude)
        write_matches(place / MATCHES, matches)
        for (_, point_id), reason in points.damaged.items():
            log.warning("control point %d is left out: %s", point_id, reason)
        solved = sum(solution.solved for solution in solutions)
        names = [*(frame.file for frame in folder.frames), "run.toml", "frames.csv"]
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


def _navigate_frames(
    folder: Folder, world: NavigationInputs, place: Path, progress: Progress
) -> tuple[list[Solution], list[MatchRow]]:
    """Rows in the order of frames.csv; the frames are navigated in the order of time."""
    solutions: dict[int, Solution] = {}
    matches: dict[int, list[MatchRow]] = {}
    navigator = Navigator(world)
    with (
        progress.stage("navigate", len(folder.frames), "frame") as bar,
        Recording(place / RECORDING, folder.body.name) as recording,
    ):
        for number in in_order(folder):
            result = solve_frame(folder, folder.frames[number], navigator)
            solutions[number] = result.solution
            matches[number] = result.matches
            recording.add_frame(
                result.solution, result.matches, result.camera, result.picture, result.marks
            )
            if result.picture is not None:
                _draw(place / OVERLAYS, result, world.points)
            level = logging.DEBUG if result.solution.solved else logging.WARNING
            log.log(level, "%s", describe(result.solution))
            bar.advance()
    rows = [match for number in sorted(matches) for match in matches[number]]
    return [solutions[number] for number in sorted(solutions)], rows


def _drawn_sizes(
    points: ControlPointField, index: int, level: int, camera: Camera, position_m: FloatArray
) -> list[float]:
    """Half sides of the matched patch and of the coarser ones that do not swamp the picture."""
    distance = float(np.linalg.norm(points.xyz_m[index] - position_m))
    across = distance / camera.focal_length_px * camera.width_px
    sizes = points.half_sizes_m(index, level)
    return [s for s in sizes if 2.0 * s <= MAX_OUTLINE * across]


def _draw(place: Path, result: FrameResult, points: ControlPointField) -> None:
    if result.picture is None:
        return
    solution = result.solution
    outlines = {}
    if (
        result.camera is not None
        and solution.position_m is not None
        and solution.camera_from_body is not None
    ):
        for match in result.matches:
            index = points.index_of(match.catalog, match.cp_id)
            reference = points.reference(index)
            if reference is None:
                continue
            outlines[match.catalog, match.cp_id] = patch_outlines(
                reference.projection,
                float(reference.projection.height_of(reference.point.xyz_m)),
                _drawn_sizes(points, index, match.level, result.camera, solution.position_m),
                result.camera,
                solution.position_m,
                solution.camera_from_body,
            )
    write_overlay(place, result.picture, solution, result.matches, outlines, marks=result.marks)
