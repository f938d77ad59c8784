"""One frame of a folder: always a row, never a guess."""

from collections.abc import Iterator

import numpy as np

from catalog.arrays import Float32Array
from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import Matcher
from catalog.correlation.surf64 import match_surf
from catalog.errors import DataError
from optnav_cli.fix import NoFix, Solution
from optnav_cli.frames.folder import Folder
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import load_picture
from optnav_cli.navigation.autonomous import Navigator
from optnav_cli.reasons import Reason, ReasonCode

MATCHERS: dict[str, Matcher] = {"ncc": match_ncc, "surf": match_surf}


def in_order(folder: Folder) -> Iterator[int]:
    """Places of the frames in the order to navigate them: by time, the widest camera first.

    A frame whose time is not known stays behind the one before it.
    """
    keys: list[tuple[float, float]] = []
    for frame in folder.frames:
        camera = folder.cameras.get(frame.camera)
        width = 0.0 if camera is None else camera.width_px / camera.focal_length_px
        last = keys[-1][0] if keys else -np.inf
        keys.append((last if frame.tdb_s is None else frame.tdb_s, -width))
    yield from sorted(range(len(keys)), key=lambda place: keys[place])


def solve_frame(
    folder: Folder, frame: Frame, navigator: Navigator
) -> tuple[Solution, Float32Array | None]:
    """Navigate one frame: its row, and its picture where that could be read.

    Whatever is wrong with the frame becomes the reason of an unsolved row.
    """

    def unsolved(code: ReasonCode, text: str) -> Solution:
        return Solution(frame.file, frame.utc, NoFix(Reason(code, text)))

    if frame.problem:
        return unsolved(ReasonCode.BAD_FRAME, frame.problem), None
    camera = folder.cameras.get(frame.camera)
    if camera is None:
        text = f"camera '{frame.camera}' is not known"
        return unsolved(ReasonCode.UNKNOWN_CAMERA, text), None
    try:
        picture = load_picture(folder.picture_path(frame), camera)
    except DataError as error:
        return unsolved(ReasonCode.BAD_PICTURE, str(error)), None
    try:
        return navigator.solve(frame, camera, picture), picture.values
    except DataError as error:
        return unsolved(ReasonCode.BAD_DATA, str(error)), picture.values
