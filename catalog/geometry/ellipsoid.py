"""A triaxial ellipsoid: its normals, the foot of a point on it; geodetic places of a spheroid.

Source of the foot: D. Eberly, Distance from a Point to an Ellipse, an Ellipsoid, or a
Hyperellipsoid (Geometric Tools, 2013): the root of one decreasing convex function, to which Newton
comes from the left without ever stepping over it.
"""

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.latlon import latlon_from_xyz

MAX_STEPS = 100
CLOSE = 1e-15  # relative step of the root: nothing is left to gain
MIN_GEODETIC = 0.5  # of the semi-axes from the centre: deeper inside normals may cross


def compute_normals(surface: ArrayLike, radii: ArrayLike) -> FloatArray:
    """Outward unit normals (..., 3) at points (..., 3) of an ellipsoid of semi-axes (3,)."""
    gradient = np.asarray(surface, dtype=np.float64) / np.square(np.asarray(radii, np.float64))
    normals: FloatArray = gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)
    return normals


def project_to_surface(directions: ArrayLike, radii: ArrayLike) -> FloatArray:
    """Points (..., 3) where directions (..., 3) from the centre pierce an ellipsoid."""
    directions = np.asarray(directions, dtype=np.float64)
    scaled = np.linalg.norm(directions / np.asarray(radii, dtype=np.float64), axis=-1)
    surface: FloatArray = directions / scaled[..., None]
    return surface


def measure_height_above(points: ArrayLike, up: ArrayLike, radii: ArrayLike) -> FloatArray:
    """Measure (...) from points (..., 3) along a unit vector (3,) to an ellipsoid's near side.

    NaN where the line along the vector misses the ellipsoid.
    """
    radii = np.asarray(radii, dtype=np.float64)
    start, way = np.asarray(points, np.float64) / radii, np.asarray(up, np.float64) / radii
    a, b = way @ way, start @ way
    under = b * b - a * ((start * start).sum(axis=-1) - 1.0)
    with np.errstate(invalid="ignore"):
        return np.asarray((np.sqrt(under) - b) / a)


def find_foot(points: ArrayLike, radii: ArrayLike) -> FloatArray:
    """The nearest points (..., 3) of an ellipsoid: where its normal goes through `points`.

    points (..., 3), radii (3,) semi-axes, same unit. Raises ValueError for the centre and points so
    deep inside that more than one normal goes through them and none is nearest.
    """
    points = np.asarray(points, dtype=np.float64)
    squares = np.square(np.asarray(radii, dtype=np.float64))
    # sum (a_i x_i / (t + a_i^2))^2 = 1; each term alone is 1 left of the root or at it
    scaled = np.abs(points) * np.sqrt(squares)
    t = np.asarray(np.max(scaled - squares, axis=-1))
    if np.any(t <= -squares.min()):
        raise ValueError("a point on an ellipsoid's axes of symmetry, inside, has no one foot")
    for _ in range(MAX_STEPS):
        below = t[..., None] + squares
        terms = np.square(scaled / below)
        step = (terms.sum(axis=-1) - 1.0) / (2.0 * (terms / below).sum(axis=-1))
        t = t + step
        if np.all(np.abs(step) <= CLOSE * squares.max()):
            break
    foot: FloatArray = points * squares / (t[..., None] + squares)
    return foot


def geodetic_from_xyz(
    points: ArrayLike, radii: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Find geodetic coordinates over an ellipsoid of revolution.

    points (..., 3), body frame; radii (3,) semi-axes along x, y, z, the first two equal, same unit

    Returns latitude and east longitude in [-pi, pi), rad, and height above the ellipsoid, each
    (...); NaN for points nearer to the centre than half of the ellipsoid. PROJ's forward
    transformation gives the points back to 0.01 mm.
    """
    points, radii = np.asarray(points, np.float64), np.asarray(radii, np.float64)
    deep = np.linalg.norm(points / radii, axis=-1) < MIN_GEODETIC
    placed = np.where(deep[..., None], radii * (1.0, 0.0, 0.0), points)
    foot = find_foot(placed, radii)
    normal = compute_normals(foot, radii)
    lat, lon, _ = latlon_from_xyz(normal)
    height = ((placed - foot) * normal).sum(axis=-1)
    nothing = np.where(deep, np.nan, 0.0)
    return lat + nothing, lon + nothing, height + nothing


def distance_to_sphere(origin: ArrayLike, directions: ArrayLike, radius: float) -> FloatArray:
    """Distance along unit rays to their first crossing of a sphere, NaN where they miss it.

    origin (3,), directions (..., 3) unit vectors, same frame and unit; returns (...).
    A crossing behind the origin counts as a miss.
    """
    origin = np.asarray(origin, dtype=np.float64)
    along = np.asarray(directions, dtype=np.float64) @ origin
    # (|o|-r)(|o|+r) keeps its digits when the origin is near the sphere
    length = float(np.linalg.norm(origin))
    discriminant = along * along - (length - radius) * (length + radius)
    with np.errstate(invalid="ignore"):
        distance = -along - np.sqrt(discriminant)
    return np.where(distance > 0.0, distance, np.nan)
