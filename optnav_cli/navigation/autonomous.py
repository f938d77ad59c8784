"""The autonomous loop: each frame solved by the best method that it and its past allow.

Source: Zhukov 2025, ch. 5 (centre, horizon, wide camera's control points, narrow camera's). The
switch is the frame itself. A prior comes from frames.csv; else from a camera that took a picture
at the same time; else from the outline in the picture; else from the orbit arc. From the prior the
control points are searched, as far as the catalog's levels reach; where they are found they are
the solution, and where they are not the outline is, unless they should have been found.

Methods check each other. Control points that are found from an outline confirm it. An outline
whose position shows many well-lit control points of which none is recognised is wrong: so betray
themselves a wrong focal length, clock or attitude. An outline far from the arc is not believed
until the next frame says the same; a position of two methods ends the arc instead.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.correlation.similarity import Matcher
from catalog.errors import NoSolutionError
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.dynamics.arc import GATE
from optnav_cli.estimation.models.points import Pose
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture
from optnav_cli.matching.picture_pyramid import PicturePyramid
from optnav_cli.navigation import outline
from optnav_cli.navigation.control_points import method as control_points
from optnav_cli.navigation.control_points.field import ControlPointField
from optnav_cli.navigation.control_points.method import (
    ControlPointFix,
    TriedPoint,
    UnsolvedFrameError,
)
from optnav_cli.navigation.control_points.solve import Prior
from optnav_cli.navigation.history import History, PositionPrior
from optnav_cli.navigation.neighbour import other_body
from optnav_cli.navigation.outline import BodyFix
from optnav_cli.navigation.settings import NavigateSettings
from optnav_cli.solution import OutlineMarks, Solution, solved, unsolved

CONTROL_POINTS = "control_points"


@dataclass(frozen=True, eq=False)
class Answer:
    """A frame's row, the control points tried for it, and the marks of the body's outline."""

    solution: Solution
    tried: list[TriedPoint]
    marks: OutlineMarks | None = None


@dataclass(frozen=True, eq=False)
class Observation:
    """A frame that can be navigated: everything that must be known about it is there.

    sun_body (3,) unit vector, body frame
    """

    frame: Frame
    tdb_s: float
    camera: Camera
    picture: Picture
    camera_from_body: Rotation
    sun_body: FloatArray

    @property
    def row(self) -> tuple[str, str]:
        """What its row in solution.csv begins with."""
        return self.frame.file, self.frame.utc


def source_of(observation: Observation) -> str:
    """What a prior is called that another frame takes from this one."""
    return f"{observation.camera.name} camera, {observation.frame.file}"


def observation_of(frame: Frame, camera: Camera, picture: Picture) -> Observation:
    """A frame with its picture. Raises NoSolutionError for what it must say and does not."""
    if frame.camera_from_body is None:
        raise NoSolutionError("no attitude: the quaternion is empty")
    if frame.sun_body is None or frame.tdb_s is None:
        raise NoSolutionError("no direction to the Sun")
    return Observation(frame, frame.tdb_s, camera, picture, frame.camera_from_body, frame.sun_body)


def row_of_points(observation: Observation, fix: ControlPointFix) -> Solution:
    """The row of a frame that control points solved."""
    resection = fix.solution
    used = [t.residual_px for t in fix.tried if t.used and t.residual_px is not None]
    return solved(
        *observation.row,
        CONTROL_POINTS,
        resection.pose.position_m,
        resection.position_covariance_m2,
        resection.pose.camera_from_body,
        resection.attitude_sigma_rad,
        n_predicted=len(fix.tried),
        n_matched=sum(not tried.match.reason for tried in fix.tried),
        n_used=len(used),
        residual_rms_px=float(np.sqrt(np.mean(np.square(used)))) if used else None,
        reason=fix.remark,
    )


def method_label(method: str) -> str:
    """A method's name in a sentence."""
    return method.replace("_", " ")


def disagreement_remark(row: Solution, found: BodyFix) -> str:
    """A remark where an outline lies further from the control points' position than it states."""
    if row.position_m is None or row.covariance_m2 is None:
        return ""
    offset = row.position_m - found.position_m
    square = float(offset @ np.linalg.solve(row.covariance_m2 + found.covariance_m2, offset))
    if square < GATE:
        return ""
    away = float(np.linalg.norm(offset)) / 1e3
    return f"the {method_label(found.method)} lies {away:.1f} km ({np.sqrt(square):.0f} sigmas) off"


def with_remark(answer: Answer, remark: str) -> Answer:
    """An answer with a remark behind its reason; as it is without one."""
    row = answer.solution
    reason = "; ".join(part for part in (row.reason, remark) if part)
    return replace(answer, solution=replace(row, reason=reason))


FROM_FILE = "frames.csv"
# So many control points in view, lit and whole, are never all missed where the prior is right: but
# under a Sun as high as trials go, and behind the camera, the ground shows next to no relief.
MIN_MISSED_POINTS, MAX_MISSED_SUN_DEG = 8, 55.0
# From farther off, where the body is less across, the limb gives the better position.
SMALL_DISC_PX = 2000.0


@dataclass(frozen=True, eq=False)
class NavigationInputs:
    """What a run navigates by.

    relief    None where neither a catalog nor the user gives one
    inertial  whether the attitudes of the files are camera_from_inertial
    """

    points: ControlPointField
    motion: Ephemeris
    relief: GlobalRelief | None
    settings: NavigateSettings
    matcher: Matcher
    inertial: bool = False


class Navigator:
    """Navigates the frames of a run one after the other, in the order of time."""

    def __init__(self, world: NavigationInputs) -> None:
        self._world = world
        self._history = History(world.motion)

    def solve(self, frame: Frame, camera: Camera, picture: Picture) -> Answer:
        """A frame's answer; whatever stands against a solution is the reason of its row."""
        try:
            observation = observation_of(frame, camera, picture)
        except NoSolutionError as error:
            return Answer(unsolved(frame.file, frame.utc, str(error)), [])
        if frame.position_m is not None and frame.position_sigma_m is not None:
            covariance = np.eye(3) * frame.position_sigma_m**2
            belief = PositionPrior(frame.position_m, covariance, FROM_FILE)
            answer = self._by_points(observation, belief)
            if not answer.solution.solved:
                return with_remark(answer, self._inverse_attitude_remark(observation, belief))
            return self._accept_points(observation, answer, sure=True)
        companion = self._history.at_same_time(observation.tdb_s)
        if companion is not None and not self._out_of_reach(observation, companion):
            answer = self._by_points(observation, companion)
            if answer.solution.solved:
                return self._accept_points(observation, answer, sure=True)
        return self._solve_without_prior(observation)

    def _solve_without_prior(self, observation: Observation) -> Answer:
        """A frame by its own outline, or by what the past predicts."""
        try:
            found = self._outline(observation, observation.camera_from_body)
        except NoSolutionError as error:
            return self._solve_from_prediction(observation, str(error))
        belief = PositionPrior(found.position_m, found.covariance_m2, found.method)
        answer = self._by_outline(observation, found)
        beyond = self._out_of_reach(observation, belief)
        if beyond:
            return self._accept_outline(observation, with_remark(answer, beyond))
        points = self._by_points(observation, belief)
        row = points.solution
        if row.solved:
            row = replace(row, n_limb=found.n_used, arc_deg=found.arc_deg)
            points = replace(points, solution=row, marks=found.marks)
            return self._accept_points(
                observation, with_remark(points, disagreement_remark(row, found)), sure=True
            )
        witnesses = _witnesses(points)
        if witnesses < MIN_MISSED_POINTS:
            answer = replace(
                with_remark(answer, f"control points: {row.reason}"), tried=points.tried
            )
            return self._accept_outline(observation, answer)
        reason = (
            f"the {method_label(found.method)} puts {witnesses} well-lit control points into "
            f"view, but they are not there ({row.reason}): attitude, time, focal length or "
            "the outline is wrong"
        )
        row = unsolved(*observation.row, reason, method=found.method, prior=found.method)
        answer = Answer(row, points.tried, found.marks)
        return with_remark(answer, self._inverse_attitude_remark(observation, None))

    def _solve_from_prediction(self, observation: Observation, why_no_outline: str) -> Answer:
        """A frame without an outline: by what other frames say, or not at all."""
        belief = self._history.at_same_time(observation.tdb_s) or self._history.predict(
            observation.tdb_s
        )
        if belief is None:
            reason = f"no prior: {why_no_outline}; and no frame before leads here"
            answer = Answer(unsolved(*observation.row, reason), [])
            return with_remark(answer, self._inverse_attitude_remark(observation, None))
        beyond = self._too_coarse(observation, belief)
        if beyond:
            reason = f"{why_no_outline}; from the {belief.source}: {beyond}"
            return Answer(unsolved(*observation.row, reason, prior=belief.source), [])
        answer = self._by_points(observation, belief)
        if answer.solution.solved:
            return self._accept_points(observation, answer, sure=False)
        return with_remark(answer, why_no_outline)

    def _attitude_sigma(self, observation: Observation) -> float:
        known = observation.frame.attitude_sigma_rad
        free = float(np.radians(self._world.settings.solve.free_attitude_deg))
        return free if known is None else known

    def _outline(self, observation: Observation, camera_from_body: Rotation) -> BodyFix:
        return outline.navigate(
            observation.picture,
            observation.camera,
            camera_from_body,
            self._attitude_sigma(observation),
            observation.sun_body,
            self._world.motion.body,
            self._world.relief,
            other_body(self._world.motion, observation.tdb_s),
        )

    def _by_outline(self, observation: Observation, found: BodyFix) -> Answer:
        row = solved(
            *observation.row,
            found.method,
            found.position_m,
            found.covariance_m2,
            observation.camera_from_body,
            self._attitude_sigma(observation),
            residual_rms_px=found.residual_rms_px,
            n_limb=found.n_used,
            arc_deg=found.arc_deg,
            reason=found.remark,
        )
        return Answer(row, [], found.marks)

    def _by_points(self, observation: Observation, belief: PositionPrior) -> Answer:
        """Control points searched from a belief."""
        world = self._world
        prior = Prior(
            Pose(belief.position_m, observation.camera_from_body),
            belief.covariance_m2,
            observation.frame.attitude_sigma_rad,
        )
        try:
            fix = control_points.navigate(
                PicturePyramid(observation.picture.values),
                observation.camera,
                prior,
                observation.sun_body,
                world.points,
                world.settings,
                world.matcher,
            )
        except UnsolvedFrameError as error:
            row = unsolved(
                *observation.row,
                str(error),
                method=CONTROL_POINTS,
                n_predicted=len(error.tried),
                n_matched=sum(not tried.match.reason for tried in error.tried),
                n_used=0,
                prior=belief.source,
            )
            return Answer(row, error.tried)
        except NoSolutionError as error:
            source = belief.source
            return Answer(
                unsolved(*observation.row, str(error), method=CONTROL_POINTS, prior=source), []
            )
        return Answer(replace(row_of_points(observation, fix), prior=belief.source), fix.tried)

    def _out_of_reach(self, observation: Observation, belief: PositionPrior) -> str:
        """Why control points have nothing to add to an outline; empty when some may."""
        radius = self._world.motion.body.radius_m
        across = 2.0 * radius / max(self._pixel_m(observation, belief), 1e-9)
        if across < SMALL_DISC_PX:
            return f"the body is {across:.0f} px across: its limb tells more than control points"
        return self._too_coarse(observation, belief)

    def _too_coarse(self, observation: Observation, belief: PositionPrior) -> str:
        """Why no control point can be matched from there; empty when some may."""
        world, sample = self._world, self._pixel_m(observation, belief)
        coarsest = max(float(layer.postings_m[-1]) for layer in world.points.layers)
        if world.settings.match.finest_posting_per_gsd * sample <= coarsest:
            return ""
        return (
            f"a pixel sees {sample:.0f} m, too much for the catalog's coarsest level "
            f"of {coarsest:.0f} m"
        )

    def _pixel_m(self, observation: Observation, belief: PositionPrior) -> float:
        """Ground that a pixel sees below."""
        height = float(np.linalg.norm(belief.position_m)) - self._world.motion.body.radius_m
        return max(height, 0.0) / observation.camera.focal_length_px

    def _accept_points(self, observation: Observation, answer: Answer, *, sure: bool) -> Answer:
        """An answer by control points, taken into the track; a remark where the arc disagrees."""
        row = answer.solution
        if row.position_m is None or row.covariance_m2 is None:
            return answer
        odd = self._history.take(observation.tdb_s, row.position_m, row.covariance_m2, sure=sure)
        self._history.keep(
            observation.tdb_s, row.position_m, row.covariance_m2, source_of(observation)
        )
        # a prior of the file may belong to another flight than the frame before
        if odd is None or row.prior == FROM_FILE:
            return answer
        return with_remark(answer, f"{odd.words}: a manoeuvre, or the arc was wrong")

    def _accept_outline(self, observation: Observation, answer: Answer) -> Answer:
        """An answer by the outline alone: not believed where the arc leads elsewhere."""
        row = answer.solution
        if row.position_m is None or row.covariance_m2 is None:
            return answer
        place = observation.tdb_s, row.position_m, row.covariance_m2
        beyond = self._history.exceeds_max_speed(*place)
        if beyond:
            reason = f"the {method_label(row.method)} lies {beyond}: no craft flies so fast"
            return self._refused(observation, answer, reason)
        odd = self._history.take(*place, sure=False)
        if odd is not None and not odd.ended:
            reason = f"the {method_label(row.method)} lies {odd.words}: one of both is wrong"
            return self._refused(observation, answer, reason)
        self._history.keep(
            observation.tdb_s, row.position_m, row.covariance_m2, source_of(observation)
        )
        if odd is None:
            return answer
        remark = f"{odd.words}, as the frame before: a manoeuvre, or the arc was wrong"
        return with_remark(answer, remark)

    def _refused(self, observation: Observation, answer: Answer, reason: str) -> Answer:
        row = unsolved(*observation.row, reason, method=answer.solution.method)
        return with_remark(
            replace(answer, solution=row), self._inverse_attitude_remark(observation, None)
        )

    def _inverse_attitude_remark(
        self, observation: Observation, belief: PositionPrior | None
    ) -> str:
        """Words for a reason where the picture is solved by the inverse of the file's rotation.

        belief  of the position; None: from the outline, seen with that rotation
        """
        body_from_space = np.eye(3)
        if self._world.inertial:
            body_from_space = self._world.motion.body_from_inertial(observation.tdb_s)
        told = observation.camera_from_body.as_matrix() @ body_from_space
        turned = Rotation.from_matrix(told.T @ body_from_space.T)
        turned_sight = replace(observation, camera_from_body=turned)
        reported_belief = belief is not None
        if belief is None:
            try:
                found = self._outline(observation, turned)
            except NoSolutionError:
                return ""
            belief = PositionPrior(found.position_m, found.covariance_m2, found.method)
            if not self._history.fits(observation.tdb_s, found.position_m, found.covariance_m2):
                return ""
        answer = self._by_points(turned_sight, belief)
        # where no points are in view an outline under the right Sun is all that can be had
        if not answer.solution.solved and (
            reported_belief or _witnesses(answer) >= MIN_MISSED_POINTS
        ):
            return ""
        wanted = "camera_from_inertial" if self._world.inertial else "camera_from_body"
        return f"the picture fits the inverse rotation: wanted the quaternion of {wanted}"


def _witnesses(answer: Answer) -> int:
    """How many control points could not all be missed at the place that an answer tried."""
    return sum(t.sun_elevation_deg < MAX_MISSED_SUN_DEG for t in answer.tried)
