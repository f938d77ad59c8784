"""Histograms of a catalog's values, and the limits of shadows by azimuth."""

from itertools import pairwise

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.control_point import SHADOW_AZIMUTHS
from catalog.store.reader import Catalog
from optnav_cli.report.page import figure
from optnav_cli.report.shades import Scale
from optnav_cli.report.svg import HALF, WIDE, Plot
from optnav_cli.report.views import THIRD

BINS = 32
BAND_DEG = 10.0
MIN_TOP = 5.0  # of a histogram, so that its ticks are whole numbers
HALF_HEIGHT = 330
STRIP = 0.05  # height of the colour bar, share of the histogram's
MAX_EXACT_TRIALS = 24  # rates of so many trials have a bar each


def histogram(
    values: FloatArray,
    usable: BoolArray,
    scale: Scale,
    edges: FloatArray,
    name: str,
    label: str,
    wide: bool,
) -> str:
    """How many points have which value, in the colours of the map, over its colour bar.

    Usable points are coloured, the others stand on them in gray. Values beyond the edges are
    counted in the outermost bars.

    values  (n,)  not finite where unknown
    """
    known = np.isfinite(values)
    inside = np.clip(values, edges[0], edges[-1])
    good, bad = (np.histogram(inside[known & choice], edges)[0] for choice in (usable, ~usable))
    top = 1.08 * max(float((good + bad).max()), MIN_TOP)
    width, height = (THIRD, THIRD) if wide else (HALF, HALF_HEIGHT)
    along = scale.along(edges)
    plot = Plot(
        (float(along[0]), float(along[-1])), (-STRIP * top, top), x_label=label, y_label="points",
        width=width, height=height, log_x=scale.log,
    )  # fmt: skip
    colours = scale.css((along[:-1] + along[1:]) / 2.0)
    spans = [f"{low:.3g} to {high:.3g}" for low, high in pairwise(edges.tolist())]
    plot.bars(along, good, "full", 0.0, colours, _titles(spans, good, "usable"))
    plot.bars(along, bad, "muted", good, None, _titles(spans, bad, "not usable"))
    bar = np.linspace(along[0], along[-1], 65)
    strip = np.full(64, STRIP * top)
    plot.bars(bar, strip, "seamless", -STRIP * top, scale.css((bar[:-1] + bar[1:]) / 2.0))
    if (known & usable).any():
        middle = float(np.median(values[known & usable]))
        if edges[0] <= middle <= edges[-1]:
            place = float(scale.along(np.array(middle)))
            plot.line((place, place), (0.0, top), "median")
    return plot.svg(f"Histogram of {name}")


def latitude_plot(catalog: Catalog) -> str:
    """Share of usable points by latitude."""
    edges = np.linspace(-90.0, 90.0, round(180.0 / BAND_DEG) + 1)
    total, good = (
        np.histogram(catalog.lat_deg[choice], edges)[0]
        for choice in (np.ones(len(catalog), np.bool_), catalog.usable)
    )
    plot = Plot(
        (-90.0, 90.0), (0.0, 100.0), x_label="latitude, deg", y_label="usable points, %",
        width=THIRD, height=THIRD,
    )  # fmt: skip
    share = 100.0 * good / np.maximum(total, 1)
    titles = [f"{g} of {n} usable" for g, n in zip(good.tolist(), total.tolist(), strict=True)]
    plot.bars(edges, share, "s1", titles=titles)
    return plot.svg("Share of usable points by latitude")


def edges_of(scale: Scale) -> FloatArray:
    """Bars over the range of a scale."""
    space = np.geomspace if scale.log else np.linspace
    return np.asarray(space(scale.low, scale.high, BINS + 1))


def rate_edges(trials: IntArray) -> FloatArray:
    """Bars for success rates: one for each possible rate where all points had as many trials."""
    numbers = np.unique(trials[trials > 0])
    steps = int(numbers[0]) if len(numbers) == 1 else 20
    steps = min(steps, MAX_EXACT_TRIALS)
    return np.asarray((np.arange(steps + 2) - 0.5) / steps)


def spread_words(values: FloatArray, usable: BoolArray, form: str) -> str:
    """Median and spread of the usable points' values in words, "" without any."""
    known = values[usable & np.isfinite(values)]
    if known.size == 0:
        return ""
    low, middle, high = (format(v, form) for v in np.percentile(known, [10.0, 50.0, 90.0]))
    return f"Usable points: median {middle}, 80 % between {low} and {high}."


def beyond_words(values: FloatArray, edges: FloatArray) -> str:
    """How many values the outermost bars hold that lie beyond them, "" for none."""
    words = []
    for beyond, end in ((values < edges[0], "below"), (values > edges[-1], "above")):
        if beyond.any():
            far = values[beyond].min() if end == "below" else values[beyond].max()
            words.append(f"{int(beyond.sum())} {end} the axis (to {far:.3g})")
    return f"The outermost bars also hold {' and '.join(words)}." if words else ""


def shadow_plot(catalog: Catalog) -> str:
    """The Sun's elevation above which no foreign shadow reaches a patch, by azimuth."""
    chosen = catalog.usable if catalog.usable.any() else np.ones(len(catalog), np.bool_)
    limits = np.asarray(catalog.records["shadow_limit_deg"][chosen], np.float64)
    azimuth = np.arange(SHADOW_AZIMUTHS + 1) * 360.0 / SHADOW_AZIMUTHS
    limits = np.column_stack([limits, limits[:, :1]])
    known = limits[np.isfinite(limits).all(axis=1)]
    if len(known) == 0:
        return ""
    lowest, low, middle, high, highest = np.percentile(known, [1, 10, 50, 90, 99], axis=0)
    plot = Plot(
        (0.0, 360.0), (min(0.0, float(lowest.min())), 1.08 * float(highest.max()) + 0.1),
        x_label="azimuth of the Sun, deg east of north", y_label="Sun elevation, deg", width=WIDE,
    )  # fmt: skip
    plot.band(azimuth, lowest, highest, "s1")
    plot.band(azimuth, low, high, "s1")
    plot.line(azimuth, middle, "s1")
    whose = "usable points" if catalog.usable.any() else "points"
    return figure(
        plot.svg("Shadow limits by azimuth of the Sun"),
        f"By azimuth: median of the {len(known)} {whose} with a known skyline, and the bands that "
        "hold 80 % and 98 % of them.",
    )


def _titles(spans: list[str], counts: IntArray, what: str) -> list[str]:
    return [f"{span}: {count} {what}" for span, count in zip(spans, counts.tolist(), strict=True)]
