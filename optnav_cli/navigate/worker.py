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
from typing import Any, ClassVar

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
from optnav_cli.frames.folder import Folder, read_folder
from optnav_cli.frames.frames import Frame, picture_path
from optnav_cli.frames.observation import FROM_FILE
from optnav_cli.frames.picture import LaterPicture, Picture, PictureSizeError, load_frame_picture
from optnav_cli.frames.points import POINTS_CSV, PickedPoint
from optnav_cli.frames.run_settings import RUN_TOML, InertialSettings
from optnav_cli.navigate.answers import Answers, NavigationInputs, Outcome
from optnav_cli.navigate.autonomous import Navigator
from optnav_cli.navigate.descent.navigator import DescentNavigator
from optnav_cli.navigate.history import NeedsPastError, UnseenPast
from optnav_cli.navigate.inputs import open_catalogs, open_field, open_ground, whole_relief
from optnav_cli.navigate.orbit_prior import orbit_inputs, with_orbit
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
# A patch that takes up more of the picture's width than this is not outlined.
MAX_OUTLINE = 0.2
# What numpy, scipy, OpenCV and the system raise for numbers that no check foresaw, little memory
# or a file that fails: the fault of one frame, and the others go on. A ValueError may also be a bug
# of ours, so its traceback goes to the details of the log.
FRAME_FAULTS = (np.linalg.LinAlgError, ArithmeticError, ValueError, cv2.error, MemoryError, OSError)


@dataclass(frozen=True)
class FrameTask:
    """A frame to look at; has_twin: a frame before it is of the same time."""

    frame: Frame
    has_twin: bool


@dataclass(frozen=True)
class FrameRecord:
    """What is kept of a frame.

    answers  of the methods
    row      as `packed_row` makes it; empty where the frames before must be known
    settled  whether the row is the same whatever they say
    image    the picture as it is recorded;  overlay: drawn for this row;  empty for none
    undrawn  why they are not there, if they should be
    details  the traceback of what failed, for the log
    seconds  that were spent on the frame
    """

    answers: Answers
    row: bytes
    settled: bool
    image: bytes
    overlay: bytes
    undrawn: str
    details: str
    seconds: float


def packed_row(row: Solution) -> bytes:
    """A row of solution.csv with its evidence as bytes."""
    outcome = Outcome.of(row.outcome)
    return pack((row.file, row.utc, outcome, row.prior, row.prior_m, row.attitude_source))


def unpacked_row(data: bytes) -> Solution:
    """The row that `packed_row` was given."""
    kinds: Any = tuple[str, str, Outcome, str, FloatArray | None, str]
    file, utc, outcome, prior, prior_m, source = unpack(data, kinds)
    return Solution(file, utc, outcome.value, prior, prior_m, source)


@dataclass(frozen=True)
class RunInputs:
    """What a user gives to a run.

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

    def absolute(self) -> "RunInputs":
        """The same for processes that work in another folder."""
        relief = None if self.relief is None else resolve_path(str(self.relief), Path.cwd())
        catalogs = [path.absolute() for path in self.catalogs]
        orbit = None if self.orbit is None else self.orbit.absolute()
        pictures = self.pictures.absolute()
        return replace(self, pictures=pictures, catalogs=catalogs, relief=relief, orbit=orbit)


class FrameWorker:
    """Looks at frames and finishes them; sent to other processes as paths, it opens them there."""

    packages: ClassVar = ("optnav_cli",)  # see `catalog.jobs.cluster_node`

    def __init__(self, given: RunInputs) -> None:
        self.given = given
        self._opened = ExitStack()
        self._pictures: Cache[str, Picture] = Cache(1)
        self._details = ""
        self._started = 0.0

    def __reduce__(self) -> tuple[object, ...]:
        return FrameWorker, (self.given,)

    def files(self) -> list[Path]:
        """Files that a worker elsewhere must see; with those of the folder go its pictures."""
        given = self.given
        folder = [given.pictures / RUN_TOML, given.pictures / FRAMES]
        folder += [path for path in [given.pictures / POINTS_CSV] if path.exists()]
        relief = [] if given.relief is None else [given.relief]
        orbit = [] if given.orbit is None else orbit_inputs(given.orbit)
        own = given.settings.stars.catalogue
        stars = [] if own is None else [Path(own)]
        return [*folder, *given.catalogs, *given.kernels, *relief, *orbit, *stars]

    @cached_property
    def folder(self) -> Folder:
        """The picture folder. Raises DataError for it, and for a wrong catalogue of stars."""
        folder = read_folder(self.given.pictures, self.given.kernels)
        if self.given.settings.stars.catalogue is not None:
            _ = self._stars  # read here, so that a wrong one ends the run before its first frame
        if self.given.orbit is None:
            return folder
        return replace(folder, frames=with_orbit(folder.frames, folder.body, self.given.orbit))

    @cached_property
    def catalogs(self) -> list[Catalog]:
        """The catalogs, open until `close`."""
        return self._opened.enter_context(open_catalogs(self.given.catalogs))

    @cached_property
    def inputs(self) -> NavigationInputs:
        """What frames are navigated by."""
        given, folder = self.given, self.folder
        points = open_field(self.catalogs, folder.body)
        ground = whole_relief(self.catalogs, given.relief, folder.body)
        inertial, matcher = folder.settings.attitude == "camera_from_inertial", given.matcher
        return NavigationInputs(
            points, folder.motion, ground, given.settings, MATCHERS[matcher], inertial
        )

    @cached_property
    def picked(self) -> PickedFrames:
        """What solves frames whose points were picked."""
        folder = self.folder
        how = self.given.settings.points.construction
        return PickedFrames(folder.attitude, folder.settings.points.filled, how)

    def points_of(self, frame: Frame) -> Sequence[PickedPoint] | None:
        """The points picked in a frame's picture, which then lead; None: it is navigated without.

        Without a catalog all frames of a folder with points.csv are solved by these, or not at all.
        """
        points = self.folder.points
        if points is None or (frame.file not in points and self.given.catalogs):
            return None
        return points.get(frame.file, ())

    def descent(
        self, track: InertialSettings | None = None, windows_above_m: float = 0.0
    ) -> DescentNavigator | None:
        """What flies the folder as a descent; None where its frames are not of one track.

        track  its errors, those of run.toml if None;  windows_above_m  see `DescentNavigator`
        """
        folder, track = self.folder, track or self.folder.settings.inertial or None
        if not track:
            return None
        places = [frame.position_m for frame in folder.frames if frame.position_m is not None]
        middle = places[-1] if places else np.array([folder.body.radius_m, 0.0, 0.0])
        ground = open_ground(self.catalogs, folder.body)
        return DescentNavigator(self.inputs, ground, track, middle, windows_above_m)

    def close(self) -> None:
        """Close the catalogs."""
        self._opened.close()

    def look(self, task: FrameTask) -> FrameRecord:
        """All of a frame that needs no other one."""
        self._begin()
        answers: Answers = {}
        past = UnseenPast(self.inputs.motion, has_twin=task.has_twin)
        try:
            row, failed = self._row(task.frame, Navigator(self.inputs, past), answers)
        except NeedsPastError:
            return self._record(task.frame, answers, None, settled=False)
        return self._record(task.frame, answers, row, settled=failed or not answers)

    def finish(
        self, frame: Frame, navigator: Navigator | DescentNavigator, record: FrameRecord
    ) -> tuple[Solution, FrameRecord]:
        """A frame's row after those before it, and its record, the same where nothing changed."""
        if record.settled:
            return unpacked_row(record.row), record
        self._begin(record)
        answers = dict(record.answers)
        row, failed = self._row(frame, navigator, answers)
        if packed_row(row) == record.row and answers == record.answers:
            return row, record
        return row, self._record(frame, answers, row, settled=failed, image=record.image)

    def _begin(self, before: FrameRecord | None = None) -> None:
        """Begin with a frame, or go on with it."""
        self._details = before.details if before else ""
        self._started = time.monotonic() - (before.seconds if before else 0.0)

    def _row(
        self, frame: Frame, navigator: Navigator | DescentNavigator, answers: Answers
    ) -> tuple[Solution, bool]:
        """A frame's row, and whether it stands; what is wrong with it becomes a reason."""
        row, stands = self._answered(frame, navigator, answers)
        return replace(row, attitude_source=_attitude_source(frame, row)), stands

    def _answered(
        self, frame: Frame, navigator: Navigator | DescentNavigator, answers: Answers
    ) -> tuple[Solution, bool]:
        if frame.problem:
            return _unsolved(frame, ReasonCode.BAD_FRAME, frame.problem), True
        camera = self.folder.cameras.get(frame.camera)
        if camera is None:
            text = f"camera '{frame.camera}' is not known"
            return _unsolved(frame, ReasonCode.UNKNOWN_CAMERA, text), True
        code = ReasonCode.BAD_PICTURE
        try:
            points = self.points_of(frame)
            if points is not None:
                self._check_size(frame, camera)
                return self.picked.solve(frame, camera, points), True
            if not answers and (remarks := self._picture(frame, camera).remarks):
                answers[REMARKS] = pack(remarks)
            if frame.camera_from_body is None:
                frame = self._with_stars(frame, camera, answers)
            code = ReasonCode.BAD_DATA
            later = LaterPicture(lambda: self._picture(frame, camera))
            return _remarked(navigator.solve(frame, camera, later, answers), answers), False
        except NoSolutionError as error:
            return _unsolved(frame, ReasonCode(error.code), str(error)), True
        except DataError as error:
            return _unsolved(frame, code, str(error)), True
        except FRAME_FAULTS as error:
            text = self._failure("numerical failure", error)
            return _unsolved(frame, ReasonCode.NUMERICAL_FAILURE, text), True

    @cached_property
    def _stars(self) -> BrightStars:
        """The catalogue of the config, or the stars that ship. Raises DataError."""
        own = self.given.settings.stars
        if own.catalogue is None:
            return load_bright_stars()
        return read_star_catalog(Path(own.catalogue), own.epoch)

    def _with_stars(self, frame: Frame, camera: Camera, answers: Answers) -> Frame:
        """A frame whose attitude is not stated with that of the stars in its picture.

        Raises NoSolutionError where its stars give none.
        """
        if frame.tdb_s is None:
            return frame
        place = frame.position_m
        distance = None if place is None else float(np.linalg.norm(place))
        view = SkyView(self.folder.body, frame.tdb_s, distance, self._stars)
        if STARS not in answers:
            picture = self._picture(frame, camera)
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
        """A frame's record with what is drawn of it."""
        packed, overlay, undrawn = b"" if row is None else packed_row(row), b"", ""
        camera = self.folder.cameras.get(frame.camera)
        if camera is not None and not frame.problem:
            try:
                gray, undrawn = self._shown(frame, camera)
                image = image or encode_recorded_image(gray, camera)
                if row is not None:
                    outlines = _patch_outlines(row, camera, self.inputs.points)
                    overlay = encode_overlay(gray, row, outlines)
            except DataError:  # its row says so
                pass
            except FRAME_FAULTS as error:
                undrawn = self._failure("cannot be drawn", error)
        seconds = round(time.monotonic() - self._started, 3)
        return FrameRecord(
            answers, packed, settled, image, overlay, undrawn, self._details, seconds
        )

    def _failure(self, what: str, error: BaseException) -> str:
        """What failed, in words; the traceback goes to the details of the log."""
        self._details += "".join(traceback.format_exception(error))
        lines = str(error).splitlines()
        return f"{what} ({type(error).__name__}{': ' if lines else ''}{lines[0] if lines else ''})"

    def _shown(self, frame: Frame, camera: Camera) -> tuple[ByteArray, str]:
        """What a frame's row is drawn on: its picture; black where picked points need none.

        Also why a picture that is there is not shown.
        """
        try:
            return scale_to_eight_bits(self._picture(frame, camera).values), ""
        except PictureSizeError:
            raise
        except DataError as error:
            if self.points_of(frame) is None:
                raise
            there = picture_path(self.folder.path, frame.file).exists()
            return np.zeros(camera.shape, np.uint8), f"not shown: {error}" if there else ""

    def _check_size(self, frame: Frame, camera: Camera) -> None:
        """Raise DataError where a frame of picked points has a picture of another size.

        Its pixels are not those of the camera. It needs no picture, nor one that can be read.
        """
        try:
            self._picture(frame, camera)
        except PictureSizeError:
            raise
        except DataError:
            pass

    def _picture(self, frame: Frame, camera: Camera) -> Picture:
        """A frame's picture; the last one is at hand. Raises DataError."""
        path, file = self.folder.path, frame.file
        return self._pictures.get(file, lambda: load_frame_picture(path, file, camera))


def _remarked(row: Solution, answers: Answers) -> Solution:
    """A row with the remarks on its picture."""
    if REMARKS not in answers:
        return row
    text = "; ".join(unpack(answers[REMARKS], tuple[str, ...]))
    remark = Reason(ReasonCode.PICTURE_REMARK, text)
    return replace(
        row, outcome=replace(row.outcome, reason=row.outcome.reason.add_sentence(remark))
    )


def unseen_record() -> FrameRecord:
    """The record of a frame that was not looked at ahead of time."""
    return FrameRecord({}, b"", False, b"", b"", "", "", 0.0)


def look_at(worker: FrameWorker, tasks: Sequence[FrameTask]) -> list[FrameRecord]:
    """Records of some frames."""
    return [worker.look(task) for task in tasks]


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


def _attitude_source(frame: Frame, row: Solution) -> str:
    """What the attitude of a solved row is from: of a free one, from what fixed it."""
    fix = row.fix
    if fix is None or fix.camera_from_body is None:
        return ""
    if frame.camera_from_body is None and fix.method is not Method.PICKED_POINTS:
        return "stars"
    by_points = fix.method in (Method.CONTROL_POINTS, Method.PICKED_POINTS)
    return "points" if by_points and frame.attitude_sigma_rad is None else FROM_FILE


def _unsolved(frame: Frame, code: ReasonCode, text: str) -> Solution:
    return Solution(frame.file, frame.utc, NoFix(Reason(code, text)))


def _patch_outlines(
    row: Solution, camera: Camera, points: ControlPointField | None
) -> dict[tuple[str, int], list[FloatArray]]:
    """Outlines in the picture of the patches that were tried, by catalog and id."""
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
        most = MAX_OUTLINE * (distance / camera.focal_length_px * camera.width_px)
        sizes = [s for s in points.half_sizes_m(index, match.level) if 2.0 * s <= most]
        projection = reference.projection
        height = float(projection.height_of(reference.point.xyz_m))
        pose = fix.position_m, fix.camera_from_body
        outlines[match.catalog, match.cp_id] = project_patches(
            projection, height, sizes, camera, *pose
        )
    return outlines
