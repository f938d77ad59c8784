"""A folder of pictures of a lit cylinder: run.toml, cameras/NAME.toml, frames.csv and pictures.

Of frames.csv the columns file, utc and camera are read; attitudes and positions of a body are none
of a cylinder's.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from catalog.bodies.body import load_body
from catalog.config import load_toml, read_toml_text
from catalog.errors import ConfigError, DataError
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.folder import read_cameras
from optnav_cli.frames.frames import Frame, read_frames
from optnav_cli.frames.run_settings import RUN_TOML, FileAttitude

Length = Annotated[float, Meta(gt=0.0, le=1e4)]


class CylinderRunSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """run.toml of a cylinder's pictures.

    radius_m                 of the cylinder
    height_m                 of its lit strip
    light_half_width_deg     half the angle under which the source is seen
    """

    target: Literal["cylinder"]
    radius_m: Length
    height_m: Length
    light_half_width_deg: Annotated[float, Meta(ge=0.0, le=20.0)] = 2.0


@dataclass(frozen=True)
class CylinderFolder:
    """A folder that was read; frames in the order of frames.csv."""

    path: Path
    settings: CylinderRunSettings
    cameras: dict[str, Camera]
    frames: list[Frame]


def read_cylinder_folder(path: Path) -> CylinderFolder:
    """Read all but the pictures; what is wrong with a row is its frame's `problem`.

    Raises ConfigError for a wrong run.toml or camera file, DataError for a folder or frames.csv
    that cannot be used.
    """
    if not path.is_dir():
        problem = "is no folder" if path.exists() else "there is no such folder"
        raise DataError(f"{path}: {problem}; wanted one with run.toml, frames.csv and cameras/")
    where = path / RUN_TOML
    if "target" not in _read_keys(where):
        raise ConfigError(
            f'{where}: names no target; write target = "cylinder", radius_m and height_m, or use '
            "`optnav navigate` for pictures of a body"
        )
    settings = load_toml(where, CylinderRunSettings)
    cameras = read_cameras(path / "cameras")
    for camera in cameras.values():
        if camera.model != "pinhole":
            raise ConfigError(
                f"{path / 'cameras' / camera.name}.toml: model is '{camera.model}'; a cylinder is "
                "measured by a pinhole camera, with distortion or without"
            )
    # rows are checked as those of any folder; what they may say of a body is not used
    attitude = FileAttitude("camera_from_body", load_body("moon"))
    frames = read_frames(path / "frames.csv", attitude, cameras)
    return CylinderFolder(path, settings, cameras, frames)


def _read_keys(path: Path) -> dict[str, object]:
    try:
        return tomllib.loads(read_toml_text(path))
    except (ValueError, RecursionError):
        return {"target": None}  # what is wrong in it is said by reading it in full
