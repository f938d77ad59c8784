"""The overlays of a run on its page: small ones side by side, each whole on a click."""

import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from markupsafe import Markup

from catalog.arrays import ByteArray
from catalog.errors import DataError
from catalog.inputs import read_input
from optnav_cli.output.canvas import compute_shrink_factor, encode_picture, resize_picture
from optnav_cli.output.overlay import MAX_PX, RESIDUALS_ENLARGED, overlay_path
from optnav_cli.output.run_folder import OVERLAYS, RunFolder
from optnav_cli.report import page as html

MAX_PICTURES = 24
MAX_BYTES = 5e6  # of all pictures of a page; they are shrunk to that
MIN_PX, QUALITY = 480, 72
MAX_OVERLAY_PX = 4 * MAX_PX  # an overlay of more pixels a side is none of ours
PNG_HEADER = b"\x89PNG\r\n\x1a\n"


def build_pictures(run: RunFolder) -> Markup:
    """Build overlays evenly through the run; a note where some are missing or damaged."""
    names = [solution.file for solution in run.solutions]
    there = _list_existing(run.path / OVERLAYS, names)
    if not there:
        return Markup()
    parts = [html.anchor("pictures"), html.paragraph(_describe_pictures(run, len(there)))]
    shown, damaged = list_overlays(run.path / OVERLAYS, names)
    if damaged:
        parts.append(html.paragraph(damaged, "note"))
    return html.section("Pictures", *parts, shown)


def list_overlays(folder: Path, names: Sequence[str]) -> tuple[Markup, str]:
    """List overlays of files, evenly through them, with a note on those that are damaged."""
    there = _list_existing(folder, names)
    number = min(len(there), MAX_PICTURES)
    picked = [there[k] for k in np.linspace(0, len(there) - 1, number).round().astype(int)]
    read = {file: _read_overlay(overlay_path(folder, file)) for file in picked}
    pictures = {file: picture for file, picture in read.items() if picture is not None}
    shown = [
        html.enlarged(f"picture{k}", html.encode_uri(data, "jpeg"), f"overlay of {file}", file)
        for k, (file, data) in enumerate(_shrink(pictures).items())
    ]
    damaged = [file for file, picture in read.items() if picture is None]
    words = f"{html.count_things(len(damaged), 'overlay')} cannot be read: {', '.join(damaged)}."
    return html.side_by_side("thumbs", shown), words if damaged else ""


def _list_existing(folder: Path, names: Sequence[str]) -> list[str]:
    """List files that have an overlay."""
    return [file for file in dict.fromkeys(names) if overlay_path(folder, file).is_file()]


def _describe_pictures(run: RunFolder, there: int) -> str:
    """Describe what the pictures show, and how many of them there are."""
    what = []
    if run.matches:
        what.append("control points where the prior (pink) and the solution (blue) predict them")
        what.append("and where they were found (crosses)")
    if any(solution.n_limb is not None for solution in run.solutions):
        what.append(("and " if what else "") + "the limb")
    shown = f"{' '.join(what)}; residuals enlarged {RESIDUALS_ENLARGED:.0f} times. " if what else ""
    some = f" {MAX_PICTURES} of {there} frames." if there > MAX_PICTURES else ""
    return f"{shown[:1].upper()}{shown[1:]}A click enlarges a picture.{some}"


def _read_overlay(path: Path) -> ByteArray | None:
    """Read an overlay; None for a file that is no picture, or a larger one than we write."""
    try:
        data = read_input(path, "picture")
    except DataError:
        return None
    if len(data) < 24 or not data.startswith(PNG_HEADER):
        return None
    if max(struct.unpack(">II", data[16:24])) > MAX_OVERLAY_PX:
        return None
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return None if picture is None else np.asarray(picture, np.uint8)


def _shrink(pictures: dict[str, ByteArray]) -> dict[str, bytes]:
    """Shrink pictures to JPEG; smaller still where they would take too much room."""
    longest = MAX_PX
    while True:
        data = {file: _encode_jpeg(picture, longest) for file, picture in pictures.items()}
        if longest <= MIN_PX or sum(map(len, data.values())) <= MAX_BYTES:
            return data
        longest = max(MIN_PX, round(0.8 * longest))


def _encode_jpeg(picture: ByteArray, longest_px: int) -> bytes:
    height, width = picture.shape[:2]
    small = resize_picture(picture, compute_shrink_factor(width, height, longest_px))
    return encode_picture(small, ".jpg", QUALITY)
