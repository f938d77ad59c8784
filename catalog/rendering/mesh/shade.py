"""The light of mesh faces that rays meet."""

import numpy as np
from numpy.typing import NDArray

from catalog.geometry.kernel import kernel
from catalog.photometry.hapke import HapkeParameters, reflectance_scalar
from catalog.terrain.mesh.rays import outward

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
Values = NDArray[np.float32]


@kernel
def facing_the_sun(
    corners: FloatArray, faces: IntArray, origin: FloatArray, rays: FloatArray,
    distances: FloatArray, sun: FloatArray, lift: float, numbers: NDArray[np.int64],
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
    corners: FloatArray, faces: IntArray, rays: FloatArray, lit: NDArray[np.int64],
    sun: FloatArray, surface: HapkeParameters, out: Values,
) -> None:  # fmt: skip
    """Put Hapke's radiance factor of the faces that lit rays meet into out (n)."""
    for n in lit:
        x, y, z = outward(corners, faces[n])
        length = np.sqrt(x * x + y * y + z * z)
        mu0 = (x * sun[0] + y * sun[1] + z * sun[2]) / length
        mu = -(x * rays[n, 0] + y * rays[n, 1] + z * rays[n, 2]) / length
        cos_g = -(rays[n, 0] * sun[0] + rays[n, 1] * sun[1] + rays[n, 2] * sun[2])
        out[n] = reflectance_scalar(mu0, mu, cos_g, surface)
