"""Seeded relief below a DEM's posting: ground that a catalog of that DEM does not have.

Craters in equilibrium (`craters`) from twice the DEM's posting down to a smallest diameter, and
random relief (`fractal`) with a power law over the same band. Neither holds net height, so the
DEM's own content stays as it is. For one seed the ground is the same wherever and however it is
sampled.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.latlon import Lattice, wrap_longitude, xyz_from_latlon
from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.terrain.synthetic import craters, fractal

# Craters below this share of a node's cell are left out: a crater holds no net height, and their
# number, 1 / D^2, would fill the memory where a small smallest_m meets a wide ground.
CELL_SHARE = 0.25


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
        total = craters.sum_crater_heights(self._make_population(self._octaves), *flat)
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
        row = (north - table[:, craters.LAT]) / step_lat
        # a crater's longitude is brought next to the window's middle, so that ±180° is no border
        middle = west + 0.5 * step_lon * (cols - 1)
        col = (wrap_longitude(table[:, craters.LON] - middle) + middle - west) / step_lon
        step_x = self.radius_m * np.cos(lat) * step_lon
        craters.add_craters(out, row, col, table, np.full(rows, posting), step_x)
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
        table = craters.make_crater_table(
            self._make_population(octaves), *_bound_body_box(body_from_grid, lat, lon)
        )
        directions = (
            xyz_from_latlon(table[:, craters.LAT], table[:, craters.LON], 1.0) @ body_from_grid
        )
        own_lat = np.arcsin(np.clip(directions[:, 2], -1.0, 1.0))
        row = (grid.north - own_lat) / step
        col = np.mod(np.arctan2(directions[:, 1], directions[:, 0]) - grid.west, 2.0 * np.pi) / step
        reach = craters.REACH * table[:, craters.DIAMETER] / posting
        wide = reach / np.cos(own_lat)
        turn = 2.0 * np.pi / step
        near = (row > -reach) & (row < rows + reach)
        near &= 0.5 * np.pi - np.abs(own_lat) > 10.0 * table[:, craters.DIAMETER] / self.radius_m
        step_y, step_x = np.full(rows, posting), posting * np.cos(lat)
        # a crater at the grid's west end also reaches over its east end, and the other way round
        for shift in (0.0, -turn, turn):
            seen = near & (col + shift > -wide) & (col + shift < cols + wide)
            craters.add_craters(out, row[seen], col[seen] + shift, table[seen], step_y, step_x)
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
        cx, cy = projection.xy_from_latlon(table[:, craters.LAT], table[:, craters.LON])
        middle = (size - 1) / 2.0
        # the map's scale is 1 + (rho / 2R)^2: craters grow with it
        table[:, craters.DIAMETER] *= 1.0 + (cx * cx + cy * cy) / (2.0 * self.radius_m) ** 2
        steps = np.full(size, posting_m)
        craters.add_craters(
            out, middle - cy / posting_m, middle + cx / posting_m, table, steps, steps
        )
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
        return craters.make_crater_table(self._make_population(octaves), south, west, north, width)

    def _count_octaves_above(self, diameter_m: float) -> int:
        """Octaves of craters that are all at least so large."""
        return max(0, int(np.floor(np.log2(self.largest_m / diameter_m) + 1e-6)))

    def _make_population(self, octaves: int) -> craters.Population:
        return craters.Population(
            self.seed, octaves, self.largest_m, self.saturation, self.radius_m
        )

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
