"""Rendered grids against GDAL, against normals made from points in space, and in the limits."""

import subprocess

import numpy as np
import pytest
import rasterio

from catalog.config import resource
from catalog.correlation.filters import filter_high_pass
from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.photometry.laws import LAWS as NAMES
from catalog.photometry.laws import LUNAR_HAPKE, NORMAL_ALBEDO, find_law
from catalog.rendering.hapke_table import SMALL_TABLE_SIZE, TABLE_SIZE
from catalog.rendering.map_view import render_levels, render_map, render_map_near
from catalog.rendering.shading import NEAR, TABLE, Lighting
from catalog.rendering.shadow import NO_FIELD, NO_TABLE, compute_illumination, map_grid
from catalog.rendering.swept import Sweep, sweep_grid
from tests.bench import hillshade

MOON_M = 1_737_400.0
POSTING_M = 118.45
LAWS = [pytest.param(find_law(name), id=name) for name in NAMES]


def sun(elevation_deg, azimuth_deg):
    el, az = np.radians([elevation_deg, azimuth_deg])
    return np.array([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)])


@pytest.fixture(scope="module")
def tycho():
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as dataset:
        window = rasterio.windows.Window(1300, 900, 320, 320)
        return dataset.read(1, window=window).astype(np.float32)


def normals_from_points(heights, posting, radius):
    """Unit normals of the inner nodes from the places of their neighbours in space."""
    x, y = make_node_grid(heights.shape[0], posting)
    place = Stereographic(0.3, 1.0, radius)
    points = place.points(x, y, heights.astype(np.float64)) @ place.body_from_local
    east = points[1:-1, 2:] - points[1:-1, :-2]
    north = points[:-2, 1:-1] - points[2:, 1:-1]
    normal = np.cross(east, north)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True), points[1:-1, 1:-1]


@pytest.mark.parametrize(
    ("radius", "posting"), [(MOON_M, POSTING_M), (MOON_M, 1900.0), (60e3, 50.0)]
)
def test_shading_over_the_curved_body_follows_normals_made_in_space(tycho, radius, posting):
    heights = tycho[:128, :128] * np.float32(posting / POSTING_M / 4)
    normal, _ = normals_from_points(heights, posting, radius)
    direction = sun(30.0, 200.0)
    expected = np.clip(normal @ direction, 0.0, None)
    lambert = render_map(
        heights, posting, direction, radius_m=radius, law=find_law("lambert"), outer=None
    )
    lambert /= np.float32(NORMAL_ALBEDO)
    # (h/R)^2 is left out of the stretch; the small body has h/R of some 1e-2
    np.testing.assert_allclose(lambert[1:-1, 1:-1], expected, atol=2e-4)


def test_a_near_camera_sees_each_node_along_its_own_line(tycho):
    heights = tycho[:96, :96]
    camera = np.array([9e3, -4e3, 15e3])
    direction = sun(40.0, 100.0)
    normal, points = normals_from_points(heights, POSTING_M, MOON_M)
    to_camera = camera + [0.0, 0.0, MOON_M] - points
    to_camera /= np.linalg.norm(to_camera, axis=-1, keepdims=True)
    expected = LUNAR_HAPKE(normal @ direction, (normal * to_camera).sum(-1), to_camera @ direction)
    got = render_map(
        heights, POSTING_M, direction, radius_m=MOON_M, camera_local=camera, outer=None
    )
    np.testing.assert_allclose(got[1:-1, 1:-1], expected, atol=2e-5)


@pytest.mark.parametrize("law", LAWS)
def test_a_camera_far_away_sees_as_a_direction_does(tycho, law):
    heights = tycho[:64, :64]
    view = sun(50.0, 10.0)
    options = {"radius_m": MOON_M, "law": law}
    far = render_map(heights, POSTING_M, sun(25, 80), camera_local=view * 1e12, **options)
    parallel = render_map(heights, POSTING_M, sun(25, 80), view_local=view, **options)
    np.testing.assert_allclose(far, parallel, atol=2e-7)


@pytest.mark.parametrize("azimuth", [30.0, 135.0, 250.0, 340.0])
def test_lambert_on_a_flat_body_is_gdals_hillshade(tycho, tmp_path, azimuth):
    """gdaldem writes 1 + 254 cos i, rounded; Zevenbergen-Thorne slopes are central differences."""
    path, shaded = tmp_path / "dem.tif", tmp_path / "shade.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=320, height=320, count=1, dtype="float32",
        crs="EPSG:32633", transform=rasterio.Affine(POSTING_M, 0, 5e5, 0, -POSTING_M, 5e6),
    ) as dataset:  # fmt: skip
        dataset.write(tycho, 1)
    options = ["-alg", "ZevenbergenThorne", "-az", str(azimuth), "-alt", "35"]
    subprocess.run(hillshade.command(path, shaded, *options), check=True)
    with rasterio.open(shaded) as dataset:
        gdal = dataset.read(1).astype(float)[1:-1, 1:-1]
    ours = render_map(
        tycho,
        POSTING_M,
        sun(35.0, azimuth),
        radius_m=1e12,
        law=find_law("lambert"),
        outer=None,
    )[1:-1, 1:-1]
    assert np.abs(1.0 + 254.0 / NORMAL_ALBEDO * ours - gdal).max() < 1.01


@pytest.mark.parametrize(
    ("size", "factor", "view_elevation"),
    [(TABLE_SIZE, 1.0, 90), (TABLE_SIZE, 1.0, 65), (TABLE_SIZE, 1.0, 35)]
    + [(SMALL_TABLE_SIZE, 4.0, 90), (SMALL_TABLE_SIZE, 4.0, 65)],
)
@pytest.mark.parametrize("sun_elevation", [3, 15, 45, 80])
def test_the_slope_table_is_as_good_as_hapke_node_by_node(
    tycho, sun_elevation, view_elevation, size, factor
):
    """Bound: 0.1 % of the contrast rms, 0.001 in radiance factor anywhere (at grazing views).

    Four times as much for the table of small grids: a tenth of an 8-bit count.
    """
    towards, view = sun(sun_elevation, 70.0), sun(view_elevation, 200.0)
    grid = map_grid(tycho, POSTING_M, MOON_M)
    light = Lighting(TABLE, towards, view, 1.0, LUNAR_HAPKE, NO_FIELD.limits)
    exact = compute_illumination(grid, light, None, 10 * size)  # too large a table for so few nodes
    read = compute_illumination(grid, light, None, size)
    error = read - exact
    assert np.sqrt((error**2).mean()) < factor * 1e-3 * exact.std()
    assert np.abs(error).max() < factor * 1e-3


def test_a_table_filled_for_one_ground_serves_another(tycho):
    towards, view = sun(25.0, 70.0), sun(80.0, 200.0)
    table = np.full((SMALL_TABLE_SIZE, SMALL_TABLE_SIZE), np.nan, np.float32)
    sweep = Sweep(False, False, False, casts=False, shear=0.0, climb=0.0)

    def shaded(heights, table):
        law = LUNAR_HAPKE
        grid = map_grid(heights, POSTING_M, MOON_M)
        return sweep_grid(grid, sweep, NO_FIELD, Lighting(TABLE, towards, view, 1.0, law, table))

    gentle = shaded((0.05 * tycho).astype(np.float32), table)
    assert 0 < np.isfinite(table).sum() < 0.2 * table.size
    fresh = np.full_like(table, np.nan)
    np.testing.assert_array_equal(shaded(tycho, table), shaded(tycho, fresh))
    full = shaded((0.05 * tycho).astype(np.float32), fresh)
    np.testing.assert_array_equal(full, gentle)


@pytest.mark.parametrize("azimuth_deg", [20.0, 110.0, 200.0, 290.0])
def test_levels_rendered_at_once_are_those_rendered_one_by_one(tycho, azimuth_deg):
    """Each under all coarser ones; the fields serve other grids about the same centre."""
    towards = sun(12.0, azimuth_deg)
    grids = [(tycho[::step, ::step][:80, :80].copy(), step * POSTING_M) for step in (1, 2, 4)]
    given = {"radius_m": MOON_M, "law": find_law("lommel_seeliger")}
    pictures, fields = render_levels(grids, 2, towards, **given)
    for k, picture in enumerate(pictures):
        alone = render_map(*grids[k], towards, outer=grids[k + 1 :], **given)
        np.testing.assert_array_equal(picture, alone)
    seen = render_map(*grids[0], towards, radius_m=MOON_M, outer=fields[0])
    np.testing.assert_array_equal(
        seen, render_map(*grids[0], towards, radius_m=MOON_M, outer=grids[1:])
    )
    overhead, _ = render_levels(grids, 1, (0.0, 0.0, 1.0), **given)
    alone = render_map(*grids[0], (0.0, 0.0, 1.0), outer=grids[1:], **given)
    np.testing.assert_array_equal(overhead[0], alone)
    with pytest.raises(ValueError, match="one by one"):
        render_levels(grids, 2, towards, radius_m=MOON_M, law=LUNAR_HAPKE)


def test_slopes_facing_the_sun_are_the_brighter_ones():
    ramp = np.tile(np.linspace(0.0, 900.0, 31, dtype=np.float32), (31, 1))  # rises to the east
    for law in map(find_law, NAMES):
        from_west = render_map(ramp, 100.0, sun(30, 270), radius_m=MOON_M, law=law)[15, 15]
        from_east = render_map(ramp, 100.0, sun(30, 90), radius_m=MOON_M, law=law)[15, 15]
        from_north = render_map(ramp.T[::-1], 100.0, sun(30, 180), radius_m=MOON_M, law=law)[15, 15]
        assert from_west > from_east
        assert from_north == pytest.approx(from_west, rel=1e-3)


@pytest.mark.parametrize("law", LAWS)
def test_shadow_is_black_and_holes_stay_holes(tycho, law):
    heights = tycho[:80, :80].copy()
    heights[30:33, 40] = np.nan
    picture = render_map(heights, POSTING_M, sun(6, 90), radius_m=MOON_M, law=law)
    assert np.isnan(picture[30:33, 40]).all()
    assert np.isfinite(np.delete(picture.ravel(), [r * 80 + 40 for r in (30, 31, 32)])).all()
    lit = render_map(heights, POSTING_M, sun(6, 90), radius_m=MOON_M, law=law, outer=None)
    dark = (picture == 0.0) & (lit > 0.0)
    assert dark.sum() > 20
    np.testing.assert_array_equal(picture[picture > 0.0], lit[picture > 0.0])


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("nodes", [2, 63, 130])
def test_sweeps_along_rows_and_along_columns_make_the_same_picture(tycho, law, nodes):
    """The ground mirrored about its diagonal, under the Sun mirrored, in the same bytes.

    One of the two is swept in strips of columns that are turned into rows.
    """
    heights = tycho[150 : 150 + nodes, 90 : 90 + nodes].copy()
    heights[nodes // 2, nodes // 3 : nodes // 2] = np.nan
    for azimuth in (20.0, 110.0, 200.0, 290.0):
        east, north, up = sun(8.0, azimuth)
        one = render_map(heights, POSTING_M, (east, north, up), radius_m=MOON_M, law=law)
        other = render_map(heights.T, POSTING_M, (-north, -east, up), radius_m=MOON_M, law=law)
        assert one.tobytes() == other.T.tobytes()


def test_the_same_call_gives_the_same_bytes(tycho):
    first = render_map(tycho, POSTING_M, sun(20, 20), radius_m=MOON_M)
    assert first.tobytes() == render_map(tycho, POSTING_M, sun(20, 20), radius_m=MOON_M).tobytes()


def test_what_cannot_be_rendered_is_refused(tycho):
    with pytest.raises(ValueError, match="direction"):
        render_map(tycho, POSTING_M, [0.0, 0.0, 0.0], radius_m=MOON_M)
    with pytest.raises(ValueError, match="not both"):
        render_map(
            tycho, POSTING_M, sun(20, 20), radius_m=MOON_M,
            view_local=[0, 0, 1], camera_local=[0, 0, 1e5],
        )  # fmt: skip


@pytest.mark.parametrize("camera_m", [(2e4, 1e4, 1e5), (0.6e5, 0.2e5, 0.4e5), (3e5, -1e5, 1e5)])
def test_the_quick_shading_for_a_near_camera_is_that_of_every_node(tycho, camera_m):
    heights = np.array(tycho[:96, :96], np.float32)
    heights[3:9, 60:70] = np.nan
    sun = np.array([0.6, 0.2, 0.4])
    quick = render_map(
        heights,
        400.0,
        sun,
        radius_m=1737400.0,
        camera_local=camera_m,
        law=find_law("lunar_lambert"),
    )
    law = find_law("lunar_lambert")
    light = Lighting(NEAR, sun / np.linalg.norm(sun), np.array(camera_m), 0.0, law, NO_TABLE)
    exact = compute_illumination(map_grid(heights, 400.0, 1737400.0), light, (), TABLE_SIZE)
    assert np.isnan(exact).any()
    np.testing.assert_allclose(quick, exact, atol=1e-7)


@pytest.mark.parametrize(
    ("camera_m", "most"),
    [((2e4, 1e4, 1e5), 0.05), ((-0.6e5, 0.2e5, 0.4e5), 0.1), ((3e5, -1e5, 1e5), 0.1)],
)
def test_hapkes_law_for_a_near_camera_is_nearly_that_of_every_node(tycho, camera_m, most):
    heights = np.array(tycho[:96, :96], np.float32)
    heights[3:9, 60:70] = np.nan
    towards, camera = np.array([0.6, 0.2, 0.4]), np.array(camera_m)
    quick = render_map_near(heights, 400.0, towards, camera, radius_m=MOON_M)
    exact, simple = (
        render_map(heights, 400.0, towards, radius_m=MOON_M, camera_local=camera, law=law)
        for law in (LUNAR_HAPKE, find_law("lunar_lambert"))
    )
    np.testing.assert_array_equal(np.isnan(quick), np.isnan(exact))
    np.testing.assert_array_equal(quick == 0.0, exact == 0.0)
    wanted = filter_high_pass(exact)

    def off(grid):
        """What a pattern leaves over, at the best contrast."""
        pattern = filter_high_pass(grid)
        contrast = (wanted * pattern).sum() / (pattern * pattern).sum()
        return np.std(contrast * pattern - wanted) / np.std(wanted)

    assert off(quick) < most
    assert off(simple) > 1.5 * off(quick)
