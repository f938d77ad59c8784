"""Opening a catalog and looking points up."""

import hashlib
import logging
import pickle
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from catalog.errors import DataError
from catalog.geometry.latlon import angular_distance
from catalog.store.reader import Catalog
from catalog.store.verify import verify
from catalog.store.writer import Written


@pytest.fixture(scope="module")
def catalog(written: Written) -> Any:
    with Catalog.open(written.path) as opened:
        yield opened


def test_nearest_is_the_point_at_the_least_angle(catalog: Catalog) -> None:
    rng = np.random.default_rng(2)
    for lat, lon in zip(rng.uniform(-90, 90, 200), rng.uniform(-400, 400, 200)):
        angles = angular_distance(
            np.radians(lat),
            np.radians(lon),
            np.radians(catalog.lat_deg),
            np.radians(catalog.lon_deg),
        )
        assert catalog.nearest(lat, lon) == catalog.ids[np.argmin(angles)]


@pytest.mark.parametrize("place", [(90.1, 0.0), (float("nan"), 0.0), (0.0, float("inf"))])
def test_nearest_refuses_what_is_no_place(catalog: Catalog, place: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="not a place"):
        catalog.nearest(*place)


def test_within_agrees_with_angles(catalog: Catalog) -> None:
    for lat, lon, radius in ((0.0, 180.0, 40.0), (89.0, 10.0, 60.0), (-30.0, 700.0, 1.0)):
        angles = angular_distance(
            np.radians(lat),
            np.radians(lon),
            np.radians(catalog.lat_deg),
            np.radians(catalog.lon_deg),
        )
        wanted = catalog.ids[np.degrees(angles) <= radius]
        assert np.array_equal(catalog.within(lat, lon, radius), wanted)
    assert catalog.within(12.0, 34.0, 180.0).size == len(catalog)


def test_arrays_and_points_agree(catalog: Catalog) -> None:
    for row, point in enumerate(catalog.points()):
        assert catalog.find_row(point.id) == row
        assert catalog.usable[row] == point.usable
        assert np.allclose(catalog.xyz_m[row], point.xyz_m, rtol=0, atol=1e-6)


def test_an_id_that_is_not_there_is_told(catalog: Catalog) -> None:
    missing = set(range(-1, catalog.grid.total + 1)) - set(catalog.ids.tolist())
    for cell in missing:
        for ask in (catalog.find_row, catalog.point, catalog.patches):
            with pytest.raises(DataError, match=f"no control point {cell};"):
                ask(cell)


def test_a_catalog_travels_to_another_process(catalog: Catalog) -> None:
    other = pickle.loads(pickle.dumps(catalog))
    number = int(catalog.ids[3])
    assert other.digest == catalog.digest
    assert np.array_equal(
        other.patches(number)[0].heights_m, catalog.patches(number)[0].heights_m, equal_nan=True
    )
    other.close()


def test_threads_may_share_a_catalog(catalog: Catalog) -> None:
    ids = [int(i) for i in catalog.ids] * 20
    with ThreadPoolExecutor(4) as pool:
        sums = [float(np.nansum(p[0].heights_m)) for p in pool.map(catalog.patches, ids)]
    assert sums == [float(np.nansum(catalog.patches(i)[0].heights_m)) for i in ids]


def change(path: Path, statement: str, *values: object) -> None:
    """Edit a catalog behind its back."""
    db = sqlite3.connect(path)
    db.create_function("ST_IsEmpty", 1, lambda _: 0)
    for name in ("ST_MinX", "ST_MaxX", "ST_MinY", "ST_MaxY"):
        db.create_function(name, 1, lambda _: 0.0)
    db.execute(statement, values)
    db.commit()
    db.close()


def test_a_damaged_patch_stops_only_its_own_point(catalog_copy: Path) -> None:
    with Catalog.open(catalog_copy) as catalog:
        ids = [int(i) for i in catalog.ids]
    bad = ids[4]
    db = sqlite3.connect(catalog_copy)
    where = "WHERE point_id = ? AND level = 1"
    (blob,) = db.execute(f"SELECT data FROM optnav_patches {where}", (bad,)).fetchone()
    db.close()
    flipped = blob[:40] + bytes([blob[40] ^ 4]) + blob[41:]
    change(catalog_copy, f"UPDATE optnav_patches SET data = ? {where}", flipped, bad)
    with Catalog.open(catalog_copy) as catalog:
        with pytest.raises(DataError, match=f"control point {bad} is damaged"):
            catalog.patches(bad)
        for number in ids:
            if number != bad:
                assert len(catalog.patches(number)) == 3


def test_a_name_of_the_database_that_is_not_utf8_is_damage(catalog_copy: Path) -> None:
    data = catalog_copy.read_bytes()
    place = data.index(b"CREATE TABLE")
    catalog_copy.write_bytes(data[: place + 8] + b"\xd4" + data[place + 9 :])
    with pytest.raises(DataError, match="restore it or build it again"):
        Catalog.open(catalog_copy)


def test_a_missing_level_stops_its_point(catalog_copy: Path) -> None:
    with Catalog.open(catalog_copy) as catalog:
        bad = int(catalog.ids[0])
    change(catalog_copy, "DELETE FROM optnav_patches WHERE point_id = ? AND level = 2", bad)
    with (
        Catalog.open(catalog_copy) as catalog,
        pytest.raises(DataError, match="2 levels of 3"),
    ):
        catalog.patches(bad)


def test_the_feature_layer_stands_in_for_damaged_packed_points(
    catalog_copy: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Catalog.open(catalog_copy) as catalog:
        before = list(catalog.points())
    change(catalog_copy, "UPDATE optnav_records SET checksum = checksum + 1")
    change(catalog_copy, "UPDATE control_points SET trials = 77 WHERE id = ?", before[2].id)
    with caplog.at_level(logging.WARNING), Catalog.open(catalog_copy) as catalog:
        assert list(catalog.points()) == before[:2] + before[3:]
    assert f"control_points {before[2].id}" in caplog.text


def test_a_file_that_is_no_catalog_is_told(tmp_path: Path) -> None:
    empty, text, other = tmp_path / "empty", tmp_path / "text", tmp_path / "other.gpkg"
    empty.write_bytes(b"")
    text.write_text("latitude, longitude\n" * 20)
    db = sqlite3.connect(other)
    db.execute("CREATE TABLE points (x)")
    db.commit()
    db.close()
    for path in (empty, text, other):
        with pytest.raises(DataError, match="is not an optnav catalog"):
            Catalog.open(path)
    with pytest.raises(DataError, match="no such file"):
        Catalog.open(tmp_path / "nowhere.gpkg")
    with pytest.raises(DataError, match=r"is a folder"):
        Catalog.open(tmp_path)


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_catalog_is_told(catalog_copy: Path, share: float) -> None:
    data = catalog_copy.read_bytes()
    catalog_copy.write_bytes(data[: int(share * len(data))])
    with pytest.raises(DataError, match="cut short") as told:
        Catalog.open(catalog_copy)
    assert str(catalog_copy) in str(told.value)


def test_an_edited_manifest_is_told(catalog_copy: Path) -> None:
    change(catalog_copy, "UPDATE optnav_meta SET value = '1737000.0' WHERE key = 'radius_m'")
    with pytest.raises(DataError, match="manifest"):
        Catalog.open(catalog_copy)


def test_a_newer_format_is_told(catalog_copy: Path) -> None:
    """Whatever its checksum covers: a newer format may sum its manifest up in another way."""
    change(catalog_copy, "UPDATE optnav_meta SET value = '7' WHERE key = 'format_version'")
    with pytest.raises(DataError, match=r"format 7.*install a newer optnav"):
        Catalog.open(catalog_copy)


@pytest.mark.parametrize("version", ["1", "3"])
def test_a_catalog_of_a_former_format_reads_the_same(
    written: Written, catalog_copy: Path, version: str
) -> None:
    """The feature layer called the localisation error, in nodes, `localisation_px` then."""
    column = "localisation_nodes TO localisation_px"
    change(catalog_copy, f"ALTER TABLE control_points RENAME COLUMN {column}")
    change(catalog_copy, "DROP TABLE layer_styles")  # there were none
    change(catalog_copy, "DELETE FROM gpkg_contents WHERE table_name = 'layer_styles'")
    change(catalog_copy, f"UPDATE optnav_meta SET value = {version} WHERE key = 'format_version'")
    with closing(sqlite3.connect(catalog_copy)) as db:
        rows = dict(db.execute("SELECT key, value FROM optnav_meta"))
    covered = sorted(set(rows) - {"checksum", "seal"})
    text = "".join(f"{key}\n{rows[key]}\n" for key in covered)
    checksum = hashlib.sha256(text.encode()).hexdigest()
    change(catalog_copy, f"UPDATE optnav_meta SET value = '{checksum}' WHERE key = 'checksum'")
    change(catalog_copy, "DELETE FROM optnav_meta WHERE key = 'seal'")
    with Catalog.open(written.path) as new, Catalog.open(catalog_copy, strict=True) as old:
        assert list(old.points()) == list(new.points())
        assert old.digest == new.digest
        found = verify(catalog_copy)
        assert (found.problems, found.computed) == ([], new.digest)
        change(catalog_copy, "DELETE FROM optnav_records")  # now from the feature layer
    with Catalog.open(written.path) as new, Catalog.open(catalog_copy) as old:
        assert list(old.points()) == list(new.points())


def test_reading_leaves_the_folder_as_it_was(catalog_copy: Path) -> None:
    before = catalog_copy.read_bytes()
    with Catalog.open(catalog_copy) as catalog:
        catalog.patches(int(catalog.ids[0]))
    assert catalog_copy.read_bytes() == before
    assert list(catalog_copy.parent.iterdir()) == [catalog_copy]
