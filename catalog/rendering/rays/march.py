"""Where a ray meets a height grid on a sphere, however steep or grazing it is.

The ray is followed from block to block. A block whose highest node stays below the ray is crossed
in one step; in the last instance single cells are tested, so no crest is jumped. Places along the
ray are second-order polynomials (of gnomonic coordinates) about an anchor that moves on every 10
km, within 0.2 m of the exact ones, so that a step needs no trigonometry and no division. Nearer
than 7 deg to a pole the anchor moves more often. `intersect_ground` nests two
grids: a fine one over a region, a smooth one of the body around it.
"""

from typing import NamedTuple

import numpy as np

from catalog.geometry.grid import interpolate_bicubic, interpolate_bilinear
from catalog.geometry.kernel import kernel
from catalog.rendering.rays.ground import Ground, locate_on_grid

LEFT, HIT, DARK = 0, 1, 2  # how a walk ends: out of the grid or the range, on the ground, in shadow
ANCHOR_REACH = 0.006  # rad
POLE_REACH = 0.05  # of the distance from the axis: places are off by 4e-5 of that distance
MAX_STEPS = 20_000  # a grid's diagonal cell by cell; only a stop for what should not happen
CROSSING_M = 0.01  # how well a crossing is found
MAX_PARTS = 2.0**24  # of a step, whatever its length
_NUDGE = 1e-3  # nodes that a step goes beyond a block's border
SKY, FINE, WIDE = 0, 1, 2  # what a ray meets
# Steeper slopes than this do not occur on a grid of kilometres (a 35 deg wall between two nodes);
# steps along a ray are no longer than its height over such a slope allows.
STEEPEST_WIDE_SLOPE = 0.5
_CLOSE_M = 0.3  # a ray this near to the wide ground has met it
_MAX_TRACE_STEPS = 2000


class Ray(NamedTuple):
    """Origin (m) and unit direction of a ray, body frame."""

    ox: float
    oy: float
    oz: float
    dx: float
    dy: float
    dz: float


@kernel
def _get_block_max(ground: Ground, level: int, row: int, col: int) -> float:
    if level == 0:
        top = ground.highest_4[row >> 2, col >> 2]
    elif level == 1:
        top = ground.highest_16[row >> 4, col >> 4]
    elif level == 2:
        top = ground.highest_64[row >> 6, col >> 6]
    else:
        top = ground.highest_256[row >> 8, col >> 8]
    return float(top)


@kernel
def walk(
    ground: Ground, ray: Ray, start: float, end: float, level: int, darkness: float
) -> tuple[int, float, float, float, float]:
    """Follow a ray over a grid.

    start, end  m along the ray; at `start` the ray is above the ground
    level       0..3: blocks of 4, 16, 64 or 256 nodes to try first
    darkness    0: stop at the first hit. Positive (a shadow test along a Sun's lower limb): keep
                the deepest angle (rad, seen from the origin) that terrain reaches above the ray,
                stop when it reaches this value
    Returns (LEFT | HIT | DARK, distance, row, col, deepest angle).
    """
    ox, oy, oz, dx, dy, dz = ray
    last_row, last_col = ground.heights.shape[0] - 1.0, ground.heights.shape[1] - 1.0
    per_lat, per_lon = 1.0 / ground.step_lat, 1.0 / ground.step_lon
    t, reach, anchor, deepest = 0.0, -1.0, start, 0.0
    # row, column and height over the sphere as polynomials of the way t from the anchor
    r0 = r1 = r2 = c0 = c1 = c2 = h0 = h1 = h2 = 0.0
    slow_row = slow_col = row = col = 0.0
    row_up = col_up = 0
    for _ in range(MAX_STEPS):
        if t > reach:
            anchor += t
            t = 0.0
            px, py, pz = ox + anchor * dx, oy + anchor * dy, oz + anchor * dz
            flat = max(np.sqrt(px * px + py * py), 1e-3)
            r = np.sqrt(flat * flat + pz * pz)
            east = np.arctan2(py, px) - ground.west
            east -= 2.0 * np.pi * np.floor(east / (2.0 * np.pi))
            cos_lat, tan_lat = flat / r, pz / flat
            du = (px * dx + py * dy + pz * dz) / r
            de = (px * dy - py * dx) / flat
            dn = (dz - du * pz / r) / cos_lat
            reach = ANCHOR_REACH * r
            sideways = np.sqrt(de * de + dn * dn)
            if reach * sideways > POLE_REACH * flat:
                # near a pole longitudes turn fast; half a cell beside it they mean nothing
                reach = max(POLE_REACH * flat, 0.5 * ground.step_lat * ground.radius_m) / sideways
            inverse = 1.0 / r
            h0, h1, h2 = r - ground.radius_m, du, 0.5 * (de * de + dn * dn) * inverse
            r0 = (ground.north - np.arctan2(pz, flat)) * per_lat
            r1 = -dn * inverse * per_lat
            r2 = (dn * du + 0.5 * de * de * tan_lat) * inverse * inverse * per_lat
            c0 = east * per_lon
            c1 = de * inverse * per_lon / cos_lat
            c2 = de * (dn * tan_lat - du) * inverse * inverse * per_lon / cos_lat
            slow_row = 1.0 / r1 if abs(r1) > 1e-12 else 1e12
            slow_col = 1.0 / c1 if abs(c1) > 1e-12 else 1e12
            row_up, col_up = int(r1 > 0.0), int(c1 > 0.0)
        row, col = r0 + t * (r1 + t * r2), c0 + t * (c1 + t * c2)
        if not (0.0 <= row < last_row and 0.0 <= col < last_col) or anchor + t >= end:
            return LEFT, anchor + t, row, col, deepest
        height = h0 + t * (h1 + t * h2)
        i, j = int(row), int(col)
        shift = 2 * level + 2 if level >= 0 else 0
        # to the nearer of the block's borders in the ray's direction
        row_line, col_line = (i >> shift) + row_up, (j >> shift) + col_up
        row_step = (abs((row_line << shift) - row) + _NUDGE) * abs(slow_row)
        col_step = (abs((col_line << shift) - col) + _NUDGE) * abs(slow_col)
        step = min(row_step, col_step, end - anchor - t, 1.01 * reach)
        after = height + step * (h1 + (2.0 * t + step) * h2)
        if level >= 0:
            # a ray that sinks and rises again inside the block is lowest between
            if min(height, after) - 0.25 * step * step * h2 > _get_block_max(ground, level, i, j):
                t += step
                level = min(level + 1, 3)
            else:
                level -= 1
            continue
        ahead = t + step
        next_row, next_col = r0 + ahead * (r1 + ahead * r2), c0 + ahead * (c1 + ahead * c2)
        clearance = after - interpolate_bilinear(ground.heights, next_row, next_col)
        if clearance < 0.0:
            if darkness <= 0.0:
                over = next_row - row, next_col - col
                way = refine(ground, step, (row, col), over, (height, after))
                row, col = row + way * over[0], col + way * over[1]
                return HIT, anchor + t + way * step, row, col, 0.0
            deepest = max(deepest, -clearance / (anchor + ahead))
            if deepest >= darkness:
                return DARK, anchor + ahead, next_row, next_col, deepest
        t = ahead
        level = 0
    return LEFT, end, row, col, deepest


@kernel
def _is_clear(
    ground: Ground,
    t: float,
    place: tuple[float, float],
    over: tuple[float, float],
    heights: tuple[float, float],
) -> bool:
    """Whether a ray is above the ground at t in 0..1 of a step; see `refine`."""
    ray = heights[0] + t * (heights[1] - heights[0])
    return ray > interpolate_bilinear(
        ground.heights, place[0] + t * over[0], place[1] + t * over[1]
    )


@kernel
def refine(
    ground: Ground,
    step: float,
    place: tuple[float, float],
    over: tuple[float, float],
    heights: tuple[float, float],
) -> float:
    """Where in 0..1 of a step within one cell the ray crosses the ground: bisection to 1 cm.

    step     m;  over  rows and columns of the step from `place` on;  heights  m, its two ends
    """
    parts = 2.0
    while step >= CROSSING_M * parts and parts < MAX_PARTS:
        parts *= 2.0
    # Over a cell the clearance is quadratic in t, so its root names the part that bisection would
    # end in. Where the step goes beyond the cell's border, that part may turn out to be another.
    grid, (rows, cols) = ground.heights, over
    r, c = int(place[0]), int(place[1])
    y, x = place[0] - r, place[1] - c
    south, east = grid[r + 1, c] - grid[r, c], grid[r, c + 1] - grid[r, c]
    twist = grid[r + 1, c + 1] - grid[r + 1, c] - east
    clear = heights[0] - grid[r, c] - y * south - x * (east + y * twist)
    sink = heights[0] - heights[1] + rows * (south + x * twist) + cols * (east + y * twist)
    root = 2.0 * clear / (sink + np.sqrt(max(sink * sink + 4.0 * twist * rows * cols * clear, 0.0)))
    if 0.0 < root < 1.0:
        low = np.floor(root * parts) / parts
        high = low + 1.0 / parts
        if _is_clear(ground, low, place, over, heights) and (
            high == 1.0 or not _is_clear(ground, high, place, over, heights)
        ):
            return float(0.5 * (low + high))
    low, high = 0.0, 1.0
    while (high - low) * parts > 1.0:
        t = 0.5 * (low + high)
        if _is_clear(ground, t, place, over, heights):
            low = t
        else:
            high = t
    return 0.5 * (low + high)


@kernel
def _bound_box_distance(fine: Ground, lat: float, lon: float) -> float:
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
def intersect_ground(
    fine: Ground, wide: Ground, ray: Ray, hint: float
) -> tuple[int, float, float, float]:
    """First crossing of a ray with the ground.

    fine, wide  inside the box of `fine` its heights are the ground, outside those of `wide`
    hint        a distance (m) where the ray is known to be above the fine ground; 0 for unknown
    Returns (SKY | FINE | WIDE, distance, row, col), row and column on the grid that was met.
    """
    ox, oy, oz, dx, dy, dz = ray
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
    for _ in range(_MAX_TRACE_STEPS):
        if s >= end:
            break
        px, py, pz = ox + s * dx, oy + s * dy, oz + s * dz
        row, col = locate_on_grid(fine, px, py, pz)
        if 0.0 <= row < rows - 1 and 0.0 <= col < cols - 1:
            how, at, row, col, _ = walk(fine, ray, s, end, level, 0.0)
            if how == HIT:
                return FINE, at, row, col
            s = max(at, s) + 1.0
            last, last_clear = s, np.inf
            continue
        r = np.sqrt(px * px + py * py + pz * pz)
        row, col = locate_on_grid(wide, px, py, pz)
        clear = r - radius - interpolate_bicubic(wide.heights, row, col)
        if clear < _CLOSE_M:
            if clear < -_CLOSE_M and last_clear < np.inf:
                s = last + (s - last) * last_clear / (last_clear - clear)
                row, col = locate_on_grid(wide, ox + s * dx, oy + s * dy, oz + s * dz)
            return WIDE, s, row, col
        last, last_clear = s, clear
        climb = (px * dx + py * dy + pz * dz) / r
        flat = np.sqrt(max(1.0 - climb * climb, 1e-12))
        step = clear / (max(-climb, 0.0) + STEEPEST_WIDE_SLOPE * flat)
        lat, lon = np.arctan2(pz, np.sqrt(px * px + py * py)), np.arctan2(py, px)
        # over the ground the ray moves at most `flat` times its own way (and it is above it)
        s += max(min(step, max(_bound_box_distance(fine, lat, lon) / flat, 1.0)), 0.1)
    return SKY, np.inf, 0.0, 0.0
