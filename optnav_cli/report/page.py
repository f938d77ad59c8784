"""The HTML page of a report and its parts, from templates; nothing is loaded from outside.

Text is escaped by the templates; `Markup` is what they made, or a drawing.
"""

import base64
import json
import struct
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from catalog.arrays import ByteArray
from catalog.errors import DataError
from catalog.inputs import read_input
from optnav_cli.output.canvas import compute_shrink_factor, encode_picture, resize_picture
from optnav_cli.output.overlay import MAX_PX, RESIDUALS_ENLARGED, overlay_path
from optnav_cli.output.run_folder import OVERLAYS, RunFolder

BEGINNING = "<!doctype html>\n<!-- optnav report -->\n"
TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    keep_trailing_newline=True,
)
MAX_PICTURES = 24
MAX_BYTES = 5e6  # of all pictures of a page; they are shrunk to that
MIN_PX, QUALITY = 480, 72
MAX_OVERLAY_PX = 4 * MAX_PX  # an overlay of more pixels a side is none of ours
PNG_HEADER = b"\x89PNG\r\n\x1a\n"


def read_styles(name: str) -> str:
    """Read the text of a style sheet."""
    return TEMPLATES.get_template(name).render().rstrip("\n")


def build_page(title: str, subtitle: str, sections: Iterable[Markup]) -> str:
    """Build a page."""
    template = TEMPLATES.get_template("page.html")
    return template.render(title=title, subtitle=subtitle, sections=list(sections))


def _fill_block(name: str, *values: object) -> Markup:
    """Fill a macro of the template of blocks."""
    return Markup(getattr(TEMPLATES.get_template("blocks.html").module, name)(*values))


# Blocks that are filled in as they are called.
legend = partial(_fill_block, "legend")  # of (colour "#rrggbb", what it means)
tiles = partial(_fill_block, "tiles")  # the main numbers, (number, what it is) each
folded = partial(_fill_block, "folded")  # (summary, content): content that opens on a click
image = partial(_fill_block, "image")  # (address, description): an img element of a `data_uri`
enlarged = partial(_fill_block, "enlarged")  # (id, address, description, words): large on a click
anchor = partial(_fill_block, "anchor")  # (id): a place to come back to
captioned = partial(_fill_block, "captioned")  # (picture, words below it, class of its frame)


def section(heading: str, *parts: Markup) -> Markup:
    """A section with its heading."""
    return _fill_block("section", heading, parts)


def subsection(heading: str, *parts: Markup) -> Markup:
    """A part of a section with its heading."""
    return _fill_block("subsection", heading, parts)


def paragraph(text: str, kind: str = "") -> Markup:
    """A paragraph; its kind "note" is one that should not be missed."""
    return _fill_block("paragraph", text, kind)


def side_by_side(kind: str, parts: Iterable[Markup]) -> Markup:
    """Parts side by side: a "pair", a "triple", "thumbs" or "patches"."""
    return _fill_block("side_by_side", kind, list(parts))


def figure(
    content: Markup, caption: str, keys: Mapping[str, str] | None = None, extra: Markup = Markup()
) -> Markup:
    """A drawing with a caption and, if given, what its colours ("k1", ...) mean and more HTML."""
    return _fill_block("figure", content, caption, keys or {}, extra)


def table(header: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int = 1) -> Markup:
    """A table of text; all but the first `text_columns` columns are numbers."""
    return _fill_block("table", header, rows, text_columns)


def format_listing(values: Mapping[str, Any] | str) -> Markup:
    """A manifest or a config as it stands."""
    text = values if isinstance(values, str) else json.dumps(values, indent=2, ensure_ascii=False)
    return _fill_block("listing", text)


def format_count(number: int) -> str:
    """Format a whole number with narrow spaces, where no line breaks, between its thousands."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}" if number >= 10000 else "")


def count_things(number: int, thing: str) -> str:
    """Format the number of things: "1 point", "2 points"."""
    return f"{format_count(number)} {thing}{'' if number == 1 else 's'}"


def format_percent(part: int, total: int) -> str:
    """Format a share in words: what is little is not called nothing."""
    if total == 0:
        return "-"
    return "< 0.1 %" if 0 < part < 0.0005 * total else f"{100.0 * part / total:.1f} %"


def encode_picture_uri(picture: ByteArray, suffix: str = ".png", quality: int = 80) -> str:
    """Encode a picture as an address that holds it."""
    return encode_uri(
        encode_picture(picture, suffix, quality), "jpeg" if suffix == ".jpg" else "png"
    )


def encode_uri(data: bytes, kind: str) -> str:
    """Wrap an encoded picture ("png" or "jpeg") into an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def build_pictures(run: RunFolder) -> Markup:
    """Build overlays evenly through the run; a note where some are missing or damaged."""
    names = [solution.file for solution in run.solutions]
    there = _list_existing(run.path / OVERLAYS, names)
    if not there:
        return Markup()
    parts = [anchor("pictures"), paragraph(_describe_pictures(run, len(there)))]
    shown, damaged = list_overlays(run.path / OVERLAYS, names)
    if damaged:
        parts.append(paragraph(damaged, "note"))
    return section("Pictures", *parts, shown)


def list_overlays(folder: Path, names: Sequence[str]) -> tuple[Markup, str]:
    """List overlays of files, evenly through them, with a note on those that are damaged."""
    there = _list_existing(folder, names)
    number = min(len(there), MAX_PICTURES)
    picked = [there[k] for k in np.linspace(0, len(there) - 1, number).round().astype(int)]
    read = {file: _read_overlay(overlay_path(folder, file)) for file in picked}
    pictures = {file: picture for file, picture in read.items() if picture is not None}
    shown = [
        enlarged(f"picture{k}", encode_uri(data, "jpeg"), f"overlay of {file}", file)
        for k, (file, data) in enumerate(_shrink(pictures).items())
    ]
    damaged = [file for file, picture in read.items() if picture is None]
    words = f"{count_things(len(damaged), 'overlay')} cannot be read: {', '.join(damaged)}."
    return side_by_side("thumbs", shown), words if damaged else ""


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
