"""A picture that stands alone: plots side by side under a title, with one legend, as SVG."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from catalog.files import make_prefix_test, replace_file
from optnav_cli.report.page import read_styles
from optnav_cli.report.svg import Plot, draw_mark

BEGINNING = "<!-- optnav picture -->\n"
EDGE, GAP = 14, 10  # around the whole and between plots, px
TITLE_HEIGHT, LEGEND_HEIGHT, HEADING_HEIGHT = 26, 22, 18
LETTER = 6.6  # width of a letter of the legend, px, on average
STYLE = f"""
svg {{ {read_styles("light.css")} }}

{read_styles("drawings.css")}

svg text.title {{ font-size: 15px; font-weight: 600; }}
svg text.heading {{ font-weight: 600; }}
"""


@dataclass(frozen=True)
class LegendEntry:
    """Legend of a series of all plots.

    series  of the plots, with "dashed" where its line is
    shape   of its marks, "" without
    line    whether it has a line
    """

    series: str
    words: str
    shape: str = "circle"
    line: bool = True


@dataclass(frozen=True)
class Panel:
    """One plot with what stands above it, if anything; `description` is read to the blind."""

    heading: str
    plot: Plot
    description: str


def draw_sheet(title: str, legend: Sequence[LegendEntry], rows: Sequence[Sequence[Panel]]) -> str:
    """Draw the picture; all plots of a row are of the same height."""
    width = max(sum(p.plot.width for p in row) + GAP * (len(row) - 1) for row in rows) + 2 * EDGE
    parts: list[str] = []
    top = float(EDGE + TITLE_HEIGHT)
    lines, top = _draw_legend(legend, width, top)
    parts += lines
    for row in rows:
        left = float(EDGE)
        heading = HEADING_HEIGHT if any(panel.heading for panel in row) else 0
        for panel in row:
            middle = left + panel.plot.width / 2.0
            if panel.heading:
                at = f'text-anchor="middle" x="{middle:g}" y="{top + 13:g}"'
                parts.append(f'<text class="heading" {at}>{escape(panel.heading)}</text>')
            parts.append(panel.plot.svg(panel.description, at=(left, top + heading)))
            left += panel.plot.width + GAP
        top += heading + max(panel.plot.height for panel in row) + GAP
    height = top - GAP + EDGE
    head = (
        f'{BEGINNING}<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
        f'viewBox="0 0 {width:g} {height:g}" role="img" '
        f'aria-label="{escape(title, quote=True)}">\n'
        f"<style>{STYLE}</style>\n"
        f'<rect width="{width:g}" height="{height:g}" style="fill: var(--paper)"/>\n'
        f'<text class="title" x="{EDGE}" y="{EDGE + 14}">{escape(title)}</text>'
    )
    return "\n".join([head, *parts, "</svg>\n"])


def write_sheet(picture: str, path: Path) -> None:
    """Write a picture; an older one there is replaced. Raises OutputError for anything else."""
    with replace_file(path, make_prefix_test(BEGINNING.encode())) as partial:
        partial.write_text(picture, encoding="utf-8")


def _draw_legend(
    legend: Sequence[LegendEntry], width: float, top: float
) -> tuple[list[str], float]:
    """Draw the entries in as many lines as they need; return where the plots begin."""
    parts: list[str] = []
    left = float(EDGE)
    for entry in legend:
        needed = 54.0 + LETTER * len(entry.words)
        if left > EDGE and left + needed > width - EDGE:
            left, top = float(EDGE), top + LEGEND_HEIGHT
        y = top + 8.0
        if entry.line:
            ends = f"{left:g},{y:g} {left + 24:g},{y:g}"
            parts.append(f'<polyline class="line {entry.series}" points="{ends}"/>')
        if entry.shape:
            parts.append(draw_mark(left + 12.0, y, entry.series.replace("dashed", ""), entry.shape))
        parts.append(f'<text x="{left + 30:g}" y="{y + 4:g}">{escape(entry.words)}</text>')
        left += needed
    return parts, top + (LEGEND_HEIGHT if legend else 0)
