"""run.toml of a picture folder: which body, and which rotation its quaternions mean."""

from pathlib import Path
from typing import Literal

import msgspec
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.motion import BodyMotion
from catalog.config import load_toml
from catalog.errors import ConfigError

Attitude = Literal["camera_from_body", "camera_from_inertial"]


class SpiceSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """SPICE kernels for the body's rotation and its Sun; none: analytic theory."""

    kernels: tuple[str, ...] = ()


class RunSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """run.toml as it is written."""

    body: str
    attitude: Attitude


def read_run_settings(path: str | Path) -> RunSettings:
    """Settings of a run.toml. Raises ConfigError for a wrong file or an unknown body."""
    settings = load_toml(Path(path), RunSettings)
    try:
        load_body(settings.body)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return settings


def run_settings_toml(settings: RunSettings) -> str:
    """The text of a run.toml."""
    return f'body = "{settings.body}"\nattitude = "{settings.attitude}"\n'


def camera_from_body(
    rotation: Rotation, attitude: Attitude, motion: BodyMotion, tdb_s: float
) -> Rotation:
    """The attitude relative to the body of a rotation as the files of a folder hold it."""
    if attitude == "camera_from_body":
        return rotation
    inertial_from_body = Rotation.from_matrix(motion.body_from_inertial(tdb_s)).inv()
    return rotation * inertial_from_body


def rotation_for_file(
    attitude: Attitude, motion: BodyMotion, tdb_s: float, found: Rotation
) -> Rotation:
    """The rotation that a file holds for an attitude `found` as camera_from_body."""
    if attitude == "camera_from_body":
        return found
    return found * Rotation.from_matrix(motion.body_from_inertial(tdb_s))


def body_sigma_rad(attitude: Attitude, motion: BodyMotion, tdb_s: float) -> float:
    """Error that the body's rotation adds to an attitude of the files, 1 sigma an axis, rad.

    An attitude against the stars is only as good, relative to the body, as the body's rotation is
    known. This part is common to frames near in time.
    """
    if attitude == "camera_from_body":
        return 0.0
    return motion.error_m(tdb_s) / motion.body.radius_m
