"""Exact casting of rays on a height grid of a curved body: slow, and the measure of what is fast.

The surface is bilinear between the nodes of a map grid (stereographic, heights above a sphere).
A ray is a straight line in space; it is followed cell by cell. Inside a cell its height above the
surface is, but for the body's curvature over one posting (4 mm at 118 m on the Moon), a parabola of
the way; the parabola through both ends and the middle is solved in closed form.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from catalog.geometry.kernel import kernel

FloatArray = NDArray[np.float64]
HeightGrid = NDArray[np.float32]
BoolGrid = NDArray[np.bool_]

# A ray that starts on the surface touches it there; a hit must go this deep.
TOUCH_M = 1e-3


@kernel
def _place(
    x: float, y: float, z: float, posting: float, radius: float, middle: float
) -> tuple[float, float, float]:
    """Fractional row, column and height above the sphere of a point in the centre's frame."""
    up = z + radius
    length = math.sqrt(x * x + y * y + up * up)
    factor = 2.0 * radius / (length + up) / posting
    # |p| - R without the loss of digits: (x^2 + y^2 + z^2 + 2 R z) / (|p| + R)
    height = (x * x + y * y + z * z + 2.0 * radius * z) / (length + radius)
    return middle - y * factor, middle + x * factor, height


@kernel
def _clearance(grid: HeightGrid, row: float, col: float, height: float) -> float:
    """Height above the bilinear surface; NaN outside the grid or beside a hole."""
    rows, cols = grid.shape
    if not (-1e-9 <= row <= rows - 1 + 1e-9 and -1e-9 <= col <= cols - 1 + 1e-9):
        return np.nan
    i = min(max(int(row), 0), rows - 2)
    j = min(max(int(col), 0), cols - 2)
    dr, dc = row - i, col - j
    top = (1.0 - dc) * grid[i, j] + dc * grid[i, j + 1]
    low = (1.0 - dc) * grid[i + 1, j] + dc * grid[i + 1, j + 1]
    clearance: float = height - ((1.0 - dr) * top + dr * low)
    return clearance


@kernel
def _next_crossing(a: float, b: float, after: float) -> float:
    """First fraction of the way a -> b beyond `after` that meets a whole number; 1 if none."""
    if a == b:
        return 1.0
    here = a + (b - a) * after
    if b > a:
        line = math.floor(here + 1e-9) + 1.0
    else:
        line = math.ceil(here - 1e-9) - 1.0
    return min((line - a) / (b - a), 1.0)


@kernel
def _dip(start: float, half: float, end: float) -> float:
    """First fraction 0..1 at which the parabola through three heights falls to -TOUCH_M, else 2."""
    a = 2.0 * (start + end) - 4.0 * half
    b = 4.0 * half - 3.0 * start - end
    c = start + TOUCH_M
    if c <= 0.0:
        return 0.0
    if abs(a) < 1e-15:
        t = -c / b if b < 0.0 else 2.0
        return t if t <= 1.0 else 2.0
    discriminant = b * b - 4.0 * a * c
    if discriminant < 0.0:
        return 2.0
    root = math.sqrt(discriminant)
    s = -0.5 * (b + math.copysign(root, b))
    first, second = s / a, (c / s if s != 0.0 else 2.0)
    low, high = min(first, second), max(first, second)
    if 0.0 <= low <= 1.0:
        return low
    if 0.0 <= high <= 1.0:
        return high
    return 2.0


@kernel
def _cast(
    grid: HeightGrid,
    posting: float,
    radius: float,
    top: float,
    origin: FloatArray,
    direction: FloatArray,
    reach: float,
) -> float:
    """Distance (m) along a unit ray to where it goes under the surface; NaN without a hit."""
    middle = (grid.shape[0] - 1) / 2.0
    level = math.sqrt(direction[0] ** 2 + direction[1] ** 2)
    # one posting of map at a time; straight up or down a posting of height
    step = posting / max(level, 0.1)
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    row0, col0, h0 = _place(ox, oy, oz, posting, radius, middle)
    distance = 0.0
    entered = False
    while distance < reach:
        far = distance + step
        row1, col1, h1 = _place(
            ox + dx * far, oy + dy * far, oz + dz * far, posting, radius, middle
        )
        if h0 > top and h1 >= h0:
            return np.nan
        done = 0.0
        while done < 1.0 and min(h0, h1) <= top + posting:
            ahead = min(_next_crossing(row0, row1, done), _next_crossing(col0, col1, done))
            ahead = max(ahead, done + 1e-12)
            gaps = np.empty(3)
            for k in range(3):
                f = done + (ahead - done) * (0.5 * k)
                if k != 1:  # the ends lie on cell borders: look from inside this cell
                    f += (0.5 - 0.5 * k) * 2e-9 * (ahead - done)
                s = distance + step * f
                row, col, h = _place(ox + dx * s, oy + dy * s, oz + dz * s, posting, radius, middle)
                gaps[k] = _clearance(grid, row, col, h)
            if gaps[0] == gaps[0] and gaps[1] == gaps[1] and gaps[2] == gaps[2]:
                entered = True
                fraction = _dip(gaps[0], gaps[1], gaps[2])
                if fraction <= 1.0:
                    return distance + step * (done + (ahead - done) * fraction)
            done = ahead
        outside = not (0.0 <= row1 <= grid.shape[0] - 1 and 0.0 <= col1 <= grid.shape[1] - 1)
        if entered and outside:
            return np.nan
        distance, row0, col0, h0 = far, row1, col1, h1
    return np.nan


@kernel
def _cast_all(
    grid: HeightGrid,
    posting: float,
    radius: float,
    top: float,
    origins: FloatArray,
    directions: FloatArray,
    reach: float,
) -> FloatArray:
    out = np.empty(origins.shape[0])
    for i in range(origins.shape[0]):
        out[i] = _cast(grid, posting, radius, top, origins[i], directions[i], reach)
    return out


def cast_rays(
    heights: HeightGrid,
    posting_m: float,
    origins: ArrayLike,
    directions: ArrayLike,
    radius_m: float,
    reach_m: float = math.inf,
) -> FloatArray:
    """Distance along rays to their first meeting with the ground of a map grid.

    heights     (n, n) float32  m above the reference sphere, NaN for no data (no ground)
    posting_m   m between nodes
    origins     (k, 3)  m; east, north, up at the grid's centre, from its foot on the sphere
    directions  (k, 3)  same frame, any length
    radius_m    radius of the reference sphere
    reach_m     how far to look
    Returns (k,) m, NaN where the ray meets no ground of the grid.
    Raises ValueError for a grid that is not square or a direction of no length.
    """
    if heights.ndim != 2 or heights.shape[0] != heights.shape[1] or heights.shape[0] < 2:
        raise ValueError(f"cast_rays: a map grid is square, at least 2 x 2, not {heights.shape}")
    rays = np.atleast_2d(np.asarray(directions, dtype=np.float64))
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    if not (length > 0.0).all():
        raise ValueError("cast_rays: a direction has no length")
    starts = np.atleast_2d(np.asarray(origins, dtype=np.float64))
    # no ray can come back to the grid from further than this
    farthest = float(np.linalg.norm(starts, axis=1).max()) + 2.0 * heights.shape[0] * posting_m
    return _cast_all(
        np.ascontiguousarray(heights, dtype=np.float32),
        float(posting_m),
        float(radius_m),
        float(np.nanmax(heights)) if np.isfinite(heights).any() else -math.inf,
        np.ascontiguousarray(starts),
        np.ascontiguousarray(rays / length),
        min(float(reach_m), farthest),
    )


def node_points(heights: HeightGrid, posting_m: float, radius_m: float) -> FloatArray:
    """Places (n, n, 3) of the nodes, m; east, north, up at the centre, from its foot."""
    size = heights.shape[0]
    offsets = (np.arange(size) - (size - 1) / 2.0) * posting_m / (2.0 * radius_m)
    u, v = np.meshgrid(offsets, -offsets)
    q = u * u + v * v
    h = heights.astype(np.float64)
    reach = (radius_m + h) / (1.0 + q)
    z = (h - q * (h + 2.0 * radius_m)) / (1.0 + q)
    return np.stack([2.0 * u * reach, 2.0 * v * reach, z], axis=-1)


def sees(
    heights: HeightGrid, posting_m: float, direction_local: ArrayLike, radius_m: float
) -> BoolGrid:
    """Which nodes see a far place (the Sun, a far camera) in a direction, by ray casting.

    heights, posting_m, radius_m as for `cast_rays`; direction_local (3,) at the grid's centre.
    Returns (n, n) bool, False without data.
    """
    points = node_points(heights, posting_m, radius_m)
    valid = np.isfinite(heights)
    origins = points[valid]
    directions = np.broadcast_to(np.asarray(direction_local, dtype=np.float64), origins.shape)
    out = np.zeros(heights.shape, dtype=np.bool_)
    out[valid] = np.isnan(cast_rays(heights, posting_m, origins, directions, radius_m))
    return out
