"""Where the rays of an altimeter meet a digital surface: the source's iteration, and casting.

Source: Tuchin, thesis (2010), chapter 2: the ray meets the reference ellipsoid; on the normal of
the ellipsoid through that point lies a point of the surface; the ray meets the plane across the
normal through it; and again, until the range settles. Where the ground's slope times the tangent of
the incidence passes 1 that does not settle, and a flat ray may pass over a ridge. So it starts
above all ground, is kept between points of the ray above the ground and below it, and takes the
ground's slope from its last two points. What does not settle all the same is cast.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.geometry.ellipsoid import compute_normals, find_foot
from catalog.terrain.mesh.rays import MeshRays

MAX_STEPS, SETTLED_M = 40, 0.1
MIN_COSINE = 0.02  # fall of a ray on the ground, by its length: less tells of no crossing
NEAR_M, MAX_STRIDE = 50.0, 1.5  # higher over the ground a step is so many heights at most
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
        self._above_all = self.radii * np.linalg.norm(mesh.corners / self.radii, axis=-1).max()

    def cast(self, origins: FloatArray, rays: FloatArray) -> GroundHits:
        """Cast rays exactly against the triangles."""
        faces, distance = self.mesh.find_first_hits(origins, rays)
        points = origins + np.where(np.isfinite(distance), distance, 0.0)[:, None] * rays
        none, met = np.zeros(len(rays), dtype=np.int64), np.maximum(faces, 0).astype(np.int64)
        unsettled = np.zeros(len(rays), bool)
        return GroundHits(distance, points, self._normals[met], unsettled, none, met)

    def settle(self, origins: FloatArray, rays: FloatArray) -> GroundHits:
        """Iterate the ranges alone; rays that do not settle have an infinite range."""
        count = len(rays)
        distance, leaves = _through(origins, rays, self._above_all)
        settled, steps = np.zeros(count, bool), np.zeros(count, dtype=np.int64)
        met = np.zeros(count, dtype=np.int64)
        # the ground lies between what is known to be above it and below it
        above, below = distance.copy(), np.full(count, np.inf)
        last, last_over = np.full(count, np.nan), np.full(count, np.nan)
        open_ = np.isfinite(distance)
        for _ in range(MAX_STEPS):
            which = np.flatnonzero(open_)
            if not which.size:
                break
            steps[which] += 1
            at = distance[which]
            there = origins[which] + at[:, None] * rays[which]
            deep = (np.abs(there) / self.radii).max(axis=1) < 1.0 + MIN_HEIGHT
            there[deep] = self.radii  # any place with a normal: `deep` decides, not its height
            over, along, met[which] = self._over(there, rays[which])
            under = deep | (over < 0.0)
            above[which] = np.where(under, above[which], at)
            below[which] = np.where(under, at, below[which])
            # the plane's slope at first, then the ground's as the last step found it
            with np.errstate(invalid="ignore", divide="ignore"):
                slope = (over - last_over[which]) / (at - last[which])
                slope = np.where(np.isfinite(slope) & ~deep, slope, along)
                new = at - over / slope
            far = np.isinf(below[which]) & (over > NEAR_M)
            # far above it a long step may pass over a ridge
            ahead = at + np.where(far, MAX_STRIDE, 1.0) * over
            new = np.where(slope < -MIN_COSINE, np.where(far, np.minimum(new, ahead), new), ahead)
            out = ~((new > above[which]) & (new < below[which])) | deep
            new = np.where(out, 0.5 * (above[which] + below[which]), new)
            done = np.abs(new - at) < SETTLED_M
            last[which], last_over[which] = at, over
            distance[which] = new
            settled[which[done]] = True
            open_[which[done | (new > leaves[which])]] = False
        distance[~settled] = np.inf
        # of rays that miss the points are their origins: nobody reads them
        points = origins + np.where(settled, distance, 0.0)[:, None] * rays
        return GroundHits(distance, points, self._normals[met], settled, steps, met)

    def ranges(self, origins: FloatArray, rays: FloatArray) -> GroundHits:
        """Iterate the ranges, and cast where that does not settle or the ray is flat."""
        hits = self.settle(origins, rays)
        # a flat ray may settle behind a ridge that it meets first
        up = compute_normals(find_foot(hits.points, self.radii), self.radii)
        flat = np.abs(np.einsum("ij,ij->i", rays, up)) < MIN_TRUSTED
        unsettled = np.flatnonzero(~hits.settled | flat)
        if unsettled.size:
            cast = self.cast(origins[unsettled], rays[unsettled])
            hits.range_m[unsettled], hits.points[unsettled] = cast.range_m, cast.points
            hits.normals[unsettled], hits.faces[unsettled] = cast.normals, cast.faces
        return hits

    def height(self, places: FloatArray) -> FloatArray:
        """Return heights of places (n, 3) along the ellipsoid's normal, m; NaN deep inside."""
        return self._over(places, places)[0]

    def _over(
        self, places: FloatArray, rays: FloatArray
    ) -> tuple[FloatArray, FloatArray, IntArray]:
        """Heights (n,) as of `height`, cosines (n,) of rays on that normal, faces (n,) there."""
        foot = find_foot(places, self.radii)
        up = compute_normals(foot, self.radii)
        faces, below = self.mesh.find_first_hits(foot + ABOVE_M * up, -up)
        over: FloatArray = np.einsum("ij,ij->i", places - foot, up) - (ABOVE_M - below)
        along: FloatArray = np.einsum("ij,ij->i", rays, up)
        return over, along, np.maximum(faces, 0)


def _through(
    origins: FloatArray, rays: FloatArray, radii: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) at which rays enter an ellipsoid, 0 inside, infinite for a miss, and leave."""
    start, way = origins / radii, rays / radii
    a = np.einsum("ij,ij->i", way, way)
    b = np.einsum("ij,ij->i", start, way)
    under = b * b - a * (np.einsum("ij,ij->i", start, start) - 1.0)
    with np.errstate(invalid="ignore"):
        enters, leaves = ((-b + sign * np.sqrt(under)) / a for sign in (-1.0, 1.0))
    return np.where(leaves > 0.0, np.maximum(enters, 0.0), np.inf), leaves
