"""Marks of several shapes, so that series are told apart without their colours."""

import math
from html import escape

SHAPES = ("circle", "triangle", "square", "diamond", "down", "cross", "dash")
# Corners about the middle, in units of the radius; areas are about those of the disc.
_CORNERS = {
    "triangle": ((0.0, -1.25), (1.1, 0.8), (-1.1, 0.8)),
    "down": ((0.0, 1.25), (1.1, -0.8), (-1.1, -0.8)),
    "square": ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    "diamond": ((0.0, -1.25), (1.25, 0.0), (0.0, 1.25), (-1.25, 0.0)),
}


def mark(x: float, y: float, series: str, shape: str, radius: float = 3.2, title: str = "") -> str:
    """A mark as SVG at picture x, y; `series` may add "hollow", `title` is shown under the pointer.

    Raises KeyError for a shape that is not in SHAPES.
    """
    name = f"<title>{escape(title)}</title>" if title else ""
    if shape == "circle":
        return (
            f'<circle class="mark {series}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}">'
            f"{name}</circle>"
        )
    if shape == "dash":
        ends = f"M{x - 1.3 * radius:.1f} {y:.1f}h{2.6 * radius:.1f}"
        return f'<path class="mark stroke {series}" d="{ends}">{name}</path>'
    if shape == "cross":
        a = radius * math.sqrt(0.7)
        path = (
            f"M{x - a:.1f} {y - a:.1f}L{x + a:.1f} {y + a:.1f}"
            f"M{x - a:.1f} {y + a:.1f}L{x + a:.1f} {y - a:.1f}"
        )
        return f'<path class="mark stroke {series}" d="{path}">{name}</path>'
    corners = " ".join(f"{x + radius * u:.1f},{y + radius * v:.1f}" for u, v in _CORNERS[shape])
    return f'<polygon class="mark {series}" points="{corners}">{name}</polygon>'


def key_mark(series: str, shape: str, words: str) -> str:
    """An entry of an HTML legend: the mark and what it stands for."""
    drawn = mark(7.0, 7.0, series, shape, 4.5)
    return (
        f'<span class="entry"><svg class="sign" viewBox="0 0 14 14" aria-hidden="true">{drawn}'
        f"</svg>{escape(words)}</span>"
    )
