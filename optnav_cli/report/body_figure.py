"""The points of a small body on its six sides: a figure of a page, and a picture by itself."""

from collections.abc import Sequence

import cv2
import numpy as np

from catalog.arrays import ByteArray, FloatArray, IntArray
from catalog.store.reader import Catalog
from optnav_cli.output.canvas import FONT, SUBPIXEL_BITS
from optnav_cli.report.body_sides import Side, sides
from optnav_cli.report.catalog_maps import POINT_COLOURS, POINT_WORDS, first_reasons, titles_of
from optnav_cli.report.page import counted, data_uri, figure, grouped, legend
from optnav_cli.report.shades import bgr_of
from optnav_cli.report.svg import Plot
from optnav_cli.report.views import THIRD

COLUMNS = 3
SIDE_PX = 400
GAP_PX, HEAD_PX, ROW_PX = 8, 34, 22
SHARPNESS = 1.5  # pixels of a page's picture a unit of its drawing
PAPER, INK, SOFT, RIM = (250, 250, 250), (40, 40, 40), (235, 235, 235), (28, 21, 16)
LINE = (255, 255, 255)
LINE_STRENGTH = 0.35
DOT_PX = 4.5
BAR_SHARE = 0.25  # of a side's width that a scale bar has at most


def sides_figure(catalog: Catalog) -> str:
    """HTML of the six sides with their points. Raises as `sides` does."""
    kinds = first_reasons(catalog)
    colours = [POINT_COLOURS[kind] for kind in kinds.tolist()]
    drawings = []
    for side in sides(catalog, round(SHARPNESS * THIRD)):
        half = side.half_m / 1e3
        ends = (-half, half)
        plot = Plot(ends, ends, width=THIRD, height=THIRD, axes=False, margins=(0, 0, 0, 0))
        plot.picture(data_uri(side.gray))
        for line in side.lines:
            plot.line(line[:, 0] / 1e3, line[:, 1] / 1e3, "graticule")
        x, y = side.places.T / 1e3
        plot.dots(x, y, "ringed", 3.6, titles_of(catalog, kinds), colours)
        plot.text(-0.97 * half, 0.91 * half, side.name, "halo")
        bar = _bar_km(side)
        plot.line((0.95 * half - bar, 0.95 * half), (-0.95 * half, -0.95 * half), "scale")
        plot.text(0.95 * half, -0.91 * half, f"{bar:g} km", "halo", "end")
        drawings.append(plot.svg(f"Control points seen from {side.name}"))
    keys = legend(_entries(kinds))
    return figure(
        f'<div class="triple">{"".join(drawings)}</div>',
        "Where the points are, on the relief that the catalog carries; lines every 30°. A point is "
        "coloured by the first check that it failed.",
        extra=keys,
    )


def sides_picture(catalog: Catalog) -> ByteArray:
    """The six sides with their points, a scale and a legend, (h, w, 3) blue, green, red.

    Raises as `sides` does.
    """
    kinds = first_reasons(catalog)
    tiles = [_tile(side, kinds) for side in sides(catalog, SIDE_PX)]
    rows = [_joined(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
    width = rows[0].shape[1]
    head = np.full((HEAD_PX, width, 3), PAPER, np.uint8)
    usable = int(np.count_nonzero(catalog.usable))
    words = (
        f"{catalog.meta.body}: {catalog.path.name}, {counted(len(catalog), 'control point')}, "
        f"{usable} usable"
    )
    _write(head, words, GAP_PX, 22, INK, 0.55)
    return np.vstack([head, *rows, _legend(width, kinds)])


def _entries(kinds: IntArray) -> list[tuple[str, str]]:
    present = [k for k in range(len(POINT_WORDS)) if (kinds == k).any()]
    return [
        (POINT_COLOURS[k], f"{POINT_WORDS[k]}: {grouped(int((kinds == k).sum()))}") for k in present
    ]


def _tile(side: Side, kinds: IntArray) -> ByteArray:
    bare: ByteArray = np.repeat(side.gray[..., None], 3, axis=2)
    lined = bare.copy()
    for line in side.lines:
        _polyline(lined, _pixels(line, side), LINE, 1)
    mixed = cv2.addWeighted(lined, LINE_STRENGTH, bare, 1.0 - LINE_STRENGTH, 0.0)
    tile = np.asarray(mixed, np.uint8)
    for (x, y), kind in zip(_pixels(side.places, side), kinds.tolist(), strict=True):
        if np.isfinite(x):
            _dot(tile, x, y, POINT_COLOURS[kind])
    _write(tile, side.name, 10, 20, SOFT)
    bar = _bar_km(side)
    across = bar * 1e3 / (2.0 * side.half_m) * SIDE_PX
    end, foot = SIDE_PX - 12.0, SIDE_PX - 14.0
    _polyline(tile, np.array([[end - across, foot], [end, foot]]), SOFT, 2)
    _write(tile, f"{bar:g} km", round(end - across), SIDE_PX - 22, SOFT)
    return tile


def _bar_km(side: Side) -> float:
    """The longest round length that a scale bar has room for."""
    most = BAR_SHARE * 2.0 * side.half_m / 1e3
    unit = 10.0 ** np.floor(np.log10(most))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * unit <= most) * unit)


def _pixels(places: FloatArray, side: Side) -> FloatArray:
    """Picture x, y (n, 2) of places (n, 2) m right and up of the middle."""
    scale = SIDE_PX / (2.0 * side.half_m)
    middle = (SIDE_PX - 1) / 2.0
    return np.column_stack([middle + scale * places[:, 0], middle - scale * places[:, 1]])


def _polyline(
    picture: ByteArray, points: FloatArray, colour: tuple[int, int, int], width: int
) -> None:
    """A line through points (n, 2) px, broken where one is not finite."""
    for run in np.split(points, np.flatnonzero(~np.isfinite(points[:, 0]))):
        run = run[np.isfinite(run[:, 0])]
        fixed = np.rint(run * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.polylines(picture, [fixed], False, colour, width, cv2.LINE_AA, SUBPIXEL_BITS)


def _dot(picture: ByteArray, x: float, y: float, colour: str) -> None:
    at = round(x * 2**SUBPIXEL_BITS), round(y * 2**SUBPIXEL_BITS)
    for radius, shade in ((DOT_PX, RIM), (DOT_PX - 1.1, bgr_of(colour))):
        fixed = round(radius * 2**SUBPIXEL_BITS)
        cv2.circle(picture, at, fixed, shade, -1, cv2.LINE_AA, SUBPIXEL_BITS)


def _joined(tiles: Sequence[ByteArray]) -> ByteArray:
    """Tiles in a row on paper, with gaps about them."""
    edged = [
        cv2.copyMakeBorder(tile, 0, GAP_PX, GAP_PX if k == 0 else 0, GAP_PX, cv2.BORDER_CONSTANT,
                           value=PAPER)
        for k, tile in enumerate(tiles)
    ]  # fmt: skip
    return np.hstack([np.asarray(tile, np.uint8) for tile in edged])


def _legend(width: int, kinds: IntArray) -> ByteArray:
    """What the dots mean, in columns as wide as the sides."""
    entries = _entries(kinds)
    column = SIDE_PX + GAP_PX
    strip = np.full((ROW_PX * -(-len(entries) // COLUMNS) + 6, width, 3), PAPER, np.uint8)
    for number, (colour, words) in enumerate(entries):
        row, place = divmod(number, COLUMNS)
        x, y = GAP_PX + column * place, ROW_PX * row + 16
        _dot(strip, x + 6.0, y - 4.5, colour)
        words = words.encode("ascii", "replace").decode("ascii")  # the font has nothing else
        _write(strip, words, x + 18, y, INK)
    return strip


def _write(
    picture: ByteArray, words: str, x: int, y: int, colour: tuple[int, int, int], size: float = 0.45
) -> None:
    cv2.putText(picture, words, (x, y), FONT, size, colour, 1, cv2.LINE_AA)
