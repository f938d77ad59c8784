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


def styles(name: str) -> str:
    """The text of a style sheet."""
    return TEMPLATES.get_template(name).render().rstrip("\n")


def page(title: str, subtitle: str, sections: Iterable[Markup]) -> str:
    """A whole page."""
    template = TEMPLATES.get_template("page.html")
    return template.render(title=title, subtitle=subtitle, sections=list(sections))


def _block(name: str, *values: object) -> Markup:
    """A macro of the template of blocks, filled in."""
    return Markup(getattr(TEMPLATES.get_template("blocks.html").module, name)(*values))


# Blocks that are filled in as they are called.
legend = partial(_block, "legend")  # of (colour "#rrggbb", what it means)
tiles = partial(_block, "tiles")  # the main numbers, (number, what it is) each
folded = partial(_block, "folded")  # (summary, content): content that opens on a click
image = partial(_block, "image")  # (address, description): an img element of a `data_uri`
enlarged = partial(_block, "enlarged")  # (id, address, description, words): large on a click
anchor = partial(_block, "anchor")  # (id): a place to come back to
captioned = partial(_block, "captioned")  # (picture, words below it, class of its frame)


def section(heading: str, *parts: Markup) -> Markup:
    """A section with its heading."""
    return _block("section", heading, parts)


def subsection(heading: str, *parts: Markup) -> Markup:
    """A part of a section with its heading."""
    return _block("subsection", heading, parts)


def paragraph(text: str, kind: str = "") -> Markup:
    """A paragraph; its kind "note" is one that should not be missed."""
    return _block("paragraph", text, kind)


def side_by_side(kind: str, parts: Iterable[Markup]) -> Markup:
    """Parts side by side: a "pair", a "triple", "thumbs" or "patches"."""
    return _block("side_by_side", kind, list(parts))


def figure(
    content: Markup, caption: str, keys: Mapping[str, str] | None = None, extra: Markup = Markup()
) -> Markup:
    """A drawing with a caption and, if given, what its colours ("k1", ...) mean and more HTML."""
    return _block("figure", content, caption, keys or {}, extra)


def table(header: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int = 1) -> Markup:
    """A table of text; all but the first `text_columns` columns are numbers."""
    return _block("table", header, rows, text_columns)


def listing(values: Mapping[str, Any] | str) -> Markup:
    """A manifest or a config as it stands."""
    text = values if isinstance(values, str) else json.dumps(values, indent=2, ensure_ascii=False)
    return _block("listing", text)


def grouped(number: int) -> str:
    """A whole number with narrow spaces, where no line breaks, between its thousands."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}" if number >= 10000 else "")


def counted(number: int, thing: str) -> str:
    """How many of a thing there are: "1 point", "2 points"."""
    return f"{grouped(number)} {thing}{'' if number == 1 else 's'}"


def percent(part: int, total: int) -> str:
    """A share in words: what is little is not called nothing."""
    if total == 0:
        return "-"
    return "< 0.1 %" if 0 < part < 0.0005 * total else f"{100.0 * part / total:.1f} %"


def data_uri(picture: ByteArray, suffix: str = ".png", quality: int = 80) -> str:
    """A picture as an address that holds it."""
    return uri_of(encode_picture(picture, suffix, quality), "jpeg" if suffix == ".jpg" else "png")


def uri_of(data: bytes, kind: str) -> str:
    """An encoded picture ("png" or "jpeg") as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
