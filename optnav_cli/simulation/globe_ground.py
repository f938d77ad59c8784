"""Ground of a whole body for pictures from anywhere: the model of the globe with seeded relief.

A picture's ground is made for what the picture can see, on a grid of latitudes and longitudes of a
frame turned so that nothing in view is near a pole of the grid; the body's own poles and its 180°
line are places like any other. Near the body the grid's equator runs through the view (`level`);
from far away the grid's pole lies below the camera and its equator runs along the limb (`facing`).
Turned frames come from a fixed set of directions, so neighbouring pictures share their ground.
"""

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.cache import Cache
from catalog.geometry.kernel import parallel_kernel
from catalog.geometry.latlon import Lattice, xyz_from_latlon
from catalog.photometry.sets import LUNAR, HapkeParameters
from catalog.rendering.rays.ground import Ground, make_ground, make_whole_sphere
from catalog.rendering.rays.scene import Scene
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.synthetic.model_error import SlopeMap
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation.albedo import Albedo
from optnav_cli.simulation.globe_heights import GlobeHeights, Relief, ReliefSum, read_globe
from optnav_cli.simulation.scenario_base import CAMERAS, Exposure, corner_rays, every_px
from optnav_cli.simulation.sections import DetailSettings, TruthSettings, error_above, relief_below

Box = tuple[float, float, float, float]  # west, south, east, north, rad

CENTRES = np.radians(4.0)  # between the directions that turned frames are made for
MAX_LEVEL = np.radians(66.0)  # a grid that reaches farther from its equator faces the camera
MAX_NODES = 40_000_000
FINER = 2  # finest nodes against the globe's posting
POSTINGS = 4  # each twice the one before
# The means of a coarser grid lower the crests along a limb: the Moon's by 10, 46 and 122 m at 2, 4
# and 8 times 474 m. Grounds that face the camera are raised by as much where its limb lies, as
# some places (width and half height of each in latitudes and longitudes of a turned frame) show.
SAMPLES, SAMPLE_WIDTH, SAMPLE_REACH = 4, np.radians(20.0), np.radians(9.0)
LEVEL_POSTINGS = 2  # near the body none is raised, for what stands below must keep its height
RAISED_TO, RAISED_FROM = np.radians(32.0), np.radians(45.0)  # latitudes of a grid that faces it
NODES_A_PIXEL = 1.4  # at the horizon; relief between nodes is smaller than a pixel there
COARSE_ROWS = 720  # of the ground beyond the window: 0.25°
CHUNK = 256  # rows sampled at once
PROBE_PX = 32  # distance of the rays that find out which ground a picture shows
ROUND = np.radians(2.0)  # boxes are widened to multiples of it, so that neighbours share them
MARGIN = np.radians(1.0)  # relief and what lies between the probing rays
LIMB_SAMPLES = 8  # rays a side of a pixel at the limb: its share of sky is right to 0.01


@dataclass(frozen=True)
class GroundView:
    """Which ground a picture needs.

    centre     (3,) direction of the middle, body frame, one of the fixed set
    box        None for all that faces the camera, else the part of the turned frame that is seen
    posting_m  of the grid
    """

    centre: tuple[float, float, float]
    box: Box | None
    posting_m: float


class GlobeTerrain:
    """Windows of one ground.

    detail  the relief to add, None for none
    kept    how many windows are kept: one for each camera that looks by turns
    """

    def __init__(self, heights: GlobeHeights, detail: Relief | None, kept: int = 1) -> None:
        self._heights, self._detail = heights, detail
        self._lost: dict[float, float] = {}
        self._kept: Cache[object, tuple[FloatArray, Ground, Ground]] = Cache(kept)

    def postings(self) -> FloatArray:
        """Postings (m) that windows may have, finest first."""
        finest = float(self._heights.posting_m) / FINER
        return finest * np.exp2(np.arange(POSTINGS, dtype=np.float64))

    def window(self, view: GroundView, sun_body: FloatArray) -> tuple[FloatArray, Ground, Ground]:
        """The ground of a view: (grid_from_body (3, 3), the window, the whole body coarsely).

        sun_body  where the Sun is: the seam of a ground that faces the camera is put in the dark
        """
        key: tuple[object, ...] = (view, None if view.box else sun_body.tobytes())
        centre = np.array(view.centre)
        frame = level_frame(centre) if view.box else facing_frame(centre, sun_body)
        return self._kept.get(key, lambda: (frame, self._window(view, frame), self._coarse(frame)))

    def _window(self, view: GroundView, grid_from_body: FloatArray) -> Ground:
        step = view.posting_m / self._heights.radius_m
        if view.box is None:
            # all round with two columns more, up to half a step from the pole
            step = np.pi / round(np.pi / step)
            rows, cols = round((0.5 * np.pi + np.radians(12.0)) / step), round(2.0 * np.pi / step)
            grid = Lattice(0.5 * np.pi - 0.5 * step, -np.pi, step, rows, cols + 2)
        else:
            west, south, east, north = view.box
            rows, cols = int((north - south) / step) + 1, int((east - west) / step) + 1
            grid = Lattice(north, west, step, rows, cols)
        heights = self._ground(grid_from_body, grid, view.posting_m)
        if view.box is None:
            heights += self._raise(view.posting_m, grid.lat)[:, None]
        return make_ground(heights, grid.north, grid.west, step, step, self._heights.radius_m)

    def _raise(self, posting_m: float, lat: FloatArray) -> Float32Array:
        """Return the heights to add at latitudes (n,), m, for the limb that coarse means lose."""
        if posting_m not in self._lost:
            finest, wanted = self._mean_skyline(self.postings()[0]), self._mean_skyline(posting_m)
            self._lost[posting_m] = float(np.mean(finest - wanted))
        share = np.clip((RAISED_FROM - lat) / (RAISED_FROM - RAISED_TO), 0.0, 1.0)
        smooth = share * share * (3.0 - 2.0 * share)
        raised: Float32Array = (self._lost[posting_m] * smooth).astype(np.float32)
        return raised

    def _mean_skyline(self, posting_m: float) -> FloatArray:
        """Mean height (SAMPLES,), m, of skylines of the ground at a posting, seen from far away."""
        rng = np.random.default_rng(0)
        means = []
        step = posting_m / self._heights.radius_m
        rows, cols = int(2.0 * SAMPLE_REACH / step) + 1, int(SAMPLE_WIDTH / step) + 1
        grid = Lattice(SAMPLE_REACH, 0.0, step, rows, cols)
        lat = grid.lat
        for _ in range(SAMPLES):
            frame = facing_frame(*(v / np.linalg.norm(v) for v in rng.normal(size=(2, 3))))
            heights = self._ground(frame, grid, posting_m)
            across = (self._heights.radius_m + heights) * np.cos(lat)[:, None]
            means.append(float(across.max(axis=0).mean()) - self._heights.radius_m)
        return np.array(means)

    def _coarse(self, grid_from_body: FloatArray) -> Ground:
        step = np.pi / COARSE_ROWS
        north, west = 0.5 * np.pi - 0.5 * step, 0.5 * step
        grid = Lattice(north, west, step, COARSE_ROWS, 2 * COARSE_ROWS)
        heights = self._sample(grid_from_body, grid, step * self._heights.radius_m)
        return make_whole_sphere(heights, self._heights.radius_m, np.pi)

    def _ground(self, grid_from_body: FloatArray, grid: Lattice, posting_m: float) -> Float32Array:
        heights = self._sample(grid_from_body, grid, posting_m)
        if self._detail is not None:
            heights += self._detail.turned_window(grid_from_body.T, grid)
        return heights

    def _sample(self, grid_from_body: FloatArray, grid: Lattice, posting_m: float) -> Float32Array:
        level = self._heights.level_for(posting_m)
        lat, lon = grid.lat, grid.lon
        out = np.empty((grid.rows, grid.cols), np.float32)
        for top in range(0, grid.rows, CHUNK):
            part = lat[top : top + CHUNK]
            places = np.empty((2, part.size, grid.cols))
            _body_latlon(grid_from_body, part, lon, places[0], places[1])
            out[top : top + CHUNK] = self._heights.sample(level, places[0], places[1])
        return out


class GlobeGround:
    """The ground of a whole body; `grounds` has the terrain of each seed.

    surface, albedo  what the ground scatters: the Moon's, the same everywhere, when left out
    """

    def __init__(
        self,
        heights: GlobeHeights,
        grounds: dict[int | None, GlobeTerrain],
        surface: HapkeParameters = LUNAR,
        albedo: Albedo | None = None,
    ) -> None:
        self._heights, self._grounds = heights, grounds
        self._surface, self._albedo = surface, albedo
        self._corners = lru_cache(maxsize=CAMERAS)(corner_rays)

    @classmethod
    def of_model(
        cls,
        model: DemSettings,
        detail: DetailSettings,
        body: Body,
        kept: int,
        truth: TruthSettings = TruthSettings(),
    ) -> "GlobeGround":
        """The ground of a model of the whole body with relief below its posting.

        kept  windows to keep, one a camera. Raises ConfigError or DataError for the model
        """
        model_heights = read_globe(model, body)
        heights = GlobeHeights(model_heights, body.radius_m)
        spectrum = truth.spectrum()
        slopes = None if spectrum is None else SlopeMap.measure_globe(model_heights, body.radius_m)
        grounds: dict[int | None, GlobeTerrain] = {}
        for seed in detail.seeds or (None,):
            parts: list[Relief] = []
            if seed is not None:
                parts.append(relief_below(detail, seed, heights.posting_m, body.radius_m))
            if spectrum is not None and slopes is not None:
                parts.append(error_above(spectrum, seed, heights.posting_m, slopes, body))
            relief = ReliefSum(tuple(parts)) if parts else None
            grounds[seed] = GlobeTerrain(heights, relief, kept)
        albedo = None if truth.albedo == "uniform" else Albedo(truth, body)
        return cls(heights, grounds, truth.find_surface(body), albedo)

    def radiance(self, camera: Camera, exposure: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width) of a picture, sky 0."""
        body_from_camera = exposure.camera_from_body.inv().as_matrix()
        corners = self._corners(camera)
        view = self._view(camera, exposure.position_m, body_from_camera)
        if view is None:
            return np.zeros(camera.shape, np.float32)
        ground = self._grounds[exposure.ground_seed]
        grid_from_body, fine, wide = ground.window(view, exposure.sun_body)
        scene = Scene(fine, wide, grid_from_body @ exposure.sun_body, surface=self._surface)
        rays = corners @ (grid_from_body @ body_from_camera).T
        albedo = None
        if self._albedo is not None:
            albedo = self._albedo.on_body(exposure.ground_seed or 0, grid_from_body.T)
        origin = grid_from_body @ exposure.position_m
        return scene.picture(origin, rays, limb_samples=LIMB_SAMPLES, albedo=albedo)

    def _view(
        self, camera: Camera, position: FloatArray, body_from_camera: FloatArray
    ) -> GroundView | None:
        """The ground that a picture shows, None when it shows only sky."""
        probes = every_px(self._corners(camera), PROBE_PX)
        rays = (probes @ body_from_camera.T).reshape(-1, 3)
        distance = float(np.linalg.norm(position))
        seen = _seen(self._heights, position, rays, PROBE_PX * camera.angular_resolution)
        if seen is None:
            return None
        radius = self._heights.radius_m
        horizon = np.sqrt(max(distance**2 - radius**2, 1e6))
        wanted = horizon * camera.angular_resolution / NODES_A_PIXEL
        centre = fixed_centre(seen.mean(axis=0))
        box = _box(seen @ level_frame(centre).T)
        there = next(iter(self._grounds.values())).postings()
        if box is None:
            centre = fixed_centre(position)
            nodes = 2.0 * np.pi * np.radians(102.0)
            posting = _posting(there, wanted)
        else:
            posting = _posting(there[:LEVEL_POSTINGS], wanted)
            nodes = (box[2] - box[0]) * (box[3] - box[1])
        while nodes * (radius / posting) ** 2 > MAX_NODES:
            posting *= 2.0
        return GroundView(tuple(centre.tolist()), box, posting)


def fixed_centre(direction: FloatArray) -> FloatArray:
    """The nearest of a fixed set of directions, some 4° apart, at most 3° from any direction."""
    unit = direction / np.linalg.norm(direction)
    lat = CENTRES * np.round(np.arcsin(unit[2]) / CENTRES)
    around = max(1.0, np.round(2.0 * np.pi * np.cos(lat) / CENTRES))
    spacing = 2.0 * np.pi / around
    lon = spacing * np.round(np.arctan2(unit[1], unit[0]) / spacing)
    return xyz_from_latlon(lat, lon, 1.0)


def level_frame(centre: FloatArray) -> FloatArray:
    """Rotation (3, 3), grid from body, that brings a unit vector to the grid's latitude 0, lon 0.

    North in the grid is north on the body there, or towards the prime meridian at its poles.
    """
    pole = np.array([0.0, 0.0, 1.0]) if abs(centre[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    y = np.cross(pole, centre)
    y /= np.linalg.norm(y)
    return np.stack([centre, y, np.cross(centre, y)])


def facing_frame(centre: FloatArray, sun_body: FloatArray) -> FloatArray:
    """Rotation (3, 3), grid from body: a unit vector is the grid's pole, lon 0 is the Sun's side.

    With the Sun straight behind the camera no side is dark and any will do.
    """
    x = sun_body - (sun_body @ centre) * centre
    if np.linalg.norm(x) < 1e-6:
        x = level_frame(centre)[1]
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(centre, x), centre])


@parallel_kernel
def _body_latlon(
    grid_from_body: FloatArray,
    lat: FloatArray,
    lon: FloatArray,
    out_lat: FloatArray,
    out_lon: FloatArray,
) -> None:
    """Latitudes and longitudes on the body of a grid in a turned frame, (rows, cols) each."""
    cos_lon, sin_lon = np.cos(lon), np.sin(lon)
    for i in numba.prange(lat.size):
        c, z = np.cos(lat[i]), np.sin(lat[i])
        for j in range(lon.size):
            x, y = c * cos_lon[j], c * sin_lon[j]
            p = grid_from_body[0, 0] * x + grid_from_body[1, 0] * y + grid_from_body[2, 0] * z
            q = grid_from_body[0, 1] * x + grid_from_body[1, 1] * y + grid_from_body[2, 1] * z
            r = grid_from_body[0, 2] * x + grid_from_body[1, 2] * y + grid_from_body[2, 2] * z
            out_lat[i, j] = np.arctan2(r, np.sqrt(p * p + q * q))
            out_lon[i, j] = np.arctan2(q, p)


def _posting(there: FloatArray, wanted_m: float) -> float:
    """The coarsest of postings (n,), finest first, not above the wanted one, else the finest."""
    fine_enough = there[there <= wanted_m]
    return float(fine_enough[-1] if fine_enough.size else there[0])


def _seen(
    heights: GlobeHeights, position: FloatArray, rays: FloatArray, apart: float
) -> FloatArray | None:
    """Directions (n, 3) from the body's centre to ground that rays may meet, None for none.

    A ray can meet ground between the spheres of the highest and the lowest height.
    """
    rays = rays[np.isfinite(rays).all(axis=1)]
    top, floor = heights.radius_m + heights.highest_m, heights.radius_m + heights.lowest_m
    along = rays @ position
    square = float(position @ position)
    clear = along**2 - square + top**2
    # between two probing rays that miss, a third may graze the body
    nearest = np.sqrt(np.maximum(square - along**2, 0.0)) - top
    close = (along < 0.0) & (nearest < apart * np.sqrt(square))
    inside = close | (square < top**2)
    if not inside.any():
        return None
    rays, along, clear = rays[inside], along[inside], np.maximum(clear[inside], 0.0)
    start = np.maximum(-along - np.sqrt(clear), 0.0)
    end = np.maximum(-along + np.sqrt(clear), 0.0)
    below = along**2 - square + floor**2
    ends = (below > 0.0) & (along < 0.0)
    end[ends] = -along[ends] - np.sqrt(below[ends])
    points = [position + s[:, None] * rays for s in (start, 0.5 * (start + end), end)]
    ground_points = np.concatenate(points)
    directions: FloatArray = ground_points / np.linalg.norm(ground_points, axis=1)[:, None]
    return directions


def _box(seen: FloatArray) -> tuple[float, float, float, float] | None:
    """The rounded box around directions in a level frame, None when it would reach too far."""
    lat = np.arcsin(np.clip(seen[:, 2], -1.0, 1.0))
    lon = np.arctan2(seen[:, 1], seen[:, 0])
    edges = np.array([lon.min(), lat.min(), lon.max(), lat.max()])
    edges += MARGIN * np.array([-1.0, -1.0, 1.0, 1.0])
    if np.abs(edges).max() + 0.5 * CENTRES > MAX_LEVEL:
        return None
    low, high = np.floor(edges[:2] / ROUND) * ROUND, np.ceil(edges[2:] / ROUND) * ROUND
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
