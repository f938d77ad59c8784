"""The page about a catalog: where its points are, how good they are, and what they look like."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from catalog.arrays import ByteArray, Float32Array, FloatArray
from catalog.control_point import FLAG_MEANINGS, ComparisonShift, Flag, Patch
from catalog.errors import DataError
from catalog.store.reader import Catalog
from optnav_cli.report import catalog_maps as maps
from optnav_cli.report import page as html
from optnav_cli.report.body_sides import build_sides_figure, has_sides
from optnav_cli.report.relief import shade
from optnav_cli.report.views import Scale

SHOWN = 3  # best points, and as many of the worst
SIDE_PX = 176  # of a picture, about; nodes are enlarged by a whole number
NO_DATA_BGR = (150, 140, 140)


@dataclass(frozen=True, eq=False)
class Quantity:
    """A value of every point (n,), NaN where unknown, and how it is presented."""

    heading: str
    label: str
    words: str
    values: FloatArray
    more_is_better: bool
    form: str
    edges: FloatArray | None = None
    log: bool = False  # allowed, where the values span much


def build_catalog_page(catalog: Catalog) -> str:
    """Build the HTML page about an open catalog."""
    meta = catalog.meta
    sections = [_list_main_numbers(catalog), *_list_warnings(catalog)]
    if len(catalog):
        panels = maps.list_panels(catalog)
        if has_sides(catalog):
            sections.append(_build_sides(catalog))
        usable = maps.draw_usable_map(catalog, panels, maps.plot_latitudes(catalog))
        sections.append(html.section("Usable control points", usable, _count_reasons(catalog)))
        sections += [
            _build_quantity(catalog, panels, quantity) for quantity in list_quantities(catalog)
        ]
        sections += [_count_sources(catalog, panels), build_gallery(catalog)]
    sections.append(_list_origin(catalog))
    count, levels = (
        html.count_things(len(catalog), "control point"),
        html.count_things(meta.levels, "level"),
    )
    subtitle = (
        f"{count}, {html.format_count(int(catalog.usable.sum()))} usable; "
        f"{levels} of {meta.size} nodes, {meta.posting_m:.6g} m between the finest."
    )
    title = f"{meta.body.capitalize()}: catalog {catalog.path.name}"
    return html.build_page(title, subtitle, filter(None, sections))


def list_quantities(catalog: Catalog) -> list[Quantity]:
    """List what is mapped and counted of a catalog, in the order of the page."""
    records = catalog.records
    trials = records["trials"].astype(np.int64)
    margins, limits = records["uniqueness"], records["shadow_limit_deg"]
    # places that fail before their certificate is made have zeros in it
    certified = (trials > 0) | (margins != 0.0).any(axis=1) | (limits != 0.0).any(axis=1)
    rate = np.where(trials > 0, _mask_infinite(records["recognition_rate"]), np.nan)
    quantities = [
        Quantity(
            "Localisation", "predicted match error, nodes",
            "Predicted match error, 1 sigma in the worst direction, in nodes of the finest level; "
            "less is better.",
            _mask_infinite(records["localisation_nodes"]), False, ".3g", log=True,
        ),
        Quantity(
            "Recognition", "recognised share of the trials",
            "Share of the recognition trials (richer terrain, noise, wrong poses) that succeeded, "
            "of those that it took to decide; more is better.",
            rate, True, ".0%", maps.compute_rate_edges(trials),
        ),
        Quantity(
            "Uniqueness", "uniqueness margin, least of the levels",
            "How much better the true place looks than its best rival in the search region, at "
            "the level where that is least; more is better.",
            np.where(certified, _find_extremes(margins, np.fmin), np.nan), True, ".3g", log=True,
        ),
        Quantity(
            "Shadow limits", "highest shadow limit, deg",
            "Sun elevation above which no shadow of ground outside the patch reaches it, at the "
            "azimuth where that is highest; less is better.",
            np.where(certified, _find_extremes(limits, np.fmax), np.nan), False, ".1f",
        ),
    ]  # fmt: skip
    if catalog.meta.comparison is not None:
        shifts, nothing = catalog.shifts, ComparisonShift(np.nan, np.nan, 0, 0.0)
        moved = [shifts.get(number, nothing).distance_m for number in catalog.ids.tolist()]
        names = ", ".join(catalog.meta.comparison.sources)
        words = f"How far {names} has the ground of each point from where the catalog has it."
        quantities.append(
            Quantity("Comparison", "shift, m", words, np.array(moved), False, ".3g", log=True)
        )
    return quantities


def _build_quantity(
    catalog: Catalog, panels: Sequence[maps.MapPanel], quantity: Quantity
) -> Markup:
    values, usable = quantity.values, catalog.usable
    known = values[np.isfinite(values)]
    if known.size == 0:
        missing = f"The catalog holds no {quantity.label} of any point."
        return html.section(quantity.heading, html.paragraph(missing))
    scale = Scale.fit(known, quantity.more_is_better, quantity.log)
    edges = maps.compute_edges(scale) if quantity.edges is None else quantity.edges
    if quantity.edges is not None:
        scale = Scale(0.0, 1.0, quantity.more_is_better)
    of_body = panels[0].view.of_body
    bars = maps.draw_histogram(
        values, usable, scale, edges, quantity.heading, quantity.label, of_body
    )
    words = (
        quantity.words,
        maps.describe_spread(values, usable, quantity.form),
        "Bars in colour: usable points, gray: others; the dashed line is the usable points' "
        "median.",
        maps.describe_values_beyond(known, edges),
    )
    caption = " ".join(filter(None, words))
    parts = [maps.draw_value_map(panels, values, scale, quantity.heading, bars, caption)]
    if quantity.heading == "Shadow limits":
        parts.append(maps.plot_shadow_limits(catalog))
    if quantity.heading == "Comparison":
        parts.append(maps.draw_shift_map(catalog, panels))
    return html.section(quantity.heading, *parts)


def _list_main_numbers(catalog: Catalog) -> Markup:
    meta, usable = catalog.meta, catalog.usable
    count = int(usable.sum())
    values = [
        (html.format_count(count), "usable control points"),
        (
            html.format_count(len(catalog)),
            f"cells with a point, of {html.format_count(catalog.grid.total)}",
        ),
    ]
    if len(catalog):
        values.append((f"{count / len(catalog):.1%}", "of the points usable"))
    values += [(f"{meta.cell_deg:g}°", "cell"), (f"{meta.posting_m:.4g} m", "finest posting")]
    for column, name, form in (
        ("localisation_nodes", "predicted match error, nodes (median)", "{:.2f}"),
        ("recognition_rate", "recognised in trials (mean)", "{:.1%}"),
    ):
        scores = catalog.records[column][usable]
        scores = scores[np.isfinite(scores)]
        if scores.size:
            middle = np.mean(scores) if column == "recognition_rate" else np.median(scores)
            values.append((form.format(middle), name))
    return html.tiles(values)


def _list_warnings(catalog: Catalog) -> list[Markup]:
    texts = []
    lost = catalog.meta.count - len(catalog)
    if lost:
        texts.append(
            f"{lost} of {catalog.meta.count} points are damaged and left out here; run `optnav "
            "catalog verify` and build the catalog again."
        )
    if len(catalog) == 0:
        texts.append("The catalog holds no control point: there is nothing to draw.")
    elif not catalog.usable.any():
        texts.append("The catalog has no usable point: navigation will find nothing with it.")
    return [html.paragraph(words, "note") for words in texts]


def _count_reasons(catalog: Catalog) -> Markup:
    """Count why points are not usable: how many fail each check, and how many fail it alone."""
    flags = catalog.records["flags"][~catalog.usable].astype(np.int64)
    if flags.size == 0:
        return html.paragraph("All points are usable.")
    rows = []
    # a point too near to a neighbour's may be usable, so alone it explains nothing
    firsts = np.bincount(maps.find_first_reasons(catalog), minlength=len(maps.REASONS) + 2)
    for number, flag in enumerate(maps.REASONS, start=1):
        carried = (flags & int(flag)) != 0
        alone = (flags & ~int(Flag.CROWDED)) == int(flag)
        if carried.any():
            counts = (int(carried.sum()), int(alone.sum()), int(firsts[number]))
            share = html.format_percent(counts[0], len(catalog))
            words = flag.label, FLAG_MEANINGS[flag]
            rows.append(
                (*words, html.format_count(counts[0]), share, *map(html.format_count, counts[1:]))
            )
    if firsts[-1]:
        unexplained = html.format_count(int(firsts[-1]))
        rows.append((maps.NO_REASON, "", unexplained, "", "", unexplained))
    header = "not usable", "because", "points", "of all", "for this alone", "so on the map"
    text = f"{html.count_things(flags.size, 'point')} not usable; one may have several reasons."
    return html.paragraph(text) + html.table(header, rows, text_columns=2)


def _build_sides(catalog: Catalog) -> Markup:
    try:
        drawing = build_sides_figure(catalog)
    except DataError as fault:  # damaged relief, or a machine without embree: the rest can be shown
        drawing = html.paragraph(str(fault), "note")
    return html.section("On the body", drawing)


def _count_sources(catalog: Catalog, panels: Sequence[maps.MapPanel]) -> Markup:
    """Count points and usable points of each terrain model; with a map where there are several."""
    meta = catalog.meta
    source = catalog.records["source"].astype(np.int64)
    rows = []
    for number, name in enumerate(meta.point_sources):
        here = source == number
        good, total = (int(np.count_nonzero(x)) for x in (here & catalog.usable, here))
        share = html.format_percent(good, total)
        rows.append(
            (name or maps.NO_SOURCE, html.format_count(total), html.format_count(good), share)
        )
    counts = html.table(("points come from", "points", "usable", "share"), rows)
    several = len(meta.point_sources) > 1
    shown = maps.draw_source_map(catalog, panels, counts) if several else counts
    return html.section("Provenance", shown)


def _list_origin(catalog: Catalog) -> Markup:
    meta = catalog.meta
    facts = [
        ("body", f"{meta.body}, sphere of {meta.radius_m:.12g} m"),
        ("grid", f"cells of {meta.cell_deg:.9g}°, {catalog.grid.total} on the body"),
        ("levels", ", ".join(f"{meta.posting_m * 2**k:.6g} m" for k in range(meta.levels))),
        ("nodes a side", str(meta.size)),
        ("height step", f"{meta.height_step_m:.9g} m"),
        ("software", meta.software or "not stated"),
        ("made", meta.created_utc or "not stated"),
        ("format", str(meta.format_version)),
        ("file", f"{catalog.path.stat().st_size / 1e6:.1f} MB"),
        ("digest", catalog.digest),
    ]
    parts = [html.table(("what", "value"), facts, text_columns=2)]
    if meta.sources:
        header = ("terrain model", "hash or description")
        parts.append(html.table(header, meta.sources.items(), text_columns=2))
    else:
        parts.append(html.paragraph("The catalog does not name its terrain models."))
    if meta.config:
        parts.append(html.folded("Build config", html.format_listing(meta.config)))
    return html.section("Made from", *parts)


def _mask_infinite(values: NDArray[np.floating[Any]]) -> FloatArray:
    return np.where(np.isfinite(values), values, np.nan).astype(np.float64)


def _find_extremes(values: Float32Array, pick: np.ufunc) -> FloatArray:
    """Find the least or highest known value of each row (n, m), NaN where none is known."""
    extremes: FloatArray = pick.reduce(_mask_infinite(values), axis=1)
    return extremes


def build_gallery(catalog: Catalog) -> Markup:
    """Build examples of points with all their levels; "" for a catalog without points."""
    scores = np.asarray(catalog.records["localisation_nodes"], np.float64)
    rows = np.flatnonzero(catalog.usable & np.isfinite(scores))
    order = rows[np.argsort(scores[rows], kind="stable")]
    best = order[:SHOWN]
    worst = order[max(len(order) - SHOWN, len(best)) :]
    parts = [
        html.paragraph(
            "Heights by colour, dark is low, shaded from the upper left; north up, finest level "
            "left. The frame in a level is the ground of the level before. Gray: no data. Points "
            "are ranked by their predicted match error."
        )
    ]
    kinds = maps.find_first_reasons(catalog)
    groups = [("Best", best.tolist()), ("Worst usable", worst.tolist())]
    for number, flag in enumerate(maps.REASONS, start=1):
        there = np.flatnonzero(kinds == number).tolist()
        # the one in the middle stands for the others better than an extreme one
        groups.append((f"Not usable: {flag.label}", there[len(there) // 2 :][:1]))
    for heading, chosen in groups:
        if chosen:
            parts.append(html.subsection(heading, *(_build_point(catalog, row) for row in chosen)))
    return html.section("Examples", *parts) if len(parts) > 1 else Markup()


def _build_point(catalog: Catalog, row: int) -> Markup:
    record, point = catalog.records[row], int(catalog.ids[row])
    tried, rate = int(record["trials"]), 100.0 * record["recognition_rate"]
    error = float(record["localisation_nodes"])
    words = [
        f"Point {point} at {catalog.lat_deg[row]:.3f}°, {catalog.lon_deg[row]:.3f}°",
        f"predicted error {error:.2f} nodes" if np.isfinite(error) else "error not known",
        f"recognised in {rate:.0f} % of {tried} trials" if tried else "not tried",
    ]
    try:
        levels = catalog.patches(point)
    except DataError as fault:
        return html.paragraph(str(fault), "note")
    if not levels:
        return html.paragraph(f"{'; '.join(words)}. No heights are kept for it.")
    pictures = [_build_level(levels[k], k, point) for k in range(len(levels))]
    return html.figure(html.side_by_side("patches", pictures), "; ".join(words))


def _build_level(patch: Patch, number: int, point: int) -> Markup:
    width_km = patch.posting_m * patch.size / 1e3
    known = patch.heights_m[np.isfinite(patch.heights_m)]
    relief = f"{float(np.ptp(known)):.0f} m of relief" if known.size else "no data"
    words = (
        f"{_format_short(patch.posting_m)} m a node, {_format_short(width_km)} km wide, {relief}"
    )
    picture = html.image(
        html.encode_picture_uri(colour_heights(patch)),
        f"heights about point {point}, level {number}",
    )
    return html.captioned(picture, words, "box inner" if number else "box")


def _format_short(value: float) -> str:
    """Format three digits at least, and never a power of ten."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def colour_heights(patch: Patch) -> ByteArray:
    """Colour a patch's heights (cividis) with relief shading, nodes enlarged."""
    heights = patch.heights_m
    known = np.isfinite(heights)
    low, high = (float(f(heights[known])) for f in (np.min, np.max)) if known.any() else (0.0, 1.0)
    share = (np.where(known, heights, low) - low) / max(high - low, 1e-6)
    levels = np.rint(255.0 * share).astype(np.uint8)
    tint = cv2.applyColorMap(levels, cv2.COLORMAP_CIVIDIS).astype(np.float32)
    light = shade(heights, patch.posting_m).astype(np.float32) / 150.0
    picture = np.clip(tint * light[..., None], 0.0, 255.0).astype(np.uint8)
    picture[~known] = NO_DATA_BGR
    factor = max(1, round(SIDE_PX / patch.size))
    return np.kron(picture, np.ones((factor, factor, 1), np.uint8))
