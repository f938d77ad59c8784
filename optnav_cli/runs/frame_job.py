"""One frame of a folder: always a row, never a guess."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from catalog.arrays import Float32Array
from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import Matcher
from catalog.correlation.surf64 import match_surf
from catalog.errors import DataError
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import Folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_picture
from optnav_cli.navigation.autonomous import Navigator
from optnav_cli.navigation.control_points.method import TriedPoint
from optnav_cli.solution import MatchRow, OutlineMarks, Solution, unsolved

MATCHERS: dict[str, Matcher] = {"ncc": match_ncc, "surf": match_surf}


@dataclass(frozen=True, eq=False)
class FrameResult:
    """A frame's row, the control points tried, and the picture for recording, where it was read.

    marks  of the body's outline in it, None where none was looked for
    """

    solution: Solution
    matches: list[MatchRow]
    camera: Camera | None
    picture: Float32Array | None
    marks: OutlineMarks | None = None


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


def solve_frame(folder: Folder, frame: Frame, navigator: Navigator) -> FrameResult:
    """Navigate one frame; whatever is wrong with it becomes the reason of an unsolved row."""
    camera = folder.cameras.get(frame.camera)
    picture = None
    try:
        if frame.problem:
            raise DataError(frame.problem)
        if camera is None:
            raise DataError(f"camera '{frame.camera}' is not known")
        picture = load_picture(folder.picture_path(frame), camera)
        answer = navigator.solve(frame, camera, picture)
    except DataError as error:
        values = None if picture is None else picture.values
        return FrameResult(unsolved(frame.file, frame.utc, str(error)), [], camera, values)
    matches = _match_rows(frame.file, answer.tried)
    return FrameResult(answer.solution, matches, camera, picture.values, answer.marks)


def _match_rows(file: str, points: Sequence[TriedPoint]) -> list[MatchRow]:
    return [
        MatchRow(
            file=file,
            cp_id=tried.point.id,
            level=tried.match.level,
            cp_position_m=tried.point.xyz_m,
            predicted_px=tried.predicted_px,
            measured_px=tried.match.pixel,
            score=tried.match.score,
            runner_up=tried.match.runner_up,
            used=tried.used,
            reason=tried.reason,
            sun_elevation_deg=tried.sun_elevation_deg,
            residual_px=tried.residual_px,
            catalog=tried.catalog,
        )
        for tried in points
    ]
