"""Heights on a graticule against the same places read one by one, and against themselves."""

import numpy as np
import pytest
from rasterio.transform import Affine

from catalog.geometry.cells import Graticule, Part
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings


def mosaic_of(moon, folder, *paths) -> Mosaic:
    named = [DemSettings(path=str(path), priority=i + 1) for i, path in enumerate(paths)]
    return Mosaic.from_files(named, folder, moon, folder / "overviews")


def zone(moon, posting, lat_deg):
    """A graticule whose columns are a posting apart at a latitude, and the row there."""
    row_angle = posting / moon.radius_m
    graticule = Graticule(row_angle, round(2.0 * np.pi * np.cos(np.radians(lat_deg)) / row_angle))
    return graticule, round((np.radians(lat_deg) + np.pi / 2.0) / row_angle - 0.5)


def latitudes_of(graticule, part):
    lat = graticule.lat(part.rows)
    return float(lat[0]), float(lat[-1])


@pytest.fixture
def globe(moon, dems, tmp_path):
    return mosaic_of(moon, tmp_path, dems.write(tmp_path / "globe.tif", dems.smooth_grid(360)))


@pytest.mark.parametrize("lat_deg", [-75.0, -40.0, 0.0, 60.0, 80.0])
@pytest.mark.parametrize("share", [0.7, 1.0, 2.7])
def test_heights_are_those_of_points(moon, globe, lat_deg, share):
    """At the latitude for which the columns are spaced, all round: the same samples, so rounding
    (1e-6 of heights to 4500 m) and the halving of columns at the edge of two halvings is left.
    """
    posting = share * globe.posting_m
    graticule, row = zone(moon, posting, lat_deg)
    part = Part(row, -5, 1, graticule.columns + 10)
    found = globe.graticule_heights(graticule, part, posting, latitudes_of(graticule, part))
    lat, lon = graticule.lat(part.rows), graticule.lon(part.cols)
    wanted = globe.heights(lat[:, None], lon, posting)
    assert np.abs(found - wanted).max() < 0.5
    assert np.ptp(found) > 500.0


def test_other_latitudes_of_a_zone_keep_the_surface(moon, dems, globe):
    """Footprints keep the zone's longitude there: below 1e-3 of a surface that is smooth."""
    graticule, row = zone(moon, globe.posting_m, 60.0)
    part = Part(row - 8, 100, 17, 60)
    limits = latitudes_of(graticule, part)
    found = globe.graticule_heights(graticule, part, globe.posting_m, limits)
    lat, lon = graticule.lat(part.rows), graticule.lon(part.cols)
    assert np.abs(found - dems.smooth_heights(lat[:, None], lon)).max() < 3.0


@pytest.mark.parametrize("sources", ["one", "two", "east first"])
def test_a_node_s_height_does_not_depend_on_the_part(moon, dems, tmp_path, sources):
    rng = np.random.default_rng(5)
    rough = rng.uniform(-2000.0, 2000.0, (180, 360)).astype(np.float32)
    # "east first": a raster from 0 to 360 degrees, as many lunar ones are
    start = 0.0 if sources == "east first" else -180.0
    whole = dems.write(
        tmp_path / "whole.tif", rough, affine=Affine(1.0, 0.0, start, 0.0, -1.0, 90.0)
    )
    heights, _ = dems.rough_region(60)
    paths = [whole]
    if sources == "two":
        wide = Affine(0.5, 0.0, 170.0, 0.0, -0.5, 30.0)
        paths = [dems.write(tmp_path / "top.tif", heights, affine=wide), whole]
    mosaic = mosaic_of(moon, tmp_path, *paths)
    posting = 30_000.0
    graticule, row = zone(moon, posting, 20.0)
    n = graticule.columns
    band = Part(row - 20, 0, 40, n)
    limits = latitudes_of(graticule, band)
    all_round = mosaic.graticule_heights(graticule, band, posting, limits)
    assert np.isfinite(all_round).all()
    for first, width, top, height in ((-30, 60, 3, 20), (n - 7, 9, 0, 40), (5, 1, 39, 1),
                                      (n // 2 - 9, 40, 7, 9), (-n, 33, 1, 30)):  # fmt: skip
        part = Part(band.row + top, first, height, width)
        found = mosaic.graticule_heights(graticule, part, posting, limits)
        wanted = all_round[top : top + height, np.mod(part.cols, n)]
        assert found.tobytes() == np.ascontiguousarray(wanted).tobytes()


def test_beside_a_raster_and_in_its_holes_there_are_no_heights(moon, dems, tmp_path):
    heights, affine = dems.rough_region(200)
    heights[100:104, 100:104] = -9999.0
    mosaic = mosaic_of(
        moon, tmp_path, dems.write(tmp_path / "r.tif", heights, affine=affine, nodata=-9999.0)
    )
    graticule, row = zone(moon, mosaic.posting_m, 10.0)
    middle = round((np.radians(20.0) + np.pi) / graticule.column_angle)
    part = Part(row - 110, middle - 110, 220, 220)
    found = mosaic.graticule_heights(
        graticule, part, mosaic.posting_m, latitudes_of(graticule, part)
    )
    known = np.isfinite(found)
    assert not known[:8].any()
    assert not known[:, :8].any()
    assert known[15:90, 15:200].all()
    assert not known[106:112, 106:112].all()
    far = Part(row + 2000, middle, 5, 5)
    beyond = mosaic.graticule_heights(
        graticule, far, mosaic.posting_m, latitudes_of(graticule, far)
    )
    assert np.isnan(beyond).all()
