"""The calls for Python users: the README's example as it stands there, the rest on its files."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from catalog import api as catalog_api
from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.config import resource
from catalog.errors import DataError, UsageError
from catalog.store.manifest import CatalogMeta
from optnav_cli import api
from tests.catalog.store.written import write_points
from tests.optnav_cli.conftest import RoughWorld

CHECKOUT = Path(__file__).resolve().parents[2]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
EXAMPLE = dict(BLOCK.findall((CHECKOUT / "optnav_cli" / "README.md").read_text()))["python"]
README = BLOCK.findall((CHECKOUT / "README.md").read_text())
UTC = "2026-01-01T00:00:00Z"
TRUTH_M = RoughWorld(seed=1).pose(150e3).position_m


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with what both READMEs name: a catalog and a picture folder of one frame."""
    place = tmp_path_factory.mktemp("api")
    (place / "pictures" / "cameras").mkdir(parents=True)
    _, run, camera = (text for kind, text in README if kind == "toml")
    header, first, _ = next(text for kind, text in README if kind == "csv").splitlines()
    for name, text in (
        ("run.toml", run),
        ("cameras/nav.toml", camera),
        ("frames.csv", f"{header}\n{first}\n"),
    ):
        (place / "pictures" / name).write_text(text)
    camera = api.load_camera(place / "pictures" / "cameras" / "nav.toml")
    world = RoughWorld(seed=1, nodes=96, camera=camera)
    pose = world.pose(150e3, roll=0.3, tilt=(0.02, -0.01))
    sun = AnalyticEphemeris(load_body("moon")).sun_body(utc_to_tdb_s(UTC))
    picture = world.picture(pose, sun, noise_seed=7)
    cv2.imwrite(str(place / "pictures" / "one.png"), picture.astype(np.uint8))
    meta = CatalogMeta("moon", world.radius_m, world.cell_deg, world.levels, 96, 120.0, 0.5)
    write_points(place / "moon.gpkg", meta, world.control_points)
    return place


def test_the_example_of_the_readme_navigates_a_picture(place, monkeypatch, capsys):
    monkeypatch.chdir(place)
    assert len(EXAMPLE.strip().splitlines()) <= 10
    assert EXAMPLE.count("import ") == 1
    names = {}
    exec(compile(EXAMPLE, "README", "exec"), names)
    assert capsys.readouterr().out.startswith("solved [")
    fix = names["solution"].fix
    assert fix.method is api.Method.CONTROL_POINTS
    error = fix.position_m - TRUTH_M
    assert error @ np.linalg.solve(fix.covariance_m2, error) < 25.0
    assert np.linalg.norm(error) < 20.0


def test_a_folder_gives_what_its_only_picture_gives(place, monkeypatch, tmp_path):
    monkeypatch.chdir(place)
    (row,) = api.navigate_folder("pictures", ["moon.gpkg"], tmp_path / "run")
    names = {}
    exec(compile(EXAMPLE, "README", "exec"), names)
    np.testing.assert_allclose(row.position_m, names["solution"].position_m, atol=1e-6)
    api.report(tmp_path / "run", tmp_path / "run.html")
    assert (tmp_path / "run.html").stat().st_size > 10_000
    truth = "file,utc,x_m,y_m,z_m,qw,qx,qy,qz\n"
    position = ",".join(f"{value:.4f}" for value in TRUTH_M)
    truth += f"one.png,{UTC},{position},0.7856457,0.2765186,0.2975382,-0.4666576\n"
    (tmp_path / "truth.csv").write_text(truth)
    figures = api.evaluate(tmp_path / "run", tmp_path / "truth.csv").figures()
    assert (figures.frames, figures.solved) == (1, 1)


def test_a_catalog_is_opened_asked_and_verified(place):
    with catalog_api.open_catalog(place / "moon.gpkg") as catalog:
        point = catalog.point(catalog.nearest(-43.0, -11.0))
        assert abs(point.lat_deg + 43.0) < 0.3
        assert catalog.patches(point.id)[0].heights_m.shape == (96, 96)
    assert catalog_api.verify_catalog(place / "moon.gpkg").sound


def test_what_cannot_be_used_is_said(place, tmp_path):
    camera = api.load_camera("unk")
    attitude = (1.0, 0.0, 0.0, 0.0)
    picture, catalogs = place / "pictures" / "one.png", [place / "moon.gpkg"]
    with pytest.raises(UsageError, match="belong together"):
        api.navigate_picture(
            picture, camera, catalogs, utc=UTC, camera_from_body=attitude, position_sigma_m=1.0
        )
    with pytest.raises(TypeError, match=r"takes no position_sigma$"):
        api.navigate_picture(
            picture, camera, catalogs, utc=UTC, camera_from_body=attitude, position_sigma=1.0
        )
    with pytest.raises(DataError, match="no such picture"):
        api.navigate_picture(
            tmp_path / "no.png", camera, catalogs, utc=UTC, camera_from_body=attitude
        )
    with pytest.raises(api.OptnavError, match="there is no"):
        api.simulate(tmp_path / "no.toml", tmp_path / "pictures")


def test_a_build_from_python_is_the_build_of_the_command(tmp_path):
    report = catalog_api.build_catalog(
        resource("configs/catalogs/tycho.toml"),
        tmp_path / "t.gpkg",
        bbox=(-12, -44, -11, -43),
        workers=1,
    )
    assert (report.points, report.output) == (1, tmp_path / "t.gpkg")
    with catalog_api.open_catalog(tmp_path / "t.gpkg") as catalog:
        assert catalog.digest == report.digest
