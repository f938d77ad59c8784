"""Where rays meet the terrain: a fine grid over a region, a smooth grid of the body around it."""

import numpy as np

from catalog.geometry.grid import bicubic_at
from catalog.geometry.kernel import kernel
from catalog.rendering.rays.ground import Ground, grid_place
from catalog.rendering.rays.march import HIT, walk

SKY, FINE, WIDE = 0, 1, 2  # what a ray meets
# Steeper slopes than this do not occur on a grid of kilometres (a 35 deg wall between two nodes);
# steps along a ray are no longer than its height over such a slope allows.
STEEPEST_WIDE_SLOPE = 0.5
_CLOSE_M = 0.3  # a ray this near to the wide ground has met it
_MAX_STEPS = 2000


@kernel
def _to_box(fine: Ground, lat: float, lon: float) -> float:
    """A lower bound of the ground distance (m) from a place to the fine grid's box; 0 inside."""
    rows, cols = fine.heights.shape
    south, width = fine.north - (rows - 1) * fine.step_lat, (cols - 1) * fine.step_lon
    far: float = max(0.0, max(lat - fine.north, south - lat))
    east = lon - fine.west
    east -= 2.0 * np.pi * np.floor(east / (2.0 * np.pi))
    if east > width:
        turn = min(east - width, 2.0 * np.pi - east)
        widest = max(abs(lat), abs(fine.north), abs(south))
        # a chord of the smaller circle never exceeds the way over the ground
        far = max(far, 2.0 / np.pi * np.cos(min(widest, 0.5 * np.pi)) * turn)
    return far * fine.radius_m


@kernel
def trace(
    fine: Ground, wide: Ground,
    ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, hint: float,
) -> tuple[int, float, float, float]:  # fmt: skip
    """First crossing of a ray with the ground.

    fine, wide  inside the box of `fine` its heights are the ground, outside those of `wide`
    o, d        origin (m) and unit direction, body frame
    hint        a distance (m) where the ray is known to be above the fine ground; 0 for unknown
    Returns (SKY | FINE | WIDE, distance, row, col), row and column on the grid that was met.
    """
    radius = wide.radius_m
    top = radius + max(fine.highest_m, wide.highest_m) + 1.0
    floor = radius + min(fine.lowest_m, wide.lowest_m) - 1.0
    along = ox * dx + oy * dy + oz * dz
    length = np.sqrt(ox * ox + oy * oy + oz * oz)
    inside = along * along - (length - top) * (length + top)
    if inside <= 0.0:
        return SKY, np.inf, 0.0, 0.0
    start, end = -along - np.sqrt(inside), -along + np.sqrt(inside)
    if end <= 0.0:
        return SKY, np.inf, 0.0, 0.0
    below = along * along - (length - floor) * (length + floor)
    if below > 0.0 and -along - np.sqrt(below) > 0.0:
        end = -along - np.sqrt(below) + 1.0
    s = max(start, hint, 0.0)
    level = 1 if hint > 0.0 else 2
    rows, cols = fine.heights.shape
    last, last_clear = s, np.inf
    for _ in range(_MAX_STEPS):
        if s >= end:
            break
        px, py, pz = ox + s * dx, oy + s * dy, oz + s * dz
        row, col = grid_place(fine, px, py, pz)
        if 0.0 <= row < rows - 1 and 0.0 <= col < cols - 1:
            how, at, row, col, _ = walk(fine, ox, oy, oz, dx, dy, dz, s, end, level, 0.0)
            if how == HIT:
                return FINE, at, row, col
            s = max(at, s) + 1.0
            last, last_clear = s, np.inf
            continue
        r = np.sqrt(px * px + py * py + pz * pz)
        row, col = grid_place(wide, px, py, pz)
        clear = r - radius - bicubic_at(wide.heights, row, col)
        if clear < _CLOSE_M:
            if clear < -_CLOSE_M and last_clear < np.inf:
                s = last + (s - last) * last_clear / (last_clear - clear)
                row, col = grid_place(wide, ox + s * dx, oy + s * dy, oz + s * dz)
            return WIDE, s, row, col
        last, last_clear = s, clear
        climb = (px * dx + py * dy + pz * dz) / r
        flat = np.sqrt(max(1.0 - climb * climb, 1e-12))
        step = clear / (max(-climb, 0.0) + STEEPEST_WIDE_SLOPE * flat)
        lat, lon = np.arctan2(pz, np.sqrt(px * px + py * py)), np.arctan2(py, px)
        # over the ground the ray moves at most `flat` times its own way (and it is above it)
        s += max(min(step, max(_to_box(fine, lat, lon) / flat, 1.0)), 0.1)
    return SKY, np.inf, 0.0, 0.0
