"""What one frame gave: a row of solution.csv, and the points tried for it, of matches.csv."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray

Status = Literal["solved", "unsolved"]
GAP_STEPS, GAP_PX = 5.0, 12.0  # a limb is drawn in pieces where its points stand farther apart


@dataclass(frozen=True, eq=False)
class Solution:
    """One frame's answer, or why there is none; what is unknown is None.

    file                the frame's name in frames.csv
    utc                 its time as frames.csv writes it
    status              "solved" or "unsolved"
    method              how it was solved: "control_points", "horizon", "horizon_sphere" or
                        "brightness_centre"; empty when no method got so far
    prior               where the search for control points began: "frames.csv", a method, a camera
                        at the same time, an orbit arc; empty when there was none
    reason              why it is unsolved, or a remark; empty otherwise
    position_m          (3,)    camera position, body frame, m
    covariance_m2       (3, 3)  its covariance, body frame, m^2
    camera_from_body    the attitude used (exact) or solved for
    attitude_sigma_rad  1-sigma error of the attitude, an axis; 0 when it was taken as exact
    n_predicted         control points expected in view, lit, unhidden and whole inside the frame
    n_matched           of these, found by the matcher
    n_used              of these, kept by the solution
    residual_rms_px     rms of the kept points' residuals, a coordinate; of limb points across it
    n_limb              limb points that the horizon rests on
    arc_deg             of the limb that they cover, about the nadir
    """

    file: str
    utc: str
    status: Status
    method: str = ""
    position_m: FloatArray | None = None
    covariance_m2: FloatArray | None = None
    camera_from_body: Rotation | None = None
    attitude_sigma_rad: float | None = None
    n_predicted: int | None = None
    n_matched: int | None = None
    n_used: int | None = None
    residual_rms_px: float | None = None
    reason: str = ""
    prior: str = ""
    n_limb: int | None = None
    arc_deg: float | None = None

    @property
    def solved(self) -> bool:
        """Whether the frame has a position."""
        return self.status == "solved"


@dataclass(frozen=True, eq=False)
class MatchRow:
    """One control point tried in one frame.

    file               the frame's name
    cp_id              the point's id in its catalog
    level              pyramid level of the (last) match, 0 = finest
    cp_position_m      (3,)  the point, body frame, m
    predicted_px       (2,)  where the final pose expects it, x, y
    measured_px        (2,)  where it was found; None when it was not
    score, runner_up   the best match's score and that of its best rival; None without a match
    used               whether the solution keeps it
    reason             why not; empty when used
    sun_elevation_deg  Sun above the point's horizon
    residual_px        (2,)  measured minus predicted after the solution
    catalog            the catalog's file name
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
    catalog: str = ""


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
    def of_disc(cls, centre_px: FloatArray) -> "OutlineMarks":
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


def unsolved(
    file: str,
    utc: str,
    reason: str,
    *,
    method: str = "",
    n_predicted: int | None = None,
    n_matched: int | None = None,
    n_used: int | None = None,
    prior: str = "",
) -> Solution:
    """The row of a frame that has no solution, with the reason in words."""
    return Solution(
        file=file,
        utc=utc,
        status="unsolved",
        method=method,
        n_predicted=n_predicted,
        n_matched=n_matched,
        n_used=n_used,
        prior=prior,
        reason=reason,
    )


def solved(
    file: str,
    utc: str,
    method: str,
    position_m: FloatArray,
    covariance_m2: FloatArray,
    camera_from_body: Rotation,
    attitude_sigma_rad: float,
    *,
    n_predicted: int | None = None,
    n_matched: int | None = None,
    n_used: int | None = None,
    residual_rms_px: float | None = None,
    prior: str = "",
    n_limb: int | None = None,
    arc_deg: float | None = None,
    reason: str = "",
) -> Solution:
    """The row of a solved frame; ValueError when position or covariance is not finite."""
    position = np.array(position_m, dtype=np.float64).reshape(3)
    covariance = np.array(covariance_m2, dtype=np.float64).reshape(3, 3)
    if not (np.isfinite(position).all() and np.isfinite(covariance).all()):
        raise ValueError(f"{file}: a solved frame needs a finite position and covariance")
    return Solution(
        file=file,
        utc=utc,
        status="solved",
        method=method,
        position_m=position,
        covariance_m2=covariance,
        camera_from_body=camera_from_body,
        attitude_sigma_rad=float(attitude_sigma_rad),
        n_predicted=n_predicted,
        n_matched=n_matched,
        n_used=n_used,
        residual_rms_px=None if residual_rms_px is None else float(residual_rms_px),
        prior=prior,
        n_limb=n_limb,
        arc_deg=arc_deg,
        reason=reason,
    )
