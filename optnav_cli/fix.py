"""A camera's position from one picture, and the row of solution.csv that it becomes.

A method gives a `Fix`, or raises NoSolutionError; a `Solution` is a frame's row with either. A
`PositionPrior` is where a camera is expected before its picture is looked at.
"""

import zlib
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray
from catalog.errors import NoSolutionError
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode

Status = Literal["solved", "unsolved"]
GAP_STEPS, GAP_PX = 5.0, 12.0  # a limb is drawn in pieces where its points stand farther apart


class Method(StrEnum):
    """Method of a position, as solution.csv names it."""

    CONTROL_POINTS = "control_points"
    HORIZON = "horizon"  # the limb on the skyline of the body's relief or shape
    HORIZON_SPHERE = "horizon_sphere"  # the limb on the bare ellipsoid
    BRIGHTNESS_CENTRE = "brightness_centre"
    SILHOUETTE = "silhouette"  # the edges of the body's shape as it is drawn
    DESCENT = "descent"  # an inertial track, windows of the terrain model and landmarks, jointly
    RELATIVE_LANDMARKS = "relative_landmarks"  # the same where a frame shows landmarks alone
    ORBIT = "orbit"  # an orbit through the fixes of runs
    PICKED_POINTS = "picked_points"  # places that a person named in the picture

    @property
    def label(self) -> str:
        """The name for people."""
        smooth = self is Method.HORIZON_SPHERE
        return "horizon of a smooth body" if smooth else self.value.replace("_", " ")


class MatchKind(StrEnum):
    """Kind of target sought in a frame, as matches.csv names it."""

    CONTROL_POINT = "control_point"
    WINDOW = "window"  # a part of the terrain model, by its number on the descent's lattice
    LANDMARK = "landmark"  # what an earlier frame showed, by its number in landmarks.csv
    PICKED_POINT = "picked_point"  # a row of points.csv, by its name


def hash_name(name: str) -> int:
    """The number that stands for a picked point's name where points are numbered."""
    return zlib.crc32(name.encode())


@dataclass(frozen=True, eq=False)
class MatchRow:
    """One control point, window, landmark or picked point of one frame: a row of matches.csv.

    file               the frame's name
    cp_id              the point's id in its catalog; a number made of a picked point's name
    level              pyramid level of the (last) match, 0 = finest
    cp_position_m      (3,)  the point, body frame, m
    predicted_px       (2,)  where the final pose expects it, x, y
    measured_px        (2,)  where it was found; None where the matcher accepts no place
    score, runner_up   the best match's score and that of its best rival; None without a match
    used               whether the solution keeps it
    reason             why not; empty when used
    sun_elevation_deg  Sun above the point's horizon
    residual_px        (2,)  measured minus predicted after the solution
    prior_px           (2,)  where the pose expected it from which the search began
    catalog            the catalog's file name
    reason_code        the code of `reason`
    kind               what was sought
    name               of a picked point
    """

    file: str
    cp_id: int
    level: int
    cp_position_m: FloatArray
    predicted_px: FloatArray
    measured_px: FloatArray | None = None
    score: float | None = None
    runner_up: float | None = None
    used: bool = False
    reason: str = ""
    sun_elevation_deg: float | None = None
    residual_px: FloatArray | None = None
    prior_px: FloatArray | None = None
    catalog: str = ""
    reason_code: ReasonCode = ReasonCode.NONE
    kind: MatchKind = MatchKind.CONTROL_POINT
    name: str = ""

    @property
    def label(self) -> str:
        """Label in drawings and tables: the name, else the number."""
        return self.name or str(self.cp_id)


@dataclass(frozen=True, eq=False)
class OutlineMarks:
    """Where a picture showed the body's outline, to be drawn.

    points_px     (n, 2)  limb points, along the limb; or one, the centre of a small disc
    inward        (n, 2)  unit vectors across the limb, from the sky to the body
    residuals_px  (n,)    how far the points lie from the fitted limb, positive away from the body;
                          NaN of those that the solution leaves out
    is_disc       whether the point is a disc's centre; inward and residuals are then empty
    """

    points_px: FloatArray
    inward: FloatArray
    residuals_px: FloatArray
    is_disc: bool = False

    @classmethod
    def mark_disc(cls, centre_px: FloatArray) -> "OutlineMarks":
        """The centre (2,) of a disc that is too small for a limb."""
        return cls(centre_px[None], np.empty((0, 2)), np.empty(0), is_disc=True)

    @property
    def used(self) -> BoolArray:
        """(n,) which limb points the solution rests on."""
        return np.isfinite(self.residuals_px)

    def curves(self, enlarged: float) -> list[FloatArray]:
        """The fitted limb, (m, 2) px a piece, moved by so many times the residuals; 0: as it is."""
        used = self.used
        if used.sum() < 2:
            return []
        residuals, inward = self.residuals_px[used, None], self.inward[used]
        fitted = self.points_px[used] + residuals * inward
        steps = np.linalg.norm(np.diff(fitted, axis=0), axis=1)
        gaps = np.flatnonzero(steps > max(GAP_STEPS * float(np.median(steps)), GAP_PX)) + 1
        return np.split(fitted - enlarged * residuals * inward, gaps)


@dataclass(frozen=True)
class GateMargins:
    """Margins of a control-point pose inside the gates that accept it.

    chance_decades  powers of ten against chance beyond those asked for; refused below 0
    scatter         how wide the matches scatter over the widest accepted; refused above 1
    """

    chance_decades: float
    scatter: float


@dataclass(frozen=True)
class LensEstimate:
    """Difference of a lens from its camera file, estimated with the pose.

    focal_scale, focal_scale_sigma  focal length over the stated; None where it counts as exact
    shift_px, shift_sigma_px        of the principal point, x and y; None where it counts as exact
    """

    focal_scale: float | None = None
    focal_scale_sigma: float | None = None
    shift_px: tuple[float, float] | None = None
    shift_sigma_px: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Evidence:
    """Measurements behind a fix, or behind a failed attempt; None where it does not apply.

    n_predicted      control points expected in view, lit, unhidden and whole inside the frame
    n_matched        of these, found: the matcher accepts a place
    n_used           of these, kept by the solution
    residual_rms_px  rms of the kept points' residuals, a coordinate; of limb points across it
    n_limb           limb points that the horizon rests on
    arc_deg          of the limb that they cover, about the nadir
    matches          the control points tried; not read back with a table
    outline          of the body in the picture; not read back with a table
    margins          of the pose that the matches gave; not read back with a table
    n_windows        windows of the terrain model that a descent's solution keeps
    n_landmarks      landmarks that it keeps
    lens             what was estimated of the lens
    """

    n_predicted: int | None = None
    n_matched: int | None = None
    n_used: int | None = None
    residual_rms_px: float | None = None
    n_limb: int | None = None
    arc_deg: float | None = None
    matches: tuple[MatchRow, ...] = ()
    outline: OutlineMarks | None = None
    margins: GateMargins | None = None
    n_windows: int | None = None
    n_landmarks: int | None = None
    lens: LensEstimate | None = None


NO_EVIDENCE = Evidence()


@dataclass(frozen=True, eq=False)
class Fix:
    """A camera position, body frame, that one method measured in one picture.

    position_m          (3,)    m
    covariance_m2       (3, 3)  m^2
    camera_from_body    the attitude used (exact) or solved for; None where the caller knows it
    attitude_sigma_rad  1-sigma error of the attitude, an axis; 0 when it was taken as exact
    reason              a remark: what a reader should know

    Raises ValueError when position or covariance is not finite.
    """

    method: Method
    position_m: FloatArray
    covariance_m2: FloatArray
    camera_from_body: Rotation | None = None
    attitude_sigma_rad: float | None = None
    evidence: Evidence = NO_EVIDENCE
    reason: Reason = NO_REASON

    def __post_init__(self) -> None:
        if not (np.isfinite(self.position_m).all() and np.isfinite(self.covariance_m2).all()):
            raise ValueError("a fix needs a finite position and covariance")


@dataclass(frozen=True, eq=False)
class NoFix:
    """Why a frame has no position; `method` is the one that got farthest, if any did."""

    reason: Reason
    method: Method | None = None
    evidence: Evidence = NO_EVIDENCE


class UnsolvedFrameError(NoSolutionError):
    """A picture gave no position; `evidence` is what was tried."""

    def __init__(self, reason: Reason, evidence: Evidence = NO_EVIDENCE) -> None:
        super().__init__(reason.text, reason.code)
        self.evidence = evidence


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """A predicted position (3,), m, with its covariance (3, 3), body frame, and its source."""

    position_m: FloatArray
    covariance_m2: FloatArray
    source: str

    @classmethod
    def isotropic(cls, position_m: FloatArray, sigma_m: float, source: str) -> "PositionPrior":
        """A position with one sigma a component."""
        return cls(position_m, np.eye(3) * sigma_m**2, source)


@dataclass(frozen=True, eq=False)
class Solution:
    """One frame's fix, or why there is none.

    file     the frame's name in frames.csv
    utc      its time as frames.csv writes it
    outcome  the fix, or why there is none
    prior    where the search for control points began: "frames.csv", a method, a camera at the
             same time, an orbit arc; empty when there was none
    prior_m  (3,) that position, body frame, m; not read back with a table
    attitude_source  what the attitude is from: "frames.csv", "stars", "points"; empty without one
    """

    file: str
    utc: str
    outcome: Fix | NoFix
    prior: str = ""
    prior_m: FloatArray | None = None
    attitude_source: str = ""

    @property
    def fix(self) -> Fix | None:
        """The frame's position, if it has one."""
        return self.outcome if isinstance(self.outcome, Fix) else None

    @property
    def solved(self) -> bool:
        """Whether the frame has a position."""
        return self.fix is not None

    @property
    def status(self) -> Status:
        """Whether the frame has a position, in a word."""
        return "solved" if self.solved else "unsolved"

    @property
    def method(self) -> str:
        """Name of the method; empty when no method got so far."""
        return self.outcome.method or ""

    @property
    def evidence(self) -> Evidence:
        """Measurements behind the fix, or behind the failed attempt."""
        return self.outcome.evidence

    @property
    def reason(self) -> str:
        """Why it is unsolved, or a remark; empty otherwise."""
        return self.outcome.reason.text

    @property
    def reason_code(self) -> ReasonCode:
        """The code of the reason."""
        return self.outcome.reason.code

    @property
    def position_m(self) -> FloatArray | None:
        """(3,) camera position, body frame, m."""
        return self.fix.position_m if self.fix else None

    @property
    def covariance_m2(self) -> FloatArray | None:
        """(3, 3) covariance of the position, body frame, m^2."""
        return self.fix.covariance_m2 if self.fix else None

    @property
    def camera_from_body(self) -> Rotation | None:
        """The attitude used (exact) or solved for."""
        return self.fix.camera_from_body if self.fix else None

    @property
    def attitude_sigma_rad(self) -> float | None:
        """1-sigma error of the attitude, an axis; 0 when it was taken as exact."""
        return self.fix.attitude_sigma_rad if self.fix else None

    @property
    def n_predicted(self) -> int | None:
        """Control points expected in view."""
        return self.evidence.n_predicted

    @property
    def n_matched(self) -> int | None:
        """Control points that were matched."""
        return self.evidence.n_matched

    @property
    def n_used(self) -> int | None:
        """Control points that the solution keeps."""
        return self.evidence.n_used

    @property
    def residual_rms_px(self) -> float | None:
        """Rms residual of the points kept: a coordinate; of limb points across the limb."""
        return self.evidence.residual_rms_px

    @property
    def n_limb(self) -> int | None:
        """Limb points that the horizon rests on."""
        return self.evidence.n_limb

    @property
    def arc_deg(self) -> float | None:
        """Arc of the limb that they cover, about the nadir."""
        return self.evidence.arc_deg

    @property
    def n_windows(self) -> int | None:
        """Windows of the terrain model that a descent's solution keeps."""
        return self.evidence.n_windows

    @property
    def n_landmarks(self) -> int | None:
        """Landmarks that it keeps."""
        return self.evidence.n_landmarks

    def event(self, stage: str, seconds: float | None = None) -> dict[str, object]:
        """The fields of the frame's event in the log."""
        return {
            "stage": stage,
            "frame": self.file,
            "status": self.status,
            "method": self.method or None,
            "reason_code": self.reason_code.value or None,
            "seconds": seconds,
        }

    def with_remark(self, remark: Reason) -> "Solution":
        """The row with a remark behind its reason."""
        reason = self.outcome.reason.add_sentence(remark)
        return replace(self, outcome=replace(self.outcome, reason=reason))
