"""The HTML page of a report and its parts, from templates; nothing is loaded from outside.

Text is escaped by the templates; `Markup` is what they made, or a drawing.
"""

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from catalog.arrays import ByteArray
from optnav_cli.output.canvas import encode_picture

BEGINNING = "<!doctype html>\n<!-- optnav report -->\n"
TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    keep_trailing_newline=True,
)


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
