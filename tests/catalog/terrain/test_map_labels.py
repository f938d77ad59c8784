"""What labels of maps say beside their projection: directions, units, constants, datum."""

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import Affine

from catalog.errors import DataError
from catalog.terrain.dem.georeference import orient_eastward
from catalog.terrain.dem.label import KEYWORDS
from catalog.terrain.dem.source import DemSettings, DemSource
from tests.catalog.terrain.maps import isis_cube, pds3_map, pds4_map

SIZE = 64
LAT, LON = np.radians([5.0, -7.0, 12.0]), np.radians([-95.0, -80.0, -102.0])


@pytest.fixture
def ground(dems):
    rough, _ = dems.rough_region(SIZE)
    return np.rint(rough).astype(np.int16)


def opened(path, moon, **settings):
    return DemSource.open(DemSettings(path.name, **settings), path.parent, moon)


def heights(path, moon, **settings):
    """Heights of places about 90 W."""
    found = opened(path, moon, **settings).heights_at(LAT, LON)
    assert np.isfinite(found).all()
    return found


@pytest.mark.parametrize(
    "projection", ["SimpleCylindrical", "Sinusoidal", "Orthographic", "Mercator"]
)
def test_an_isis_map_of_west_longitudes_shows_the_ground_of_one_of_east(
    tmp_path, moon, ground, projection
):
    common = {"ProjectionName": projection, "CenterLatitude": "0.0"}
    east = isis_cube(tmp_path / "east.cub", ground, CenterLongitude="270.0", **common)
    west = isis_cube(
        *(tmp_path / "west.cub", ground),
        **{"CenterLongitude": "90.0", "LongitudeDirection": "PositiveWest", **common},
    )
    np.testing.assert_array_equal(heights(west, moon), heights(east, moon))
    with pytest.raises(AssertionError):
        heights(west, moon, longitude="east")  # the setting wins


def test_a_pds3_map_of_west_longitudes_shows_the_ground_of_one_of_east(tmp_path, moon, ground):
    east = pds3_map(tmp_path / "EAST.LBL", ground, CENTER_LONGITUDE="270 <deg>")
    west = pds3_map(
        *(tmp_path / "WEST.LBL", ground),
        **{"CENTER_LONGITUDE": "90 <deg>", "POSITIVE_LONGITUDE_DIRECTION": '"WEST"'},
    )
    np.testing.assert_array_equal(heights(west, moon), heights(east, moon))


def test_a_pds4_map_of_west_longitudes_shows_the_ground_of_one_of_east(tmp_path, moon, ground):
    east = pds4_map(tmp_path / "east.xml", ground, centre=270)
    west = pds4_map(tmp_path / "west.xml", ground, centre=90, direction="Positive West")
    np.testing.assert_array_equal(heights(west, moon), heights(east, moon))


def test_a_pds4_map_that_stores_its_southern_line_first_is_turned(tmp_path, moon, ground):
    right = pds4_map(tmp_path / "down.xml", ground, centre=270)
    turned = pds4_map(tmp_path / "up.xml", ground[::-1], centre=270, down="Bottom to Top")
    np.testing.assert_array_equal(heights(turned, moon), heights(right, moon))


def test_west_of_a_projected_map_is_its_central_meridian(tmp_path, dems, moon, ground):
    """Its picture has east on the right, as that of a cube made a GeoTIFF."""
    step = 40000.0
    affine = Affine(step, 0.0, -step * SIZE / 2.0, 0.0, -step, step * SIZE / 2.0)
    east, west = (
        dems.write(
            *(tmp_path / f"{lon}.tif", ground),
            crs=f"+proj=eqc +lon_0={lon} +R=1737400 +units=m",
            affine=affine,
        )
        for lon in (270, 90)
    )
    np.testing.assert_array_equal(heights(west, moon, longitude="west"), heights(east, moon))


def test_west_of_a_map_in_degrees_is_its_x_either_way(tmp_path, dems, moon, ground):
    """Columns that run westward, and such that run eastward with falling longitudes."""
    east = dems.write(tmp_path / "e.tif", ground, affine=Affine(1, 0, -122, 0, -1, 32))
    mirrored = dems.write(
        tmp_path / "m.tif", ground[:, ::-1].copy(), affine=Affine(1, 0, 58, 0, -1, 32)
    )
    falling = dems.write(tmp_path / "f.tif", ground, affine=Affine(-1, 0, 122, 0, -1, 32))
    expected = heights(east, moon)
    for path in (mirrored, falling):
        np.testing.assert_allclose(heights(path, moon, longitude="west"), expected, atol=1e-3)


def test_a_prime_meridian_of_a_system_is_added(tmp_path, dems, moon, ground):
    right = dems.write(tmp_path / "right.tif", ground, affine=Affine(1, 0, -122, 0, -1, 32))
    meridian = dems.write(
        *(tmp_path / "pm.tif", ground),
        crs="+proj=longlat +R=1737400 +pm=-100 +no_defs",
        affine=Affine(1, 0, -22, 0, -1, 32),
    )
    np.testing.assert_allclose(heights(meridian, moon), heights(right, moon), atol=1e-3)


def test_axes_that_count_westward_are_turned():
    """IAU codes of planetographic systems: the longitude of 100 on such an axis is 260 E."""
    crs = pyproj.CRS("IAU_2015:19901")
    wkt, steps, sign = orient_eastward(crs.to_wkt(), (1.0, 0.0, 90.0, 0.0, -1.0, 10.0), False)
    assert (sign, steps[2]) == (-1.0, 90.0)
    assert {axis.direction for axis in pyproj.CRS(wkt).axis_info} == {"north", "east"}
    with pytest.raises(ValueError, match="counts westward"):
        orient_eastward(
            pyproj.CRS("IAU_2015:19911").to_wkt(), (1.0, 0.0, 0.0, 0.0, -1.0, 0.0), False
        )


@pytest.mark.parametrize(
    ("vertical", "words"),
    [
        (
            'VERT_CS["Moon geoid height",VERT_DATUM["x",2005],UNIT["metre",1],AXIS["Up",UP]]',
            "geoid",
        ),
        ('VERT_CS["depth",VERT_DATUM["x",2005],UNIT["metre",1],AXIS["Down",DOWN]]', "depths"),
    ],
)
def test_heights_that_count_otherwise_are_refused(vertical, words):
    flat = pyproj.CRS("+proj=longlat +R=1737400 +no_defs").to_wkt("WKT1_GDAL")
    compound = f'COMPD_CS["both",{flat},{vertical}]'
    with pytest.raises(ValueError, match=words):
        orient_eastward(compound, (1.0, 0.0, 0.0, 0.0, -1.0, 0.0), False)


@pytest.mark.parametrize("radius_m", [1737400.0, 1738000.0, 1735000.0])
def test_heights_above_another_sphere_are_brought_to_the_body(
    tmp_path, dems, moon, ground, caplog, radius_m
):
    path = dems.write(
        *(tmp_path / "sphere.tif", ground),
        crs=f"+proj=longlat +R={radius_m} +no_defs",
        affine=Affine(1, 0, -122, 0, -1, 32),
    )
    source = opened(path, moon)
    expected = ground + np.float32(radius_m - 1737400.0)
    np.testing.assert_array_equal(source.read_window(0, 0, SIZE, SIZE), expected)
    told = [record.message for record in caplog.records]
    assert len(told) == (radius_m != 1737400.0)
    opened(path, moon)  # reported once a file
    assert len(caplog.records) == len(told)
    assert all(f"{radius_m - 1737400.0:+g} m bring them" in words for words in told)
    # an offset that is stated says what heights count from
    stated = opened(path, moon, offset=0.0)
    np.testing.assert_array_equal(stated.read_window(0, 0, SIZE, SIZE), ground)


def test_radii_need_no_sphere(tmp_path, dems, moon, ground):
    path = dems.write(
        *(tmp_path / "radii.tif", ground + np.float64(1737400.0)),
        crs="+proj=longlat +R=1738000 +no_defs",
        affine=Affine(1, 0, -122, 0, -1, 32),
    )
    np.testing.assert_array_equal(opened(path, moon).read_window(0, 0, SIZE, SIZE), ground)


def test_heights_above_a_sphere_far_from_the_body_are_refused(tmp_path, dems, moon, ground):
    path = dems.write(
        *(tmp_path / "far.tif", ground),
        crs="+proj=longlat +R=1727000 +no_defs",
        affine=Affine(1, 0, -122, 0, -1, 32),
    )
    with pytest.raises(DataError, match=r"1727 km.*difference of at most 8687 m.*state `offset`"):
        opened(path, moon)


def test_planetographic_latitudes_on_a_flattened_body_are_refused(tmp_path, moon, ground):
    flat = {"LatitudeType": "Planetographic", "PolarRadius": "1730000.0 <meters>"}
    paths = (
        isis_cube(tmp_path / "flat.cub", ground, **flat),
        pds3_map(
            *(tmp_path / "FLAT.LBL", ground),
            **{"C_AXIS_RADIUS": "1730.0 <km>", "COORDINATE_SYSTEM_NAME": "PLANETOGRAPHIC"},
        ),
        pds4_map(tmp_path / "flat.xml", ground, latitudes="Planetographic", polar=1730.0),
    )
    for path in paths:
        with pytest.raises(DataError, match=r"(?i)planetographic, on radii of 1737.4 and 1730 km"):
            opened(path, moon)
    # on a sphere they are planetocentric
    isis_cube(paths[0], ground, LatitudeType="Planetographic")
    opened(paths[0], moon)


def test_heights_above_a_flattened_ellipsoid_are_refused_and_radii_taken(tmp_path, moon, ground):
    flat = {"PolarRadius": "1730000.0 <meters>"}
    path = isis_cube(tmp_path / "flat.cub", ground, **flat)
    with pytest.raises(DataError, match=r'ellipsoid of 1737.4 and 1730 km.*heights = "radius"'):
        opened(path, moon)
    radii = isis_cube(tmp_path / "radii.cub", ground, base=1737400.0, **flat)
    np.testing.assert_array_equal(opened(radii, moon).read_window(0, 0, SIZE, SIZE), ground)


@pytest.mark.parametrize(
    ("unit", "factor"), [("METER", 1.0), ("KILOMETER", 1000.0), ("'N/A'", 1.0), ("KM", 1000.0)]
)
def test_the_unit_of_a_pds3_image_is_used(tmp_path, moon, ground, unit, factor):
    image = {"UNIT": unit, "SCALING_FACTOR": 1.0 / factor}
    path = pds3_map(tmp_path / "UNIT.LBL", ground, image)
    np.testing.assert_allclose(opened(path, moon).read_window(0, 0, SIZE, SIZE), ground, atol=1e-3)


def test_a_foreign_unit_of_a_label_is_refused(tmp_path, moon, ground):
    with pytest.raises(DataError, match="its values are in 'DEGREE'"):
        opened(pds3_map(tmp_path / "UNIT.LBL", ground, {"UNIT": "DEGREE"}), moon)


@pytest.mark.parametrize(
    ("keyword", "text", "stored"),
    [
        ("MISSING_CONSTANT", "-9999", -9999),
        ("INVALID_CONSTANT", "16#8001#", -32767),
        ("MISSING_CONSTANT", "16#8001#", -32767),
        ("SATURATED_CONSTANT", "32767", 32767),
        ("HIGH_INSTR_SATURATION", "'32766'", 32766),
        ("VALID_MINIMUM", "-8000", -8001),
        ("VALID_MAXIMUM", "8000", 8001),
    ],
)
def test_constants_of_a_label_are_no_heights(tmp_path, moon, ground, keyword, text, stored):
    """Of PDS3 and of PDS4; the stored value is marked, whatever the offset."""
    values = ground.copy()
    values[10:14, 10:20] = stored
    expected = ground.astype(np.float32)
    expected[10:14, 10:20] = np.nan
    name = keyword.lower()
    plain = text.strip("'").replace("16#8001#", "0x8001")
    paths = [
        (pds3_map(tmp_path / "A.LBL", values, {keyword: text, "OFFSET": 100.0}), 100.0),
        (pds4_map(tmp_path / "a.xml", values, f"<{name}>{plain}</{name}>"), 0.0),
    ]
    for path, offset in paths:
        found = opened(path, moon).read_window(0, 0, SIZE, SIZE)
        np.testing.assert_array_equal(found, expected + np.float32(offset))


def test_a_constant_that_is_no_number_is_refused(tmp_path, moon, ground):
    path = pds3_map(tmp_path / "A.LBL", ground, {"INVALID_CONSTANT": '"-INF!"'})
    with pytest.raises(DataError, match=r"states IMAGE.INVALID_CONSTANT = -INF!; wanted a number"):
        opened(path, moon)


REFUSED = [name for name, entry in KEYWORDS.items() if entry.fate == "refused"]


@pytest.mark.parametrize("name", [name for name in REFUSED if not name.startswith("MAP.")])
def test_a_refused_keyword_is_named_with_its_value(tmp_path, moon, ground, name):
    group, _, keyword = name.rpartition(".")
    if group == "Mapping":
        path = isis_cube(tmp_path / "a.cub", ground, **{keyword: "90.0"})
    elif group == "Display_Direction":
        path = pds4_map(tmp_path / "a.xml", ground, across="Right to Left")
    elif group == "IMAGE":
        path = pds3_map(tmp_path / "A.LBL", ground, {keyword: "UP"})
    else:
        path = pds3_map(tmp_path / "A.LBL", ground, **{keyword: "INERTIAL"})
    with pytest.raises(DataError, match=f"states {name} = "):
        opened(path, moon)


@pytest.mark.parametrize("kind", ["Area", "Point"])
def test_a_map_of_points_is_shifted_by_half_a_pixel(tmp_path, dems, moon, ground, kind):
    """GeoTIFF: the tie point of RasterPixelIsPoint is the middle of the first pixel."""
    path = tmp_path / f"{kind}.tif"
    profile = {"driver": "GTiff", "height": SIZE, "width": SIZE, "count": 1, "dtype": "int16"}
    affine = Affine(1, 0, -122, 0, -1, 32)
    with rasterio.open(
        path, "w", crs=f"+proj=longlat {dems.sphere}", transform=affine, **profile
    ) as f:
        f.update_tags(AREA_OR_POINT=kind)
        f.write(ground, 1)
    col, row = opened(path, moon).pixel_from_latlon(np.radians(31.5), np.radians(-121.5))
    assert (float(col), float(row)) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_unit_tag_of_a_geotiff_is_used(tmp_path, dems, moon, ground):
    path = dems.write(tmp_path / "km.tif", (ground / 1000.0).astype(np.float32))
    with rasterio.open(path, "r+") as file:
        file.units = ("km",)
    np.testing.assert_allclose(opened(path, moon).read_window(0, 0, SIZE, SIZE), ground, rtol=1e-6)
