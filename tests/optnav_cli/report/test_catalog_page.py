"""The page about a catalog: regional and global, whole and odd ones."""

import re
import sqlite3
import time
from dataclasses import replace

import numpy as np
import pytest

from catalog.control_point import ComparisonShift, Flag
from catalog.errors import DataError
from catalog.geometry.cells import CellGrid
from catalog.store.manifest import CatalogMeta, ComparisonMeta
from catalog.store.reader import Catalog
from optnav_cli.main import run
from optnav_cli.pages import write_report
from optnav_cli.report.catalog_maps import find_first_reasons
from optnav_cli.report.catalog_page import build_catalog_page, list_quantities
from tests.catalog.store.written import write_points
from tests.optnav_cli.report.pages import RADIUS_M, a_catalog, report_of

WHOLE = {"lat": (-90.0, 90.0), "lon": (-180.0, 180.0)}
MAPS = 5  # usable points, localisation, recognition, uniqueness, shadow limits


def circles(tmp_path):
    return len(re.findall('<circle class="dot', (tmp_path / "report.html").read_text()))


def test_a_regional_catalog_shows_points_scores_patches_and_sources(tmp_path):
    page = report_of(a_catalog(tmp_path / "c.gpkg"), tmp_path)
    assert "40 control points, 32 usable; 2 levels of 32 nodes" in page.text
    assert "flat the predicted match error is above the limit 8 20.0 % 8 8" in page.text
    assert "dem.tif <sha>" in page.text
    assert circles(tmp_path) == 40
    # three of the best, three of the worst and a flat one
    assert page.counts["img"] == 7 * 2
    assert sum("Map of" in label for label in page.labels) == MAPS
    assert "the region" in " ".join(page.labels)


def test_shifts_in_a_second_model_are_mapped_by_size_and_direction(tmp_path):
    def moved(point, number):
        return replace(point, comparison=ComparisonShift(10.0 + number, -20.0, 0, 0.8))

    second = ComparisonMeta({"second.tif": "<sha>"}, None)
    page = report_of(a_catalog(tmp_path / "c.gpkg", change=moved, comparison=second), tmp_path)
    assert "How far second.tif has the ground of each point" in page.text
    assert "Map of shifts in the comparison model" in page.labels
    assert "Shifts of the points in the comparison model, " in page.text
    assert circles(tmp_path) == 2 * 40
    assert sum("Map of Comparison" in label for label in page.labels) == 1


def test_a_global_catalog_is_painted_with_both_poles_beside_it(tmp_path):
    page = report_of(a_catalog(tmp_path / "c.gpkg", 300, step_deg=5.0, **WHOLE), tmp_path)
    assert circles(tmp_path) == 0
    for kind in ("the whole body, equal-area (Mollweide)", "north polar cap", "south polar cap"):
        assert sum(kind in label for label in page.labels) == MAPS
    assert "LROC WAC GLD100" in page.text


def test_another_body_never_shows_the_moon(tmp_path):
    catalog = a_catalog(
        tmp_path / "c.gpkg", 300, step_deg=5.0, body="phobos", radius_m=11100.0, **WHOLE
    )
    page = report_of(catalog, tmp_path)
    assert "Phobos: catalog c.gpkg" in page.text
    assert "GLD100" not in page.text


@pytest.mark.parametrize(
    ("lat", "lon", "step_deg"),
    [
        ((80.0, 90.0), (-180.0, 180.0), 2.0),
        ((-90.0, -89.0), (-180.0, 180.0), 2.0),  # the pole's own cap
        ((-5.0, 5.0), (175.0, 185.0), 2.0),
        ((-90.0, 90.0), (-180.0, 180.0), 90.0),
    ],
)
@pytest.mark.parametrize("count", [1, 30])
def test_poles_and_the_date_line_and_single_cells_are_drawn(tmp_path, lat, lon, step_deg, count):
    path = a_catalog(tmp_path / "c.gpkg", count, lat, lon, step_deg)
    page = report_of(path, tmp_path)
    assert "Usable control points" in page.text
    assert "not known" not in page.text
    assert page.text.count("1 control point,") == (count == 1)


def test_a_catalog_without_a_usable_point_says_so(tmp_path):
    page = report_of(a_catalog(tmp_path / "c.gpkg", usable=False), tmp_path)
    assert "40 control points, 0 usable" in page.text
    assert "The catalog has no usable point" in page.text
    assert "Not usable: flat" in page.text


def test_a_catalog_without_any_point_says_so(tmp_path):
    path = tmp_path / "c.gpkg"
    write_points(path, CatalogMeta("moon", RADIUS_M, 1.0, 2, 32, 118.0, 0.1), [])
    page = report_of(path, tmp_path)
    assert "The catalog holds no control point" in page.text
    assert "does not name its terrain models" in page.text


def test_what_no_point_knows_is_told_as_missing(tmp_path):
    def unknown(point, number):
        return replace(
            point, localisation_nodes=np.nan, trials=0, recognition_rate=0.0, uniqueness=(),
            shadow_limit_deg=(),
        )  # fmt: skip

    page = report_of(a_catalog(tmp_path / "c.gpkg", change=unknown), tmp_path)
    for missing in ("predicted match error", "recognised share", "uniqueness", "shadow limit"):
        assert re.search(rf"holds no [^.]*{missing}[^.]* of any point", page.text)


def test_places_that_were_never_checked_are_unknown_instead_of_free_of_shadows(tmp_path):
    def unchecked(point, number):
        if point.usable:
            return point
        return replace(point, trials=0, uniqueness=(0.0, 0.0), shadow_limit_deg=(0.0,) * 36)

    path = a_catalog(tmp_path / "c.gpkg", change=unchecked)
    page = report_of(path, tmp_path)
    assert page.text.count("not known: 8") == 3
    with Catalog.open(path) as catalog:
        by_heading = {quantity.heading: quantity.values for quantity in list_quantities(catalog)}
        for heading in ("Recognition", "Uniqueness", "Shadow limits"):
            assert np.array_equal(np.isfinite(by_heading[heading]), catalog.usable)
        truth = catalog.records["shadow_limit_deg"][catalog.usable].max(axis=1)
        assert by_heading["Shadow limits"][catalog.usable] == pytest.approx(truth)


def test_a_point_is_coloured_by_the_first_check_it_failed(tmp_path):
    flags = [Flag.NO_DATA | Flag.FLAT, Flag.FLAT, Flag.SHADOWED | Flag.NOT_RECOGNISED, Flag.NONE]

    def change(point, number):
        return replace(point, usable=number >= 4, flags=flags[number] if number < 4 else Flag.NONE)

    path = a_catalog(tmp_path / "c.gpkg", count=6, change=change)
    with Catalog.open(path) as catalog:
        assert find_first_reasons(catalog).tolist() == [1, 2, 4, 9, 0, 0]
    page = report_of(path, tmp_path)
    assert "no reason given: 1" in page.text
    assert "a patch has holes 1 16.7 % 0 1" in page.text


def test_several_sources_are_mapped_and_counted(tmp_path):
    def polar(point, number):
        return replace(point, source="polar <1>.tif" if number % 2 else "")

    page = report_of(a_catalog(tmp_path / "c.gpkg", change=polar), tmp_path)
    assert "polar <1>.tif 20 16 80.0 %" in page.text
    assert "none: no ground at the point 20 16 80.0 %" in page.text
    assert "Map of sources" in " ".join(page.labels)


def test_a_damaged_patch_is_named_and_the_rest_is_shown(tmp_path):
    path = a_catalog(tmp_path / "c.gpkg")
    with Catalog.open(path) as catalog:
        scores = np.where(catalog.usable, catalog.records["localisation_nodes"], np.inf)
        best = int(catalog.ids[scores.argmin()])
    with sqlite3.connect(path) as db:
        db.execute("UPDATE optnav_patches SET data = x'00' WHERE point_id = ?", (best,))
    db.close()
    page = report_of(path, tmp_path)
    assert f"control point {best} is damaged" in page.text
    assert page.counts["img"] == 6 * 2


def test_points_that_are_left_out_for_damage_are_counted(tmp_path):
    path = a_catalog(tmp_path / "c.gpkg")
    with sqlite3.connect(path) as db:
        db.execute("UPDATE optnav_records SET data = x'00'")
        without_triggers(db)
        db.execute("UPDATE control_points SET flags = 0 WHERE flags != 0")
    db.close()
    page = report_of(path, tmp_path)
    assert "8 of 40 points are damaged and left out here" in page.text


def without_triggers(db):
    """They call functions that only GIS programs have."""
    triggers = db.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for (name,) in triggers:
        db.execute(f"DROP TRIGGER {name}")


@pytest.mark.parametrize("damage", ["cut", "text", "manifest", "points"])
def test_a_damaged_catalog_is_an_error_that_names_it(tmp_path, damage, capsys):
    path = a_catalog(tmp_path / "c.gpkg")
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:70000])
    elif damage == "text":
        path.write_text("Dear Sir")
    else:
        table = {"manifest": "optnav_meta", "points": "control_points"}[damage]
        with sqlite3.connect(path) as db:
            db.execute("UPDATE optnav_records SET data = x'00'")
            without_triggers(db)
            db.execute(f"DELETE FROM {table}")
        db.close()
    with pytest.raises(DataError, match=r"c\.gpkg"):
        write_report(path, tmp_path / "report.html")
    assert run(["report", str(path), "-o", str(tmp_path / "report.html")]) == 3
    assert "c.gpkg" in capsys.readouterr().err
    assert not (tmp_path / "report.html").exists()


def test_the_same_catalog_gives_the_same_page(tmp_path):
    path = a_catalog(tmp_path / "c.gpkg")
    for name in ("one.html", "other.html"):
        write_report(path, tmp_path / name)
    assert (tmp_path / "one.html").read_bytes() == (tmp_path / "other.html").read_bytes()


def test_a_page_about_all_cells_of_one_degree_stays_small_and_quick(tmp_path):
    """41 252 points: at most 10 MB and 20 s of a core, though scores that jump from cell to cell
    are the worst case of a map's picture."""
    count = CellGrid(1.0).total
    path = tmp_path / "c.gpkg"
    source = a_catalog(path, count=200, step_deg=1.0, **WHOLE)
    with Catalog.open(source) as catalog:
        records = np.resize(catalog.records, count).copy()
        grid = CellGrid(1.0)
        centres = np.array([grid.centre_deg(cell) for cell in range(count)])
        records["id"], records["levels"] = np.arange(count), 0
        records["lat_deg"], records["lon_deg"] = centres.T
        records["localisation_nodes"] = np.random.default_rng(3).uniform(0.1, 0.5, count)
        whole = Catalog(path, catalog._db, replace(catalog.meta, count=count), records)
        started = time.process_time()
        text = build_catalog_page(whole)
        seconds = time.process_time() - started
    assert len(text) < 10e6
    assert seconds < 20.0
    assert text.count("<circle") == 0
