"""One frame of a run, from its picture to its row and drawings: the piece of work of a worker.

A frame is looked at ahead of time, in any order and any process: the methods answer, and a row is
made as if no frame came before. Then, in the order of time, it is finished: its row is made again
from the same answers with what the frames before say. Mostly nothing changes, and what was drawn
stands.
"""

import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from catalog.arrays import ByteArray, FloatArray
from catalog.bodies.stars import BrightStars, load_bright_stars, read_star_catalog
from catalog.cache import Cache
from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import Matcher
from catalog.correlation.surf64 import match_surf
from catalog.errors import DataError, NoSolutionError
from catalog.jobs.workspace import pack, unpack
from catalog.store.reader import Catalog
from catalog.terrain.dem.file import resolve_path
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.fix import MatchKind, Method, NoFix, Solution
from optnav_cli.frames.folder import FROM_FILE, Folder, read_folder
from optnav_cli.frames.frames import Frame, picture_path
from optnav_cli.frames.picture import LaterPicture, Picture, PictureSizeError, load_frame_picture
from optnav_cli.frames.points import POINTS_CSV, PickedPoint
from optnav_cli.frames.run_settings import RUN_TOML, InertialSettings
from optnav_cli.navigate.answers import (
    Answers,
    FrameRecord,
    FrameTask,
    NavigationInputs,
    pack_row,
    unpack_row,
)
from optnav_cli.navigate.autonomous import Navigator
from optnav_cli.navigate.descent.navigator import DescentNavigator
from optnav_cli.navigate.history import NeedsPastError, UnseenPast
from optnav_cli.navigate.inputs import (
    add_orbit_priors,
    choose_relief,
    list_orbit_files,
    open_catalogs,
    open_field,
    open_ground,
)
from optnav_cli.output.canvas import scale_to_eight_bits
from optnav_cli.output.overlay import encode_overlay, project_patches
from optnav_cli.output.recording import encode_recorded_image
from optnav_cli.output.run_folder import FRAMES
from optnav_cli.points.method import PickedFrames
from optnav_cli.reasons import Reason, ReasonCode
from optnav_cli.stars.sky import SkyView, StarSight, find_star_attitude

STARS = "stars"  # the question of a frame's answers
REMARKS = "remarks on the picture"  # likewise; kept where there are some
MATCHERS: dict[str, Matcher] = {"ncc": match_ncc, "surf": match_surf}
# What numpy, scipy, OpenCV and the system raise for numbers that no check foresaw, little memory
# or a file that fails: the fault of one frame, and the others go on. A ValueError may also be a bug
# of ours, so its traceback goes to the details of the log.
FRAME_FAULTS = (np.linalg.LinAlgError, ArithmeticError, ValueError, cv2.error, MemoryError, OSError)


@dataclass(frozen=True)
class RunInputs:
    """Inputs that a user gives to a run.

    pictures  the picture folder
    catalogs  the first given has priority where it has points; without any the limb alone serves
    matcher   of MATCHERS
    relief    a terrain model of the whole body for the horizon; else the finest relief that a
              catalog carries
    orbit     folder of a fitted orbit: the prior of frames that have none
    """

    pictures: Path
    catalogs: Sequence[Path] = ()
    settings: NavigateSettings = field(default_factory=NavigateSettings)
    matcher: str = "ncc"
    relief: Path | None = None
    orbit: Path | None = None

    @property
    def kernels(self) -> list[Path]:
        """SPICE kernels."""
        return [Path(name) for name in self.settings.spice.kernels]

    def make_absolute(self) -> "RunInputs":
        """Make all paths absolute, for processes that work in another folder."""
        relief = None if self.relief is None else resolve_path(str(self.relief), Path.cwd())
        catalogs = [path.absolute() for path in self.catalogs]
        orbit = None if self.orbit is None else self.orbit.absolute()
        pictures = self.pictures.absolute()
        return replace(self, pictures=pictures, catalogs=catalogs, relief=relief, orbit=orbit)


class FrameWorker:
    """A worker that processes frames; sent to other processes as paths, it opens them there."""

    packages: ClassVar = ("optnav_cli",)  # see `catalog.jobs.cluster`

    def __init__(self, given: RunInputs) -> None:
        self.given = given
        self._opened = ExitStack()
        self._pictures: Cache[str, Picture] = Cache(1)
        self._details = ""
        self._started = 0.0

    def __reduce__(self) -> tuple[object, ...]:
        return FrameWorker, (self.given,)

    def list_files(self) -> list[Path]:
        """List files that a worker elsewhere must see; with those of the folder go its pictures."""
        given = self.given
        folder = [given.pictures / RUN_TOML, given.pictures / FRAMES]
        folder += [path for path in [given.pictures / POINTS_CSV] if path.exists()]
        relief = [] if given.relief is None else [given.relief]
        orbit = [] if given.orbit is None else list_orbit_files(given.orbit)
        catalogue = given.settings.stars.catalogue
        stars = [] if catalogue is None else [Path(catalogue)]
        return [*folder, *given.catalogs, *given.kernels, *relief, *orbit, *stars]

    @cached_property
    def folder(self) -> Folder:
        """The picture folder. Raises DataError for it, and for a wrong catalogue of stars."""
        folder = read_folder(self.given.pictures, self.given.kernels)
        if self.given.settings.stars.catalogue is not None:
            _ = self._stars  # read here, so that a wrong one ends the run before its first frame
        if self.given.orbit is None:
            return folder
        return replace(
            folder, frames=add_orbit_priors(folder.frames, folder.body, self.given.orbit)
        )

    @cached_property
    def catalogs(self) -> list[Catalog]:
        """The catalogs, open until `close`."""
        return self._opened.enter_context(open_catalogs(self.given.catalogs))

    @cached_property
    def inputs(self) -> NavigationInputs:
        """Inputs that all frames are navigated with."""
        given, folder = self.given, self.folder
        points = open_field(self.catalogs, folder.body)
        ground = choose_relief(self.catalogs, given.relief, folder.body)
        inertial, matcher = folder.settings.attitude == "camera_from_inertial", given.matcher
        return NavigationInputs(
            points, folder.motion, ground, given.settings, MATCHERS[matcher], inertial
        )

    @cached_property
    def picked(self) -> PickedFrames:
        """Solver of frames whose points were picked."""
        folder = self.folder
        how = self.given.settings.points.construction
        return PickedFrames(folder.attitude, folder.settings.points.filled, how)

    def find_points(self, frame: Frame) -> Sequence[PickedPoint] | None:
        """Find the points picked in a frame's picture, which take precedence; None for none.

        Without a catalog all frames of a folder with points.csv are solved by these, or not at all.
        """
        points = self.folder.points
        if points is None or (frame.file not in points and self.given.catalogs):
            return None
        return points.get(frame.file, ())

    def make_descent(
        self, track: InertialSettings | None = None, windows_above_m: float | None = None
    ) -> DescentNavigator | None:
        """Make the navigator of a descent; None where the frames are not of one track.

        track  its errors, those of run.toml if None
        windows_above_m  see `DescentNavigator`; that of the settings if None
        """
        folder, track = self.folder, track or self.folder.settings.inertial or None
        if not track:
            return None
        places = [frame.position_m for frame in folder.frames if frame.position_m is not None]
        middle = places[-1] if places else np.array([folder.body.radius_m, 0.0, 0.0])
        ground = open_ground(self.catalogs, folder.body)
        above, beam = windows_above_m, folder.settings.beam.direction
        if above is None:
            above = self.inputs.settings.descent.windows_above_m
        return DescentNavigator(self.inputs, ground, track, middle, above, beam)

    def close(self) -> None:
        """Close the catalogs."""
        self._opened.close()

    def look(self, task: FrameTask) -> FrameRecord:
        """Process all of a frame that needs no other one."""
        self._start_timing()
        answers: Answers = {}
        past = UnseenPast(self.inputs.motion, has_twin=task.has_twin)
        try:
            row, failed = self._make_row(task.frame, Navigator(self.inputs, past), answers)
        except NeedsPastError:
            return self._record(task.frame, answers, None, settled=False)
        return self._record(task.frame, answers, row, settled=failed or not answers)

    def finish(
        self, frame: Frame, navigator: Navigator | DescentNavigator, record: FrameRecord
    ) -> tuple[Solution, FrameRecord]:
        """Finish a frame after those before it: row and record, the same where nothing changed."""
        if record.settled:
            return unpack_row(record.row), record
        self._start_timing(record)
        answers = dict(record.answers)
        row, failed = self._make_row(frame, navigator, answers)
        if pack_row(row) == record.row and answers == record.answers:
            return row, record
        return row, self._record(frame, answers, row, settled=failed, image=record.image)

    def _start_timing(self, before: FrameRecord | None = None) -> None:
        """Start the clock of a frame, or continue it."""
        self._details = before.details if before else ""
        self._started = time.monotonic() - (before.seconds if before else 0.0)

    def _make_row(
        self, frame: Frame, navigator: Navigator | DescentNavigator, answers: Answers
    ) -> tuple[Solution, bool]:
        """Make a frame's row, and whether it stands; what is wrong with it becomes a reason."""
        row, stands = self._solve_frame(frame, navigator, answers)
        return replace(row, attitude_source=_determine_attitude_source(frame, row)), stands

    def _solve_frame(
        self, frame: Frame, navigator: Navigator | DescentNavigator, answers: Answers
    ) -> tuple[Solution, bool]:
        if frame.problem:
            return _make_unsolved(frame, ReasonCode.BAD_FRAME, frame.problem), True
        camera = self.folder.cameras.get(frame.camera)
        if camera is None:
            text = f"camera '{frame.camera}' is not known"
            return _make_unsolved(frame, ReasonCode.UNKNOWN_CAMERA, text), True
        code = ReasonCode.BAD_PICTURE
        try:
            points = self.find_points(frame)
            if points is not None:
                self._check_size(frame, camera)
                return self.picked.solve(frame, camera, points), True
            if not answers and (remarks := self._load_picture(frame, camera).remarks):
                answers[REMARKS] = pack(remarks)
            if frame.camera_from_body is None:
                frame = self._add_star_attitude(frame, camera, answers)
            code = ReasonCode.BAD_DATA
            later = LaterPicture(lambda: self._load_picture(frame, camera))
            return _add_remarks(navigator.solve(frame, camera, later, answers), answers), False
        except NoSolutionError as error:
            return _make_unsolved(frame, ReasonCode(error.code), str(error)), True
        except DataError as error:
            return _make_unsolved(frame, code, str(error)), True
        except FRAME_FAULTS as error:
            text = self._describe_failure("numerical failure", error)
            return _make_unsolved(frame, ReasonCode.NUMERICAL_FAILURE, text), True

    @cached_property
    def _stars(self) -> BrightStars:
        """The catalogue of the config, or the stars that ship. Raises DataError."""
        settings = self.given.settings.stars
        if settings.catalogue is None:
            return load_bright_stars()
        return read_star_catalog(Path(settings.catalogue), settings.epoch)

    def _add_star_attitude(self, frame: Frame, camera: Camera, answers: Answers) -> Frame:
        """Add the attitude by the stars in its picture to a frame without one.

        Raises NoSolutionError where its stars give none.
        """
        if frame.tdb_s is None:
            return frame
        position = frame.position_m
        distance = None if position is None else float(np.linalg.norm(position))
        view = SkyView(self.folder.body, frame.tdb_s, distance, self._stars)
        if STARS not in answers:
            picture = self._load_picture(frame, camera)
            answers[STARS] = pack(
                find_star_attitude(picture.values, picture.saturation, camera, view)
            )
        sight = unpack(answers[STARS], StarSight)
        if sight.camera_from_inertial is None:
            text = f"no attitude: the quaternion is empty, and the stars give none: {sight.reason}"
            raise NoSolutionError(text, ReasonCode.NO_ATTITUDE)
        space = self.folder.attitude.inertial_from_body(frame.tdb_s)
        # only the body's own rotation is common to frames: a boresight plays no part here
        common = self.folder.motion.error_m(frame.tdb_s) / self.folder.body.radius_m
        return replace(
            frame,
            camera_from_body=sight.camera_from_inertial * space,
            attitude_sigma_rad=float(np.hypot(sight.sigma_rad, common)),
            common_sigma_rad=common,
        )

    def _record(
        self,
        frame: Frame,
        answers: Answers,
        row: Solution | None,
        *,
        settled: bool,
        image: bytes = b"",
    ) -> FrameRecord:
        """Make a frame's record with its drawings."""
        packed, overlay, undrawn = b"" if row is None else pack_row(row), b"", ""
        camera = self.folder.cameras.get(frame.camera)
        if camera is not None and not frame.problem:
            try:
                gray, undrawn = self._draw_background(frame, camera)
                image = image or encode_recorded_image(gray, camera)
                if row is not None:
                    outlines = _draw_patch_outlines(row, camera, self.inputs.points)
                    overlay = encode_overlay(gray, row, outlines)
            except DataError:  # its row says so
                pass
            except FRAME_FAULTS as error:
                undrawn = self._describe_failure("cannot be drawn", error)
        seconds = round(time.monotonic() - self._started, 3)
        return FrameRecord(
            answers, packed, settled, image, overlay, undrawn, self._details, seconds
        )

    def _describe_failure(self, what: str, error: BaseException) -> str:
        """Describe a failure; the traceback goes to the details of the log."""
        self._details += "".join(traceback.format_exception(error))
        lines = str(error).splitlines()
        return f"{what} ({type(error).__name__}{': ' if lines else ''}{lines[0] if lines else ''})"

    def _draw_background(self, frame: Frame, camera: Camera) -> tuple[ByteArray, str]:
        """Return the picture a row is drawn on; black where picked points need none.

        Also why a picture that is there is not shown.
        """
        try:
            return scale_to_eight_bits(self._load_picture(frame, camera).values), ""
        except PictureSizeError:
            raise
        except DataError as error:
            if self.find_points(frame) is None:
                raise
            there = picture_path(self.folder.path, frame.file).exists()
            return np.zeros(camera.shape, np.uint8), f"not shown: {error}" if there else ""

    def _check_size(self, frame: Frame, camera: Camera) -> None:
        """Raise DataError where a frame of picked points has a picture of another size.

        Its pixels are not those of the camera. It needs no picture, nor one that can be read.
        """
        try:
            self._load_picture(frame, camera)
        except PictureSizeError:
            raise
        except DataError:
            pass

    def _load_picture(self, frame: Frame, camera: Camera) -> Picture:
        """Load a frame's picture; the last one is cached. Raises DataError."""
        path, file = self.folder.path, frame.file
        return self._pictures.get(file, lambda: load_frame_picture(path, file, camera))


def _add_remarks(row: Solution, answers: Answers) -> Solution:
    """Add the remarks on its picture to a row."""
    if REMARKS not in answers:
        return row
    text = "; ".join(unpack(answers[REMARKS], tuple[str, ...]))
    remark = Reason(ReasonCode.PICTURE_REMARK, text)
    return replace(
        row, outcome=replace(row.outcome, reason=row.outcome.reason.add_sentence(remark))
    )


def look_at(worker: FrameWorker, tasks: Sequence[FrameTask]) -> list[FrameRecord]:
    """Process frames; return their records."""
    return [worker.look(task) for task in tasks]


def order_frames(folder: Folder) -> Iterator[int]:
    """Order the frames to navigate: by time, the widest camera first; yield their indices.

    A frame whose time is not known stays behind the one before it.
    """
    keys: list[tuple[float, float]] = []
    for frame in folder.frames:
        camera = folder.cameras.get(frame.camera)
        width = 0.0 if camera is None else camera.width_px / camera.focal_length_px
        last = keys[-1][0] if keys else -np.inf
        keys.append((last if frame.tdb_s is None else frame.tdb_s, -width))
    yield from sorted(range(len(keys)), key=lambda index: keys[index])


def _determine_attitude_source(frame: Frame, row: Solution) -> str:
    """Determine the source of a solved row's attitude; for a free one, what fixed it."""
    fix = row.fix
    if fix is None or fix.camera_from_body is None:
        return ""
    if frame.camera_from_body is None and fix.method is not Method.PICKED_POINTS:
        return "stars"
    by_points = fix.method in (Method.CONTROL_POINTS, Method.PICKED_POINTS)
    return "points" if by_points and frame.attitude_sigma_rad is None else FROM_FILE


def _make_unsolved(frame: Frame, code: ReasonCode, text: str) -> Solution:
    return Solution(frame.file, frame.utc, NoFix(Reason(code, text)))


def _draw_patch_outlines(
    row: Solution, camera: Camera, points: ControlPointField | None
) -> dict[tuple[str, int], list[FloatArray]]:
    """Draw outlines of the patches that were tried in the picture, by catalog and id."""
    fix, outlines = row.fix, {}
    if fix is None or fix.camera_from_body is None or points is None:
        return {}
    for match in row.evidence.matches:
        if match.kind is not MatchKind.CONTROL_POINT:
            continue
        index = points.index_of(match.catalog, match.cp_id)
        reference = points.reference(index)
        if reference is None:
            continue
        distance = float(np.linalg.norm(points.xyz_m[index] - fix.position_m))
        # A patch wider than a fifth of the picture is not outlined.
        most = 0.2 * (distance / camera.focal_length_px * camera.width_px)
        sizes = [s for s in points.list_half_sizes_m(index, match.level) if 2.0 * s <= most]
        projection = reference.projection
        height = float(projection.height_of(reference.point.xyz_m))
        pose = fix.position_m, fix.camera_from_body
        outlines[match.catalog, match.cp_id] = project_patches(
            projection, height, sizes, camera, *pose
        )
    return outlines
