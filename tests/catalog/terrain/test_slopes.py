"""Slopes of terrain models: planes, gdaldem, holes, maps in degrees."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine

from catalog.arrays import Float32Array
from catalog.bodies.body import load_body
from catalog.errors import DataError, NothingToDoError
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.slopes import (
    SlopeSummary,
    compute_slope_components,
    convert_to_degrees,
    iterate_slopes,
    summarise_slopes,
)

MOON = load_body("moon")
RADIUS = MOON.radius_m
LOCAL = f"+proj=stere +lat_0=-70 +lon_0=20 +R={RADIUS:.1f} +units=m"
DEGREES = f"+proj=longlat +R={RADIUS:.1f}"


def source(path: Path, heights: Float32Array, step: float, crs: str = LOCAL) -> DemSource:
    rows, cols = heights.shape
    place = Affine(step, 0.0, -0.5 * cols * step, 0.0, -step, 0.5 * rows * step)
    with rasterio.open(
        path, "w", "GTiff", cols, rows, 1, rasterio.CRS.from_proj4(crs), place, "float32", np.nan
    ) as file:
        file.write(heights, 1)
    return DemSource.open(DemSettings(str(path)), Path.cwd(), MOON)


def rough(size: int = 40) -> Float32Array:
    return np.random.default_rng(3).normal(0.0, 2.0, (size, size)).cumsum(axis=0).astype(np.float32)


@pytest.mark.parametrize("base_m", [0.5, 2.0, 3.0, 5.0, 7.9])
def test_a_plane_has_its_slope_on_every_base(base_m: float) -> None:
    y, x = np.mgrid[0:30, 0:40].astype(np.float32)
    east, north = compute_slope_components(0.2 * x - 0.3 * y, 2.0, 3.0, base_m)
    inner = np.s_[4:-4, 4:-4]
    np.testing.assert_allclose(east[inner], 0.1, atol=1e-6)
    np.testing.assert_allclose(north[inner], 0.1, atol=1e-6)


def test_a_base_between_postings_takes_bilinear_heights() -> None:
    heights = rough()
    east, _ = compute_slope_components(heights, 1.0, 1.0, 5.0)  # 2.5 postings to either side
    ahead = 0.5 * (heights[10, 22] + heights[10, 23])
    behind = 0.5 * (heights[10, 18] + heights[10, 17])
    assert east[10, 20] == pytest.approx((ahead - behind) / 5.0, rel=1e-5)


def test_slopes_are_those_of_gdaldem_on_a_base_of_two_postings(tmp_path: Path) -> None:
    if shutil.which("gdaldem") is None:
        pytest.skip("gdaldem is not on this machine: it comes with GDAL's programs")
    heights = rough()
    dem = source(tmp_path / "dem.tif", heights, 2.0)
    _, found = summarise_slopes(dem, 4.0)
    words = ["gdaldem", "slope", "-alg", "ZevenbergenThorne", "dem.tif", "slopes.tif"]
    subprocess.run(words, cwd=tmp_path, check=True, capture_output=True)
    with rasterio.open(tmp_path / "slopes.tif") as file:
        expected = file.read(1)
    np.testing.assert_allclose(found[1:-1, 1:-1], expected[1:-1, 1:-1], atol=1e-2)


def test_a_map_in_degrees_has_the_slopes_of_its_ground(tmp_path: Path) -> None:
    """At latitudes near 0 a degree is 30 km: a plane that rises by 3 km over one."""
    x = np.mgrid[0:24, 0:24][1].astype(np.float32)
    step = 0.01
    metres = np.radians(step) * RADIUS
    dem = source(tmp_path / "dem.tif", 0.1 * metres * x, step, DEGREES)
    summary, found = summarise_slopes(dem, 3.0)
    assert summary.base_m == pytest.approx(2.0 * metres, rel=1e-3)
    assert np.nanmedian(found) == pytest.approx(np.degrees(np.arctan(0.1)), rel=1e-3)
    assert (summary.share_above(5.0), summary.share_above(7.0)) == (pytest.approx(1.0), 0.0)


def test_strips_and_the_whole_give_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dem = source(tmp_path / "dem.tif", rough(), 1.0)
    whole = summarise_slopes(dem, 5.0)[1]
    monkeypatch.setattr("catalog.terrain.slopes.STRIP_PIXELS", 7 * 40)
    tops = [top for top, _ in iterate_slopes(dem, 5.0)]
    assert len(tops) > 3
    np.testing.assert_array_equal(summarise_slopes(dem, 5.0)[1], whole)


def test_holes_have_no_slope_and_all_else_counts(tmp_path: Path) -> None:
    heights = rough()
    heights[10:14, 10:14] = np.nan
    summary, found = summarise_slopes(source(tmp_path / "dem.tif", heights, 2.0), 4.0)
    assert np.isnan(found[9:15, 11]).all()
    assert summary.covered == pytest.approx(float(np.isfinite(found).mean()), abs=1e-3)


def test_a_model_of_holes_alone_says_so(tmp_path: Path) -> None:
    heights = np.full((12, 12), np.nan, np.float32)
    heights[::3, ::3] = 1.0
    with pytest.raises(NothingToDoError, match="fill its holes"):
        summarise_slopes(source(tmp_path / "dem.tif", heights, 2.0), 4.0)


def test_a_base_as_wide_as_the_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="shorter --base-m"):
        summarise_slopes(source(tmp_path / "dem.tif", rough(), 2.0), 60.0)


def test_shares_are_of_the_area() -> None:
    summary = SlopeSummary(3.0)
    degrees = np.array([[1.0, 10.0, np.nan]], np.float32)
    summary.add(degrees, np.array([[1.0, 3.0, 4.0]], np.float32))
    assert summary.share_above(7.0) == pytest.approx(0.75)
    assert summary.covered == pytest.approx(0.5)
    assert summary.rms_deg == pytest.approx(np.sqrt((1.0 + 300.0) / 4.0))


def test_a_slope_of_45_deg_is_that_of_one_metre_a_metre() -> None:
    components = np.array([[[0.6]], [[0.8]]], np.float32)
    assert convert_to_degrees(components)[0, 0] == pytest.approx(45.0)
