"""What the matching study looks at: a real catalog, pictures of richer ground, wrong priors."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.build import build
from catalog.config import resource
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from catalog.progress import Progress
from catalog.rendering.rays.scene import Scene as LitGround
from catalog.store.reader import Catalog
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.estimation.models.points import Pose
from optnav_cli.matching.reference import Reference
from optnav_cli.simulation.truth_terrain import TruthTerrain

DEM, GLOBE = "data/tycho_gld100_256ppd.tif", "data/moon_gld100_4ppd.tif"
MIDDLE_DEG = (-43.0, -11.0)  # of the terrain model
# The seen ground has nodes of half the catalog's, with what a scenario adds by itself.
POSTING_M, FINER = 118.45, 2
MIN_M, SLOPE_DEG, SATURATION = 30.0, 3.0, 0.05
WHOLE = (-np.pi, -0.5 * np.pi, np.pi, 0.5 * np.pi)
SUN_ELEVATIONS_DEG = (25.0, 15.0, 35.0, 20.0, 30.0, 40.0)


@dataclass(frozen=True, eq=False)
class Scene:
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


def scenes(
    body: Body,
    camera: Camera,
    range_m: float,
    count: int,
    off_nadir_deg: Sequence[float],
    progress: Progress,
) -> Iterator[Scene]:
    """Pictures of the terrain's middle; `count` Suns and grounds, each from all angles.

    range_m        from the camera to the ground in the middle
    off_nadir_deg  between the local vertical there and the way to the camera
    """
    lat, lon = np.radians(MIDDLE_DEG)
    local, middle = body_from_local(lat, lon), xyz_from_latlon(lat, lon, body.radius_m)
    x, y = np.meshgrid(np.arange(camera.width_px + 1), np.arange(camera.height_px + 1))
    corners = camera.unproject(np.stack([x, y], axis=-1) - 0.5)
    details: dict[int | None, SyntheticRelief | None] = {
        number: SyntheticRelief(
            number + 1, POSTING_M, body.radius_m,
            smallest_m=MIN_M, rms_slope_deg=SLOPE_DEG, saturation=SATURATION,
        )
        for number in range(count)
    }  # fmt: skip
    terrain = TruthTerrain(
        body, (DemSettings(str(resource(DEM))),), DemSettings(str(resource(GLOBE))), details
    )
    with progress.stage("look", count * len(off_nadir_deg), "picture") as bar:
        for number in range(count):
            sun = local @ _sun_local(number)
            ground = LitGround(terrain.window(number, FINER, WHOLE), terrain.wide(number), sun)
            for angle in off_nadir_deg:
                pose = _pose(local, middle, range_m, angle if number % 2 else -angle)
                rays = corners @ pose.camera_from_body.as_matrix()
                radiance = ground.picture(pose.position_m, rays)
                yield Scene(number, radiance, pose, sun, angle)
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
    """How a told pose is wrong about a point, which keeps its pixel.

    roll   rad about the line of sight
    scale  relative error of the distance
    lean   the view is believed to be from straight above the point
    """

    roll: float = 0.0
    scale: float = 0.0
    lean: bool = False

    def other_way(self) -> "Wrong":
        """The same by the opposite sign."""
        return Wrong(-self.roll, -self.scale, self.lean)


RIGHT = Wrong()


def wrong_pose(pose: Pose, point_m: FloatArray, wrong: Wrong) -> Pose:
    """The pose that is told when `pose` is the truth; point_m (3,) body frame."""
    away = pose.position_m - point_m
    attitude = pose.camera_from_body
    distance = float(np.linalg.norm(away))
    attitude = attitude * Rotation.from_rotvec(wrong.roll * away / distance)
    if wrong.lean:
        vertical = point_m / np.linalg.norm(point_m)
        turn, _ = Rotation.align_vectors(vertical[None], away[None] / distance)
        away, attitude = turn.apply(away), attitude * turn.inv()
    return Pose(point_m + (1.0 + wrong.scale) * away, attitude)
