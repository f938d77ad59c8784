"""run.toml of a picture folder: its body, the meaning of its quaternions, its cameras' mounts."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, CatalogFrame, is_body_file, load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import load_toml
from catalog.errors import ConfigError
from catalog.geometry.rotations import ARCSEC, rotation_from_quaternion
from optnav_cli.camera.camera_file import is_plain_name

MIN_BASE_M = 1e-3  # less cannot be measured on a ship
UNIT_TOLERANCE = 1e-3  # of a quaternion's length
Metres = Annotated[float, Meta(ge=-1e4, le=1e4)]
Share = Annotated[float, Meta(ge=-1.001, le=1.001)]
MountError = Annotated[float, Meta(ge=0.0, le=36_000.0)]  # arcsec: 10 deg
RUN_TOML = "run.toml"
MAX_ROUND = 1e-3  # flattening up to which [points] need not be stated
Attitude = Literal["camera_from_body", "camera_from_inertial"]


class MountSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One [[mount]] as it is written.

    camera            its name, that of a file in cameras/
    position_m        of its centre in the ship's frame
    ship_from_camera  unit quaternion, scalar first
    error_arcsec      of the mounting, 1 sigma an axis: the same in all pictures
    """

    camera: str
    position_m: tuple[Metres, Metres, Metres]
    ship_from_camera: tuple[Share, Share, Share, Share] = (1.0, 0.0, 0.0, 0.0)
    error_arcsec: MountError = 0.0

    @property
    def place_m(self) -> FloatArray:
        """(3,) of the camera in the ship's frame, m."""
        return np.array(self.position_m)

    @property
    def turn(self) -> Rotation:
        """ship_from_camera."""
        return rotation_from_quaternion(*self.ship_from_camera)

    @property
    def error_rad(self) -> float:
        """1 sigma an axis, rad."""
        return self.error_arcsec * ARCSEC

    def format_toml(self) -> str:
        """The section as run.toml has it."""
        return (
            f'\n[[mount]]\ncamera = "{self.camera}"\n'
            f"position_m = [{', '.join(repr(float(v)) for v in self.position_m)}]\n"
            f"ship_from_camera = [{', '.join(repr(float(v)) for v in self.ship_from_camera)}]\n"
            f"error_arcsec = {float(self.error_arcsec)!r}\n"
        )


def check_mounts(mounts: Sequence[MountSettings]) -> None:
    """Raise ConfigError for a camera that is mounted twice, or a quaternion that is none."""
    seen: set[str] = set()
    for mount in mounts:
        if mount.camera in seen:
            raise ConfigError(f"[[mount]] has the camera '{mount.camera}' twice; keep one section")
        seen.add(mount.camera)
        if not is_plain_name(mount.camera):
            raise ConfigError(f"[[mount]] names the camera '{mount.camera}'; wanted a plain word")
        length = float(np.linalg.norm(mount.ship_from_camera))
        if abs(length - 1.0) > UNIT_TOLERANCE:
            raise ConfigError(
                f"[[mount]] of '{mount.camera}': ship_from_camera has a length of {length:.6g}; "
                "wanted a unit quaternion, scalar first"
            )


def select_stereo_pair(mounts: Sequence[MountSettings]) -> tuple[MountSettings, MountSettings]:
    """The two mounts of a stereo pair. Raises ConfigError for others, or without a base."""
    if len(mounts) != 2:
        raise ConfigError(
            f"run.toml has {len(mounts)} [[mount]] sections; wanted two, one for each camera of "
            "the pair"
        )
    first, second = mounts
    base_m = float(np.linalg.norm(first.place_m - second.place_m))
    if base_m < MIN_BASE_M:
        raise ConfigError(
            f"[[mount]]: '{first.camera}' and '{second.camera}' stand {1e3 * base_m:g} mm apart; "
            "a height needs a base: correct position_m"
        )
    return first, second


class SpiceSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """SPICE kernels for the body's rotation and its Sun; none: analytic theory."""

    kernels: tuple[str, ...] = ()


class InertialSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[inertial]: frames.csv is one inertial track, whose errors are common to its rows; 1 sigma.

    position_sigma_m         at the start, a component
    velocity_sigma_m_s       a constant error, a component
    acceleration_sigma_m_s2  white noise, per root second, a component
    attitude_sigma_arcsec    bias, an axis of the camera
    attitude_drift_arcsec_s  its growth, an axis
    attitude_noise_arcsec    fresh in each frame, an axis
    """

    position_sigma_m: Annotated[float, Meta(ge=0.0, le=1e6)] = 300.0
    velocity_sigma_m_s: Annotated[float, Meta(ge=0.0, le=1e4)] = 0.8
    acceleration_sigma_m_s2: Annotated[float, Meta(ge=0.0, le=1e3)] = 0.0
    attitude_sigma_arcsec: Annotated[float, Meta(ge=0.0, le=36_000.0)] = 12.0
    attitude_drift_arcsec_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 0.08
    attitude_noise_arcsec: Annotated[float, Meta(ge=0.0, le=36_000.0)] = 3.0

    def compute_row_sigmas(self, seconds: float) -> tuple[float, float]:
        """1 sigma of a row so long after the start: position, m, and attitude, rad, an axis."""
        wander = self.acceleration_sigma_m_s2 * np.sqrt(seconds**3 / 3.0)
        position = self.position_sigma_m, self.velocity_sigma_m_s * seconds, wander
        drift = self.attitude_drift_arcsec_s * seconds
        attitude = self.attitude_sigma_arcsec, drift, self.attitude_noise_arcsec
        return float(np.linalg.norm(position)), float(np.linalg.norm(attitude)) * ARCSEC


class AltimeterSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[altimeter]: the beam that range_m of frames.csv is measured along.

    beam  unit vector, frame of the row's camera; the boresight unless stated
    """

    beam: tuple[Share, Share, Share] = (0.0, 0.0, 1.0)

    @property
    def direction(self) -> FloatArray:
        """(3,) unit vector of the beam, camera frame."""
        beam = np.array(self.beam)
        direction: FloatArray = beam / float(np.linalg.norm(beam))
        return direction

    def check(self) -> None:
        """Raise ConfigError for a beam that is no unit vector or points back."""
        length = float(np.linalg.norm(self.beam))
        if abs(length - 1.0) > UNIT_TOLERANCE or self.beam[2] <= 0.0:
            raise ConfigError(
                f"[altimeter] beam is {list(self.beam)} with a length of {length:.6g}; wanted a "
                "unit vector in the camera's frame with z, along the boresight, over 0"
            )


LatitudeKind = Literal["planetocentric", "geodetic"]
HeightKind = Literal["sphere", "ellipsoid"]


class PointsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Meaning of the coordinates in points.csv.

    latitude  from the body's centre, or of the normal of its ellipsoid, as on maps of the Earth
    height    above the body's sphere, or above its ellipsoid
    """

    latitude: LatitudeKind = "planetocentric"
    height: HeightKind = "sphere"


class PointsSection(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """[points]: the settings of points.csv as far as run.toml states them."""

    latitude: LatitudeKind | msgspec.UnsetType = msgspec.UNSET
    height: HeightKind | msgspec.UnsetType = msgspec.UNSET

    @property
    def filled(self) -> PointsSettings:
        """The settings, with the default of what is not stated."""
        return PointsSettings(**msgspec.to_builtins(self))

    def check(self, body: Body) -> None:
        """Raise ConfigError where the body's shape asks for what is not stated, or forbids it."""
        a, b, _ = body.radii_m
        if self.latitude == "geodetic" and a != b:
            radii = ", ".join(f"{axis / 1e3:g}" for axis in body.radii_m)
            raise ConfigError(
                f'[points] latitude is "geodetic", but the {body.name} has the radii {radii} km; '
                'geodetic latitudes are those of a spheroid: write latitude = "planetocentric", '
                "or state a body file whose first two radii are equal"
            )
        missing = [name for name in ("latitude", "height") if name not in msgspec.to_builtins(self)]
        if missing and abs(body.flattening) > MAX_ROUND:
            off_km = max(np.ptp(body.radii_m), np.abs(np.array(body.radii_m) - body.radius_m).max())
            raise ConfigError(
                f"[points] does not state {' and '.join(missing)}; the {body.name} is flattened by "
                f"1/{1.0 / body.flattening:.0f}, and read wrongly points lie up to "
                f'{off_km / 1e3:.2g} km off: write [points] with latitude = "geodetic" or '
                '"planetocentric" and height = "ellipsoid" or "sphere"'
            )


class RunSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """run.toml.

    body      a name of configs/bodies, or the path of a body file, from the folder of run.toml
    attitude  which rotation the quaternions of the folder's tables are
    inertial  what the one inertial track of frames.csv is wrong by; unset: each row by itself
    mount     where cameras stand in the ship, for stereo
    points    what the coordinates of points.csv are
    altimeter  along which beam frames.csv states ranges; unset: the boresight
    """

    body: str
    attitude: Attitude
    inertial: InertialSettings | msgspec.UnsetType = msgspec.UNSET
    mount: tuple[MountSettings, ...] = ()
    points: PointsSection = PointsSection()
    altimeter: AltimeterSettings | msgspec.UnsetType = msgspec.UNSET

    @property
    def beam(self) -> AltimeterSettings:
        """[altimeter], or its defaults."""
        return self.altimeter or AltimeterSettings()


def read_run_settings(path: Path) -> tuple[RunSettings, Body]:
    """A run.toml, the path of a body file made whole, and the body that it names.

    Raises ConfigError for a wrong file or an unknown body.
    """
    settings = load_toml(path, RunSettings)
    try:
        check_mounts(settings.mount)
        settings.beam.check()
        body = load_body(settings.body, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if is_body_file(settings.body):
        settings = msgspec.structs.replace(settings, body=str(path.parent / settings.body))
    return settings, body


def write_run_settings(settings: RunSettings, folder: Path) -> None:
    """Write run.toml into a folder, and beside it a copy of the body file that it names."""
    body = settings.body
    if is_body_file(body):
        body = Path(body).name
        if not (folder / body).exists():
            shutil.copyfile(settings.body, folder / body)
    text = f'body = "{body}"\nattitude = "{settings.attitude}"\n'
    if settings.inertial:
        errors = msgspec.structs.asdict(settings.inertial)
        lines = (f"{name} = {float(value)!r}\n" for name, value in errors.items())
        text += "\n[inertial]\n" + "".join(lines)
    stated = msgspec.to_builtins(settings.points)
    if stated:
        text += "\n[points]\n" + "".join(f'{name} = "{kind}"\n' for name, kind in stated.items())
    if settings.altimeter:
        beam = ", ".join(repr(float(v)) for v in settings.altimeter.beam)
        text += f"\n[altimeter]\nbeam = [{beam}]\n"
    text += "".join(mount.format_toml() for mount in settings.mount)
    (folder / RUN_TOML).write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class FileAttitude:
    """Convention of one folder's attitudes and positions; `name`: `attitude` of run.toml.

    Files state them in the frame that users have; read, they are in that of the body's catalogs.

    motion  how the body turns; by theory if None. Truth and solutions are compared by theory, which
            takes nothing from the comparison: one small rotation stands before both.

    A time is TDB s past J2000, or UTC as the files write it.
    """

    name: Attitude
    body: Body
    motion: Ephemeris | None = None

    @property
    def ephemeris(self) -> Ephemeris:
        """Rotation model of the body."""
        return self.motion or AnalyticEphemeris(self.body)

    @property
    def places(self) -> CatalogFrame:
        """Where the places of the files lie in the frame of the body's catalogs."""
        return self.body.catalog_frame

    def convert_for_file(self, camera_from_body: Rotation, time: float | str) -> Rotation:
        """The rotation to write for an attitude at a time."""
        if self.name == "camera_from_body":
            same = self.places.is_same
            turn = self.places.stated_from_catalog
            return camera_from_body if same else camera_from_body * turn.inv()
        return camera_from_body * self._body_from_inertial(time)

    def read(self, written: Rotation, time: float | str) -> Rotation:
        """camera_from_body of a written rotation at a time."""
        if self.name == "camera_from_body":
            same = self.places.is_same
            return written if same else written * self.places.stated_from_catalog
        return written * self._body_from_inertial(time).inv()

    def sigma_rad(self, tdb_s: float) -> float:
        """Error that the body's rotation adds to an attitude of the files, 1 sigma an axis, rad.

        An attitude against the stars is only as good, relative to the body, as the body's rotation
        is known. This part is common to frames near in time.
        """
        if self.name == "camera_from_body":
            return 0.0
        return self.ephemeris.error_m(tdb_s) / self.body.radius_m

    def inertial_from_body(self, time: float | str) -> Rotation:
        """Return the orientation of the body at a time."""
        return self._body_from_inertial(time).inv()

    def _body_from_inertial(self, time: float | str) -> Rotation:
        tdb_s = utc_to_tdb_s(time) if isinstance(time, str) else time
        return Rotation.from_matrix(self.ephemeris.body_from_inertial(tdb_s))
