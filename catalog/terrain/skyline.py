"""The skyline that terrain outside a patch makes, as the patch's own ground sees it.

Of every vertical plane through the patch two profiles are taken: the ground inside the patch, and
the ground outside towards the azimuth, from the coarser grids about the same centre, each from
where the finer one ends. The limit of the plane is the steepest line from a point inside to a point
outside; only points of the upper convex hull of the outside can touch it, so it costs a walk along
that hull instead of all pairs. Heights are those over the centre's tangent plane: curvature is in.
Coarse grids hold area means: a peak narrower than their posting is lowered. The planes stand three
nodes apart, the bins are sampled every 5 deg: on steep ground across the border of the patch the
limit is up to 0.5 deg low (measured on Tycho's wall).
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from catalog.geometry.kernel import kernel

FloatArray = NDArray[np.float64]
HeightGrid = NDArray[np.float32]

AZIMUTHS = 36
# A bin covers 10 deg; its limit is the greatest at its middle and its two borders.
PER_BIN = 2
LINE_SPACING_NODES = 3.0  # between planes, nodes of the patch
INNER_STEP_NODES = 2.0  # between points of the inside profile


@kernel
def _tangent_heights(grids: HeightGrid, postings: FloatArray, radius: float) -> FloatArray:
    """Heights over the tangent plane at the centre, of nodes whose heights are over the sphere."""
    levels, size = grids.shape[0], grids.shape[1]
    out = np.empty(grids.shape)
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


@kernel
def _profile(
    grid: FloatArray,
    x: float,
    y: float,
    dx: float,
    dy: float,
    first: int,
    last: int,
    heights: FloatArray,
) -> None:
    """Bilinear heights at (x, y) + k (dx, dy), k = first..last, in nodes; all must lie inside."""
    size = grid.shape[0]
    for k in range(first, last + 1):
        col, row = x + k * dx, y + k * dy
        i, j = min(np.uint64(row), np.uint64(size - 2)), min(np.uint64(col), np.uint64(size - 2))
        dr, dc = row - i, col - j
        i1, j1 = i + np.uint64(1), j + np.uint64(1)
        heights[k - first] = (1.0 - dr) * ((1.0 - dc) * grid[i, j] + dc * grid[i, j1]) + dr * (
            (1.0 - dc) * grid[i1, j] + dc * grid[i1, j1]
        )


@kernel
def _inside(origin: float, step: float, top: float) -> tuple[float, float]:
    """Range of k for which 0 <= origin + k step <= top."""
    if abs(step) < 1e-12:
        if 0.0 <= origin <= top:
            return -1e9, 1e9
        return 1.0, -1.0
    a, b = -origin / step, (top - origin) / step
    return min(a, b), max(a, b)


@kernel
def _steepest(
    near_s: FloatArray,
    near_z: FloatArray,
    near: int,
    far_s: FloatArray,
    far_z: FloatArray,
    far: int,
) -> float:
    """Greatest slope from one of `near` points up to one of `far` points, which lie ahead.

    far_s rises. Points are (way, height); returns -inf when a set is empty.
    """
    if near == 0 or far == 0:
        return -np.inf
    # upper hull of the far points, from the farthest back to the nearest, on a stack
    hull = np.empty(far, np.int64)
    count = 0
    for k in range(far - 1, -1, -1):
        while count >= 2:
            a, b = hull[count - 1], hull[count - 2]
            # drop a when it lies on or under the line from k to b
            if (far_z[a] - far_z[k]) * (far_s[b] - far_s[k]) <= (far_z[b] - far_z[k]) * (
                far_s[a] - far_s[k]
            ):
                count -= 1
            else:
                break
        hull[count] = k
        count += 1
    best = -np.inf
    for p in range(near):
        # along an upper hull the slope from a point before it rises, then falls
        k = hull[count - 1]
        slope = (far_z[k] - near_z[p]) / (far_s[k] - near_s[p])
        for m in range(count - 2, -1, -1):
            k = hull[m]
            further = (far_z[k] - near_z[p]) / (far_s[k] - near_s[p])
            if further < slope:
                break
            slope = further
        best = max(best, slope)
    return best


@kernel
def _crossing(
    size: int, posting: float, step: float, across: float, east: float, north: float
) -> tuple[float, float, float, float, int, int]:
    """Where a plane of points k step (east, north) + across (north, -east) crosses a grid.

    Returns col and row at k = 0, their change a step, and the first and last k inside.
    """
    middle = (size - 1) / 2.0
    col, row = middle + across * north / posting, middle + across * east / posting
    d_col, d_row = step * east / posting, -step * north / posting
    low_c, high_c = _inside(col, d_col, size - 1.0)
    low_r, high_r = _inside(row, d_row, size - 1.0)
    first = int(np.ceil(max(low_c, low_r) + 1e-9))
    last = int(np.floor(min(high_c, high_r) - 1e-9))
    return col, row, d_col, d_row, first, last


@kernel
def _limit_at(z: FloatArray, postings: FloatArray, east: float, north: float) -> float:
    """Tangent of the greatest elevation of outside ground towards (east, north), over the patch.

    z (levels, n, n) heights over the tangent plane, the patch's own first; postings (levels,).
    """
    levels, size = z.shape[0], z.shape[1]
    posting = postings[0]
    corner = (size - 1) / 2.0 * posting * (abs(east) + abs(north))
    spacing = LINE_SPACING_NODES * posting
    room = 2 * size + 4
    near_s, near_z = np.empty(room), np.empty(room)
    far_s, far_z = np.empty(levels * room), np.empty(levels * room)
    heights = np.empty(room)
    best = -np.inf
    lines = int(2.0 * corner / spacing) + 1
    for line in range(lines):
        across = (line - (lines - 1) / 2.0) * spacing
        near = far = 0
        end = 0.0
        for level in range(levels):
            step = INNER_STEP_NODES * posting if level == 0 else postings[level]
            col, row, d_col, d_row, first, last = _crossing(
                size, postings[level], step, across, east, north
            )
            if level == 0:
                if last < first:
                    break
            else:  # from the first step beyond the finer grid
                # 1e-9: a point that both grids share must not, by rounding, be its own horizon
                first = max(first, int(np.floor(end / step + 1e-9)) + 1)
            _profile(z[level], col, row, d_col, d_row, first, last, heights)
            for k in range(first, last + 1):
                height = heights[k - first]
                if height == height and level == 0:
                    near_s[near], near_z[near] = k * step, height
                    near += 1
                elif height == height:
                    far_s[far], far_z[far] = k * step, height
                    far += 1
            end = max(end, last * step) if level > 0 else last * step
        best = max(best, _steepest(near_s, near_z, near, far_s, far_z, far))
    return best


@kernel
def _limits(grids: HeightGrid, postings: FloatArray, radius: float, per_bin: int) -> FloatArray:
    z = _tangent_heights(grids, postings, radius)
    count = AZIMUTHS * per_bin
    tangents = np.empty(count)
    for k in range(count):
        azimuth = 2.0 * math.pi * k / count
        tangents[k] = _limit_at(z, postings, math.sin(azimuth), math.cos(azimuth))
    return tangents


def skyline_limits_deg(
    levels: Sequence[tuple[HeightGrid, float]], patch_level: int, radius_m: float
) -> FloatArray:
    """Sun elevation by azimuth above which ground outside a patch throws no shadow into it.

    levels       (heights (n, n) float32, posting_m) of a point's grids, finest first, centred alike
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
    tangents = _limits(grids, postings, float(radius_m), PER_BIN)
    angles = np.degrees(np.arctan(tangents)).reshape(AZIMUTHS, PER_BIN)
    # the border between two bins belongs to both
    middle, border = angles[:, 0], angles[:, PER_BIN // 2]
    worst = np.maximum(np.maximum(middle, border), np.roll(border, 1))
    limits: FloatArray = np.maximum(worst, 0.0)
    return limits
