"""The drawings of a catalog's page: the map, histograms of the certificate, shadow limits."""

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.control_point import SHADOW_AZIMUTHS
from catalog.store.reader import Catalog
from optnav_cli.output.report.ground import GroundMap
from optnav_cli.output.report.page import data_uri, figure, paragraph
from optnav_cli.output.report.svg import HALF, Plot, span

FloatArray = NDArray[np.float64]
MOST_DOTS = 5000  # more points are painted into a picture instead of drawn one by one
PAINTED_PX = (1500, 1000)
BINS = 30
# From good to bad, told apart in light and dark and by most colour-blind people (viridis, its
# yellow darkened for white paper).
SCALE = ("#e3b505", "#7ad151", "#22a884", "#2a788e", "#414487", "#440154")
REJECTED_BGR = (150, 150, 150)


def points_map(catalog: Catalog) -> str:
    """Where the points are; the usable ones coloured by their expected match error."""
    ground = GroundMap.about(catalog.lat_deg, catalog.lon_deg, catalog.meta.radius_m)
    x, y = ground.places(catalog.lat_deg, catalog.lon_deg)
    plot = ground.plot(x, y, height=620)
    scores = np.asarray(catalog.records["localisation_px"], np.float64)
    usable = catalog.usable
    classes, limits = _classes(scores, usable)
    if len(x) > MOST_DOTS:
        painted = _painted(plot, x, y, usable, classes)
        plot.picture(data_uri(painted), plot.x, plot.y)
    else:
        radius = float(np.clip(90.0 / np.sqrt(len(x)), 1.6, 5.0))
        plot.dots(x[~usable], y[~usable], "muted", 0.6 * radius)
        names = [
            f"{point}: {score:.2f} nodes"
            for point, score in zip(catalog.ids[usable], scores[usable], strict=True)
        ]
        colours = [SCALE[c] for c in classes[usable]]
        plot.dots(x[usable], y[usable], "s1", radius, names, colours)
    swatches = "".join(
        f'<span class="key" style="background:{colour}"></span>{text}'
        for colour, text in zip(SCALE, limits, strict=False)
    )
    return figure(
        plot.svg("Map of the control points") + f'<div class="soft">{swatches}</div>',
        "Usable points by expected match error (nodes, 1 sigma, worst direction).",
        {"k0": "not usable"},
    )


def score_histograms(catalog: Catalog) -> list[str]:
    """Histograms of localisation, eigenvalue and uniqueness of the usable points."""
    records = catalog.records[catalog.usable]
    with np.errstate(divide="ignore", invalid="ignore"):
        eigenvalues = np.log10(np.asarray(records["hessian_eigenvalue"], np.float64))
    columns = (
        (records["localisation_px"], "expected match error, nodes", "s1"),
        (eigenvalues, "log10 of the smallest eigenvalue of the Hessian", "s2"),
        (records["uniqueness"][:, 0], "uniqueness margin, finest level", "s3"),
    )
    drawings = [
        figure(_histogram(np.asarray(values, np.float64), label, series), "")
        for values, label, series in columns
    ]
    return [f'<div class="pair">{"".join(drawings)}</div>']


def trial_histogram(catalog: Catalog) -> str:
    """How often the points were recognised in their trials, usable and not."""
    tried = catalog.records["trials"] > 0
    if not tried.any():
        return paragraph("No point was put to recognition trials.")
    rates = np.asarray(catalog.records["recognition_rate"], np.float64)
    edges = np.linspace(0.0, 1.0, 21)
    below, above = (
        np.histogram(rates[tried & choice & np.isfinite(rates)], edges)[0]
        for choice in (~catalog.usable, catalog.usable)
    )
    top = 1.05 * max(float((below + above).max()), 1.0)
    plot = Plot((0.0, 1.0), (0.0, top), x_label="recognised share of the trials", y_label="points")
    plot.bars(edges, below, "s4")
    plot.bars(edges, above, "s3", below)
    return figure(
        plot.svg("Recognition rates"),
        f"Recognition in trials with richer terrain, noise and wrong poses; {int(tried.sum())} "
        "points were tried.",
        {"k3": "usable", "k4": "not usable"},
    )


def shadow_plot(catalog: Catalog) -> str:
    """The Sun's elevation above which no foreign shadow reaches a patch, by azimuth."""
    limits = np.asarray(catalog.records["shadow_limit_deg"][catalog.usable], np.float64)
    azimuth = np.arange(SHADOW_AZIMUTHS + 1) * 360.0 / SHADOW_AZIMUTHS
    limits = np.column_stack([limits, limits[:, :1]])
    known = limits[np.isfinite(limits).all(axis=1)]
    if len(known) == 0:
        return ""
    low, middle, high = np.percentile(known, [10.0, 50.0, 90.0], axis=0)
    plot = Plot(
        (0.0, 360.0), (min(0.0, float(low.min())), 1.1 * float(high.max()) + 0.1),
        x_label="azimuth of the Sun, deg east of north", y_label="elevation, deg",
    )  # fmt: skip
    plot.band(azimuth, low, high, "s1")
    plot.line(azimuth, middle, "s1")
    return figure(
        plot.svg("Shadow limits"),
        "Sun elevation above which no foreign shadow reaches a patch: median, and the band that "
        "holds 80 % of the usable points.",
    )


def _histogram(values: FloatArray, label: str, series: str) -> str:
    values = values[np.isfinite(values)]
    low, high = span(values, 0.0)
    if high <= low:
        low, high = low - 0.5, low + 0.5
    counts, edges = np.histogram(values, BINS, (low, high))
    plot = Plot(
        (low, high), (0.0, 1.05 * max(float(counts.max()), 1.0)), x_label=label, y_label="points",
        width=HALF, height=260,
    )  # fmt: skip
    plot.bars(edges, counts, series)
    if values.size:
        middle = float(np.median(values))
        plot.line((middle, middle), plot.y, "muted")
        plot.text(middle, plot.y[1] * 0.93, f" median {middle:.3g}")
    return plot.svg(f"Histogram of {label}")


def _classes(scores: FloatArray, usable: NDArray[np.bool_]) -> tuple[NDArray[np.int64], list[str]]:
    """Which sixth of the usable points each point is in by its score, and their limits in words."""
    good = scores[usable & np.isfinite(scores)]
    if good.size == 0 or good.min() == good.max():
        return np.zeros(len(scores), np.int64), [f"{value:.2f}" for value in good[:1]]
    limits = np.quantile(good, np.arange(1, len(SCALE)) / len(SCALE))
    classes = np.searchsorted(limits, np.nan_to_num(scores, nan=np.inf), side="right")
    ends = [good.min(), *limits, good.max()]
    words = [f"{a:.2f}-{b:.2f}" for a, b in pairwise(ends)]
    return np.asarray(classes, np.int64), words


def _painted(
    plot: Plot,
    x: FloatArray,
    y: FloatArray,
    usable: NDArray[np.bool_],
    classes: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """All points as a transparent picture (h, w, 4) over the plot's whole range."""
    width, height = PAINTED_PX
    picture = np.zeros((height, width, 4), np.uint8)
    columns = (x - plot.x[0]) / (plot.x[1] - plot.x[0]) * width
    rows = (plot.y[1] - y) / (plot.y[1] - plot.y[0]) * height
    radius = int(np.clip(0.3 * np.sqrt(width * height / len(x)), 1, 4))
    colours = [tuple(int(c[i : i + 2], 16) for i in (5, 3, 1)) for c in SCALE]
    for index in np.argsort(usable, kind="stable"):
        blue, green, red = colours[classes[index]] if usable[index] else REJECTED_BGR
        at = int(columns[index]), int(rows[index])
        cv2.circle(picture, at, radius, (blue, green, red, 255), -1)
    return picture
