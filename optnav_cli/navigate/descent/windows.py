"""Windows of the terrain model for low heights: parts of patches, oversampled and joined.

A patch of a control point is wider than a picture from 5 km shows. Its catalog tiles the ground, so
any square of it can be cut from the patches about it and matched as a control point is: at half the
model's posting, with the picture blurred to what the model knows. Windows lie on a fixed lattice,
so that those of one frame are sought again in the next one, with the same error of their ground.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from catalog.arrays import BoolArray, Float32Array, FloatArray, IndexArray
from catalog.cache import Cache
from catalog.control_point import ControlPoint, Patch
from catalog.errors import DataError
from catalog.geometry.ellipsoid import distance_to_sphere
from catalog.geometry.grid import sample_bicubic
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.geometry.vectors import unit
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.expectation import FrameContext
from optnav_cli.control_points.field import ControlPointField
from optnav_cli.control_points.point_match import (
    MARGIN_NODES,
    MatchGates,
    PointMatch,
    count_nodes_per_sample,
    match_point,
)
from optnav_cli.control_points.reference import Reference
from optnav_cli.control_points.search_plan import SearchPlan
from optnav_cli.estimation.models.points import Pose
from optnav_cli.reasons import Reason, ReasonCode

# A window's side, postings, and the least one; of the square seen it takes at most this share.
SIDE, MIN_SIDE, MAX_SHARE = 24, 12, 0.6
# Over a model whose shortest wave is stated: least posting over that wave, waves in a window. Of
# GLD100's 1.6 km 28 of 30 windows were found at 237 m, one at 118 m; 9 km halve the scatter of 6.
RESOLVED_SHARE, WAVES, MAX_SIDE = 0.125, 6.0, 40
STEP = 4  # postings between places of the lattice
OVERSAMPLED = 2  # nodes of a window a posting of the model
SOFT_NODES = 0.9
MAX_SEARCH_NODES = 24
MAX_EMISSION, MIN_SUN = np.radians(60.0), np.radians(3.0)
SQUARES = 6  # along a side of the picture: one window in each
KEPT_WINDOWS = 500
SHADOW_NODES, SHADOW_LEVELS = 100, 3  # of the grids about a window that throw shadows into it
FEW_NODES = 10  # a side of a window, asked first
MIN_KNOWN = 0.95  # share of a window that the patches must cover
# See `compute_min_score`: of searches over at most so many nodes to every side, one in a thousand.
MAX_SCORE = 0.5


class WindowKey(NamedTuple):
    """A window of the lattice: level of the catalog, side in postings, and its place in STEPs."""

    level: int
    side: int
    row: int
    col: int

    @property
    def number(self) -> int:
        """The key as one number: matches.csv's id."""
        row, col = self.row + 50_000, self.col + 50_000
        return ((self.level * 100 + self.side) * 100_000 + row) * 100_000 + col


@dataclass(frozen=True, eq=False)
class Window:
    """A square of ground to be matched; place_m (3,) its middle on the ground, m, body frame."""

    key: WindowKey
    place_m: FloatArray
    projection: Stereographic
    posting_m: float
    field: "WindowField"

    @cached_property
    def reference(self) -> Reference | None:
        """The ground ready to render; None where the catalog has too little of it."""
        return self.field.reference(self)


@dataclass(frozen=True, eq=False)
class SoughtWindow:
    """A window that was looked for, and where, px."""

    window: Window
    match: PointMatch
    expected_px: FloatArray


class WindowField:
    """The windows of a catalog about a descent.

    middle_m  (3,) a place that the descent goes over; the lattice is flat about it
    Raises DataError for a catalog whose patches do not lie on a sphere.
    """

    def __init__(self, points: ControlPointField, middle_m: FloatArray) -> None:
        if points.layers[0].planes is not None:
            raise DataError(
                "the catalog's patches lie in tangent planes, and a descent is flown over those of "
                "a large body; leave [inertial] out of run.toml"
            )
        lat, lon, _ = (float(v) for v in latlon_from_xyz(middle_m))
        self.points = points
        self.map = Stereographic(lat, lon, points.radius_m)
        self._windows: Cache[WindowKey, Window | None] = Cache(KEPT_WINDOWS)

    def posting_m(self, level: int) -> float:
        """Return the posting of a level of the catalog, m."""
        return float(self.points.layers[0].postings_m[level])

    def window(self, key: WindowKey) -> Window | None:
        """Return a window of the lattice; None where the catalog has no ground."""
        return self._windows.get(key, lambda: self._make_window(key))

    def ground_m(self, place_m: FloatArray) -> float | None:
        """Return the model's height over the sphere at a point (3,); None outside the catalog."""
        place_m = self.points.radius_m * unit(place_m)
        for level in range(len(self.points.layers[0].postings_m)):
            heights = self._sample_patches(place_m, place_m[None], level, joined=False)
            if np.isfinite(heights[0]):
                return float(heights[0])
        return None

    def meet_ray(self, position_m: FloatArray, ray: FloatArray) -> FloatArray | None:
        """Return where a ray (3,) from a position (3,) meets the ground; None where it does not."""
        height = 0.0
        for _ in range(6):
            radius = self.map.radius_m + height
            along = float(distance_to_sphere(position_m, ray[None], radius)[0])
            if not np.isfinite(along):
                return None
            point: FloatArray = position_m + along * ray
            ground = self.ground_m(point)
            if ground is None:
                return None
            height = ground
        return point

    def fit_normal(self, place_m: FloatArray, half_m: float) -> FloatArray:
        """Fit the ground's normal (3,) over a base; the radial direction where the model ends."""
        up = unit(place_m)
        axes = body_from_local(*(float(v) for v in latlon_from_xyz(place_m)[:2]))
        base = max(0.5 * self.posting_m(0), half_m)
        slopes = []
        for axis in (axes[:, 0], axes[:, 1]):
            ends = [self.ground_m(place_m + sign * base * axis) for sign in (1.0, -1.0)]
            if ends[0] is None or ends[1] is None:
                return up
            slopes.append((ends[0] - ends[1]) / (2.0 * base))
        normal: FloatArray = unit(up - slopes[0] * axes[:, 0] - slopes[1] * axes[:, 1])
        return normal

    def choose_level(self, view: "SeenGround", camera: Camera) -> tuple[int, int] | None:
        """Choose the level and the side of windows, postings, for a picture; None for none.

        The finest level that picture and model resolve, or a finer one where too little is seen.
        """
        postings = self.points.layers[0].postings_m
        fit = np.flatnonzero(postings >= 2.5 * view.metres_per_pixel)  # 2.5 pixels at least
        if not fit.size:
            return None
        resolution = self.points.resolution_m(view.middle_m) or 0.0
        held = np.flatnonzero(postings >= RESOLVED_SHARE * resolution)
        coarsest = max(int(fit[0]), int(held[0]) if held.size else len(postings) - 1)
        width = view.metres_per_pixel * min(camera.width_px, camera.height_px)
        for level in range(coarsest, int(fit[0]) - 1, -1):
            most = min(max(SIDE, round(WAVES * resolution / postings[level])), MAX_SIDE)
            most -= most % STEP
            side = min(most, int(MAX_SHARE * width / postings[level]) // STEP * STEP)
            if side >= MIN_SIDE:
                return level, side
        return None

    def reference(self, window: Window) -> Reference | None:
        """Return the ground of a window; None where the catalog has too little of it."""
        key, posting = window.key, window.posting_m
        lat, lon = window.projection.lat, window.projection.lon
        radius = float(np.linalg.norm(window.place_m))
        point = _make_point(np.degrees(lat), np.degrees(lon), radius)
        window_grid = _Grid(posting / OVERSAMPLED, _count_room_nodes(key))
        few = _Grid(window_grid.posting_m * window_grid.size / FEW_NODES, FEW_NODES)
        if (
            np.isfinite(self._sample_heights(point, few, key.level, joined=False)).mean()
            < MIN_KNOWN
        ):
            return None
        last = min(key.level + SHADOW_LEVELS, len(self.points.layers[0].postings_m))
        grids = [(key.level, window_grid)]
        # coarser patches throw shadows in
        grids += [(n, _Grid(self.posting_m(n), SHADOW_NODES)) for n in range(key.level, last)]
        patches = []
        for number, (level, grid) in enumerate(grids):
            heights = self._sample_heights(point, grid, level, joined=number == 0)
            if number == 0 and np.isfinite(heights).mean() < MIN_KNOWN:
                return None
            patches.append(Patch(grid.posting_m, heights))
        law = self.points.layers[0].law
        return Reference(point, tuple(patches), self.points.radius_m, law=law)

    def find_covered(self, keys: Sequence[WindowKey]) -> BoolArray:
        """Find which windows (n,) of one level and side may have ground; the others have none.

        A catalog has a point in each cell with ground, so far from all of them there is none.
        """
        posting = self.posting_m(keys[0].level)
        middles = STEP * posting * np.array([(key.col, key.row) for key in keys], np.float64)
        span = posting / OVERSAMPLED * (_count_room_nodes(keys[0]) - 1)
        few = middles[:, None] + span * np.array(list(product((-0.5, 0.0, 0.5), repeat=2)))
        distances = self.points.distances_m(self.map.points(few[..., 0], few[..., 1], 0.0))
        cell = float(np.radians(self.points.layers[0].grid.step_deg)) * self.points.radius_m
        farthest: FloatArray = distances.max(axis=1)
        # Ground of the catalog has a point within a cell.
        return farthest < 1.0 * cell

    def _make_window(self, key: WindowKey) -> Window | None:
        posting = self.posting_m(key.level)
        x, y = STEP * posting * key.col, STEP * posting * key.row
        middle = self.map.points(x, y, 0.0)
        height = self.ground_m(middle)
        if height is None:
            return None
        lat, lon = (float(v) for v in self.map.latlon(x, y))
        projection = Stereographic(lat, lon, self.points.radius_m)
        return Window(key, projection.points(0.0, 0.0, height), projection, posting, self)

    def _sample_heights(
        self, point: ControlPoint, grid: "_Grid", level: int, *, joined: bool
    ) -> Float32Array:
        """Sample heights (n, n) of a grid about a point; joined: neighbours weighted smoothly.

        Else each node is of the nearest patch that has it: what throws shadows need not be smooth.
        """
        projection = point.projection(self.points.radius_m)
        places = projection.points(*make_node_grid(grid.size, grid.posting_m), 0.0).reshape(-1, 3)
        heights = self._sample_patches(point.xyz_m, places, level, joined=joined)
        return heights.reshape(grid.size, grid.size)

    def _sample_patches(
        self, middle_m: FloatArray, places: FloatArray, level: int, *, joined: bool
    ) -> Float32Array:
        """Sample heights (n,) at points (n, 3) from the patches about a middle; NaN outside."""
        total, weight = np.zeros(len(places)), np.zeros(len(places))
        # Patches within 110 nodes, half the grid's side and half of theirs, are joined.
        reach = 110 * self.posting_m(level)
        for index in self.points.nearest(middle_m, 16, reach):
            reference = self.points.reference(index)
            if reference is None or level >= len(reference.patches):
                continue
            wanted = np.flatnonzero(weight == 0.0) if not joined else np.arange(len(places))
            if wanted.size == 0:
                break
            patch = reference.patches[level]
            # More than eight nodes inside a patch no other one is needed.
            if joined and weight.min() > 8.0:
                break
            x, y = reference.projection.xy_from_xyz(places[wanted])
            half = (patch.size - 1) / 2.0
            row, col = half - y / patch.posting_m, half + x / patch.posting_m
            # less and less toward a patch's border, so that neighbours join without a step
            inward = half - np.maximum(np.abs(row - half), np.abs(col - half))
            inside = inward > 0.0
            heights = sample_bicubic(patch.heights_m, row[inside], col[inside])
            known = np.isfinite(heights)
            at, share = wanted[inside][known], inward[inside][known]
            total[at] += share * heights[known]
            weight[at] += share
        joined_heights = np.where(weight > 0.0, total / np.maximum(weight, 1e-9), np.nan)
        return joined_heights.astype(np.float32)


def _count_room_nodes(key: WindowKey) -> int:
    """Count the nodes along a side of a window with all the room of a search."""
    return OVERSAMPLED * key.side + 2 * (MAX_SEARCH_NODES + MARGIN_NODES)


class _Grid(NamedTuple):
    """Nodes of a window's level."""

    posting_m: float
    size: int


class SeenGround(NamedTuple):
    """Ground in view of a picture.

    middle_m         (3,) below its middle
    metres_per_pixel there, square to the line of sight
    border_m         (n, 3) the ground at its border, as far as it is seen under MAX_EMISSION
    """

    middle_m: FloatArray
    metres_per_pixel: float
    border_m: FloatArray

    def distance_m(self, camera: Camera) -> float:
        """Return the distance from the camera to the ground at the picture's middle."""
        return self.metres_per_pixel * camera.coarse_focal_px


def find_view(camera: Camera, pose: Pose, windows: WindowField) -> SeenGround | None:
    """Find the ground in a picture; None where its middle shows none of the catalog."""
    turn = pose.camera_from_body.as_matrix()
    middle_px = np.array([[camera.width_px - 1, camera.height_px - 1]]) / 2.0
    # 24 rays along each border bound the ground in view.
    pixels = np.concatenate([middle_px, camera.border(24)])
    rays = camera.unproject(pixels) @ turn
    rays = rays[np.isfinite(rays).all(axis=1)]
    radius = windows.map.radius_m
    height = 0.0
    for _ in range(3):  # the ground's height under the middle
        along = distance_to_sphere(pose.position_m, rays, radius + height)
        if not np.isfinite(along[0]):
            return None
        middle = pose.position_m + along[0] * rays[0]
        ground = windows.ground_m(middle)
        if ground is None:
            return None
        height = ground
    met = np.isfinite(along)
    places = pose.position_m + along[met][:, None] * rays[met]
    emission = np.einsum("ni,ni->n", -rays[met], unit(places))
    seen = places[emission > np.cos(MAX_EMISSION)]
    return SeenGround(middle, float(along[0]) / camera.coarse_focal_px, seen)


def choose_windows(
    frame: FrameContext, pose: Pose, windows: WindowField, known: Sequence[WindowKey]
) -> list[Window]:
    """Choose a window in each square of the picture, those already known first."""
    camera = frame.camera
    view = find_view(camera, pose, windows)
    if view is None or len(view.border_m) < 3:
        return []
    chosen_level = windows.choose_level(view, camera)
    if chosen_level is None:
        return []
    level, side = chosen_level
    posting = windows.posting_m(level)
    step = STEP * posting
    x, y = windows.map.xy_from_xyz(np.concatenate([view.border_m, view.middle_m[None]]))
    cols = np.arange(int(np.ceil(x.min() / step)), int(np.floor(x.max() / step)) + 1)
    rows = np.arange(int(np.ceil(y.min() / step)), int(np.floor(y.max() / step)) + 1)
    col, row = (grid.ravel() for grid in np.meshgrid(cols, rows))
    height = float(windows.map.height_of(view.middle_m))
    places = windows.map.points(step * col, step * row, height)
    pixels = camera.project_from_body(places, pose.position_m, pose.camera_from_body.as_matrix())
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        square = np.floor(pixels / size * SQUARES)
        off = np.abs(pixels / size * SQUARES - square - 0.5).max(axis=1)
        inside = ((square >= 0) & (square < SQUARES)).all(axis=1)
    taken = {(key.row, key.col) for key in known if (key.level, key.side) == (level, side)}
    fresh = np.array([(int(r), int(c)) not in taken for r, c in zip(row, col, strict=True)])
    chosen: list[Window] = []
    order: IndexArray = np.lexsort((col, row, off, fresh))
    order = order[inside[order]]
    keys = [WindowKey(level, side, int(row[k]), int(col[k])) for k in order]
    known_ground = windows.find_covered(keys) if keys else np.zeros(0, dtype=bool)
    full: set[tuple[int, int]] = set()
    for k, key, has_ground in zip(order, keys, known_ground, strict=True):
        if not has_ground or (cell := (int(square[k, 0]), int(square[k, 1]))) in full:
            continue
        window = windows.window(key)
        if window is None or not _is_seen(frame, pose, window) or window.reference is None:
            continue
        full.add(cell)
        chosen.append(window)
    return chosen


def match_window(frame: FrameContext, pose: Pose, window: Window, sigma_px: float) -> PointMatch:
    """Search a window about where the pose expects it, to sigma_px."""
    if window.reference is None:
        return PointMatch(window.key.level, Reason(ReasonCode.NO_TERRAIN, "no terrain data"))
    sample = float(np.linalg.norm(window.place_m - pose.position_m)) / frame.camera.coarse_focal_px
    posting = window.posting_m / OVERSAMPLED
    room = int(np.ceil(frame.settings.match.search_sigmas * sigma_px * sample / posting + 2.0))
    room, nodes = min(room, MAX_SEARCH_NODES), OVERSAMPLED * window.key.side
    plan = SearchPlan(0, nodes, room, sample, soft_nodes=SOFT_NODES)
    gates = MatchGates(compute_min_score(nodes, room), frame.settings.match.rival_ratio)
    args = window.reference, plan, frame.picture, frame.camera, pose, frame.sun_body
    return match_point(*args, frame.matcher, gates)


def compute_min_score(nodes: int, room: int) -> float:
    """Compute the least correlation: MAX_SCORE, or in a small search what chance reaches.

    nodes  a side of the template;  room  of the search on every side
    A model that is wrong at its posting correlates little with the ground: 0.2 to 0.4 in 3 m of
    error on smooth ground. Where the track leaves little room, such a window still says something,
    and what its match leaves over says how little.
    """
    if room > 8:
        return MAX_SCORE
    sample = count_nodes_per_sample(SOFT_NODES)
    places = max((2 * room + 1) ** 2 / sample, 1.0)
    # One in a thousand searches over at most eight nodes to each side passes by chance.
    sigmas = -float(ndtri(1e-3 / places))
    return min(MAX_SCORE, sigmas / float(np.sqrt(nodes**2 / sample)))


def compute_overlaps(some: Sequence[WindowKey], others: Sequence[WindowKey]) -> FloatArray:
    """Correlate windows' errors (k, n): their common ground over the root of both areas."""
    first, second = (np.array(keys, np.int64).reshape(-1, 4).T for keys in (some, others))
    # in postings of the finer one: each level's is twice that of the one below
    finer = np.minimum.outer(first[0], second[0])
    scale, other_scale = 2 ** (first[0][:, None] - finer), 2 ** (second[0] - finer)
    side, other_side = scale * first[1][:, None], other_scale * second[1]
    shares = np.ones(finer.shape)
    for axis in (2, 3):
        apart = STEP * np.abs(scale * first[axis][:, None] - other_scale * second[axis])
        common = np.minimum(0.5 * (side + other_side) - apart, np.minimum(side, other_side))
        shares *= np.maximum(common, 0.0) / np.sqrt(side * other_side)
    return shares


def _is_seen(frame: FrameContext, pose: Pose, window: Window) -> bool:
    """Whether a window lies whole in the picture, lit and not too oblique."""
    point, up = window.place_m, unit(window.place_m)
    sight = unit(pose.position_m - point)
    if sight @ up < np.cos(MAX_EMISSION) or frame.sun_body @ up < np.sin(MIN_SUN):
        return False
    half = window.key.side * window.posting_m / 2.0
    height = float(window.projection.height_of(point))
    x, y = np.array([-1.0, 1.0, 1.0, -1.0]) * half, np.array([-1.0, -1.0, 1.0, 1.0]) * half
    corners = window.projection.points(x, y, height)
    turn = pose.camera_from_body.as_matrix()
    pixels = frame.camera.project_from_body(corners, pose.position_m, turn)
    return bool(np.isfinite(pixels).all() and frame.camera.contains(pixels).all())


def _make_point(lat_deg: float, lon_deg: float, radius_m: float) -> ControlPoint:
    """Make a control point without a certificate."""
    return ControlPoint(0, lat_deg, lon_deg, radius_m, 0.0, 0.0, 0.0, 0, (), (), usable=True)
