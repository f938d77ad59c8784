"""Seams between terrain models: steps of a hard edge, slopes of a feathered one, who is named."""

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import Resampling, reproject
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from catalog.geometry.latlon import xyz_from_latlon
from catalog.geometry.projection import Stereographic
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.sampling.map_nodes import locate_points

BIAS_M = 60.0


def layered(moon, folder, upper, lower, feather_km) -> Mosaic:
    return Mosaic.from_files(
        [
            DemSettings(path=str(upper), priority=1, feather_km=feather_km),
            DemSettings(path=str(lower), priority=2),
        ],
        folder,
        moon,
        folder / f"overviews-{feather_km}",
    )


def alone(moon, folder, path) -> Mosaic:
    return Mosaic.from_files([DemSettings(path=str(path))], folder, moon, folder / "alone")


@pytest.fixture
def plain(tmp_path, dems, moon):
    """A smooth globe and a region 60 m above it with a hole, 0.02° pixels about 10 N 20 E."""
    globe = dems.write(tmp_path / "globe.tif", dems.smooth_grid(720).astype(np.float32))
    _, affine = dems.rough_region(400)
    lat = np.radians(affine.f + affine.e * (np.arange(400) + 0.5))
    lon = np.radians(affine.c + affine.a * (np.arange(400) + 0.5))
    values = (dems.smooth_heights(lat[:, None], lon[None, :]) + BIAS_M).astype(np.float32)
    values[200, 200] = np.nan
    return dems.write(tmp_path / "region.tif", values, affine=affine), globe, values


def test_a_feathered_source_counts_by_its_distance_from_edge_and_holes(tmp_path, moon, plain):
    """Against SciPy's distance transform of the pixels; blocks of 8 pixels are the resolution.

    A degree of longitude at 10 N is 0.985 of one of latitude; 4 km of slack hold two blocks.
    """
    region, globe, values = plain
    mosaic = layered(moon, tmp_path, region, globe, 30.0)
    lower = alone(moon, tmp_path, globe)
    source = mosaic.pyramids[0].source
    rng = np.random.default_rng(1)
    row, col = rng.uniform(3, 396, 4000), rng.uniform(3, 396, 4000)
    lat, lon = source.georeference.latlon_from_pixel(col, row)
    share = (mosaic.heights(lat, lon, 700.0) - lower.heights(lat, lon, 700.0)) / BIAS_M
    pixel_km = source.posting_m / 1e3
    room = np.pad(np.isfinite(values), 1)
    distance = distance_transform_edt(room, sampling=(pixel_km, pixel_km * np.cos(np.radians(10))))
    km = distance[1:-1, 1:-1][np.rint(row).astype(int), np.rint(col).astype(int)]
    block = 8 * pixel_km
    # never more than the distance says, and no less than two blocks of it
    assert (share <= np.clip(km / 30.0, 0.0, 1.0) + 0.05).all()
    assert (share >= np.clip((km - 3.0 * block) / 30.0, 0.0, 1.0) - 0.05).all()
    assert (share[km > 30.0 + 3.0 * block] > 0.95).all()
    assert np.count_nonzero(km > 30.0 + 3.0 * block) > 100


@pytest.mark.parametrize("feather_km", [0.0, 3.0, 30.0])
def test_a_hard_edge_steps_by_the_bias_and_a_feather_slopes_by_bias_over_its_width(
    tmp_path, moon, plain, feather_km
):
    """Along a line of 100 m steps through the western edge, and through a hole of one pixel."""
    region, globe, _ = plain
    mosaic = layered(moon, tmp_path, region, globe, feather_km)
    lower = alone(moon, tmp_path, globe)
    step = np.degrees(100.0 / moon.radius_m)
    for lat_deg, lon_deg in ((9.0, 16.0), (9.99, 20.01)):
        lon = np.radians(lon_deg + step * np.arange(-600, 601))
        lat = np.full(lon.size, np.radians(lat_deg))
        above = mosaic.heights(lat, lon, 600.0) - lower.heights(lat, lon, 600.0)
        steps = np.abs(np.diff(above))
        if feather_km == 0.0:
            assert steps.max() > 0.9 * BIAS_M
        else:
            # a metre: what the two rasters' interpolations differ by
            assert steps.max() < 100.0 / (1e3 * feather_km) * BIAS_M + 1.0
        assert above.min() < 2.0
        assert above.max() > 0.9 * BIAS_M


def test_feathered_heights_do_not_depend_on_where_one_looks_from(tmp_path, moon, plain):
    region, globe, _ = plain
    one, other = (layered(moon, tmp_path, region, globe, 20.0) for _ in range(2))
    lat, lon = np.meshgrid(np.radians(np.linspace(5, 15, 90)), np.radians(np.linspace(15, 25, 90)))
    whole = one.heights(lat, lon, 700.0)
    backward = [other.heights(lat[i], lon[i], 700.0) for i in reversed(range(90))][::-1]
    np.testing.assert_array_equal(whole, np.array(backward))


def test_the_edge_of_the_lower_source_does_not_cut_the_upper(tmp_path, dems, moon, plain):
    """Where nothing lies below, the upper one counts wholly up to its edge."""
    region, _, values = plain
    affine = Affine(0.02, 0.0, 20.0, 0.0, -0.02, 12.0)
    small = dems.write(tmp_path / "small.tif", np.zeros((200, 200), np.float32), affine=affine)
    units = DemSettings(path=str(small), priority=2, units="m")
    upper = DemSettings(path=str(region), feather_km=30.0)
    mosaic = Mosaic.from_files([upper, units], tmp_path, moon, tmp_path / "o")
    row, col = np.arange(20.0, 180.0), np.full(160, 2.0)
    lat, lon = mosaic.pyramids[0].source.georeference.latlon_from_pixel(col, row)
    np.testing.assert_allclose(mosaic.heights(lat, lon, 300.0), values[20:180, 2], atol=0.01)


@pytest.mark.parametrize("reach_deg", [-70.0, -90.0])
def test_distances_are_right_about_a_pole_and_across_180_degrees(tmp_path, dems, moon, reach_deg):
    """A cylindrical upper source with holes at 180° and near the pole, against a tree of points.

    The tree holds every pixel without data in space; blocks add up to a diagonal of uncertainty.
    """
    values = np.random.default_rng(4).normal(0.0, 50.0, (160, 2880)).astype(np.float32)
    affine = Affine(0.125, 0.0, -180.0, 0.0, -0.125, reach_deg + 20.0)
    values[100:103, :2] = np.nan
    values[130, 700] = np.nan
    values[157, 1200:1210] = np.nan
    upper = dems.write(tmp_path / "upper.tif", values, affine=affine)
    globe = dems.write(tmp_path / "globe.tif", dems.smooth_grid(180).astype(np.float32))
    mosaic = layered(moon, tmp_path, upper, globe, 200.0)
    feather = mosaic._get_feather(0)
    place = mosaic.pyramids[0].source.georeference
    rng = np.random.default_rng(5)
    row, col = rng.uniform(0, 159, 3000), rng.uniform(-0.5, 2879.5, 3000)
    lat, lon = place.latlon_from_pixel(col, row)
    weight = feather.weights(locate_points(place, lat, lon))
    holes = np.argwhere(np.isnan(values)).astype(float)
    edge = [(-1.0, c) for c in np.arange(0, 2880, 1.0)]
    if reach_deg != -90.0:
        edge += [(160.0, c) for c in np.arange(0, 2880, 1.0)]
    points = np.vstack([holes, np.array(edge)])
    hole_lat, hole_lon = place.latlon_from_pixel(points[:, 1], points[:, 0])
    tree = cKDTree(xyz_from_latlon(hole_lat, hole_lon, moon.radius_m))
    metres = tree.query(xyz_from_latlon(lat, lon, moon.radius_m))[0]
    block = feather.block_m
    assert (weight <= np.clip(metres / 200e3, 0.0, 1.0) + 0.02).all()
    assert (weight >= np.clip((metres - 3.0 * block) / 200e3, 0.0, 1.0) - 0.02).all()


def test_every_source_of_a_patch_is_named_the_middle_s_first(tmp_path, moon, plain):
    region, globe, _ = plain

    def named(lat_deg, lon_deg, feather_km):
        mosaic = layered(moon, tmp_path, region, globe, feather_km)
        projection = Stereographic(*np.radians([lat_deg, lon_deg]), moon.radius_m)
        return mosaic.provenance(projection, 600.0, 80)

    assert named(12.0, 22.0, 0.0) == "region.tif"
    assert named(12.0, 30.0, 0.0) == "globe.tif"
    assert named(12.0, 16.3, 0.0) == "region.tif + globe.tif"
    assert named(12.0, 15.7, 0.0) == "globe.tif + region.tif"
    # well inside, but the feather reaches there; and less than half of the weight at its edge
    assert named(12.0, 18.0, 60.0) == "region.tif + globe.tif"
    assert named(12.0, 16.3, 60.0) == "globe.tif + region.tif"
    single = alone(moon, tmp_path, region)
    inside, outside = (Stereographic(*np.radians(p), moon.radius_m) for p in ((12, 22), (12, 40)))
    assert single.provenance(inside, 600.0, 80) == "region.tif"
    assert single.provenance(outside, 600.0, 80) == ""


def polar_model(path, globe, dems, posting=400.0, size=760):
    """The south beyond 85° as GDAL reprojects it, 60 m higher, with finer relief; a hole in it."""
    affine = Affine(posting, 0.0, -posting * size / 2, 0.0, -posting, posting * size / 2)
    out = np.full((size, size), np.nan, np.float32)
    crs = f"+proj=stere +lat_0=-90 +lon_0=0 +k=1 {dems.sphere}"
    with rasterio.open(globe) as dataset:
        a, _, _, _, e, f = dataset.transform[:6]
        # from -180°: GDAL looks for places west of 0 nowhere else
        half = dataset.width // 2 if dataset.transform.c >= 0.0 else 0
        west = -a * dataset.width / 2
        reproject(
            np.roll(dataset.read(1), half, axis=1).astype(np.float32),
            out,
            src_transform=Affine(a, 0.0, west, 0.0, e, f),
            src_crs=dataset.crs,
            dst_transform=affine,
            dst_crs=crs,
            dst_nodata=np.nan,
            resampling=Resampling.cubic,
        )
    row, col = np.mgrid[0:size, 0:size]
    out += BIAS_M + 15.0 * np.sin(col * 2.0) * np.sin(row * 2.0)
    out[np.hypot(row - size / 2, col - size / 2) * posting > 150e3] = np.nan
    out[290:302, 290:302] = np.nan
    return dems.write(path, out.astype(np.float32), crs=crs, affine=affine, tiled=True)


@pytest.mark.parametrize("feather_km", [0.0, 20.0])
def test_a_polar_model_lies_on_the_real_moon(shared_data, tmp_path, dems, moon, feather_km):
    """Hard: the bias at once; feathered: nothing at the rim, all of it 20 km further in.

    The polar model is GDAL's; profiles run outward through its rim, 150 km from the pole.
    """
    globe = shared_data("moon/moon_gld100_32ppd.tif")
    top = polar_model(tmp_path / "pole.tif", globe, dems)
    mosaic = layered(moon, tmp_path, top, globe, feather_km)
    lower = alone(moon, tmp_path, globe)
    upper = alone(moon, tmp_path / "u", top)
    lon = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    # radii in the map, m: a sphere's stereographic plane
    radius = np.arange(100e3, 160e3, 400.0)
    lat = 2.0 * np.arctan(radius / (2.0 * moon.radius_m)) - np.pi / 2.0
    lat, lon = np.meshgrid(lat, lon)
    posting = 1000.0
    both, below = mosaic.heights(lat, lon, posting), lower.heights(lat, lon, posting)
    assert np.isfinite(both).all()
    profile = np.mean(both - below, axis=0)  # all round: the ground itself averages out
    steps = np.abs(np.diff(profile))
    assert abs(profile[radius > 152e3]).max() == 0.0
    assert profile[radius < 120e3] == pytest.approx(BIAS_M, abs=4.0)
    if feather_km:
        assert steps.max() < 400.0 / 20e3 * BIAS_M + 1.0
        expected = np.clip((150e3 - radius) / 20e3, 0.0, 1.0) * BIAS_M
        # a block of 3.2 km lies between the rim and where the feather begins
        late = np.clip((150e3 - 2.5 * 3200.0 - radius) / 20e3, 0.0, 1.0) * BIAS_M
        assert (profile <= expected + 4.0).all()
        assert (profile >= late - 4.0).all()
    else:
        assert steps.max() > 0.5 * BIAS_M
    # the model's own heights where it counts wholly, the pole included
    lat = np.radians(np.linspace(-90.0, -88.9, 200))
    inner = mosaic.heights(lat, np.full(200, 2.0), 400.0)
    np.testing.assert_array_equal(inner, upper.heights(lat, np.full(200, 2.0), 400.0))
    # the hole is filled, and patches over the pole, ±180° and the rim are whole
    for place in ((-90.0, 0.0), (-87.0, 180.0), (-85.05, -179.9), (-85.05, 40.0)):
        projection = Stereographic(*np.radians(place), moon.radius_m)
        for level_posting in (400.0, 1600.0):
            assert np.isfinite(mosaic.local_grid(projection, level_posting, 80)).all()
    named = [
        mosaic.provenance(Stereographic(*np.radians(p), moon.radius_m), 200.0, 80)
        for p in ((-90.0, 0.0), (-80.0, 9.0), (-85.05, 40.0))
    ]
    assert named[:2] == ["pole.tif", globe.name]
    assert set(named[2].split(" + ")) == {"pole.tif", globe.name}


def test_a_polar_model_on_a_smooth_globe_is_seamless_but_for_its_bias(tmp_path, dems, moon):
    """The same with made ground, always run; nodes of a patch over the rim, neighbour to neighbour.

    Three metres are left for the relief that the polar model has beyond the globe's.
    """
    globe = dems.write(tmp_path / "globe.tif", dems.smooth_grid(720).astype(np.float32))
    top = polar_model(tmp_path / "pole.tif", globe, dems)
    projection = Stereographic(np.radians(-85.05), np.radians(179.0), moon.radius_m)
    lower = alone(moon, tmp_path, globe).local_grid(projection, 2000.0, 80)
    rough = {}
    for feather_km in (0.0, 40.0):
        mosaic = layered(moon, tmp_path, top, globe, feather_km)
        above = mosaic.local_grid(projection, 2000.0, 80) - lower
        assert np.isfinite(above).all()
        rough[feather_km] = max(np.abs(np.diff(above, axis=axis)).max() for axis in (0, 1))
    assert rough[0.0] > 0.8 * BIAS_M
    assert rough[40.0] < 2000.0 / 40e3 * BIAS_M + 3.0
