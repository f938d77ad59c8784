"""Catalogs that somebody edited, with checksums that fit: a clear error, or a point left out."""

import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from catalog.errors import DataError, OptnavError
from catalog.inspect.compare import compare
from catalog.inspect.draw import draw_pyramid
from catalog.inspect.export import export, export_patch
from catalog.inspect.summary import catalog_document, describe, describe_point, point_document
from catalog.store.codec import Encoded
from catalog.store.manifest import _hash_rows
from catalog.store.patches import pack_header
from catalog.store.reader import Catalog
from catalog.store.records import compute_checksum, record_type
from catalog.store.verify import verify
from catalog.store.writer import Written
from tests.catalog.made_catalogs import LEVELS

FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e308, -1e308, 5e-324, 1e9)
WHOLE = (0, -1, 1, 2**31 - 1, -(2**31))
TEXTS = ("", "nan", "1e308", "-1", "0", "9" * 5000, "[" * 2000, "null", '{"a": 1}', "x" * 100)
LAYOUT = record_type(LEVELS)


def edit_record(path: Path, field: str, value: float) -> bool:
    """Set a field of the first packed point, its checksum made to fit; whether it changed."""
    with closing(sqlite3.connect(path)) as db, db:
        ((data,),) = db.execute("SELECT data FROM optnav_records WHERE id = 0")
        records = np.frombuffer(data, LAYOUT).copy()
        with np.errstate(over="ignore"):
            records[field][0] = value
        row = compute_checksum(records.tobytes()), records.tobytes()
        db.execute("UPDATE optnav_records SET checksum = ?, data = ? WHERE id = 0", row)
    return records.tobytes() != data


def edit_meta(path: Path, key: str, value: str | bytes | None) -> None:
    """Set or remove a row of the manifest; the checksum is made to fit."""
    with closing(sqlite3.connect(path)) as db, db:
        if value is None:
            db.execute("DELETE FROM optnav_meta WHERE key = ?", (key,))
        else:
            db.execute("UPDATE optnav_meta SET value = ? WHERE key = ?", (value, key))
        rows = {str(k): str(v) for k, v in db.execute("SELECT key, value FROM optnav_meta")}
        fitting = (_hash_rows(rows),)
        db.execute("UPDATE optnav_meta SET value = ? WHERE key = 'checksum'", fitting)


def edit_patch(path: Path, **columns: object) -> int:
    """Set columns of the first patch; the checksum is made to fit. Returns the point's id."""
    with closing(sqlite3.connect(path)) as db, db:
        db.row_factory = sqlite3.Row
        row = dict(db.execute("SELECT * FROM optnav_patches ORDER BY id LIMIT 1").fetchone())
        new = {**row, **columns}
        with suppress(struct.error, TypeError, AttributeError):
            encoded = Encoded(new["size"], new["step"], new["value_offset"], new["data"])
            header = pack_header(row["point_id"], row["level"], new["posting_m"], encoded)
            new["checksum"] = compute_checksum(header, encoded.data)
        texts = ", ".join(f"{name} = ?" for name in new)
        db.execute(f"UPDATE optnav_patches SET {texts} WHERE id = {row['id']}", [*new.values()])
    return int(row["point_id"])


def use(path: Path, other: Path) -> None:
    """What people do with a catalog, each by itself; only our own errors may come."""
    actions: tuple[Callable[[Catalog], object], ...] = (
        lambda catalog: describe(catalog_document(catalog)),
        lambda catalog: [describe_point(point_document(p)) for p in catalog.points()],
        lambda catalog: [catalog.nearest(lat, 10.0) for lat in (-90.0, 3.0, 90.0)],
        lambda catalog: [catalog.patches(int(number)) for number in catalog.ids],
        lambda catalog: catalog.relief(),
        lambda c: [draw_pyramid(c.pyramid(int(n)), c.meta.radius_m) for n in c.ids[:1]],
        lambda c: [export_patch(c, int(n), 0, path.with_suffix(".ply")) for n in c.ids[:1]],
        lambda catalog: export(catalog, path.with_suffix(".geojson")),
    )
    for action in actions:
        try:
            catalog = Catalog.open(path)
        except OptnavError:
            break  # nor does it open for the others
        with suppress(OptnavError), catalog:
            action(catalog)
    with suppress(OptnavError):
        verify(path)
    with suppress(OptnavError):
        compare(other, path)


@pytest.mark.parametrize("field", [str(name) for name in LAYOUT.names or ()])
def test_every_number_of_a_point_is_checked(written: Written, tmp_path: Path, field: str) -> None:
    path = tmp_path / "edited.gpkg"
    for value in FLOATS if LAYOUT[field].base.kind == "f" else WHOLE:
        path.write_bytes(written.path.read_bytes())
        changed = edit_record(path, field, value)
        use(path, written.path)
        assert verify(path).sound != changed


def test_an_impossible_point_is_left_out_with_its_reason(
    catalog_copy: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Catalog.open(catalog_copy) as catalog:
        before = len(catalog)
    edit_record(catalog_copy, "radius_m", 1e308)
    with Catalog.open(catalog_copy) as catalog:
        assert len(catalog) == before - 1
    assert "left out: its radius is not of the body" in caplog.text
    with pytest.raises(DataError, match="left out"):
        Catalog.open(catalog_copy, strict=True)


def test_every_row_of_the_manifest_is_checked(written: Written, tmp_path: Path) -> None:
    path = tmp_path / "edited.gpkg"
    with closing(sqlite3.connect(written.path)) as db:
        keys = [key for (key,) in db.execute("SELECT key FROM optnav_meta")]
    for key in keys:
        for value in (*TEXTS, None, b"\xff\xfe", "0.5", "5e-324", "2147483648", "/etc/a.toml"):
            path.write_bytes(written.path.read_bytes())
            edit_meta(path, key, value)
            use(path, written.path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("size", "1000000"),
        ("levels", "1000000000"),
        ("cell_deg", "1e-9"),
        ("radius_m", "nan"),
        ("posting_m", "0.0"),
        ("count", "-1"),
        ("body", "../moon.toml"),
        ("relief", '{"rows": 100000, "source": "", "digest": ""}'),
        ("planes", '{"radii_m": [1, 0, 1], "model_posting_m": 1}'),
        ("sources", "[" * 100_000),
        ("point_sources", "[1]"),
    ],
)
def test_a_manifest_beyond_the_format_is_refused(catalog_copy: Path, key: str, value: str) -> None:
    with closing(sqlite3.connect(catalog_copy)) as db, db:
        db.execute(
            "INSERT OR IGNORE INTO optnav_meta (key, value) SELECT ?, '' WHERE NOT EXISTS"
            " (SELECT 1 FROM optnav_meta WHERE key = ?)",
            (key, key),
        )
    edit_meta(catalog_copy, key, value)
    with pytest.raises(DataError, match="manifest"):
        Catalog.open(catalog_copy)


def test_every_column_of_a_patch_is_checked(written: Written, tmp_path: Path) -> None:
    path = tmp_path / "edited.gpkg"
    values: dict[str, tuple[Any, ...]] = {
        "posting_m": (*FLOATS, "text"),
        "step": (*FLOATS, "text"),
        "value_offset": (*(f for f in FLOATS if abs(f) >= 1e9), "text"),
        "size": (*WHOLE, 33, 4096, 100_000, "text"),
        "data": (b"", b"x", "text", 7),
        "level": WHOLE[1:],
        "layer": WHOLE[1:],
        "point_id": WHOLE,
    }
    for column, wrong in values.items():
        for value in wrong:
            path.write_bytes(written.path.read_bytes())
            with suppress(sqlite3.IntegrityError):  # NaN is NULL
                number = edit_patch(path, **{column: value})
                with pytest.raises(DataError, match="damaged"), Catalog.open(path) as catalog:
                    catalog.patches(number)
                use(path, written.path)


def test_a_small_blob_is_not_given_the_memory_that_it_asks_for(catalog_copy: Path) -> None:
    bomb = zstandard.ZstdCompressor(level=19).compress(bytes(1 << 30))
    assert len(bomb) < 100_000
    number = edit_patch(catalog_copy, data=bomb)
    with Catalog.open(catalog_copy) as catalog, pytest.raises(DataError, match="another size"):
        catalog.patches(number)
    unstated = zstandard.ZstdCompressor(level=19).compressobj()
    edit_patch(catalog_copy, data=unstated.compress(bytes(1 << 28)) + unstated.flush())
    with Catalog.open(catalog_copy) as catalog, pytest.raises(DataError, match="damaged"):
        catalog.patches(number)


@pytest.mark.parametrize(
    "table", ["optnav_meta", "optnav_records", "optnav_patches", "control_points"]
)
def test_a_view_in_the_place_of_a_table_is_refused(catalog_copy: Path, table: str) -> None:
    with closing(sqlite3.connect(catalog_copy)) as db:
        columns = [name for (name,) in db.execute(f"SELECT name FROM pragma_table_info('{table}')")]
        db.execute(f"DROP TABLE {table}")
        endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
        same = ", ".join(f"i AS {name}" for name in columns)
        db.execute(f"CREATE VIEW {table} AS {endless} SELECT {same} FROM n")
    for read in (Catalog.open, verify):
        with pytest.raises(DataError, match="no plain table"):
            read(catalog_copy)


def test_a_computed_column_and_a_huge_text_are_refused(catalog_copy: Path) -> None:
    with closing(sqlite3.connect(catalog_copy)) as db:
        db.execute("ALTER TABLE optnav_meta ADD COLUMN more AS (zeroblob(1000000000))")
        db.commit()
    with pytest.raises(DataError, match="no plain table"):
        Catalog.open(catalog_copy)


@pytest.mark.parametrize(
    "table", ["optnav_meta", "optnav_records", "optnav_patches", "control_points", "gpkg_contents"]
)
def test_a_table_that_is_missing_or_empty_is_told(
    written: Written, tmp_path: Path, table: str
) -> None:
    for statement in ("DELETE FROM {}", "DROP TABLE {}", "ALTER TABLE {} RENAME TO other"):
        path = tmp_path / "edited.gpkg"
        path.write_bytes(written.path.read_bytes())
        with closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA writable_schema = ON")
            with suppress(sqlite3.OperationalError):  # the triggers' functions are unknown here
                db.execute(statement.format(table))
            db.commit()
        use(path, written.path)
