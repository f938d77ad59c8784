"""The rotation of a body and the places of its neighbours, by analytic theory or by SPICE kernels.

A run's log names the source that it used.

Analytic, without files: rotation by the series of configs/bodies with its fitted correction, the
Sun and the Earth by SOFA, small bodies by the Kepler orbit of their file. SPICE: the rotation of
the frame that configs/bodies states, else of the one that the kernels tie to the body; positions of
the SPK kernels. Where no SPK kernel is named (orientation kernels reach further than most orbits),
Sun and places stay analytic. The Earth's rotation takes UT1 and polar motion from an IERS table
that is named in place of kernels.

Directions to the Sun are apparent ones (light time and stellar aberration), as pictures show it.
Positions are geometric ones at the very time, as forces and orbits need them.
"""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Literal

import erfa
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, LockedOrbit, SunOrbit, SunTheory, load_body
from catalog.bodies.coverage import intersect_spans
from catalog.bodies.epochs import DAY_S, J2000_JD, utc_from_tdb_s
from catalog.bodies.kernels import KernelSet
from catalog.bodies.rotation import (
    EarthOrientation,
    body_from_inertial,
    estimate_earth_error_m,
    is_earth_orientation,
    read_earth_orientation,
    rotate_earth,
)
from catalog.errors import DataError
from catalog.geometry.vectors import unit

CENTURY_S = 36525.0 * DAY_S


def compute_mean_anomaly(orbit: LockedOrbit, tdb_s: ArrayLike) -> FloatArray:
    """Compute the mean anomaly of a moon, rad, not reduced to one turn, at times (...)."""
    century = np.asarray(tdb_s, dtype=np.float64) / CENTURY_S
    argument = np.array(orbit.mean_anomaly_deg_by_century)
    mean: FloatArray = np.radians(np.polynomial.polynomial.polyval(century, argument))
    return mean


def compute_planet_position(body: Body, orbit: LockedOrbit, tdb_s: ArrayLike) -> FloatArray:
    """Positions (..., 3) of the planet's centre from the moon's, body frame, m, at times (...)."""
    mean, e = compute_mean_anomaly(orbit, tdb_s), orbit.eccentricity
    argument = orbit.mean_anomaly_deg_by_century
    swing = sum(t.meridian_deg for t in body.rotation.terms if t.angle_deg_by_century == argument)
    centre = 2.0 * e * np.sin(mean) + 1.25 * e**2 * np.sin(2.0 * mean)
    longitude = centre - np.radians(swing) * np.sin(mean)
    # r/a of the ellipse, to the square of e as well
    share = 1.0 - e * np.cos(mean) + 0.5 * e**2 * (1.0 - np.cos(2.0 * mean))
    distance = 1e3 * orbit.semi_major_axis_km * share
    axes = np.stack([np.cos(longitude), np.sin(longitude), np.zeros_like(longitude)], axis=-1)
    position: FloatArray = distance[..., None] * axes
    return position


LIGHT_AU_PER_DAY = 173.1446326846693  # c * 86400 s / 149597870700 m
AU_M = 149597870700.0
# Numbers of SOFA's plan94.
PLANETS = {
    "mercury": 1,
    "venus": 2,
    "mars": 4,
    "jupiter": 5,
    "saturn": 6,
    "uranus": 7,
    "neptune": 8,
}


# Gauss' constant and the obliquity of J2000 (IAU 1976), which JPL's elements are stated with.
GAUSS_PER_DAY = 0.01720209895
KEPLER_STEPS = 20  # far more than any eccentricity up to 0.99 needs
OBLIQUITY = np.radians(84381.448 / 3600.0)


def compute_sun_direction_inertial(body: Body, tdb_s: float) -> FloatArray:
    """Unit vector (3,) to the apparent Sun, inertial axes, as seen from the body's centre.

    Raises DataError beyond the years of a small body's orbit.
    """
    from_sun, velocity = _compute_heliocentric_state(body, tdb_s)
    direction = -unit(from_sun)
    return unit(direction + velocity / LIGHT_AU_PER_DAY)


def compute_velocity_inertial(body: Body, tdb_s: float) -> FloatArray:
    """Velocity (3,) of a body's centre about the Sun, m/s, inertial axes: what aberration is from.

    The Sun's own motion, 15 m/s, is 0.01". Raises DataError beyond a small body's orbit.
    """
    return np.asarray(_compute_heliocentric_state(body, tdb_s)[1] * (AU_M / DAY_S))


def _compute_heliocentric_state(body: Body, tdb_s: float) -> tuple[FloatArray, FloatArray]:
    """Position of a body from the Sun, AU, and velocity, AU/day."""
    if not isinstance(body.sun, SunOrbit):
        return _compute_planet_state(body.sun, tdb_s / DAY_S)
    if not body.sun.is_valid_at(tdb_s):
        first, last = body.sun.years
        raise DataError(
            f"{body.name}: the orbit in its body file serves from {first:g} to {last:g}, not at "
            f"{utc_from_tdb_s(tdb_s, 0)}; give the Sun's direction or SPICE kernels"
        )
    return _propagate_kepler(body.sun, tdb_s / DAY_S)


def solve_kepler_equation(mean: ArrayLike, eccentricity: float) -> FloatArray:
    """Kepler's equation solved by Newton's steps for mean anomalies (...), rad."""
    wanted = np.asarray(mean, dtype=np.float64)
    # from here the steps converge
    anomaly = wanted.copy() if eccentricity < 0.8 else np.full_like(wanted, np.pi)
    for _ in range(KEPLER_STEPS):
        wrong = anomaly - eccentricity * np.sin(anomaly) - wanted
        anomaly -= wrong / (1.0 - eccentricity * np.cos(anomaly))
    return anomaly


def _propagate_kepler(orbit: SunOrbit, day: float) -> tuple[FloatArray, FloatArray]:
    """Position, AU, and velocity, AU/day, on an orbit about the Sun, `day` days after J2000."""
    a, e = orbit.semi_major_axis_au, orbit.eccentricity
    rate = GAUSS_PER_DAY / a**1.5
    mean = np.radians(orbit.mean_anomaly_deg) + rate * (day + J2000_JD - orbit.epoch_jd)
    mean = float(np.remainder(mean, 2.0 * np.pi))
    anomaly = float(solve_kepler_equation(mean, e))
    cosine, sine, flat = np.cos(anomaly), np.sin(anomaly), np.sqrt(1.0 - e * e)
    angles = [orbit.perihelion_deg, orbit.inclination_deg, orbit.node_deg]
    ecliptic_from_orbit = Rotation.from_euler("zxz", angles, degrees=True)
    inertial_from_orbit = Rotation.from_euler("x", OBLIQUITY) * ecliptic_from_orbit
    in_plane = np.array([[cosine - e, flat * sine, 0.0], [-sine, flat * cosine, 0.0]]) * a
    in_plane[1] *= rate / (1.0 - e * cosine)
    position, velocity = inertial_from_orbit.apply(in_plane)
    return position, velocity


def _compute_planet_state(of: str, day: float) -> tuple[FloatArray, FloatArray]:
    """Position from the Sun, AU, and velocity, AU/day, `day` days after J2000."""
    with warnings.catch_warnings():
        # Outside 1900-2100 the theories warn; they stay far better than needed.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        if of in PLANETS:
            return _unpack_state(erfa.plan94(J2000_JD, day, PLANETS[of]))
        # The Sun's own barycentric velocity, 15 m/s, changes the aberration by 0.01".
        heliocentric, _ = erfa.epv00(J2000_JD, day)
    position, velocity = _unpack_state(heliocentric)
    if of == "moon":
        moon_position, moon_velocity = _compute_moon_state(day)
        return position + moon_position, velocity + moon_velocity
    return position, velocity


def _compute_moon_state(day: float) -> tuple[FloatArray, FloatArray]:
    """Position of the Moon from the Earth, AU, and velocity, AU/day."""
    return _unpack_state(erfa.moon98(J2000_JD, day))


def _unpack_state(pv: object) -> tuple[FloatArray, FloatArray]:
    record = np.asarray(pv)
    return np.array(record["p"], dtype=np.float64), np.array(record["v"], dtype=np.float64)


Neighbour = Literal["sun"] | SunTheory

SUN_GM_M3_S2 = 1.3271244004127942e20  # NAIF gm_de440.tpc, BODY10_GM

SUN_NAIF = (10,)
# Kernels and series must agree to this, or the kernels are of something else. The widest honest
# difference is that of the Earth's series, which leaves nutation and UT1 out.
_AGREEMENT = np.radians(0.5)


class Ephemeris(ABC):
    """Rotation of a body and the directions and places of its neighbours; times are TDB s."""

    body: Body
    name: str  # the source, for a log

    @abstractmethod
    def error_m(self, tdb_s: float) -> float:
        """Error of the rotation as a shift of the surface, 1 sigma a body axis, m."""

    @abstractmethod
    def body_from_inertial(self, tdb_s: float) -> FloatArray:
        """Rotation (3, 3) taking inertial (ICRF) vectors to the body-fixed frame of catalogs."""

    @abstractmethod
    def sun_inertial(self, tdb_s: float) -> FloatArray:
        """Unit vector (3,) to the apparent Sun from the body's centre, inertial axes."""

    @abstractmethod
    def position_m(self, of: Neighbour, tdb_s: float) -> FloatArray:
        """Geometric position (3,) of a neighbour's centre from the body's, inertial, m."""

    def sun_body(self, tdb_s: float) -> FloatArray:
        """Unit vector (3,) to the apparent Sun from the body's centre, body frame."""
        return self.body_from_inertial(tdb_s) @ self.sun_inertial(tdb_s)

    def _rotate_to_catalog(self, body_from_inertial: FloatArray) -> FloatArray:
        """The rotation to the body frame that catalogs are in, of that to the stated one."""
        return self.body.catalog_frame.rotate_to_catalog(body_from_inertial.T).T


class AnalyticEphemeris(Ephemeris):
    """Analytic theories: SOFA and the rotation series of the body's file."""

    def __init__(self, body: Body, orientation: EarthOrientation | None = None) -> None:
        """Take the Earth's UT1 and polar motion from a table; None: none of either."""
        self.body, self._orientation = body, orientation
        self.name = "analytic theory (SOFA, rotation series)"
        if orientation is not None:
            self.name = f"analytic theory (SOFA, IAU 2006/2000A) and {orientation.name}"
        elif body.rotation.theory == "iau2006":
            self.name = (
                "analytic theory (SOFA, IAU 2006/2000A without UT1 and polar motion: off by "
                f"{body.rotation.error_m:.0f} m rms and up to 420 m at the equator; name an IERS "
                "table in [spice] kernels)"
            )

    def error_m(self, tdb_s: float) -> float:
        if self._orientation is not None:
            return estimate_earth_error_m(tdb_s, self._orientation)
        return self.body.rotation_error_m(tdb_s)

    def body_from_inertial(self, tdb_s: float) -> FloatArray:
        """Raises DataError, with the dates of the IERS table, for a time outside it."""
        if self._orientation is not None:
            return self._rotate_to_catalog(rotate_earth(tdb_s, self._orientation))
        return self._rotate_to_catalog(body_from_inertial(self.body, tdb_s))

    def sun_inertial(self, tdb_s: float) -> FloatArray:
        return compute_sun_direction_inertial(self.body, tdb_s)

    def position_m(self, of: Neighbour, tdb_s: float) -> FloatArray:
        """For Phobos all but Mars are seen from Mars, 9400 km off.

        Raises DataError for a pair without a theory here: a body and itself, or a moon's planet
        where the moon's file has no [orbit].
        """
        body, day = self.body, tdb_s / DAY_S
        if body.orbit is not None and of == body.orbit.around:
            return body_from_inertial(body, tdb_s).T @ compute_planet_position(
                body, body.orbit, tdb_s
            )
        if of == body.name or of == body.sun:
            raise DataError(
                f"there is no theory here of {of} as seen from {body.name}; "
                "name SPICE kernels that have it"
            )
        if {of, body.sun} == {"earth", "moon"}:
            # the pair itself: the Sun's distance would cost digits
            return (1.0 if of == "moon" else -1.0) * _compute_moon_state(day)[0] * AU_M
        seen_from = _compute_heliocentric_state(body, tdb_s)[0]
        there = np.zeros(3) if of == "sun" else _compute_planet_state(of, day)[0]
        return (there - seen_from) * AU_M


class SpiceEphemeris(Ephemeris):
    """SPICE kernels. Every time is a call of the toolkit (some 20 microseconds)."""

    def __init__(self, body: Body, kernels: Sequence[Path]) -> None:
        """Raises DataError for kernels that are missing, damaged, incomplete or of another body."""
        self.body = body
        self._analytic = AnalyticEphemeris(body)
        self._kernels = KernelSet(kernels)
        self._orbits = bool(self._kernels.orbits)
        self._has_sun = any(map(self._kernels.has_orbit, SUN_NAIF))
        sun_source = "" if self._has_sun else "; the Sun by analytic theory (SOFA)"
        self.name = f"SPICE kernels ({self._kernels.names}){sun_source}"
        if body.spice is None:
            raise DataError(
                f"{body.name}: its body file has no [spice] naif; add it, or leave [spice] out"
            )
        self._names = body.spice
        self._frame = self._names.frame or self._kernels.find_body_frame(body.name)
        self._check()

    def error_m(self, tdb_s: float) -> float:
        stated = self._names.frame_error_m
        return self.body.rotation_error_m(tdb_s) if stated is None else stated

    def body_from_inertial(self, tdb_s: float) -> FloatArray:
        """Raises DataError, with the span the kernels cover, for a time outside it."""
        return self._rotate_to_catalog(self._kernels.rotation(self._frame, tdb_s))

    def sun_inertial(self, tdb_s: float) -> FloatArray:
        """Raises DataError, with the span the kernels cover, for a time outside it."""
        if not self._has_sun:  # none, or those of a craft alone
            return self._analytic.sun_inertial(tdb_s)
        of, centre = self._find_sun_and_viewer()
        return unit(self._kernels.position_m(of, centre, tdb_s, apparent=True))

    def position_m(self, of: Neighbour, tdb_s: float) -> FloatArray:
        """Raises DataError for a time or body that the kernels do not cover."""
        orbit = self.body.orbit
        lacking = not any(self._kernels.has_orbit(number) for number in self._names.naif)
        if (lacking and orbit is not None and of == orbit.around) or not self._orbits:
            return self._analytic.position_m(of, tdb_s)
        centre = self._find_number(self.body.name, self._names.naif)
        there = self._find_number(of, find_naif_numbers(of))
        return self._kernels.position_m(there, centre, tdb_s, apparent=False)

    def _find_sun_and_viewer(self) -> tuple[int, int]:
        """NAIF numbers of the Sun and of the body that it is seen from."""
        viewer = self._names.sun_seen_from or self._names.naif
        return self._find_number("sun", SUN_NAIF), self._find_number(self.body.name, viewer)

    def _find_number(self, name: str, numbers: Sequence[int]) -> int:
        for number in numbers:
            if self._kernels.has_orbit(number):
                return number
        wanted = " or ".join(str(number) for number in numbers)
        raise DataError(
            f"{self.name}: none has the orbit of {name} (NAIF number {wanted}); "
            "add the SPK kernel (.bsp) that has it"
        )

    def _check(self) -> None:
        """Compare with the analytic theory once, in the middle of what the kernels cover."""
        if not self._kernels.has_frame(self._frame):
            raise DataError(
                f"{self.name}: none defines the frame {self._frame}; add its frame kernel (.tf), "
                "such as moon_080317.tf, and the orientation kernel (.bpc) that goes with it"
            )
        middle = 0.0  # J2000, for constants that hold at all times
        if self._has_sun:
            sun, centre = self._find_sun_and_viewer()
            middle = _find_middle(self._kernels.find_orbit_span((sun, centre)), middle)
            orbit = self.body.sun
            if not isinstance(orbit, SunOrbit) or orbit.is_valid_at(middle):
                ours, theirs = (m.sun_inertial(middle) for m in (self._analytic, self))
                self._compare(float(np.linalg.norm(ours - theirs)), "the Sun", middle)
        middle = _find_middle(intersect_spans(self._kernels.turns.values()), middle)
        ours, theirs = (m.body_from_inertial(middle) for m in (self._analytic, self))
        # a rotation by a small angle differs from none by sqrt(2) of it
        apart = float(np.linalg.norm(ours @ theirs.T - np.eye(3)) / np.sqrt(2.0))
        self._compare(apart, f"the frame {self._frame}", middle)

    def _compare(self, apart: float, what: str, tdb_s: float) -> None:
        if not apart < _AGREEMENT:
            raise DataError(
                f"{self.name}: {what} is {np.degrees(apart):.3g} deg "
                f"from the analytic theory of {self.body.name} at {utc_from_tdb_s(tdb_s, 0)}; "
                "wanted the kernels of this body, with ICRF axes"
            )


@lru_cache
def find_naif_numbers(name: str) -> tuple[int, ...]:
    """NAIF numbers of the Sun or of a body of configs/bodies."""
    if name == "sun":
        return SUN_NAIF
    spice = load_body(name).spice
    return () if spice is None else spice.naif


def load_ephemeris(body: Body, kernels: Sequence[Path]) -> Ephemeris:
    """Use the kernels, or the Earth's IERS table, where any are named, else theory.

    Raises DataError as SpiceEphemeris does, and for a table of another body or beside kernels.
    """
    tables = [path for path in kernels if is_earth_orientation(path)]
    if not tables:
        return SpiceEphemeris(body, kernels) if kernels else AnalyticEphemeris(body)
    if body.rotation.theory != "iau2006":
        raise DataError(
            f"{tables[0]}: is no SPICE kernel, and tables of the IERS are for the Earth, not for "
            f"{body.name}; correct [spice] kernels"
        )
    if len(kernels) > 1:
        raise DataError(
            f"{tables[0]}: stands beside other files in [spice] kernels; name the IERS table "
            "alone, or the kernels without it"
        )
    return AnalyticEphemeris(body, read_earth_orientation(tables[0]))


def _find_middle(span: tuple[float, float] | None, otherwise: float) -> float:
    return otherwise if span is None else 0.5 * (span[0] + span[1])
