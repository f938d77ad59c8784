"""Maps: every pixel knows its place and its cell, by another library, too; relief is lit right."""

import sqlite3

import numpy as np
import pytest
from pyproj import CRS, Transformer

from catalog.geometry.cells import CellGrid
from catalog.store.reader import Catalog
from optnav_cli.report.relief import MOON_WORDS, OWN_WORDS, find_relief, shade
from optnav_cli.report.views import STEPS, Scale, blend, choose_views, compute_corners, find_rows
from tests.optnav_cli.report.pages import RADIUS_M, a_catalog

GLOBAL = CellGrid(10.0)


def views_of(cells, grid):
    centres = np.array([grid.centre_deg(int(cell)) for cell in cells])
    return choose_views(grid, np.asarray(cells, np.int64), *centres.T, RADIUS_M)


def test_places_and_pixels_of_all_maps_agree():
    for view in views_of(np.arange(GLOBAL.total), GLOBAL):
        lat, lon = view.pixels()
        known = np.isfinite(lat)
        x, y = view.places(lat[known], lon[known])
        again = view.latlon(x, y)
        # where the map is a point, a pole, its longitude is anything
        assert np.abs(again[0] - lat[known]).max() < 1e-5
        turn = (again[1] - lon[known] + 180.0) % 360.0 - 180.0
        assert np.abs(turn * np.cos(np.radians(lat[known]))).max() < 1e-5


def test_the_main_map_of_a_body_is_equal_area():
    view = views_of(np.arange(GLOBAL.total), GLOBAL)[0]
    lat, lon = view.pixels()
    rows = find_rows(GLOBAL, np.arange(GLOBAL.total), lat, lon)
    pixels = np.bincount(rows[rows >= 0], minlength=GLOBAL.total)
    west_south_east_north = np.array([GLOBAL.bounds_deg(cell) for cell in range(GLOBAL.total)])
    west, south, east, north = np.radians(west_south_east_north).T
    area = (east - west) * (np.sin(north) - np.sin(south)) / (4.0 * np.pi)
    assert pixels / pixels.sum() == pytest.approx(area, rel=0.02)


def test_the_polar_maps_are_polar_stereographic_with_zero_down_in_the_north():
    caps = views_of(np.arange(GLOBAL.total), GLOBAL)[1:]
    lat, lon = np.array([61.0, 75.0, 89.0]), np.array([0.0, 100.0, -170.0])
    for view, side in zip(caps, (1, -1), strict=True):
        crs = CRS.from_proj4(f"+proj=stere +lat_0={90 * side} +lon_0=0 +R={RADIUS_M}")
        truth = Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True)
        expected = truth.transform(lon, side * lat)
        assert np.array(view.places(side * lat, lon)) * 1e3 == pytest.approx(np.array(expected))
        known = np.isfinite(view.pixels()[0])
        assert known.mean() == pytest.approx(np.pi / 4.0, abs=0.02)
    assert caps[0].places(70.0, 0.0)[1] < 0.0


def test_every_pixel_of_a_region_across_180_degrees_finds_its_cell():
    grid = CellGrid(2.0)
    cells = grid.find_cells_in_bbox(176.0, -6.0, -176.0, 6.0)
    view = views_of(cells, grid)[0]
    lat, lon = view.pixels()
    rows = find_rows(grid, cells, lat, lon)
    inside = (np.abs(lat) < 6.0) & (np.abs(np.mod(lon, 360.0) - 180.0) < 4.0)
    assert (rows >= 0)[inside].all()
    assert not (rows >= 0)[(np.abs(lat) > 6.1)].any()
    assert set(np.unique(rows)) == {-1, *range(len(cells))}


def test_the_corners_of_cells_are_their_bounds():
    cells = np.arange(GLOBAL.total)
    lat, lon = compute_corners(GLOBAL, cells)
    for cell in (1, 100, GLOBAL.total - 2):
        west, south, east, north = GLOBAL.bounds_deg(cell)
        assert {lat[cell].min(), lat[cell].max()} == {south, north}
        assert lon[cell].min() == pytest.approx(west)
        assert lon[cell].max() == pytest.approx(east if east < 180.0 else west + 5.0, abs=40.0)


def test_slopes_that_face_the_upper_left_are_bright():
    y, x = np.mgrid[:40, :40].astype(np.float32)
    hill = -np.hypot(x - 20.0, y - 20.0)
    light = shade(hill, 1.0)
    assert light[10, 10] > 190
    assert light[30, 30] < 110
    assert light[30, 10] == pytest.approx(150, abs=2)
    hole = hill.copy()
    hole[5:9, 5:9] = np.nan
    assert np.array_equal(shade(hole, 1.0)[7, 7], 150)


def test_the_moon_s_relief_lies_where_the_moon_has_it():
    """Mare Crisium, 17 N 59 E, is smooth; the far-side highlands are not."""
    lat, lon = np.meshgrid(np.linspace(89.9, -89.9, 720), np.linspace(-179.9, 179.9, 1440))
    lat, lon = lat.T, lon.T

    class Moon:
        class meta:
            body, radius_m = "moon", RADIUS_M

    light, known, words = find_relief(Moon, lat, lon)
    assert words == MOON_WORDS
    assert known.all()
    at = {"mare": (17.0, 59.0), "highlands": (20.0, -150.0)}
    rough = {
        name: light[(np.abs(lat - a) < 4.0) & (np.abs(lon - b) < 4.0)].std()
        for name, (a, b) in at.items()
    }
    assert rough["mare"] < 0.4 * rough["highlands"]


def test_a_region_is_shaded_from_its_own_patches(tmp_path):
    """The made-up catalog has 3.8 km wide patches, 7.6 km in the coarser level."""
    dense = a_catalog(tmp_path / "c.gpkg", 60, (10.0, 10.5), (20.0, 20.5), 0.1)
    with Catalog.open(dense) as catalog:
        view = choose_views(
            catalog.grid, catalog.ids, catalog.lat_deg, catalog.lon_deg, RADIUS_M
        )[0]  # fmt: skip
        light, known, words = find_relief(catalog, *view.pixels())
    assert words == OWN_WORDS
    assert known.mean() > 0.3
    assert light[known].std() > 20.0


def test_a_region_whose_patches_leave_most_of_it_open_has_no_relief(tmp_path):
    with Catalog.open(a_catalog(tmp_path / "c.gpkg")) as catalog:
        view = choose_views(
            catalog.grid, catalog.ids, catalog.lat_deg, catalog.lon_deg, RADIUS_M
        )[0]  # fmt: skip
        assert find_relief(catalog, *view.pixels()) is None


@pytest.mark.parametrize("more_is_better", [True, False])
def test_better_values_are_brighter(more_is_better):
    scale = Scale.fit(np.linspace(0.0, 1.0, 100), more_is_better)
    luminance = scale.bgr(np.linspace(0.0, 1.0, STEPS)).astype(float) @ [0.114, 0.587, 0.299]
    steps = np.diff(luminance if more_is_better else luminance[::-1])
    assert steps.min() > -1.0
    assert np.ptp(luminance) > 150.0


def test_one_value_everywhere_still_has_a_scale():
    scale = Scale.fit(np.full(5, 0.3), True)
    assert scale.low < 0.3 < scale.high


def test_values_that_span_much_get_a_logarithmic_scale_and_others_do_not():
    values = np.concatenate([np.geomspace(0.01, 10.0, 500), [-1.0, 0.0]])
    scale = Scale.fit(values, True, log=True)
    assert scale.log
    places = scale.map_to_axis(np.array([-1.0, 0.0, 0.1, 1.0]))
    assert places[0] == places[1] == np.log10(scale.low)
    assert places[3] - places[2] == pytest.approx(1.0)
    thirds = scale.bgr(np.geomspace(scale.low, scale.high, 4)).tolist()
    even = Scale(0.0, 3.0, True).bgr(np.arange(4.0)).tolist()
    assert thirds[0] == even[0]
    assert thirds[3] == even[3]
    assert not Scale.fit(np.linspace(1.0, 2.0, 50), True, log=True).log
    assert not Scale.fit(np.zeros(5), True, log=True).log


def test_a_tint_looks_in_the_legend_as_on_the_map():
    assert blend("#ff0000", 0.5, 100.0) == "#b23232"


def test_damaged_patches_leave_holes_in_the_relief_and_one_warning(tmp_path, caplog):
    path = a_catalog(tmp_path / "c.gpkg", 25, (10.0, 10.5), (20.0, 20.5), 0.1)

    def seen():
        with Catalog.open(path) as catalog:
            view = choose_views(
                catalog.grid, catalog.ids, catalog.lat_deg, catalog.lon_deg, RADIUS_M
            )[0]  # fmt: skip
            return find_relief(catalog, *view.pixels())[1].sum(), catalog.ids[:2].tolist()

    whole, ids = seen()
    assert caplog.messages == []
    with sqlite3.connect(path) as db:
        db.execute("UPDATE optnav_patches SET data = x'00' WHERE point_id IN (?, ?)", ids)
    db.close()
    assert seen()[0] < 0.97 * whole
    assert len(caplog.messages) == 1
    assert "2 damaged control points are missing in the relief" in caplog.text
