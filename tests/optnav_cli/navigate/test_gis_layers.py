"""A run's layers for GIS programs, read back through GDAL and not through our own code."""

import sqlite3
from contextlib import closing
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest

from catalog.config import resource
from catalog.errors import OutputError
from catalog.geometry.latlon import latlon_from_xyz
from catalog.geometry.map_pieces import split_area
from catalog.store.geopackage import (
    UNDATED,
    FeatureLayer,
    describe_geopackage,
    encode_parts,
    format_style,
    open_new_geopackage,
)
from optnav_cli.main import run as optnav
from optnav_cli.navigate.gis_layers import compute_footprint, export_run
from optnav_cli.output.run_folder import read_run
from tests.catalog.geometry.test_map_pieces import inside
from tests.optnav_cli.output.approach import write_approach
from tests.optnav_cli.report.test_footprint import BAR, FISHEYE, MOON, NARROW, WIDE, looking

pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio to read vector layers")

NAMES = ["footprints", "camera_track", "matched_points", "camera_positions"]


def read(path, layer, **how):
    """Columns by name, and geometries as GDAL's well-known binary."""
    meta, _, geometry, fields = pyogrio.raw.read(path, layer=layer, **how)
    return dict(zip(meta["fields"].tolist(), fields)), geometry


def rings(wkb):
    """The outer rings of a multipolygon, or the lines of a multilinestring."""
    code = int.from_bytes(wkb[1:5], "little")
    count, at, parts = int.from_bytes(wkb[5:9], "little"), 9, []
    for _ in range(count):
        at += 5 if code == 5 else 9
        points = int.from_bytes(wkb[at : at + 4], "little")
        parts.append(np.frombuffer(wkb, "<f8", 2 * points, at + 4).reshape(-1, 2))
        at += 4 + 16 * points
    assert at == len(wkb)
    return parts


@pytest.fixture
def made(tmp_path, make_run):
    make_run(tmp_path / "run", count=12, unsolved_from=10)
    path = tmp_path / "run.gpkg"
    counts = export_run(read_run(tmp_path / "run"), path)
    assert counts == dict(zip(NAMES, (10, 1, 120, 12)))
    return tmp_path / "run", path


def test_every_layer_is_on_the_moon_and_has_its_features(made):
    _, path = made
    kinds = ["MultiPolygon", "MultiLineString", "Point", "Point"]
    layers = pyogrio.list_layers(path).tolist()
    assert layers[:4] == [list(pair) for pair in zip(NAMES, kinds)]
    iau = pyproj.CRS.from_user_input("IAU_2015:30100")
    for name, count in zip(NAMES, (10, 1, 120, 12)):
        info = pyogrio.read_info(path, layer=name)
        assert info["features"] == count
        assert pyproj.CRS.from_user_input(info["crs"]).equals(iau, ignore_axis_order=True)


def test_positions_hold_the_solutions_and_unsolved_frames_their_reason(made):
    folder, path = made
    columns, geometry = read(path, "camera_positions")
    for row, solution in enumerate(read_run(folder).solutions):
        assert columns["file"][row] == solution.file
        assert columns["status"][row] == solution.status
        assert columns["reason"][row] == solution.reason
        assert columns["reason_code"][row] == solution.reason_code
        if not solution.solved:
            assert geometry[row] is None
            assert np.isnan(columns["x_m"][row])
            continue
        lat, lon, radius = latlon_from_xyz(solution.position_m)
        place = np.frombuffer(geometry[row][5:21], "<f8")
        np.testing.assert_allclose(place, np.degrees([lon, lat]), atol=1e-12)
        assert columns["height_m"][row] == pytest.approx(radius - 1737400.0)
        # along R 60 m, N and B 20 and 15 m; R of the solution is off that of the truth by 1e-5
        assert columns["sigma_height_m"][row] == pytest.approx(60.0, rel=1e-3)
        assert columns["sigma_horizontal_m"][row] == pytest.approx(25.0, rel=1e-3)
        assert columns["n_used"][row] == 8


def test_footprints_lie_about_the_place_below_a_camera_that_looks_down(made):
    folder, path = made
    columns, geometry = read(path, "footprints")
    places = {s.file: latlon_from_xyz(s.position_m) for s in read_run(folder).solutions if s.solved}
    half = np.degrees(200e3 * 256.0 / 1046.0 / 1737400.0)  # of flat ground
    for file, wkb in zip(columns["file"], geometry):
        lat, lon, _ = places[file]
        place = np.degrees([[lon, lat]])
        parts = rings(wkb)
        assert inside(parts, place).all()
        north = parts[0][:, 1].max() - place[0, 1]
        assert north == pytest.approx(half, rel=0.04)  # the ground falls away


def test_the_track_goes_through_the_positions_and_is_broken_between_passes(made, tmp_path):
    _, path = made
    columns, geometry = read(path, "camera_track")
    (line,) = rings(geometry[0])
    _, points = read(path, "camera_positions")
    solved = [np.frombuffer(wkb[5:21], "<f8") for wkb in points if wkb is not None]
    for place in solved:
        assert np.abs(line - place).max(axis=1).min() < 1e-9
    assert (columns["camera"][0], columns["frames"][0]) == ("unk", 10)
    # the same frames, the later half a day after: two lines
    text = (tmp_path / "run" / "solution.csv").read_text().splitlines()
    late = [line.replace("2023-08-17", "2023-08-18") for line in text[6:]]
    (tmp_path / "run" / "solution.csv").write_text("\n".join(text[:6] + late) + "\n")
    export_run(read_run(tmp_path / "run"), path)
    assert len(rings(read(path, "camera_track")[1][0])) == 2


def test_points_tell_used_ones_apart(made):
    folder, path = made
    columns, geometry = read(path, "matched_points")
    matches = read_run(folder).matches
    assert columns["used"].astype(bool).tolist() == [m.used for m in matches]
    assert columns["point_id"].tolist() == [m.cp_id for m in matches]
    assert np.isnan(columns["residual_x_px"]).sum() == 12  # one of ten was not found
    lat, lon, _ = latlon_from_xyz(np.array([m.cp_position_m for m in matches]))
    places = [np.frombuffer(wkb[5:21], "<f8") for wkb in geometry]
    np.testing.assert_allclose(places, np.degrees(np.column_stack([lon, lat])), atol=1e-12)
    box = (*np.min(places, axis=0), *np.mean(places, axis=0))
    _, near = read(path, "matched_points", bbox=box)
    assert 0 < len(near) < len(places)


def test_every_layer_has_a_style_of_its_own(made):
    _, path = made
    with closing(sqlite3.connect(path)) as db:
        styles = dict(db.execute("SELECT f_table_name, styleQML FROM layer_styles"))
        assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert db.execute("PRAGMA foreign_key_check").fetchall() == []
    assert list(styles) == NAMES
    rules = {name: len(list(ElementTree.fromstring(s).iter("rule"))) for name, s in styles.items()}
    assert rules == dict(zip(NAMES, (1, 1, 2, 2)))


def test_frames_from_afar_and_of_two_cameras_have_whole_discs(tmp_path):
    write_approach(tmp_path / "run")
    counts = export_run(read_run(tmp_path / "run"), tmp_path / "run.gpkg")
    assert (counts["camera_track"], counts["camera_positions"]) == (2, 48)
    columns, geometry = read(tmp_path / "run.gpkg", "footprints")
    far = max(range(len(geometry)), key=lambda row: columns["height_m"][row])
    extent = np.ptp(np.vstack(rings(geometry[far])), axis=0)
    assert extent[1] > 150.0


def assert_valid(path, layer, count):
    """Every area is what OGC calls a valid one, as GEOS judges it through GDAL's SQLite."""
    sql = f"SELECT ST_IsValid(geom) AS valid, ST_IsValidReason(geom) AS why FROM {layer}"
    try:
        _, _, _, (valid, why) = pyogrio.raw.read(path, sql=sql, sql_dialect="SQLITE")
    except pyogrio.errors.DataLayerError:
        pytest.skip("this GDAL has no Spatialite functions")
    assert len(valid) == count
    assert set(zip(valid.tolist(), why.tolist())) == {(1, "Valid Geometry")}


def test_footprints_of_an_approach_are_valid_about_the_pole_and_across_180_degrees(tmp_path):
    write_approach(tmp_path / "run", count=60)
    counts = export_run(read_run(tmp_path / "run"), tmp_path / "run.gpkg")
    assert_valid(tmp_path / "run.gpkg", "footprints", counts["footprints"])


def test_areas_of_any_view_are_valid(tmp_path):
    rng = np.random.default_rng(5)
    features = []
    while len(features) < 250:
        camera = (NARROW, WIDE, BAR, FISHEYE)[rng.integers(4)]
        lat = rng.choice([-1.0, 1.0]) * (90.0 - 10.0 ** rng.uniform(-1.0, 1.95))
        distance = MOON[0] * (1.0 + 10.0 ** rng.uniform(-2.0, 1.5))
        turns = rng.normal(0.0, 30.0), rng.normal(0.0, 30.0), rng.uniform(0.0, 360.0)
        position, turn = looking(lat, rng.uniform(-180.0, 180.0), distance, *turns)
        pieces = [p for r in compute_footprint(camera, position, turn, MOON) for p in split_area(r)]
        geometry = encode_parts("MULTIPOLYGON", pieces, 30100)
        if geometry is not None:
            features.append(((len(features) + 1, geometry), None))
    layer = FeatureLayer("areas", "MULTIPOLYGON", "", (), format_style())
    with open_new_geopackage(tmp_path / "areas.gpkg") as db:
        describe_geopackage(db, "moon", MOON[0], UNDATED)
        layer.create(db)
        layer.register(db, 30100, layer.fill(db, features), UNDATED)
    assert_valid(tmp_path / "areas.gpkg", "areas", 250)


def test_a_body_of_one_s_own_has_its_own_sphere(tmp_path, make_run):
    make_run(tmp_path / "run", count=2)
    text = resource("configs/bodies/moon.toml").read_text()
    own = text.replace('name = "moon"', 'name = "ours"').replace("km = 1737.4 ", "km = 1730.0 ")
    (tmp_path / "run" / "ours.toml").write_text(own)
    (tmp_path / "run" / "run.toml").write_text(
        'body = "ours.toml"\nattitude = "camera_from_body"\n'
    )
    export_run(read_run(tmp_path / "run"), tmp_path / "run.gpkg")
    crs = pyproj.CRS.from_user_input(
        pyogrio.read_info(tmp_path / "run.gpkg", layer="footprints")["crs"]
    )
    assert crs.ellipsoid.semi_major_metre == 1730000.0
    assert "Ours" in crs.name


def test_the_same_run_gives_the_same_bytes_and_nothing_else_is_replaced(made):
    folder, path = made
    first = path.read_bytes()
    export_run(read_run(folder), path)
    assert path.read_bytes() == first
    path.write_bytes(b"somebody's own")
    with pytest.raises(OutputError, match="not made by optnav"):
        export_run(read_run(folder), path)
    with pytest.raises(OutputError, match=r"written as \.gpkg"):
        export_run(read_run(folder), path.with_suffix(".shp"))


def test_the_command_says_what_it_wrote(tmp_path, make_run, capsys):
    make_run(tmp_path / "run", count=3)
    place = tmp_path / "run.gpkg"
    assert optnav(["export", str(tmp_path / "run"), "-o", str(place)]) == 0
    words = "footprints 3, camera_track 1, matched_points 30, camera_positions 3"
    assert capsys.readouterr().out == f"{place}: {words}\n"
    assert optnav(["export", str(tmp_path), "-o", str(place)]) == 3
    assert "optnav navigate" in capsys.readouterr().err


def test_a_run_without_a_position_has_empty_layers(tmp_path, make_run):
    make_run(tmp_path / "run", count=3, unsolved_from=0)
    counts = export_run(read_run(tmp_path / "run"), tmp_path / "run.gpkg")
    assert counts == dict(zip(NAMES, (0, 0, 30, 3)))
    assert len(read(tmp_path / "run.gpkg", "camera_track")[1]) == 0
