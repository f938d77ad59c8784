"""The methods asked about one frame: each question once, its answer kept.

An answer depends on the frame's row and picture alone, never on other frames. So workers give
answers ahead of time, and those of a stopped run stand. An answer is used as it reads back from its
bytes, also where it was just given: a run that goes on has the same numbers to the last bit.
"""

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.bodies.ephemeris import Ephemeris
from catalog.correlation.similarity import Matcher
from catalog.errors import NoSolutionError
from catalog.jobs.workspace import pack, unpack
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.control_points import method as control_points
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.fix import Fix, Method, NoFix, PositionPrior, Solution, UnsolvedFrameError
from optnav_cli.frames.observation import Observation
from optnav_cli.outline import method as outline
from optnav_cli.outline.neighbour import find_other_body
from optnav_cli.reasons import Reason

# Answers of a frame by their questions: bytes of `pack`.
Answers = dict[str, bytes]


@dataclass(frozen=True, eq=False)
class NavigationInputs:
    """What a run navigates by.

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
class Outcome:
    """A fix or why there is none, as it is kept: one of both is there."""

    fix: Fix | None
    no_fix: NoFix | None

    @classmethod
    def of(cls, outcome: Fix | NoFix) -> "Outcome":
        """One that holds this."""
        if isinstance(outcome, Fix):
            return cls(outcome, None)
        return cls(None, outcome)

    @property
    def value(self) -> Fix | NoFix:
        """What it holds."""
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
        """What the body's outline gives; inverse: seen with the inverse of the stated rotation."""
        question = f"outline{' inverse' * inverse}"
        if question not in self._answers:
            self._keep(question, self._outline(self._seen(inverse)))
        return self._kept(question)

    def by_points(self, prior: PositionPrior, *, inverse: bool = False) -> Solution:
        """The row that control points give from a prior."""
        mark = hashlib.sha256(pack(prior)).hexdigest()
        question = f"control points{' inverse' * inverse} {mark}"
        if question not in self._answers:
            self._keep(question, self._by_points(self._seen(inverse), prior))
        seen = self.observation
        return Solution(seen.file, seen.utc, self._kept(question), prior.source, prior.position_m)

    def _keep(self, question: str, outcome: Fix | NoFix) -> None:
        self._answers[question] = pack(Outcome.of(outcome))

    def _kept(self, question: str) -> Fix | NoFix:
        return unpack(self._answers[question], Outcome).value

    def _seen(self, inverse: bool) -> Observation:
        """The frame with its picture, perhaps with the inverse of the rotation that is stated."""
        observation = replace(self.observation, picture=self.observation.picture.load())
        if not inverse:
            return observation
        body_from_space = np.eye(3)
        if self._inputs.inertial:
            body_from_space = self._inputs.motion.body_from_inertial(observation.tdb_s)
        stated = observation.camera_from_body.as_matrix() @ body_from_space
        turn = Rotation.from_matrix(stated.T @ body_from_space.T)
        return replace(observation, camera_from_body=turn)

    def _outline(self, observation: Observation) -> Fix | NoFix:
        inputs, turn, sun = self._inputs, observation.camera_from_body, observation.sun_body
        sigma = inputs.settings.attitude_sigma_rad(observation.attitude_sigma_rad)
        body, other = inputs.motion.body, find_other_body(inputs.motion, observation.tdb_s)
        picture, camera = observation.picture, observation.camera
        try:
            return outline.navigate(picture, camera, turn, sigma, sun, body, inputs.relief, other)
        except NoSolutionError as error:
            return NoFix(Reason.from_error(error))

    def _by_points(self, observation: Observation, prior: PositionPrior) -> Fix | NoFix:
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
