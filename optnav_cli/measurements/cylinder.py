"""A lit upright cylinder seen from the height of its strip: geometry, and the source's formulas.

Source: Ivanov, Ovchinnikov, Trofimov, KIAM preprint 2010-5, section 3; symbols in comments are its.
The camera is level. Angles are measured about the cylinder's axis: `psi` of a point of the surface
and `theta` of the light, both from the direction to the camera, positive to the right of the
picture. A bearing is an angle at the camera, from the boresight, positive to the right.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.errors import NoSolutionError


@dataclass(frozen=True)
class CylinderSize:
    """Radius of a cylinder and height of the strip of it that is seen, m."""

    radius_m: float
    height_m: float


def half_width(radius_m: float, distance_m: float) -> float:
    """Half the angle under which a cylinder is seen whose axis is at a distance, rad."""
    return math.asin(radius_m / distance_m)


def bearing_of(psi: ArrayLike, radius_m: float, distance_m: float) -> FloatArray:
    """Bearings (n,) of points of the surface from the axis, rad, for angles psi (n,)."""
    psi = np.asarray(psi, np.float64)
    found: FloatArray = np.arctan2(radius_m * np.sin(psi), distance_m - radius_m * np.cos(psi))
    return found


def psi_of(bearing: ArrayLike, radius_m: float, distance_m: float) -> FloatArray:
    """Angles psi (n,) of the points of the surface seen at bearings (n,) from the axis, rad.

    Beyond the limb those of the limb.
    """
    bearing = np.asarray(bearing, np.float64)
    sine = np.clip(distance_m / radius_m * np.sin(bearing), -1.0, 1.0)
    found: FloatArray = np.arcsin(sine) - bearing
    return found


def surface_distance(psi: ArrayLike, radius_m: float, distance_m: float) -> FloatArray:
    """Horizontal distances (n,) from the camera to points of the surface, m."""
    cosine = np.cos(np.asarray(psi, np.float64))
    square = distance_m**2 + radius_m**2 - 2.0 * distance_m * radius_m * cosine
    return np.sqrt(square)


def lit_edges(theta: float, radius_m: float, distance_m: float) -> tuple[float, float]:
    """The bearings from the axis between which the seen surface is lit, rad, left one first.

    One of them is the terminator unless the whole face is lit, |theta| <= `half_width`.
    """
    limb = half_width(radius_m, distance_m)
    terminator = abs(theta) - 0.5 * math.pi
    if terminator <= limb - 0.5 * math.pi:
        return -limb, limb
    edge = float(bearing_of(min(terminator, 0.5 * math.pi - limb), radius_m, distance_m))
    return (edge, limb) if theta >= 0.0 else (-limb, -edge)


def seed_distance_and_angle(
    lit_height: float, lit_width: float, size: CylinderSize
) -> tuple[float, float]:
    """The distance d to the surface, m, and theta, rad, by formulas (5) and (6) as printed.

    lit_height, lit_width  angles of the lit area, rad: phi_h and phi_w

    The last term of (6) takes the parallel projection of the terminator at the distance d: of a
    cylinder that is lit over its full face, seen from 1.34 m with a radius of 0.14 m, the formula
    gives 31 deg. Raises NoSolutionError where its arc cosine has no value.
    """
    distance = size.height_m / lit_height
    cosine = 1.0 - distance * lit_width / size.radius_m
    if not -1.0 <= cosine <= 1.0:
        raise NoSolutionError(
            f"formula (6) has no angle: the lit area is {distance * lit_width:.3f} m wide at the "
            f"distance of {distance:.3f} m, and the cylinder {2.0 * size.radius_m:.3f} m"
        )
    limb = math.asin(size.radius_m / (size.radius_m + distance))
    return distance, math.pi - limb - math.acos(cosine)
