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
from catalog.geometry.ellipsoid import geodetic_from_xyz, normal_at
from catalog.geometry.latlon import latlon_from_xyz, wrap_longitude_deg
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.settings import Construction
from optnav_cli.estimation.models.points import Pose, predict
from optnav_cli.fix import (
    Evidence,
    Fix,
    MatchKind,
    MatchRow,
    Method,
    NoFix,
    Solution,
    number_of_name,
)
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.points import PickedPoint, places_of
from optnav_cli.frames.run_settings import FileAttitude, PointsSettings
from optnav_cli.points.constructions import (
    Picks,
    by_circles,
    by_tori,
    covariance_of,
    pose_at,
)
from optnav_cli.points.horizon import is_hidden
from optnav_cli.points.model import AttitudePrior, LensPrior, PickedSightings
from optnav_cli.points.resection import (
    PickedPose,
    PickedResection,
)
from optnav_cli.reasons import NO_REASON, Reason, ReasonCode, longer

PRIOR_SIGMAS = 5.0  # within which a prior decides between poses
MAX_ZENITH_DEG = 70.0  # the formula of refraction is a few per cent off there, and grows
MIN_EXACT_RAD = 5e-9  # of an attitude that counts as exact: 0.001"
REFRACTION_ROUNDS = 2
MIRRORED_READING = "once the longitudes are taken as west (a mirrored picture fits so, too)"
MAX_HIDDEN = 0.5  # of the points beyond the horizon: more are seen through the ground


@dataclass(frozen=True)
class PickedFrames:
    """How the picked points of one folder are solved: its body, its coordinates, what is asked."""

    attitude: FileAttitude
    settings: PointsSettings
    construction: Construction = "least_squares"
    judges_lens: bool = True  # whether a lens is refused against which the points speak

    @property
    def body(self) -> Body:
        """The body that the points are of."""
        return self.attitude.body

    def solve(self, frame: Frame, camera: Camera, points: Sequence[PickedPoint]) -> Solution:
        """A frame's row; what is wrong with it is the reason of an unsolved one."""
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
            outcome = NoFix(Reason.of(error), Method.PICKED_POINTS, evidence)
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
        self._places = self._placed(self._latlon, self._heights, how.settings)
        self._rays = camera.unproject(self._pixels)
        self._in_picture = camera.contains(self._pixels) & np.isfinite(self._rays).all(axis=1)
        self._low = np.zeros(len(points), dtype=bool)  # beyond MAX_ZENITH_DEG

    def fix(self) -> Fix:
        """The position. Raises NoSolutionError."""
        if not self._in_picture.any():
            camera = self._camera
            raise NoSolutionError(
                f"all {len(self._points)} points lie outside the picture of {camera.width_px} x "
                f"{camera.height_px} px; see that x_px and y_px are of this camera",
                ReasonCode.OUTSIDE_FRAME,
            )
        problem = self._problem(self._places)
        if len(problem.points) == 3 and problem.attitude is None:
            found, remark = self._of_three(problem), NO_REASON
        else:
            found, remark = self._of_many(problem)
        place, covariance, turn = found.pose.position_m, found.position_covariance_m2, None
        if self._how.construction != "least_squares":
            place, covariance, turn = self._constructed(found)
        solved = Pose(place, found.pose.camera_from_body if turn is None else turn)
        if self._is_below(solved, self._places[self._in_picture]):
            raise self._mirrored()
        matches = self.rows(found, solved)
        residuals = np.array([m.residual_px for m in matches if m.used])
        evidence = Evidence(
            n_predicted=len(self._points),
            n_matched=len(self._points),
            n_used=int(sum(m.used for m in matches)),
            residual_rms_px=float(np.sqrt((residuals**2).mean())),
            matches=matches,
            lens=found.lens if self._how.construction == "least_squares" else None,
        )
        return Fix(
            Method.PICKED_POINTS,
            place,
            covariance,
            solved.camera_from_body,
            found.attitude_sigma_rad,
            evidence,
            remark,
        )

    def rows(self, found: PickedPose | None, solved: Pose | None = None) -> tuple[MatchRow, ...]:
        """The rows of matches.csv; without a pose nothing is predicted but the picks themselves."""
        used = np.zeros(len(self._points), dtype=bool)
        predicted = self._pixels
        if found is not None:
            used[self._in_picture & ~self._low] = found.used
            pose = found.pose if solved is None else solved
            predicted, _ = predict(self._camera, pose, self._refracted(pose))
            if self._how.construction == "least_squares":
                middle = np.array(self._camera.principal_point_px)
                predicted = middle + (1.0 + found.focal) * (predicted - middle)
                predicted[self._in_picture & ~self._low] = (
                    self._pixels[self._in_picture & ~self._low] - found.residuals_px
                )
        rows = []
        for number, point in enumerate(self._points):
            reason = self._why_not(number, found, bool(used[number]))
            seen = np.isfinite(predicted[number]).all()
            expected = predicted[number] if seen else point.pixel
            rows.append(
                MatchRow(
                    self._frame.file,
                    number_of_name(point.name),
                    0,
                    self._places[number],
                    expected,
                    measured_px=point.pixel,
                    used=bool(used[number]),
                    reason=reason.text,
                    residual_px=point.pixel - expected if found is not None and seen else None,
                    reason_code=reason.code,
                    kind=MatchKind.PICKED_POINT,
                    name=point.name,
                )
            )
        return tuple(rows)

    def _why_not(self, number: int, found: PickedPose | None, used: bool) -> Reason:
        if used:
            return NO_REASON
        if not self._in_picture[number]:
            return Reason(ReasonCode.OUTSIDE_FRAME, "lies outside the picture")
        if self._low[number]:
            text = f"is seen more than {MAX_ZENITH_DEG:g} deg from the vertical, through much air"
            return Reason(ReasonCode.OUTLIER, text)
        if found is None:
            return Reason(ReasonCode.NO_SOLUTION, "the frame has no position")
        kept = np.cumsum(self._in_picture & ~self._low)[number] - 1
        off = float(np.linalg.norm(found.residuals_px[kept]))
        text = f"is a blunder: {off:.1f} px off, {self._points[number].sigma_px:g} px stated"
        return Reason(ReasonCode.OUTLIER, text)

    def _problem(self, places_m: FloatArray) -> PickedResection:
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

    def _of_many(self, problem: PickedResection) -> tuple[PickedPose, Reason]:
        found = problem.solve()
        for _ in range(REFRACTION_ROUNDS if self._body.atmosphere else 0):
            if self._is_below(found.pose, problem.points.places_m):
                raise self._mirrored()
            before = self._low
            self._low = self._zeniths(found.pose) > np.radians(MAX_ZENITH_DEG)
            problem = self._problem(self._refracted(found.pose))
            if len(problem.points) < problem.fewest:
                raise self._too_low() if found.fits else self._misfit(found)
            found = problem.solve(found if (before == self._low).all() else None)
        if not found.fits:
            raise self._misfit(found)
        found, rival = self._seen_from_above(problem, found)
        lens = problem.by_another_lens(found) if self._how.judges_lens else None
        if lens is not None:
            text = (
                f"the points fit another focal length, {longer(lens.focal)}: chi-square "
                f"{lens.cost:.0f}, {found.cost:.0f} with the one of the camera file; calibrate "
                "the camera or state its focal_length_error"
            )
            raise NoSolutionError(text, ReasonCode.WRONG_LENS)
        if rival is not None:
            chosen = problem.with_all_leans(self._decided([found, rival]))
            return chosen, Reason(ReasonCode.DEGENERATE, "the prior decides between two places")
        found = problem.with_all_leans(found)
        hidden = int(self._hidden(found.pose, problem.points.places_m[found.used]).sum())
        if found.freedom <= 2 and problem.attitude is None:
            text = "4 points leave little to check: a blunder moves the position unseen"
            return found, Reason(ReasonCode.FEW_POINTS, text)
        if hidden:
            if self._mirror_hides_fewer(hidden):
                raise self._mirrored()
            text = f"{hidden} of {found.used.sum()} points lie beyond the horizon of the ellipsoid"
            return found, Reason(ReasonCode.POINTS_HIDDEN, text)
        return found, NO_REASON

    def _seen_from_above(
        self, problem: PickedResection, found: PickedPose
    ) -> tuple[PickedPose, PickedPose | None]:
        """The pose that sees the ground from above, and its rival if that does no worse.

        Raises NoSolutionError where both see it from below.
        """
        rival = problem.rival_of(found)
        places = problem.points.places_m[found.used]
        if self._is_below(found.pose, places):
            if rival is None or self._is_below(rival.pose, places):
                raise self._mirrored()
            return rival, None
        hidden = self._hidden(found.pose, places).sum()
        if rival is not None and self._hidden(rival.pose, places).sum() > hidden:
            rival = None
        return found, rival

    def _mirror_hides_fewer(self, hidden: int) -> bool:
        """Whether the mirrored ground fits, too, with fewer points beyond the horizon than that."""
        west = self._latlon * (1.0, -1.0)
        problem = self._problem(self._placed(west, self._heights, self._how.settings))
        other = _solved(problem)
        if other is None or not other.fits:
            return False
        return bool(self._hidden(other.pose, problem.points.places_m[other.used]).sum() < hidden)

    def _hidden(self, pose: Pose, places_m: FloatArray) -> BoolArray:
        return is_hidden(pose.position_m, places_m, self._body.radii_m)

    def _is_below(self, pose: Pose, places_m: FloatArray) -> bool:
        """Whether a camera would see most places (n, 3) through the ground."""
        return bool(self._hidden(pose, places_m).mean() > MAX_HIDDEN)

    def _of_three(self, problem: PickedResection) -> PickedPose:
        places = problem.points.places_m
        found = [pose for pose in problem.of_three() if not self._is_below(pose.pose, places)]
        if not found:
            raise self._mirrored()
        return self._decided(found)

    def _decided(self, found: Sequence[PickedPose]) -> PickedPose:
        """The one pose that the prior position allows. Raises NoSolutionError with all of them."""
        prior, sigma = self._frame.position_m, self._frame.position_sigma_m
        allowed = list(found)
        if prior is not None and sigma is not None:
            allowed = []
            for pose in found:
                away = pose.pose.position_m - prior
                covariance = pose.position_covariance_m2 + np.eye(3) * sigma**2
                if float(away @ np.linalg.solve(covariance, away)) < PRIOR_SIGMAS**2:
                    allowed.append(pose)
        if len(allowed) == 1 and prior is not None:
            return allowed[0]
        used = int(found[0].used.sum())
        places = "; ".join(self._in_words(pose.pose) for pose in found)
        why = "no prior decides" if prior is None else f"the prior allows {len(allowed)} of them"
        raise NoSolutionError(
            f"{used} points are seen so from {len(found)} "
            f"{'place' if len(found) == 1 else 'places'}, and {why}: {places}; pick more points "
            "or state a prior position",
            ReasonCode.DEGENERATE,
        )

    def _in_words(self, pose: Pose) -> str:
        place = self._how.attitude.places.stated(pose.position_m)
        lat, lon, radius = latlon_from_xyz(place)
        height = radius - self._body.radius_m
        if self._body.flattening:
            lat, lon, height = geodetic_from_xyz(place, self._body.radii_m)
        words = (
            f"{np.degrees(lat):.4f} {np.degrees(lon):.4f} deg, {float(height) / 1e3:.2f} km high"
        )
        return f"geodetic {words}" if self._body.flattening else words

    def _constructed(self, found: PickedPose) -> tuple[FloatArray, FloatArray, Rotation]:
        """Place, covariance and attitude by the construction that is asked for."""
        problem = self._problem(self._refracted(found.pose))
        kept = problem.points.subset(found.used)
        rays = problem.rays[found.used]
        camera, start = self._camera, found.pose.position_m
        half = min(
            camera.width_px / camera.focal_length_px, camera.height_px / camera.coarse_focal_px
        )
        picks = Picks(kept.places_m, rays[:, :2] / rays[:, 2:], half / 2.0)

        def construct(some: Picks) -> FloatArray:
            return by_circles(some) if self._how.construction == "circles" else by_tori(some, start)

        lens = camera.focal_length_error, camera.principal_point_error_px / camera.focal_length_px
        sigma_image = kept.sigma_px / camera.focal_length_px
        covariance = covariance_of(construct, picks, sigma_image, kept.sigma_m, lens)
        pose = pose_at(construct(picks), picks)
        return pose.position_m, covariance, pose.camera_from_body

    def _placed(
        self, latlon_deg: FloatArray, heights_m: FloatArray, settings: PointsSettings
    ) -> FloatArray:
        """Places (n, 3) in the frame of the body's catalogs."""
        places = places_of(latlon_deg, heights_m, self._body, settings)
        return self._how.attitude.places.catalog(places)

    def _zeniths(self, pose: Pose) -> FloatArray:
        """Angles (n,) of the lines of sight from the vertical at the points, rad."""
        up = normal_at(self._places, self._body.radii_m)
        sights = pose.position_m - self._places
        sights /= np.linalg.norm(sights, axis=1, keepdims=True)
        found: FloatArray = np.arccos(np.clip((up * sights).sum(axis=1), -1.0, 1.0))
        return found

    def _refracted(self, pose: Pose) -> FloatArray:
        """Where straight lines of sight reach the ground: places (n, 3) farther from the nadir.

        A ray that comes straight to z from the vertical meets the ground (n - 1) H tan z / cos^2 z
        nearer to the nadir, for a camera above the air; ray tracing agrees to 3 % up to 70 deg.
        """
        air = self._body.atmosphere
        if air is None:
            return self._places
        up = normal_at(self._places, self._body.radii_m)
        sights = self._places - pose.position_m
        across = sights - (sights * up).sum(axis=1, keepdims=True) * up
        length = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        zenith = np.minimum(self._zeniths(pose), np.radians(MAX_ZENITH_DEG))
        bent = air.refractivity * air.scale_height_m * np.tan(zenith) / np.cos(zenith) ** 2
        refracted: FloatArray = self._places + across / length * bent[:, None]
        return refracted

    def _mirrored(self) -> NoSolutionError:
        text = "the points are seen so through the ground only: a mirrored picture"
        others = self._readings()
        if others:
            text += f"; they fit {others}"
        return NoSolutionError(text, ReasonCode.MIRRORED)

    def _too_low(self) -> NoSolutionError:
        text = (
            f"{self._low.sum()} of {len(self._low)} points are seen more than {MAX_ZENITH_DEG:g} "
            "deg from the vertical, through much air; pick points nearer to the nadir"
        )
        return NoSolutionError(text, ReasonCode.FEW_POINTS)

    def _misfit(self, found: PickedPose) -> NoSolutionError:
        """Why points do not fit, as far as another reading of them says."""
        left_out = int((~found.used).sum())
        text = (
            f"the points do not fit one pose: {left_out} of {len(found.used)} disagree, chi-square "
            f"{found.cost:.0f} of the others for {found.freedom} degrees of freedom"
        )
        others = self._readings()
        if others:
            mirrored = others == MIRRORED_READING
            code = ReasonCode.MIRRORED if mirrored else ReasonCode.POINTS_DISAGREE
            return NoSolutionError(f"{text}; they fit {others}", code)
        return NoSolutionError(
            f"{text}; check the coordinates, their sigmas and the lens", ReasonCode.POINTS_DISAGREE
        )

    def _readings(self) -> str:
        """Other readings of the coordinates, in words, by which the points fit one pose."""
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
        found = []
        for text, latlon, heights, how in tries:
            problem = self._problem(self._placed(latlon, heights, how))
            if self._fits(problem):
                found.append(text)
        problem = self._problem(self._places).any_lens
        if not found and len(problem.points) > 4:
            lens = _solved(problem)
            if lens is not None and lens.fits:
                found.append(f"with a focal length {longer(lens.focal)}")
        return ", or ".join(found)

    def _fits(self, problem: PickedResection) -> bool:
        found = _solved(problem)
        if found is None or not found.fits:
            return False
        return not self._is_below(found.pose, problem.points.places_m[found.used])


def _solved(problem: PickedResection) -> PickedPose | None:
    try:
        return problem.solve()
    except NoSolutionError:
        return None
