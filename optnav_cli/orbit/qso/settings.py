"""Settings of quasi-satellite orbits, the starts and motion they mean, and a mesh's gravity."""

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, load_body
from catalog.bodies.ephemeris import CENTURY_S, compute_mean_anomaly
from catalog.bodies.epochs import DAY_S, utc_to_tdb_s
from catalog.config import Turn, load_toml, resolve_config
from catalog.errors import ConfigError, DataError
from catalog.terrain.mesh.file import MeshSettings
from catalog.terrain.mesh.shape import Shape, load_shape
from optnav_cli.dynamics.gravity_field import HarmonicField
from optnav_cli.dynamics.left_out import warn_of_unknown_gravity
from optnav_cli.orbit.qso.motion import MoonMotion

# Rule of degree 5 on a triangle: Strang and Fix, "An Analysis of the Finite Element Method", 1973.
_ROOT = np.sqrt(15.0)
_NEAR, _FAR = (6.0 - _ROOT) / 21.0, (6.0 + _ROOT) / 21.0
_RULE = [(1.0 / 3.0, 1.0 / 3.0, 9.0 / 40.0)]
QSO_KIND = "qso"  # of the output folder
QSO_CSV, PASSES_CSV, PATHS_CSV = "qso.csv", "passes.csv", "paths.csv"
FOLDER = "orbits"  # of configs/
MAX_STARTS = 10_000

Distance = Annotated[float, msgspec.Meta(ge=0.1, le=1e5)]
Days = Annotated[float, msgspec.Meta(ge=0.5, le=60.0)]
Step = Annotated[float, msgspec.Meta(ge=1.0, le=DAY_S)]
Degree = Annotated[int, msgspec.Meta(ge=2, le=20)]
BUNDLED_MESH = MeshSettings(path="bundled:phobos_thomas.tab", units="km", longitude="west")


for _a, _w in ((_NEAR, (155.0 - _ROOT) / 1200.0), (_FAR, (155.0 + _ROOT) / 1200.0)):
    _RULE += [(_a, _a, _w), (1.0 - 2.0 * _a, _a, _w), (_a, 1.0 - 2.0 * _a, _w)]


def mesh_field(shape: Shape, radius_m: float, degree: int) -> HarmonicField:
    """Coefficients of degrees 2 to `degree` for a radius.

    Degrees 0 and 1 are 0: the point mass stands apart, and a body's ephemeris is that of its centre
    of mass, whatever its figure's centre is.
    """
    corners = shape.vertices[shape.faces] / radius_m
    a, b, c = (corners[:, k] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    size = degree + 1
    sums = np.zeros((2, size, size))
    for u, v, weight in _RULE:
        points = (1.0 - u - v) * a + u * b + v * c
        sums += weight * np.einsum("knmi,i->knm", _solid(points, size), volume)
    cosines, sines = np.zeros((size, size)), np.zeros((size, size))
    for n in range(2, size):
        for m in range(n + 1):
            share = (2.0 if m else 1.0) * math.factorial(n - m) / math.factorial(n + m)
            scale = math.sqrt(share / (2.0 * n + 1.0)) * 3.0 / (n + 3.0) / float(volume.sum())
            cosines[n, m], sines[n, m] = scale * sums[:, n, m]
    return HarmonicField(radius_m, cosines, sines, None, "mesh of even density")


def _solid(points: FloatArray, size: int) -> FloatArray:
    """r^n P_nm(sin lat) times cos and sin of m lon (2, n, m, i) at points (i, 3)."""
    x, y, z = points.T
    squared = x * x + y * y + z * z
    harmonics = np.zeros((2, size, size, len(points)))
    harmonics[0, 0, 0] = 1.0
    for m in range(size):
        if m:
            c, s = harmonics[:, m - 1, m - 1]
            harmonics[:, m, m] = (2 * m - 1) * np.stack([x * c - y * s, x * s + y * c])
        for n in range(m + 1, size):
            harmonics[:, n, m] = (2 * n - 1) * z * harmonics[:, n - 1, m] / (n - m)
            if n > m + 1:
                harmonics[:, n, m] -= (n + m - 1) * squared * harmonics[:, n - 2, m] / (n - m)
    return harmonics


class MoonForces(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [forces] section.

    field   of the moon: a point mass, J2 and C22 of its body file, or its mesh at even density
    degree  of the mesh's field
    planet_flattening  whether the planet has its J2
    """

    field: Literal["point", "body", "mesh"] = "body"
    degree: Degree = 8
    planet_flattening: bool = True
    mesh: MeshSettings = BUNDLED_MESH


class QsoSection(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The [qso] section; see configs/templates/qso.toml."""

    time: str | tuple[str, ...]
    distance_km: Distance | tuple[Distance, ...]
    body: str = "phobos"
    longitude_deg: Turn = 90.0
    anomaly_deg: tuple[Turn, ...] = ()
    days: Days = 5.0
    start: Literal["greatest", "middle"] = "greatest"
    velocity: Literal["free", "perpendicular"] = "free"
    step_s: Step = 600.0


class QsoSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The whole file."""

    qso: QsoSection
    forces: MoonForces = MoonForces()


def load_qso_settings(path: Path) -> QsoSettings:
    """Settings of a file, or of one that ships ("bundled:NAME"). Raises ConfigError."""
    settings = load_toml(resolve_config(path, FOLDER), QsoSettings)
    starts = len(distances_of(settings.qso)) * max(len(settings.qso.anomaly_deg), 1)
    starts *= len(times_of(settings.qso))
    if not 0 < starts <= MAX_STARTS:
        raise ConfigError(
            f"{path}: [qso] asks for {starts} orbits; give distances and times for 1 to "
            f"{MAX_STARTS}"
        )
    for time in times_of(settings.qso):
        try:
            utc_to_tdb_s(time, "time")
        except DataError as error:
            raise ConfigError(f"{path}: [qso] {error}") from None
    return settings


def distances_of(section: QsoSection) -> tuple[float, ...]:
    """The distances from the surface, km."""
    given = section.distance_km
    return given if isinstance(given, tuple) else (given,)


def times_of(section: QsoSection) -> tuple[str, ...]:
    """The times, UTC."""
    return (section.time,) if isinstance(section.time, str) else section.time


def motion_of_moon(forces: MoonForces, moon: Body, beside: Path) -> MoonMotion:
    """The motion beside a moon; the mesh's path is relative to the folder `beside`."""
    field: HarmonicField | Literal["point", "body"]
    if forces.field == "mesh":
        shape = load_shape(forces.mesh, beside, moon)
        field = mesh_field(shape, moon.radius_m, forces.degree)
    else:
        field = forces.field
        warn_of_unknown_gravity(moon)
    return MoonMotion(moon, forces.planet_flattening, field)


def moon_of(name: str, path: Path) -> Body:
    """A body by name or file beside the settings. Raises ConfigError."""
    try:
        return load_body(name, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def start_times(section: QsoSection, motion: MoonMotion) -> FloatArray:
    """TDB s of the starts: the times, or after each the first at which the anomaly is reached."""
    orbit, turn = motion.orbit, 2.0 * np.pi
    rate = np.radians(orbit.mean_anomaly_deg_by_century[1]) / CENTURY_S
    epochs_s = []
    for time in times_of(section):
        tdb_s = utc_to_tdb_s(time)
        if not section.anomaly_deg:
            epochs_s.append(tdb_s)
        for anomaly in np.radians(section.anomaly_deg):
            now = float(compute_mean_anomaly(orbit, tdb_s)) % turn
            epochs_s.append(tdb_s + (anomaly - now) % turn / rate)
    return np.array(epochs_s)
