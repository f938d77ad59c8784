"""The skyline that terrain outside a patch makes, as the patch's own ground sees it.

Of every vertical plane through the patch two profiles are taken: the ground inside the patch, and
the ground outside towards the azimuth, from the coarser grids about the same centre, each from
where the finer one ends. The limit of the plane is the steepest line from a point inside to a point
outside. It is raised from plane to plane: most planes hold no steeper one, and ground whose highest
nodes about a few points are too low for it is skipped. Heights are those over the centre's tangent
plane: curvature is in.
Coarse grids hold area means: a peak narrower than their posting is lowered. The planes stand three
nodes apart, the bins are sampled every 5 deg: on steep ground across the border of the patch the
limit is up to 0.5 deg low (measured on Tycho's wall).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import inplace_kernel, kernel

AZIMUTHS = 36
# A bin covers 10 deg; its limit is the greatest at its middle and its two borders.
PER_BIN = 2
LINE_SPACING_NODES = 3.0  # between planes, nodes of the patch
INNER_STEP_NODES = 2.0  # between points of the inside profile
GROUP = 8  # points outside that are looked at together; also nodes a side of a block of `tops`


class Plane(NamedTuple):
    """A vertical plane: points k step (east, north) + across (north, -east), m."""

    across: float
    east: float
    north: float


class SkylineGrids(NamedTuple):
    """Grids (levels, n, n) of heights over the tangent plane, the patch's own first.

    tops         see `_find_tops`
    max_heights  (levels,) of the grids
    postings     (levels,) m
    """

    grids: Float32Array
    tops: Float32Array
    max_heights: Float32Array
    postings: FloatArray


@kernel
def _compute_tangent_heights(
    grids: Float32Array, postings: FloatArray, radius: float
) -> Float32Array:
    """Heights over the tangent plane at the centre, of nodes whose heights are over the sphere."""
    levels, size = grids.shape[0], grids.shape[1]
    out = np.empty(grids.shape, np.float32)
    middle = (size - 1) / 2.0
    for level in range(levels):
        scale = postings[level] / (2.0 * radius)
        for i in range(size):
            v2 = ((i - middle) * scale) ** 2
            for j in range(size):
                q = v2 + ((j - middle) * scale) ** 2
                h = grids[level, i, j]
                out[level, i, j] = (h - q * (h + 2.0 * radius)) / (1.0 + q)
    return out


@inplace_kernel
def _find_inside(origin: float, step: float, top: float) -> tuple[float, float]:
    """Range of k for which 0 <= origin + k step <= top."""
    if abs(step) < 1e-12:
        if 0.0 <= origin <= top:
            return -1e9, 1e9
        return 1.0, -1.0
    a, b = -origin / step, (top - origin) / step
    return min(a, b), max(a, b)


@inplace_kernel
def _find_lowest(s: FloatArray, z: FloatArray, count: int, slope: float) -> int:
    """Which of `count` points (way, height) lies lowest against a line of a slope."""
    lowest, which = np.inf, 0
    for k in range(count):
        over = z[k] - slope * s[k]
        if over < lowest:
            lowest, which = over, k
    return which


@inplace_kernel
def _find_steeper(
    near_s: FloatArray,
    near_z: FloatArray,
    near: int,
    far_s: FloatArray,
    far_z: FloatArray,
    far: int,
    slope: float,
    foot: int,
) -> tuple[float, int]:
    """Greatest slope from one of `near` points up to one of `far` points ahead, or `slope`.

    Points are (way, height); foot is the near point that lies lowest against lines of the slope.
    Returns the slope and its foot. If a steeper line exists, then one from the foot to the far
    point that lies highest; taken as the new slope until none is steeper, it grows to the greatest
    in a few steps (Dinkelbach's method for a ratio).
    """
    while True:
        highest, head = near_z[foot] - slope * near_s[foot], -1
        for k in range(far):
            over = far_z[k] - slope * far_s[k]
            if over > highest:
                highest, head = over, k
        if head < 0:
            return slope, foot
        steeper = (far_z[head] - near_z[foot]) / (far_s[head] - near_s[foot])
        if not steeper > slope:  # but for rounding
            return slope, foot
        slope = steeper
        foot = _find_lowest(near_s, near_z, near, slope)


@inplace_kernel
def _find_crossing(
    size: int, posting: float, step: float, plane: Plane
) -> tuple[float, float, float, float, int, int]:
    """Where a plane, in steps (m), crosses a grid.

    Returns col and row at k = 0, their change a step, and the first and last k inside.
    """
    across, east, north = plane
    middle = (size - 1) / 2.0
    col, row = middle + across * north / posting, middle + across * east / posting
    d_col, d_row = step * east / posting, -step * north / posting
    low_c, high_c = _find_inside(col, d_col, size - 1.0)
    low_r, high_r = _find_inside(row, d_row, size - 1.0)
    first = int(np.ceil(max(low_c, low_r) + 1e-9))
    last = int(np.floor(min(high_c, high_r) - 1e-9))
    return col, row, d_col, d_row, first, last


@inplace_kernel
def _sample_profile(
    grid: Float32Array,
    crossing: tuple[float, float, float, float],
    step: float,
    first: int,
    last: int,
    s: FloatArray,
    z: FloatArray,
) -> int:
    """Fill s, z with way and height of the points k step, k = first..last, that have ground.

    All of them must lie inside the grid; heights are bilinear.
    """
    x, y, dx, dy = crossing
    size = grid.shape[0]
    for k in range(first, last + 1):
        col, row = x + k * dx, y + k * dy
        i, j = min(np.uint64(row), np.uint64(size - 2)), min(np.uint64(col), np.uint64(size - 2))
        dr, dc = row - i, col - j
        i1, j1 = i + np.uint64(1), j + np.uint64(1)
        z[k - first] = (1.0 - dr) * ((1.0 - dc) * grid[i, j] + dc * grid[i, j1]) + dr * (
            (1.0 - dc) * grid[i1, j] + dc * grid[i1, j1]
        )
    count = 0
    for k in range(first, last + 1):
        height = z[k - first]
        if height == height:
            s[count], z[count] = k * step, height
            count += 1
    return count


@kernel
def _find_tops(grids: Float32Array) -> Float32Array:
    """Highest of the nodes that a group's points read, by the block under the group's middle.

    grids (levels, n, n); -inf where no node has a height. A group's points lie within half a group
    of its middle, and are read from nodes less than one further.
    """
    levels, size = grids.shape[0], grids.shape[1]
    blocks, reach = (size + GROUP - 1) // GROUP, GROUP // 2 + 1
    out = np.empty((levels, blocks, blocks), np.float32)
    line = np.empty(size, np.float32)
    for level in range(levels):
        for i in range(blocks):
            line[:] = -np.inf
            for row in range(max(i * GROUP - reach, 0), min((i + 1) * GROUP + reach, size)):
                here = grids[level, row]
                # a plain comparison, which a hole fails: compiled to vector instructions
                for c in range(size):
                    line[c] = here[c] if here[c] > line[c] else line[c]
            for j in range(blocks):
                top = np.float32(-np.inf)
                for c in range(max(j * GROUP - reach, 0), min((j + 1) * GROUP + reach, size)):
                    top = line[c] if line[c] > top else top
                out[level, i, j] = top
    return out


@inplace_kernel
def _find_last_inside(x: float, step: float, top: float) -> float:
    """The greatest k for which x + k step, with x inside, lies within 0 and top."""
    if abs(step) < 1e-12:
        return 1e9
    return (top - x) / step if step > 0.0 else -x / step


@inplace_kernel
def _find_steepest_outside(
    ground: SkylineGrids,
    plane: Plane,
    end: float,
    inside: tuple[FloatArray, FloatArray, int],
    outside: tuple[FloatArray, FloatArray],
    slope: float,
) -> float:
    """Greatest slope in one plane from the points inside up to ground outside, or `slope` (>= 0).

    end      way to the last point of the patch, m
    inside   ways, heights and number of the points of the patch; outside: room for those of a grid
    """
    size, blocks = ground.grids.shape[1], np.uint64(ground.tops.shape[1] - 1)
    across, east, north = plane
    middle = (size - 1) / 2.0
    near_s, near_z, near = inside
    far_s, far_z = outside
    foot = _find_lowest(near_s, near_z, near, slope)
    under = near_z[foot] - slope * near_s[foot]
    for level in range(1, ground.grids.shape[0]):
        step = ground.postings[level]
        col, row = middle + across * north / step, middle + across * east / step
        # from the first step beyond the finer grid, which lies inside of this one
        # 1e-9: a point that both grids share must not, by rounding, be its own horizon
        first = int(np.floor(end / step + 1e-9)) + 1
        reach = min(
            _find_last_inside(col, east, size - 1.0), _find_last_inside(row, -north, size - 1.0)
        )
        last = int(np.floor(reach - 1e-9))
        end = max(end, last * step)
        # where even the grid's top stays under a line of that slope, there is nothing to look for
        if not ground.max_heights[level] - under > slope * first * step:
            continue
        for begin in range(first, last + 1, GROUP):
            # the last group's middle may lie outside
            half = begin + 0.5 * (GROUP - 1)
            i = min(np.uint64(max(row - half * north, 0.0)) // np.uint64(GROUP), blocks)
            j = min(np.uint64(max(col + half * east, 0.0)) // np.uint64(GROUP), blocks)
            if not ground.tops[level, i, j] - under > slope * begin * step:
                continue
            stop, crossing = min(begin + GROUP - 1, last), (col, row, east, -north)
            far = _sample_profile(ground.grids[level], crossing, step, begin, stop, far_s, far_z)
            slope, foot = _find_steeper(near_s, near_z, near, far_s, far_z, far, slope, foot)
            under = near_z[foot] - slope * near_s[foot]
    return slope


@inplace_kernel
def _find_limits_along(
    ground: SkylineGrids, east: float, north: float, room: FloatArray
) -> tuple[float, float]:
    """Tangents of the greatest elevation of outside ground towards (east, north) and away from it.

    room (4, 2 n) to work in. Zero where nothing stands above the horizontal.
    """
    size, posting = ground.grids.shape[1], ground.postings[0]
    corner = (size - 1) / 2.0 * posting * (abs(east) + abs(north))
    spacing, step = LINE_SPACING_NODES * posting, INNER_STEP_NODES * posting
    near_s, near_z = room[0], room[1]
    outside = room[2], room[3]
    towards = behind = 0.0
    lines = int(2.0 * corner / spacing) + 1
    for line in range(lines):
        across = (line - (lines - 1) / 2.0) * spacing
        plane = Plane(across, east, north)
        col, row, d_col, d_row, first, last = _find_crossing(size, posting, step, plane)
        crossing = col, row, d_col, d_row
        near = _sample_profile(ground.grids[0], crossing, step, first, last, near_s, near_z)
        if near == 0:
            continue
        inside = near_s, near_z, near
        towards = _find_steepest_outside(ground, plane, last * step, inside, outside, towards)
        # the same plane, seen the other way
        for k in range(near):
            near_s[k] = -near_s[k]
        plane = Plane(-across, -east, -north)
        behind = _find_steepest_outside(ground, plane, -first * step, inside, outside, behind)
    return towards, behind


@kernel
def _find_limits(
    heights: Float32Array, postings: FloatArray, radius: float, per_bin: int
) -> FloatArray:
    grids = _compute_tangent_heights(heights, postings, radius)
    tops = _find_tops(grids)
    max_heights = np.empty(postings.size, np.float32)
    for level in range(postings.size):
        max_heights[level] = tops[level].max()
    ground = SkylineGrids(grids, tops, max_heights, postings)
    half = AZIMUTHS * per_bin // 2
    tangents = np.empty(2 * half)
    room = np.empty((4, 2 * heights.shape[1]))
    for k in range(half):
        azimuth = math.pi * k / half
        tangents[k], tangents[k + half] = _find_limits_along(
            ground, math.sin(azimuth), math.cos(azimuth), room
        )
    return tangents


def compute_skyline_limits_deg(
    levels: Sequence[tuple[Float32Array, float]], patch_level: int, radius_m: float
) -> FloatArray:
    """Sun elevation by azimuth above which ground outside a patch throws no shadow into it.

    levels       (heights (n, n) float32, posting_m) of grids about one centre, finest first
    patch_level  which of them is the patch; the coarser ones are the ground outside
    radius_m     radius of the reference sphere
    Returns (36,) deg for bins centred on 0, 10, ... deg east of north, not below zero (also where
    there is no coarser level: nothing is known outside). Elevation and azimuth are the Sun's at the
    centre of the patch.
    Raises ValueError for grids of different sizes or a patch level that does not exist.
    """
    if not 0 <= patch_level < len(levels):
        raise ValueError(f"skyline: there are {len(levels)} levels, not a level {patch_level}")
    used = levels[patch_level:]
    if any(heights.shape != used[0][0].shape for heights, _ in used):
        raise ValueError("skyline: all levels must have the same number of nodes")
    if len(used) == 1:
        return np.zeros(AZIMUTHS)
    grids = np.stack([heights for heights, _ in used]).astype(np.float32)
    postings = np.array([posting for _, posting in used], dtype=np.float64)
    tangents = _find_limits(grids, postings, float(radius_m), PER_BIN)
    angles = np.degrees(np.arctan(tangents)).reshape(AZIMUTHS, PER_BIN)
    # the border between two bins belongs to both
    middle, border = angles[:, 0], angles[:, PER_BIN // 2]
    limits: FloatArray = np.maximum(np.maximum(np.maximum(middle, border), np.roll(border, 1)), 0.0)
    return limits
