"""[[mount]] of run.toml: where the cameras of a ship stand in it, and how well that is known."""

from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.errors import ConfigError
from catalog.geometry.rotations import ARCSEC, rotation_from_quaternion
from optnav_cli.camera.camera_file import is_plain_name

MIN_BASE_M = 1e-3  # less cannot be measured on a ship
UNIT_TOLERANCE = 1e-3  # of a quaternion's length
Metres = Annotated[float, Meta(ge=-1e4, le=1e4)]
Share = Annotated[float, Meta(ge=-1.001, le=1.001)]
MountError = Annotated[float, Meta(ge=0.0, le=36_000.0)]  # arcsec: 10 deg


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
