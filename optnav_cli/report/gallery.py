"""Height grids of chosen points: the best, the worst usable, and one a reason of the others."""

import cv2
import numpy as np

from catalog.arrays import ByteArray
from catalog.control_point import Patch
from catalog.errors import DataError
from catalog.store.reader import Catalog
from optnav_cli.report.catalog_maps import REASONS, first_reasons
from optnav_cli.report.page import (
    captioned,
    data_uri,
    figure,
    image,
    note,
    paragraph,
    section,
    subsection,
)
from optnav_cli.report.relief import shaded

SHOWN = 3  # best points, and as many of the worst
SIDE_PX = 176  # of a picture, about; nodes are enlarged by a whole number
NO_DATA_BGR = (150, 140, 140)


def gallery(catalog: Catalog) -> str:
    """Chosen points with all their levels; "" for a catalog without points."""
    scores = np.asarray(catalog.records["localisation_px"], np.float64)
    rows = np.flatnonzero(catalog.usable & np.isfinite(scores))
    order = rows[np.argsort(scores[rows], kind="stable")]
    best = order[:SHOWN]
    worst = order[max(len(order) - SHOWN, len(best)) :]
    parts = [
        paragraph(
            "Heights by colour, dark is low, shaded from the upper left; north up, finest level "
            "left. The frame in a level is the ground of the level before. Gray: no data. Points "
            "are ranked by their predicted match error."
        )
    ]
    kinds = first_reasons(catalog)
    failed = [
        (reason, np.flatnonzero(kinds == number))
        for number, reason in enumerate(REASONS.values(), start=1)
    ]
    groups = [("Best", best.tolist()), ("Worst usable", worst.tolist())]
    groups += [
        # the one in the middle stands for the others better than an extreme one
        (f"Not usable: {reason}", [int(there[len(there) // 2])])
        for reason, there in failed
        if len(there)
    ]
    for heading, chosen in groups:
        if chosen:
            parts.append(subsection(heading, *(_point(catalog, row) for row in chosen)))
    return section("Examples", *parts) if len(parts) > 1 else ""


def _point(catalog: Catalog, row: int) -> str:
    record, point = catalog.records[row], int(catalog.ids[row])
    tried = int(record["trials"])
    error = float(record["localisation_px"])
    words = [
        f"Point {point} at {catalog.lat_deg[row]:.3f}°, {catalog.lon_deg[row]:.3f}°",
        f"predicted error {error:.2f} nodes" if np.isfinite(error) else "error not known",
        f"recognised in {100.0 * record['recognition_rate']:.0f} % of {tried} trials"
        if tried
        else "not tried",
    ]
    try:
        levels = catalog.patches(point)
    except DataError as fault:
        return note(str(fault))
    if not levels:
        return paragraph(f"{'; '.join(words)}. No heights are kept for it.")
    pictures = "".join(_level(levels[k], k, point) for k in range(len(levels)))
    return figure(f'<div class="patches">{pictures}</div>', "; ".join(words))


def _level(patch: Patch, number: int, point: int) -> str:
    width_km = patch.posting_m * patch.size / 1e3
    known = patch.heights_m[np.isfinite(patch.heights_m)]
    relief = f"{float(np.ptp(known)):.0f} m of relief" if known.size else "no data"
    words = f"{_short(patch.posting_m)} m a node, {_short(width_km)} km wide, {relief}"
    picture = image(data_uri(coloured(patch)), f"heights about point {point}, level {number}")
    return captioned(picture, words, "box inner" if number else "box")


def _short(value: float) -> str:
    """Three digits at least, and never a power of ten."""
    return f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"


def coloured(patch: Patch) -> ByteArray:
    """A patch's heights by colour (cividis) with relief shading, nodes enlarged."""
    heights = patch.heights_m
    known = np.isfinite(heights)
    low, high = (float(f(heights[known])) for f in (np.min, np.max)) if known.any() else (0.0, 1.0)
    share = (np.where(known, heights, low) - low) / max(high - low, 1e-6)
    levels = np.rint(255.0 * share).astype(np.uint8)
    tint = cv2.applyColorMap(levels, cv2.COLORMAP_CIVIDIS).astype(np.float32)
    light = shaded(heights, patch.posting_m).astype(np.float32) / 150.0
    picture = np.clip(tint * light[..., None], 0.0, 255.0).astype(np.uint8)
    picture[~known] = NO_DATA_BGR
    factor = max(1, round(SIDE_PX / patch.size))
    side = factor * patch.size
    return np.asarray(cv2.resize(picture, (side, side), interpolation=cv2.INTER_NEAREST), np.uint8)
