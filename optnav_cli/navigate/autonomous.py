"""The autonomous loop: each frame solved by the best method that it and its past allow.

Source: Zhukov 2025, ch. 5 (centre, horizon, wide camera's control points, narrow camera's). The
switch is the frame itself. A prior comes from frames.csv; else from a camera that took a picture
at the same time; else from the outline in the picture; else from the orbit arc: the steps of
`Navigator.solve`, in this order. From the prior the control points are searched, as far as the
catalog's levels reach; where they are found they are the solution, and where they are not the
outline is, unless they should have been found.

Methods check each other. Control points that are found from an outline confirm it. An outline
whose position shows many well-lit control points of which none is recognised is wrong: a wrong
focal length, clock or attitude shows so. An outline far from the arc is not accepted until the
next frame agrees with it; a position of two methods ends the arc instead.
"""

from dataclasses import replace

import numpy as np

from catalog.errors import NoSolutionError
from catalog.geometry.vectors import squared_distance
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.acceptance import check_position
from optnav_cli.dynamics.arc import GATE
from optnav_cli.fix import Evidence, Fix, Method, NoFix, PositionPrior, Solution
from optnav_cli.frames.folder import FROM_FILE, Observation, make_observation
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture
from optnav_cli.navigate.answers import Answers, FrameMethods, NavigationInputs
from optnav_cli.navigate.history import History
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

# So many control points in view, lit and whole, are never all missed where the prior is right: but
# under a Sun as high as trials go, and behind the camera, the ground shows next to no relief.
MIN_MISSED_POINTS, MAX_MISSED_SUN_DEG = 8, 55.0
NO_CATALOG = Reason(ReasonCode.NO_CATALOG, "no catalog was given to search control points of")


class Navigator:
    """Navigates the frames of a run one after the other, in the order of time.

    history  what is known of the frames before; nothing yet if None
    """

    def __init__(self, inputs: NavigationInputs, history: History | None = None) -> None:
        self._inputs = inputs
        self._history = History(inputs.motion) if history is None else history

    def solve(
        self, frame: Frame, camera: Camera, picture: Picture, answers: Answers | None = None
    ) -> Solution:
        """Solve a frame; the reason of an unsolved row says what is wrong.

        answers  of the methods, as far as they are known; those asked anew are added. The picture
                 is only read for these.
        """
        try:
            observation = make_observation(frame, camera, picture)
        except NoSolutionError as error:
            return Solution(frame.file, frame.utc, NoFix(Reason.from_error(error)))
        methods = FrameMethods(self._inputs, observation, {} if answers is None else answers)
        # A step gives the frame's row, or leaves it to the next one and may say why.
        reason = NO_REASON
        for step in (self._solve_from_file, self._solve_from_same_time, self._solve_from_outline):
            result = step(methods)
            if isinstance(result, Solution):
                return result
            reason = result
        return self._solve_from_arc(methods, reason)

    def _solve_from_file(self, methods: FrameMethods) -> Solution | Reason:
        """Solve by control points from the position that frames.csv states or an orbit predicts."""
        prior = methods.observation.prior
        if prior is None or self._inputs.points is None:
            return NO_REASON
        stated = prior.source == FROM_FILE
        if not stated and self._check_reach(methods.observation, prior):
            return NO_REASON
        row = methods.solve_by_points(prior)
        if not row.solved and not stated:  # what solves a frame without a prior may solve it
            return NO_REASON
        if not row.solved:
            return self._solve_from_silhouette(methods, prior, row) or self._try_inverse_attitude(
                row, methods, prior
            )
        return self._accept_points(methods.observation, row, confirmed=True)

    def _solve_from_silhouette(
        self, methods: FrameMethods, prior: PositionPrior, tried: Solution
    ) -> Solution | None:
        """Solve by the silhouette where the prior allows it, and by control points from there.

        tried  the control points' row from the prior, which is unsolved
        """
        fix = methods.outline()
        if isinstance(fix, NoFix) or fix.method is not Method.SILHOUETTE:
            return None
        if check_position(fix.position_m, fix.covariance_m2, prior):
            return None
        start = PositionPrior(fix.position_m, fix.covariance_m2, fix.method)
        # a free attitude is searched about the stated one, which the silhouette has left behind
        if methods.observation.attitude_sigma_rad is not None:
            points = methods.solve_by_points(start)
            if points.solved:
                return self._accept_points(methods.observation, points, confirmed=True)
        alone = replace(fix, evidence=replace(fix.evidence, matches=tried.evidence.matches))
        row = replace(tried, outcome=alone)
        why = tried.outcome.reason
        remark = why.with_text(f"control points: {why}")
        return self._accept_outline(methods, row.with_remark(remark))

    def _solve_from_same_time(self, methods: FrameMethods) -> Solution | Reason:
        """Solve by control points from the fix of another camera at the same time."""
        observation = methods.observation
        prior = self._history.find_at_same_time(observation.tdb_s)
        if prior is None or self._check_reach(observation, prior):
            return NO_REASON
        row = methods.solve_by_points(prior)
        return self._accept_points(observation, row, confirmed=True) if row.solved else NO_REASON

    def _solve_from_outline(self, methods: FrameMethods) -> Solution | Reason:
        """Solve by the outline, and by control points from it where they may give more."""
        observation, fix = methods.observation, methods.outline()
        if isinstance(fix, NoFix):
            return fix.reason
        row = Solution(observation.file, observation.utc, fix)
        if self._inputs.points is None:
            far = observation.prior and check_position(
                fix.position_m, fix.covariance_m2, observation.prior
            )
            return self._refuse(methods, row, far) if far else self._accept_outline(methods, row)
        prior = PositionPrior(fix.position_m, fix.covariance_m2, fix.method)
        beyond = self._check_reach(observation, prior)
        if beyond:
            return self._accept_outline(methods, row.with_remark(beyond))
        points = methods.solve_by_points(prior)
        limb, tried = fix.evidence, points.evidence
        if points.fix is not None:
            n, arc, marks = limb.n_limb, limb.arc_deg, limb.outline
            evidence = replace(tried, n_limb=n, arc_deg=arc, outline=marks)
            both = replace(points.fix, evidence=evidence)
            row = replace(points, outcome=both).with_remark(_describe_disagreement(points.fix, fix))
            return self._accept_points(observation, row, confirmed=True)
        why = points.outcome.reason
        missed = _count_missed_points(tried)
        if missed < MIN_MISSED_POINTS or _is_confirming(why, tried):
            evidence = replace(limb, matches=tried.matches)
            alone = replace(row, outcome=replace(fix, evidence=evidence))
            remark = why.with_text(f"control points: {why}")
            return self._accept_outline(methods, alone.with_remark(remark))
        reason = Reason(
            ReasonCode.POINTS_MISSING,
            f"the {fix.method.label} puts {missed} well-lit control points into "
            f"view, but they are not there ({why}): attitude, time, focal length or "
            "the outline is wrong",
        )
        evidence = Evidence(matches=tried.matches, outline=limb.outline)
        row = replace(row, outcome=NoFix(reason, fix.method, evidence), prior=fix.method)
        return self._try_inverse_attitude(row, methods)

    def _solve_from_arc(self, methods: FrameMethods, why_no_outline: Reason) -> Solution:
        """Solve by control points from the position that other frames predict, or not at all."""
        observation = methods.observation
        row = Solution(observation.file, observation.utc, NoFix(why_no_outline))
        if self._inputs.points is None:
            row = row.with_remark(NO_CATALOG)
            return self._try_inverse_attitude(row, methods)
        time = observation.tdb_s
        prior = self._history.find_at_same_time(time) or self._history.predict(time)
        if prior is None:
            text = f"no prior: {why_no_outline}; and no frame before leads here"
            row = replace(row, outcome=NoFix(Reason(ReasonCode.NO_PRIOR, text)))
            return self._try_inverse_attitude(row, methods)
        beyond = self._check_resolution(observation, prior)
        if beyond:
            reason = beyond.with_text(f"{why_no_outline}; from the {prior.source}: {beyond}")
            return replace(row, outcome=NoFix(reason), prior=prior.source)
        row = methods.solve_by_points(prior)
        if not row.solved:
            return row.with_remark(why_no_outline)
        return self._accept_points(observation, row, confirmed=False)

    def _check_reach(self, observation: Observation, prior: PositionPrior) -> Reason:
        """Return why control points have nothing to add to a prior; empty when some may."""
        radius = self._inputs.motion.body.radius_m
        across = 2.0 * radius / max(self._compute_pixel_m(observation, prior), 1e-9)
        # Where the body is less than 2000 px across the limb gives the better position.
        if across < 2000.0:
            text = f"the body is {across:.0f} px across: its limb tells more than control points"
            return Reason(ReasonCode.DISTANT_BODY, text)
        return self._check_resolution(observation, prior)

    def _check_resolution(self, observation: Observation, prior: PositionPrior) -> Reason:
        """Return why no control point can be matched from there; empty when some may."""
        inputs, sample = self._inputs, self._compute_pixel_m(observation, prior)
        if inputs.points is None:
            return NO_CATALOG
        coarsest = max(float(layer.postings_m[-1]) for layer in inputs.points.layers)
        if inputs.settings.match.finest_posting_per_gsd * sample <= coarsest:
            return NO_REASON
        return Reason(
            ReasonCode.TOO_COARSE,
            f"a pixel sees {sample:.0f} m, too much for the catalog's coarsest level "
            f"of {coarsest:.0f} m",
        )

    def _compute_pixel_m(self, observation: Observation, prior: PositionPrior) -> float:
        """Compute the ground sample distance below the camera, m."""
        height = float(np.linalg.norm(prior.position_m)) - self._inputs.motion.body.radius_m
        return max(height, 0.0) / observation.camera.coarse_focal_px

    def _accept_points(
        self, observation: Observation, row: Solution, *, confirmed: bool
    ) -> Solution:
        """Add a row solved by control points to the history; remark where the arc disagrees.

        confirmed  two methods agree on it
        """
        if row.fix is None:
            return row
        boresight = observation.camera.boresight_sigma_rad
        disagreement = self._history.add_fix(
            observation.tdb_s, row.fix, confirmed=confirmed, boresight_rad=boresight
        )
        self._history.remember(observation.tdb_s, row.fix, observation.source)
        # a prior of the file may belong to another flight than the frame before
        if disagreement is None or row.prior == FROM_FILE:
            return row
        remark = f"{disagreement.words}: a manoeuvre, or the arc was wrong"
        return row.with_remark(Reason(ReasonCode.CONTRADICTS_ARC, remark))

    def _accept_outline(self, methods: FrameMethods, row: Solution) -> Solution:
        """Accept a row solved by the outline alone; refuse it where the history excludes it."""
        observation, fix = methods.observation, row.fix
        if fix is None:
            return row
        beyond = self._history.check_speed(observation.tdb_s, fix)
        if beyond:
            text = f"the {fix.method.label} lies {beyond}: no craft flies so fast"
            return self._refuse(methods, row, Reason(ReasonCode.TOO_FAST, text))
        boresight = observation.camera.boresight_sigma_rad
        disagreement = self._history.add_fix(
            observation.tdb_s, fix, confirmed=False, boresight_rad=boresight
        )
        if disagreement is not None and not disagreement.new_arc:
            text = f"the {fix.method.label} lies {disagreement.words}: one of both is wrong"
            return self._refuse(methods, row, Reason(ReasonCode.CONTRADICTS_ARC, text))
        self._history.remember(observation.tdb_s, fix, observation.source)
        if disagreement is None:
            return row
        remark = f"{disagreement.words}, as the frame before: a manoeuvre, or the arc was wrong"
        return row.with_remark(Reason(ReasonCode.CONTRADICTS_ARC, remark))

    def _refuse(self, methods: FrameMethods, row: Solution, reason: Reason) -> Solution:
        evidence = Evidence(matches=row.evidence.matches, outline=row.evidence.outline)
        unsolved = replace(row, outcome=NoFix(reason, row.outcome.method, evidence))
        return self._try_inverse_attitude(unsolved, methods)

    def _try_inverse_attitude(
        self, row: Solution, methods: FrameMethods, prior: PositionPrior | None = None
    ) -> Solution:
        """Replace an unsolved row's reason where the inverse rotation solves the frame.

        prior  of the position; None: from the outline, seen with that rotation
        """
        if not self._is_solved_by_inverse(methods, prior):
            return row
        wanted = "camera_from_inertial" if self._inputs.inertial else "camera_from_body"
        text = (
            f"{row.reason}; the picture fits the inverse rotation: wanted the quaternion of "
            f"{wanted}"
        )
        reason = Reason(ReasonCode.WRONG_ATTITUDE, text)
        return replace(row, outcome=replace(row.outcome, reason=reason))

    def _is_solved_by_inverse(self, methods: FrameMethods, prior: PositionPrior | None) -> bool:
        """Whether the picture fits the inverse of the rotation that the file states."""
        if prior is not None:
            return methods.solve_by_points(prior, inverse=True).solved
        fix = methods.outline(inverse=True)
        if isinstance(fix, NoFix):
            return False
        if not self._history.is_consistent(methods.observation.tdb_s, fix):
            return False
        if self._inputs.points is None:
            return True
        prior = PositionPrior(fix.position_m, fix.covariance_m2, fix.method)
        row = methods.solve_by_points(prior, inverse=True)
        # where no points are in view an outline under the right Sun is all that can be had
        return row.solved or _count_missed_points(row.evidence) < MIN_MISSED_POINTS


def _describe_disagreement(points: Fix, outline: Fix) -> Reason:
    """Describe where an outline lies further from the control points' position than it states."""
    offset = points.position_m - outline.position_m
    square = squared_distance(offset, points.covariance_m2 + outline.covariance_m2)
    if square < GATE:
        return NO_REASON
    distance_km = float(np.linalg.norm(offset)) / 1e3
    text = (
        f"the {outline.method.label} lies {distance_km:.1f} km ({np.sqrt(square):.0f} sigmas) off"
    )
    return Reason(ReasonCode.METHODS_DISAGREE, text)


def _is_confirming(why: Reason, tried: Evidence) -> bool:
    """Whether control points that scatter too much to be a position still show the right ground.

    why, tried  of their refusal. Where pixels are a tenth of the terrain model's posting its errors
    move points by several times what their scores tell: they are there, though, about where the
    outline puts them, and chance does not offer so many such scores.
    """
    margins = tried.margins
    if why.code != ReasonCode.POINTS_DISAGREE or margins is None:
        return False
    # 1.5 times the widest scatter that is accepted.
    return margins.chance_decades >= 0.0 and margins.scatter < 1.5


def _count_missed_points(evidence: Evidence) -> int:
    """Count the control points tried that are lit so low that not all could be missed."""
    return sum((match.sun_elevation_deg or 0.0) < MAX_MISSED_SUN_DEG for match in evidence.matches)
