"""How free a patch is of shadows from terrain outside it."""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray


def shadowed_share(limits_deg: ArrayLike, suns_local: FloatArray) -> float:
    """Share of the Suns whose elevation is below the skyline limit of their azimuth.

    limits_deg  (k,)    limit by azimuth, bins centred on 0, 360/k, ... degrees east of north
    suns_local  (n, 3)  unit vectors east, north, up
    """
    limits = np.asarray(limits_deg, dtype=np.float64)
    suns = np.asarray(suns_local, dtype=np.float64).reshape(-1, 3)
    azimuth = np.degrees(np.arctan2(suns[:, 0], suns[:, 1]))
    bins = np.rint(azimuth / (360.0 / limits.size)).astype(np.int64) % limits.size
    elevation = np.degrees(np.arcsin(np.clip(suns[:, 2], -1.0, 1.0)))
    return float((elevation < limits[bins]).mean())
