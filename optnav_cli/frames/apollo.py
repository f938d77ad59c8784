"""A picture folder from a frame of the Apollo 15 metric camera and an ISIS cube of it.

The cube gives the pose; the picture is the whole frame as a PNG of 1012 x 1012 pixels. The cube's
samples and lines run as the PNG's columns and rows do. The ISIS frame of this camera has its
boresight along -z, x to the picture's left and y downwards. Found by laying the picture over a
shaded terrain model in all eight orientations: correlation 0.87 in this one, 0.10 in the next best.

The pose is a first guess: 1.3 km off, and tilted by 0.33 degrees to the wrong side of the nadir.
With the tilt held the best position leaves 1.0 px rms, with the tilt mirrored 0.40, with free
attitude 0.36 (692 patches of the 474 m model). So the attitude is declared free.
"""

import shutil
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from catalog.errors import DataError
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.folder import write_folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.isis_cube import read_cube_pose
from optnav_cli.frames.run_settings import RunSettings

CAMERA = "apollo15_metric"
CAMERA_FROM_ISIS = Rotation.from_matrix(np.diag([-1.0, 1.0, -1.0]))
PRIOR_SIGMA_M = 1500.0  # a component; the poses of the mission's support data are off by 1-2 km


def apollo_frame(cube: str | Path, file: str) -> Frame:
    """The frame that a cube describes, for a picture called `file`. Raises DataError."""
    pose = read_cube_pose(cube)
    return Frame(
        file=file,
        utc=pose.utc + "Z",
        camera=CAMERA,
        tdb_s=pose.tdb_s,
        camera_from_body=CAMERA_FROM_ISIS * pose.isis_from_body,
        attitude_sigma_rad=None,
        position_m=pose.position_m,
        position_sigma_m=PRIOR_SIGMA_M,
        sun_body=pose.sun_body,
    )


def write_apollo_folder(picture: str | Path, cube: str | Path, folder: str | Path) -> None:
    """Write a picture folder of one metric frame: its PNG, its camera and the cube's pose.

    Raises DataError when the picture or the cube cannot be used.
    """
    picture, folder = Path(picture), Path(folder)
    frame = apollo_frame(cube, picture.name)
    settings = RunSettings(body="moon", attitude="camera_from_body")
    write_folder(folder, settings, [preset_camera(CAMERA)], [frame])
    try:
        shutil.copyfile(picture, folder / picture.name)
    except OSError as error:
        raise DataError(f"{picture}: cannot be copied: {error.strerror}") from None
