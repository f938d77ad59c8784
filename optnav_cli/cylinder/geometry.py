"""A lit upright cylinder seen from the height of its strip: geometry, formulas, sizes of errors.

Source: Ivanov, Ovchinnikov, Trofimov, KIAM preprint 2010-5, section 3; symbols in comments are its.
The camera is level. Angles are measured about the cylinder's axis: `psi` of a point of the surface
and `theta` of the light, both from the direction to the camera, positive to the right of the
picture. A bearing is an angle at the camera, from the boresight, positive to the right.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.config import load_toml, resource
from catalog.errors import NoSolutionError

FILE = "configs/models/cylinder.toml"
GRAZING_DEG, GRAZING_SPAN_DEG = 90.0, 47.0  # from where on light grazes, and to where sizes are of
CRESCENT_DEG, CRESCENT_SPAN_DEG = 145.0, 10.0  # from where on a few pixels are lit, and hardly so
Share = Annotated[float, Meta(ge=0.0, le=0.1)]
Size = Annotated[float, Meta(ge=0.0, le=100.0)]


@dataclass(frozen=True)
class CylinderSize:
    """Radius of a cylinder and height of the strip of it that is seen, m."""

    radius_m: float
    height_m: float


def compute_half_width(radius_m: float, distance_m: float) -> float:
    """Compute half the angle under which a cylinder is seen whose axis is at a distance, rad."""
    return math.asin(radius_m / distance_m)


def compute_bearing(psi: ArrayLike, radius_m: float, distance_m: float) -> FloatArray:
    """Compute bearings (n,) of points of the surface from the axis, rad, for angles psi (n,)."""
    psi = np.asarray(psi, np.float64)
    bearing: FloatArray = np.arctan2(radius_m * np.sin(psi), distance_m - radius_m * np.cos(psi))
    return bearing


def compute_psi(bearing: ArrayLike, radius_m: float, distance_m: float) -> FloatArray:
    """Compute angles psi (n,) of the surface points seen at bearings (n,) from the axis, rad.

    Beyond the limb those of the limb.
    """
    bearing = np.asarray(bearing, np.float64)
    sine = np.clip(distance_m / radius_m * np.sin(bearing), -1.0, 1.0)
    psi: FloatArray = np.arcsin(sine) - bearing
    return psi


def compute_surface_distance(psi: ArrayLike, radius_m: float, distance_m: float) -> FloatArray:
    """Compute horizontal distances (n,) from the camera to points of the surface, m."""
    cosine = np.cos(np.asarray(psi, np.float64))
    square = distance_m**2 + radius_m**2 - 2.0 * distance_m * radius_m * cosine
    return np.sqrt(square)


def find_lit_edges(theta: float, radius_m: float, distance_m: float) -> tuple[float, float]:
    """Find the bearings from the axis between which the seen surface is lit, rad, left one first.

    One of them is the terminator unless the whole face is lit, |theta| <= `compute_half_width`.
    """
    limb = compute_half_width(radius_m, distance_m)
    terminator = abs(theta) - 0.5 * math.pi
    if terminator <= limb - 0.5 * math.pi:
        return -limb, limb
    edge = float(compute_bearing(min(terminator, 0.5 * math.pi - limb), radius_m, distance_m))
    return (edge, limb) if theta >= 0.0 else (-limb, -edge)


def solve_printed_formulas(
    lit_height: float, lit_width: float, size: CylinderSize
) -> tuple[float, float]:
    """Solve formulas (5) and (6) as printed for the distance d to the surface, m, and theta, rad.

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


class CylinderErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sizes of errors left out of the model of the fit; FILE says what each is."""

    theta_deg: Size
    theta_grazing_deg: Size
    distance_share: Share
    distance_grazing_share: Share
    distance_crescent_share: Share
    theta_crescent_deg: Size

    def compute_variances(self, theta: float, distance_m: float) -> tuple[float, float]:
        """Compute variances of distance, m², and theta, rad², at an angle of the light, rad."""
        grazing = compute_grazing(theta)
        share = self.distance_share**2 + (self.distance_grazing_share * grazing) ** 2
        thin = max(math.degrees(abs(theta)) - CRESCENT_DEG, 0.0) / CRESCENT_SPAN_DEG
        share += (self.distance_crescent_share * thin) ** 2
        degrees = self.theta_deg**2 + (self.theta_grazing_deg * grazing) ** 2
        degrees += (self.theta_crescent_deg * thin) ** 2
        return share * distance_m**2, degrees * math.radians(1.0) ** 2


def compute_grazing(theta: float) -> float:
    """Compute how much light grazes what is seen: 0 up to 90 deg, 1 at 137 deg."""
    return max(math.degrees(abs(theta)) - GRAZING_DEG, 0.0) / GRAZING_SPAN_DEG


@cache
def load_error_sizes() -> CylinderErrorSizes:
    """Load the sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), CylinderErrorSizes)


@dataclass(frozen=True)
class IdealLens:
    """A pinhole lens: focal lengths and principal point, px."""

    focal_x_px: float
    focal_y_px: float
    centre_x_px: float
    centre_y_px: float
