"""run.toml of a picture folder: which body, and which rotation its quaternions mean."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body, is_body_file, load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import load_toml
from catalog.errors import ConfigError

Attitude = Literal["camera_from_body", "camera_from_inertial"]


class SpiceSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """SPICE kernels for the body's rotation and its Sun; none: analytic theory."""

    kernels: tuple[str, ...] = ()


class RunSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """run.toml. body: a name of configs/bodies, or the path of a body file, from its folder."""

    body: str
    attitude: Attitude


def read_run_settings(path: str | Path) -> RunSettings:
    """Settings of a run.toml; the path of a body file comes out whole.

    Raises ConfigError for a wrong file or an unknown body.
    """
    path = Path(path)
    settings = load_toml(path, RunSettings)
    try:
        load_body(settings.body, path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    if is_body_file(settings.body):
        settings = msgspec.structs.replace(settings, body=str(path.parent / settings.body))
    return settings


def write_run_settings(settings: RunSettings, folder: Path) -> None:
    """Write run.toml into a folder, and beside it a copy of the body file that it names."""
    body = settings.body
    if is_body_file(body):
        body = Path(body).name
        if not (folder / body).exists():
            shutil.copyfile(settings.body, folder / body)
    text = f'body = "{body}"\nattitude = "{settings.attitude}"\n'
    (folder / "run.toml").write_text(text, encoding="utf-8")


def camera_from_body(
    rotation: Rotation, attitude: Attitude, motion: Ephemeris, tdb_s: float
) -> Rotation:
    """The attitude relative to the body of a rotation as the files of a folder hold it."""
    if attitude == "camera_from_body":
        return rotation
    inertial_from_body = Rotation.from_matrix(motion.body_from_inertial(tdb_s)).inv()
    return rotation * inertial_from_body


def rotation_for_file(
    attitude: Attitude, motion: Ephemeris, tdb_s: float, found: Rotation
) -> Rotation:
    """The rotation that a file holds for an attitude `found` as camera_from_body."""
    if attitude == "camera_from_body":
        return found
    return found * Rotation.from_matrix(motion.body_from_inertial(tdb_s))


def body_sigma_rad(attitude: Attitude, motion: Ephemeris, tdb_s: float) -> float:
    """Error that the body's rotation adds to an attitude of the files, 1 sigma an axis, rad.

    An attitude against the stars is only as good, relative to the body, as the body's rotation is
    known. This part is common to frames near in time.
    """
    if attitude == "camera_from_body":
        return 0.0
    return motion.error_m(tdb_s) / motion.body.radius_m


@dataclass(frozen=True)
class FileAttitude:
    """How the files of one run write attitudes; `name` is the `attitude` of run.toml.

    motion  how the body turns; by theory if None. Truth and solutions are compared by theory, which
            takes nothing from the comparison: one small turn stands before both.
    """

    name: Attitude
    body: Body
    motion: Ephemeris | None = None

    def written(self, rotation: Rotation, utc: str) -> Rotation:
        """The rotation to write for a camera_from_body at a time."""
        return rotation_for_file(self.name, self._motion, self._time(utc), rotation)

    def read(self, written: Rotation, utc: str) -> Rotation:
        """camera_from_body of a written rotation at a time."""
        return camera_from_body(written, self.name, self._motion, self._time(utc))

    @property
    def _motion(self) -> Ephemeris:
        return self.motion or AnalyticEphemeris(self.body)

    def _time(self, utc: str) -> float:
        # relative to the body no time is needed, and an unsolved row's may not be understood
        return 0.0 if self.name == "camera_from_body" else utc_to_tdb_s(utc)
