"""The ground that pictures are taken of: terrain models refined with detail, the globe around them.

The fine ground hangs on one lattice of latitudes and longitudes for a whole scenario and is made in
tiles, so every picture of a seed shows the same ground. Toward the border of a terrain model it
runs smoothly into what lies below: the next model, in the end the globe.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.cache import Cache
from catalog.errors import ConfigError
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.latlon import latlon_from_xyz
from catalog.rendering.rays.ground import Ground, make_ground
from catalog.rendering.rays.scene import Scene
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.error_model import ErrorSpectrum
from catalog.terrain.synthetic.model_error import SLOPE_BASE_M, ModelError, SlopeMap, map_rms_slope
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.camera.camera import Camera
from optnav_cli.simulation import globe_heights
from optnav_cli.simulation.albedo import Albedo
from optnav_cli.simulation.scenario_base import (
    CAMERAS,
    Exposure,
    ScenarioBase,
    corner_rays,
    every_px,
)
from optnav_cli.simulation.sections import TruthSettings, error_above, relief_below

Box = tuple[float, float, float, float]  # west, south, east, north, rad

TILE = 1024  # nodes a side
KEPT_TILES = 120  # 0.5 GB
KEPT_WINDOWS = 2
FEATHER_M = 8000.0  # about a pixel of the globe
MAX_WINDOW = 100_000_000  # nodes
POLAR_LATITUDE = np.radians(86.0)  # beyond it a lattice of longitudes is no good
SLOPE_ROWS = 64  # of a slope map, made at once
PROBE_PX = 64  # distance of the rays that find out which ground a picture shows
NARROW = np.radians(60.0)  # wider cameras get all the fine ground there is
SHARED_NODES = 40_000_000  # a scene of several pictures holds no more than this
NEAR_FACTOR = 32  # times finer than the terrain model at most, where pictures are from low heights
NEAR_NODES_PX = 1.25  # nodes at two thirds of a pixel are enough, and here a pixel or so must do
NEAR_REACH = 2.5  # heights that such a camera sees aside
NEAR_MARGIN_M = 300.0
WHOLE: Box = (-np.pi, -0.5 * np.pi, np.pi, 0.5 * np.pi)


class TruthTerrain:
    """Grounds of one scenario; tiles and windows are kept from picture to picture.

    dems           terrain models in order of priority, with absolute paths
    globe          a terrain model that goes all round
    details        the relief to add to the first of the models by seed
    globe_details  the relief to add to the globe by seed; none: smooth
    cameras_m      (n, 3) m, body frame, where the ground is looked at from; see `WideGround`
    error          what the terrain models are wrong by; the same as the truth for None
    """

    def __init__(
        self,
        body: Body,
        dems: tuple[DemSettings, ...],
        globe: DemSettings,
        details: Mapping[int | None, SyntheticRelief | None],
        globe_details: Mapping[int | None, SyntheticRelief] = MappingProxyType({}),
        cameras_m: Sequence[FloatArray] = (),
        error: ErrorSpectrum | None = None,
    ) -> None:
        self.body, self._details, self._around = body, details, globe_details
        self._sources = [DemSource.open(dem, Path.cwd(), body) for dem in dems]
        first = self._sources[0]
        inset = first.posting_m / body.radius_m
        west, south, east, north = first.latlon_bounds()
        self._known: Box = (west + inset, south + inset, east - inset, north - inset)
        if max(abs(south), abs(north)) > POLAR_LATITUDE:
            south, north = max(south, -POLAR_LATITUDE), min(north, POLAR_LATITUDE)
            self._known = (self._known[0], south, self._known[2], north)
        self.posting_m = first.posting_m
        self._stretch = 1.0 / float(np.cos(0.5 * (south + north)))
        self.box = self._with_border(self._known, first.wraps)
        self._tiles: Cache[tuple[int | None, int, int, int], Float32Array] = Cache(KEPT_TILES)
        self._windows: Cache[tuple[int | None, int, Box], Ground] = Cache(KEPT_WINDOWS)
        seam = 0.5 * (self.box[0] + self.box[2]) + np.pi
        heights = globe_heights.read_globe(globe, body)
        self._errors: dict[int | None, ModelError] = {}
        around: dict[int | None, globe_heights.Relief] = dict(globe_details)
        if error is not None:
            slopes, posting = self._slopes(), self.posting_m
            self._errors = {s: error_above(error, s, posting, slopes, body) for s in details}
            if around:
                slopes = SlopeMap.measure_globe(heights, body.radius_m)
                posting = np.pi * body.radius_m / len(heights)
            for seed, relief in list(around.items()):
                error_relief = error_above(error, seed, posting, slopes, body)
                around[seed] = globe_heights.ReliefSum((relief, error_relief))
        self._wide = globe_heights.WideGround(heights, body.radius_m, seam, around, cameras_m)

    def wide(self, seed: int | None) -> Ground:
        """The ground of a seed outside the terrain models, all round the body."""
        return self._wide.of(seed)

    def window(self, seed: int | None, factor: int, box: Box) -> Ground:
        """The fine ground over a box, as far as the first terrain model reaches.

        Raises ConfigError when the box holds too much ground at this resolution.
        """
        if factor == 1 and seed not in self._around and not self._errors:
            seed = None  # without added relief all seeds have one ground
        return self._windows.get((seed, factor, box), lambda: self._window(seed, factor, box))

    def _window(self, seed: int | None, factor: int, box: Box) -> Ground:
        step_lat, step_lon = self._steps(factor)
        top, left, rows, cols = self._place(factor, box)
        if rows * cols > MAX_WINDOW:
            raise ConfigError(
                f"a picture sees {rows} x {cols} nodes of {self.posting_m / factor:.0f} m of "
                f"ground; {MAX_WINDOW} nodes are possible: name a coarser terrain model"
            )
        out = np.empty((rows, cols), np.float32)
        for tile_row in range(top // TILE, (top + rows - 1) // TILE + 1):
            for tile_col in range(left // TILE, (left + cols - 1) // TILE + 1):
                key = (seed, factor, tile_row, tile_col)
                tile = self._tiles.get(key, partial(self._tile, *key))
                r, c = tile_row * TILE - top, tile_col * TILE - left
                a, b, d, e = max(r, 0), max(c, 0), min(r + TILE, rows), min(c + TILE, cols)
                out[a:d, b:e] = tile[a - r : d - r, b - c : e - c]
        return make_ground(
            out, -top * step_lat, left * step_lon, step_lat, step_lon, self.body.radius_m
        )

    def nodes(self, factor: int, box: Box) -> int:
        """Count the nodes of the window of a box."""
        _, _, rows, cols = self._place(factor, box)
        return rows * cols

    def _place(self, factor: int, box: Box) -> tuple[int, int, int, int]:
        """First row and column on the lattice, rows and columns of a box's window."""
        step_lat, step_lon = self._steps(factor)
        west, south, east, north = self._clip(box)
        top, bottom = int(np.ceil(-north / step_lat)), int(np.floor(-south / step_lat))
        left, right = int(np.ceil(west / step_lon)), int(np.floor(east / step_lon))
        return top, left, max(bottom - top + 1, 4), max(right - left + 1, 4)

    def _steps(self, factor: int) -> tuple[float, float]:
        step = self.posting_m / factor / self.body.radius_m
        return step, step * self._stretch

    def _clip(self, box: Box) -> Box:
        """The part of a box within the first model's, on the model's turn of longitude."""
        west, south, east, north = box
        own_west, own_south, own_east, own_north = self.box
        if east - west >= 2.0 * np.pi:
            west, east = own_west, own_east
        turn = 2.0 * np.pi * np.round((0.5 * (own_west + own_east - west - east)) / (2.0 * np.pi))
        west, east = max(west + turn, own_west), min(east + turn, own_east)
        south, north = max(south, own_south), min(north, own_north)
        # without common ground any corner of the model will do: no ray of the picture meets it
        return west, south, max(west, east), max(south, north)

    def _tile(self, seed: int | None, factor: int, tile_row: int, tile_col: int) -> Float32Array:
        step_lat, step_lon = self._steps(factor)
        lat = -(tile_row * TILE + np.arange(TILE, dtype=np.float64)) * step_lat
        lon = (tile_col * TILE + np.arange(TILE, dtype=np.float64)) * step_lon
        wide = self.wide(seed)
        east = np.mod(lon - wide.west, 2.0 * np.pi)
        row, col = np.meshgrid(
            (wide.north - lat) / wide.step_lat, east / wide.step_lon, indexing="ij"
        )
        heights = sample_bicubic(wide.heights, row, col)
        error = self._errors.get(seed)
        grid = lat[0], lon[0], step_lat, step_lon, TILE, TILE
        wrong = np.float32(0.0) if error is None else error.window(*grid)
        for number, source in reversed(list(enumerate(self._sources))):
            share, *nearest = self._within(source, lat, lon)
            if not share.any():
                continue
            model_heights = self._source_heights(source, *nearest) + wrong
            # at the model's own posting the relief below it has no place
            detail = self._details[seed] if number == 0 and factor > 1 else None
            if detail is not None:
                model_heights += detail.window(*grid)
            share[~np.isfinite(model_heights)] = 0.0
            heights += (share * (np.where(share > 0.0, model_heights, heights) - heights)).astype(
                np.float32
            )
        return heights

    def _slopes(self) -> SlopeMap:
        """Slopes of the first model."""
        west, south, east, north = self._known
        step = max(SLOPE_BASE_M, self.posting_m) / self.body.radius_m
        step_lon = step * self._stretch
        lat = north - step * np.arange(max(4, int((north - south) / step)), dtype=np.float64)
        lon = west + step_lon * np.arange(max(4, int((east - west) / step_lon)), dtype=np.float64)
        parts = [
            self._source_heights(self._sources[0], lat[top : top + SLOPE_ROWS], lon)
            for top in range(0, lat.size, SLOPE_ROWS)
        ]
        radius = self.body.radius_m
        slopes = map_rms_slope(
            np.concatenate(parts), step * radius, step_lon * radius * np.cos(lat)
        )
        return SlopeMap(slopes, float(lat[0]), float(lon[0]), step, step_lon)

    def _with_border(self, box: Box, wraps: bool) -> Box:
        """A box and FEATHER_M about it."""
        west, south, east, north = box
        down = FEATHER_M / self.body.radius_m
        across = 0.0 if wraps else down * self._stretch
        south, north = max(south - down, -0.5 * np.pi), min(north + down, 0.5 * np.pi)
        return west - across, south, east + across, north

    def _within(
        self, source: DemSource, lat: FloatArray, lon: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Weigh nodes by their place in a model; also return their coordinates moved to its edge.

        (rows, cols) 1 in the model, falling smoothly to 0 over FEATHER_M outside: catalogs are
        made from the whole model, so the truth is the model's up to its edge.
        """
        west, south, east, north = source.latlon_bounds()
        inset = source.posting_m / self.body.radius_m
        south, north = south + inset, north - inset
        down = np.minimum(north - lat, lat - south)
        across, nearest = np.full(lon.size, np.inf), lon
        if not source.wraps:
            offset = np.mod(lon - 0.5 * (west + east) + np.pi, 2.0 * np.pi) - np.pi
            half = 0.5 * (east - west) - inset
            across = (half - np.abs(offset)) / self._stretch
            nearest = np.where(across < 0.0, lon + np.copysign(half, offset) - offset, lon)
        metres = np.minimum(down[:, None], across[None, :]) * self.body.radius_m
        x = np.clip(1.0 + metres / FEATHER_M, 0.0, 1.0)
        return x * x * (3.0 - 2.0 * x), np.clip(lat, south, north), nearest

    def _source_heights(self, source: DemSource, lat: FloatArray, lon: FloatArray) -> Float32Array:
        """Spline heights of one model at the nodes of a tile, NaN beside holes."""
        col, row = source.pixel_from_latlon(lat[:, None], lon[None, :])
        if source.wraps:
            period = source.shape[1]
            col = col[:1, :1] + np.mod(col - col[:1, :1] + 0.5 * period, period) - 0.5 * period
        rows, cols = source.shape
        margin = globe_heights.SPLINE_MARGIN
        top = max(int(np.nanmin(row)) - margin, 0)
        bottom = min(int(np.nanmax(row)) + margin + 1, rows)
        left, right = int(np.nanmin(col)) - margin, int(np.nanmax(col)) + margin + 1
        if not source.wraps:
            left, right = max(left, 0), min(right, cols)
        if bottom - top < 2 or right - left < 2:
            return np.full((lat.size, lon.size), np.nan, np.float32)
        heights = source.read_window(top, left, bottom - top, right - left)
        source.check_window(heights)  # rays would march through a damaged value for hours
        holes = ~np.isfinite(heights)
        inside = (row >= 0) & (row <= rows - 1)
        if not source.wraps:
            inside &= (col >= 0) & (col <= cols - 1)
        # a spline does not bear holes: where the model has some, convolution leaves them out
        y, x = np.where(inside, row - top, 0.0), np.where(inside, col - left, 0.0)
        if holes.any():
            sampled = sample_bicubic(heights, y, x)
        else:
            sampled = globe_heights.sample_spline(globe_heights.spline_coefficients(heights), y, x)
        sampled[~inside] = np.nan
        return sampled


def truth_terrain(scenario: ScenarioBase, body: Body, flight: Sequence[Exposure]) -> TruthTerrain:
    """The ground of a scenario. Raises ConfigError or DataError for terrain that cannot be used."""
    first = DemSource.open(scenario.dem[0], Path.cwd(), body)
    globe, around = DemSettings(scenario.globe.path), scenario.globe.detail
    seeds, error = scenario.detail.seeds, scenario.world.spectrum()
    details: dict[int | None, SyntheticRelief | None] = {None: None}
    for seed in seeds:
        details[seed] = relief_below(scenario.detail, seed, first.posting_m, body.radius_m)
    if not around:
        return TruthTerrain(body, scenario.dem, globe, details, error=error)
    posting_m = DemSource.open(globe, Path.cwd(), body).posting_m
    wide: dict[int | None, SyntheticRelief] = {
        seed: relief_below(around, seed, posting_m, body.radius_m) for seed in seeds
    }
    cameras_m = [exposure.position_m for exposure in flight]
    return TruthTerrain(body, scenario.dem, globe, details, wide, cameras_m, error)


class RegionGround:
    """The ground of a region for the pictures of a flight, by each camera in their order.

    Neighbouring pictures of a pass that see nearly the same ground share one scene, so its terrain
    is made and its shadows are cast once. Which do follows from the exposures alone.
    """

    def __init__(
        self,
        terrain: TruthTerrain,
        cameras: Sequence[Camera],
        flight: Sequence[Exposure],
        truth: TruthSettings = TruthSettings(),
        *,
        near: bool = False,
    ) -> None:
        self._near, self._finest = near, NEAR_FACTOR if near else 4
        self._nodes_px = NEAR_NODES_PX if near else 1.0 / 1.5
        self._terrain, self._surface = terrain, truth.find_surface(terrain.body)
        self._albedo = None if truth.albedo == "uniform" else Albedo(truth, terrain.body)
        self._corners = lru_cache(maxsize=CAMERAS)(corner_rays)
        self._plans: dict[int, tuple[int, Box]] = {}
        for number, camera in enumerate(cameras):
            self._plan(camera, [exposure for exposure in flight if exposure.camera == number])
        self._scenes: Cache[object, Scene] = Cache(len(cameras))

    def radiance(self, camera: Camera, exposure: Exposure) -> Float32Array:
        """Mean radiance factor over each pixel (height, width), sky 0, of one of the flight."""
        seed, (factor, box) = exposure.ground_seed, self._plans[exposure.index]

        def scene() -> Scene:
            fine = self._terrain.window(seed, factor, box)
            between = None if box == WHOLE else self._terrain.window(seed, 1, WHOLE)
            wide = self._terrain.wide(seed)
            return Scene(fine, wide, exposure.sun_body, between, self._surface)

        key = (exposure.camera, seed, factor, box, exposure.sun_body.tobytes())
        rays = self._corners(camera) @ exposure.camera_from_body.as_matrix()
        albedo = None if self._albedo is None else self._albedo.on_body(seed or 0, np.eye(3))
        return self._scenes.get(key, scene).picture(exposure.position_m, rays, albedo=albedo)

    def height_m(self, exposure: Exposure, lat: float, lon: float) -> float:
        """The ground's height at a place, rad, over the reference sphere."""
        factor, _ = self._plans[exposure.index]
        # a few nodes about the place
        reach = 4.0 * self._terrain.posting_m / self._terrain.body.radius_m
        wide = reach / np.cos(lat)
        box = lon - wide, lat - reach, lon + wide, lat + reach
        ground = self._terrain.window(exposure.ground_seed, factor, box)
        col = np.mod(lon - ground.west, 2.0 * np.pi) / ground.step_lon
        row = (ground.north - lat) / ground.step_lat
        return float(sample_bicubic(ground.heights, np.array([row]), np.array([col]))[0])

    def _plan(self, camera: Camera, flight: Sequence[Exposure]) -> None:
        """Fineness and box of the ground for each picture of a camera, by its index."""
        plans = self._plans
        group: list[Exposure] = []
        shared: Box = WHOLE
        for exposure in flight:
            box, gsd = self._footprint(camera, exposure)
            # times finer than the terrain model
            factor = 2
            while factor < self._finest and self._terrain.posting_m / factor > gsd * self._nodes_px:
                factor *= 2
            last = group[-1] if group else None
            joined = _around(shared, box) if last else box
            if (
                last is None
                or last.pass_index != exposure.pass_index
                or plans[last.index][0] != factor
                or self._terrain.nodes(factor, joined) > SHARED_NODES
            ):
                group, joined = [], box
            group.append(exposure)
            shared = joined
            for member in group:
                plans[member.index] = (factor, shared)

    def _footprint(self, camera: Camera, exposure: Exposure) -> tuple[Box, float]:
        """The box of ground that a picture shows, with a margin for relief, and its finest GSD."""
        body, position = self._terrain.body, exposure.position_m
        radius = body.radius_m
        height = float(np.linalg.norm(position)) - radius
        gsd = max(height, 1.0) * camera.angular_resolution
        probes = every_px(self._corners(camera), PROBE_PX)
        rays = probes @ exposure.camera_from_body.as_matrix()
        if self._near:
            return self._near_box(position, rays), self._near_gsd(camera, position)
        along = distance_to_sphere(position, rays, radius)
        cosine = rays.reshape(-1, 3) @ (-position / np.linalg.norm(position))
        if not np.isfinite(along).all() or np.nanmin(cosine) < np.cos(NARROW):
            return WHOLE, gsd
        points = position + along[..., None] * rays
        lat = np.arcsin(points[..., 2] / radius)
        middle = np.arctan2(position[1], position[0])
        lon = np.arctan2(points[..., 1], points[..., 0])
        lon = middle + np.mod(lon - middle + np.pi, 2.0 * np.pi) - np.pi
        # relief moves what a slanted ray meets; the tangent of the slant is at most this
        slant = np.tan(np.arccos(np.nanmin(cosine)))
        relief = max(abs(body.plausible_heights_m[0]), body.plausible_heights_m[1])
        margin = (relief * slant + 500.0) / radius
        wider = margin / np.cos(min(np.abs(lat).max() + margin, 1.5))
        west, east = float(lon.min() - wider), float(lon.max() + wider)
        return (west, float(lat.min() - margin), east, float(lat.max() + margin)), gsd

    def _heights_m(self, position: FloatArray) -> tuple[float, float]:
        """Lowest and highest ground about the camera's foot, as far as it may see."""
        body = self._terrain.body
        lat, lon, distance = (float(v) for v in latlon_from_xyz(position))
        height = distance - body.radius_m
        lowest, highest = body.plausible_heights_m
        for _ in range(2):  # the second time about no more than is seen
            reach = NEAR_REACH * (height - lowest) / body.radius_m
            wide = reach / np.cos(min(abs(lat) + reach, 1.5))
            ground = self._terrain.window(
                None, 1, (lon - wide, lat - reach, lon + wide, lat + reach)
            )
            lowest, highest = ground.lowest_m, ground.highest_m
        return lowest, highest

    def _near_gsd(self, camera: Camera, position: FloatArray) -> float:
        """Return the GSD of the highest ground in view: never coarser than what is seen."""
        height = float(np.linalg.norm(position)) - self._terrain.body.radius_m
        lowest, highest = self._heights_m(position)
        over = max(height - highest, 0.3 * (height - lowest), 1.0)
        return over * camera.angular_resolution

    def _near_box(self, position: FloatArray, rays: FloatArray) -> Box:
        """Bound the ground that rays (..., 3) from low over it may meet."""
        radius = self._terrain.body.radius_m
        points = []
        for height in self._heights_m(position):
            along = distance_to_sphere(position, rays, radius + height)
            met = np.isfinite(along)
            points.append((position + along[met][:, None] * rays[met]).reshape(-1, 3))
        points.append(position[None])
        lat, lon, _ = latlon_from_xyz(np.concatenate(points))
        middle = np.arctan2(position[1], position[0])
        lon = middle + np.mod(lon - middle + np.pi, 2.0 * np.pi) - np.pi
        margin = NEAR_MARGIN_M / radius
        wider = margin / np.cos(min(np.abs(lat).max() + margin, 1.5))
        west, east = float(lon.min() - wider), float(lon.max() + wider)
        return west, float(lat.min() - margin), east, float(lat.max() + margin)


def _around(a: Box, b: Box) -> Box:
    """The box around two; the second one is brought to the first one's turn of longitude."""
    turn = 2.0 * np.pi * round((a[0] + a[2] - b[0] - b[2]) / (4.0 * np.pi))
    west, east = min(a[0], b[0] + turn), max(a[2], b[2] + turn)
    return west, min(a[1], b[1]), east, max(a[3], b[3])
