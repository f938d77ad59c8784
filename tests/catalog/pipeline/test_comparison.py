"""A second model of the same ground: the shifts that it shows are found, stored and judged."""

import csv
import json
import logging
import sqlite3
from contextlib import closing

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from scipy.ndimage import gaussian_filter

from catalog.config import resource
from catalog.control_point import Flag
from catalog.errors import ConfigError, DataError
from catalog.inspect.export import export
from catalog.inspect.summary import catalog_document, describe, describe_point, point_document
from catalog.pipeline.build import run
from catalog.store.reader import Catalog
from catalog.store.verify import verify
from tests.catalog.pipeline.coarse_tycho import BBOX, CONFIG

EAST_M, NORTH_M = 150.0, -90.0  # in the file's map, whose scale along a parallel is that of 0 deg
SECOND = '[[dem]]\npath = "second.tif"\nrole = "comparison"\n'


def second_model(path, east_m=EAST_M, north_m=NORTH_M):
    """The bundled model of Tycho moved, blurred to 474 m and with an error of 2 m of its own."""
    with rasterio.open(resource("data/tycho_gld100_256ppd.tif")) as dataset:
        heights, profile = dataset.read(1).astype(np.float32), dataset.profile
    coarse = heights.reshape(heights.shape[0] // 4, 4, -1, 4).mean(axis=(1, 3))
    noise = gaussian_filter(np.random.default_rng(1).normal(size=coarse.shape), 1.5)
    coarse = gaussian_filter(coarse, 1.0) + noise * (2.0 / noise.std())
    moved = Affine.translation(east_m, north_m) @ profile["transform"] @ Affine.scale(4.0)
    rows, cols = coarse.shape
    profile.update(dtype="float32", transform=moved, nodata=None, height=rows, width=cols)
    with rasterio.open(path, "w", **profile) as dataset:
        dataset.write(coarse.astype(np.float32), 1)


def built(folder, more=SECOND, name="other"):
    (folder / f"{name}.toml").write_text(CONFIG + more)
    output = folder / f"{name}.gpkg"
    run(folder / f"{name}.toml", folder / "work", output=output, bbox=BBOX, workers=1)
    return Catalog.open(output)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compared")
    second_model(folder / "second.tif")
    built(folder, name="c").close()
    return folder


def test_the_shift_of_a_moved_and_blurred_copy_is_recovered(folder):
    """To 5 m on the mean of eleven points and 25 m on each, where a node is 474 m."""
    with Catalog.open(folder / "c.gpkg") as catalog:
        assert set(catalog.shifts) == set(catalog.ids.tolist())
        for point in catalog.points():
            shift = catalog.shifts[point.id]
            wanted = EAST_M * np.cos(np.radians(point.lat_deg)), NORTH_M
            assert (shift.east_m, shift.north_m) == pytest.approx(wanted, abs=25.0)
            assert shift.level == 0
            assert shift.score > 0.9
        moved = np.array([(s.east_m, s.north_m) for s in catalog.shifts.values()])
        wanted = EAST_M * np.cos(np.radians(catalog.lat_deg.mean())), NORTH_M
        assert moved.mean(axis=0) == pytest.approx(wanted, abs=5.0)


def test_shifts_are_shown_and_are_no_content(folder):
    assert verify(folder / "c.gpkg").sound
    with Catalog.open(folder / "c.gpkg") as catalog, built(folder, more="") as plain:
        assert catalog.digest == plain.digest
        assert catalog_document(plain)["comparison"] is None
        document = catalog_document(catalog)
        assert document["comparison"]["points_found"] == len(catalog)
        assert "11 of 11 points found, +1" in describe(document)["comparison with second.tif"]
        point = point_document(catalog.point(int(catalog.ids[0])))
        assert point["comparison_n_m"] == pytest.approx(NORTH_M, abs=25.0)
        assert "m north, score 0.9" in describe_point(point)["comparison"]
        other = point_document(plain.point(int(plain.ids[0])))
        assert other["comparison_e_m"] is None
        assert "comparison" not in describe_point(other)


def test_a_layer_has_the_shifts_of_a_catalog_with_a_comparison(folder, tmp_path):
    with Catalog.open(folder / "c.gpkg") as catalog:
        for ending in (".csv", ".geojson", ".gpkg"):
            export(catalog, tmp_path / f"layer{ending}")
        shifts = [(s.east_m, s.north_m, s.score) for _, s in sorted(catalog.shifts.items())]
    names = ["comparison_e_m", "comparison_n_m", "comparison_score"]
    with (tmp_path / "layer.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [tuple(float(row[name]) for name in names) for row in rows] == shifts
    features = json.loads((tmp_path / "layer.geojson").read_text())["features"]
    assert [tuple(f["properties"][name] for name in names) for f in features] == shifts
    with closing(sqlite3.connect(tmp_path / "layer.gpkg")) as db:
        listed = "SELECT data_type FROM gpkg_contents WHERE table_name = 'optnav_comparison'"
        assert db.execute(listed).fetchall() == [("attributes",)]
        stored = "SELECT comparison_e_m, comparison_n_m, score FROM optnav_comparison ORDER BY id"
        assert db.execute(stored).fetchall() == shifts


def test_damaged_shifts_are_left_out_and_reported(folder, tmp_path):
    import shutil
    import sqlite3

    copy = tmp_path / "c.gpkg"
    shutil.copyfile(folder / "c.gpkg", copy)
    with sqlite3.connect(copy) as db:
        db.execute("UPDATE optnav_comparison SET comparison_e_m = 0.0")
    db.close()
    assert any(problem.where == "optnav_comparison" for problem in verify(copy).problems)
    with Catalog.open(copy) as catalog:
        assert catalog.shifts == {}


def test_points_over_the_limit_are_not_usable(folder):
    with built(folder, SECOND + "[comparison]\nmax_shift_m = 137.0\n") as catalog:
        shifts = catalog.shifts
        over = [point for point in catalog.points() if shifts[point.id].distance_m > 137.0]
        assert 0 < len(over) < len(catalog)
        for point in catalog.points():
            assert bool(point.flags & Flag.DISPLACED) == (point in over)
        assert not any(point.usable for point in over)
        assert "displaced" in over[0].flags.label


def test_a_model_that_is_off_by_a_degree_is_reported(folder, caplog):
    second_model(folder / "degree.tif", east_m=30.3e3)
    more = SECOND.replace("second", "degree")
    with caplog.at_level(logging.WARNING), built(folder, more) as catalog:
        assert np.isnan([shift.east_m for shift in catalog.shifts.values()]).mean() > 0.5
    assert "control points on its ground are found in it: it is shifted by more than" in caplog.text


@pytest.mark.parametrize(
    ("more", "error", "words"),
    [
        (SECOND.replace("second", "far"), DataError, "far.tif shows none of the 1"),
        (SECOND + "error_m = 3.0\n", ConfigError, "comparison model enters nothing"),
        ("[comparison]\nmax_shift_m = 9.0\n", ConfigError, 'no \\[\\[dem\\]\\] has role = "comp'),
        ("[comparison]\nmax_shift_m = 0.0\n", ConfigError, "max_shift_m = 0.0"),
        (SECOND.replace("comparison", "compare"), ConfigError, "did you mean 'comparison'"),
        (
            '[[dem]]\npath = "bundled:moon_gld100_4ppd.tif"\nrole = "comparison"\n',
            ConfigError,
            "7580.* m between nodes, the coarsest level 1896 m",
        ),
    ],
)
def test_a_comparison_that_cannot_be_is_refused(folder, more, error, words):
    second_model(folder / "far.tif", east_m=600e3)
    with pytest.raises(error, match=words):
        built(folder, more)


def test_the_ground_itself_is_needed(tmp_path):
    (tmp_path / "a.toml").write_text('[body]\nname = "moon"\n' + SECOND)
    with pytest.raises(ConfigError, match="alone; name the ground"):
        run(tmp_path / "a.toml", output=tmp_path / "c.gpkg", workers=1)


def test_gld100_and_lola_agree_on_coarse_ground(tmp_path, shared_data):
    """Templates of 480 km from models of 7.6 km: none moves by 500 m, which is 0.07 nodes.

    LDEM_4 and GLD100 have the same registration: half a pixel between them would be 3.8 km.
    """
    lola = shared_data("moon/LDEM_4.LBL")
    (tmp_path / "globe.toml").write_text(
        '[body]\nname = "moon"\n[[dem]]\npath = "bundled:moon_gld100_4ppd.tif"\n'
        f'[[dem]]\npath = "{lola}"\nrole = "comparison"\n'
        "[grid]\ncell_deg = 15.0\n[pyramid]\nlevels = 1\nsize = 64\n"
        "[render]\ncandidates = 1\n[check]\nplaces = 1\ntrials = 1\n"
    )
    run(tmp_path / "globe.toml", output=tmp_path / "c.gpkg", bbox=(-60, -50, 60, 50), workers=1)
    with Catalog.open(tmp_path / "c.gpkg") as catalog:
        moved = np.array([(s.east_m, s.north_m) for s in catalog.shifts.values()])
        assert len(moved) > 30
        assert np.isfinite(moved).all(axis=1).mean() > 0.9
        assert np.abs(np.nanmedian(moved, axis=0)).max() < 100.0
        assert np.nanmax(np.abs(moved)) < 500.0
