"""Where the rays of an altimeter meet a digital surface: the source's iteration, and casting.

Source: Tuchin, thesis (2010), chapter 2: the ray meets the reference ellipsoid; on the normal of
the ellipsoid through that point lies a point of the surface; the ray meets the plane across the
normal through it; and again, until the range settles. Where the ground's slope times the tangent of
the incidence passes 1 it does not settle: such rays are cast against the mesh.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.geometry.ellipsoid import foot_of, normal_at
from catalog.terrain.mesh.rays import MeshRays

MAX_STEPS, SETTLED_M = 40, 0.1
MIN_COSINE = 0.02  # of a ray on the normal: flatter ones count as parallel to the plane
MIN_TRUSTED = 0.5  # the same cosine: of flatter rays the first crossing is looked for by casting
ABOVE_M = 8e3  # over the ellipsoid from which normals are followed down: above all ground
MIN_HEIGHT = -0.6  # of the smallest semi-axis: a point deeper than this has no one normal


@dataclass(frozen=True, eq=False)
class GroundHits:
    """Where rays meet the ground.

    range_m  (n,) infinite where the ground is not met
    points, normals  (n, 3) of the ground there, body frame
    settled  (n,) whether the iteration found it;  steps  (n,) that it took
    faces    (n,) of the mesh there, where the ground is met
    """

    range_m: FloatArray
    points: FloatArray
    normals: FloatArray
    settled: BoolArray
    steps: IntArray
    faces: IntArray


class DigitalSurface:
    """A mesh with its reference ellipsoid."""

    def __init__(self, mesh: MeshRays, radii_m: tuple[float, float, float]) -> None:
        self.mesh, self.radii = mesh, np.array(radii_m)
        a, b, c = (mesh.corners[:, k] for k in range(3))
        across = np.cross(b - a, c - a)
        self._normals = across / np.linalg.norm(across, axis=1)[:, None]

    def cast(self, origins: FloatArray, rays: FloatArray) -> GroundHits:
        """By exact casting against the triangles."""
        faces, distance = self.mesh.first_hits(origins, rays)
        points = origins + np.where(np.isfinite(distance), distance, 0.0)[:, None] * rays
        none, met = np.zeros(len(rays), dtype=np.int64), np.maximum(faces, 0).astype(np.int64)
        unsettled = np.zeros(len(rays), bool)
        return GroundHits(distance, points, self._normals[met], unsettled, none, met)

    def settle(self, origins: FloatArray, rays: FloatArray) -> GroundHits:
        """By the iteration alone; rays that do not settle have an infinite range."""
        count = len(rays)
        distance = _to_ellipsoid(origins, rays, self.radii)
        settled, steps = np.zeros(count, bool), np.zeros(count, dtype=np.int64)
        met = np.zeros(count, dtype=np.int64)
        open_ = np.isfinite(distance)
        for _ in range(MAX_STEPS):
            which = np.flatnonzero(open_)
            if not which.size:
                break
            steps[which] += 1
            there = origins[which] + distance[which, None] * rays[which]
            deep = (np.abs(there) / self.radii).max(axis=1) < 1.0 + MIN_HEIGHT
            open_[which[deep]] = False
            which, there = which[~deep], there[~deep]
            foot = foot_of(there, self.radii)
            up = normal_at(foot, self.radii)
            faces, below = self.mesh.first_hits(foot + ABOVE_M * up, -up)
            surface = foot + (ABOVE_M - np.where(np.isfinite(below), below, 0.0))[:, None] * up
            along = np.einsum("ij,ij->i", rays[which], up)
            flat = (np.abs(along) < MIN_COSINE) | ~np.isfinite(below)
            reach = np.einsum("ij,ij->i", surface - origins[which], up)
            new = reach / np.where(flat, 1.0, along)
            done = ~flat & (new >= 0.0) & (np.abs(new - distance[which]) < SETTLED_M)
            distance[which] = np.where(flat, np.inf, new)
            met[which] = np.maximum(faces, 0)
            settled[which[done]] = True
            open_[which[flat | done]] = False
        distance[~settled] = np.inf
        # of rays that miss the points are their origins: nobody reads them
        points = origins + np.where(settled, distance, 0.0)[:, None] * rays
        return GroundHits(distance, points, self._normals[met], settled, steps, met)

    def ranges(self, origins: FloatArray, rays: FloatArray) -> GroundHits:
        """By the iteration, and by casting where it does not settle or the ray is flat."""
        found = self.settle(origins, rays)
        # a flat ray may settle behind a ridge that it meets first
        up = normal_at(foot_of(found.points, self.radii), self.radii)
        flat = np.abs(np.einsum("ij,ij->i", rays, up)) < MIN_TRUSTED
        rest = np.flatnonzero(~found.settled | flat)
        if rest.size:
            cast = self.cast(origins[rest], rays[rest])
            found.range_m[rest], found.points[rest] = cast.range_m, cast.points
            found.normals[rest], found.faces[rest] = cast.normals, cast.faces
        return found

    def height(self, places: FloatArray) -> FloatArray:
        """Of places (n, 3) over the ground along the ellipsoid's normal, m; NaN deep inside."""
        foot = foot_of(places, self.radii)
        up = normal_at(foot, self.radii)
        _, below = self.mesh.first_hits(foot + ABOVE_M * up, -up)
        over: FloatArray = np.einsum("ij,ij->i", places - foot, up) - (ABOVE_M - below)
        return over


def _to_ellipsoid(origins: FloatArray, rays: FloatArray, radii: FloatArray) -> FloatArray:
    """Distances (n,) to the near side of an ellipsoid, infinite where rays miss it.

    Where the ground lies below the ellipsoid a craft may be inside: its near side lies behind it.
    """
    start, way = origins / radii, rays / radii
    a = np.einsum("ij,ij->i", way, way)
    b = np.einsum("ij,ij->i", start, way)
    under = b * b - a * (np.einsum("ij,ij->i", start, start) - 1.0)
    with np.errstate(invalid="ignore"):
        distance = (-b - np.sqrt(under)) / a
    inside = np.einsum("ij,ij->i", start, start) < 1.0
    found: FloatArray = np.where((distance > 0.0) | inside, distance, np.inf)
    return found
