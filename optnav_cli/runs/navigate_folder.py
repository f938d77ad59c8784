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
from optnav_cli.fix import Solution
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
from optnav_cli.runs.frame_job import MATCHERS, in_order, solve_frame

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
        inputs = NavigationInputs(
            points, folder.motion, ground, settings, MATCHERS[matcher], inertial
        )
        copy_inputs(pictures, folder.settings, place)
        solutions = _navigate_frames(folder, inputs, place, progress)
        write_solutions(place / SOLUTION, solutions, folder.attitude)
        matches = [match for row in solutions for match in row.evidence.matches]
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
    folder: Folder, inputs: NavigationInputs, place: Path, progress: Progress
) -> list[Solution]:
    """Rows in the order of frames.csv; the frames are navigated in the order of time."""
    solutions: dict[int, Solution] = {}
    navigator = Navigator(inputs)
    with (
        progress.stage("navigate", len(folder.frames), "frame") as bar,
        Recording(place / RECORDING, folder.body.name) as recording,
    ):
        for number in in_order(folder):
            frame = folder.frames[number]
            row, picture = solve_frame(folder, frame, navigator)
            solutions[number] = row
            camera, evidence = folder.cameras.get(frame.camera), row.evidence
            recording.add_frame(row, evidence.matches, camera, picture, evidence.outline)
            if camera is not None and picture is not None:
                outlines = _patch_outlines(row, camera, inputs.points)
                marks = evidence.outline
                write_overlay(
                    place / OVERLAYS, picture, row, evidence.matches, outlines, marks=marks
                )
            log.log(logging.DEBUG if row.solved else logging.WARNING, "%s", describe(row))
            bar.advance()
    return [solutions[number] for number in sorted(solutions)]


def _drawn_sizes(
    points: ControlPointField, index: int, level: int, camera: Camera, position_m: FloatArray
) -> list[float]:
    """Half sides of the matched patch and of the coarser ones that do not swamp the picture."""
    distance = float(np.linalg.norm(points.xyz_m[index] - position_m))
    across = distance / camera.focal_length_px * camera.width_px
    sizes = points.half_sizes_m(index, level)
    return [s for s in sizes if 2.0 * s <= MAX_OUTLINE * across]


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
        outlines[match.catalog, match.cp_id] = patch_outlines(
            reference.projection,
            float(reference.projection.height_of(reference.point.xyz_m)),
            _drawn_sizes(points, index, match.level, camera, fix.position_m),
            camera,
            fix.position_m,
            fix.camera_from_body,
        )
    return outlines
