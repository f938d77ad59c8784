"""The page about a catalog: where its points are, how good they are, and what they look like."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.control_point import Flag, Patch
from catalog.errors import DataError
from catalog.rendering.map_view import render_map
from catalog.store.reader import Catalog
from optnav_cli.output.report.catalog_plots import (
    points_map,
    score_histograms,
    shadow_plot,
    trial_histogram,
)
from optnav_cli.output.report.page import (
    data_uri,
    figure,
    folded,
    image,
    listing,
    page,
    paragraph,
    section,
    table,
    tiles,
)

SHOWN = 3  # best points, and as many of the worst
SUN_ELEVATION_DEG, SUN_AZIMUTH_DEG = 20.0, 270.0
LEAST_SIDE_PX = 128  # smaller patches are enlarged, node by node
REASONS = {
    Flag.NO_DATA: "a patch has holes",
    Flag.FLAT: "too flat to be located",
    Flag.NOT_UNIQUE: "a rival nearby looks too much alike",
    Flag.NOT_RECOGNISED: "recognition trials failed",
    Flag.CROWDED: "too near to a neighbour's point",
    Flag.SHADOWED: "foreign shadows at most Suns",
}


def catalog_page(catalog: Catalog) -> str:
    """The HTML page about an open catalog. Raises DataError when all shown patches are damaged."""
    meta = catalog.meta
    sections = [_main_numbers(catalog)]
    if len(catalog):
        sections.append(section("Control points", points_map(catalog)))
    if catalog.usable.any():
        sections.append(
            section("How good the usable points are", *score_histograms(catalog))
            + section("Recognition and shadows", trial_histogram(catalog), shadow_plot(catalog))
        )
        sections.append(_patches(catalog))
    sections.append(_rejected(catalog))
    sections.append(_made_from(catalog))
    subtitle = (
        f"{meta.count} control points, {meta.usable} usable; {meta.levels} levels of {meta.size} "
        f"nodes, {meta.posting_m:.6g} m between the finest. Digest {catalog.digest}"
    )
    return page(f"{meta.body.capitalize()}: catalog {catalog.path.name}", subtitle, sections)


def _main_numbers(catalog: Catalog) -> str:
    meta, usable = catalog.meta, catalog.usable
    values = [
        (str(meta.usable), "usable control points"),
        (str(meta.count), "cells with a point"),
        (f"{meta.cell_deg:g}°", "cell"),
        (f"{meta.posting_m:.4g} m", "finest posting"),
    ]
    for column, name, form in (
        ("localisation_px", "expected match error, nodes (median)", "{:.2f}"),
        ("recognition_rate", "recognised in trials (mean)", "{:.1%}"),
    ):
        scores = catalog.records[column][usable]
        scores = scores[np.isfinite(scores)]
        if scores.size:
            middle = np.mean(scores) if column == "recognition_rate" else np.median(scores)
            values.append((form.format(middle), name))
    return tiles(values)


def _patches(catalog: Catalog) -> str:
    """Rendered levels of the best and the worst usable points by expected match error."""
    scores = catalog.records["localisation_px"]
    rows = np.flatnonzero(catalog.usable & np.isfinite(scores))
    order = rows[np.argsort(scores[rows], kind="stable")]
    parts = [
        paragraph(
            f"Rendered under a Sun {SUN_ELEVATION_DEG:g}° high in the west, finest level first, "
            "north up. Ranked by the expected match error."
        )
    ]
    best = order[:SHOWN]
    worst = order[max(len(order) - SHOWN, len(best)) :]
    for title, chosen in (("Best", best), ("Worst usable", worst)):
        parts += [_patch_row(catalog, title, int(row)) for row in chosen]
    return section("Best and worst points", *parts)


def _patch_row(catalog: Catalog, title: str, row: int) -> str:
    record = catalog.records[row]
    words = (
        f"{title}: {catalog.ids[row]} at {catalog.lat_deg[row]:.3f}°, "
        f"{catalog.lon_deg[row]:.3f}°; error {record['localisation_px']:.2f} nodes, recognised "
        f"{100.0 * record['recognition_rate']:.0f} %"
    )
    try:
        levels = catalog.patches(int(catalog.ids[row]))
    except DataError as error:
        return paragraph(f"{words}. {error}")
    pictures = [
        image(data_uri(_rendered(levels, number, catalog.meta.radius_m)), f"level {number}")
        for number in range(len(levels))
    ]
    return figure(f'<div class="patches">{"".join(pictures)}</div>', words)


def _rendered(levels: Sequence[Patch], number: int, radius_m: float) -> NDArray[np.uint8]:
    patch = levels[number]
    elevation, azimuth = np.radians([SUN_ELEVATION_DEG, SUN_AZIMUTH_DEG])
    sun = np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            np.cos(elevation) * np.cos(azimuth),
            np.sin(elevation),
        ]
    )
    outer = [(coarser.heights_m, coarser.posting_m) for coarser in levels[number + 1 :]]
    shade = render_map(
        patch.heights_m, patch.posting_m, sun, radius_m=radius_m, law="lommel_seeliger", outer=outer
    )
    finite = shade[np.isfinite(shade)]
    white = float(np.percentile(finite, 99.5)) if finite.size else 0.0
    scaled = np.nan_to_num(shade) / white if white > 0.0 else np.zeros_like(shade)
    gray = np.asarray(np.rint(255.0 * np.clip(scaled, 0.0, 1.0) ** 0.8), dtype=np.uint8)
    factor = max(1, -(-LEAST_SIDE_PX // patch.size))
    side = factor * patch.size
    return np.asarray(cv2.resize(gray, (side, side), interpolation=cv2.INTER_NEAREST), np.uint8)


def _rejected(catalog: Catalog) -> str:
    flags = catalog.records["flags"][~catalog.usable]
    if flags.size == 0:
        return ""
    rows = [(text, str(int(((flags & flag) != 0).sum()))) for flag, text in REASONS.items()]
    rows = sorted((row for row in rows if row[1] != "0"), key=lambda row: -int(row[1]))
    return section(
        "Points that are not usable",
        paragraph(f"{flags.size} points; a point may have several reasons."),
        table(("reason", "points"), rows),
    )


def _made_from(catalog: Catalog) -> str:
    meta = catalog.meta
    facts = {
        "body": meta.body,
        "radius_m": meta.radius_m,
        "cell_deg": meta.cell_deg,
        "levels": meta.levels,
        "size": meta.size,
        "posting_m": meta.posting_m,
        "height_step_m": meta.height_step_m,
        "format_version": meta.format_version,
        "software": meta.software,
        "created_utc": meta.created_utc,
        "digest": catalog.digest,
        "sources": dict(meta.sources),
    }
    parts = [folded("Manifest", listing(facts))]
    if meta.config:
        parts.append(folded("Build config", listing(meta.config)))
    return section("Made from", *parts)
