"""Rays against a closed mesh: embree finds the triangle, 64-bit arithmetic the place on it.

Embree computes in 32 bits. So the mesh is scaled to a ball of radius 1, rays from far away are
first moved to that ball, and distances are those to the plane of the found triangle in 64 bits.
What is left: beside an edge (1e-7 of the body's size) the neighbour may be taken, whose plane there
is as near, or a ray slips through between two triangles. Either meets a face from within, which the
sign of the ray's cosine shows; it is traced again beside itself by a millionth of the body's size
and, if that does not help, against all triangles in 64 bits. (Slips of shadow rays are not looked
for: they are a few lit pixels in a million.)
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, FloatArray, Int32Array
from catalog.errors import DataError
from catalog.geometry.kernel import kernel

ASIDE = 1e-6  # of the body's reach: ten steps of a 32-bit number
START = 1.001  # rays begin on a ball that holds the mesh with a little room
BATCH = 1 << 18  # rays at once: 32-bit copies of 6 MB


@kernel
def compute_outward_normal(corners: FloatArray, face: int) -> tuple[float, float, float]:
    """The outward normal of a face, twice its area long."""
    a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
    u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0


@kernel
def _measure_hits(
    corners: FloatArray,
    origins: FloatArray,
    rays: FloatArray,
    found: Int32Array,
    distance: FloatArray,
    cosine: FloatArray,
) -> None:
    """Distances to the planes of found triangles, and cosines of rays on their outward normals."""
    for n in range(found.size):
        distance[n], cosine[n] = np.inf, 0.0
        if found[n] < 0:
            continue
        a = corners[found[n], 0]
        x, y, z = compute_outward_normal(corners, found[n])
        across = rays[n, 0] * x + rays[n, 1] * y + rays[n, 2] * z
        over = (a[0] - origins[n, 0]) * x + (a[1] - origins[n, 1]) * y + (a[2] - origins[n, 2]) * z
        distance[n] = over / across
        cosine[n] = across / np.sqrt(x * x + y * y + z * z)


@kernel
def intersect_all(
    corners: FloatArray, origin: FloatArray, ray: FloatArray, nearest: float
) -> tuple[int, float]:
    """First triangle of all (m, 3, 3) that a ray meets beyond a distance, and where; -1 for none.

    Moeller and Trumbore, J. Graphics Tools 2 (1997) 21, in 64 bits; edges count to both sides.
    """
    best, at = -1, np.inf
    for n in range(corners.shape[0]):
        a, b, c = corners[n, 0], corners[n, 1], corners[n, 2]
        u0, u1, u2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        v0, v1, v2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        p0 = ray[1] * v2 - ray[2] * v1
        p1 = ray[2] * v0 - ray[0] * v2
        p2 = ray[0] * v1 - ray[1] * v0
        determinant = u0 * p0 + u1 * p1 + u2 * p2
        if determinant == 0.0:
            continue
        t0, t1, t2 = origin[0] - a[0], origin[1] - a[1], origin[2] - a[2]
        u = (t0 * p0 + t1 * p1 + t2 * p2) / determinant
        q0, q1, q2 = t1 * u2 - t2 * u1, t2 * u0 - t0 * u2, t0 * u1 - t1 * u0
        v = (ray[0] * q0 + ray[1] * q1 + ray[2] * q2) / determinant
        if u < -1e-12 or v < -1e-12 or u + v > 1.0 + 1e-12:
            continue
        distance = (v0 * q0 + v1 * q1 + v2 * q2) / determinant
        if nearest < distance < at:
            best, at = n, distance
    return best, at


class MeshRays:
    """A closed mesh ready for rays. Not safe across threads; pickles without its index.

    corners  (m, 3, 3) m: the three vertices of each face, counter-clockwise from outside
    """

    def __init__(self, corners: FloatArray) -> None:
        self.corners = np.ascontiguousarray(corners, dtype=np.float64)
        self.reach_m = float(np.sqrt(np.square(corners).sum(axis=2).max()))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_scene"}

    def find_first_hits(
        self, origins_m: ArrayLike, rays: ArrayLike
    ) -> tuple[Int32Array, FloatArray]:
        """First faces that unit rays (n, 3) from outside meet (-1: none), and distances (n) m.

        origins_m  (n, 3) or (3,), body frame; distances are infinite where nothing is met
        """
        both = np.broadcast_arrays(*(np.asarray(v, np.float64) for v in (origins_m, rays)))
        origins, rays = (np.ascontiguousarray(v) for v in both)
        hit_faces = np.empty(len(rays), np.int32)
        distance, cosine = np.empty(len(rays)), np.empty(len(rays))
        for part in _split_batches(len(rays)):
            start, ahead = self._move_to_ball(origins[part], rays[part])
            hit_faces[part] = self._run(start, rays[part], "INTERSECT")
            hit_faces[part][ahead] = -1
        _measure_hits(self.corners, origins, rays, hit_faces, distance, cosine)
        # rays that met a face from within are traced once more, a hair aside
        for sign in (1.0, -1.0):
            inner = np.flatnonzero(cosine > 0.0)
            if not inner.size:
                break
            aside = np.cross(rays[inner], np.roll(rays[inner], 1, axis=1) + [0.3, 0.5, 0.7])
            aside *= sign * ASIDE * self.reach_m / np.linalg.norm(aside, axis=1)[:, None]
            start, ahead = self._move_to_ball(origins[inner] + aside, rays[inner])
            again = self._run(start, rays[inner], "INTERSECT")
            again[ahead] = -1
            at, side = np.empty(inner.size), np.empty(inner.size)
            _measure_hits(self.corners, origins[inner], rays[inner], again, at, side)
            hit_faces[inner], distance[inner], cosine[inner] = again, at, side
        for n in np.flatnonzero(cosine > 0.0):
            hit_faces[n], distance[n] = intersect_all(self.corners, origins[n], rays[n], 0.0)
        return hit_faces, distance

    def find_next_hits(
        self, origins_m: FloatArray, rays: FloatArray, beyond_m: FloatArray
    ) -> tuple[Int32Array, FloatArray]:
        """Find hits from either side beyond distances (n) m along rays; see `find_first_hits`."""
        faces = self._run(origins_m + beyond_m[:, None] * rays, rays, "INTERSECT")
        distance, cosine = np.empty(len(rays)), np.empty(len(rays))
        _measure_hits(self.corners, origins_m, rays, faces, distance, cosine)
        return faces, distance

    def intersect_segments(
        self, origins_m: FloatArray, rays: FloatArray, lengths_m: FloatArray
    ) -> tuple[Int32Array, FloatArray]:
        """Faces that segments (n) meet, from either side (-1: none), and distances in 64 bits."""
        faces = self._run(origins_m, rays, "INTERSECT", lengths_m)
        distance, cosine = np.empty(len(rays)), np.empty(len(rays))
        _measure_hits(self.corners, origins_m, rays, faces, distance, cosine)
        return faces, distance

    def are_blocked(self, origins_m: FloatArray, ray: FloatArray) -> BoolArray:
        """Whether the mesh stands between origins (n, 3) m and the far end of one unit ray (3,)."""
        blocked = np.empty(len(origins_m), dtype=bool)
        for part in _split_batches(len(origins_m)):
            rays = np.broadcast_to(ray, origins_m[part].shape)
            blocked[part] = self._run(origins_m[part], rays, "OCCLUDED") >= 0
        return blocked

    def _move_to_ball(self, origins: FloatArray, rays: FloatArray) -> tuple[FloatArray, Any]:
        """Origins moved ahead to the ball about the mesh, and which rays do not meet it."""
        ball = START * self.reach_m
        along = np.einsum("ij,ij->i", origins, rays)
        length = np.linalg.norm(origins, axis=1)
        within = along * along - (length - ball) * (length + ball)
        move = np.where(length > ball, -along - np.sqrt(np.maximum(within, 0.0)), 0.0)
        missed = (length > ball) & ((within <= 0.0) | (move <= 0.0))
        return origins + move[:, None] * rays, missed

    def _run(
        self, origins: FloatArray, rays: FloatArray, query: str, lengths: FloatArray | None = None
    ) -> Int32Array:
        scaled = np.ascontiguousarray(origins / self.reach_m, dtype=np.float32)
        directions = np.ascontiguousarray(rays, dtype=np.float32)
        ends = None if lengths is None else (lengths / self.reach_m).astype(np.float32)
        faces: Int32Array = self._scene.run(scaled, directions, dists=ends, query=query)
        return faces

    @cached_property
    def _scene(self) -> Any:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore import EmbreeDevice
            from embreex.rtcore_scene import EmbreeScene
        except ImportError:
            raise DataError(
                "rays on meshes need the package embreex, which is made for x86-64 machines only; "
                "build on such a machine: its catalog can be used on all"
            ) from None
        scene = EmbreeScene(EmbreeDevice())
        TriangleMesh(scene, (self.corners / self.reach_m).astype(np.float32))
        return scene


def _split_batches(count: int) -> list[slice]:
    return [slice(first, first + BATCH) for first in range(0, count, BATCH)]
