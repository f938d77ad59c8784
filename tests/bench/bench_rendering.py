"""Shading with cast shadows against GDAL's hillshade without, and the navigator's reference."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from catalog.config import resource
from catalog.photometry.laws import find_law
from catalog.rendering.map_view import render_map
from catalog.rendering.shadow import make_lit_mask
from catalog.terrain.skyline.local import compute_skyline_limits_deg
from tests.bench import hillshade
from tests.bench.timing import best, in_turn, result, sized, spread, within

pytestmark = pytest.mark.bench

MOON_M, POSTING_M, SIZE = 1_737_400.0, 118.45, 2048
SHADED = sized(2048, 256)  # pixels a side, shaded and compared with GDAL
SUN = np.array([0.6, -0.5, 0.25])
ROUNDS = 25
# what the figures ask for
REFERENCE_MS, SKYLINE_MS, RATIOS = 5.0, 5.0, {"lunar_lambert": 2.5, "hapke": 1.3}


@pytest.fixture(scope="module")
def tile() -> NDArray[np.float32]:
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as source:
        return source.read(1)[:SIZE, :SIZE].astype(np.float32)


def write_map(tile: NDArray[np.float32], path: Path) -> Path:
    """A raster, not compressed."""
    with rasterio.open(
        path, "w", driver="GTiff", width=tile.shape[1], height=tile.shape[0], count=1,
        dtype="float32", crs="EPSG:32633",
        transform=rasterio.Affine(POSTING_M, 0, 5e5, 0, -POSTING_M, 5e6),
    ) as target:  # fmt: skip
        target.write(tile, 1)
    return path


def test_shading_with_shadows_against_gdal_hillshade(tile, tmp_path):
    """Speed over hillshade's of the same raster, less the time of starting that on a small one."""
    tile = np.ascontiguousarray(tile[:SHADED, :SHADED])
    whole, small = (
        write_map(tile, tmp_path / "a.tif"),
        write_map(tile[:16, :16], tmp_path / "b.tif"),
    )
    calls = {
        "hillshade": lambda: hillshade.make(whole, tmp_path / "out.tif"),
        "its start": lambda: hillshade.make(small, tmp_path / "out.tif"),
        "cast shadows alone": lambda: make_lit_mask(tile, POSTING_M, SUN, MOON_M),
    }
    for law in ("lommel_seeliger", "lunar_lambert", "hapke"):
        value = find_law(law)
        calls[law] = lambda law=value: render_map(tile, POSTING_M, SUN, radius_m=MOON_M, law=law)
    times = in_turn(calls, ROUNDS)
    theirs = np.subtract(times.pop("hillshade"), times.pop("its start"))
    rate = tile.size / 1e6 / np.median(theirs)
    which = "gdaldem" if shutil.which("gdaldem") else "rasterio's GDAL"
    result(f"hillshade by {which}, which casts no shadows", f"{rate:.0f} Mpx/s")
    for name, seconds in times.items():
        ratio = spread(theirs / seconds)
        rate = tile.size / 1e6 / np.median(seconds)
        shading = name.replace("_", "-") + ("" if "shadows" in name else " shading with shadows")
        limit = f"; limit {RATIOS[name]} ×" if name in RATIOS else ""
        result(shading, f"{rate:.0f} Mpx/s", f"{ratio} × that hillshade{limit}")
        assert within(RATIOS.get(name, 0.0), ratio.median)


def test_a_reference_patch_with_its_shadows(tile):
    patch = np.ascontiguousarray(tile[900:980, 1300:1380])
    camera = np.array([20e3, -30e3, 100e3])
    for law in ("lommel_seeliger", "lunar_lambert", "hapke"):
        seconds = best(
            lambda law=law: render_map(
                patch, POSTING_M, SUN, radius_m=MOON_M, law=find_law(law), camera_local=camera
            ),
            50,
        )
        what = f"reference patch of 80 nodes with shadows, {law.replace('_', '-')}"
        result(what, f"{seconds * 1e3:.3f} ms", f"limit {REFERENCE_MS:g} ms")
        assert within(seconds * 1e3, REFERENCE_MS)


def test_the_skyline_of_a_point(tile):
    levels, grid, posting = [], tile[300:1580, 600:1880], POSTING_M
    for _ in range(5):
        middle = grid.shape[0] // 2
        cut = slice(middle - 40, middle + 40)
        levels.append((np.ascontiguousarray(grid[cut, cut]), posting))
        grid = cv2.resize(grid, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        posting *= 2
    seconds = best(lambda: compute_skyline_limits_deg(levels, 0, MOON_M), 20)
    limit = f"limit {SKYLINE_MS:g} ms"
    result("skyline of a point, 36 azimuths", f"{seconds * 1e3:.2f} ms", limit)
    assert within(seconds * 1e3, SKYLINE_MS)
