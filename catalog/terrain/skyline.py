"""The skyline that terrain outside a patch makes, as the patch's own ground sees it.

Of every vertical plane through the patch two profiles are taken: the ground inside the patch, and
the ground outside towards the azimuth, from the coarser grids about the same centre, each from
where the finer one ends. The limit of the plane is the steepest line from a point inside to a point
outside; only points of the upper convex hull of the outside can touch it, so it costs a walk along
that hull instead of all pairs. Heights are those over the centre's tangent plane: curvature is in.
Coarse grids hold area means: a peak narrower than their posting is lowered.
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
LINE_SPACING_NODES = 2.0  # between planes, nodes of the patch


@kernel
def _height(grid: HeightGrid, x: float, y: float, posting: float, radius: float) -> float:
    """Height over the centre's tangent plane of map x, y; NaN outside the grid or in a hole."""
    size = grid.shape[0]
    col = x / posting + (size - 1) / 2.0
    row = (size - 1) / 2.0 - y / posting
    if not (0.0 <= row <= size - 1 and 0.0 <= col <= size - 1):
        return np.nan
    i, j = min(int(row), size - 2), min(int(col), size - 2)
    dr, dc = row - i, col - j
    h = (1.0 - dr) * ((1.0 - dc) * grid[i, j] + dc * grid[i, j + 1]) + dr * (
        (1.0 - dc) * grid[i + 1, j] + dc * grid[i + 1, j + 1]
    )
    q = (x * x + y * y) / (4.0 * radius * radius)
    return (h - q * (h + 2.0 * radius)) / (1.0 + q)


@kernel
def _steepest(
    near_s: FloatArray, near_z: FloatArray, near: int, far_s: FloatArray, far_z: FloatArray, far: int
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
def _limit_at(
    grids: HeightGrid, postings: FloatArray, radius: float, east: float, north: float
) -> float:
    """Tangent of the greatest elevation of outside ground towards (east, north), over the patch.

    grids (levels, n, n), the patch's own first; postings (levels,).
    """
    levels, size = grids.shape[0], grids.shape[1]
    half = (size - 1) / 2.0 * postings[0]
    spacing = LINE_SPACING_NODES * postings[0]
    corner = half * (abs(east) + abs(north))  # the patch reaches so far along and across
    near_s, near_z = np.empty(2 * size + 4), np.empty(2 * size + 4)
    room = levels * (2 * size + 4)
    far_s, far_z = np.empty(room), np.empty(room)
    best = -np.inf
    lines = int(2.0 * corner / spacing) + 1
    for line in range(lines):
        across = (line - (lines - 1) / 2.0) * spacing
        # points of the plane: way * (east, north) + across * (north, -east)
        near = 0
        steps = int(2.0 * corner / postings[0]) + 1
        end = -np.inf
        for k in range(steps):
            way = -corner + k * postings[0]
            z = _height(
                grids[0], way * east + across * north, way * north - across * east, postings[0], radius
            )
            if z == z and near < near_s.size:
                near_s[near], near_z[near] = way, z
                near += 1
                end = way
        if near == 0:
            continue
        far = 0
        for level in range(1, levels):
            posting = postings[level]
            # the first step beyond the finer grid's last node in this plane
            way = end + posting
            while far < room:
                z = _height(
                    grids[level],
                    way * east + across * north,
                    way * north - across * east,
                    posting,
                    radius,
                )
                reach = (size - 1) / 2.0 * posting
                if max(abs(way * east + across * north), abs(way * north - across * east)) > reach:
                    break
                if z == z:
                    far_s[far], far_z[far] = way, z
                    far += 1
                end = way
                way += posting
        best = max(best, _steepest(near_s, near_z, near, far_s, far_z, far))
    return best


@kernel
def _limits(grids: HeightGrid, postings: FloatArray, radius: float, per_bin: int) -> FloatArray:
    count = AZIMUTHS * per_bin
    tangents = np.empty(count)
    for k in range(count):
        azimuth = 2.0 * math.pi * k / count
        tangents[k] = _limit_at(grids, postings, radius, math.sin(azimuth), math.cos(azimuth))
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
    return np.maximum(worst, 0.0)
