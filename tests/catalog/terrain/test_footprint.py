"""Where nodes fall in a raster, and means where columns crowd, against the long way round."""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from rasterio.transform import Affine
from scipy.ndimage import map_coordinates

from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.sampling.map_nodes import POLE_STEPS, STEPS, locate_grid


def mosaic_of(moon, folder, path) -> Mosaic:
    one = DemSettings(path=str(path))
    return Mosaic.from_files([one], folder, moon, folder / "overviews")


def as_near_as_allowed(step: int, size: int, posting_m: float, radius_m: float) -> float:
    """Latitude (deg) of the grid nearest to the north pole that has steps of so many nodes."""
    nodes = 1.001 * POLE_STEPS * step + np.sqrt(2.0) * (size / 2.0 + 2 * step)
    return 90.0 - np.degrees(nodes * posting_m / radius_m)


@pytest.mark.parametrize(
    "where", [0.0, -43.3, 71.0, 86.0, 89.0, -90.0, *(f"step {s}" for s in STEPS)]
)
@pytest.mark.parametrize("lon_deg", [0.0, 179.9, -97.0])
@pytest.mark.parametrize("size", [5, 9, 80, 81, 331])
def test_nodes_fall_where_their_latitude_and_longitude_say(
    tmp_path, dems, moon, where, lon_deg, size
):
    """Interpolated places are within a thousandth of a node, as near to a pole as steps go, too.

    The long way: the projection's latitude and longitude, then the raster's own formula.
    """
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(90).astype(np.float32))
    place = mosaic_of(moon, tmp_path, path).pyramids[0].source.georeference
    posting = 118.45
    lat_deg = where
    if isinstance(where, str):
        step = int(where.removeprefix("step "))
        lat_deg = as_near_as_allowed(step, size, posting, moon.radius_m)
    projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), moon.radius_m)
    pixels = locate_grid(place, projection, posting, size)
    lat, lon = (angle.ravel() for angle in projection.latlon(*make_node_grid(size, posting)))
    col, row = place.pixel_from_latlon(lat, lon)
    off = pixels.col - col
    off -= np.round(off / place.period) * place.period
    metres = np.radians(360.0 / place.shape[1]) * moon.radius_m
    assert np.abs(off * np.cos(lat)).max() * metres < 1e-3 * posting
    assert np.abs(pixels.row - row).max() * metres < 1e-3 * posting
    np.testing.assert_allclose(pixels.column_scale * np.maximum(np.cos(lat), 1e-9), 1.0, rtol=1e-4)


@pytest.mark.parametrize("pole", [90.0, -90.0])
@pytest.mark.parametrize("west", [False, True])
def test_nodes_fall_right_in_polar_stereographic_rasters(tmp_path, dems, moon, pole, west):
    crs = f"+proj=stere +lat_0={pole:g} +lon_0=33 {dems.sphere}"
    affine = Affine(2000.0, 0.0, -200e3, 0.0, -2000.0, 200e3)
    path = dems.write(
        tmp_path / "p.tif", np.eye(200, dtype=np.float32) * 100.0, crs=crs, affine=affine
    )
    one = DemSettings(path=str(path), longitude="west" if west else "east", heights="height")
    place = Mosaic.from_files([one], tmp_path, moon, tmp_path / "o").pyramids[0].source.georeference
    for lat_deg, lon_deg in ((pole, 12.0), (pole * 0.97, -170.0), (pole * 0.99, 33.0)):
        projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), moon.radius_m)
        pixels = locate_grid(place, projection, 500.0, 41)
        lat, lon = projection.latlon(*make_node_grid(41, 500.0))
        col, row = place.pixel_from_latlon(lat.ravel(), lon.ravel())
        np.testing.assert_allclose(pixels.col, col, atol=1e-6)
        np.testing.assert_allclose(pixels.row, row, atol=1e-6)


def dense_means(values, row, col, wide, rows_wide=1.0):
    """Means of linear samples, 96 along each footprint; `values` must have room on all sides."""
    share = (np.arange(96) + 0.5) / 96 - 0.5
    cols = col[:, None] + share * wide[:, None]
    rows = np.broadcast_to(row[:, None], cols.shape)
    return map_coordinates(values, [rows, cols], order=1).mean(axis=1)


@pytest.mark.parametrize("lat_deg", [62.0, 71.0, 75.5, 80.1, 84.0, 86.5, 88.0, 89.3, -77.0, -88.9])
def test_means_toward_the_poles_agree_with_dense_ones(tmp_path, dems, moon, lat_deg):
    """Noise correlated over ten columns: what is lost between few samples would show.

    On rows' middles, so that rows do not matter. Ours weigh a footprint's ends less sharply than a
    box does (two or three cubic samples of averaged columns), which on noise costs up to a quarter
    of the mean's own spread; a single column picked of thirty would leave no likeness at all.
    """
    rng = np.random.default_rng(1)
    rows, cols = 720, 1440
    spectrum = np.fft.rfft(rng.normal(0.0, 1.0, (rows, cols)), axis=1)
    spectrum *= np.exp(-0.5 * (2.0 * np.pi * np.fft.rfftfreq(cols) * 3.0) ** 2)
    values = np.fft.irfft(spectrum, cols, axis=1)
    values = (1000.0 * values / values.std()).astype(np.float32)
    mosaic = mosaic_of(moon, tmp_path, dems.write(tmp_path / "noise.tif", values))
    row = np.floor((90.0 - lat_deg) * 4.0)
    lat = np.full(2000, np.radians(90.0 - (row + 0.5) / 4.0))
    lon = rng.uniform(-np.pi, np.pi, 2000)
    ours = mosaic.heights(lat, lon, mosaic.posting_m)
    wide = np.minimum(1.0 / np.cos(lat), cols)
    col = (np.degrees(lon) + 180.0) * 4.0 - 0.5
    endless = np.hstack([values] * 3)
    truth = dense_means(endless, np.full(2000, row), col + cols, wide)
    assert np.corrcoef(ours, truth)[0, 1] > 0.95
    assert np.std(ours) == pytest.approx(np.std(truth), rel=0.12)
    assert abs(np.mean(ours - truth)) < 0.03 * np.std(truth)


def test_a_region_near_a_pole_is_averaged_and_keeps_its_holes(tmp_path, dems, moon):
    """Not all the way round, an odd number of columns, a hole."""
    rng = np.random.default_rng(2)
    values = rng.normal(0.0, 100.0, (120, 2001)).astype(np.float32)
    values[60:, 900:1300] = np.nan
    affine = Affine(0.02, 0.0, 150.0, 0.0, -0.02, 86.0)  # across 180°, columns 15 times too many
    mosaic = mosaic_of(moon, tmp_path, dems.write(tmp_path / "r.tif", values, affine=affine))
    row = rng.integers(10, 110, 3000).astype(float)
    col = rng.uniform(-100.0, 2100.0, 3000)
    lat, lon = np.radians(86.0 - 0.02 * (row + 0.5)), np.radians(150.0 + 0.02 * (col + 0.5))
    wide = 1.0 / np.cos(lat)
    ours = mosaic.heights(lat, lon, mosaic.posting_m)
    clear = wide + 20.0
    outside = (col < -clear) | (col > 2000.0 + clear)
    hole = (row > 62.0) & (np.abs(col - 1099.5) < 200.0 - clear)
    assert np.isnan(ours[outside | hole]).all()
    away = (row < 58.0) | (np.abs(col - 1099.5) > 200.0 + clear)
    known = (col > clear) & (col < 2000.0 - clear) & away
    assert np.isfinite(ours[known]).all()
    truth = dense_means(np.nan_to_num(values), row[known], col[known], wide[known])
    assert np.corrcoef(ours[known], truth)[0, 1] > 0.92
    assert np.std(ours[known]) == pytest.approx(np.std(truth), rel=0.12)


def test_what_was_read_before_does_not_change_heights(tmp_path, dems, moon):
    """Polar and other cells, forward and backward, with a cache that holds next to nothing."""
    rng = np.random.default_rng(3)
    values = rng.normal(0.0, 100.0, (720, 1440)).astype(np.float32)
    path = dems.write(tmp_path / "globe.tif", values)
    places = [(lat, lon) for lat in (90.0, 88.0, 84.0, 76.0, 10.0, -89.5) for lon in (0.0, 179.0)]

    def grids(order, limit):
        mosaic = mosaic_of(moon, tmp_path, path)
        mosaic._cache._bound = limit
        found = {}
        for place in order:
            projection = Stereographic(*np.radians(place), moon.radius_m)
            found[place] = [
                mosaic.local_grid(projection, mosaic.posting_m * f, 60).tobytes()
                for f in (0.5, 1.0, 2.0, 4.0)
            ]
        return found

    assert grids(places, 128 << 20) == grids(places[::-1], 1 << 10)


def test_a_whole_body_without_holes_is_covered_everywhere(tmp_path, dems, moon):
    values = dems.smooth_grid(90).astype(np.float32)
    whole = mosaic_of(moon, tmp_path / "a", dems.write(tmp_path / "whole.tif", values))
    values[40, 60] = np.nan
    holed = mosaic_of(moon, tmp_path / "b", dems.write(tmp_path / "holed.tif", values))
    lat, lon = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 361), np.linspace(-4.0, 4.0, 721))
    assert whole.covers(lat, lon).all()
    assert np.isfinite(whole.heights(lat, lon, whole.posting_m)).all()
    assert 0 < np.count_nonzero(~holed.covers(lat, lon)) < 40


@pytest.mark.parametrize("factor", [1.0, 20.0, 60.0])
def test_footprints_of_very_many_pixels_are_spread_over(tmp_path, dems, moon, factor):
    """An odd number of columns, never halved, up to all of a ring; postings far beyond the levels.

    The means of a linear surface are its values at the middle, so nothing of it may get lost.
    """
    values = np.empty((361, 721), np.float32)
    values[:] = 10.0 * (90.0 - (np.arange(361) + 0.5) * 180.0 / 361)[:, None]
    mosaic = mosaic_of(moon, tmp_path, dems.write(tmp_path / "odd.tif", values))
    assert mosaic.get_level_windows(0, 0).most_halvings == 0
    lat_deg = np.linspace(-90.0, 90.0, 400) if factor == 1.0 else np.linspace(-30.0, 30.0, 400)
    heights = mosaic.heights(
        np.radians(lat_deg), np.linspace(-3.0, 3.0, 400), mosaic.posting_m * factor
    )
    # a pole's last half pixel has no row beyond it on this raster
    np.testing.assert_allclose(heights, 10.0 * lat_deg, atol=3.0 if factor == 1.0 else 20.0)


@pytest.mark.parametrize("longitude", ["east", "west"])
@pytest.mark.parametrize("lat_deg", [0.0, -50.0, 66.0, 75.0, 84.0])
def test_map_grids_have_the_heights_of_their_nodes(tmp_path, dems, moon, lat_deg, longitude):
    """Whichever way the raster counts longitudes, and with a hole; to 2 m on relief of 2000 m.

    Rows of nodes are sampled together, scattered places one by one.
    """
    values = dems.smooth_grid(360).astype(np.float32)
    values[200:203, 300:303] = np.nan
    one = DemSettings(path=str(dems.write(tmp_path / "g.tif", values)), longitude=longitude)
    mosaic = Mosaic.from_files([one], tmp_path, moon, tmp_path / "o")
    projection = Stereographic(np.radians(lat_deg), np.radians(31.0), moon.radius_m)
    for factor in (0.5, 1.0, 2.1):
        posting = mosaic.posting_m * factor
        lat, lon = projection.latlon(*make_node_grid(40, posting))
        found = mosaic.local_grid(projection, posting, 40)
        wanted = mosaic.heights(lat, lon, posting)
        np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
        assert np.nanmax(np.abs(found - wanted)) < 1e-3 * np.ptp(values[:100])


@pytest.mark.bench
def test_a_cells_ground_costs_little_more_than_plain_interpolation(shared_data, tmp_path, moon):
    """A cell's ground at the finest posting, tiles read before; CPU time, the least of several.

    Against scipy's linear interpolation of as many nodes, whose places are known, from one array.
    Usual and high ground is read row by row; about the poles, 2 thousandths of the body, nodes are
    taken one by one, at twice and more the time of each.
    """
    mosaic = mosaic_of(moon, tmp_path, shared_data("moon/moon_gld100_32ppd.tif"))
    size = 160
    heights, made = np.zeros((2 * size, 2 * size)), np.zeros((size, size))
    row, col = np.indices((size, size), dtype=np.float64)
    places = np.stack([0.9 * row + 0.3 * col, 0.9 * col - 0.3 * row + size / 3.0])  # a turned grid

    def grid(lat_deg: float) -> None:
        projection = Stereographic(np.radians(lat_deg), 0.2, moon.radius_m)
        mosaic.local_grid(projection, mosaic.posting_m, size)

    def plain() -> None:
        map_coordinates(heights, places, made, order=1)

    def cost(call: Callable[[], None]) -> float:
        started = time.process_time()
        call()
        return time.process_time() - started

    usual, high, polar = -40.0, (-65.0, -76.0, -83.0), (-87.0, -89.5, 90.0)
    calls = {lat: partial(grid, lat) for lat in (usual, *high, *polar)}
    # in turns, so that all of them meet the same load of the machine
    rounds = [[cost(plain), *(cost(call) for call in calls.values())] for _ in range(30)]
    reference, *least = np.min(rounds, axis=0)
    ratio = dict(zip(calls, np.array(least) / reference, strict=True))
    assert ratio[usual] < 1.0
    assert max(ratio[lat] for lat in high) < 2.0
    assert max(ratio[lat] for lat in polar) < 5.0
