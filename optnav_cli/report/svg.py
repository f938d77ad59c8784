"""Small plots as inline SVG: no plotting library, colours from the page's style sheet.

Series are named by the classes s1 (blue), s2 (orange), s3 (green), s4 (red), s5 (violet), muted.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce
from html import escape

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray

MOST = 1e100  # larger numbers are drawn no more than infinite ones are
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PLAIN = (1e-3, 1e4)  # powers of ten outside are written as such
SHAPES = ("circle", "triangle", "square", "diamond", "down", "cross", "dash")
# Corners about the middle, in units of the radius; areas are about those of the disc.
_CORNERS = {
    "triangle": ((0.0, -1.25), (1.1, 0.8), (-1.1, 0.8)),
    "down": ((0.0, 1.25), (1.1, -0.8), (-1.1, -0.8)),
    "square": ((-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)),
    "diamond": ((0.0, -1.25), (1.25, 0.0), (0.0, 1.25), (-1.25, 0.0)),
}
LEFT, RIGHT, TOP, BOTTOM = 58, 14, 12, 40  # room around the axes, px
# Plots across the page and of a pair: at these widths their letters are as large as the text's.
WIDE, HALF = 960, 470
NARROW = 400  # a wide plot again, for telephones


def choose_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Choose about `count` round numbers: steps of 1, 2 or 5 times a power of ten."""
    raw = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(f * power for f in (1.0, 2.0, 5.0, 10.0) if f * power >= 0.75 * raw)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(n * step, 12) for n in range(first, last + 1)]


def choose_log_ticks(low: float, high: float) -> list[tuple[float, float]]:
    """Choose ticks at 1, 2 and 5 of every power of ten: their common logarithms and numbers.

    Over more than two powers the powers alone.
    """
    digits = (1.0, 2.0, 5.0) if high - low <= 2.0 else (1.0,)
    powers = range(math.floor(low), math.ceil(high) + 1)
    pairs = [(power + math.log10(d), float(f"{d:g}e{power}")) for power in powers for d in digits]
    return [
        (position, number) for position, number in pairs if low - 1e-9 <= position <= high + 1e-9
    ]


def format_number(value: float) -> str:
    """Format a tick's number, short, with a true minus sign."""
    return f"{value:.10g}".replace("-", "\N{MINUS SIGN}")


def format_log_number(value: float) -> str:
    """Format a number on a logarithmic axis: 0.01, 200, 10⁶."""
    power = round(math.log10(value))
    if PLAIN[0] <= value <= PLAIN[1] or not math.isclose(value, 10.0**power):
        return format_number(value)
    return "10" + str(power).translate(SUPERSCRIPTS)


def draw_mark(
    x: float, y: float, series: str, shape: str, radius: float = 3.2, title: str = ""
) -> str:
    """Draw a mark as SVG at picture x, y; `title` is shown under the pointer.

    Raises KeyError for a shape that is not in SHAPES.
    """
    name = f"<title>{escape(title)}</title>" if title else ""
    if shape == "circle":
        disc = f'cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"'
        return f'<circle class="mark {series}" {disc}>{name}</circle>'
    if shape == "dash":
        ends = f"M{x - 1.3 * radius:.1f} {y:.1f}h{2.6 * radius:.1f}"
        return f'<path class="mark stroke {series}" d="{ends}">{name}</path>'
    if shape == "cross":
        a = radius * math.sqrt(0.7)
        path = f"M{x - a:.1f} {y - a:.1f}L{x + a:.1f} {y + a:.1f}"
        path += f"M{x - a:.1f} {y + a:.1f}L{x + a:.1f} {y - a:.1f}"
        return f'<path class="mark stroke {series}" d="{path}">{name}</path>'
    corners = " ".join(f"{x + radius * u:.1f},{y + radius * v:.1f}" for u, v in _CORNERS[shape])
    return f'<polygon class="mark {series}" points="{corners}">{name}</polygon>'


def draw_key_mark(series: str, shape: str, words: str) -> Markup:
    """Draw an entry of an HTML legend: the mark and what it stands for."""
    drawn = draw_mark(7.0, 7.0, series, shape, 4.5)
    return Markup(
        f'<span class="entry"><svg class="sign" viewBox="0 0 14 14" aria-hidden="true">{drawn}'
        f"</svg>{escape(words)}</span>"
    )


@dataclass(frozen=True)
class PlotAxis:
    """One axis of a plot: its range, and what is written along it.

    ends     lowest and highest value; their common logarithms where `log`
    log      numbers are written as what the logarithms stand for
    numbers  what is written along it, instead of round numbers
    """

    ends: tuple[float, float]
    label: str = ""
    log: bool = False
    numbers: Sequence[float] = ()


class Plot:
    """Axes in data units; what is added later is drawn above. What is not finite is left out."""

    def __init__(
        self,
        x: PlotAxis | tuple[float, float],
        y: PlotAxis | tuple[float, float],
        *,
        width: int = WIDE,
        height: int = 260,
        equal: bool = False,
        axes: bool = True,
        margins: tuple[int, int, int, int] = (LEFT, RIGHT, TOP, BOTTOM),
    ) -> None:
        """Axes x and y, of which the ends suffice; see the arguments.

        equal    widens one of them until both scales agree
        axes     False leaves out grid lines and their numbers, for maps that draw their own
        margins  room around the axes, px: left, right, top, bottom; 0 at the left leaves out the
                 frame as well, for maps that have an outline of their own
        """
        x, y = (axis if isinstance(axis, PlotAxis) else PlotAxis(axis) for axis in (x, y))
        self.width, self.height = width, height
        self._left, self._right, self._top, self._bottom = margins
        self.x, self.y = _open_range(x.ends), _open_range(y.ends)
        if equal:
            self._match_scales()
        self._axes, self._x_axis, self._y_axis = axes, x, y
        self._ground: list[str] = []
        self._body: list[str] = []

    def _match_scales(self) -> None:
        across, up = self.inner
        unit = max((self.x[1] - self.x[0]) / across, (self.y[1] - self.y[0]) / up)
        for name, pixels in (("x", across), ("y", up)):
            low, high = getattr(self, name)
            middle, half = (low + high) / 2.0, unit * pixels / 2.0
            setattr(self, name, (middle - half, middle + half))

    @property
    def inner(self) -> tuple[int, int]:
        """Width and height of what the axes enclose, px."""
        return self.width - self._left - self._right, self.height - self._top - self._bottom

    def px(self, x: ArrayLike) -> FloatArray:
        """Convert data x to picture x."""
        scale = self.inner[0] / (self.x[1] - self.x[0])
        return self._left + (np.asarray(x, dtype=np.float64) - self.x[0]) * scale

    def py(self, y: ArrayLike) -> FloatArray:
        """Convert data y, which grows upwards, to picture y."""
        scale = self.inner[1] / (self.y[1] - self.y[0])
        return self.height - self._bottom - (np.asarray(y, np.float64) - self.y[0]) * scale

    def line(self, x: ArrayLike, y: ArrayLike, series: str, closed: bool = False) -> None:
        """Draw a polyline, broken where a point is not finite (`closed` only when all are)."""
        points = np.column_stack([self.px(x), self.py(y)])
        finite = np.isfinite(points).all(axis=1)
        closed = closed and bool(finite.all())
        for run in np.split(points, np.flatnonzero(~finite)):
            run = run[np.isfinite(run).all(axis=1)]
            if len(run) > 1:
                kind = "polygon" if closed else "polyline"
                self._body.append(f'<{kind} class="line {series}" points="{_format_points(run)}"/>')

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, series: str) -> None:
        """Draw the area between two curves over the same x."""
        edges = np.stack([np.asarray(v, dtype=np.float64) for v in (x, low, high)])
        x, low, high = edges[:, np.isfinite(edges).all(axis=0)]
        across = np.concatenate([self.px(x), self.px(x)[::-1]])
        outline = np.column_stack([across, np.concatenate([self.py(low), self.py(high)[::-1]])])
        self._body.append(f'<polygon class="band {series}" points="{_format_points(outline)}"/>')

    def dots(
        self,
        x: ArrayLike,
        y: ArrayLike,
        series: str,
        radius: float = 3.0,
        titles: Sequence[str] | None = None,
        colours: Sequence[str] | None = None,
    ) -> None:
        """Draw dots; `titles` appear under the pointer, `colours` (CSS) replace the series'."""
        for index, (cx, cy) in enumerate(np.column_stack([self.px(x), self.py(y)])):
            if not (math.isfinite(cx) and math.isfinite(cy)):
                continue
            style = f' style="fill:{colours[index]}"' if colours else ""
            name = f"<title>{escape(titles[index])}</title>" if titles else ""
            disc = f'cx="{cx:.1f}" cy="{cy:.1f}" r="{radius:g}"{style}'
            self._body.append(f'<circle class="dot {series}" {disc}>{name}</circle>')

    def marks(
        self,
        x: ArrayLike,
        y: ArrayLike,
        series: str,
        shape: str,
        radius: float = 3.2,
        titles: Sequence[str] | None = None,
    ) -> None:
        """Draw marks of a shape (see `draw_mark`); `titles` as those of `dots`."""
        for index, (cx, cy) in enumerate(np.column_stack([self.px(x), self.py(y)])):
            if math.isfinite(cx) and math.isfinite(cy):
                title = titles[index] if titles else ""
                self._body.append(draw_mark(cx, cy, series, shape, radius, title))

    def area(self, x: ArrayLike, y: ArrayLike, series: str) -> None:
        """Draw the inside of a closed outline; it lies below lines, dots and words."""
        points = np.column_stack([self.px(x), self.py(y)])
        self._ground.append(f'<polygon class="area {series}" points="{_format_points(points)}"/>')

    def bars(
        self,
        edges: ArrayLike,
        counts: ArrayLike,
        series: str,
        base: ArrayLike = 0.0,
        colours: Sequence[str] | None = None,
        titles: Sequence[str] | None = None,
    ) -> None:
        """Draw a histogram of `counts` between `edges`, on `base`; see `dots` for the others."""
        edges, counts = np.asarray(edges, dtype=np.float64), np.asarray(counts, dtype=np.float64)
        base = np.broadcast_to(np.asarray(base, dtype=np.float64), counts.shape)
        x, low, high = self.px(edges), self.py(base), self.py(base + counts)
        for index, (bottom, top) in enumerate(zip(low, high, strict=True)):
            if bottom - top > 0.0:
                left, right = x[index], x[index + 1]
                gap, seam = (0.0, 0.6) if series == "seamless" else (0.5, 0.0)
                style = f' style="fill:{colours[index]}"' if colours else ""
                name = f"<title>{escape(titles[index])}</title>" if titles else ""
                self._body.append(
                    f'<rect class="bar {series}" x="{left + gap:.1f}" y="{top:.1f}" '
                    f'width="{max(right - left - 2.0 * gap, 0.5) + seam:.1f}" '
                    f'height="{bottom - top:.1f}"'
                    f"{style}>{name}</rect>"
                )

    def level(self, y: float, series: str = "muted") -> None:
        """Draw a line across at height y."""
        self.line(self.x, (y, y), f"{series} thin")

    def picture(self, data_uri: str, kind: str = "") -> None:
        """Draw a picture stretched over all that the axes enclose, below lines, dots and words.

        kind  "pale" for one that is not to distract from what is drawn on it
        """
        self._ground.append(
            f'<image class="{kind}" x="{self._left}" y="{self._top}" width="{self.inner[0]}" '
            f'height="{self.inner[1]}" preserveAspectRatio="none" href="{data_uri}"/>'
        )

    def text(self, x: float, y: float, words: str, kind: str = "", anchor: str = "start") -> None:
        """Draw small words at a place in data units, which is their start, middle or end."""
        self._body.append(
            f'<text class="tick {kind}" text-anchor="{anchor}" x="{float(self.px(x)):.1f}" '
            f'y="{float(self.py(y)):.1f}">{escape(words)}</text>'
        )

    def svg(self, description: str, at: tuple[float, float] | None = None) -> Markup:
        """Return the plot; `description` is read to people who cannot see it.

        at  left and top of its place in a larger drawing
        """
        named = f"{description}{self._x_axis.label}{self._y_axis.label}{self.width}"
        clip = f"c{hash_words(named):x}"
        inner, left, top = self.inner, self._left, self._top
        wide = ' class="wide"' if self.width > HALF else ""
        size = f'width="{self.width}" height="{self.height}"'
        corner = f'x="{at[0]:g}" y="{at[1]:g}" {size} ' if at else ""
        parts = [
            f'<svg {corner}viewBox="0 0 {self.width} {self.height}" role="img"{wide} '
            f'aria-label="{escape(description, quote=True)}">',
            f'<clipPath id="{clip}"><rect x="{left}" y="{top}" width="{inner[0]}" '
            f'height="{inner[1]}"/></clipPath>',
            *(self._draw_ticks() if self._axes else ()),
            f'<g clip-path="url(#{clip})">',
            *self._ground,
            *self._body,
            "</g>",
            f'<rect class="frame" x="{left}" y="{top}" width="{inner[0]}" height="{inner[1]}"/>'
            if left
            else "",
            f'<text class="label" text-anchor="middle" x="{left + inner[0] / 2:.0f}" '
            f'y="{self.height - 6}">{escape(self._x_axis.label)}</text>',
            f'<text class="label" text-anchor="middle" transform="translate(13 '
            f'{top + inner[1] / 2:.0f}) rotate(-90)">{escape(self._y_axis.label)}</text>',
            "</svg>",
        ]
        return Markup("\n".join(parts))

    def _draw_ticks(self) -> Iterable[str]:
        bottom, right = self.height - self._bottom, self.width - self._right
        for position, words in _label_ticks(self._x_axis, self.x, max(3, self.inner[0] // 70)):
            x = float(self.px(position))
            yield f'<line class="grid" x1="{x:.1f}" y1="{self._top}" x2="{x:.1f}" y2="{bottom}"/>'
            foot = f'text-anchor="middle" x="{x:.1f}" y="{bottom + 15}"'
            yield f'<text class="tick" {foot}>{words}</text>'
        for position, words in _label_ticks(self._y_axis, self.y, max(4, self.inner[1] // 45)):
            y = float(self.py(position))
            yield f'<line class="grid" x1="{self._left}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}"/>'
            side = f'text-anchor="end" x="{self._left - 5}" y="{y + 4:.1f}"'
            yield f'<text class="tick" {side}>{words}</text>'


def _label_ticks(axis: PlotAxis, ends: tuple[float, float], count: int) -> list[tuple[float, str]]:
    """Label an axis' ticks between its ends: positions, and what is written beside them."""
    if len(axis.numbers):
        places = np.log10(axis.numbers) if axis.log else axis.numbers
        return [(float(x), format_number(v)) for x, v in zip(places, axis.numbers, strict=True)]
    if axis.log:
        return [
            (position, format_log_number(number)) for position, number in choose_log_ticks(*ends)
        ]
    return [(value, format_number(value)) for value in choose_ticks(*ends, count=count)]


def find_span(values: ArrayLike, margin: float = 0.05) -> tuple[float, float]:
    """Find the range of the finite values, widened by a share of it; (0, 1) for none."""
    finite = np.asarray(values, dtype=np.float64).ravel()
    finite = finite[np.abs(finite) < MOST]  # not of NaN
    if finite.size == 0:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    return low - margin * (high - low), high + margin * (high - low)


def hash_words(words: str) -> int:
    """Hash words to a number that is the same in every process, unlike `hash`."""
    return reduce(lambda number, byte: (number * 131 + byte) & 0xFFFFFFFF, words.encode(), 0)


def _open_range(ends: tuple[float, float]) -> tuple[float, float]:
    low, high = (float(v) for v in ends)
    if high > low:
        return low, high
    half = abs(low) * 0.1 or 1.0
    return low - half, low + half


def _format_points(places: FloatArray) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
