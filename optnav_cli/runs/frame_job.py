"""One frame of a folder through navigation by control points: always a row, never a guess."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import Matcher
from catalog.correlation.surf64 import match_surf
from catalog.errors import DataError, NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.resection import Pose
from optnav_cli.imagery.folder import Folder
from optnav_cli.imagery.frames import Frame
from optnav_cli.imagery.picture import read_picture
from optnav_cli.matching.picture_pyramid import PicturePyramid
from optnav_cli.navigation.control_points import (
    ControlPointFix,
    TriedPoint,
    UnsolvedFrameError,
    navigate,
)
from optnav_cli.navigation.frame_match import Prior
from optnav_cli.navigation.point_field import ControlPointField
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.solution import MatchRow, Solution, solved, unsolved

METHOD = "control_points"
MATCHERS: dict[str, Matcher] = {"ncc": match_ncc, "surf": match_surf}


@dataclass(frozen=True)
class FrameResult:
    """A frame's row, the control points tried, and the picture for recording, where it was read."""

    solution: Solution
    matches: list[MatchRow]
    camera: Camera | None
    picture: NDArray[np.float32] | None


def solve_frame(
    folder: Folder,
    frame: Frame,
    points: ControlPointField,
    settings: NavigateSettings,
    matcher: Matcher,
) -> FrameResult:
    """Navigate one frame; whatever is wrong with it becomes the reason of an unsolved row."""
    camera = folder.cameras.get(frame.camera)
    picture: NDArray[np.float32] | None = None
    try:
        if frame.problem:
            raise DataError(frame.problem)
        if camera is None:
            raise DataError(f"camera '{frame.camera}' is not known")
        picture = read_picture(folder.picture_path(frame), camera)
        prior, sun_body = _prior(frame)
        fix = navigate(PicturePyramid(picture), camera, prior, sun_body, points, settings, matcher)
    except DataError as error:
        return FrameResult(unsolved(frame.file, frame.utc, str(error)), [], camera, picture)
    except UnsolvedFrameError as error:
        matches = [_match_row(frame.file, tried) for tried in error.tried]
        believed = sum(not tried.match.reason for tried in error.tried)
        row = unsolved(
            frame.file,
            frame.utc,
            str(error),
            method=METHOD,
            n_predicted=len(error.tried),
            n_matched=believed,
            n_used=0,
        )
        return FrameResult(row, matches, camera, picture)
    except NoSolutionError as error:
        return FrameResult(unsolved(frame.file, frame.utc, str(error)), [], camera, picture)
    return FrameResult(
        _solved_row(frame, fix), [_match_row(frame.file, t) for t in fix.tried], camera, picture
    )


def _prior(frame: Frame) -> tuple[Prior, NDArray[np.float64]]:
    """What the frame's row says of pose and Sun. Raises NoSolutionError for what it must say."""
    if frame.camera_from_body is None:
        raise NoSolutionError("no attitude: the quaternion is empty")
    if frame.position_m is None or frame.position_sigma_m is None:
        raise NoSolutionError("no prior: the position is empty")
    if frame.sun_body is None:
        raise NoSolutionError("no direction to the Sun")
    pose = Pose(frame.position_m, frame.camera_from_body)
    return Prior.even(pose, frame.position_sigma_m, frame.attitude_sigma_rad), frame.sun_body


def _solved_row(frame: Frame, fix: ControlPointFix) -> Solution:
    resection = fix.solution.resection
    used = [t.residual_px for t in fix.tried if t.used and t.residual_px is not None]
    rms = float(np.sqrt(np.mean(np.square(used)))) if used else None
    return solved(
        frame.file,
        frame.utc,
        METHOD,
        resection.pose.position_m,
        resection.position_covariance_m2,
        resection.pose.camera_from_body,
        resection.attitude_sigma_rad,
        n_predicted=len(fix.tried),
        n_matched=sum(not tried.match.reason for tried in fix.tried),
        n_used=len(used),
        residual_rms_px=rms,
        reason=fix.remark,
    )


def _match_row(file: str, tried: TriedPoint) -> MatchRow:
    return MatchRow(
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
