"""A cache of the methods' answers about one frame: each question is asked once.

An answer depends on the frame's row and picture alone, never on other frames. So workers give
answers ahead of time, and those of a stopped run stand. An answer is used as it reads back from its
bytes, also where it was just given: a run that goes on has the same numbers to the last bit.
"""

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.correlation.similarity import Matcher
from catalog.errors import NoSolutionError
from catalog.jobs.workspace import pack, unpack
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.control_points import method as control_points
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.fix import Fix, Method, NoFix, PositionPrior, Solution, UnsolvedFrameError
from optnav_cli.frames.folder import Observation
from optnav_cli.frames.frames import Frame
from optnav_cli.outline import method as outline
from optnav_cli.outline.neighbour import find_other_body
from optnav_cli.reasons import Reason

# Answers of a frame by their questions: bytes of `pack`.
Answers = dict[str, bytes]


@dataclass(frozen=True, eq=False)
class NavigationInputs:
    """Inputs that all frames of a run are navigated with.

    points    None where there is no catalog: then the outline alone gives positions
    relief    None where neither a catalog nor the user gives one
    inertial  whether the attitudes of the files are camera_from_inertial
    """

    points: ControlPointField | None
    motion: Ephemeris
    relief: GlobalRelief | None
    settings: NavigateSettings
    matcher: Matcher
    inertial: bool = False


@dataclass(frozen=True, eq=False)
class FrameOutcome:
    """A fix or why there is none, as it is kept: one of both is there."""

    fix: Fix | None
    no_fix: NoFix | None

    @classmethod
    def of(cls, outcome: Fix | NoFix) -> "FrameOutcome":
        """Make the outcome of a method."""
        if isinstance(outcome, Fix):
            return cls(outcome, None)
        return cls(None, outcome)

    @property
    def value(self) -> Fix | NoFix:
        """The fix, or why there is none."""
        outcome = self.fix or self.no_fix
        if outcome is None:
            raise ValueError("an outcome is empty")
        return outcome


class FrameMethods:
    """The outline and the control points of one frame.

    observation  what is known of the frame
    answers      those that are known; what is asked anew is added
    """

    def __init__(
        self, inputs: NavigationInputs, observation: Observation, answers: Answers
    ) -> None:
        self.observation = observation
        self._inputs, self._answers = inputs, answers

    def outline(self, *, inverse: bool = False) -> Fix | NoFix:
        """Solve by the body's outline; inverse: with the inverse of the stated rotation."""
        question = f"outline{' inverse' * inverse}"
        if question not in self._answers:
            self._keep(question, self._solve_outline(self._load_observation(inverse)))
        return self._read_answer(question)

    def solve_by_points(self, prior: PositionPrior, *, inverse: bool = False) -> Solution:
        """Solve by control points from a prior; return the frame's row."""
        mark = hashlib.sha256(pack(prior)).hexdigest()
        question = f"control points{' inverse' * inverse} {mark}"
        if question not in self._answers:
            self._keep(question, self._match_points(self._load_observation(inverse), prior))
        seen = self.observation
        return Solution(
            seen.file, seen.utc, self._read_answer(question), prior.source, prior.position_m
        )

    def _keep(self, question: str, outcome: Fix | NoFix) -> None:
        self._answers[question] = pack(FrameOutcome.of(outcome))

    def _read_answer(self, question: str) -> Fix | NoFix:
        return unpack(self._answers[question], FrameOutcome).value

    def _load_observation(self, inverse: bool) -> Observation:
        """Load the frame's picture; inverse: with the inverse of the stated rotation."""
        observation = replace(self.observation, picture=self.observation.picture.load())
        if not inverse:
            return observation
        body_from_space = np.eye(3)
        if self._inputs.inertial:
            body_from_space = self._inputs.motion.body_from_inertial(observation.tdb_s)
        stated = observation.camera_from_body.as_matrix() @ body_from_space
        turn = Rotation.from_matrix(stated.T @ body_from_space.T)
        return replace(observation, camera_from_body=turn)

    def _solve_outline(self, observation: Observation) -> Fix | NoFix:
        inputs, turn, sun = self._inputs, observation.camera_from_body, observation.sun_body
        sigma = inputs.settings.attitude_sigma_rad(observation.attitude_sigma_rad)
        body, other = inputs.motion.body, find_other_body(inputs.motion, observation.tdb_s)
        picture, camera = observation.picture, observation.camera
        try:
            return outline.navigate(picture, camera, turn, sigma, sun, body, inputs.relief, other)
        except NoSolutionError as error:
            return NoFix(Reason.from_error(error))

    def _match_points(self, observation: Observation, prior: PositionPrior) -> Fix | NoFix:
        inputs = self._inputs
        if inputs.points is None:
            raise ValueError("control points are asked for without a catalog")
        try:
            return control_points.navigate(
                observation, prior, inputs.points, inputs.settings, inputs.matcher
            )
        except UnsolvedFrameError as error:
            return NoFix(Reason.from_error(error), Method.CONTROL_POINTS, error.evidence)
        except NoSolutionError as error:
            return NoFix(Reason.from_error(error), Method.CONTROL_POINTS)


@dataclass(frozen=True)
class FrameTask:
    """A frame to look at; has_twin: a frame before it is of the same time."""

    frame: Frame
    has_twin: bool


@dataclass(frozen=True)
class FrameRecord:
    """Stored result of a frame.

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


def pack_row(row: Solution) -> bytes:
    """A row of solution.csv with its evidence as bytes."""
    outcome = FrameOutcome.of(row.outcome)
    return pack((row.file, row.utc, outcome, row.prior, row.prior_m, row.attitude_source))


def unpack_row(data: bytes) -> Solution:
    """The row that `packed_row` was given."""
    kinds: Any = tuple[str, str, FrameOutcome, str, FloatArray | None, str]
    file, utc, outcome, prior, prior_m, source = unpack(data, kinds)
    return Solution(file, utc, outcome.value, prior, prior_m, source)


def make_empty_record() -> FrameRecord:
    """Make the record of a frame that was not processed ahead of time."""
    return FrameRecord({}, b"", False, b"", b"", "", "", 0.0)
