"""Trials of the matching study: points looked for in pictures from poses that are wrong."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import Matcher
from catalog.correlation.surf64 import match_surf
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.resection import Pose
from optnav_cli.matching.picture_pyramid import PicturePyramid
from optnav_cli.matching.point_match import MatchGates, match_point
from optnav_cli.matching.reference import Reference
from optnav_cli.matching.search_plan import (
    NO_DISTORTION,
    Distortion,
    SearchPlan,
    plan_distortion,
)
from optnav_cli.navigation.settings import MatchSettings
from optnav_cli.simulation.sections import SensorSettings
from optnav_cli.simulation.sensor import expose
from optnav_cli.studies.matching_scene import RIGHT, Scene, Wrong, wrong_pose

MATCHERS: dict[str, Matcher] = {"NCC": match_ncc, "SURF-64": match_surf}
TEMPLATE_NODES, SEARCH_NODES, SHIFT_NODES = 64, 8, 5.0
FRAME_MARGIN_PX = 80.0  # half a search window, stretched and turned as the worst prior does
# Of the pictures whose error is not their noise.
SNR = 50.0
SEARCH_SIGMAS = 2.0


@dataclass(frozen=True)
class Axis:
    """One kind of error: its values, from the harmless end on, and what the seed states."""

    name: str
    unit: str
    values: tuple[float, ...]
    stated: float
    aid: str


AXES = (
    Axis("noise", "SNR", (50.0, 20.0, 10.0, 5.0, 3.0, 2.0, 1.4, 1.0), 10.0,
         "one level coarser"),
    Axis("scale", "%", (0.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0), 10.0,
         "scales searched"),
    Axis("off nadir", "°", (0.0, 15.0, 25.0, 35.0, 45.0, 55.0), 25.0,
         "view known"),
    Axis("roll", "°", (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0), 6.0,
         "rolls searched"),
)  # fmt: skip
NOISE, SCALE, SLANT, ROLL = AXES


@dataclass(frozen=True)
class Trial:
    """A point looked for once.

    error_nodes  distance of the best place from the truth, finest nodes; None without a place
    believed     whether the navigator's gates pass the match
    """

    axis: str
    value: float
    matcher: str
    aided: bool
    error_nodes: float | None
    believed: bool


def trials_of(scene: Scene, points: Sequence[Reference], camera: Camera, seed: int) -> list[Trial]:
    """What one picture is good for: its slant, and every other error when it has none."""
    seen = [point for point in points if _whole(point, scene.pose, camera)]
    rng = np.random.default_rng([seed, scene.number, round(scene.off_nadir_deg)])
    look = Look(scene, seen, camera, rng)
    found: list[Trial] = []
    picture = look.picture(SNR)
    found += look.trials(SLANT, scene.off_nadir_deg, False, picture, wrong=Wrong(lean=True))
    found += look.trials(SLANT, scene.off_nadir_deg, True, picture)
    if scene.off_nadir_deg > 0.0:
        return found
    for value in SCALE.values:
        wrong = Wrong(scale=value / 100.0)
        found += look.trials(SCALE, value, False, picture, wrong=wrong)
        found += look.trials(SCALE, value, True, picture, wrong=wrong, distortion=scale_search())
    for value in ROLL.values:
        wrong = Wrong(roll=float(np.radians(value)))
        found += look.trials(ROLL, value, False, picture, wrong=wrong)
        found += look.trials(ROLL, value, True, picture, wrong=wrong, distortion=roll_search())
    for value in NOISE.values:
        picture = look.picture(value)
        found += look.trials(NOISE, value, False, picture)
        found += look.trials(NOISE, value, True, picture, level=1)
    return found


def scale_search() -> Distortion:
    """What the navigator searches when the largest error of the study is two of its sigmas."""
    sigma = max(SCALE.values) / 100.0 / SEARCH_SIGMAS
    return plan_distortion(TEMPLATE_NODES, 0.0, sigma, SEARCH_SIGMAS)


def roll_search() -> Distortion:
    """The same for rolls."""
    sigma = float(np.radians(max(ROLL.values))) / SEARCH_SIGMAS
    return plan_distortion(TEMPLATE_NODES, sigma, 0.0, SEARCH_SIGMAS)


class Look:
    """Looks for points in pictures of one scene."""

    def __init__(
        self, scene: Scene, points: Sequence[Reference], camera: Camera, rng: np.random.Generator
    ) -> None:
        self.scene, self.points, self.camera, self.rng = scene, points, camera, rng
        settings = MatchSettings()
        self.gates = MatchGates(settings.min_score, settings.rival_ratio)

    def picture(self, snr: float) -> PicturePyramid:
        """The scene blurred, noisy and in 8 bits."""
        counts = expose(self.scene.radiance, SensorSettings(snr=snr), self.rng)
        return PicturePyramid(counts.astype(np.float32))

    def trials(
        self, axis: Axis, value: float, aided: bool, picture: PicturePyramid, *,
        wrong: Wrong = RIGHT, level: int = 0, distortion: Distortion = NO_DISTORTION,
    ) -> Iterator[Trial]:  # fmt: skip
        """Every point by every matcher from a pose that is wrong, by either sign in turn."""
        for number, point in enumerate(self.points):
            error = wrong.other_way() if number % 2 else wrong
            told = wrong_pose(self.scene.pose, point.point.xyz_m, error)
            shift = self.rng.uniform(-SHIFT_NODES, SHIFT_NODES, 2) * point.patches[0].posting_m
            east, north, _ = point.projection.body_from_local.T
            told = Pose(told.position_m + shift[0] * east + shift[1] * north, told.camera_from_body)
            for name, matcher in MATCHERS.items():
                off, believed = self._error(point, told, picture, level, matcher, distortion)
                held = self._slant(point) if axis is SLANT else value
                yield Trial(axis.name, held, name, aided, off, believed)

    def _slant(self, point: Reference) -> float:
        """Off-nadir angle at a point, rounded to the study's values: it changes over a picture."""
        place = point.point.xyz_m
        away = self.scene.pose.position_m - place
        cosine = place @ away / np.linalg.norm(place) / np.linalg.norm(away)
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
        return min(SLANT.values, key=lambda value: abs(value - angle))

    def _error(
        self, point: Reference, told: Pose, picture: PicturePyramid, level: int,
        matcher: Matcher, distortion: Distortion,
    ) -> tuple[float | None, bool]:  # fmt: skip
        """Distance from the truth, finest nodes, and whether the gates pass the match."""
        place, pose = point.point.xyz_m, self.scene.pose
        distance = float(np.linalg.norm(told.position_m - place))
        sample = distance / self.camera.focal_length_px
        match = match_point(
            point,
            SearchPlan(level, TEMPLATE_NODES, SEARCH_NODES, sample, distortion),
            picture,
            self.camera,
            told,
            self.scene.sun_body,
            matcher,
            self.gates,
        )
        if match.pixel is None:
            return None, False
        truth = self.camera.project_from_body(
            place, pose.position_m, pose.camera_from_body.as_matrix()
        )
        off = float(np.linalg.norm(match.pixel - truth)) * sample / point.patches[0].posting_m
        return off, not match.reason


def _whole(point: Reference, pose: Pose, camera: Camera) -> bool:
    """Whether a point's search window lies in the frame, whatever the errors do to it."""
    pixel = camera.project_from_body(
        point.point.xyz_m, pose.position_m, pose.camera_from_body.as_matrix()
    )
    return bool(camera.contains(pixel, FRAME_MARGIN_PX))
