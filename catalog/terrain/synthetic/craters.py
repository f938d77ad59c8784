"""A seeded population of small craters on a sphere, in equilibrium, fresh to worn.

Sizes: small lunar craters stand in equilibrium, N(> D) = f 1.54 D^-2 with f a few percent of
geometric saturation (Gault 1970; Minton et al., Icarus 326, 2019). Depths run from 0.20 D (fresh)
to a few percent of D, most craters being worn. Every profile holds no net volume: what the bowl
lacks lies in its rim, so that a field of craters leaves the ground's mean height as it was and has
hardly any power at wavelengths above a few diameters.

Craters live in cells of latitude bands, one set of cells for each octave of diameter. A cell's
craters follow from the seed and the cell's number alone, so any region of the body, sampled in
any order, shows the same ground.
"""

from typing import NamedTuple

import numba
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import kernel, parallel_kernel
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
