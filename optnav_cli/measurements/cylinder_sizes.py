"""Sizes of what the model of a lit cylinder leaves out, from configs/models/cylinder.toml."""

import math
from functools import cache
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from catalog.arrays import FloatArray
from catalog.config import load_toml, resource

FILE = "configs/models/cylinder.toml"
GRAZING_DEG, GRAZING_SPAN_DEG = 90.0, 47.0  # from where on light grazes, and to where sizes are of
CRESCENT_DEG, CRESCENT_SPAN_DEG = 145.0, 10.0  # from where on a few pixels are lit, and hardly so
Share = Annotated[float, Meta(ge=0.0, le=0.1)]
Size = Annotated[float, Meta(ge=0.0, le=100.0)]


class CylinderErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fitted numbers of FILE, which says what each is."""

    theta_deg: Size
    theta_grazing_deg: Size
    distance_share: Share
    distance_grazing_share: Share
    distance_crescent_share: Share
    theta_crescent_deg: Size
    alike_deg: Annotated[float, Meta(gt=0.0, le=360.0)]

    def likeness(self, thetas: FloatArray) -> FloatArray:
        """(n, n) correlation of these errors of one cloth at angles of the light (n,), rad."""
        apart = np.degrees(np.abs(thetas[:, None] - thetas))
        found: FloatArray = np.exp(-np.minimum(apart, 360.0 - apart) / self.alike_deg)
        return found

    def variances(self, theta: float, distance_m: float) -> tuple[float, float]:
        """Of the distance, m², and of theta, rad², at an angle of the light, rad."""
        grazing = grazing_of(theta)
        share = self.distance_share**2 + (self.distance_grazing_share * grazing) ** 2
        thin = max(math.degrees(abs(theta)) - CRESCENT_DEG, 0.0) / CRESCENT_SPAN_DEG
        share += (self.distance_crescent_share * thin) ** 2
        degrees = self.theta_deg**2 + (self.theta_grazing_deg * grazing) ** 2
        degrees += (self.theta_crescent_deg * thin) ** 2
        return share * distance_m**2, degrees * math.radians(1.0) ** 2


def grazing_of(theta: float) -> float:
    """How much light grazes what is seen: 0 up to 90 deg, 1 at 137 deg."""
    return max(math.degrees(abs(theta)) - GRAZING_DEG, 0.0) / GRAZING_SPAN_DEG


@cache
def cylinder_sizes() -> CylinderErrorSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), CylinderErrorSizes)
