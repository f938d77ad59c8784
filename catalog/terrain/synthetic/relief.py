"""Seeded relief below a DEM's posting: ground that a catalog of that DEM does not have.

Craters in equilibrium from twice the DEM's posting down to a smallest diameter, and
random relief (`fractal`) with a power law over the same band. Neither holds net height, so the
DEM's own content stays as it is. For one seed the ground is the same wherever and however it is
sampled.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel, parallel_kernel
from catalog.geometry.latlon import Lattice, wrap_longitude, xyz_from_latlon
from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.terrain.synthetic import fractal
from catalog.terrain.synthetic.fractal import join, scale_to_unit

GEOMETRIC_SATURATION = 1.54  # N(> D) D^2 of the closest packing that craters of one size can show
REACH = 2.5  # ejecta end here, in crater radii
FRESH_DEPTH, WORN_DEPTH = 0.20, 0.03  # rim to floor over diameter
CELL_DIAMETERS = 4.0  # cell size over the octave's largest diameter
LAT, LON, DIAMETER, DEPTH, WEAR = range(5)  # columns of a crater table
_STRIPS = 32  # row strips stamped in parallel; any number gives the same ground

# volume of the fresh rim outside x = 1: integral of x^-2 (1 - ((x-1)/(REACH-1))^2)^2 dx
_x = np.linspace(1.0, REACH, 20001)
_RIM = float(np.trapezoid(_x**-2.0 * (1.0 - ((_x - 1.0) / (REACH - 1.0)) ** 2) ** 2, _x))
_FRESH_RIM = 1.0 / (1.0 + 4.0 * _RIM)  # rim height over bowl depth that makes the volume vanish
_WORN_FLOOR = 1.0 / (1.0 + np.exp(-2.0))  # of rim-to-floor depth 1 in the worn profile
# Craters below this share of a node's cell are left out: a crater holds no net height, and their
# number, 1 / D^2, would fill the memory where a small smallest_m meets a wide ground.
CELL_SHARE = 0.25


class Population(NamedTuple):
    """Which craters there are.

    octaves    diameters from largest_m down to largest_m / 2^octaves
    density    share of geometric saturation
    radius_m   of the body
    """

    seed: int
    octaves: int
    largest_m: float
    density: float
    radius_m: float


@kernel
def evaluate_profile(x: float, wear: float) -> float:
    """Height over rim-to-floor depth at x radii from the middle; wear 0 fresh, 1 smoothed out."""
    if x >= REACH:
        return 0.0
    bowl = 1.0 / (1.0 + _FRESH_RIM)
    rim = 1.0 - bowl
    fresh = 0.0
    if x < 1.0:
        fresh = -bowl + x * x
    else:
        fall = (x - 1.0) / (REACH - 1.0)
        taper = (1.0 - fall * fall) ** 2
        fresh = rim * taper / (x * x * x)
    # (1 - y) exp(-y) with y = 2 x^2: floor, rim crest at x = 1, no net volume
    y = 2.0 * x * x
    worn = -_WORN_FLOOR * (1.0 - y) * float(np.exp(-y))
    return float((1.0 - wear) * fresh + wear * worn)


@kernel
def _draw_count(
    state: np.uint64, band: int, bands: int, columns: int, smallest: float, f: float, radius: float
) -> int:
    """Number of craters of a cell: a Poisson draw by inversion."""
    south = -0.5 * np.pi + np.pi * band / bands
    north = -0.5 * np.pi + np.pi * (band + 1) / bands
    area = radius * radius * 2.0 * np.pi / columns * (np.sin(north) - np.sin(south))
    mean = 0.75 * f * GEOMETRIC_SATURATION / (smallest * smallest) * area
    draw = scale_to_unit(join(state, -1))
    total = term = np.exp(-mean)
    count = 0
    while draw > total and count < 1000:
        count += 1
        term *= mean / count
        total += term
    return count


@kernel
def _draw_crater(
    state: np.uint64, index: int, band: int, bands: int, column: int, columns: int, smallest: float
) -> tuple[float, float, float, float, float]:
    """Latitude, longitude, diameter, rim-to-floor depth (unit of `smallest`), wear of a crater."""
    crater_state = join(state, index)
    south = np.sin(-0.5 * np.pi + np.pi * band / bands)
    north = np.sin(-0.5 * np.pi + np.pi * (band + 1) / bands)
    lat = np.arcsin(
        min(1.0, max(-1.0, south + (north - south) * scale_to_unit(join(crater_state, 1))))
    )
    lon = -np.pi + 2.0 * np.pi * (column + scale_to_unit(join(crater_state, 2))) / columns
    # cumulative D^-2 between D and 2 D
    diameter = smallest / np.sqrt(1.0 - 0.75 * scale_to_unit(join(crater_state, 3)))
    freshness = scale_to_unit(join(crater_state, 4)) ** 2
    depth = diameter * (WORN_DEPTH + (FRESH_DEPTH - WORN_DEPTH) * freshness)
    return lat, lon, diameter, depth, 1.0 - freshness


@kernel
def _gather(population: Population, box: FloatArray, table: FloatArray) -> int:
    """Fill `table` with the craters that can reach a box of (south, west, north, width) rad.

    Returns their number; stops writing, not counting, when the table is full.
    """
    seed, octaves, largest, f, radius = population
    count = 0
    for octave in range(octaves):
        top = largest / 2.0**octave
        reach = 0.5 * REACH * top / radius
        bands = max(2, int(np.pi * radius / (CELL_DIAMETERS * top)))
        south, north = box[0] - reach, box[2] + reach
        first = max(0, int(np.floor((south + 0.5 * np.pi) / np.pi * bands)))
        last = min(bands - 1, int(np.floor((north + 0.5 * np.pi) / np.pi * bands)))
        widest = max(abs(south), abs(north))
        turn = widest >= 0.5 * np.pi or np.sin(reach) >= np.cos(widest)
        half = np.pi if turn else np.arcsin(np.sin(reach) / np.cos(widest))
        for band in range(first, last + 1):
            middle = -0.5 * np.pi + np.pi * (band + 0.5) / bands
            columns = max(1, int(np.ceil(2.0 * bands * np.cos(middle))))
            low = int(np.floor((box[1] - half + np.pi) / (2.0 * np.pi) * columns))
            high = int(np.floor((box[1] + box[3] + half + np.pi) / (2.0 * np.pi) * columns))
            if turn or high - low >= columns:
                low, high = 0, columns - 1
            for turned in range(low, high + 1):
                column = turned % columns
                state = join(join(np.uint64(0x0C7A7E25), seed), octave)
                state = join(join(state, band), column)
                for index in range(_draw_count(state, band, bands, columns, 0.5 * top, f, radius)):
                    if count < table.shape[0]:
                        crater = _draw_crater(state, index, band, bands, column, columns, 0.5 * top)
                        for k in range(5):
                            table[count, k] = crater[k]
                    count += 1
    return count


def make_crater_table(
    population: Population, south: float, west: float, north: float, width: float
) -> FloatArray:
    """The craters that can touch a box of latitudes and longitudes.

    south, west, north, width  rad; the box runs `width` eastward from `west`
    Returns (n, 5): latitude, longitude (rad), diameter, rim-to-floor depth (m), wear 0..1.
    """
    box = np.array([south, west, north, width], dtype=np.float64)
    table = np.empty((_gather(population, box, np.empty((0, 5))), 5))
    _gather(population, box, table)
    return table


@kernel
def sum_crater_heights(population: Population, lat: FloatArray, lon: FloatArray) -> FloatArray:
    """Summed crater heights at single points (n,), rad."""
    out = np.zeros(lat.size)
    table = np.empty((4096, 5))
    box = np.empty(4)
    for i in range(lat.size):
        box[0], box[1], box[2], box[3] = lat[i], lon[i], lat[i], 0.0
        count = _gather(population, box, table)
        if count > table.shape[0]:
            table = np.empty((2 * count, 5))
            _gather(population, box, table)
        for k in range(count):
            # haversine keeps its digits at these small distances, also at the poles
            a = np.sin(0.5 * (lat[i] - table[k, LAT]))
            b = np.sin(0.5 * (lon[i] - table[k, LON]))
            h = a * a + np.cos(lat[i]) * np.cos(table[k, LAT]) * b * b
            x = 2.0 * population.radius_m * np.sqrt(h) / (0.5 * table[k, DIAMETER])
            if x < REACH:
                out[i] += table[k, DEPTH] * evaluate_profile(x, table[k, WEAR])
    return out


@parallel_kernel
def add_craters(
    out: Float32Array,
    row: FloatArray,
    col: FloatArray,
    table: FloatArray,
    step_y: FloatArray,
    step_x: FloatArray,
) -> None:
    """Add craters to a grid, each node taking the mean over its own cell.

    out       (rows, cols) m, changed in place
    row, col  (n,) where the craters' middles lie, fractional nodes
    step_y    (rows,) m from a node to the next row; step_x (rows,) m to the next column
    """
    rows, cols = out.shape
    strips = min(rows, _STRIPS)
    for strip in numba.prange(strips):
        top, bottom = strip * rows // strips, (strip + 1) * rows // strips
        for k in range(table.shape[0]):
            near = min(max(int(row[k]), 0), rows - 1)
            dy, dx = step_y[near], step_x[near]
            reach = 0.5 * REACH * table[k, DIAMETER]
            low = max(top, int(np.ceil(row[k] - reach / dy - 1.0)))
            high = min(bottom - 1, int(np.floor(row[k] + reach / dy + 1.0)))
            if low > high:
                continue
            left = max(0, int(np.ceil(col[k] - reach / dx - 1.0)))
            right = min(cols - 1, int(np.floor(col[k] + reach / dx + 1.0)))
            inverse = 2.0 / table[k, DIAMETER]
            # a bowl needs about four samples across it for the mean over a node to be right
            n = min(4, max(1, int(np.ceil(4.0 * max(dx, dy) / table[k, DIAMETER]))))
            for i in range(low, high + 1):
                for j in range(left, right + 1):
                    total = 0.0
                    for p in range(n):
                        y = (i - row[k] + (p + 0.5) / n - 0.5) * step_y[i] * inverse
                        for q in range(n):
                            x = (j - col[k] + (q + 0.5) / n - 0.5) * step_x[i] * inverse
                            square = x * x + y * y
                            if square < REACH * REACH:
                                total += evaluate_profile(np.sqrt(square), table[k, WEAR])
                    out[i, j] += np.float32(table[k, DEPTH] * total / (n * n))


@dataclass(frozen=True)
class SyntheticRelief:
    """Relief to add to a DEM.

    seed            which ground; any integer
    dem_posting_m   posting of the DEM that the relief is added to
    radius_m        the body's reference sphere
    smallest_m      smallest crater diameter and finest spacing of the random relief
    rms_slope_deg   rms slope of the random relief alone, over its whole band
    hurst           exponent of its power law: rms height of an octave ~ wavelength^hurst; lunar
                    highlands show 0.95 (Rosenburg et al., JGR 116, 2011)
    saturation      crater density over geometric saturation; equilibrium is 0.02-0.1

    Raises ValueError for lengths that are not positive or a smallest size above the largest.
    """

    seed: int
    dem_posting_m: float
    radius_m: float
    smallest_m: float = 30.0
    rms_slope_deg: float = 3.0
    hurst: float = 0.95
    saturation: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 < self.smallest_m <= self.largest_m or not self.largest_m < self.radius_m:
            raise ValueError(
                f"smallest relief {self.smallest_m} m is not within 0 and {self.largest_m} m,"
                " twice the DEM's posting, or that is no small part of the body"
            )

    @property
    def largest_m(self) -> float:
        """Largest added crater: what a DEM of this posting no longer shows."""
        return 2.0 * self.dem_posting_m

    @cached_property
    def _octaves(self) -> int:
        return max(1, round(float(np.log2(self.largest_m / self.smallest_m))))

    @cached_property
    def _noise(self) -> fractal.Octaves:
        """The random relief over its whole band."""
        count = max(1, round(float(np.log2(self.dem_posting_m / self.smallest_m))) + 1)
        spacing = self.dem_posting_m / 2.0 ** np.arange(count, dtype=np.float64)
        shape = spacing**self.hurst
        slope = fractal.RMS_GRADIENT * float(np.linalg.norm(shape / spacing))
        amplitude = shape * float(np.tan(np.radians(self.rms_slope_deg))) / slope
        return fractal.Octaves(self.seed, spacing, amplitude, self.radius_m)

    def heights(self, lat: ArrayLike, lon: ArrayLike) -> FloatArray:
        """Heights to add at points, microseconds each; lat, lon (...) rad; returns (...) m."""
        lat, lon = np.broadcast_arrays(np.asarray(lat, np.float64), wrap_longitude(lon))
        flat = np.ascontiguousarray(lat).ravel(), np.ascontiguousarray(lon).ravel()
        total = sum_crater_heights(self._make_population(self._octaves), *flat)
        total += fractal.sum_noise(self._noise, xyz_from_latlon(*flat, 1.0))
        return total.reshape(lat.shape)

    def window(
        self, north: float, west: float, step_lat: float, step_lon: float, rows: int, cols: int
    ) -> Float32Array:
        """Heights to add on a regular grid of latitudes and longitudes, means over a node's cell.

        Craters smaller than a quarter of a cell are left out.

        north, west         rad  the first node; rows run south, columns east
        step_lat, step_lon  rad  positive
        Returns (rows, cols) float32, m. The grid must keep a few nodes away from the poles.
        """
        out = np.zeros((rows, cols), np.float32)
        lat = north - step_lat * np.arange(rows, dtype=np.float64)
        lon = west + step_lon * np.arange(cols, dtype=np.float64)
        posting = self.radius_m * step_lat
        fractal.add_noise_window(out, self._select_resolved(posting), lat, lon)
        table = self._make_craters(posting, lat[-1], west, lat[0], step_lon * (cols - 1))
        row = (north - table[:, LAT]) / step_lat
        # a crater's longitude is brought next to the window's middle, so that ±180° is no border
        middle = west + 0.5 * step_lon * (cols - 1)
        col = (wrap_longitude(table[:, LON] - middle) + middle - west) / step_lon
        step_x = self.radius_m * np.cos(lat) * step_lon
        add_craters(out, row, col, table, np.full(rows, posting), step_x)
        return out

    def turned_window(self, body_from_grid: FloatArray, grid: Lattice) -> Float32Array:
        """Heights to add on a grid in a turned frame, means over a node's cell.

        body_from_grid  (3, 3) rotation from the grid's frame to the body's
        grid            may go all round, and up to half a step from the frame's poles
        Returns (rows, cols) float32, m. Craters smaller than a step, and those nearer than 10
        diameters to the frame's poles, where the grid's cells are slivers, are left out.
        """
        rows, cols, step, lat, lon = grid.rows, grid.cols, grid.step, grid.lat, grid.lon
        out = np.zeros((rows, cols), np.float32)
        posting = self.radius_m * step
        noise = self._select_resolved(posting)
        if noise.spacing.size:
            fractal.add_noise_turned(out, noise, lat, lon, body_from_grid)
        octaves = min(self._octaves, self._count_octaves_above(posting))
        if octaves < 1:
            return out
        table = make_crater_table(
            self._make_population(octaves), *_bound_body_box(body_from_grid, lat, lon)
        )
        directions = xyz_from_latlon(table[:, LAT], table[:, LON], 1.0) @ body_from_grid
        own_lat = np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))
        row = (grid.north - own_lat) / step
        col = np.mod(np.arctan2(directions[:, 1], directions[:, 0]) - grid.west, 2.0 * np.pi) / step
        reach = REACH * table[:, DIAMETER] / posting
        wide = reach / np.cos(own_lat)
        turn = 2.0 * np.pi / step
        near = (row > -reach) & (row < rows + reach)
        near &= 0.5 * np.pi - np.abs(own_lat) > 10.0 * table[:, DIAMETER] / self.radius_m
        step_y, step_x = np.full(rows, posting), posting * np.cos(lat)
        # a crater at the grid's west end also reaches over its east end, and the other way round
        for shift in (0.0, -turn, turn):
            seen = near & (col + shift > -wide) & (col + shift < cols + wide)
            add_craters(out, row[seen], col[seen] + shift, table[seen], step_y, step_x)
        return out

    def sample_local(self, projection: Stereographic, posting_m: float, size: int) -> Float32Array:
        """Heights to add on a map grid (size, size), float32 m, row 0 north: means over a cell."""
        out = np.zeros((size, size), np.float32)
        x, y = make_node_grid(size, posting_m)
        lat, lon = projection.latlon(x, y)
        directions = xyz_from_latlon(lat.ravel(), lon.ravel(), 1.0)
        noise = fractal.sum_noise(self._select_resolved(posting_m), directions)
        out += noise.reshape(size, size).astype(np.float32)
        lon = wrap_longitude(lon - projection.lon)
        # over a pole the box is the whole turn
        over_pole = abs(projection.lat) + size * posting_m / self.radius_m >= 0.5 * np.pi
        west, width = (-np.pi, 2.0 * np.pi) if over_pole else (float(lon.min()), float(np.ptp(lon)))
        table = self._make_craters(
            posting_m, float(lat.min()), west + projection.lon, float(lat.max()), width, over_pole
        )
        cx, cy = projection.xy_from_latlon(table[:, LAT], table[:, LON])
        middle = (size - 1) / 2.0
        # the map's scale is 1 + (rho / 2R)^2: craters grow with it
        table[:, DIAMETER] *= 1.0 + (cx * cx + cy * cy) / (2.0 * self.radius_m) ** 2
        steps = np.full(size, posting_m)
        add_craters(out, middle - cy / posting_m, middle + cx / posting_m, table, steps, steps)
        return out

    def _make_craters(
        self,
        posting_m: float,
        south: float,
        west: float,
        north: float,
        width: float,
        over_pole: bool = False,
    ) -> FloatArray:
        if over_pole:
            south, north = (south, 0.5 * np.pi) if north > 0.0 else (-0.5 * np.pi, north)
        octaves = min(self._octaves, self._count_octaves_above(CELL_SHARE * posting_m))
        return make_crater_table(self._make_population(octaves), south, west, north, width)

    def _count_octaves_above(self, diameter_m: float) -> int:
        """Octaves of craters that are all at least so large."""
        return max(0, int(np.floor(np.log2(self.largest_m / diameter_m) + 1e-6)))

    def _make_population(self, octaves: int) -> Population:
        return Population(self.seed, octaves, self.largest_m, self.saturation, self.radius_m)

    def _select_resolved(self, posting_m: float) -> fractal.Octaves:
        return fractal.select_resolved(self._noise, posting_m)


def _bound_body_box(
    body_from_grid: FloatArray, lat: FloatArray, lon: FloatArray
) -> tuple[float, float, float, float]:
    """South, west, north, width (rad, body frame) of a box around a grid in a turned frame."""
    # the rim of the grid bounds it, unless a pole of the body lies within
    a, b = lat[:: max(1, lat.size // 64)], lon[:: max(1, lon.size // 64)]
    a, b = np.append(a, lat[-1]), np.append(b, lon[-1])
    all_lat, all_lon = np.meshgrid(a, b, indexing="ij")
    directions = xyz_from_latlon(all_lat.ravel(), all_lon.ravel(), 1.0) @ body_from_grid.T
    # what lies between the places looked at: a step of theirs and a margin
    margin = float(np.abs(np.diff(a)).max() + np.abs(np.diff(b)).max())
    all_lat_body = np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))
    south, north = float(all_lat_body.min()) - margin, float(all_lat_body.max()) + margin
    if max(-south, north) >= 0.5 * np.pi - 0.02:
        return max(south, -0.5 * np.pi), -np.pi, min(north, 0.5 * np.pi), 2.0 * np.pi
    middle = directions.mean(axis=0)
    centre = float(np.arctan2(middle[1], middle[0]))
    offset = wrap_longitude(np.arctan2(directions[:, 1], directions[:, 0]) - centre)
    half = min(float(np.abs(offset).max()) + margin / np.cos(max(-south, north)), np.pi)
    return south, centre - half, north, 2.0 * half
