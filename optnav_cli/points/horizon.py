"""Which places lie beyond the horizon of a body that is no sphere and has relief.

Divided by its semi-axes the body's ellipsoid is the unit sphere. Relief hides and shows points: the
sphere that may stand in the line of sight lies below the lowest of the points by half of what they
differ in height. So a crest beyond the ellipsoid's horizon is seen over the ground between.
"""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, FloatArray

ROOM = 0.5  # of the points' difference in height: ground between them lies lower than the lowest
MIN_BLOCKING = 0.1  # of the semi-axes: points with more relief than that tell no horizon


def is_hidden(position_m: ArrayLike, places_m: FloatArray, radii_m: ArrayLike) -> BoolArray:
    """Find the places that a camera could see through the ground only.

    position_m  (3,) of the camera, m, body frame
    places_m    (n, 3) of the points, m, body frame, at least one
    radii_m     (3,) semi-axes of the body's ellipsoid, m

    Returns (n,).
    """
    radii = np.asarray(radii_m, dtype=np.float64)
    eye, points = np.asarray(position_m, np.float64) / radii, places_m / radii
    heights = np.linalg.norm(points, axis=1)
    lowest = heights.min()
    blocking = max(lowest - ROOM * (heights.max() - lowest), MIN_BLOCKING)
    # the nearest the line of sight, from the point to the camera, comes to the centre
    sights = eye - points
    lengths = np.einsum("ni,ni->n", sights, sights)
    along = -np.einsum("ni,ni->n", sights, points) / np.maximum(lengths, np.finfo(float).tiny)
    nearest = points + np.clip(along, 0.0, 1.0)[:, None] * sights
    hidden: BoolArray = np.linalg.norm(nearest, axis=1) < blocking * (1.0 - 1e-12)
    return hidden
