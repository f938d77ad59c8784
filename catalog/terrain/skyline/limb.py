"""The skyline that the relief of a whole body draws against the sky, seen from outside.

In the plane of the observer's nadir and one azimuth the skyline is the ground point highest above
the nadir. A crest at the angle d from the point where a sphere's limb would lie loses R d^2 / 2 of
height, so lunar relief decides the limb within some +-280 km of it; the search goes on until no
ground of the body could rise above what is found, near the body as well as at 100 000 km. Steps
whose highest ground (a coarse grid of bounds) cannot reach the skyline found so far are jumped.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.geometry.grid import interpolate_bilinear
from catalog.geometry.kernel import kernel
from catalog.geometry.vectors import unit
from catalog.terrain.relief.relief import GlobalRelief

SEGMENT = np.radians(0.5)  # jumped or searched as a whole
MAX_STEP = np.radians(0.03)  # between samples, or half a cell of the relief
BOUND_CELLS = 360  # rows of the grid of bounds: cells of half a degree
REFINEMENTS = 4  # halvings of the step about the highest sample: 60 m on the Moon


@dataclass(frozen=True, eq=False)
class Skyline:
    """Where relief meets the sky, at azimuths about the nadir.

    off_nadir (n,)   rad, angle between the nadir and the skyline
    range     (n,)   rad, angle at the body's centre from the observer to the crest
    radius_m  (n,)   of the crest from the body's centre
    """

    off_nadir: FloatArray
    range: FloatArray
    radius_m: FloatArray


class _Outlook(NamedTuple):
    """The grid with borders on a sphere (m), the observer's distance (m) and axes (3, 3)."""

    grid: Float32Array
    sphere: float
    distance: float
    axes: FloatArray


class LimbRelief:
    """A relief made ready for skylines.

    relief      the body's
    top_share   the surface lies this share of the way from mean to greatest heights; may pass 1
    """

    def __init__(self, relief: GlobalRelief, top_share: float) -> None:
        crests = relief.heights + np.float32(top_share) * (relief.max_heights - relief.heights)
        self.radius_m = relief.radius_m
        self.posting_m = relief.posting_m
        # one more row and column on every side, so that bilinear needs no exceptions
        grid = crests.astype(np.float32)
        half = grid.shape[1] // 2
        tall = np.concatenate([np.roll(grid[:1], half, 1), grid, np.roll(grid[-1:], half, 1)])
        self.grid = np.ascontiguousarray(np.concatenate([tall[:, -1:], tall, tall[:, :1]], axis=1))
        self.bounds = _bound_heights(crests)
        self.highest_m = float(crests.max())

    def skyline(self, position_m: ArrayLike, axes: ArrayLike, azimuths: ArrayLike) -> Skyline:
        """The skyline from a position (3,), m, body frame.

        axes      (3, 3) rows: first and second direction of azimuth, and up; see `make_nadir_axes`
        azimuths  (n,) rad, from the first axis towards the second
        """
        viewer = np.ascontiguousarray(position_m, dtype=np.float64)
        around = np.ascontiguousarray(azimuths, dtype=np.float64)
        values = np.empty((3, around.size))
        body = self.grid, self.bounds, self.radius_m, self.highest_m
        rows = np.ascontiguousarray(axes, dtype=np.float64)
        _find_skyline(*body, float(np.linalg.norm(viewer)), rows, around, values)
        return Skyline(*values)

    def mark_sunlit(self, points: ArrayLike, sun: ArrayLike) -> BoolArray:
        """Whether the Sun (3,), a direction, stands clear of the relief at places (n, 3), m."""
        places = np.ascontiguousarray(points, dtype=np.float64)
        lit = np.empty(len(places), np.bool_)
        _mark_sunlit(
            self.grid, self.radius_m, self.highest_m, self.posting_m, places, unit(sun), lit
        )
        return lit


def make_nadir_axes(position: ArrayLike) -> FloatArray:
    """Rows (3, 3): two directions across the position (3,), then the position's own; unit."""
    up = unit(position)
    first = np.zeros(3)
    first[int(np.argmin(np.abs(up)))] = 1.0
    first -= up * (first @ up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def _bound_heights(grid: Float32Array) -> Float32Array:
    """Highest ground within a segment about each coarse cell."""
    rows = grid.shape[0]
    count = min(BOUND_CELLS, rows)
    first = (np.arange(count) * rows) // count
    lon_first = (np.arange(2 * count) * rows) // count
    cells = np.maximum.reduceat(np.maximum.reduceat(grid, first, axis=0), lon_first, axis=1)
    wide = np.empty_like(cells)
    lat = (0.5 - (np.arange(count) + 0.5) / count) * np.pi
    for row in range(count):
        # the narrowest of the row and its neighbours; at the poles all meridians are near
        narrow = np.cos(min(abs(lat[row]) + np.pi / count, np.pi / 2.0))
        reach = int(np.ceil(1.0 / max(narrow, 1e-9)))
        if 2 * reach + 1 >= 2 * count:
            wide[row] = cells[row].max()
            continue
        wide[row] = cells[row]
        for shift in range(1, reach + 1):
            wide[row] = np.maximum(wide[row], np.roll(cells[row], shift))
            wide[row] = np.maximum(wide[row], np.roll(cells[row], -shift))
    out = wide.copy()
    out[1:] = np.maximum(out[1:], wide[:-1])
    out[:-1] = np.maximum(out[:-1], wide[1:])
    return out


@kernel
def _interpolate_height(grid: Float32Array, x: float, y: float, z: float) -> float:
    """Bilinear height at a unit direction, from the grid with borders."""
    per_rad = (grid.shape[0] - 2) / np.pi
    row = (0.5 * np.pi - np.arctan2(z, np.sqrt(x * x + y * y))) * per_rad + 0.5
    col = (np.arctan2(y, x) + np.pi) * per_rad + 0.5
    return interpolate_bilinear(grid, row, col)


@kernel
def _bound(bounds: Float32Array, x: float, y: float, z: float) -> float:
    per_rad = bounds.shape[0] / np.pi
    row = int((0.5 * np.pi - np.arctan2(z, np.sqrt(x * x + y * y))) * per_rad)
    col = int((np.arctan2(y, x) + np.pi) * per_rad)
    return float(bounds[min(row, bounds.shape[0] - 1), min(col, bounds.shape[1] - 1)])


@kernel
def _compute_direction(
    axes: FloatArray, azimuth: tuple[float, float], up: float, along: float
) -> tuple[float, float, float]:
    """Unit vector, body frame, of the cosine and sine of an angle from the observer."""
    a, b = along * azimuth[0], along * azimuth[1]
    return (
        a * axes[0, 0] + b * axes[1, 0] + up * axes[2, 0],
        a * axes[0, 1] + b * axes[1, 1] + up * axes[2, 1],
        a * axes[0, 2] + b * axes[1, 2] + up * axes[2, 2],
    )


@kernel
def _compute_ground_cot(
    outlook: _Outlook, azimuth: tuple[float, float], up: float, along: float
) -> tuple[float, float]:
    """`_cot` of the ground at an azimuth and its radius; up, along: cosine, sine of its angle."""
    x, y, z = _compute_direction(outlook.axes, azimuth, up, along)
    radius = outlook.sphere + _interpolate_height(outlook.grid, x, y, z)
    return (outlook.distance - radius * up) / (radius * along), radius


class _Segments(NamedTuple):
    """Segments about the sphere's limb, shared by all azimuths, rows from `first` on.

    made     (n,)         whether a segment's row is filled in
    edges    (n, 3, 3)    angle, cosine and sine of its least, middle and greatest angle
    nearest  (n,)         the smallest cotangent that ground may have from there on, away from the
                          limb
    samples  (n, parts, 3) angle, cosine and sine of its samples
    """

    first: int
    made: BoolArray
    edges: FloatArray
    nearest: FloatArray
    samples: FloatArray


@kernel
def _find_smallest_cot(distance: float, radius: float, edges: FloatArray) -> float:
    """Cotangent of the off-nadir angle of the highest point of a segment of ground at a radius."""
    share = radius / distance
    if share > edges[0, 1]:
        return float((distance - radius * edges[0, 1]) / (radius * edges[0, 2]))
    if share < edges[2, 1]:
        return float((distance - radius * edges[2, 1]) / (radius * edges[2, 2]))
    return float(np.sqrt(distance * distance - radius * radius) / radius)


@kernel
def _make_segment(
    segments: _Segments, number: int, middle: float, distance: float, top: float
) -> None:
    """Fill in the row of a segment, whose number counts from the sphere's limb, at `middle`.

    top  radius that no ground passes
    """
    row = number - segments.first
    start, parts = middle + number * SEGMENT, segments.samples.shape[1]
    low, high = max(start, 1e-9), min(start + SEGMENT, np.pi - 1e-9)
    edges = segments.edges[row]
    for k, angle in enumerate((low, 0.5 * (low + high), high)):
        edges[k, 0], edges[k, 1], edges[k, 2] = angle, np.cos(angle), np.sin(angle)
    # of all that lies beyond the segment's near edge, or before its far one
    top_angle = np.arccos(top / distance)
    near = max(low, top_angle) if number >= 0 else min(high, top_angle)
    segments.nearest[row] = (distance - top * np.cos(near)) / (top * np.sin(near))
    for k in range(parts):
        angle = start + (k + 0.5) * (SEGMENT / parts)
        samples = segments.samples[row, k]
        samples[0], samples[1], samples[2] = angle, np.cos(angle), np.sin(angle)
    segments.made[row] = True


@kernel
def _search_segment(
    outlook: _Outlook,
    azimuth: tuple[float, float],
    segment: tuple[FloatArray, FloatArray, float],
    best: tuple[float, float],
) -> tuple[float, float]:
    """The smallest cotangent of a segment's samples and its angle, or `best` where none is smaller.

    segment  its edges and samples, and the radius that its ground stays below
    """
    edges, samples, top = segment
    best_cot, best_angle = best
    for k in range(samples.shape[0]):
        angle, up, along = samples[k, 0], samples[k, 1], samples[k, 2]
        if not edges[0, 0] < angle < edges[2, 0]:
            continue
        # ground is looked up only where the highest of the segment would be the skyline
        if outlook.distance - top * up <= best_cot * (top * along):
            cot, _ = _compute_ground_cot(outlook, azimuth, up, along)
            if cot < best_cot:
                best_cot, best_angle = cot, angle
    return best_cot, best_angle


@kernel
def _refine_crest(
    outlook: _Outlook, azimuth: tuple[float, float], half: float, best: tuple[float, float]
) -> tuple[float, float]:
    """`best` (cotangent, angle) after halvings of the step about it, from `half` (rad) on."""
    best_cot, best_angle = best
    for _ in range(REFINEMENTS):
        centre = best_angle
        for side in (-half, half):
            angle = centre + side
            cot, _ = _compute_ground_cot(outlook, azimuth, np.cos(angle), np.sin(angle))
            if cot < best_cot:
                best_cot, best_angle = cot, centre + side
        half *= 0.5
    return best_cot, best_angle


@kernel
def _find_skyline(
    grid: Float32Array,
    bounds: Float32Array,
    sphere: float,
    highest: float,
    distance: float,
    axes: FloatArray,
    azimuths: FloatArray,
    found: FloatArray,
) -> None:
    outlook = _Outlook(grid, sphere, distance, axes)
    posting = np.pi / (grid.shape[0] - 2)
    parts = int(np.ceil(SEGMENT / min(0.5 * posting, MAX_STEP)))
    step = SEGMENT / parts
    inside = distance * (1.0 - 1e-9)
    middle = np.arccos(min(sphere, inside) / distance)
    top = min(sphere + highest, inside)
    before, rows = int(middle / SEGMENT) + 2, int(np.pi / SEGMENT) + 4
    segments = _Segments(
        -before,
        np.zeros(rows, np.bool_),
        np.empty((rows, 3, 3)),
        np.empty(rows),
        np.empty((rows, parts, 3)),
    )
    likely = 0
    for n in range(azimuths.size):
        azimuth = np.cos(azimuths[n]), np.sin(azimuths[n])
        best, best_angle = np.inf, middle
        ahead, back, number = True, True, -1
        while ahead or back:
            # first where the azimuth before has its crest, which lets the others be jumped; then
            # alternately beyond the sphere's limb and before it
            here = likely
            if number >= 0:
                here = number // 2 if number % 2 == 0 else -(number + 1) // 2
            number += 1
            beyond = here >= 0
            if not (ahead if beyond else back) or (here == likely and number > 0):
                continue
            row = here + before
            if not segments.made[row]:
                _make_segment(segments, here, middle, distance, top)
            edges = segments.edges[row]
            if edges[0, 0] >= edges[2, 0] or segments.nearest[row] > best:
                # from here on no ground of this body reaches the skyline found
                ahead, back = ahead and not beyond, back and beyond
                continue
            x, y, z = _compute_direction(axes, azimuth, edges[1, 1], edges[1, 2])
            radius = min(sphere + _bound(bounds, x, y, z), inside)
            if _find_smallest_cot(distance, radius, edges) > best:
                continue
            found_before = best
            segment = edges, segments.samples[row], radius
            best, best_angle = _search_segment(outlook, azimuth, segment, (best, best_angle))
            if best < found_before:
                highest_in = here
        likely = highest_in
        best, best_angle = _refine_crest(outlook, azimuth, 0.5 * step, (best, best_angle))
        _, radius = _compute_ground_cot(outlook, azimuth, np.cos(best_angle), np.sin(best_angle))
        found[0, n], found[1, n], found[2, n] = np.arctan2(1.0, best), best_angle, radius


@kernel
def _mark_sunlit(
    grid: Float32Array,
    sphere: float,
    highest: float,
    posting: float,
    places: FloatArray,
    sun: FloatArray,
    lit: BoolArray,
) -> None:
    for n in range(len(places)):
        x, y, z = places[n, 0], places[n, 1], places[n, 2]
        lit[n] = True
        travelled = 0.0
        step = posting
        while True:
            travelled += step
            a, b, c = x + travelled * sun[0], y + travelled * sun[1], z + travelled * sun[2]
            radius = np.sqrt(a * a + b * b + c * c)
            clear = radius - sphere
            rising = a * sun[0] + b * sun[1] + c * sun[2] > 0.0
            if clear > highest and rising:
                break
            ground = _interpolate_height(grid, a / radius, b / radius, c / radius)
            if clear < ground:
                lit[n] = False
                break
            # no lunar slope that rises out of a clear ray by more than its own clearance a step
            step = max(posting, 0.5 * (clear - ground))
