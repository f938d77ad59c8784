"""The matching study's pictures and trials: points looked for from poses that are wrong.

The points are those of a real catalog, the pictures show richer ground.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import Matcher
from catalog.correlation.surf64 import match_surf
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from catalog.pipeline import build
from catalog.progress import Progress
from catalog.rendering.rays.scene import Scene as LitGround
from catalog.store.reader import Catalog
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.picture_pyramid import PicturePyramid
from optnav_cli.control_points.point_match import MatchGates, match_point
from optnav_cli.control_points.reference import Reference
from optnav_cli.control_points.search_plan import (
    NO_DISTORTION,
    Distortion,
    SearchPlan,
    plan_distortion,
)
from optnav_cli.control_points.settings import MatchSettings
from optnav_cli.estimation.models.points import Pose
from optnav_cli.simulation.region_ground import WHOLE, TruthTerrain
from optnav_cli.simulation.scenario_base import corner_rays
from optnav_cli.simulation.sections import DetailSettings, SensorSettings, relief_below
from optnav_cli.simulation.sensor import expose

DEM, GLOBE = "data/tycho_gld100_256ppd.tif", "data/moon_gld100_4ppd.tif"
MIDDLE_DEG = (-43.0, -11.0)  # of the terrain model
# The seen ground has nodes of half the catalog's, with what a scenario adds by itself.
POSTING_M, FINER = 118.45, 2
DETAIL = DetailSettings(smallest_m=30.0, rms_slope_deg=3.0, saturation=0.05)
SUN_ELEVATIONS_DEG = (25.0, 15.0, 35.0, 20.0, 30.0, 40.0)
MATCHERS: dict[str, Matcher] = {"NCC": match_ncc, "SURF-64": match_surf}
GATES = MatchGates(MatchSettings().min_score, MatchSettings().rival_ratio)
TEMPLATE_NODES, SEARCH_NODES, SHIFT_NODES = 64, 8, 5.0
FRAME_MARGIN_PX = 80.0  # half a search window, stretched and turned as the worst prior does
# Of the pictures whose error is not their noise.
SNR = 50.0
SEARCH_SIGMAS = 2.0


@dataclass(frozen=True, eq=False)
class StudyPicture:
    """One picture before its noise.

    radiance       (h, w)  over the pixels
    pose           from which it was taken; sun_body (3,) unit vector
    off_nadir_deg  at the middle of the picture
    """

    number: int
    radiance: Float32Array
    pose: Pose
    sun_body: FloatArray
    off_nadir_deg: float


def references(work: Path, progress: Progress) -> list[Reference]:
    """The usable control points of the bundled Tycho terrain, from a catalog built in `work`."""
    path = work / "tycho.gpkg"
    build.run(resource("configs/catalogs/tycho.toml"), output=path, progress=progress)
    with Catalog.open(path) as catalog:
        radius = catalog.meta.radius_m
        return [
            Reference(catalog.point(int(cp)), catalog.patches(int(cp)), radius)
            for cp in catalog.ids[catalog.usable]
        ]


def draw_scenes(
    camera: Camera, range_m: float, count: int, progress: Progress
) -> Iterator[StudyPicture]:
    """Pictures of the terrain's middle; `count` Suns and grounds, each from all angles off nadir.

    range_m  from the camera to the ground in the middle
    """
    body, angles = load_body("moon"), SLANT.values
    lat, lon = np.radians(MIDDLE_DEG)
    local, middle = body_from_local(lat, lon), xyz_from_latlon(lat, lon, body.radius_m)
    corners = corner_rays(camera)
    details: dict[int | None, SyntheticRelief | None] = {
        number: relief_below(DETAIL, number + 1, POSTING_M, body.radius_m)
        for number in range(count)
    }
    terrain = TruthTerrain(
        body, (DemSettings(str(resource(DEM))),), DemSettings(str(resource(GLOBE))), details
    )
    with progress.stage("look", count * len(angles), "picture") as bar:
        for number in range(count):
            sun = local @ _sun_local(number)
            ground = LitGround(terrain.window(number, FINER, WHOLE), terrain.wide(number), sun)
            for angle in angles:
                pose = _pose(local, middle, range_m, angle if number % 2 else -angle)
                rays = corners @ pose.camera_from_body.as_matrix()
                radiance = ground.picture(pose.position_m, rays)
                yield StudyPicture(number, radiance, pose, sun, angle)
                bar.advance()  # with what the caller does with it


def _sun_local(number: int) -> FloatArray:
    """Morning or evening, low or high: unit vector east, north, up."""
    elevation = np.radians(SUN_ELEVATIONS_DEG[number % len(SUN_ELEVATIONS_DEG)])
    east = 1.0 if number // 2 % 2 else -1.0
    return np.array([east * np.cos(elevation), 0.0, np.sin(elevation)])


def _pose(local: FloatArray, middle: FloatArray, range_m: float, off_nadir_deg: float) -> Pose:
    """A camera that looks at the middle of the ground from the north (south when negative).

    So never along the Sun's rays, which come from east or west.
    """
    angle = np.radians(off_nadir_deg)
    up = local @ np.array([0.0, np.sin(angle), np.cos(angle)])
    right = local[:, 0]
    attitude = Rotation.from_matrix(np.stack([right, np.cross(-up, right), -up]))
    return Pose(middle + range_m * up, attitude)


@dataclass(frozen=True)
class Wrong:
    """How a stated pose is wrong about a point, which keeps its pixel.

    roll   rad about the line of sight
    scale  relative error of the distance
    lean   the view is taken to be from straight above the point
    """

    roll: float = 0.0
    scale: float = 0.0
    lean: bool = False

    def other_way(self) -> "Wrong":
        """The same by the opposite sign."""
        return Wrong(-self.roll, -self.scale, self.lean)


RIGHT = Wrong()


def wrong_pose(pose: Pose, point_m: FloatArray, wrong: Wrong) -> Pose:
    """The pose that is stated when `pose` is the truth; point_m (3,) body frame."""
    away = pose.position_m - point_m
    attitude = pose.camera_from_body
    distance = float(np.linalg.norm(away))
    attitude = attitude * Rotation.from_rotvec(wrong.roll * away / distance)
    if wrong.lean:
        vertical = point_m / np.linalg.norm(point_m)
        turn, _ = Rotation.align_vectors(vertical[None], away[None] / distance)
        away, attitude = turn.apply(away), attitude * turn.inv()
    return Pose(point_m + (1.0 + wrong.scale) * away, attitude)


@dataclass(frozen=True)
class Axis:
    """One kind of error: its values, from the harmless end on, and what the source states."""

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
    accepted     whether the navigator's gates pass the match
    """

    axis: str
    value: float
    matcher: str
    aided: bool
    error_nodes: float | None
    accepted: bool


def trials_of(
    scene: StudyPicture, points: Sequence[Reference], camera: Camera, seed: int
) -> list[Trial]:
    """What one picture is good for: its slant, and every other error when it has none."""
    # points whose search window lies in the frame, whatever the errors do to it
    seen = [
        point
        for point in points
        if camera.contains(_pixel(point, scene.pose, camera), FRAME_MARGIN_PX)
    ]
    rng = np.random.default_rng([seed, scene.number, round(scene.off_nadir_deg)])
    look = Look(scene, seen, camera, rng)
    found: list[Trial] = []
    picture = look.picture(SNR)
    found += look.trials(SLANT, scene.off_nadir_deg, False, picture, wrong=Wrong(lean=True))
    found += look.trials(SLANT, scene.off_nadir_deg, True, picture)
    if scene.off_nadir_deg > 0.0:
        return found
    # what the navigator searches when the largest error is as many of its sigmas
    sigma = max(SCALE.values) / 100.0 / SEARCH_SIGMAS
    scales = plan_distortion(TEMPLATE_NODES, 0.0, sigma, SEARCH_SIGMAS)
    cases = [(SCALE, value, Wrong(scale=value / 100.0), scales) for value in SCALE.values]
    cases += [(ROLL, v, Wrong(roll=float(np.radians(v))), roll_search()) for v in ROLL.values]
    for axis, value, wrong, searched in cases:
        found += look.trials(axis, value, False, picture, wrong=wrong)
        found += look.trials(axis, value, True, picture, wrong=wrong, distortion=searched)
    for value in NOISE.values:
        picture = look.picture(value)
        found += look.trials(NOISE, value, False, picture)
        found += look.trials(NOISE, value, True, picture, level=1)
    return found


def roll_search() -> Distortion:
    """The navigator's search when the study's largest roll is as many of its sigmas."""
    sigma = float(np.radians(max(ROLL.values))) / SEARCH_SIGMAS
    return plan_distortion(TEMPLATE_NODES, sigma, 0.0, SEARCH_SIGMAS)


@dataclass(frozen=True, eq=False)
class Look:
    """Looks for points in pictures of one scene."""

    scene: StudyPicture
    points: Sequence[Reference]
    camera: Camera
    rng: np.random.Generator

    def picture(self, snr: float) -> PicturePyramid:
        """The scene blurred, noisy and in 8 bits."""
        counts = expose(self.scene.radiance, SensorSettings(snr=snr), self.rng)
        return PicturePyramid(counts.astype(np.float32))

    def trials(
        self,
        axis: Axis,
        value: float,
        aided: bool,
        picture: PicturePyramid,
        *,
        wrong: Wrong = RIGHT,
        level: int = 0,
        distortion: Distortion = NO_DISTORTION,
    ) -> Iterator[Trial]:
        """Every point by every matcher from a pose that is wrong, by either sign in turn."""
        camera, pose, sun = self.camera, self.scene.pose, self.scene.sun_body
        for number, point in enumerate(self.points):
            error = wrong.other_way() if number % 2 else wrong
            stated = wrong_pose(pose, point.point.xyz_m, error)
            shift = self.rng.uniform(-SHIFT_NODES, SHIFT_NODES, 2) * point.patches[0].posting_m
            east, north, _ = point.projection.body_from_local.T
            place = stated.position_m + shift[0] * east + shift[1] * north
            stated = Pose(place, stated.camera_from_body)
            distance = float(np.linalg.norm(stated.position_m - point.point.xyz_m))
            sample = distance / camera.focal_length_px
            plan = SearchPlan(level, TEMPLATE_NODES, SEARCH_NODES, sample, distortion)
            held = self._slant(point) if axis is SLANT else value
            for name, matcher in MATCHERS.items():
                match = match_point(point, plan, picture, camera, stated, sun, matcher, GATES)
                off, accepted = None, False
                if match.pixel is not None:
                    off_px = float(np.linalg.norm(match.pixel - _pixel(point, pose, camera)))
                    off, accepted = off_px * sample / point.patches[0].posting_m, not match.reason
                yield Trial(axis.name, held, name, aided, off, accepted)

    def _slant(self, point: Reference) -> float:
        """Off-nadir angle at a point, rounded to the study's values: it changes over a picture."""
        place = point.point.xyz_m
        away = self.scene.pose.position_m - place
        cosine = place @ away / np.linalg.norm(place) / np.linalg.norm(away)
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
        return min(SLANT.values, key=lambda value: abs(value - angle))


def _pixel(point: Reference, pose: Pose, camera: Camera) -> FloatArray:
    """Where a point is seen from a pose."""
    attitude = pose.camera_from_body.as_matrix()
    return camera.project_from_body(point.point.xyz_m, pose.position_m, attitude)
