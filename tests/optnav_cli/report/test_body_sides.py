"""A small body and its points from six sides: where they are, what hides them, what is written."""

import cv2
import numpy as np
import pytest
import trimesh

from catalog.control_point import ControlPoint, Flag, Patch
from catalog.geometry.cells import CellGrid
from catalog.geometry.latlon import xyz_from_latlon
from catalog.store.manifest import CatalogMeta, PlanesMeta
from catalog.store.patches import prepare_point
from catalog.store.reader import Catalog
from catalog.store.relief import prepare_relief
from catalog.store.writer import write_catalog
from catalog.terrain.relief.relief import GlobalRelief
from optnav_cli.main import run
from optnav_cli.report import body_sides
from optnav_cli.report.body_sides import draw_sides, mesh_relief
from optnav_cli.report.views import REASON_COLOURS, USABLE, parse_colour
from tests.optnav_cli.report.pages import a_catalog, report_of

RADII_M = (13000.0, 11400.0, 9100.0)
SPHERE_M = 11000.0
PLACES = ((1.0, 31.0), (-62.0, -100.0), (20.0, 170.0))  # lat, lon, deg
OVERHUNG = 1  # of the places


def ellipsoid_radius(lat, lon):
    """Distance (...) m of an ellipsoid's surface from its centre."""
    x, y, z = np.moveaxis(xyz_from_latlon(lat, lon, 1.0), -1, 0)
    return 1.0 / np.sqrt((x / RADII_M[0]) ** 2 + (y / RADII_M[1]) ** 2 + (z / RADII_M[2]) ** 2)


def an_ellipsoid(rows=90):
    step = np.pi / rows
    lat = np.pi / 2.0 - (np.arange(rows) + 0.5) * step
    lon = -np.pi + (np.arange(2 * rows) + 0.5) * step
    heights = (ellipsoid_radius(lat[:, None], lon[None, :]) - SPHERE_M).astype(np.float32)
    return GlobalRelief(heights, heights, SPHERE_M, "made.obj")


@pytest.fixture
def phobos(tmp_path):
    """A catalog of three points on an ellipsoid, one of them not usable."""
    grid = CellGrid(10.0)
    points = []
    for number, (lat, lon) in enumerate(PLACES):
        bad = number == OVERHUNG
        point = ControlPoint(
            int(grid.find_cells(lat, lon)), lat, lon,
            float(ellipsoid_radius(np.radians(lat), np.radians(lon))),
            0.3, 1.0, 1.0, 5, (0.4,), (5.0,) * 36, not bad,
            Flag.OVERHANG if bad else Flag.NONE, "made.obj",
        )  # fmt: skip
        patch = Patch(48.0, np.zeros((16, 16), np.float32))
        points.append(prepare_point(point, (patch,), (0.1,)))
    meta = CatalogMeta(
        "phobos", SPHERE_M, 10.0, 1, 16, 48.0, 0.1, {"made.obj": "<sha>"}, "[body]\n",
        "optnav 0", "", ("made.obj",), planes=PlanesMeta(RADII_M, 380.0),
    )  # fmt: skip
    points.sort(key=lambda prepared: int(prepared.point.id))
    write_catalog(tmp_path / "phobos.gpkg", meta, points, relief=prepare_relief(an_ellipsoid()))
    return tmp_path / "phobos.gpkg"


def test_the_relief_as_a_mesh_is_closed_and_as_large_as_the_ellipsoid():
    corners = mesh_relief(an_ellipsoid())
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    mesh.merge_vertices(digits_vertex=3)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi * np.prod(RADII_M), rel=2e-3)


def test_points_are_where_the_viewer_has_them_and_hidden_behind_the_body(phobos):
    with Catalog.open(phobos) as catalog:
        views = {side.name[:2]: side for side in draw_sides(catalog, 60)}
        row = int(np.flatnonzero(np.isclose(catalog.lon_deg, 31.0))[0])
    lat, lon = np.radians(PLACES[0])
    x, y, z = xyz_from_latlon(lat, lon, ellipsoid_radius(lat, lon))
    # east is to the right, north or what the side's name says is up
    wanted = {"+x": (y, z), "+y": (-x, z), "+z": (y, -x)}
    for name, place in wanted.items():
        assert views[name].places[row] == pytest.approx(place, abs=2.0)
    for name in ("-x", "-y"):
        assert np.isnan(views[name].places[row]).all()


def test_each_side_is_as_wide_and_high_as_the_ellipsoid(phobos):
    with Catalog.open(phobos) as catalog:
        views = draw_sides(catalog, 150)
    along = {"x": 0, "y": 1, "z": 2}
    for side in views:
        pixel = 2.0 * side.half_m / 150
        seen = side.gray > 0
        across, up = {"x": "yz", "y": "xz", "z": "yx"}[side.name[1]]
        for axis, extent in ((across, seen.any(axis=0).sum()), (up, seen.any(axis=1).sum())):
            assert extent * pixel == pytest.approx(2.0 * RADII_M[along[axis]], abs=2.5 * pixel)
        # the Sun stands at the upper left
        middle = len(side.gray) // 2
        assert side.gray[middle - 35, middle - 35] > 1.3 * side.gray[middle + 35, middle + 35]


def test_show_draws_the_body_with_its_points_and_reasons(phobos, tmp_path, capsys):
    place = tmp_path / "body.png"
    assert run(["catalog", "show", str(phobos), "-o", str(place)]) == 0
    assert capsys.readouterr().out == f"picture: {place}\n"
    picture = cv2.imread(str(place))
    tiles = picture[body_sides.HEAD_PX : -60]
    overhang = REASON_COLOURS[list(Flag).index(Flag.OVERHANG)]
    for colour in (USABLE, overhang):
        assert (tiles == parse_colour(colour)).all(axis=2).sum() > 30


def test_the_report_of_a_small_body_shows_it_from_six_sides(phobos, tmp_path):
    page = report_of(phobos, tmp_path)
    assert sum("Control points seen from" in label for label in page.labels) == 6
    assert "overhang: 1" in page.text


def test_large_bodies_and_catalogs_without_a_shape_are_not_drawn_whole(tmp_path, capsys):
    catalog = a_catalog(tmp_path / "moon.gpkg")
    assert run(["catalog", "show", str(catalog), "-o", str(tmp_path / "moon.png")]) == 2
    assert "moon is too large to be drawn with its points; name one" in capsys.readouterr().err
    assert "On the body" not in report_of(catalog, tmp_path).text
