"""[cylinder] of a scenario: a lit cylinder and the craft about it, held still or in a circle."""

import math
from typing import Annotated, Self

import msgspec
import numpy as np
from msgspec import Meta

from catalog.arrays import FloatArray
from catalog.bodies.ephemeris import Ephemeris
from catalog.config import Count, Seconds
from catalog.errors import ConfigError
from optnav_cli.simulation.cylinder_picture import SurfaceSettings
from optnav_cli.simulation.exposure import Epoch
from optnav_cli.simulation.scenario_base import ScenarioBase

Length = Annotated[float, Meta(gt=0.0, le=1e4)]
Angle = Annotated[float, Meta(ge=-180.0, le=180.0)]


class CylinderSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The cylinder, and where the craft is.

    distance_m      of the craft from the axis at the start
    theta_deg       angle of the light from the craft at the start;  theta_rate_deg_s  its rate: 0
                    is a craft that is held still
    bearing_deg     of the axis from the camera's boresight
    sway_m, sway_deg, sway_s  how far a craft drifts about the path, and the period
    """

    radius_m: Length
    height_m: Length
    distance_m: Length
    theta_deg: Angle
    theta_rate_deg_s: Annotated[float, Meta(ge=-90.0, le=90.0)] = 0.0
    bearing_deg: Annotated[float, Meta(ge=-60.0, le=60.0)] = 0.0
    sway_m: Annotated[float, Meta(ge=0.0, le=100.0)] = 0.0
    sway_deg: Annotated[float, Meta(ge=0.0, le=90.0)] = 0.0
    sway_s: Annotated[float, Meta(gt=0.0, le=1e6)] = 60.0
    pictures: Count = 10
    spacing_s: Seconds = 2.0
    start_utc: str = "2026-01-01T00:00:00Z"
    surface: SurfaceSettings = SurfaceSettings()


class CylinderScenario(ScenarioBase, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A cylinder on a table, with [camera], [sensor] and `seed` of any scenario."""

    cylinder: CylinderSettings
    dem: tuple[()] = ()

    def check(self) -> None:
        super().check()
        section = self.cylinder
        if section.distance_m - section.sway_m < 1.2 * section.radius_m:
            raise ConfigError(
                f"[cylinder] distance_m is {section.distance_m:g} and radius_m "
                f"{section.radius_m:g}; wanted a craft outside the cylinder"
            )
        if self.beside:
            raise ConfigError("[cylinder] is seen by one camera; leave out [[beside]]")

    def shortened(self, frames: int) -> Self:
        fewer = min(frames, self.cylinder.pictures)
        return msgspec.structs.replace(
            self, cylinder=msgspec.structs.replace(self.cylinder, pictures=fewer)
        )

    def epochs(self, motion: Ephemeris) -> list[Epoch]:
        return []  # no body is flown over; see `states`

    def states(self) -> FloatArray:
        """Seconds, distance m, theta rad and velocity m/s along x, y (n, 5).

        x points towards the light, y to where theta grows.
        """
        section = self.cylinder
        seconds = np.arange(section.pictures) * section.spacing_s
        pace = 2.0 * math.pi / section.sway_s
        distance = section.distance_m + section.sway_m * np.sin(pace * seconds)
        closing = section.sway_m * pace * np.cos(pace * seconds)
        swing = math.radians(section.sway_deg)
        theta = np.radians(section.theta_deg + section.theta_rate_deg_s * seconds)
        theta = theta + swing * np.sin(1.3 * pace * seconds)
        rate = math.radians(section.theta_rate_deg_s) + 1.3 * pace * swing * np.cos(
            1.3 * pace * seconds
        )
        vx = closing * np.cos(theta) - distance * rate * np.sin(theta)
        vy = closing * np.sin(theta) + distance * rate * np.cos(theta)
        theta = (theta + math.pi) % (2.0 * math.pi) - math.pi
        return np.stack([seconds, distance, theta, vx, vy], axis=1)
