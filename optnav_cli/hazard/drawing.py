"""Pictures of a hazard map: the risk in colours, and all of it side by side."""

import math

import cv2
import numpy as np

from catalog.arrays import ByteArray, Float32Array
from catalog.terrain.slopes import convert_to_degrees
from optnav_cli.hazard.hazard_map import HazardMap
from optnav_cli.hazard.pads import REFUSED
from optnav_cli.output.canvas import Canvas, scale_to_eight_bits, shade_picture

GAP_PX, TITLE_PX = 8, 22
MAX_SLOPE_DEG = 20.0  # the brightest of the colours
TEXT_COLOUR = (235, 235, 235)
REFUSED_COLOUR, OUTSIDE_COLOUR = (60, 40, 50), (24, 24, 24)
# A safe pad is green, a dangerous one red: stops of a scale, BGR, and readable in gray as well
SCALE = np.array([[80, 170, 60], [90, 210, 190], [70, 190, 245], [50, 100, 235], [60, 20, 140]])


def map_colours(values: Float32Array, highest: float) -> ByteArray:
    """Map numbers from 0 to `highest` to colours (rows, cols, 3), BGR."""
    at = np.clip(np.nan_to_num(values) / highest, 0.0, 1.0) * (len(SCALE) - 1)
    near = np.minimum(at.astype(np.int64), len(SCALE) - 2)
    share = (at - near)[..., None]
    mixed: ByteArray = np.rint(SCALE[near] * (1.0 - share) + SCALE[near + 1] * share).astype(
        np.uint8
    )
    return mixed


def draw_risk(mapped: HazardMap) -> ByteArray:
    """Draw the risk map in colours, refused pads dark, with the chosen pads."""
    factor = min(1.0, 1024 / max(mapped.view.brightness.shape))
    return _mark_pads(mapped, _scale(_draw_risk_cells(mapped), factor), factor)


def _draw_risk_cells(mapped: HazardMap) -> ByteArray:
    """Draw the risk at each cell of a view."""
    colours = map_colours(mapped.risk.code.astype(np.float32), 0.6 * REFUSED)
    colours[mapped.risk.code == REFUSED] = REFUSED_COLOUR
    full = _expand_to_cells(mapped, colours)
    full[~mapped.view.valid] = OUTSIDE_COLOUR
    return full


def draw_overview(mapped: HazardMap) -> ByteArray:
    """Draw picture, risk, pads and slopes side by side with captions."""
    view = mapped.view
    factor = 330 / max(view.brightness.shape)
    gray = shade_picture(
        scale_to_eight_bits(np.where(view.valid, view.brightness, np.float32(0.0)))
    )
    panels = [
        ("picture on the ground", _scale(gray, factor)),
        ("risk: green 0, red 0.6; dark refused", _scale(_draw_risk_cells(mapped), factor)),
        ("pads", _mark_pads(mapped, _scale(gray, factor), factor)),
    ]
    if mapped.slopes is not None:
        degrees = convert_to_degrees(np.stack([mapped.slopes.toward, mapped.slopes.across]))
        colours = map_colours(degrees, MAX_SLOPE_DEG)
        colours[~view.valid] = OUTSIDE_COLOUR
        title = f"slopes on 3 m: green 0, red {MAX_SLOPE_DEG:g} deg"
        panels.append((title, _mark_pads(mapped, _scale(colours, factor), factor)))
    height = TITLE_PX + max(len(panel) for _, panel in panels)
    width = sum(panel.shape[1] for _, panel in panels) + GAP_PX * (len(panels) - 1)
    canvas = Canvas(np.full((height, width, 3), 16, np.uint8), 1.0)
    left = 0
    for title, panel in panels:
        canvas.image[TITLE_PX : TITLE_PX + len(panel), left : left + panel.shape[1]] = panel
        canvas.text(title, left + 4, TITLE_PX - 7, TEXT_COLOUR)
        left += panel.shape[1] + GAP_PX
    return canvas.image


def _expand_to_cells(mapped: HazardMap, colours: ByteArray) -> ByteArray:
    """Expand colours of pads to the cells about each pad's middle; the border is refused."""
    risk, (rows, cols) = mapped.risk, mapped.view.brightness.shape
    places = [
        np.rint((np.arange(size) - risk.origin) / risk.step).astype(np.int64)
        for size in (rows, cols)
    ]
    full = np.empty((rows, cols, 3), np.uint8)
    full[:] = REFUSED_COLOUR
    inside = [(at >= 0) & (at < size) for at, size in zip(places, risk.code.shape, strict=True)]
    chosen = [at[good] for at, good in zip(places, inside, strict=True)]
    full[np.ix_(*inside)] = colours[np.ix_(*chosen)]
    return full


def _scale(picture: ByteArray, factor: float) -> ByteArray:
    """Scale a picture: averaged when smaller, nearest pixels when larger."""
    if factor == 1.0:
        return picture.copy()
    high, wide = (max(1, round(size * factor)) for size in picture.shape[:2])
    how = cv2.INTER_AREA if factor < 1.0 else cv2.INTER_NEAREST
    return cv2.resize(picture, (wide, high), interpolation=how).astype(np.uint8, copy=False)


def _mark_pads(mapped: HazardMap, picture: ByteArray, factor: float) -> ByteArray:
    """Draw a box at each chosen pad onto the picture; factor: pixels per cell."""
    half = 0.5 * mapped.risk.cells
    for pad in mapped.pads:
        if pad.cell is None:
            continue
        row, col = ((middle + 0.5) * factor for middle in pad.cell)
        reach = max(half * factor, 3.0)
        low = math.floor(col - reach), math.floor(row - reach)
        high = math.ceil(col + reach), math.ceil(row + reach)
        cv2.rectangle(picture, low, high, (0, 0, 0), 3)
        cv2.rectangle(picture, low, high, (255, 255, 255), 1)
    return picture
