"""Shading with cast shadows against GDAL's hillshade without, and the navigator's reference."""

import shutil
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray

from catalog.config import resource
from catalog.rendering.map_view import render_map
from catalog.rendering.shadow import lit_mask
from catalog.terrain.skyline.local import skyline_limits_deg
from tests.bench.timing import best, sized, within

pytestmark = pytest.mark.bench

MOON_M, POSTING_M, SIZE = 1_737_400.0, 118.45, 2048
SHADED = sized(2048, 256)  # pixels a side, shaded and compared with GDAL
SUN = np.array([0.6, -0.5, 0.25])
REFERENCE_MS, SKYLINE_MS = 5.0, 5.0  # what the figures ask for


@pytest.fixture(scope="module")
def tile() -> NDArray[np.float32]:
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as source:
        return source.read(1)[:SIZE, :SIZE].astype(np.float32)


def hillshade_seconds(tile: NDArray[np.float32], folder: Path) -> float:
    """gdaldem on an uncompressed file, less the time of starting it on a small one."""
    times = []
    for name, grid in (("full", tile), ("small", tile[:16, :16])):
        path = folder / f"{name}.tif"
        with rasterio.open(
            path, "w", driver="GTiff", width=grid.shape[1], height=grid.shape[0], count=1,
            dtype="float32", crs="EPSG:32633",
            transform=rasterio.Affine(POSTING_M, 0, 5e5, 0, -POSTING_M, 5e6),
        ) as target:  # fmt: skip
            target.write(grid, 1)
        command = ["gdaldem", "hillshade", "-q", str(path), str(folder / f"{name}_shade.tif")]
        times.append(best(lambda c=command: subprocess.run(c, check=True), 5, time.perf_counter))
    return times[0] - times[1]


def test_shading_with_shadows_against_gdal_hillshade(tile, tmp_path):
    tile = np.ascontiguousarray(tile[:SHADED, :SHADED])
    pixels = tile.size / 1e6
    gdal = hillshade_seconds(tile, tmp_path) if shutil.which("gdaldem") else None
    if gdal is None:
        print("\n  gdaldem is not installed: no ratio")
    else:
        print(f"\n  gdaldem hillshade, no shadows     {pixels / gdal:7.0f} Mpx/s   1.00")
    rates = {
        "cast shadows alone": best(
            lambda: lit_mask(tile, POSTING_M, SUN, MOON_M), 5, time.perf_counter
        )
    }
    for law in ("lommel_seeliger", "lunar_lambert", "hapke"):
        rates[f"{law}, cast shadows"] = best(
            lambda law=law: render_map(tile, POSTING_M, SUN, radius_m=MOON_M, law=law),
            5,
            time.perf_counter,
        )
    for name, seconds in rates.items():
        ratio = f"{gdal / seconds:6.2f}" if gdal else ""
        print(f"  {name:<32}  {pixels / seconds:7.0f} Mpx/s {ratio}")
    if gdal is not None:
        assert within(rates["lommel_seeliger, cast shadows"], 2.0 * gdal)


def test_a_reference_patch_with_its_shadows(tile):
    patch = np.ascontiguousarray(tile[900:980, 1300:1380])
    camera = np.array([20e3, -30e3, 100e3])
    for law in ("lommel_seeliger", "lunar_lambert", "hapke"):
        seconds = best(
            lambda law=law: render_map(
                patch, POSTING_M, SUN, radius_m=MOON_M, law=law, camera_local=camera
            ),
            50,
        )
        print(f"\n  reference patch 80 x 80, {law:<16} {seconds * 1e3:6.3f} ms", end="")
        assert within(seconds * 1e3, REFERENCE_MS)
    print()


def test_the_skyline_of_a_point(tile):
    levels, grid, posting = [], tile[300:1580, 600:1880], POSTING_M
    for _ in range(5):
        middle = grid.shape[0] // 2
        cut = slice(middle - 40, middle + 40)
        levels.append((np.ascontiguousarray(grid[cut, cut]), posting))
        grid = cv2.resize(grid, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        posting *= 2
    seconds = best(lambda: skyline_limits_deg(levels, 0, MOON_M), 20)
    print(f"\n  skyline of a point, 36 azimuths   {seconds * 1e3:6.2f} ms")
    assert within(seconds * 1e3, SKYLINE_MS)
