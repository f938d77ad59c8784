"""What a user sets about quasi-satellite orbits, and the starts and the motion that it means."""

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
from catalog.terrain.mesh.shape import load_shape
from optnav_cli.dynamics.gravity_field import HarmonicField
from optnav_cli.dynamics.left_out import warn_of_unknown_gravity
from optnav_cli.orbit.qso.field import mesh_field
from optnav_cli.orbit.qso.motion import MoonMotion

QSO_KIND = "qso"  # of the output folder
QSO_CSV, PASSES_CSV, PATHS_CSV = "qso.csv", "passes.csv", "paths.csv"
FOLDER = "orbits"  # of configs/
MAX_STARTS = 10_000

Distance = Annotated[float, msgspec.Meta(ge=0.1, le=1e5)]
Days = Annotated[float, msgspec.Meta(ge=0.5, le=60.0)]
Step = Annotated[float, msgspec.Meta(ge=1.0, le=DAY_S)]
Degree = Annotated[int, msgspec.Meta(ge=2, le=20)]
BUNDLED_MESH = MeshSettings(path="bundled:phobos_thomas.tab", units="km", longitude="west")


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
