"""A catalog that GIS programs have opened, changed around its content, or left in a hurry.

QGIS opens a GeoPackage through GDAL with a write-ahead log, and keeps styles and projects in it.
"""

import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from catalog.errors import DataError
from catalog.store.connection import SealState
from catalog.store.reader import Catalog
from catalog.store.verify import Verification, verify
from catalog.store.writer import Written

FLIPS = 300
PROJECTS = "CREATE TABLE qgis_projects (name TEXT PRIMARY KEY, metadata BLOB, content BLOB)"
STYLE = "INSERT INTO layer_styles (styleQML) VALUES ('<qgis/>')"
OWN_STYLE = "UPDATE layer_styles SET styleQML = '<qgis/>'"


def assert_whole(path: Path, written: Written, seal: SealState = SealState.OPENED) -> None:
    found = verify(path)
    assert found.sound, found.problems
    assert found.computed == written.digest
    assert found.seal is seal
    with Catalog.open(path) as catalog:
        assert len(catalog.patches(int(catalog.ids[0]))) == 3


@pytest.fixture
def ogrinfo() -> Any:
    """GDAL's own program with the journal that QGIS asks for."""
    program = shutil.which("ogrinfo")
    if program is None:
        pytest.skip("needs GDAL's ogrinfo")

    def call(*words: object, journal: str = "WAL") -> None:
        done = subprocess.run(
            [program, *(str(word) for word in words)],
            env={**os.environ, "OGR_SQLITE_JOURNAL": journal},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stderr == ""

    return call


def visit(path: Path, journal: str) -> sqlite3.Connection:
    """What QGIS does to a GeoPackage that it opens; the file stays open."""
    db = sqlite3.connect(path)
    db.execute(f"PRAGMA journal_mode = {journal}")
    for statement in (PROJECTS, STYLE, OWN_STYLE):
        db.execute(statement)
    db.execute("UPDATE gpkg_contents SET last_change = '2030-01-01T00:00:00Z'")
    db.commit()
    return db


@pytest.mark.parametrize("journal", ["WAL", "DELETE"])
def test_a_catalog_that_a_gis_program_has_open_still_verifies(
    catalog_copy: Path, written: Written, journal: str
) -> None:
    visitor = visit(catalog_copy, journal)
    try:
        assert_whole(catalog_copy, written)
    finally:
        visitor.close()
    assert_whole(catalog_copy, written)


def test_looking_alone_leaves_every_byte(
    catalog_copy: Path, written: Written, ogrinfo: Any
) -> None:
    ogrinfo("-al", "-so", catalog_copy)
    assert_whole(catalog_copy, written, SealState.WHOLE)


def test_styles_and_a_vacuum_by_gdal_are_no_damage(
    catalog_copy: Path, written: Written, ogrinfo: Any
) -> None:
    for statement in (PROJECTS, STYLE, OWN_STYLE):
        ogrinfo(catalog_copy, "-sql", statement)
    assert_whole(catalog_copy, written)
    ogrinfo(catalog_copy, "-sql", "VACUUM")
    assert_whole(catalog_copy, written)


def test_layers_metadata_and_systems_that_gdal_adds_are_no_damage(
    catalog_copy: Path, written: Written
) -> None:
    """A system that WKT 1 cannot say gives the table of systems a column more."""
    pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio to write vector layers")
    pyogrio.set_gdal_config_options({"OGR_SQLITE_JOURNAL": "WAL"})
    try:
        _, _, geometry, fields = pyogrio.raw.read(catalog_copy, layer="control_points")
        for layer, crs in (("notes", "IAU_2015:30100"), ("more", "EPSG:4979")):
            pyogrio.raw.write(
                catalog_copy, geometry=geometry, field_data=[fields[0]], fields=["lat_deg"],
                layer=layer, driver="GPKG", geometry_type="Point", crs=crs,
                layer_metadata={"author": "a user"},
            )  # fmt: skip
    finally:
        pyogrio.set_gdal_config_options({"OGR_SQLITE_JOURNAL": None})
    db = sqlite3.connect(catalog_copy)
    columns = [row[1] for row in db.execute("PRAGMA table_info(gpkg_spatial_ref_sys)")]
    tables = {name for (name,) in db.execute("SELECT name FROM sqlite_schema")}
    db.close()
    assert "definition_12_063" in columns
    assert {"notes", "more", "gpkg_metadata"} <= tables
    assert_whole(catalog_copy, written)


KILLED = """
import os, signal, sqlite3, sys
db = sqlite3.connect(sys.argv[1], isolation_level=None)
db.execute("PRAGMA journal_mode = " + sys.argv[2])
db.execute("PRAGMA cache_size = 1")
db.execute("CREATE TABLE qgis_projects (name TEXT PRIMARY KEY, content BLOB)")
db.execute("BEGIN")
for _ in range(100):
    db.execute("INSERT INTO layer_styles (styleQML) VALUES (?)", ("x" * 60000,))
if sys.argv[2] == "WAL":
    db.execute("COMMIT")
os.kill(os.getpid(), signal.SIGKILL)
"""


def beside(path: Path) -> set[str]:
    return {found.name.removeprefix(path.name) for found in path.parent.iterdir()} - {""}


def kill_a_visitor(path: Path, journal: str) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(path), journal], check=False)


def test_a_log_that_a_killed_program_left_is_read(catalog_copy: Path, written: Written) -> None:
    kill_a_visitor(catalog_copy, "WAL")
    assert beside(catalog_copy) == {"-wal", "-shm"}
    assert_whole(catalog_copy, written)
    # without its log the file is what it was at the last checkpoint: our content all the same
    for suffix in ("-wal", "-shm"):
        catalog_copy.with_name(catalog_copy.name + suffix).unlink()
    assert_whole(catalog_copy, written)


def test_a_half_done_change_of_a_killed_program_is_told_and_undone_by_the_next(
    catalog_copy: Path, written: Written
) -> None:
    kill_a_visitor(catalog_copy, "DELETE")
    assert beside(catalog_copy) == {"-journal"}
    with pytest.raises(DataError, match=r"left copy\.gpkg-journal: open and close the catalog"):
        verify(catalog_copy)
    db = sqlite3.connect(catalog_copy)
    db.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    db.close()
    assert_whole(catalog_copy, written)


def verified(path: Path) -> Verification | None:
    """None for a file that is refused whole."""
    try:
        return verify(path)
    except DataError:
        return None


def test_after_a_visit_a_flipped_bit_is_reported_or_harms_nothing(
    catalog_copy: Path, written: Written
) -> None:
    """The visitor's own tables and the room between rows are no longer under the seal."""
    db = visit(catalog_copy, "WAL")
    db.execute("VACUUM")
    db.close()
    rng = np.random.default_rng(12)
    size = catalog_copy.stat().st_size
    reported = 0
    for number in range(FLIPS):
        place = int(rng.integers(size))
        if number % 2:
            place = place // 65536 * 65536 + int(rng.integers(600))
        with catalog_copy.open("r+b") as file:
            file.seek(place)
            old = file.read(1)[0]
            file.seek(place)
            file.write(bytes([old ^ (1 << int(rng.integers(8)))]))
        found = verified(catalog_copy)
        if found is None or not found.sound:
            reported += 1
        else:
            assert found.computed == written.digest, f"byte {place}"
        with catalog_copy.open("r+b") as file:
            file.seek(place)
            file.write(bytes([old]))
    assert 0 < reported < FLIPS
    assert_whole(catalog_copy, written)
