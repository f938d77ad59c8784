"""run.toml of a picture folder: which body, and which rotation its quaternions mean."""

from pathlib import Path
from typing import Literal

import msgspec
from scipy.spatial.transform import Rotation

from catalog.bodies.body import Body, load_body
from catalog.bodies.rotation import body_from_inertial
from catalog.config import load_toml
from catalog.errors import ConfigError

Attitude = Literal["camera_from_body", "camera_from_inertial"]


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


def camera_from_body(rotation: Rotation, attitude: Attitude, body: Body, tdb_s: float) -> Rotation:
    """The attitude relative to the body of a rotation as the files of a folder hold it."""
    if attitude == "camera_from_body":
        return rotation
    inertial_from_body = Rotation.from_matrix(body_from_inertial(body, tdb_s)).inv()
    return rotation * inertial_from_body


def rotation_for_file(attitude: Attitude, body: Body, tdb_s: float, found: Rotation) -> Rotation:
    """The rotation that a file holds for an attitude `found` as camera_from_body."""
    if attitude == "camera_from_body":
        return found
    return found * Rotation.from_matrix(body_from_inertial(body, tdb_s))
