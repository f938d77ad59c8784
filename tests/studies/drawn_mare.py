"""A terrain model of 474 m of a mare, of which none is to be had: the one of 948 m, drawn finer.

Between its postings it is a spline, with relief added that is as high as that of a real model of
474 m: the bundled crop of the far side beside its own means over 2 x 2 postings, on ground of the
same slope. What lies below 948 m is so of a real size, but drawn.
"""

from contextlib import closing
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from affine import Affine

from catalog.arrays import Float32Array, FloatArray
from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.pipeline.ingest import Bbox
from catalog.rasters import TERRAIN, handle_read_errors, open_raster
from catalog.terrain.dem.file import resolve_path
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.synthetic.model_error import map_rms_slope
from optnav_cli.simulation.globe_heights import sample_spline, spline_coefficients
from tests.studies import flights

NAME = "mare_474m.tif"
BOX: Bbox = (15.0, 1.0, 37.0, 23.0)  # of the mare scenario, with what its pictures show, and more
REAL = "data/farside_gld100_64ppd.tif"
SEED = 474
ROUND_NODES = 0.6  # sigma of what smooths the noise: a wave of four nodes is left
EDGES = (0.0, 0.03, 0.06, 0.1, 0.15, 0.25)  # of slopes, tangents


def write_drawn_mare(folder: Path) -> Path:
    """The model, in a folder. Raises ConfigError without the shared model of 948 m."""
    west, south, east, north = BOX
    path = resolve_path(flights.GLOBE, Path.cwd())
    source = DemSource.open(DemSettings(path=flights.GLOBE), Path.cwd(), load_body("moon"))
    with closing(source):
        cols, rows = source.pixel_from_latlon(np.radians([north, south]), np.radians([west, east]))
        (top, bottom), (left, right) = (np.rint(ends + 0.5).astype(int) for ends in (rows, cols))
        heights = source.read_window(top, left, bottom - top, right - left)
    with open_raster(path, TERRAIN) as dataset, handle_read_errors(path):
        place = dataset.transform @ Affine.translation(left, top) @ Affine.scale(0.5)
        crs, posting_m = dataset.crs, 0.5 * dataset.res[0]
    drawn = drawn_finer(heights, posting_m, fine_relief(real_heights(), posting_m))
    return flights.written_model(folder / NAME, drawn, crs, place)


def real_heights() -> Float32Array:
    """The bundled crop of 474 m, an even number of nodes along each side."""
    path = resource(REAL)
    with open_raster(path, TERRAIN) as dataset, handle_read_errors(path):
        heights = dataset.read(1).astype(np.float32)
    rows, cols = (n // 2 * 2 for n in heights.shape)
    return np.ascontiguousarray(heights[:rows, :cols])


def drawn_finer(heights: Float32Array, posting_m: float, relief: FloatArray) -> Float32Array:
    """Heights (2n, 2m) at half the posting of those given (n, m), with relief by `fine_relief`.

    posting_m  of the finer ones
    """
    smooth = twice_as_fine(heights)
    rng = np.random.default_rng(SEED)
    noise = rng.standard_normal(smooth.shape).astype(np.float32)
    noise = beyond_means(np.asarray(cv2.GaussianBlur(noise, (0, 0), ROUND_NODES), np.float32))
    slopes = map_rms_slope(smooth, posting_m, posting_m)
    size = np.interp(slopes, *relief).astype(np.float32)
    return np.asarray(smooth + size * noise / noise.std(), np.float32)


def fine_relief(heights: Float32Array, posting_m: float) -> FloatArray:
    """Slopes (tangents), and the rms height (m) that means over 2 x 2 nodes lose there, (2, k)."""
    lost = beyond_means(heights)
    slopes = map_rms_slope(heights - lost, posting_m, posting_m)
    found = []
    for low, high in pairwise(EDGES):
        some = (slopes >= low) & (slopes < high)
        if some.any():
            found.append((slopes[some].mean(), np.sqrt(np.mean(lost[some] ** 2))))
    return np.array(found, np.float64).T


def beyond_means(heights: Float32Array) -> Float32Array:
    """A grid (2n, 2m) less the spline through its means over 2 x 2 nodes."""
    rows, cols = (n // 2 for n in heights.shape)
    means = heights.reshape(rows, 2, cols, 2).mean(axis=(1, 3), dtype=np.float64)
    return np.asarray(heights - twice_as_fine(means.astype(np.float32)), np.float32)


def twice_as_fine(heights: Float32Array) -> Float32Array:
    """The spline through a grid (n, m) at (2n, 2m) nodes, four about each of its own."""
    row, col = ((np.arange(2 * n) + 0.5) / 2.0 - 0.5 for n in heights.shape)
    return sample_spline(spline_coefficients(heights), *np.meshgrid(row, col, indexing="ij"))
