"""A run over a spheroid: tables, layers and pages have the geodetic coordinates of pyproj."""

import csv
import shutil

import numpy as np
import pyproj
import pytest

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.errors import ConfigError
from catalog.geometry.latlon import latlon_from_xyz
from catalog.progress import SilentProgress
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.run_settings import FileAttitude
from optnav_cli.navigate.gis_layers import export_run
from optnav_cli.navigate.job import navigate_folder
from optnav_cli.navigate.worker import RunInputs
from optnav_cli.output.run_folder import read_run
from optnav_cli.output.tables import read_solutions, write_solutions
from optnav_cli.report.relief import plot_ground
from tests.optnav_cli.made_picks import rows_of, scene, write_picked
from tests.optnav_cli.rows import solved

EXAMPLE = resource("data/picked_points/run.toml").parent
POINTS = '[points]\nlatitude = "geodetic"\nheight = "ellipsoid"\n'


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    place = tmp_path_factory.mktemp("spheroid") / "run"
    navigate_folder(RunInputs(EXAMPLE), place, SilentProgress())
    return place


def geodetic(xyz):
    """Longitude, latitude, deg, and height, m, over WGS 84."""
    to_map = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    return np.column_stack(to_map.transform(*np.asarray(xyz, np.float64).T))


def test_solutions_have_geodetic_latitude_and_height_over_the_ellipsoid(run):
    with (run / "solution.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        lon, lat, height = geodetic([[float(row[name]) for name in ("x_m", "y_m", "z_m")]])[0]
        assert float(row["lon_deg"]) == pytest.approx(lon, abs=2e-9)
        # PROJ's inverse, one step of Bowring's, is 1.4 mm off at 420 km
        assert float(row["lat_geodetic_deg"]) == pytest.approx(lat, abs=2e-8)
        assert float(row["height_ellipsoid_m"]) == pytest.approx(height, abs=3e-3)
        assert abs(float(row["lat_deg"]) - lat) > 0.15  # up to 21 km on a map


def test_what_was_estimated_of_the_lens_is_written_and_read_back(run):
    body = load_body("earth")
    rows = read_solutions(run / "solution.csv", FileAttitude("camera_from_body", body))
    for row in rows:
        lens = row.evidence.lens
        # the file states 1 % and 20 px, and the example's lens is exact
        assert abs(lens.focal_scale - 1.0) < 3.0 * lens.focal_scale_sigma < 0.03
        assert np.abs(lens.shift_px).max() < 20.0
        assert max(lens.shift_sigma_px) < 20.1


def test_an_exact_lens_has_no_columns_and_its_share_is_said_once(tmp_path, caplog):
    made = scene(3)
    folder = write_picked(tmp_path / "f", made, rows_of(made))
    navigate_folder(RunInputs(folder), tmp_path / "run", SilentProgress())
    assert "focal_scale" not in (tmp_path / "run/solution.csv").read_text()
    said = [text for text in caplog.messages if "0.1%" in text]
    assert len(said) == 1
    away = np.linalg.norm(made.places_m - made.pose.position_m, axis=1).mean()
    assert f"{0.001 * away:.3g} m along the line of sight" in said[0]
    lens = folder / "cameras/tele.toml"
    lens.write_text(lens.read_text() + "focal_length_error = 0.001\n")
    caplog.clear()
    navigate_folder(RunInputs(folder), tmp_path / "other", SilentProgress())
    assert not [text for text in caplog.messages if "0.1%" in text]
    header, row = (tmp_path / "other/solution.csv").read_text().splitlines()
    cells = dict(zip(header.split(","), row.split(","), strict=True))
    assert float(cells["focal_scale"]) == pytest.approx(1.0, abs=0.003)
    assert cells["principal_shift_x_px"] == ""


def test_layers_of_the_earth_lie_in_wgs_84(run, tmp_path):
    pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio to read vector layers")
    path = tmp_path / "run.gpkg"
    export_run(read_run(run), path)
    export_run(read_run(run), path)  # an export of ours is replaced
    found = read_run(run)
    wanted = {
        "camera_positions": geodetic([row.position_m for row in found.solutions]),
        "matched_points": geodetic([match.cp_position_m for match in found.matches]),
    }
    for layer, places in wanted.items():
        meta, _, shapes, fields = pyogrio.raw.read(path, layer=layer)
        assert meta["crs"] == "EPSG:4326"
        points = np.array([np.frombuffer(shape, "<f8", 2, 5) for shape in shapes])
        np.testing.assert_allclose(points, places[:, :2], atol=2e-8)
        if layer == "camera_positions":
            heights = fields[meta["fields"].tolist().index("height_ellipsoid_m")]
            np.testing.assert_allclose(heights, places[:, 2], atol=3e-3)
    west, south, east, north = pyogrio.read_info(path, layer="footprints")["total_bounds"]
    lon, lat, _ = wanted["matched_points"].T
    assert west < lon.min() < lon.max() < east
    # the points reach to 3 % of the picture's side from its border, some 2 km
    assert abs(south - lat.min()) < 0.05
    assert abs(north - lat.max()) < 0.05


def test_layers_of_another_spheroid_have_its_ellipsoid(tmp_path):
    pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio to read vector layers")
    body = load_body("mars")
    place = np.array([2.1e6, 1.4e6, 2.9e6])
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "run.toml").write_text('body = "mars"\nattitude = "camera_from_body"\n')
    row = solved("a.png", "2024-06-01T00:00:00Z", "horizon", place, np.eye(3), None, None)
    write_solutions(folder / "solution.csv", [row], FileAttitude("camera_from_body", body))
    export_run(read_run(folder), tmp_path / "run.gpkg")
    meta, _, (shape,), _ = pyogrio.raw.read(tmp_path / "run.gpkg", layer="camera_positions")
    crs = pyproj.CRS.from_user_input(meta["crs"])
    a, _, c = body.radii_m
    assert (crs.ellipsoid.semi_major_metre, crs.ellipsoid.semi_minor_metre) == pytest.approx((a, c))
    there = pyproj.Transformer.from_crs({"proj": "geocent", "a": a, "b": c}, crs, always_xy=True)
    lon, lat, _ = there.transform(*place)
    np.testing.assert_allclose(np.frombuffer(shape, "<f8", 2, 5), (lon, lat), atol=1e-8)
    assert abs(lat - np.degrees(latlon_from_xyz(place)[0])) > 0.25


def test_the_map_of_a_spheroid_says_what_its_latitudes_are(run, tmp_path, make_run):
    assert "Latitudes are geodetic." in str(plot_ground(read_run(run)))
    make_run(tmp_path / "moon", count=3)
    assert "geodetic" not in str(plot_ground(read_run(tmp_path / "moon")))


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ("", "does not state latitude and height"),
        ('[points]\nlatitude = "geodetic"\n', "does not state height"),
        ('[points]\nheight = "ellipsoid"\n', "does not state latitude"),
    ],
)
def test_points_of_a_flattened_body_without_their_kind_are_refused(tmp_path, stated, words):
    folder = shutil.copytree(EXAMPLE, tmp_path / "f")
    text = (folder / "run.toml").read_text()
    (folder / "run.toml").write_text(text[: text.index("[points]")] + stated)
    with pytest.raises(ConfigError, match=words) as error:
        read_folder(folder)
    assert 'latitude = "geodetic"' in str(error.value)
    assert 'height = "ellipsoid"' in str(error.value)
    (folder / "run.toml").write_text(text[: text.index("[points]")] + POINTS)
    assert read_folder(folder).points


def test_geodetic_points_of_a_body_with_three_axes_are_refused(tmp_path):
    made = scene(3)
    folder = write_picked(tmp_path / "f", made, rows_of(made), more=POINTS)
    assert read_folder(folder).points  # the Moon is a sphere: both are the same
    (folder / "run.toml").write_text(f'body = "vesta"\nattitude = "camera_from_body"\n{POINTS}')
    with pytest.raises(ConfigError, match="radii 289, 280, 229 km"):
        read_folder(folder)
