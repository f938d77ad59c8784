"""The HTML page of a report: its style, its sections and tables; nothing is loaded from outside."""

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optnav_cli.output.display import encoded

BEGINNING = "<!doctype html>\n<!-- optnav report -->\n"

STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1b2330; --soft: #5b6675;
  --rule: #d8dee6; --tile: #f3f6f9; --c1: #1f6fb2; --c2: #c2571a; --c3: #23824e; --c4: #b3273f; }
@media (prefers-color-scheme: dark) { :root { --paper: #12161c; --ink: #e4e9f0; --soft: #98a4b3;
  --rule: #2c3541; --tile: #1b222b; --c1: #5eb0f0; --c2: #f29a5c; --c3: #5fc98c; --c4: #f2708a; } }
@media print { :root { color-scheme: light; --paper: #ffffff; --ink: #000000; --soft: #444444;
  --rule: #cccccc; --tile: #f3f3f3; --c1: #1f6fb2; --c2: #c2571a; --c3: #23824e; --c4: #b3273f; }
  section, figure, tr { break-inside: avoid; } body { max-width: none; padding: 0; } }
* { box-sizing: border-box; }
body { background: var(--paper); color: var(--ink); max-width: 62rem; margin: 0 auto;
  padding: 1.5rem 1rem 4rem; font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; padding-top: .5rem;
  border-top: 1px solid var(--rule); }
p { margin: .4rem 0; } .soft { color: var(--soft); }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(9.5rem, 1fr)); gap: .6rem;
  margin: 1rem 0; }
.tile { background: var(--tile); border-radius: 8px; padding: .6rem .8rem; }
.tile b { display: block; font-size: 1.35rem; font-weight: 600; }
.tile span { color: var(--soft); font-size: .82rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .86rem; }
th, td { text-align: left; padding: .25rem .6rem; border-bottom: 1px solid var(--rule);
  vertical-align: top; }
th { color: var(--soft); font-weight: 600; white-space: nowrap; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
figure { margin: .8rem 0; } figcaption { color: var(--soft); font-size: .86rem; }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(20rem, 1fr)); gap: 1rem; }
.thumbs { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .8rem; }
.thumbs img, .patches img { width: 100%; height: auto; border-radius: 4px; display: block; }
.patches { display: grid; grid-template-columns: repeat(5, minmax(0, 8.5rem)); gap: .4rem;
  margin: .3rem 0 1rem; } .patches img { image-rendering: pixelated; }
svg { width: 100%; height: auto; display: block; }
svg text { fill: var(--ink); font: 12px system-ui, "DejaVu Sans", sans-serif; }
svg text.tick { fill: var(--soft); font-size: 11px; }
svg .grid { stroke: var(--rule); stroke-width: 1; }
svg .frame { fill: none; stroke: var(--soft); stroke-width: 1; }
svg .line { fill: none; stroke-width: 1.6; stroke: var(--ink); } svg .thin { stroke-width: .8; }
svg .band { stroke: none; fill-opacity: .16; }
svg .bar { fill-opacity: .8; }
svg .line.s1 { stroke: var(--c1); } svg .line.s2 { stroke: var(--c2); }
svg .line.s3 { stroke: var(--c3); } svg .line.s4 { stroke: var(--c4); }
svg .line.muted { stroke: var(--soft); } svg .line.faint { stroke: var(--soft); opacity: .35; }
svg .s1 { fill: var(--c1); } svg .s2 { fill: var(--c2); } svg .s3 { fill: var(--c3); }
svg .s4 { fill: var(--c4); } svg .muted { fill: var(--soft); } svg .line { fill: none; }
.key { display: inline-block; width: .8em; height: .8em; border-radius: 2px; margin: 0 .3em 0 .9em;
  vertical-align: -.05em; } .k1 { background: var(--c1); } .k2 { background: var(--c2); }
.k3 { background: var(--c3); } .k4 { background: var(--c4); } .k0 { background: var(--soft); }
details { margin: .5rem 0; } summary { cursor: pointer; }
pre { background: var(--tile); border-radius: 8px; padding: .8rem; font-size: .8rem;
  white-space: pre-wrap; overflow-wrap: anywhere; }
"""


def page(title: str, subtitle: str, sections: Iterable[str]) -> str:
    """A whole page; title and subtitle are plain text, sections are HTML."""
    return (
        f'{BEGINNING}<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head>\n"
        f'<body><h1>{escape(title)}</h1><p class="soft">{escape(subtitle)}</p>\n'
        + "\n".join(sections)
        + "\n</body></html>\n"
    )


def section(heading: str, *parts: str) -> str:
    """A section with its heading (plain text) and HTML parts."""
    return f"<section><h2>{escape(heading)}</h2>\n" + "\n".join(parts) + "</section>"


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def figure(content: str, caption: str, keys: Mapping[str, str] | None = None) -> str:
    """A drawing with a caption and, if given, what its colours ("k1", ...) mean."""
    legend = "".join(
        f'<span class="key {key}"></span>{escape(words)}' for key, words in (keys or {}).items()
    )
    return f"<figure>{content}<figcaption>{escape(caption)}{legend}</figcaption></figure>"


def tiles(values: Iterable[tuple[str, str]]) -> str:
    """The main numbers, each with what it is."""
    inner = "".join(
        f'<div class="tile"><b>{escape(value)}</b><span>{escape(name)}</span></div>'
        for value, name in values
    )
    return f'<div class="tiles">{inner}</div>'


def table(header: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int = 1) -> str:
    """A table of plain text; all but the first `text_columns` columns are numbers."""

    def cells(tag: str, row: Sequence[str]) -> str:
        return "".join(
            f"<{tag}{'' if i < text_columns else ' class=n'}>{escape(cell)}</{tag}>"
            for i, cell in enumerate(row)
        )

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return (
        f'<div class="scroll"><table><thead><tr>{cells("th", header)}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def folded(summary: str, content: str) -> str:
    """HTML content that opens on a click."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"


def listing(values: Mapping[str, Any] | str) -> str:
    """A manifest or a config as it stands."""
    text = values if isinstance(values, str) else json.dumps(values, indent=2, ensure_ascii=False)
    return f"<pre>{escape(text)}</pre>"


def data_uri(picture: NDArray[np.uint8], suffix: str = ".png", quality: int = 80) -> str:
    """A picture as an address that holds it."""
    kind = "jpeg" if suffix == ".jpg" else "png"
    data = base64.b64encode(encoded(picture, suffix, quality)).decode("ascii")
    return f"data:image/{kind};base64,{data}"


def image(uri: str, description: str) -> str:
    """An img element of a `data_uri`."""
    return f'<img src="{uri}" alt="{escape(description, quote=True)}">'
