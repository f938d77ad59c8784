"""A small rough world: ground finer than its control points, a camera, pictures with noise."""

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.control_point import SHADOW_AZIMUTHS, ControlPoint, Patch
from catalog.geometry.cells import CellGrid
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.latlon import body_from_local, xyz_from_latlon
from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.rendering.map_view import render_map
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.field import ControlPointField, PointLayer
from optnav_cli.estimation.models.points import Pose
from tests.optnav_cli.made_runs import make_run  # noqa: F401, a fixture

RADIUS_M = 1737400.0
LAT, LON = np.radians(-43.0), np.radians(-11.0)
CAMERA_FROM_LOCAL = np.diag([1.0, -1.0, -1.0])  # nadir, north at the picture's top
LIGHTS = {}
MAX_LIGHTS = 32  # of a megabyte each


def pixel_grid(camera):
    """Coordinates (height, width, 2) of all pixel centres."""
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    return np.stack([x, y], axis=-1).astype(np.float64)


def half_of(grid):
    """Area means of two by two nodes."""
    return cv2.resize(grid, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


@dataclass
class RoughWorld:
    """Ground of seeded noise with a slope of about 6 degrees at 120 m, and what looks at it.

    The ground has nodes of 60 m, the control points' finest patches 120 m, a pixel sees 100 m.
    """

    seed: int
    size: int = 1536
    posting_m: float = 60.0
    levels: int = 4
    nodes: int = 64
    cell_deg: float = 0.25
    camera: Camera = field(
        default_factory=lambda: Camera("cam", "pinhole", 512, 512, 1000.0, (255.5, 255.5))
    )
    radius_m: float = RADIUS_M

    @cached_property
    def projection(self):
        return Stereographic(LAT, LON, RADIUS_M)

    @cached_property
    def heights(self):
        rng = np.random.default_rng(self.seed)
        k = np.hypot(*np.meshgrid(np.fft.rfftfreq(self.size), np.fft.fftfreq(self.size)))
        k[0, 0] = 1.0
        amplitude = (k**2 + 0.003**2) ** -0.8
        amplitude[0, 0] = 0.0
        phase = np.fft.rfft2(rng.normal(size=(self.size, self.size)))
        ground = np.fft.irfft2(phase * amplitude, s=(self.size, self.size))
        slope = np.hypot(*np.gradient(half_of(ground.astype(np.float32)), 2.0 * self.posting_m))
        return (ground * np.tan(np.radians(6.0)) / np.sqrt(np.mean(slope**2))).astype(np.float32)

    @cached_property
    def coarser(self):
        """Area means of the ground at 120 m, 240 m, ..."""
        grids = [half_of(self.heights)]
        while len(grids) < self.levels:
            grids.append(half_of(grids[-1]))
        return grids

    def heights_at(self, projection, x, y, level):
        """Heights (like x) at map points, from the ground as a level of the patches knows it."""
        grid = self.coarser[level]
        posting = self.posting_m * 2.0 ** (level + 1)
        e, n = self.projection.xy_from_xyz(projection.points(x, y, np.zeros_like(x)))
        half = (grid.shape[0] - 1) / 2.0
        return sample_bicubic(grid, half - n / posting, half + e / posting)

    def postings(self):
        return self.posting_m * 2.0 ** (1 + np.arange(self.levels))

    @cached_property
    def control_points(self):
        """Pairs of a point and its patches, one in the middle of each cell, ascending ids."""
        grid = CellGrid(self.cell_deg)
        reach = 0.8
        lat, lon = np.degrees(LAT), np.degrees(LON)
        cells = grid.find_cells_in_bbox(
            lon - reach / np.cos(LAT), lat - reach, lon + reach / np.cos(LAT), lat + reach
        )
        return [self.control_point(int(cell), *grid.centre_deg(int(cell))) for cell in cells]

    def control_point(self, cell, lat_deg, lon_deg):
        projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), RADIUS_M)
        patches = []
        for level, posting in enumerate(self.postings()):
            x, y = make_node_grid(self.nodes, posting)
            patches.append(Patch(float(posting), self.heights_at(projection, x, y, level)))
        height = float(self.heights_at(projection, np.zeros(1), np.zeros(1), 0)[0])
        point = ControlPoint(
            id=cell,
            lat_deg=lat_deg,
            lon_deg=lon_deg,
            radius_m=RADIUS_M + height,
            localisation_nodes=0.1,
            hessian_eigenvalue=2.0,
            recognition_rate=1.0,
            trials=5,
            uniqueness=(0.5,) * self.levels,
            shadow_limit_deg=(0.0,) * SHADOW_AZIMUTHS,
            usable=True,
            source="noise",
        )
        return point, tuple(patches)

    def pose(self, height_m=100e3, roll=0.0, tilt=(0.0, 0.0), lat=LAT, lon=LON):
        """A camera above a place, looking down, turned by small angles (rad)."""
        turn = Rotation.from_euler("zxy", [roll, *tilt])
        down = Rotation.from_matrix(CAMERA_FROM_LOCAL @ body_from_local(lat, lon).T)
        return Pose(xyz_from_latlon(lat, lon, RADIUS_M + height_m), turn * down)

    def sun(self, elevation_deg, azimuth_deg):
        """Unit vector to the Sun, body frame, as seen from the middle of the ground."""
        e, a = np.radians([elevation_deg, azimuth_deg])
        local = np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])
        return body_from_local(LAT, LON) @ local

    def picture(self, pose, sun_body, noise_seed=0, snr=50.0, bits=8):
        """What the camera takes: Hapke's law, cast shadows, blur, noise, whole counts."""
        picture = self._light(pose, sun_body)
        rng = np.random.default_rng(noise_seed)
        picture = picture + rng.normal(size=picture.shape) * picture.mean() / snr
        top = 2.0**bits - 1.0
        scaled = picture / np.percentile(picture, 99.8) * 0.95 * top
        return np.clip(np.rint(scaled), 0.0, top).astype(np.float32)

    def _light(self, pose, sun_body):
        """The picture before its noise; kept, as many tests draw another noise over it."""
        turned = pose.camera_from_body.as_quat()
        numbers = np.concatenate([pose.position_m, turned, sun_body]).tobytes()
        key = id(self.heights), repr(self.camera), numbers
        if key not in LIGHTS:
            if len(LIGHTS) >= MAX_LIGHTS:
                del LIGHTS[next(iter(LIGHTS))]
            # with the ground, so that its id stays its own
            LIGHTS[key] = self.heights, self._made_light(pose, sun_body)
        return LIGHTS[key][1]

    def _made_light(self, pose, sun_body):
        turn = self.projection.body_from_local
        foot = np.array([0.0, 0.0, RADIUS_M])
        camera_local = pose.position_m @ turn - foot
        radiance = render_map(
            self.heights,
            self.posting_m,
            sun_body @ turn,
            camera_local=camera_local,
            radius_m=RADIUS_M,
        )
        col, row = self._nodes_of_pixels(pose)
        picture = cv2.remap(np.nan_to_num(radiance), col, row, cv2.INTER_LINEAR)
        return cv2.GaussianBlur(picture, (0, 0), 0.7)

    def _nodes_of_pixels(self, pose):
        """Columns and rows of the ground's nodes that the pixels see: rays against the relief."""
        turn = self.projection.body_from_local
        rays = self.camera.unproject(pixel_grid(self.camera)) @ pose.camera_from_body.as_matrix()
        rays, origin = rays @ turn, pose.position_m @ turn
        half = (self.size - 1) / 2.0
        height = np.zeros(rays.shape[:2], dtype=np.float32)
        along = rays @ origin
        for _ in range(6):  # the relief moves the foot by less than half of what it did before
            radius = RADIUS_M + height
            distance = -along - np.sqrt(along * along - origin @ origin + radius * radius)
            place = origin + rays * distance[..., None]
            factor = 2.0 * RADIUS_M / (np.linalg.norm(place, axis=-1) + place[..., 2])
            col = (half + factor * place[..., 0] / self.posting_m).astype(np.float32)
            row = (half - factor * place[..., 1] / self.posting_m).astype(np.float32)
            height = cv2.remap(self.heights, col, row, cv2.INTER_LINEAR)
        return col, row


@pytest.fixture(scope="session")
def rough_world():
    return RoughWorld(seed=1)


@pytest.fixture(scope="session")
def other_world():
    """Ground of the same kind and quite another shape."""
    return RoughWorld(seed=2)


class PatchStore:
    """The points and patches of a world in memory, as a catalog would give them."""

    def __init__(self, world):
        self.by_id = {point.id: (point, patches) for point, patches in world.control_points}

    def point(self, point_id):
        return self.by_id[point_id][0]

    def patches(self, point_id):
        return self.by_id[point_id][1]


@pytest.fixture
def layer_of():
    """Makes the layer of a world's control points, of some of them when asked."""

    def make(world, keep=slice(None), name="world.gpkg"):
        points = [point for point, _ in world.control_points][keep]
        return PointLayer(
            name,
            PatchStore(world),
            CellGrid(world.cell_deg),
            np.array([point.id for point in points]),
            np.array([point.xyz_m for point in points]),
            np.array([point.shadow_limit_deg for point in points]),
            world.postings(),
            world.radius_m,
        )

    return make


@pytest.fixture
def field_of(layer_of):
    """Makes the field of a world's control points, of some of them when asked."""

    def make(world, keep=slice(None)):
        return ControlPointField([layer_of(world, keep)])

    return make
