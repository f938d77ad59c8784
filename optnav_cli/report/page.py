"""The HTML page of a report: its style, its sections and tables; nothing is loaded from outside."""

import base64
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from catalog.arrays import ByteArray
from optnav_cli.output.canvas import encoded

LIGHT = """--paper: #ffffff; --ink: #1b2330; --soft: #5b6675;
  --rule: #d8dee6; --tile: #f3f6f9; --none: #c4cad2; --edge: transparent;
  --c1: #1f6fb2; --c2: #c2571a; --c3: #23824e; --c4: #b3273f; --c5: #7549a8;"""
DARK = """--paper: #12161c; --ink: #e4e9f0; --soft: #98a4b3;
  --rule: #2c3541; --tile: #1b222b; --none: #39424e; --edge: #98a4b399;
  --c1: #5eb0f0; --c2: #f29a5c; --c3: #5fc98c; --c4: #f2708a; --c5: #b994ea;"""
PRINTED = """--paper: #ffffff; --ink: #000000; --soft: #444444;
  --rule: #cccccc; --tile: #f3f3f3; --none: #cccccc; --edge: transparent;
  --c1: #1f6fb2; --c2: #c2571a; --c3: #23824e; --c4: #b3273f; --c5: #7549a8;"""

DRAWINGS = """
svg text { fill: var(--ink); font: 12px system-ui, "DejaVu Sans", sans-serif; }
svg text.tick { fill: var(--soft); font-size: 11px; }
svg .grid { stroke: var(--rule); stroke-width: 1; }
svg .frame { fill: none; stroke: var(--soft); stroke-width: 1; }
svg .line { fill: none; stroke-width: 1.6; stroke: var(--ink); } svg .thin { stroke-width: .8; }
svg .dashed { stroke-dasharray: 5 4; }
svg .band { stroke: none; fill-opacity: .16; }
svg .bar { fill-opacity: .8; } svg .bar.full, svg .bar.seamless { fill-opacity: 1; }
svg .bar.full { stroke: var(--edge); stroke-width: .6; }
svg .bar.seamless { shape-rendering: crispEdges; }
svg .line.median { stroke: var(--ink); stroke-dasharray: 4 3; stroke-width: 1.2; }
svg .line.s1, svg .mark.s1 { stroke: var(--c1); } svg .line.s2, svg .mark.s2 { stroke: var(--c2); }
svg .line.s3, svg .mark.s3 { stroke: var(--c3); } svg .line.s4, svg .mark.s4 { stroke: var(--c4); }
svg .line.s5, svg .mark.s5 { stroke: var(--c5); } svg .mark.muted { stroke: var(--soft); }
svg .line.muted { stroke: var(--soft); } svg .line.faint { stroke: var(--soft); opacity: .35; }
svg .line.graticule { stroke: #ffffff; stroke-opacity: .45; stroke-width: .8; }
svg .line.scale { stroke: #ffffff; stroke-width: 2.5; }
svg .line.rim { stroke: var(--soft); stroke-width: 1.4; } svg .area.ground { fill: var(--none); }
svg text.halo { fill: #ffffff; paint-order: stroke; stroke: #00000099; stroke-width: 2.5px; }
svg .dot.ringed { stroke: #10151c; stroke-width: 1.2; }
svg .s1 { fill: var(--c1); } svg .s2 { fill: var(--c2); } svg .s3 { fill: var(--c3); }
svg .s4 { fill: var(--c4); } svg .s5 { fill: var(--c5); } svg .muted { fill: var(--soft); }
svg .line, svg .mark.stroke { fill: none; } svg .mark.hollow { fill: var(--paper); }
svg .mark { stroke-width: 1.3; } svg .mark.stroke { stroke-width: 1.8; }
"""


BEGINNING = "<!doctype html>\n<!-- optnav report -->\n"

STYLE = (
    f"""
:root {{ color-scheme: light dark; {LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root {{ {DARK} }} }}
@media print {{ :root {{ color-scheme: light; {PRINTED} }}
  section, figure, tr {{ break-inside: avoid; }} body {{ max-width: none; padding: 0; }} }}
"""
    + """
* { box-sizing: border-box; }
body { background: var(--paper); color: var(--ink); max-width: 62rem; margin: 0 auto;
  padding: 1.5rem 1rem 4rem; font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; padding-top: .5rem;
  border-top: 1px solid var(--rule); }
h3 { font-size: 1rem; margin: 1.4rem 0 .3rem; }
p { margin: .4rem 0; } .soft { color: var(--soft); }
.tiles { display: grid; grid-template-columns: repeat(auto-fill, minmax(7.4rem, 1fr)); gap: .6rem;
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
.pair { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(20rem, 100%), 1fr)); }
.thumbs { display: grid; gap: .8rem;
  grid-template-columns: repeat(auto-fill, minmax(min(15rem, 100%), 1fr)); }
.thumbs img, .patches img { width: 100%; height: auto; border-radius: 4px; display: block; }
.patches { display: grid; grid-template-columns: repeat(5, minmax(0, 1fr)); gap: .5rem;
  margin: .3rem 0 .2rem; }
.patches .level { position: relative; font-size: .74rem; line-height: 1.3; color: var(--soft); }
.patches .box { position: relative; display: block; }
.patches .inner::after { content: ""; position: absolute; inset: 25%; border: 1px solid #ffb000; }
.triple { display: grid; gap: 1rem; align-items: end; margin-top: .4rem;
  grid-template-columns: repeat(3, minmax(0, 1fr)); }
.legend { list-style: none; margin: .3rem 0 0; padding: 0; display: flex; flex-wrap: wrap;
  gap: .1rem 1.1rem; } .legend .key { margin-left: 0; border: 1px solid var(--soft); }
.note { border-left: 4px solid var(--c2); padding: .1rem .8rem; }
svg { width: 100%; height: auto; display: block; }
"""
    + DRAWINGS
    + """
.key { display: inline-block; width: .8em; height: .8em; border-radius: 2px; margin: 0 .3em 0 .9em;
  vertical-align: -.05em; } .k1 { background: var(--c1); } .k2 { background: var(--c2); }
.k5 { background: var(--c5); }
.k3 { background: var(--c3); } .k4 { background: var(--c4); } .k0 { background: var(--soft); }
.entry { display: inline-block; margin-left: .9em; }
svg.sign { display: inline-block; width: .95em; height: .95em; vertical-align: -.12em;
  margin-right: .3em; }
details { margin: .5rem 0; } summary { cursor: pointer; }
pre { background: var(--tile); border-radius: 8px; padding: .8rem; font-size: .8rem;
  white-space: pre-wrap; overflow-wrap: anywhere; }
@media (max-width: 40rem) { body { padding: 1rem .7rem 3rem; }
  svg.wide text.halo, svg.wide text.place, svg.wide text.label { font-size: 24px; }
  .triple { grid-template-columns: repeat(2, minmax(0, 1fr)); }
  .triple > :last-child { grid-column: 1 / -1; }
  .patches { grid-template-columns: repeat(3, minmax(0, 1fr)); } }
"""
)


def page(title: str, subtitle: str, sections: Iterable[str]) -> str:
    """A whole page; title and subtitle are plain text, sections are HTML."""
    return (
        f'{BEGINNING}<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{escape(title)}</title>'
        f"<style>{STYLE}</style></head>\n"
        f'<body><main><h1>{escape(title)}</h1><p class="soft">{escape(subtitle)}</p>\n'
        + "\n".join(sections)
        + "\n</main></body></html>\n"
    )


def section(heading: str, *parts: str) -> str:
    """A section with its heading (plain text) and HTML parts."""
    return f"<section><h2>{escape(heading)}</h2>\n" + "\n".join(parts) + "</section>"


def subsection(heading: str, *parts: str) -> str:
    """A part of a section with its heading (plain text) and HTML parts."""
    return f"<h3>{escape(heading)}</h3>\n" + "\n".join(parts)


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f"<p>{escape(text)}</p>"


def figure(
    content: str, caption: str, keys: Mapping[str, str] | None = None, extra: str = ""
) -> str:
    """A drawing with a caption and, if given, what its colours ("k1", ...) mean and more HTML."""
    swatches = "".join(
        f'<span class="key {key}"></span>{escape(words)}' for key, words in (keys or {}).items()
    )
    return f"<figure>{content}<figcaption>{escape(caption)}{swatches}{extra}</figcaption></figure>"


def legend(keys: Sequence[tuple[str, str]]) -> str:
    """What colours ("#rrggbb") mean."""
    items = "".join(
        f'<li><span class="key" style="background:{colour}"></span>{escape(words)}</li>'
        for colour, words in keys
    )
    return f'<ul class="legend">{items}</ul>'


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


def folded(summary: str, content: str) -> str:
    """HTML content that opens on a click."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"


def note(text: str) -> str:
    """A paragraph of plain text that should not be missed."""
    return f'<p class="note">{escape(text)}</p>'


def listing(values: Mapping[str, Any] | str) -> str:
    """A manifest or a config as it stands."""
    text = values if isinstance(values, str) else json.dumps(values, indent=2, ensure_ascii=False)
    return f"<pre>{escape(text)}</pre>"


def data_uri(picture: ByteArray, suffix: str = ".png", quality: int = 80) -> str:
    """A picture as an address that holds it."""
    kind = "jpeg" if suffix == ".jpg" else "png"
    data = base64.b64encode(encoded(picture, suffix, quality)).decode("ascii")
    return f"data:image/{kind};base64,{data}"


def captioned(picture: str, words: str, kind: str) -> str:
    """One of a row of pictures (HTML) with its words below; `kind` is a class of its frame."""
    return f'<div class="level"><span class="{kind}">{picture}</span>{escape(words)}</div>'


def image(uri: str, description: str) -> str:
    """An img element of a `data_uri`."""
    return f'<img src="{uri}" alt="{escape(description, quote=True)}">'
