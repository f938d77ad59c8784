"""A closed mesh under one Sun, ready to be looked at from anywhere."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray, Int8Array, Int32Array, IntArray
from catalog.geometry.kernel import kernel
from catalog.geometry.vectors import unit
from catalog.photometry.hapke import reflectance_scalar
from catalog.photometry.sets import LUNAR, HapkeParameters
from catalog.terrain.mesh.rays import MeshRays, compute_outward_normal

# Shadow rays start so far over their face, share of the body's reach: 32 bits end at a hundredth.
LIFT = 1e-5


@kernel
def select_sunward(
    corners: FloatArray,
    faces: Int32Array,
    origin: FloatArray,
    rays: FloatArray,
    distances: FloatArray,
    sun: FloatArray,
    lift: float,
) -> tuple[IntArray, FloatArray]:
    """Numbers (m) of the rays (n, 3) that meet faces turned to the Sun.

    Also the points (m, 3) `lift` m above where they do.
    """
    numbers, starts = np.empty(faces.size, np.int64), np.empty((faces.size, 3))
    count = 0
    for n in range(faces.size):
        if faces[n] < 0:
            continue
        x, y, z = compute_outward_normal(corners, faces[n])
        if x * sun[0] + y * sun[1] + z * sun[2] <= 0.0:
            continue
        up = lift / np.sqrt(x * x + y * y + z * z)
        numbers[count] = n
        starts[count, 0] = origin[0] + distances[n] * rays[n, 0] + up * x
        starts[count, 1] = origin[1] + distances[n] * rays[n, 1] + up * y
        starts[count, 2] = origin[2] + distances[n] * rays[n, 2] + up * z
        count += 1
    return numbers[:count], starts[:count]


@kernel
def shade_faces(
    corners: FloatArray,
    faces: Int32Array,
    rays: FloatArray,
    lit: IntArray,
    sun: FloatArray,
    surface: HapkeParameters,
    out: Float32Array,
) -> None:
    """Put Hapke's radiance factor of the faces that lit rays meet into out (n)."""
    for n in lit:
        x, y, z = compute_outward_normal(corners, faces[n])
        length = np.sqrt(x * x + y * y + z * z)
        mu0 = (x * sun[0] + y * sun[1] + z * sun[2]) / length
        mu = -(x * rays[n, 0] + y * rays[n, 1] + z * rays[n, 2]) / length
        cos_g = -(rays[n, 0] * sun[0] + rays[n, 1] * sun[1] + rays[n, 2] * sun[2])
        out[n] = reflectance_scalar(mu0, mu, cos_g, surface)


class MeshScene:
    """A mesh under one Sun: faces are flat, each as bright as Hapke's law says, or in shadow.

    mesh      the body
    sun_body  (3,) direction to the Sun, body frame, any length; the Sun is a point
    surface   Hapke's parameters
    """

    def __init__(
        self, mesh: MeshRays, sun_body: ArrayLike, surface: HapkeParameters = LUNAR
    ) -> None:
        self.mesh, self.sun, self.surface = mesh, unit(sun_body), surface

    def radiance(self, origin_m: ArrayLike, rays: ArrayLike) -> tuple[Float32Array, Int32Array]:
        """Radiance factors (n) along unit rays (n, 3) from a camera (3,) m outside the body.

        Also the face that each meets, -1 for the sky, which is 0; rays may be NaN: sky.
        """
        origin = np.ascontiguousarray(origin_m, dtype=np.float64)
        rays = np.ascontiguousarray(rays, dtype=np.float64)
        seen = np.isfinite(rays[:, 0])
        if not seen.all():
            rays = np.where(seen[:, None], rays, 0.0)  # no direction meets nothing
        faces, distances = self.mesh.find_first_hits(origin, rays)
        faces[~seen] = -1
        corners, lift = self.mesh.corners, LIFT * self.mesh.reach_m
        numbers, starts = select_sunward(corners, faces, origin, rays, distances, self.sun, lift)
        lit = numbers[~self.mesh.are_blocked(starts, self.sun)]
        out = np.zeros(len(rays), np.float32)
        shade_faces(corners, faces, rays, lit, self.sun, self.surface, out)
        return out, faces

    def picture(
        self, origin_m: ArrayLike, corner_rays: ArrayLike, samples: int = 5
    ) -> Float32Array:
        """Mean radiance factor (rows, cols) of the pixels of a camera.

        origin_m     (3,) the camera, body frame, m, outside the body
        corner_rays  (rows + 1, cols + 1, 3) unit rays through the pixels' corners, body frame; NaN
                     where the camera sees nothing
        samples      rays a side of a pixel at edges of the body and of shadows; others have one
        """
        corners = np.asarray(corner_rays, dtype=np.float64)
        values, faces = self._sample_pixels(origin_m, corners, 0.5, 0.5, None)
        edges = _find_edges(np.where(faces < 0, 0, np.where(values > 0.0, 2, 1)).astype(np.int8))
        if samples > 1 and edges.any():
            total = np.zeros(int(edges.sum()))
            for row in range(samples):
                for col in range(samples):
                    at = (row + 0.5) / samples, (col + 0.5) / samples
                    total += self._sample_pixels(origin_m, corners, *at, edges)[0]
            values[edges] = total / samples**2
        return values

    def _sample_pixels(
        self,
        origin: ArrayLike,
        corners: FloatArray,
        down: float,
        along: float,
        chosen: BoolArray | None,
    ) -> tuple[Float32Array, Int32Array]:
        """Radiance and faces at a place inside all pixels (rows, cols), or chosen ones (n)."""
        rays = np.zeros((corners.shape[0] - 1, corners.shape[1] - 1, 3))
        for i, share in ((0, 1.0 - down), (1, down)):
            for j, part in ((0, 1.0 - along), (1, along)):
                rays += share * part * corners[i : i + rays.shape[0], j : j + rays.shape[1]]
        if chosen is not None:
            rays = rays[chosen]
        flat = rays.reshape(-1, 3)
        flat /= np.sqrt(np.einsum("ij,ij->i", flat, flat))[:, None]
        values, faces = self.radiance(origin, flat)
        return values.reshape(rays.shape[:-1]), faces.reshape(rays.shape[:-1])


def _find_edges(kind: Int8Array) -> BoolArray:
    """Which pixels have a neighbour of another kind."""
    out = np.zeros(kind.shape, dtype=bool)
    down, along = kind[1:] != kind[:-1], kind[:, 1:] != kind[:, :-1]
    out[1:] |= down
    out[:-1] |= down
    out[:, 1:] |= along
    out[:, :-1] |= along
    return out
