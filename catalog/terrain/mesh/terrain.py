"""The ground of a body that is given as a mesh, cut into the map grids of patches.

On a body under 100 km a patch is a grid in the plane that touches the reference ellipsoid, with
heights along that plane's normal; on a larger one, as with rasters, a stereographic grid with
radial heights. A height is where the line through a node meets the ground first from outside.
Where it meets the ground again soon below, the ground overhangs and has no one height: NaN.

No ellipsoid follows the ground of a body of which lines from its centre leave some ground
unmet: of one with two lobes or deep hollows. Its patches lie in planes of the ground itself:
through the point, along the mean normal of the faces about it. Rays go down from half a patch's
width over the plane, so that a lobe that stands over the place is left out. At a cliff's foot a
node takes the ground on top, as pictures show it; a patch with much such ground overhangs.
"""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.bodies.body import Body
from catalog.geometry.cells import Graticule, Part
from catalog.geometry.latlon import latlon_from_xyz, xyz_from_latlon
from catalog.geometry.projection import MapProjection, Stereographic, TangentPlane, make_node_grid
from catalog.geometry.vectors import unit
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.relief.relief import GlobalRelief

SMALL_BODY_M = 100e3  # mean diameter
# A coarse node is the mean of so many rays a side that none covers more than a mesh's own
# posting; more than this would cost much and change little.
MAX_RAYS_ASIDE = 8
SHADOW_RAYS_ASIDE = 1
PAST = 1e-6  # of the body's reach: beyond a face that was met, before the next one is looked for
# In a plane of the ground: surfaces over the ceiling that are passed at most, the share of nodes
# that may have ground below ground (more and the patch overhangs), and faces that a normal is
# the mean of at most (of a finer mesh some are left out).
MAX_PASSED, MAX_COVERED, NORMAL_FACES = 6, 0.1, 1 << 18


class MeshTerrain:
    """A mesh as terrain. Not safe across threads; pickles by path.

    corners_file  .npy of (m, 3, 3) m, faces counter-clockwise from outside
    name          of the file that the mesh came from
    posting_m     distance of neighbouring vertices
    in_planes     whether patches lie in tangent planes: on a small body
    normals_m     radius about a point of the ground whose normal is that of its patches; 0: they
                  lie in planes that touch the body's ellipsoid
    """

    covers_body = True
    has_graticules = False  # a ray a node costs as much anywhere

    def __init__(
        self,
        body: Body,
        corners_file: Path,
        name: str,
        posting_m: float,
        normals_m: float = 0.0,
    ) -> None:
        self.body, self.corners_file, self.name = body, corners_file, name
        self.normals_m = normals_m
        self.posting_m = posting_m
        self.names: tuple[str, ...] = (name,)
        self.extent = f"{name} covers all of {body.name}"
        self.latitudes = -0.5 * np.pi, 0.5 * np.pi
        self.in_planes = 2.0 * body.radius_m < SMALL_BODY_M
        self.own_planes = self.in_planes and normals_m > 0.0

    def __getstate__(self) -> dict[str, Any]:
        made = ("rays", "_faces")
        return {name: value for name, value in self.__dict__.items() if name not in made}

    @cached_property
    def rays(self) -> MeshRays:
        """The mesh for rays, read at first use."""
        return MeshRays(np.load(self.corners_file))

    def files(self) -> list[Path]:
        """The file of corners."""
        return [self.corners_file]

    def close(self) -> None:
        """Drop the mesh; it is read again at the next use."""
        self.__dict__.pop("rays", None)
        self.__dict__.pop("_faces", None)

    def projection(self, lat: float, lon: float) -> MapProjection:
        """The projection of patches about the ground at a place (rad, planetocentric)."""
        if self.own_planes:
            point = self.points(lat, lon)
            normal_lat, normal_lon, _ = latlon_from_xyz(self._average_normal(point))
            return TangentPlane.make_through(point, float(normal_lat), float(normal_lon))
        if self.in_planes:
            return TangentPlane.make_below(self.points(lat, lon), self.body.radii_m)
        return Stereographic(lat, lon, self.body.radius_m)

    @cached_property
    def _faces(self) -> tuple[cKDTree, FloatArray]:
        """Middles of faces, to be searched, and normals (n, 3) as long as twice their areas."""
        corners = self.rays.corners[:: 1 + len(self.rays.corners) // NORMAL_FACES]
        a, b, c = (corners[:, k] for k in range(3))
        return cKDTree(corners.mean(axis=1)), np.cross(b - a, c - a)

    def _average_normal(self, point: FloatArray) -> FloatArray:
        """Unit mean normal (3,) of the ground about a point (3,) m, without what looks away."""
        tree, areas = self._faces
        _, nearest = tree.query(point)
        normal = areas[[*tree.query_ball_point(point, self.normals_m / 4.0), nearest]].sum(axis=0)
        about = areas[[*tree.query_ball_point(point, self.normals_m), nearest]]
        mean = about[about @ normal > 0.0].sum(axis=0)
        return unit(mean if mean.any() else normal)

    def points(self, lat: ArrayLike, lon: ArrayLike) -> FloatArray:
        """Points (..., 3) m of the ground at places (rad, planetocentric), the outermost."""
        directions = xyz_from_latlon(lat, lon, 1.0)
        outward = directions.reshape(-1, 3)
        start = 2.0 * self.rays.reach_m
        _, distance = self.rays.find_first_hits(start * outward, -outward)
        return (outward * (start - distance)[:, None]).reshape(directions.shape)

    def heights(self, lat: ArrayLike, lon: ArrayLike, posting_m: float) -> Float32Array:
        """Heights (...) of places (rad) above the sphere of the body's radius, m."""
        radius = np.linalg.norm(self.points(lat, lon), axis=-1)
        return np.asarray(radius - self.body.radius_m, dtype=np.float32)

    def covers(self, lat: ArrayLike, lon: ArrayLike, posting_m: float | None = None) -> BoolArray:
        """True: a closed mesh has ground everywhere."""
        return np.ones(np.broadcast_shapes(np.shape(lat), np.shape(lon)), dtype=bool)

    def local_grid(self, projection: MapProjection, posting_m: float, size: int) -> Float32Array:
        """Heights (size, size) of a centred map grid; NaN beside the body and under overhangs."""
        return self._grid(projection, posting_m, size, size * posting_m)

    def graticule_heights(
        self, graticule: Graticule, part: Part, posting_m: float, latitudes: tuple[float, float]
    ) -> Float32Array:
        """Heights (height, width) m of a part of a graticule; row 0 south, column 0 west."""
        lat = np.clip(graticule.lat(part.rows), -np.pi / 2.0, np.pi / 2.0)
        return self.heights(lat[:, None], graticule.lon(part.cols), posting_m)

    def overhangs(self, projection: MapProjection, posting_m: float, size: int) -> bool:
        """Whether a vertical line through a node meets the ground again within the grid's width.

        In a plane of the ground: whether more than a few lines do.
        """
        if self.own_planes:
            return self._measure_covered_share(projection, posting_m, size) > MAX_COVERED
        first = self._find_outermost(projection, *make_node_grid(size, posting_m))
        single = self._find_outermost(
            projection, *make_node_grid(size, posting_m), size * posting_m
        )
        return bool((np.isnan(single) & ~np.isnan(first)).any())

    def make_outer_grids(
        self, projection: MapProjection, posting_m: float, size: int
    ) -> Sequence[tuple[Float32Array, float]]:
        """Coarser grids, each of twice the posting of the one before, until all of the body is in.

        Overhanging ground enters with its outermost height: it throws shadows. In a plane of the
        ground it does so up to a height of half a grid's width.
        """
        if not self.in_planes:
            return ()
        grids = []
        while size * posting_m < 4.0 * self.rays.reach_m:
            posting_m *= 2.0
            width_m = size * posting_m if self.own_planes else 0.0
            grids.append((self._grid(projection, posting_m, size, width_m, up=True), posting_m))
        return grids

    def provenance(self, projection: MapProjection, posting_m: float, size: int) -> str:
        """The mesh's file."""
        return self.name

    def _grid(
        self,
        projection: MapProjection,
        posting_m: float,
        size: int,
        depth_m: float = 0.0,
        *,
        up: bool = False,
    ) -> Float32Array:
        """Average heights of `_find_outermost` or `_find_in_plane` over the cells of grid nodes.

        up  whether ground over the ceiling counts as high as that
        """
        # what throws shadows from afar need not be as exact as what is matched
        most = SHADOW_RAYS_ASIDE if up and self.own_planes else MAX_RAYS_ASIDE
        aside = int(np.clip(np.ceil(posting_m / self.posting_m - 0.05), 1, most))
        x, y = make_node_grid(size * aside, posting_m / aside)
        if self.own_planes and depth_m:
            heights, filled = self._find_in_plane(projection, x, y, depth_m)
            heights[filled & up] = depth_m / 2.0
        else:
            heights = self._find_outermost(projection, x, y, depth_m)
        cells = heights.reshape(size, aside, size, aside)
        means: Float32Array = cells.mean(axis=(1, 3)).astype(np.float32)
        return means

    def _find_outermost(
        self, projection: MapProjection, x: FloatArray, y: FloatArray, depth_m: float = 0.0
    ) -> FloatArray:
        """Heights of the outermost ground; NaN where it begins again less than depth_m below."""
        top = 2.0 * self.rays.reach_m  # above all ground
        starts = projection.points(x.ravel(), y.ravel(), top)
        rays = projection.downward(starts)
        face, distance = self.rays.find_first_hits(starts, rays)
        height = np.where(np.isfinite(distance), top - distance, np.nan)
        if depth_m == 0.0:
            return height.reshape(x.shape)
        met = np.flatnonzero(face >= 0)
        past = PAST * self.rays.reach_m
        # out of the body again, then into it once more
        for _ in range(2):
            if not met.size:
                break
            face, at = self.rays.find_next_hits(starts[met], rays[met], distance[met] + past)
            below = (face >= 0) & (at < top - height[met] + depth_m)
            met = met[below]
            distance[met] = at[below]
        height[met] = np.nan
        return height.reshape(x.shape)

    def _find_in_plane(
        self, projection: MapProjection, x: FloatArray, y: FloatArray, width_m: float
    ) -> tuple[FloatArray, BoolArray]:
        """Heights of the first ground below a ceiling of half a width, NaN where there is none.

        Also which nodes the body fills at the ceiling: their ground is higher.
        """
        top, ceiling = 2.0 * self.rays.reach_m, width_m / 2.0
        starts = projection.points(x.ravel(), y.ravel(), top)
        rays = projection.downward(starts)
        face, distance = self.rays.find_first_hits(starts, rays)
        filled = np.zeros(face.size, dtype=bool)
        over = np.flatnonzero((face >= 0) & (top - distance > ceiling))
        for _ in range(MAX_PASSED):
            out, again = self._find_next_ground(starts[over], rays[over], distance[over])
            filled[over] = top - out < ceiling
            distance[over] = np.where(filled[over], np.inf, again)
            over = over[top - distance[over] > ceiling]
            if not over.size:
                break
        distance[over] = np.inf
        height = np.where(np.isfinite(distance), top - distance, np.nan)
        height[height < -width_m] = np.nan
        return height.reshape(x.shape), filled.reshape(x.shape)

    def _measure_covered_share(
        self, projection: MapProjection, posting_m: float, size: int
    ) -> float:
        """Share of a grid's nodes that have more ground within its width below the first."""
        x, y = make_node_grid(size, posting_m)
        heights = self._find_in_plane(projection, x, y, size * posting_m)[0].ravel()
        top = 2.0 * self.rays.reach_m
        met = np.flatnonzero(np.isfinite(heights))
        starts = projection.points(x.ravel()[met], y.ravel()[met], top)
        rays = projection.downward(starts)
        below = self._find_next_ground(starts, rays, top - heights[met])[1]
        return float((top - below > heights[met] - size * posting_m).sum() / heights.size)

    def _find_next_ground(
        self, starts: FloatArray, rays: FloatArray, distance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Where rays that met ground at distances (n) m leave the body, and meet it once more."""
        past, again = PAST * self.rays.reach_m, np.full(len(rays), np.inf)
        if not len(rays):
            return again, again
        _, out = self.rays.find_next_hits(starts, rays, distance + past)
        left = np.flatnonzero(np.isfinite(out))
        if left.size:
            _, again[left] = self.rays.find_next_hits(starts[left], rays[left], out[left] + past)
        return out, again


RAYS_ASIDE = 4  # a side of a cell, of which the mean is taken
MAX_ROWS = 1440


def make_mesh_relief(terrain: MeshTerrain) -> GlobalRelief:
    """Mean and greatest heights, as far out as the surface reaches, in cells half as wide as faces.

    On a flat face the radius is greatest at a corner or where a cell ends. Greatest heights are
    those of the cell's rays and vertices, low by the rise of a face over an eighth of a cell.
    """
    radius = terrain.body.radius_m
    rows = min(MAX_ROWS, int(np.ceil(2.0 * np.pi * radius / terrain.posting_m)))
    step = np.pi / (rows * RAYS_ASIDE)
    lat = np.pi / 2.0 - (np.arange(rows * RAYS_ASIDE) + 0.5) * step
    lon = -np.pi + (np.arange(2 * rows * RAYS_ASIDE) + 0.5) * step
    means = np.empty((rows, 2 * rows), np.float32)
    max_heights = np.empty((rows, 2 * rows), np.float32)
    for row in range(rows):
        part = slice(row * RAYS_ASIDE, (row + 1) * RAYS_ASIDE)
        heights = terrain.heights(lat[part, None], lon[None, :], terrain.posting_m)
        cells = heights.reshape(RAYS_ASIDE, 2 * rows, RAYS_ASIDE)
        means[row], max_heights[row] = cells.mean(axis=(0, 2)), cells.max(axis=(0, 2))
    vertex_lat, vertex_lon, out = latlon_from_xyz(terrain.rays.corners.reshape(-1, 3))
    at = np.minimum(((np.pi / 2.0 - vertex_lat) * rows / np.pi).astype(np.int64), rows - 1)
    along = ((vertex_lon + np.pi) * rows / np.pi).astype(np.int64) % (2 * rows)
    np.maximum.at(max_heights, (at, along), (out - radius).astype(np.float32))
    return GlobalRelief(means, np.maximum(max_heights, means), radius, terrain.name)


def make_relief_mesh(relief: GlobalRelief) -> MeshRays:
    """The surface of a relief: triangles between the middles of its cells, closed at the poles."""
    rows, cols = relief.heights.shape
    lat = np.pi / 2.0 - (np.arange(rows) + 0.5) * relief.step_rad
    lon = -np.pi + (np.arange(cols) + 0.5) * relief.step_rad
    grid = xyz_from_latlon(lat[:, None], lon[None, :], relief.radius_m + relief.heights)
    ends = [[0.0, 0.0, end * (relief.radius_m + relief.heights[row].mean())]
            for end, row in ((1.0, 0), (-1.0, -1))]  # fmt: skip
    number = np.arange(rows * cols).reshape(rows, cols)
    east = np.roll(number, -1, axis=1)
    quads = [(number[:-1], number[1:], east[1:]), (number[:-1], east[1:], east[:-1])]
    faces = [np.stack(triple, axis=-1).reshape(-1, 3) for triple in quads]
    north, south = np.full(cols, rows * cols), np.full(cols, rows * cols + 1)
    faces += [np.stack([north, number[0], east[0]], axis=1)]
    faces += [np.stack([south, east[-1], number[-1]], axis=1)]
    return MeshRays(np.concatenate([grid.reshape(-1, 3), ends])[np.concatenate(faces)])
