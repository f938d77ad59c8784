"""A control point as a picture: its heights and its brightness at every level."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from catalog.arrays import ByteArray, Float32Array
from catalog.control_point import Patch, Pyramid
from catalog.errors import OutputError
from catalog.files import check_file, write_output
from catalog.photometry.laws import LUNAR_HAPKE, SurfaceLaw
from catalog.rendering.map_view import render_map

HEADER_BYTES = 33  # of a PNG: its magic number and its first chunk
# A text chunk by which we know a picture of ours again: length, type, text, CRC-32 of both.
_TEXT = b"tEXtSoftware\0optnav catalog show"
OUR_MARK = struct.pack(">I", len(_TEXT) - 4) + _TEXT + struct.pack(">I", zlib.crc32(_TEXT))
TILE_PX = 256
GAP_PX = 12
HEAD_PX = 62
LABEL_PX = 22
SUN_AZIMUTH_DEG = 315.0  # from the north-west, as relief is read best
SUN_ELEVATION_DEG = 25.0

_PAPER = (250, 250, 250)
_INK = (40, 40, 40)
_FRAME = (60, 160, 255)
_NO_DATA = (200, 190, 190)


def draw_pyramid(pyramid: Pyramid, radius_m: float, law: SurfaceLaw = LUNAR_HAPKE) -> ByteArray:
    """Draw the levels of a point side by side, the finest left.

    Above: heights by colour with relief shading. Below: brightness by Hapke with cast shadows,
    seen from above. A box in each level marks the ground of the level before.
    """
    levels = pyramid.levels
    columns = max(len(levels), 3)  # the head needs room
    width = GAP_PX + columns * (TILE_PX + GAP_PX)
    height = HEAD_PX + 2 * (TILE_PX + LABEL_PX) + GAP_PX
    picture: ByteArray = np.full((height, width, 3), _PAPER, dtype=np.uint8)
    _draw_head(picture, pyramid)
    azimuth, elevation = np.radians(SUN_AZIMUTH_DEG), np.radians(SUN_ELEVATION_DEG)
    across = np.cos(elevation)
    sun = np.array([across * np.sin(azimuth), across * np.cos(azimuth), np.sin(elevation)])
    for level, patch in enumerate(levels):
        left = GAP_PX + level * (TILE_PX + GAP_PX)
        outer = tuple((p.heights_m, p.posting_m) for p in levels[level + 1 :])
        bright = render_map(
            patch.heights_m, patch.posting_m, sun, radius_m=radius_m, law=law, outer=outer
        )
        finer = levels[level - 1] if level else None
        _draw_tile(picture, HEAD_PX, left, _render_heights(patch), patch, finer)
        _draw_tile(
            picture, HEAD_PX + TILE_PX + LABEL_PX, left, _render_brightness(bright), patch, finer
        )
        _write(picture, _label(level, patch), left, HEAD_PX + TILE_PX + 15)
        extent_km = patch.posting_m * patch.size / 1000.0
        _write(picture, f"{extent_km:.4g} km wide", left, HEAD_PX + 2 * TILE_PX + LABEL_PX + 15)
    return picture


def write_png(picture: ByteArray, path: Path) -> None:
    """Write a picture. Raises OutputError for another ending than .png or an unusable place."""
    check_png_place(path)
    done, data = cv2.imencode(".png", picture)
    if not done:
        raise OutputError(f"{path}: a picture of {picture.shape} pixels cannot be coded")
    coded = data.tobytes()
    write_output(path, coded[:HEADER_BYTES] + OUR_MARK + coded[HEADER_BYTES:], _is_ours)


def check_png_place(path: Path) -> None:
    """Raise OutputError for another ending than .png, or a place where no picture can be put."""
    if path.suffix.lower() != ".png":
        raise OutputError(f"{str(path)!r}: the picture is a PNG; choose a name that ends in .png")
    check_file(path, _is_ours)


def _is_ours(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(HEADER_BYTES + len(OUR_MARK))[HEADER_BYTES:] == OUR_MARK


def _draw_head(picture: ByteArray, pyramid: Pyramid) -> None:
    point = pyramid.point
    verdict = "usable" if point.usable else "not usable"
    reasons = point.flags.label
    first = (
        f"control point {point.id}   lat {point.lat_deg:.5f}  lon {point.lon_deg:.5f}   "
        f"{verdict}{': ' + reasons if reasons else ''}"
    )
    tried = f"recognised in {point.recognition_rate:.0%} of {point.trials} trials"
    second = (
        f"{tried if point.trials else 'never tried'}   "
        f"localisation {point.localisation_nodes:.3f} nodes   north up   "
        f"Sun azimuth {SUN_AZIMUTH_DEG:.0f}, elevation {SUN_ELEVATION_DEG:.0f} deg"
    )
    _write(picture, first, GAP_PX, 24, 0.55)
    _write(picture, second, GAP_PX, 48)


def _label(level: int, patch: Patch) -> str:
    known = patch.heights_m[np.isfinite(patch.heights_m)]
    heights = f"{known.min():.0f}..{known.max():.0f} m" if known.size else "no data"
    return f"level {level}  {patch.posting_m:.4g} m  {heights}"


def _write(picture: ByteArray, text: str, x: int, y: int, size: float = 0.42) -> None:
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, _INK, 1, cv2.LINE_AA)


def _draw_tile(
    picture: ByteArray, top: int, left: int, tile: ByteArray, patch: Patch, finer: Patch | None
) -> None:
    """Put a tile in its place, pixels enlarged, with the box of the finer level."""
    large = cv2.resize(tile, (TILE_PX, TILE_PX), interpolation=cv2.INTER_CUBIC)
    picture[top : top + TILE_PX, left : left + TILE_PX] = large
    if finer is not None:
        share = finer.posting_m * finer.size / (patch.posting_m * patch.size)
        half = round(TILE_PX * share / 2.0)
        x, y = left + TILE_PX // 2, top + TILE_PX // 2
        cv2.rectangle(picture, (x - half, y - half), (x + half, y + half), _FRAME, 1)


def _render_heights(patch: Patch) -> ByteArray:
    heights = patch.heights_m
    known = np.isfinite(heights)
    if not known.any():
        return np.full((*heights.shape, 3), _NO_DATA, dtype=np.uint8)
    low, high = float(heights[known].min()), float(heights[known].max())
    filled = np.where(known, heights, low)
    share = (filled - low) / max(high - low, 1e-6)
    colours = cv2.applyColorMap(np.rint(255.0 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS)
    southward, eastward = np.gradient(filled.astype(np.float64), patch.posting_m)
    # exaggerated to a slope that reads well, whatever the terrain's: this is a map, not a view
    lean = np.hypot(eastward, southward)
    strength = 0.6 / max(float(np.percentile(lean[known], 90.0)), 1e-9)
    # ground that rises away from the north-west faces the light
    facing = strength * (eastward + southward) / np.sqrt(2.0)
    shade = np.clip(0.75 + 0.35 * facing, 0.25, 1.2)
    toned: ByteArray = np.clip(colours * shade[..., None], 0.0, 255.0).astype(np.uint8)
    toned[~known] = _NO_DATA
    return toned


def _render_brightness(brightness: Float32Array) -> ByteArray:
    known = np.isfinite(brightness)
    lit = brightness[known & (brightness > 0.0)]
    top = float(np.percentile(lit, 99.5)) if lit.size else 1.0
    scaled = np.clip(np.where(known, brightness, 0.0) / top, 0.0, 1.0)
    grey = np.rint(255.0 * scaled**0.8).astype(np.uint8)
    tile = np.repeat(grey[..., None], 3, axis=2)
    tile[~known] = _NO_DATA
    return tile
