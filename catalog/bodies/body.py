"""The constants of a body, read from configs/bodies/NAME.toml or a file like these."""

import os
import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.config import Turn, load_toml, nearest_name, resource
from catalog.errors import ConfigError
from catalog.photometry.sets import (
    BodyPhotometry,
    PhotometricSet,
    PhotometrySettings,
    load_sets,
)

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

SunTheory = Literal[
    "moon", "earth", "mercury", "venus", "mars", "jupiter", "saturn", "uranus", "neptune"
]
# W of a body that turns in minutes grows by 1e6 deg a day, an angle of its orbit by 1e8 a century
Term = Annotated[float, msgspec.Meta(ge=-1e10, le=1e10)]
Arcsec = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
ErrorM = Annotated[float, msgspec.Meta(ge=0.0, le=1e7)]
Size = Annotated[float, msgspec.Meta(ge=1e-3, le=1e6)]  # km: from a boulder to the Sun
Naif = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]
Coefficient = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]  # of gravity
Offset = Annotated[float, msgspec.Meta(ge=-1e7, le=1e7)]  # m
Height = Annotated[float, msgspec.Meta(ge=-1e7, le=1e7)]  # km
Year = Annotated[float, msgspec.Meta(ge=-10_000.0, le=20_000.0)]
Polynomial = tuple[Term, Term, Term]
Axes = tuple[Arcsec, Arcsec, Arcsec]
J2000_YEAR = 2000.0
JULIAN_YEAR_S = 365.25 * 86400.0
NAME = re.compile(r"[^\W_][\w .'()-]{0,79}")  # no path: a body's file is looked for by name
MAX_RATIO = 20.0  # of a semi-axis to the radius, either way; the longest asteroids have 5


class RotationTerm(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One trigonometric term of a rotation series.

    angle_deg_by_century  the argument E, a polynomial in Julian centuries of TDB
    ra_deg, meridian_deg  amplitudes of sin E;  dec_deg  amplitude of cos E
    """

    angle_deg_by_century: Polynomial
    ra_deg: Turn = 0.0
    dec_deg: Turn = 0.0
    meridian_deg: Turn = 0.0


class CorrectionTerm(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One trigonometric term of a correction: small turns about body x, y, z.

    angle_deg_by_century  the argument, a polynomial in Julian centuries of TDB
    sin_arcsec, cos_arcsec  amplitudes of its sine and cosine about the three axes
    """

    angle_deg_by_century: Polynomial
    sin_arcsec: Axes
    cos_arcsec: Axes


class RotationCorrection(msgspec.Struct, frozen=True, forbid_unknown_fields=True, cache_hash=True):
    """A fitted correction to a published rotation series: a small rotation after it, in body axes.

    years                        first and last Julian year of the fit; beyond them it is not used
    x_, y_, z_arcsec_by_century  polynomials of the three angles
    error_m                      rms a body axis of what remains, as a shift of the surface
    """

    years: tuple[Year, Year]
    error_m: ErrorM
    x_arcsec_by_century: Polynomial
    y_arcsec_by_century: Polynomial
    z_arcsec_by_century: Polynomial
    terms: tuple[CorrectionTerm, ...]

    def is_valid_at(self, tdb_s: float) -> bool:
        """Return whether a time, TDB s past J2000, lies in the years of the fit."""
        return self.years[0] <= J2000_YEAR + tdb_s / JULIAN_YEAR_S <= self.years[1]


class RotationSeries(msgspec.Struct, frozen=True, forbid_unknown_fields=True, cache_hash=True):
    """Pole and prime meridian as the IAU working group writes them.

    Polynomials from J2000 TDB: right ascension and declination of the pole in degrees by powers of
    Julian centuries, the prime meridian W by powers of days.
    error_m is the mean size of its known error at the surface; 0 where none is stated.
    theory  "iau2006": the Earth's precession and nutation instead, by which the polynomials serve
            for rates alone
    """

    pole_ra_deg_by_century: Polynomial
    pole_dec_deg_by_century: Polynomial
    meridian_deg_by_day: Polynomial
    error_m: ErrorM = 0.0
    terms: tuple[RotationTerm, ...] = ()
    theory: Literal["series", "iau2006"] = "series"


class GravityField(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Lists the largest terms of a body's gravity beside the point mass, in its body frame.

    j2, c22, s22  unnormalised, for radius_km, as are the zonal terms j3 to j6
    kaula         the terms left out: degree n from 3 on has normalised coefficients of about
                  kaula / n^2 (Kaula's rule); None for the Earth's, scaled by the gravity
    """

    j2: Coefficient
    c22: Coefficient = 0.0
    s22: Coefficient = 0.0
    j3: Coefficient = 0.0
    j4: Coefficient = 0.0
    j5: Coefficient = 0.0
    j6: Coefficient = 0.0
    radius_km: Size
    kaula: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None = None

    @property
    def zonals(self) -> tuple[float, ...]:
        """The zonal terms j2 to j6."""
        return self.j2, self.j3, self.j4, self.j5, self.j6


class LockedOrbit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The orbit of a moon that always turns one side to its planet, see `locked_orbit`.

    around               the planet, which stands over the prime meridian in the mean
    semi_major_axis_km   of the orbit about it;  eccentricity as well
    mean_anomaly_deg_by_century  a polynomial in Julian centuries of TDB; the rotation's terms of
                         the same argument are the forced libration
    tide_error           share of the planet's tide that is in error, its flattening included
    """

    around: SunTheory
    semi_major_axis_km: Annotated[float, msgspec.Meta(ge=1.0, le=1e9)]
    eccentricity: Annotated[float, msgspec.Meta(ge=0.0, le=0.9)]
    mean_anomaly_deg_by_century: Polynomial
    tide_error: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class SunOrbit(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The orbit of a small body about the Sun: osculating elements, ecliptic and equinox of J2000.

    epoch_jd  Julian date of the elements, TDB
    years     first and last Julian year in which the Kepler orbit serves; beyond them planets have
              moved the body too far from it
    """

    epoch_jd: Annotated[float, msgspec.Meta(ge=0.0, le=1e7)]
    years: tuple[Year, Year]
    semi_major_axis_au: Annotated[float, msgspec.Meta(ge=0.01, le=1e4)]
    eccentricity: Annotated[float, msgspec.Meta(ge=0.0, le=0.99)]
    inclination_deg: Turn
    node_deg: Turn
    perihelion_deg: Turn
    mean_anomaly_deg: Turn

    def is_valid_at(self, tdb_s: float) -> bool:
        """Whether a time, TDB s past J2000, lies in the years of the elements."""
        return self.years[0] <= J2000_YEAR + tdb_s / JULIAN_YEAR_S <= self.years[1]


class SpiceNames(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The names of a body in SPICE kernels.

    naif           its numbers; the first whose orbit the kernels have is taken
    sun_seen_from  the same for the Sun's direction, where other bodies serve as well
    frame          the body-fixed frame; None for the one that the kernels tie to the body
    frame_error_m  error of that frame as a shift of the surface, 1 sigma a body axis; None for the
                   error of the rotation series
    """

    naif: tuple[Naif, ...]
    sun_seen_from: tuple[Naif, ...] = ()
    frame: str | None = None
    frame_error_m: ErrorM | None = None


class Atmosphere(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The refracting air of a body: refractivity n - 1 at height 0, and its scale height."""

    refractivity: Annotated[float, msgspec.Meta(ge=0.0, le=0.01)]
    scale_height_m: Annotated[float, msgspec.Meta(ge=1.0, le=1e6)]


class CatalogFrame(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where catalogs and terrain models lie in the body frame that positions are stated in.

    A place is stated at scale * (turned by turn_deg) + offset_m of where the catalog has it: as
    `optnav adjust` finds from pictures whose positions and attitudes are stated.

    turn_deg  rotation vector, body frame
    """

    turn_deg: tuple[Turn, Turn, Turn] = (0.0, 0.0, 0.0)
    offset_m: tuple[Offset, Offset, Offset] = (0.0, 0.0, 0.0)
    scale: Annotated[float, msgspec.Meta(ge=0.5, le=2.0)] = 1.0

    @property
    def stated_from_catalog(self) -> "Rotation":
        """The rotation alone."""
        # here, because what only reads a catalog's head would wait half of its time for scipy
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(np.radians(self.turn_deg))

    @property
    def is_same(self) -> bool:
        """Whether both frames are one."""
        return self == THE_SAME_FRAME

    def transform_to_stated(self, places_m: FloatArray) -> FloatArray:
        """Transform places (..., 3) from the catalog's frame to the stated one."""
        if self.is_same:
            return places_m
        placed: FloatArray = self.scale * self.rotate_to_stated(places_m) + np.array(self.offset_m)
        return placed

    def transform_to_catalog(self, places_m: FloatArray) -> FloatArray:
        """Transform places (..., 3) from the stated frame to the catalog's."""
        if self.is_same:
            return places_m
        placed: FloatArray = self.rotate_to_catalog(places_m - np.array(self.offset_m)) / self.scale
        return placed

    def rotate_to_stated(self, vectors: FloatArray) -> FloatArray:
        """Rotate vectors (..., 3) from the catalog's frame to the stated one."""
        return vectors if self.is_same else vectors @ self.stated_from_catalog.as_matrix().T

    def rotate_to_catalog(self, vectors: FloatArray) -> FloatArray:
        """Rotate vectors (..., 3) from the stated frame to the catalog's."""
        return vectors if self.is_same else vectors @ self.stated_from_catalog.as_matrix()

    def transform_covariance_to_stated(self, covariance_m2: FloatArray) -> FloatArray:
        """Transform the covariance (3, 3) of a place from the catalog's frame to the stated one."""
        turned = self.rotate_to_stated(self.rotate_to_stated(covariance_m2).T)
        return turned * self.scale**2

    def transform_covariance_to_catalog(self, covariance_m2: FloatArray) -> FloatArray:
        """Transform the covariance (3, 3) of a place from the stated frame to the catalog's."""
        turned = self.rotate_to_catalog(self.rotate_to_catalog(covariance_m2).T)
        return turned / self.scale**2


THE_SAME_FRAME = CatalogFrame()


class BodyFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A body file as it is written."""

    name: str
    radius_km: Size
    radii_km: tuple[Size, Size, Size]
    gm_km3_s2: Annotated[float, msgspec.Meta(ge=1e-15, le=1e12)]
    plausible_heights_km: tuple[Height, Height]
    sun: SunTheory | SunOrbit
    rotation: RotationSeries
    rotation_correction: RotationCorrection | None = None
    gravity: GravityField | None = None
    orbit: LockedOrbit | None = None
    spice: SpiceNames | None = None
    catalog_frame: CatalogFrame = THE_SAME_FRAME
    atmosphere: Atmosphere | None = None
    photometry: BodyPhotometry | None = None


@dataclass(frozen=True)
class Body:
    """A body and its body-fixed frame.

    radius_m             the reference sphere that all heights are measured from
    radii_m              (3,) semi-axes of the best ellipsoid along body x, y, z
    gm_m3_s2             gravitational parameter
    plausible_heights_m  (lowest, highest) a height above the reference sphere may be; beyond it a
                         terrain model has the wrong units or the wrong body
    rotation             how the body-fixed frame turns, as published
    sun                  which analytic theory gives the Sun's direction, see `bodies.ephemeris`,
                         or the body's own orbit
    rotation_correction  what a fit to better data adds to the rotation, where there is one
    gravity              its field beside the point mass; None where the file has none
    orbit                about its planet, for a moon whose planet no theory here gives otherwise
    spice                its names in SPICE kernels; None where the file states none
    catalog_frame        where its catalogs lie in the frame that positions are stated in
    atmosphere           of bodies whose air bends light
    photometric_sets     Hapke's parameters of its ground, the one in use first; empty: those that
                         ship for its name, see `photometry`
    """

    name: str
    radius_m: float
    radii_m: tuple[float, float, float]
    gm_m3_s2: float
    plausible_heights_m: tuple[float, float]
    rotation: RotationSeries
    sun: SunTheory | SunOrbit
    rotation_correction: RotationCorrection | None = None
    gravity: GravityField | None = None
    orbit: LockedOrbit | None = None
    spice: SpiceNames | None = None
    catalog_frame: CatalogFrame = THE_SAME_FRAME
    atmosphere: Atmosphere | None = None
    photometric_sets: tuple[PhotometricSet, ...] = ()

    @property
    def photometry(self) -> PhotometricSet:
        """The set of Hapke's parameters in use; the Moon's for a body of which none is known."""
        return (self.photometric_sets or load_sets(self.name))[0]

    def choose_photometry(self, settings: PhotometrySettings) -> "Body":
        """The body with the set that settings ask for. Raises ConfigError for an unknown one."""
        known = self.photometric_sets or load_sets(self.name)
        if settings == PhotometrySettings():
            return self
        chosen = settings.choose(known, self.name)
        return replace(self, photometric_sets=(chosen, *(s for s in known if s != chosen)))

    def describe_missing_photometry(self) -> str | None:
        """Say that the Moon's set stands in, and how to state one; None where the body has one."""
        if self.photometry.body == self.name:
            return None
        return (
            f"no photometric set is known of the {self.name}: its ground is drawn as the Moon's, "
            f"{self.photometry.describe()}; state [photometry.sets.NAME] and default in its body "
            "file, as configs/photometry has them"
        )

    @property
    def flattening(self) -> float:
        """(a - c) / a of a spheroid; 0 of a sphere, and of bodies without geodetic latitudes.

        Those have three semi-axes, or two equal ones that are not along x and y.
        """
        a, b, c = self.radii_m
        return (a - c) / a if a == b else 0.0

    def rotation_error_m(self, tdb_s: float) -> float:
        """Error of the rotation as a shift of the surface, 1 sigma a body axis; 0: not stated.

        tdb_s  TDB seconds past J2000
        """
        fit = self.rotation_correction
        return (fit if fit is not None and fit.is_valid_at(tdb_s) else self.rotation).error_m


def load_body(name_or_path: str, beside: Path | None = None) -> Body:
    """A body of configs/bodies by its name, or the body that a TOML file describes.

    name_or_path  a path where it holds a separator or ends in ".toml"
    beside        the folder that a relative path starts from; without it the working folder

    Raises ConfigError for a name without a file, naming the nearest one, and for a wrong file.
    """
    if is_body_file(name_or_path):
        return read_body((beside or Path()) / name_or_path)
    return _load_shipped_body(name_or_path)


@cache
def _load_shipped_body(name: str) -> Body:
    """Read once: a file takes milliseconds, and all that comes near a body asks for it."""
    folder = resource("configs/bodies/moon.toml").parent
    known = sorted(path.stem for path in folder.glob("*.toml"))
    if name not in known:
        near = nearest_name(name.lower(), known)
        hint = f"did you mean '{near}'?" if near else f"there are {', '.join(known)}"
        raise ConfigError(f"no body '{name}'; {hint}, or give the path of a body's file")
    return read_body(folder / f"{name}.toml")


def is_body_file(name_or_path: str) -> bool:
    """Whether `load_body` takes this for the path of a file."""
    return name_or_path.endswith(".toml") or "/" in name_or_path or os.sep in name_or_path


def read_body(path: Path) -> Body:
    """The body a file describes. Raises ConfigError when the file is not a valid body."""
    settings = load_toml(path, BodyFile)
    lowest_km, highest_km = settings.plausible_heights_km
    radius_km = settings.radius_km
    if not NAME.fullmatch(settings.name):
        raise ConfigError(f"{path}: name is {settings.name[:80]!r}; wanted a plain name")
    if not all(1.0 / MAX_RATIO <= axis / radius_km <= MAX_RATIO for axis in settings.radii_km):
        raise ConfigError(
            f"{path}: radii_km is {list(settings.radii_km)}; wanted semi-axes about radius_km, "
            f"{radius_km:g}, at most {MAX_RATIO:g} times larger or smaller"
        )
    if not -radius_km < lowest_km < highest_km <= MAX_RATIO * radius_km:
        raise ConfigError(
            f"{path}: plausible_heights_km is [{lowest_km}, {highest_km}]; "
            "wanted [lowest, highest], the lowest above the body's centre"
        )
    if isinstance(settings.sun, SunOrbit) and settings.sun.years[0] >= settings.sun.years[1]:
        years = list(settings.sun.years)
        raise ConfigError(f"{path}: [sun] years is {years}; wanted the first and the last year")
    x_km, y_km, z_km = settings.radii_km
    return Body(
        name=settings.name,
        radius_m=settings.radius_km * 1e3,
        radii_m=(x_km * 1e3, y_km * 1e3, z_km * 1e3),
        gm_m3_s2=settings.gm_km3_s2 * 1e9,
        plausible_heights_m=(lowest_km * 1e3, highest_km * 1e3),
        rotation=settings.rotation,
        sun=settings.sun,
        rotation_correction=settings.rotation_correction,
        gravity=settings.gravity,
        orbit=settings.orbit,
        spice=settings.spice,
        catalog_frame=settings.catalog_frame,
        atmosphere=settings.atmosphere,
        photometric_sets=()
        if settings.photometry is None
        else settings.photometry.name_sets(settings.name, str(path)),
    )
