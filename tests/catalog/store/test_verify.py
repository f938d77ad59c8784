"""Verification finds every damage that changes what a catalog says."""

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from catalog.errors import DataError
from catalog.store.connection import SealState
from catalog.store.verify import verify
from catalog.store.writer import Written

FLIPS = 250  # a slow test of the whole command flips 1000


def test_a_whole_catalog_is_sound_and_its_digest_true(world: Any, written: Written) -> None:
    found = verify(written.path)
    assert found.sound, found.problems
    assert found.computed == found.stated == written.digest
    assert found.seal is SealState.WHOLE
    assert (found.points, found.patches) == (len(world.points), 3 * len(world.points))


def test_each_of_250_flipped_bits_is_reported(make: Callable[..., Any], tmp_path: Path) -> None:
    """Anywhere in the file; half of the flips aim at the first 600 bytes of a page, where SQLite
    keeps its own structure, as most of a small file's pages are empty."""
    written = make(seed=9, count=20, size=80).write(tmp_path / "c.gpkg")
    data = bytearray(written.path.read_bytes())
    rng = np.random.default_rng(20)
    outcomes = {"reported": 0, "refused": 0}
    for number in range(FLIPS):
        place = int(rng.integers(len(data)))
        if number % 2:
            place = place // 65536 * 65536 + int(rng.integers(600))
        bit = 1 << int(rng.integers(8))
        data[place] ^= bit
        flipped = tmp_path / "flipped.gpkg"
        flipped.write_bytes(data)
        data[place] ^= bit
        try:
            found = verify(flipped)
        except DataError:
            outcomes["refused"] += 1
            continue
        assert not found.sound, f"bit {bit} of byte {place}"
        outcomes["reported"] += 1
    assert min(outcomes.values()) > 0, outcomes


@pytest.mark.parametrize("place", [24, 27, 92, 95])
def test_a_flipped_bit_of_the_change_counters_is_reported(catalog_copy: Path, place: int) -> None:
    data = bytearray(catalog_copy.read_bytes())
    data[place] ^= 4
    catalog_copy.write_bytes(data)
    assert not verify(catalog_copy).sound


def test_every_flipped_bit_of_the_seal_is_reported(catalog_copy: Path) -> None:
    data = bytearray(catalog_copy.read_bytes())
    with sqlite3.connect(catalog_copy) as db:
        (seal,) = db.execute("SELECT value FROM optnav_meta WHERE key = 'seal'").fetchone()
    db.close()
    first = data.index(seal.encode())
    for place in range(first, first + len(seal), 5):
        data[place] ^= 1
        catalog_copy.write_bytes(data)
        assert not verify(catalog_copy).sound
        data[place] ^= 1


def test_every_flipped_bit_of_patch_data_names_point_and_level(
    world: Any, written: Written, tmp_path: Path
) -> None:
    db = sqlite3.connect(written.path)
    number, level, blob = db.execute(
        "SELECT point_id, level, data FROM optnav_patches WHERE level = 1 LIMIT 1"
    ).fetchone()
    db.close()
    whole = written.path.read_bytes()
    start = whole.index(blob)
    rng = np.random.default_rng(4)
    for place in rng.integers(start, start + len(blob), 20):
        data = bytearray(whole)
        data[place] ^= 1 << int(rng.integers(8))
        path = tmp_path / "flipped.gpkg"
        path.write_bytes(data)
        found = verify(path)
        assert f"control point {number}, level {level}" in [p.where for p in found.problems]
        assert found.computed != written.digest


EDITS = {
    "UPDATE control_points SET reasons = 'bright' WHERE id = 22": "control_points 22",
    "DELETE FROM rtree_control_points_geom": "rtree_control_points_geom 22",
    "DELETE FROM optnav_records": "optnav_records",
    "UPDATE optnav_patches SET posting_m = 100.0 WHERE level = 0": "control point 22, level 0",
    "INSERT INTO optnav_patches SELECT id + 200, point_id, 0, 9, 1, 1, 1, 1, 1, data "
    "FROM optnav_patches LIMIT 1": "optnav_patches",
    "UPDATE gpkg_spatial_ref_sys SET definition = 'x' WHERE srs_id = 30100": "gpkg_spatial_ref_sys",
}


@pytest.mark.parametrize(("statement", "place"), EDITS.items())
def test_an_edit_is_named(catalog_copy: Path, statement: str, place: str) -> None:
    db = sqlite3.connect(catalog_copy)
    for trigger in db.execute("SELECT name FROM sqlite_schema WHERE type = 'trigger'").fetchall():
        db.execute(f"DROP TRIGGER {trigger[0]}")
    db.execute(statement)
    db.commit()
    db.close()
    found = verify(catalog_copy)
    assert place in [problem.where for problem in found.problems]


def test_a_damaged_manifest_is_named(catalog_copy: Path) -> None:
    db = sqlite3.connect(catalog_copy)
    db.execute("UPDATE optnav_meta SET value = '0' WHERE key = 'digest'")
    db.commit()
    db.close()
    with pytest.raises(DataError, match="manifest"):
        verify(catalog_copy)


def test_what_is_no_catalog_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a catalog " * 30)
    with pytest.raises(DataError, match="is not an optnav catalog"):
        verify(path)
