"""Small terrain models for tests."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from catalog.bodies.body import load_body
from tests.catalog.made_catalogs import catalog_copy, make, world, written  # noqa: F401, fixtures

SPHERE = "+R=1737400 +no_defs"


def smooth_heights(lat, lon):
    """A surface known everywhere (rad), continuous round the body and over its poles, m."""
    x, y, z = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    return 3000.0 * np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 1500.0 * z * np.sin(5.0 * x * y)


def write_dem(path: Path, values, crs=f"+proj=longlat {SPHERE}", affine=None, **options) -> Path:
    """A GeoTIFF; without an affine it covers the whole body from -180°."""
    rows, cols = values.shape
    if affine is None:
        affine = Affine(360.0 / cols, 0.0, -180.0, 0.0, -180.0 / rows, 90.0)
    shape = {"height": rows, "width": cols, "count": 1, "dtype": values.dtype}
    with rasterio.open(
        path, "w", driver="GTiff", crs=crs, transform=affine, **shape, **options
    ) as dataset:
        dataset.write(values, 1)
    return path


def smooth_grid(rows: int):
    """The smooth surface on a whole-body grid of `rows` x 2 `rows` pixels, m."""
    lat = np.pi / 2.0 - (np.arange(rows) + 0.5) * np.pi / rows
    lon = -np.pi + (np.arange(2 * rows) + 0.5) * np.pi / rows
    return smooth_heights(lat[:, None], lon[None, :])


def rough_region(size: int = 320, seed: int = 3):
    """Rough ground of a power-law spectrum, m, and its affine: 0.02° pixels about 10 N 20 E."""
    rng = np.random.default_rng(seed)
    fx, fy = np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size))
    amplitude = np.maximum(np.hypot(fx, fy), 1.0 / size) ** -1.8
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((size, size))) * amplitude).real
    heights = 800.0 * (field - field.mean()) / field.std()
    half = size * 0.01
    return heights.astype(np.float32), Affine(0.02, 0.0, 20.0 - half, 0.0, -0.02, 10.0 + half)


@pytest.fixture
def dems() -> SimpleNamespace:
    """Makers of small terrain models."""
    return SimpleNamespace(
        smooth_heights=smooth_heights,
        smooth_grid=smooth_grid,
        rough_region=rough_region,
        write=write_dem,
        sphere=SPHERE,
    )


@pytest.fixture
def moon():
    return load_body("moon")
