"""[forces]: what moves a craft about a body, as a TOML file says it."""

from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import ConfigError, DataError

MAX_DEGREE = 180  # numbers of a degree-180 field below 10 m over a body keep 1e-12
SmallAcceleration = Annotated[float, Meta(ge=-100.0, le=100.0)]  # m/s^2: 10 g
Degrees = Annotated[int, Meta(ge=2, le=MAX_DEGREE)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Direction = Annotated[float, Meta(ge=0.0, le=90.0)]


class SunlightSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """[forces.sunlight]: pressure of sunlight on a sphere, with the shadow of the bodies.

    area_over_mass_m2_kg  lit area over mass
    reflectivity          1: all light is absorbed, 2: all is thrown back
    """

    area_over_mass_m2_kg: Annotated[float, Meta(ge=0.0, le=1e3)] = 0.01
    reflectivity: Annotated[float, Meta(ge=0.0, le=4.0)] = 1.3

    @property
    def strength_m2_kg(self) -> float:
        """The product: what the pressure of sunlight is multiplied by."""
        return self.area_over_mass_m2_kg * self.reflectivity


class ThrustArc(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """[[forces.thrust]]: an acceleration that is constant along R, N, B from one time to another.

    acceleration_m_s2    along R (up), N (forward), B (across), see the terms
    size_sigma           1 sigma of its size, as a share of it
    direction_sigma_deg  1 sigma of its direction, each of two angles
    """

    start_utc: str
    end_utc: str
    acceleration_m_s2: tuple[SmallAcceleration, SmallAcceleration, SmallAcceleration]
    size_sigma: Share = 0.01
    direction_sigma_deg: Direction = 0.5

    @property
    def times_s(self) -> tuple[float, float]:
        """Start and end, TDB s."""
        start = utc_to_tdb_s(self.start_utc, "start_utc")
        return start, utc_to_tdb_s(self.end_utc, "end_utc")

    @property
    def covariance(self) -> FloatArray:
        """Covariance (3, 3) of the acceleration along R, N, B, m^2/s^4."""
        thrust = np.array(self.acceleration_m_s2)
        along = np.outer(thrust, thrust)
        across = float(thrust @ thrust) * np.eye(3) - along
        turned = np.radians(self.direction_sigma_deg) ** 2
        covariance: FloatArray = self.size_sigma**2 * along + turned * across
        return covariance


class ForcesSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """[forces].

    degree       of the gravity field; left out: 50 for the Moon, 2 elsewhere, all of a named field.
                 2 without `field`: the terms of the body's file
    field        a gravity field: SHADR (.tab, .txt, .sha), ICGEM (.gfc) or .cof, beside this file;
                 left out: GLGM-3 for the Moon, the terms of the body's file elsewhere
    field_frame  axes that the field is stated in: the body frame, or the Moon's principal axes
    field_error  1 sigma of its coefficients above degree 20, as a share of their size by Kaula's
                 rule, where the field states no errors
    sunlight     its pressure; left out: none
    thrust       arcs of thrust
    """

    degree: Degrees | None = None
    field: str | None = None
    field_frame: Literal["body", "principal_axes"] = "body"
    field_error: Share = 0.1
    sunlight: SunlightSettings | None = None
    thrust: tuple[ThrustArc, ...] = ()

    def check(self) -> None:
        """Raise ConfigError for arcs of thrust that end before they begin, or at no time."""
        for number, arc in enumerate(self.thrust, start=1):
            try:
                start, end = arc.times_s
            except DataError as error:
                raise ConfigError(f"[[forces.thrust]] number {number}: {error}") from None
            if not start < end:
                raise ConfigError(
                    f"[[forces.thrust]] number {number} ends at {arc.end_utc}, not after its "
                    f"start {arc.start_utc}; exchange them"
                )
