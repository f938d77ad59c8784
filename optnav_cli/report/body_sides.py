"""A small body seen from its six sides, drawn from the relief that its catalog carries.

A side shows the body from so far that there is no perspective, under a Sun from the upper left.
What is in shadow gets some light from the lower right: this is a map of the body, not a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup

from catalog.arrays import ByteArray, FloatArray, IntArray
from catalog.errors import DataError, UsageError
from catalog.geometry.latlon import xyz_from_latlon
from catalog.photometry.sets import HapkeParameters
from catalog.rendering.mesh_scene import MeshScene
from catalog.store.reader import Catalog
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.output.canvas import FONT, SUBPIXEL_BITS
from optnav_cli.report.catalog_maps import (
    POINT_COLOURS,
    find_first_reasons,
    list_legend_entries,
    list_titles,
)
from optnav_cli.report.page import count_things, encode_picture_uri, figure, legend, side_by_side
from optnav_cli.report.svg import Plot
from optnav_cli.report.views import THIRD, parse_colour

# Where the viewer stands, what is up for him, what the side is called.
SIDES = (
    ((1, 0, 0), (0, 0, 1), "+x: longitude 0"),
    ((0, 1, 0), (0, 0, 1), "+y: longitude 90 east"),
    ((0, 0, 1), (-1, 0, 0), "+z: north pole, longitude 0 below"),
    ((-1, 0, 0), (0, 0, 1), "-x: longitude 180"),
    ((0, -1, 0), (0, 0, 1), "-y: longitude 90 west"),
    ((0, 0, -1), (1, 0, 0), "-z: south pole, longitude 0 above"),
)
MAX_ROWS = 360  # of the drawn relief: two pixels of a side a cell
ROOM = 1.1  # of the picture about the body
AWAY = 5000.0  # reaches of the body to the viewer: perspective is a hundredth of a pixel
SAMPLES = 3  # rays a side of a pixel, where the ground changes
SUN_ASIDE_DEG = 45.0  # from the line of sight
FILL_ASIDE_DEG, FILL = 55.0, 0.3  # the second light, and its share of all
GAMMA = 0.8
HIDDEN_CELLS = 3.0  # a point so far behind the ground is behind it
GRATICULE_DEG = 30
LINE_STEP_DEG = 2.0
MARGIN = 1.002  # lines run so far over the relief, not to sink into it
COLUMNS = 3
SIDE_PX = 400
GAP_PX, HEAD_PX, ROW_PX = 8, 34, 22
SHARPNESS = 1.5  # pixels of a page's picture a unit of its drawing
PAPER, INK, SOFT, RIM = (250, 250, 250), (40, 40, 40), (235, 235, 235), (28, 21, 16)
LINE = (255, 255, 255)
LINE_STRENGTH = 0.35
DOT_PX = 4.5
BAR_SHARE = 0.25  # of a side's width that a scale bar has at most


@dataclass(frozen=True, eq=False)
class Side:
    """One view.

    name    which
    half_m  half a side of the picture on the body
    gray    (h, h) uint8, 0 for the sky
    places  (n, 2) m right and up from the origin, of the catalog's points; NaN where hidden
    lines   of the graticule (k, 2) m, NaN where hidden
    """

    name: str
    half_m: float
    gray: ByteArray
    places: FloatArray
    lines: list[FloatArray]


def has_sides(catalog: Catalog) -> bool:
    """Whether a catalog is of a body so small that it is drawn whole, and carries its relief."""
    return catalog.meta.planes is not None and catalog.meta.relief is not None


def draw_sides(catalog: Catalog, size_px: int) -> list[Side]:
    """Draw six views of the body, pictures of size_px a side.

    Raises UsageError for a large body; DataError for a catalog that carries no relief or a damaged
    one, or a machine without embree's rays.
    """
    if catalog.meta.planes is None:
        raise UsageError(
            f"{catalog.path}: {catalog.meta.body} is too large to be drawn with its points; name "
            "one of them, or see `optnav report` for maps"
        )
    relief = catalog.relief()
    if relief is None:
        raise DataError(
            f"{catalog.path}: carries no relief to draw the body from; build it again from a "
            "[[mesh]], or from a terrain model of the whole body"
        )
    mesh = MeshRays(mesh_relief(relief))
    records = catalog.records
    lat, lon = np.radians(catalog.lat_deg), np.radians(catalog.lon_deg)
    points = xyz_from_latlon(lat, lon, np.asarray(records["radius_m"], np.float64))
    lines = _trace_graticule(relief)
    hidden_m = HIDDEN_CELLS * relief.posting_m * max(1.0, len(relief.heights) / MAX_ROWS)
    surface = catalog.meta.ground.surface
    return [_draw_side(mesh, surface, side, size_px, points, lines, hidden_m) for side in SIDES]


def mesh_relief(relief: GlobalRelief) -> FloatArray:
    """Mesh the relief's mean heights: closed, (m, 3, 3) m, counter-clockwise from outside.

    More than MAX_ROWS rows are averaged to as many or fewer.
    """
    factor = -(-relief.heights.shape[0] // MAX_ROWS)
    heights = relief.heights.astype(np.float64)
    rows = heights.shape[0] // factor
    heights = heights[: rows * factor, : 2 * rows * factor]
    heights = heights.reshape(rows, factor, 2 * rows, factor).mean(axis=(1, 3))
    step = factor * relief.step_rad
    lat = np.pi / 2.0 - (np.arange(rows) + 0.5) * step
    lon = -np.pi + (np.arange(2 * rows) + 0.5) * step
    grid = xyz_from_latlon(lat[:, None], lon[None, :], relief.radius_m + heights)
    grid = np.concatenate([grid, grid[:, :1]], axis=1)
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    parts = [np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]
    for row, turn in ((0, 1), (rows - 1, -1)):
        ring = grid[row]
        pole = np.broadcast_to(ring[:-1].mean(axis=0) * [0.0, 0.0, 1.0], ring[:-1].shape)
        parts.append(np.stack([pole, ring[:-1], ring[1:]][::turn], axis=1)[:, None])
    return np.concatenate([part.reshape(-1, 3, 3) for part in parts])


def _trace_graticule(relief: GlobalRelief) -> list[FloatArray]:
    """Trace parallels and meridians (k, 3) m on the relief."""
    along = np.radians(np.arange(-180.0, 180.0 + LINE_STEP_DEG, LINE_STEP_DEG))
    upward = np.radians(np.arange(-90.0, 90.0 + LINE_STEP_DEG, LINE_STEP_DEG))
    parallels = np.radians(range(-90 + GRATICULE_DEG, 90, GRATICULE_DEG))
    curves = [(np.full_like(along, lat), along) for lat in parallels]
    meridians = np.radians(range(-180, 180, GRATICULE_DEG))
    curves += [(upward, np.full_like(upward, lon)) for lon in meridians]
    return [
        MARGIN * xyz_from_latlon(lat, lon, relief.radius_m + relief.heights_at(lat, lon))
        for lat, lon in curves
    ]


def _draw_side(
    mesh: MeshRays,
    surface: HapkeParameters,
    side: tuple[tuple[int, ...], tuple[int, ...], str],
    size_px: int,
    points: FloatArray,
    lines: list[FloatArray],
    hidden_m: float,
) -> Side:
    toward, up = np.array(side[0], np.float64), np.array(side[1], np.float64)
    right = np.cross(up, toward)
    half = ROOM * mesh.reach_m
    viewer = AWAY * mesh.reach_m * toward
    edges = np.linspace(-half, half, size_px + 1)
    rays = edges[None, :, None] * right - edges[:, None, None] * up - viewer
    rays /= np.linalg.norm(rays, axis=2)[..., None]
    light = np.zeros((size_px, size_px))
    for aside_deg, share in ((SUN_ASIDE_DEG, 1.0 - FILL), (-FILL_ASIDE_DEG, FILL)):
        aside = np.radians(aside_deg)
        sun = np.cos(aside) * toward + np.sin(aside) * (up - right) / np.sqrt(2.0)
        bright = MeshScene(mesh, sun, surface).picture(viewer, rays, SAMPLES)
        light += share * bright / max(float(np.percentile(bright[bright > 0.0], 99.5)), 1e-9)
    gray = np.rint(255.0 * np.clip(light, 0.0, 1.0) ** GAMMA).astype(np.uint8)

    def hide_behind(places: FloatArray) -> FloatArray:
        sight = places - viewer
        distances = np.linalg.norm(sight, axis=1)
        _, met = mesh.find_first_hits(viewer, sight / distances[:, None])
        flat = np.column_stack([places @ right, places @ up])
        flat[met < distances - hidden_m] = np.nan
        return flat

    return Side(side[2], half, gray, hide_behind(points), [hide_behind(line) for line in lines])


def build_sides_figure(catalog: Catalog) -> Markup:
    """Build HTML of the six sides with their points. Raises as `draw_sides` does."""
    kinds = find_first_reasons(catalog)
    colours = [POINT_COLOURS[kind] for kind in kinds.tolist()]
    drawings = []
    for side in draw_sides(catalog, round(SHARPNESS * THIRD)):
        half = side.half_m / 1e3
        ends = (-half, half)
        plot = Plot(ends, ends, width=THIRD, height=THIRD, axes=False, margins=(0, 0, 0, 0))
        plot.picture(encode_picture_uri(side.gray))
        for line in side.lines:
            plot.line(line[:, 0] / 1e3, line[:, 1] / 1e3, "graticule")
        x, y = side.places.T / 1e3
        plot.dots(x, y, "ringed", 3.6, list_titles(catalog, kinds), colours)
        plot.text(-0.97 * half, 0.91 * half, side.name, "halo")
        bar = _choose_bar_km(side)
        plot.line((0.95 * half - bar, 0.95 * half), (-0.95 * half, -0.95 * half), "scale")
        plot.text(0.95 * half, -0.91 * half, f"{bar:g} km", "halo", "end")
        drawings.append(plot.svg(f"Control points seen from {side.name}"))
    caption = (
        "Where the points are, on the relief that the catalog carries; lines every 30°. A point is "
        "coloured by the first check that it failed."
    )
    return figure(
        side_by_side("triple", drawings), caption, extra=legend(list_legend_entries(kinds))
    )


def draw_sides_picture(catalog: Catalog) -> ByteArray:
    """Draw the six sides with their points, a scale and a legend, (h, w, 3) blue, green, red.

    Raises as `sides` does.
    """
    kinds = find_first_reasons(catalog)
    tiles = [_draw_tile(side, kinds) for side in draw_sides(catalog, SIDE_PX)]
    rows = [_join_tiles(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
    width = rows[0].shape[1]
    head = np.full((HEAD_PX, width, 3), PAPER, np.uint8)
    usable = int(np.count_nonzero(catalog.usable))
    words = (
        f"{catalog.meta.body}: {catalog.path.name}, {count_things(len(catalog), 'control point')}"
    )
    _write(head, f"{words}, {usable} usable", GAP_PX, 22, INK, 0.55)
    return np.vstack([head, *rows, _draw_legend(width, kinds)])


def _draw_tile(side: Side, kinds: IntArray) -> ByteArray:
    bare: ByteArray = np.repeat(side.gray[..., None], 3, axis=2)
    lined = bare.copy()
    for line in side.lines:
        _draw_polyline(lined, _project_to_pixels(line, side), LINE, 1)
    mixed = cv2.addWeighted(lined, LINE_STRENGTH, bare, 1.0 - LINE_STRENGTH, 0.0)
    tile = np.asarray(mixed, np.uint8)
    for (x, y), kind in zip(_project_to_pixels(side.places, side), kinds.tolist(), strict=True):
        if np.isfinite(x):
            _draw_dot(tile, x, y, POINT_COLOURS[kind])
    _write(tile, side.name, 10, 20, SOFT)
    bar = _choose_bar_km(side)
    across = bar * 1e3 / (2.0 * side.half_m) * SIDE_PX
    end, foot = SIDE_PX - 12.0, SIDE_PX - 14.0
    _draw_polyline(tile, np.array([[end - across, foot], [end, foot]]), SOFT, 2)
    _write(tile, f"{bar:g} km", round(end - across), SIDE_PX - 22, SOFT)
    return tile


def _choose_bar_km(side: Side) -> float:
    """Choose the longest round length that a scale bar has room for."""
    most = BAR_SHARE * 2.0 * side.half_m / 1e3
    unit = 10.0 ** np.floor(np.log10(most))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * unit <= most) * unit)


def _project_to_pixels(places: FloatArray, side: Side) -> FloatArray:
    """Project places (n, 2), m right and up of the middle, to picture x, y (n, 2)."""
    scale = SIDE_PX / (2.0 * side.half_m)
    middle = (SIDE_PX - 1) / 2.0
    return np.column_stack([middle + scale * places[:, 0], middle - scale * places[:, 1]])


def _draw_polyline(
    picture: ByteArray, points: FloatArray, colour: tuple[int, int, int], width: int
) -> None:
    """Draw a line through points (n, 2) px, broken where one is not finite."""
    for run in np.split(points, np.flatnonzero(~np.isfinite(points[:, 0]))):
        run = run[np.isfinite(run[:, 0])]
        fixed = np.rint(run * 2**SUBPIXEL_BITS).astype(np.int32)
        cv2.polylines(picture, [fixed], False, colour, width, cv2.LINE_AA, SUBPIXEL_BITS)


def _draw_dot(picture: ByteArray, x: float, y: float, colour: str) -> None:
    at = round(x * 2**SUBPIXEL_BITS), round(y * 2**SUBPIXEL_BITS)
    for radius, shade in ((DOT_PX, RIM), (DOT_PX - 1.1, parse_colour(colour))):
        fixed = round(radius * 2**SUBPIXEL_BITS)
        cv2.circle(picture, at, fixed, shade, -1, cv2.LINE_AA, SUBPIXEL_BITS)


def _join_tiles(tiles: Sequence[ByteArray]) -> ByteArray:
    """Join tiles in a row on paper, with gaps about them."""
    height, width = tiles[0].shape[:2]
    row = np.full((height + GAP_PX, len(tiles) * (width + GAP_PX) + GAP_PX, 3), PAPER, np.uint8)
    for k, tile in enumerate(tiles):
        left = GAP_PX + k * (width + GAP_PX)
        row[:height, left : left + width] = tile
    return row


def _draw_legend(width: int, kinds: IntArray) -> ByteArray:
    """Draw the meaning of the dots, in columns as wide as the sides."""
    entries = list_legend_entries(kinds)
    column = SIDE_PX + GAP_PX
    strip = np.full((ROW_PX * -(-len(entries) // COLUMNS) + 6, width, 3), PAPER, np.uint8)
    for number, (colour, words) in enumerate(entries):
        row, column_number = divmod(number, COLUMNS)
        x, y = GAP_PX + column * column_number, ROW_PX * row + 16
        _draw_dot(strip, x + 6.0, y - 4.5, colour)
        words = words.encode("ascii", "replace").decode("ascii")  # the font has nothing else
        _write(strip, words, x + 18, y, INK)
    return strip


def _write(
    picture: ByteArray, words: str, x: int, y: int, colour: tuple[int, int, int], size: float = 0.45
) -> None:
    cv2.putText(picture, words, (x, y), FONT, size, colour, 1, cv2.LINE_AA)
