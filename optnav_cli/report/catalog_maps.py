"""Maps of a catalog's cells: which points are usable and why others are not, values, sources."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catalog.arrays import BoolArray, ByteArray, FloatArray, Int32Array, IntArray
from catalog.control_point import Flag
from catalog.store.reader import Catalog
from optnav_cli.report.page import data_uri, figure, grouped, legend
from optnav_cli.report.relief import GRAY, relief
from optnav_cli.report.shades import (
    OTHER,
    REASON_COLOURS,
    SOURCE_COLOURS,
    USABLE,
    Scale,
    bgr_of,
    blended,
)
from optnav_cli.report.svg import Plot
from optnav_cli.report.views import View, rows_of_pixels, views

MAX_DOTS = 1500  # more points are shown by their cells instead of one by one
TINT, STRONG_TINT, SOLID = 105, 205, 255  # of 255, over the relief
# In the order in which the checks run: a point is shown by the first that it fails.
REASONS = {
    Flag.NO_DATA: "a patch has holes",
    Flag.FLAT: "too flat to be located",
    Flag.NOT_UNIQUE: "a rival nearby looks too much alike",
    Flag.SHADOWED: "foreign shadows at most Suns",
    Flag.NOT_RECOGNISED: "recognition trials failed",
    Flag.CROWDED: "too near to a neighbour's point",
    Flag.OVERHANG: "ground hangs over its patch",
}
UNTOLD = "no reason given"
# By the kinds that `first_reasons` tells.
POINT_COLOURS = (USABLE, *REASON_COLOURS, OTHER)
POINT_WORDS = ("usable", *REASONS.values(), UNTOLD)
NO_SOURCE = "none: no ground at the point"


@dataclass(frozen=True, eq=False)
class Panel:
    """A map together with the row of the point whose cell each of its pixels is in."""

    view: View
    lat_deg: FloatArray
    lon_deg: FloatArray
    rows: Int32Array  # (h, w), -1 for no point

    def painted(self, colours: ByteArray) -> ByteArray:
        """Picture (h, w, 4) of the points' colours (n, 4); clear where there is no point."""
        clear = np.zeros((1, 4), np.uint8)
        return np.asarray(np.concatenate([colours, clear])[self.rows], np.uint8)

    def plot(self, *pictures: str) -> Plot:
        """A drawing of the map with pictures (data addresses) of its pixels on it."""
        plot = self.view.plot()
        if self.view.outline is not None:
            plot.area(self.view.outline[0], self.view.outline[1], "ground")
        for picture in pictures:
            plot.picture(picture)
        return plot


def panels(catalog: Catalog) -> list[Panel]:
    """The maps of a catalog with at least one point, the main one first."""
    found = []
    for view in views(
        catalog.grid, catalog.ids, catalog.lat_deg, catalog.lon_deg, catalog.meta.radius_m
    ):
        lat, lon = view.pixels()
        rows = rows_of_pixels(catalog.grid, catalog.ids, lat, lon)
        found.append(Panel(view, lat, lon, rows))
    return found


def first_reasons(catalog: Catalog) -> IntArray:
    """For each point 0 where it is usable, or 1 + the place in REASONS of its first failed check.

    A point without any known flag gets 1 + len(REASONS).
    """
    flags = catalog.records["flags"].astype(np.int64)
    kinds = np.full(len(catalog), 1 + len(REASONS), np.int64)
    for number, flag in reversed(list(enumerate(REASONS))):
        kinds[(flags & int(flag)) != 0] = 1 + number
    kinds[catalog.usable] = 0
    return kinds


def usable_map(catalog: Catalog, maps: Sequence[Panel], beside: str) -> str:
    """Usable points and why others are not, on shaded relief; with a drawing beside the caps."""
    kinds = first_reasons(catalog)
    colours, words = POINT_COLOURS, POINT_WORDS
    whole = maps[0].view.whole
    dots = not whole and len(catalog) <= MAX_DOTS
    strength = np.where(kinds == 0, TINT, STRONG_TINT)
    tints = _bgra([colours[kind] for kind in kinds.tolist()], strength)
    drawings, whose = [], ""
    for panel in maps if whole else maps[:1]:
        ground = relief(catalog, panel.lat_deg, panel.lon_deg)
        pictures = []
        if ground is not None:
            gray, known, whose = ground
            pictures.append(data_uri(_with_edge(gray, known)))
        if not dots:
            pictures.append(data_uri(panel.painted(tints)))
        plot = panel.plot(*pictures)
        if dots:
            _dots(plot, panel.view, catalog, kinds)
        drawings.append(plot.svg(f"Map of usable control points: {panel.view.name}"))
    present = [k for k in range(len(words)) if (kinds == k).any()]
    shown = list(colours)
    if not dots:  # as they look on the relief
        shares = [TINT / SOLID] + [STRONG_TINT / SOLID] * (len(colours) - 1)
        shown = [blended(c, share, GRAY) for c, share in zip(colours, shares, strict=True)]
    keys = legend([(shown[k], f"{words[k]}: {grouped(int((kinds == k).sum()))}") for k in present])
    shape = "a dot a point" if dots else "a tile a cell"
    first = "" if len(present) < 2 else " A point is coloured by the first check that it failed."
    if whole:
        drawings.append(beside)
    return figure(
        _arranged(drawings, whole) if whole else drawings[0],
        f"Where the points are, {shape}.{first} {whose}",
        extra=keys,
    )


def value_map(
    catalog: Catalog,
    maps: Sequence[Panel],
    values: FloatArray,
    scale: Scale,
    name: str,
    histogram: str,
    caption: str,
) -> str:
    """Cells coloured by a value (n,) of their points, with the histogram that is their legend."""
    known = np.isfinite(values)
    colours = np.zeros((len(values), 4), np.uint8)
    colours[:, :3] = bgr_of(OTHER)
    colours[known, :3] = scale.bgr(values[known])
    colours[:, 3] = SOLID
    whole = maps[0].view.whole
    drawings = [
        panel.plot(data_uri(panel.painted(colours))).svg(f"Map of {name}: {panel.view.name}")
        for panel in (maps if whole else maps[1:])
    ]
    unknown = (
        legend([(OTHER, f"not known: {grouped(int((~known).sum()))}")]) if not known.all() else ""
    )
    return figure(_arranged([*drawings, histogram], whole), caption, extra=unknown)


def source_map(catalog: Catalog, maps: Sequence[Panel], beside: str) -> str:
    """Which terrain model each point comes from; with HTML beside the small maps."""
    sources = catalog.records["source"].astype(np.int64)
    names = catalog.meta.point_sources
    colours = [SOURCE_COLOURS[k % len(SOURCE_COLOURS)] for k in range(len(names))]
    painted = _bgra([colours[k] for k in sources.tolist()], np.full(len(sources), SOLID))
    whole = maps[0].view.whole
    drawings = [
        panel.plot(data_uri(panel.painted(painted))).svg(f"Map of sources: {panel.view.name}")
        for panel in (maps if whole else maps[1:])
    ]
    keys = legend([(c, name or NO_SOURCE) for c, name in zip(colours, names, strict=True)])
    return figure(_arranged([*drawings, beside], whole), "Terrain model of each point.", extra=keys)


def _arranged(drawings: Sequence[str], whole: bool) -> str:
    """A main map across the page with the rest in a row below it, or all in pairs."""
    if not whole:
        return f'<div class="pair">{"".join(drawings)}</div>'
    return f'{drawings[0]}<div class="triple">{"".join(drawings[1:])}</div>'


def titles_of(catalog: Catalog, kinds: IntArray) -> list[str]:
    """What is told of each point under the pointer; kinds (n,) as `first_reasons` tells them."""
    scores = catalog.records["localisation_px"]
    return [
        f"{point}: {POINT_WORDS[kind]}, predicted error {score:.2f} nodes"
        for point, kind, score in zip(catalog.ids.tolist(), kinds.tolist(), scores, strict=True)
    ]


def _dots(plot: Plot, view: View, catalog: Catalog, kinds: IntArray) -> None:
    x, y = view.places(catalog.lat_deg, catalog.lon_deg)
    colours = [POINT_COLOURS[kind] for kind in kinds.tolist()]
    radius = float(np.clip(120.0 / np.sqrt(len(x)), 3.0, 6.5))
    plot.dots(x, y, "ringed", radius, titles_of(catalog, kinds), colours)


def _bgra(colours: Sequence[str], strength: IntArray) -> ByteArray:
    table = {colour: bgr_of(colour) for colour in set(colours)}
    bgr = np.array([table[colour] for colour in colours], np.uint8).reshape(-1, 3)
    return np.column_stack([bgr, strength.astype(np.uint8)])


def _with_edge(gray: ByteArray, known: BoolArray) -> ByteArray:
    """A gray picture that is clear where no ground is known."""
    if known.all():
        return gray
    alpha = np.where(known, SOLID, 0).astype(np.uint8)
    return np.dstack([np.where(known, gray, 0)] * 3 + [alpha]).astype(np.uint8)
