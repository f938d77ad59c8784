"""The light of mesh faces that rays meet."""

import numpy as np

from catalog.arrays import Float32Array, FloatArray, Int32Array, IntArray
from catalog.geometry.kernel import kernel
from catalog.photometry.hapke import HapkeParameters, reflectance_scalar
from catalog.terrain.mesh.rays import outward


@kernel
def facing_the_sun(
    corners: FloatArray, faces: Int32Array, origin: FloatArray, rays: FloatArray,
    distances: FloatArray, sun: FloatArray, lift: float, numbers: IntArray,
    starts: FloatArray,
) -> int:  # fmt: skip
    """Which rays (n, 3) meet faces turned to the Sun, and points `lift` m over where they do.

    Fills numbers (n) and starts (n, 3); returns how many there are.
    """
    count = 0
    for n in range(faces.size):
        if faces[n] < 0:
            continue
        x, y, z = outward(corners, faces[n])
        if x * sun[0] + y * sun[1] + z * sun[2] <= 0.0:
            continue
        up = lift / np.sqrt(x * x + y * y + z * z)
        numbers[count] = n
        starts[count, 0] = origin[0] + distances[n] * rays[n, 0] + up * x
        starts[count, 1] = origin[1] + distances[n] * rays[n, 1] + up * y
        starts[count, 2] = origin[2] + distances[n] * rays[n, 2] + up * z
        count += 1
    return count


@kernel
def radiance_of(
    corners: FloatArray, faces: Int32Array, rays: FloatArray, lit: IntArray,
    sun: FloatArray, surface: HapkeParameters, out: Float32Array,
) -> None:  # fmt: skip
    """Put Hapke's radiance factor of the faces that lit rays meet into out (n)."""
    for n in lit:
        x, y, z = outward(corners, faces[n])
        length = np.sqrt(x * x + y * y + z * z)
        mu0 = (x * sun[0] + y * sun[1] + z * sun[2]) / length
        mu = -(x * rays[n, 0] + y * rays[n, 1] + z * rays[n, 2]) / length
        cos_g = -(rays[n, 0] * sun[0] + rays[n, 1] * sun[1] + rays[n, 2] * sun[2])
        out[n] = reflectance_scalar(mu0, mu, cos_g, surface)
