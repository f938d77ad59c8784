"""Maps and histograms of a catalog: usable points, reasons against the others, values, sources."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from markupsafe import Markup

from catalog.arrays import BoolArray, ByteArray, FloatArray, Int32Array, IntArray
from catalog.control_point import FLAG_MEANINGS, SHADOW_AZIMUTHS
from catalog.store.reader import Catalog
from optnav_cli.report.page import encode_picture_uri, figure, format_count, legend, side_by_side
from optnav_cli.report.relief import GRAY, find_relief
from optnav_cli.report.svg import HALF, WIDE, Plot, PlotAxis
from optnav_cli.report.views import (
    OTHER,
    REASON_COLOURS,
    SOURCE_COLOURS,
    THIRD,
    USABLE,
    MapView,
    Scale,
    blend,
    choose_views,
    find_rows,
    parse_colour,
)

MAX_DOTS = 1500  # more points are shown by their cells instead of one by one
TINT, STRONG_TINT, SOLID = 105, 205, 255  # of 255, over the relief
# In the order in which the checks run: a point is shown by the first that it fails.
REASONS = tuple(FLAG_MEANINGS)
NO_REASON = "no reason given"
# By the kinds of `first_reasons`.
POINT_COLOURS = (USABLE, *REASON_COLOURS, OTHER)
POINT_WORDS = ("usable", *(flag.label for flag in REASONS), NO_REASON)
NO_SOURCE = "none: no ground at the point"
BINS = 32
BAND_DEG = 10.0
MIN_TOP = 5.0  # of a histogram, so that its ticks are whole numbers
HALF_HEIGHT = 330
STRIP = 0.05  # height of the colour bar, share of the histogram's
MAX_EXACT_TRIALS = 24  # rates of so many trials have a bar each


@dataclass(frozen=True, eq=False)
class MapPanel:
    """A map together with the row of the point whose cell each of its pixels is in."""

    view: MapView
    lat_deg: FloatArray
    lon_deg: FloatArray
    rows: Int32Array  # (h, w), -1 for no point

    def paint(self, colours: ByteArray) -> ByteArray:
        """Paint a picture (h, w, 4) in the points' colours (n, 4); clear where no point is."""
        return np.concatenate([colours, np.zeros((1, 4), np.uint8)])[self.rows]

    def plot(self, *pictures: str) -> Plot:
        """Draw the map with pictures (data addresses) of its pixels on it."""
        plot = self.view.plot()
        if self.view.outline is not None:
            plot.area(self.view.outline[0], self.view.outline[1], "ground")
        for picture in pictures:
            plot.picture(picture)
        return plot


def list_panels(catalog: Catalog) -> list[MapPanel]:
    """List the maps of a catalog with at least one point, the main one first."""
    grid, ids = catalog.grid, catalog.ids
    shown = choose_views(grid, ids, catalog.lat_deg, catalog.lon_deg, catalog.meta.radius_m)
    places = [view.pixels() for view in shown]
    return [
        MapPanel(view, lat, lon, find_rows(grid, ids, lat, lon))
        for view, (lat, lon) in zip(shown, places, strict=True)
    ]


def find_first_reasons(catalog: Catalog) -> IntArray:
    """Find for each point 0 if usable, else 1 + the place in REASONS of its first failed check.

    A point without any known flag gets 1 + len(REASONS).
    """
    flags = catalog.records["flags"].astype(np.int64)
    kinds = np.full(len(catalog), 1 + len(REASONS), np.int64)
    for number, flag in reversed(list(enumerate(REASONS))):
        kinds[(flags & int(flag)) != 0] = 1 + number
    kinds[catalog.usable] = 0
    return kinds


def list_legend_entries(
    kinds: IntArray, colours: Sequence[str] = POINT_COLOURS
) -> list[tuple[str, str]]:
    """List colours and words, with their number, of the kinds (n,) that occur."""
    counts = np.bincount(kinds, minlength=len(POINT_WORDS)).tolist()
    entries = zip(colours, POINT_WORDS, counts, strict=True)
    return [
        (colour, f"{words}: {format_count(count)}") for colour, words, count in entries if count
    ]


def draw_usable_map(catalog: Catalog, maps: Sequence[MapPanel], beside: Markup) -> Markup:
    """Draw usable points and why others are not, on shaded relief; a drawing stands beside caps."""
    kinds = find_first_reasons(catalog)
    colours: Sequence[str] = POINT_COLOURS
    of_body = maps[0].view.of_body
    dots = not of_body and len(catalog) <= MAX_DOTS
    strength = np.where(kinds == 0, TINT, STRONG_TINT)
    by_kind = [colours[kind] for kind in kinds.tolist()]
    tints = _stack_colours(by_kind, strength)
    drawings, whose = [], ""
    for panel in maps if of_body else maps[:1]:
        ground = find_relief(catalog, panel.lat_deg, panel.lon_deg)
        pictures = []
        if ground is not None:
            gray, known, whose = ground
            pictures.append(encode_picture_uri(_mask_unknown(gray, known)))
        if not dots:
            pictures.append(encode_picture_uri(panel.paint(tints)))
        plot = panel.plot(*pictures)
        if dots:
            x, y = panel.view.places(catalog.lat_deg, catalog.lon_deg)
            radius = float(np.clip(120.0 / np.sqrt(len(x)), 3.0, 6.5))
            plot.dots(x, y, "ringed", radius, list_titles(catalog, kinds), by_kind)
        drawings.append(plot.svg(f"Map of usable control points: {panel.view.name}"))
    if not dots:  # as they look on the relief
        shares = [TINT / SOLID] + [STRONG_TINT / SOLID] * (len(colours) - 1)
        colours = [blend(c, share, GRAY) for c, share in zip(colours, shares, strict=True)]
    entries = list_legend_entries(kinds, colours)
    shape = "a dot a point" if dots else "a tile a cell"
    first = "" if len(entries) < 2 else " A point is coloured by the first check that it failed."
    if of_body:
        drawings.append(beside)
    drawn = _arrange(drawings, of_body) if of_body else drawings[0]
    words = f"Where the points are, {shape}.{first} {whose}"
    return figure(drawn, words, extra=legend(entries))


def draw_value_map(
    maps: Sequence[MapPanel],
    values: FloatArray,
    scale: Scale,
    name: str,
    histogram: Markup,
    caption: str,
) -> Markup:
    """Draw cells coloured by a value (n,) of their points; the histogram is the legend."""
    known = np.isfinite(values)
    colours = np.zeros((len(values), 4), np.uint8)
    colours[:, :3] = parse_colour(OTHER)
    colours[known, :3] = scale.bgr(values[known])
    colours[:, 3] = SOLID
    unknown = Markup()
    if not known.all():
        unknown = legend([(OTHER, f"not known: {format_count(int((~known).sum()))}")])
    return figure(_draw_coloured_maps(maps, colours, name, histogram), caption, extra=unknown)


def draw_source_map(catalog: Catalog, maps: Sequence[MapPanel], beside: Markup) -> Markup:
    """Draw which terrain model each point comes from; with HTML beside the small maps."""
    sources = catalog.records["source"].astype(np.int64)
    names = catalog.meta.point_sources
    colours = [SOURCE_COLOURS[k % len(SOURCE_COLOURS)] for k in range(len(names))]
    painted = _stack_colours([colours[k] for k in sources.tolist()], np.full(len(sources), SOLID))
    keys = legend([(c, name or NO_SOURCE) for c, name in zip(colours, names, strict=True)])
    drawn = _draw_coloured_maps(maps, painted, "sources", beside)
    return figure(drawn, "Terrain model of each point.", extra=keys)


def draw_shift_map(catalog: Catalog, maps: Sequence[MapPanel]) -> Markup:
    """Draw enlarged shifts of the points in the comparison model, a line from each point."""
    rows = [row for row, number in enumerate(catalog.ids.tolist()) if number in catalog.shifts]
    rows = rows[:: max(1, -(-len(rows) // MAX_DOTS))]
    shifts = [catalog.shifts[number] for number in catalog.ids[rows].tolist()]
    moved = np.array([(s.east_m, s.north_m) for s in shifts]).reshape(-1, 2)
    known = np.isfinite(moved).all(axis=1)
    moved, lat, lon = moved[known], catalog.lat_deg[rows][known], catalog.lon_deg[rows][known]
    lengths = np.linalg.norm(moved, axis=1)
    if not lengths.any():
        return Markup()
    # nine of ten lines are no longer than a cell is wide
    scale = catalog.meta.cell_deg / float(np.percentile(lengths[lengths > 0.0], 90.0))
    to_lat = np.clip(lat + scale * moved[:, 1], -90.0, 90.0)
    to_lon = lon + scale * moved[:, 0] / np.maximum(np.cos(np.radians(lat)), 0.01)
    view = maps[0].view
    plot = maps[0].plot()
    x, y = view.places(lat, lon)
    for x0, y0, x1, y1 in zip(x, y, *view.places(to_lat, to_lon), strict=True):
        plot.line([x0, x1], [y0, y1], "s2")
    plot.dots(x, y, "s1", 2.0)
    times = round(np.radians(scale) * catalog.meta.radius_m)
    words = f"Shifts of the points in the comparison model, {format_count(times)} times enlarged."
    return figure(plot.svg("Map of shifts in the comparison model"), words)


def _draw_coloured_maps(
    maps: Sequence[MapPanel], colours: ByteArray, name: str, beside: Markup
) -> Markup:
    """Draw all maps of a body, or the small one, in the points' colours (n, 4)."""
    of_body = maps[0].view.of_body
    drawings = [
        panel.plot(encode_picture_uri(panel.paint(colours))).svg(
            f"Map of {name}: {panel.view.name}"
        )
        for panel in (maps if of_body else maps[1:])
    ]
    return _arrange([*drawings, beside], of_body)


def _arrange(drawings: Sequence[Markup], of_body: bool) -> Markup:
    """Arrange a main map across the page with the others in a row below it, or all in pairs."""
    if not of_body:
        return side_by_side("pair", drawings)
    return drawings[0] + side_by_side("triple", drawings[1:])


def list_titles(catalog: Catalog, kinds: IntArray) -> list[str]:
    """List what the pointer shows of each point; kinds (n,) of `find_first_reasons`."""
    scores = catalog.records["localisation_nodes"]
    return [
        f"{point}: {POINT_WORDS[kind]}, predicted error {score:.2f} nodes"
        for point, kind, score in zip(catalog.ids.tolist(), kinds.tolist(), scores, strict=True)
    ]


def _stack_colours(colours: Sequence[str], strength: IntArray) -> ByteArray:
    table = {colour: parse_colour(colour) for colour in set(colours)}
    bgr = np.array([table[colour] for colour in colours], np.uint8).reshape(-1, 3)
    return np.column_stack([bgr, strength.astype(np.uint8)])


def _mask_unknown(gray: ByteArray, known: BoolArray) -> ByteArray:
    """Mask a gray picture where no ground is known."""
    if known.all():
        return gray
    alpha = np.where(known, SOLID, 0).astype(np.uint8)
    return np.dstack([np.where(known, gray, 0)] * 3 + [alpha]).astype(np.uint8)


def draw_histogram(
    values: FloatArray,
    usable: BoolArray,
    scale: Scale,
    edges: FloatArray,
    name: str,
    label: str,
    wide: bool,
) -> Markup:
    """Draw how many points have which value, in the colours of the map, over its colour bar.

    Usable points are coloured, the others stand on them in gray. Values beyond the edges are
    counted in the outermost bars.

    values  (n,)  not finite where unknown
    """
    known = np.isfinite(values)
    inside = np.clip(values, edges[0], edges[-1])
    good, bad = (np.histogram(inside[known & choice], edges)[0] for choice in (usable, ~usable))
    top = 1.08 * max(float((good + bad).max()), MIN_TOP)
    width, height = (THIRD, THIRD) if wide else (HALF, HALF_HEIGHT)
    along = scale.map_to_axis(edges)
    x = PlotAxis((float(along[0]), float(along[-1])), label, scale.log)
    plot = Plot(x, PlotAxis((-STRIP * top, top), "points"), width=width, height=height)
    colours = scale.css((along[:-1] + along[1:]) / 2.0)
    spans = [f"{low:.3g} to {high:.3g}" for low, high in pairwise(edges.tolist())]
    plot.bars(along, good, "full", 0.0, colours, _list_bar_titles(spans, good, "usable"))
    plot.bars(along, bad, "muted", good, None, _list_bar_titles(spans, bad, "not usable"))
    bar = np.linspace(along[0], along[-1], 65)
    strip = np.full(64, STRIP * top)
    plot.bars(bar, strip, "seamless", -STRIP * top, scale.css((bar[:-1] + bar[1:]) / 2.0))
    if (known & usable).any():
        middle = float(np.median(values[known & usable]))
        if edges[0] <= middle <= edges[-1]:
            middle_x = float(scale.map_to_axis(np.array(middle)))
            plot.line((middle_x, middle_x), (0.0, top), "median")
    return plot.svg(f"Histogram of {name}")


def plot_latitudes(catalog: Catalog) -> Markup:
    """Plot the share of usable points by latitude."""
    edges = np.linspace(-90.0, 90.0, round(180.0 / BAND_DEG) + 1)
    latitudes = (catalog.lat_deg, catalog.lat_deg[catalog.usable])
    total, good = (np.histogram(lat_deg, edges)[0] for lat_deg in latitudes)
    x, y = PlotAxis((-90.0, 90.0), "latitude, deg"), PlotAxis((0.0, 100.0), "usable points, %")
    plot = Plot(x, y, width=THIRD, height=THIRD)
    share = 100.0 * good / np.maximum(total, 1)
    titles = [f"{g} of {n} usable" for g, n in zip(good.tolist(), total.tolist(), strict=True)]
    plot.bars(edges, share, "s1", titles=titles)
    return plot.svg("Share of usable points by latitude")


def compute_edges(scale: Scale) -> FloatArray:
    """Compute bars over the range of a scale."""
    space = np.geomspace if scale.log else np.linspace
    return space(scale.low, scale.high, BINS + 1)


def compute_rate_edges(trials: IntArray) -> FloatArray:
    """Compute bars for success rates: one per possible rate if all points had as many trials."""
    numbers = np.unique(trials[trials > 0])
    steps = min(int(numbers[0]), MAX_EXACT_TRIALS) if len(numbers) == 1 else 20
    return (np.arange(steps + 2) - 0.5) / steps


def describe_spread(values: FloatArray, usable: BoolArray, form: str) -> str:
    """Describe median and spread of the usable points' values, "" without any."""
    known = values[usable & np.isfinite(values)]
    if known.size == 0:
        return ""
    low, middle, high = (format(v, form) for v in np.percentile(known, [10.0, 50.0, 90.0]))
    return f"Usable points: median {middle}, 80 % between {low} and {high}."


def describe_values_beyond(values: FloatArray, edges: FloatArray) -> str:
    """Describe how many values beyond them the outermost bars hold, "" for none."""
    words = []
    for beyond, end in ((values < edges[0], "below"), (values > edges[-1], "above")):
        if beyond.any():
            far = values[beyond].min() if end == "below" else values[beyond].max()
            words.append(f"{int(beyond.sum())} {end} the axis (to {far:.3g})")
    return f"The outermost bars also hold {' and '.join(words)}." if words else ""


def plot_shadow_limits(catalog: Catalog) -> Markup:
    """Plot the Sun's elevation above which no foreign shadow reaches a patch, by azimuth."""
    chosen = catalog.usable if catalog.usable.any() else np.ones(len(catalog), np.bool_)
    limits = np.asarray(catalog.records["shadow_limit_deg"][chosen], np.float64)
    azimuth = np.arange(SHADOW_AZIMUTHS + 1) * 360.0 / SHADOW_AZIMUTHS
    limits = np.column_stack([limits, limits[:, :1]])
    known = limits[np.isfinite(limits).all(axis=1)]
    if len(known) == 0:
        return Markup()
    lowest, low, middle, high, highest = np.percentile(known, [1, 10, 50, 90, 99], axis=0)
    y = (min(0.0, float(lowest.min())), 1.08 * float(highest.max()) + 0.1)
    x_axis = PlotAxis((0.0, 360.0), "azimuth of the Sun, deg east of north")
    plot = Plot(x_axis, PlotAxis(y, "Sun elevation, deg"), width=WIDE)
    plot.band(azimuth, lowest, highest, "s1")
    plot.band(azimuth, low, high, "s1")
    plot.line(azimuth, middle, "s1")
    whose = "usable points" if catalog.usable.any() else "points"
    return figure(
        plot.svg("Shadow limits by azimuth of the Sun"),
        f"By azimuth: median of the {len(known)} {whose} with a known skyline, and the bands that "
        "hold 80 % and 98 % of them.",
    )


def _list_bar_titles(spans: list[str], counts: IntArray, what: str) -> list[str]:
    return [f"{span}: {count} {what}" for span, count in zip(spans, counts.tolist(), strict=True)]
