"""A camera's position from the picked points of a picture: what a frame with points.csv gets.

No prior is needed and the picture itself is not looked at. Where the points do not fit, other
readings of their coordinates are tried, and the reason names one that does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.body import Body
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import geodetic_from_xyz
from catalog.geometry.latlon import latlon_from_xyz, wrap_longitude_deg
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.settings import Construction
from optnav_cli.estimation.models.points import (
    MAX_ZENITH_DEG,
    Pose,
    compute_zeniths,
    correct_refraction,
    predict,
)
from optnav_cli.fix import Evidence, Fix, MatchKind, MatchRow, Method, NoFix, Solution, hash_name
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.points import PickedPoint, locate_points
from optnav_cli.frames.run_settings import FileAttitude, PointsSettings
from optnav_cli.points.constructions import (
    Picks,
    fit_attitude_at,
    locate_by_circles,
    locate_by_tori,
    propagate_covariance,
)
from optnav_cli.points.model import AttitudePrior, LensPrior, PickedSightings, is_hidden
from optnav_cli.points.resection import PickedPose, PickedResection, try_solve
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode, describe_length

PRIOR_SIGMAS = 5.0  # within which a prior decides between poses
MIN_EXACT_RAD = 5e-9  # of an attitude that counts as exact: 0.001"
REFRACTION_ROUNDS = 2
MIRRORED_READING = "once the longitudes are taken as west (a mirrored picture fits so, too)"
MAX_HIDDEN = 0.5  # of the points beyond the horizon: more are seen through the ground


@dataclass(frozen=True)
class PickedFrames:
    """Picked points of one folder: its body, its coordinates, how they are solved."""

    attitude: FileAttitude
    settings: PointsSettings
    construction: Construction = "least_squares"
    judges_lens: bool = True  # whether a lens is refused against which the points speak

    @property
    def body(self) -> Body:
        """The body that the points are of."""
        return self.attitude.body

    def solve(self, frame: Frame, camera: Camera, points: Sequence[PickedPoint]) -> Solution:
        """Solve a frame; the reason of an unsolved one says what is wrong with it."""
        if not points:
            reason = Reason(ReasonCode.FEW_POINTS, "points.csv has no points of this picture")
            return Solution(frame.file, frame.utc, NoFix(reason, Method.PICKED_POINTS))
        work = _FrameOfPoints(self, frame, camera, points)
        try:
            outcome: Fix | NoFix = work.fix()
        except NoSolutionError as error:
            evidence = Evidence(
                n_predicted=len(points), n_matched=len(points), matches=work.rows(None)
            )
            outcome = NoFix(Reason.from_error(error), Method.PICKED_POINTS, evidence)
        return Solution(frame.file, frame.utc, outcome)


class _FrameOfPoints:
    """The points of one picture."""

    def __init__(
        self, how: PickedFrames, frame: Frame, camera: Camera, points: Sequence[PickedPoint]
    ) -> None:
        self._how, self._frame, self._camera, self._points = how, frame, camera, points
        self._body = how.body
        self._latlon = np.array([point.latlon_deg for point in points])
        self._heights = np.array([point.height_m for point in points])
        self._pixels = np.array([point.pixel for point in points])
        self._places = self._locate_points(self._latlon, self._heights, how.settings)
        self._rays = camera.unproject(self._pixels)
        self._in_picture = camera.contains(self._pixels) & np.isfinite(self._rays).all(axis=1)
        self._low = np.zeros(len(points), dtype=bool)  # beyond MAX_ZENITH_DEG

    def fix(self) -> Fix:
        """Solve the position. Raises NoSolutionError."""
        if not self._in_picture.any():
            camera = self._camera
            raise NoSolutionError(
                f"all {len(self._points)} points lie outside the picture of {camera.width_px} x "
                f"{camera.height_px} px; see that x_px and y_px are of this camera",
                ReasonCode.OUTSIDE_FRAME,
            )
        problem = self._build_problem(self._places)
        if len(problem.points) == 3 and problem.attitude is None:
            picked, remark = self._solve_three(problem), NO_REASON
        else:
            picked, remark = self._solve_many(problem)
        position, covariance, turn = picked.pose.position_m, picked.position_covariance_m2, None
        if self._how.construction != "least_squares":
            position, covariance, turn = self._locate_by_construction(picked)
        solved = Pose(position, picked.pose.camera_from_body if turn is None else turn)
        if self._is_below(solved, self._places[self._in_picture]):
            raise self._explain_mirrored()
        matches = self.rows(picked, solved)
        residuals = np.array([m.residual_px for m in matches if m.used])
        evidence = Evidence(
            n_predicted=len(self._points),
            n_matched=len(self._points),
            n_used=int(sum(m.used for m in matches)),
            residual_rms_px=float(np.sqrt((residuals**2).mean())),
            matches=matches,
            lens=picked.lens if self._how.construction == "least_squares" else None,
        )
        return Fix(
            Method.PICKED_POINTS,
            position,
            covariance,
            solved.camera_from_body,
            picked.attitude_sigma_rad,
            evidence,
            remark,
        )

    def rows(self, picked: PickedPose | None, solved: Pose | None = None) -> tuple[MatchRow, ...]:
        """Build the rows of matches.csv; without a pose the picks predict themselves."""
        used = np.zeros(len(self._points), dtype=bool)
        predicted = self._pixels
        if picked is not None:
            used[self._in_picture & ~self._low] = picked.used
            pose = picked.pose if solved is None else solved
            predicted, _ = predict(self._camera, pose, self._correct_refraction(pose))
            if self._how.construction == "least_squares":
                middle = np.array(self._camera.principal_point_px)
                predicted = middle + (1.0 + picked.focal) * (predicted - middle)
                predicted[self._in_picture & ~self._low] = (
                    self._pixels[self._in_picture & ~self._low] - picked.residuals_px
                )
        rows = []
        for number, point in enumerate(self._points):
            reason = self._explain_unused(number, picked, bool(used[number]))
            seen = np.isfinite(predicted[number]).all()
            expected = predicted[number] if seen else point.pixel
            rows.append(
                MatchRow(
                    self._frame.file,
                    hash_name(point.name),
                    0,
                    self._places[number],
                    expected,
                    measured_px=point.pixel,
                    used=bool(used[number]),
                    reason=reason.text,
                    residual_px=point.pixel - expected if picked is not None and seen else None,
                    reason_code=reason.code,
                    kind=MatchKind.PICKED_POINT,
                    name=point.name,
                )
            )
        return tuple(rows)

    def _explain_unused(self, number: int, picked: PickedPose | None, used: bool) -> Reason:
        if used:
            return NO_REASON
        if not self._in_picture[number]:
            return Reason(ReasonCode.OUTSIDE_FRAME, "lies outside the picture")
        if self._low[number]:
            text = f"is seen more than {MAX_ZENITH_DEG:g} deg from the vertical, through much air"
            return Reason(ReasonCode.OUTLIER, text)
        if picked is None:
            return Reason(ReasonCode.NO_SOLUTION, "the frame has no position")
        kept = np.cumsum(self._in_picture & ~self._low)[number] - 1
        off = float(np.linalg.norm(picked.residuals_px[kept]))
        text = f"is a blunder: {off:.1f} px off, {self._points[number].sigma_px:g} px stated"
        return Reason(ReasonCode.OUTLIER, text)

    def _build_problem(self, places_m: FloatArray) -> PickedResection:
        some = self._in_picture & ~self._low
        points = PickedSightings(
            places_m[some],
            self._pixels[some],
            np.array([point.sigma_px for point in self._points])[some],
            np.array([point.sigma_m for point in self._points])[some],
        )
        camera = self._camera
        lens = LensPrior(
            camera.focal_length_error,
            camera.principal_point_error_px,
            np.array(camera.principal_point_px),
        )
        turn, sigma = self._frame.camera_from_body, self._frame.attitude_sigma_rad
        attitude = None
        if turn is not None and sigma is not None:
            attitude = AttitudePrior(turn, max(sigma, MIN_EXACT_RAD))
        return PickedResection(camera, points, self._rays[some], lens, attitude)

    def _solve_many(self, problem: PickedResection) -> tuple[PickedPose, Reason]:
        picked = problem.solve()
        for _ in range(REFRACTION_ROUNDS if self._body.atmosphere else 0):
            if self._is_below(picked.pose, problem.points.places_m):
                raise self._explain_mirrored()
            before = self._low
            zeniths = compute_zeniths(self._places, picked.pose.position_m, self._body)
            self._low = zeniths > np.radians(MAX_ZENITH_DEG)
            problem = self._build_problem(self._correct_refraction(picked.pose))
            if len(problem.points) < problem.fewest:
                raise self._explain_too_low() if picked.fits else self._explain_misfit(picked)
            picked = problem.solve(picked if (before == self._low).all() else None)
        if not picked.fits:
            raise self._explain_misfit(picked)
        picked, rival = self._choose_pose_above(problem, picked)
        lens = problem.fit_another_lens(picked) if self._how.judges_lens else None
        if lens is not None:
            text = (
                f"the points fit another focal length, {describe_length(lens.focal)}: chi-square "
                f"{lens.cost:.0f}, {picked.cost:.0f} with the one of the camera file; calibrate "
                "the camera or state its focal_length_error"
            )
            raise NoSolutionError(text, ReasonCode.WRONG_LENS)
        if rival is not None:
            chosen = problem.expand_over_leans(self._choose_by_prior([picked, rival]))
            return chosen, Reason(ReasonCode.DEGENERATE, "the prior decides between two places")
        picked = problem.expand_over_leans(picked)
        hidden = int(self._find_hidden(picked.pose, problem.points.places_m[picked.used]).sum())
        if picked.freedom <= 2 and problem.attitude is None:
            text = "4 points leave little to check: a blunder moves the position unseen"
            return picked, Reason(ReasonCode.FEW_POINTS, text)
        if hidden:
            if self._is_mirror_hiding_fewer(hidden):
                raise self._explain_mirrored()
            text = f"{hidden} of {picked.used.sum()} points lie beyond the horizon of the ellipsoid"
            return picked, Reason(ReasonCode.POINTS_HIDDEN, text)
        return picked, NO_REASON

    def _choose_pose_above(
        self, problem: PickedResection, picked: PickedPose
    ) -> tuple[PickedPose, PickedPose | None]:
        """Choose the pose that sees the ground from above, and its rival if that does no worse.

        Raises NoSolutionError where both see it from below.
        """
        rival = problem.find_rival(picked)
        places = problem.points.places_m[picked.used]
        if self._is_below(picked.pose, places):
            if rival is None or self._is_below(rival.pose, places):
                raise self._explain_mirrored()
            return rival, None
        hidden = self._find_hidden(picked.pose, places).sum()
        if rival is not None and self._find_hidden(rival.pose, places).sum() > hidden:
            rival = None
        return picked, rival

    def _is_mirror_hiding_fewer(self, hidden: int) -> bool:
        """Whether the mirrored ground fits, too, with fewer points beyond the horizon."""
        west = self._latlon * (1.0, -1.0)
        problem = self._build_problem(self._locate_points(west, self._heights, self._how.settings))
        other = try_solve(problem)
        if other is None or not other.fits:
            return False
        return bool(
            self._find_hidden(other.pose, problem.points.places_m[other.used]).sum() < hidden
        )

    def _find_hidden(self, pose: Pose, places_m: FloatArray) -> BoolArray:
        return is_hidden(pose.position_m, places_m, self._body.radii_m)

    def _is_below(self, pose: Pose, places_m: FloatArray) -> bool:
        """Whether a camera would see most places (n, 3) through the ground."""
        return bool(self._find_hidden(pose, places_m).mean() > MAX_HIDDEN)

    def _solve_three(self, problem: PickedResection) -> PickedPose:
        places = problem.points.places_m
        poses = [pose for pose in problem.solve_three() if not self._is_below(pose.pose, places)]
        if not poses:
            raise self._explain_mirrored()
        return self._choose_by_prior(poses)

    def _choose_by_prior(self, poses: Sequence[PickedPose]) -> PickedPose:
        """Choose the one pose that the prior allows. Raises NoSolutionError with all of them."""
        prior, sigma = self._frame.position_m, self._frame.position_sigma_m
        allowed = list(poses)
        if prior is not None and sigma is not None:
            allowed = []
            for pose in poses:
                offset = pose.pose.position_m - prior
                covariance = pose.position_covariance_m2 + np.eye(3) * sigma**2
                if float(offset @ np.linalg.solve(covariance, offset)) < PRIOR_SIGMAS**2:
                    allowed.append(pose)
        if len(allowed) == 1 and prior is not None:
            return allowed[0]
        used = int(poses[0].used.sum())
        places = "; ".join(self._describe_position(pose.pose) for pose in poses)
        why = "no prior decides" if prior is None else f"the prior allows {len(allowed)} of them"
        raise NoSolutionError(
            f"{used} points are seen so from {len(poses)} "
            f"{'place' if len(poses) == 1 else 'places'}, and {why}: {places}; pick more points "
            "or state a prior position",
            ReasonCode.DEGENERATE,
        )

    def _describe_position(self, pose: Pose) -> str:
        position = self._how.attitude.places.transform_to_stated(pose.position_m)
        lat, lon, radius = latlon_from_xyz(position)
        height = radius - self._body.radius_m
        if self._body.flattening:
            lat, lon, height = geodetic_from_xyz(position, self._body.radii_m)
        words = (
            f"{np.degrees(lat):.4f} {np.degrees(lon):.4f} deg, {float(height) / 1e3:.2f} km high"
        )
        return f"geodetic {words}" if self._body.flattening else words

    def _locate_by_construction(
        self, picked: PickedPose
    ) -> tuple[FloatArray, FloatArray, Rotation]:
        """Return place, covariance and attitude by the construction that is asked for."""
        problem = self._build_problem(self._correct_refraction(picked.pose))
        kept = problem.points.subset(picked.used)
        rays = problem.rays[picked.used]
        camera, start = self._camera, picked.pose.position_m
        half = min(
            camera.width_px / camera.focal_length_px, camera.height_px / camera.coarse_focal_px
        )
        picks = Picks(kept.places_m, rays[:, :2] / rays[:, 2:], half / 2.0)

        def construct(some: Picks) -> FloatArray:
            return (
                locate_by_circles(some)
                if self._how.construction == "circles"
                else locate_by_tori(some, start)
            )

        lens = camera.focal_length_error, camera.principal_point_error_px / camera.focal_length_px
        sigma_image = kept.sigma_px / camera.focal_length_px
        covariance = propagate_covariance(construct, picks, sigma_image, kept.sigma_m, lens)
        pose = fit_attitude_at(construct(picks), picks)
        return pose.position_m, covariance, pose.camera_from_body

    def _locate_points(
        self, latlon_deg: FloatArray, heights_m: FloatArray, settings: PointsSettings
    ) -> FloatArray:
        """Return places (n, 3) in the frame of the body's catalogs."""
        places = locate_points(latlon_deg, heights_m, self._body, settings)
        return self._how.attitude.places.transform_to_catalog(places)

    def _correct_refraction(self, pose: Pose) -> FloatArray:
        return correct_refraction(self._places, pose.position_m, self._body)

    def _explain_mirrored(self) -> NoSolutionError:
        text = "the points are seen so through the ground only: a mirrored picture"
        others = self._try_readings()
        if others:
            text += f"; they fit {others}"
        return NoSolutionError(text, ReasonCode.MIRRORED)

    def _explain_too_low(self) -> NoSolutionError:
        text = (
            f"{self._low.sum()} of {len(self._low)} points are seen more than {MAX_ZENITH_DEG:g} "
            "deg from the vertical, through much air; pick points nearer to the nadir"
        )
        return NoSolutionError(text, ReasonCode.FEW_POINTS)

    def _explain_misfit(self, picked: PickedPose) -> NoSolutionError:
        """Explain why points do not fit, as far as another reading of them says."""
        left_out = int((~picked.used).sum())
        text = (
            f"the points do not fit one pose: {left_out} of {len(picked.used)} disagree, "
            f"chi-square {picked.cost:.0f} of the others for {picked.freedom} degrees of freedom"
        )
        others = self._try_readings()
        if others:
            mirrored = others == MIRRORED_READING
            code = ReasonCode.MIRRORED if mirrored else ReasonCode.POINTS_DISAGREE
            return NoSolutionError(f"{text}; they fit {others}", code)
        return NoSolutionError(
            f"{text}; check the coordinates, their sigmas and the lens", ReasonCode.POINTS_DISAGREE
        )

    def _try_readings(self) -> str:
        """Try other readings of the coordinates; return in words those by which the points fit."""
        settings, lat, lon = self._how.settings, self._latlon[:, 0], self._latlon[:, 1]
        geodetic = settings.latitude == "geodetic"
        other = PointsSettings("planetocentric" if geodetic else "geodetic", settings.height)
        swapped = np.column_stack([wrap_longitude_deg(lon), lat])
        west = np.column_stack([lat, -lon])
        tries: list[tuple[str, FloatArray, FloatArray, PointsSettings]] = []
        if np.abs(swapped[:, 0]).max() <= 90.0:
            words = "once lat_deg and lon_deg are exchanged"
            tries.append((words, swapped, self._heights, settings))
        tries.append((MIRRORED_READING, west, self._heights, settings))
        words = f'with latitude = "{other.latitude}" in [points] of run.toml'
        a, b, c = self._body.radii_m
        if a == b != c:
            tries.append((words, self._latlon, self._heights, other))
        low, high = self._body.plausible_heights_m
        if low <= 1e3 * self._heights.min() and 1e3 * self._heights.max() <= high:
            words = "with heights 1000 times larger: height_m is in metres"
            tries.append((words, self._latlon, 1e3 * self._heights, settings))
        # which places are seen through much air hangs on the reading
        self._low = np.zeros(len(self._points), dtype=bool)
        fitting = []
        for text, latlon, heights, how in tries:
            problem = self._build_problem(self._locate_points(latlon, heights, how))
            if self._is_fitting(problem):
                fitting.append(text)
        problem = self._build_problem(self._places).any_lens
        if not fitting and len(problem.points) > 4:
            lens = try_solve(problem)
            if lens is not None and lens.fits:
                fitting.append(f"with a focal length {describe_length(lens.focal)}")
        return ", or ".join(fitting)

    def _is_fitting(self, problem: PickedResection) -> bool:
        picked = try_solve(problem)
        if picked is None or not picked.fits:
            return False
        return not self._is_below(picked.pose, problem.points.places_m[picked.used])
