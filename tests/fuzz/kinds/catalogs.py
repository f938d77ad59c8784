"""Catalogs: damaged bytes, and rows that were edited with checksums, digest and seal that fit."""

import random
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import zstandard

from catalog.store import manifest
from catalog.store.codec import Encoded
from catalog.store.connection import write_seal
from catalog.store.patches import pack_header
from catalog.store.records import compute_checksum, record_type
from tests.fuzz.cases import DATA, DIFFERS, NOTHING, OK, Case, Place, kind
from tests.fuzz.damage import damaged

READ = frozenset({OK, DATA, NOTHING, DIFFERS})
NUMBERS: list[Any] = [
    0, 1, -1, 2, 7, 48, 80, 4096, 4097, 65536, 2**31 - 1, 2**31, 2**40, 2**63 - 1, 0.0, -0.0, 0.5, -1.5, 1e-300, 1e17, 1e308, -1e308,
    float("inf"), float("-inf"), None, "x", "", "1e999", b"", b"\x00" * 8, "é" * 50,
]  # fmt: skip
FLOATS = [
    0.0,
    -1.0,
    1e-300,
    1e17,
    1e308,
    -1e308,
    float("nan"),
    float("inf"),
    -90.0,
    90.1,
    180.0,
    361.0,
    5e8,
]
TEXTS = [
    "", "x", "0", "-1", "1", "2", "999", "nan", "inf", "1e308", "1e-300", "1_0", "0x1", "9" * 5000, "moon", "phobos", "earth", "null", "[]", "{}",
    "[" * 5000, '{"rows": 10}', '{"rows": 999999999, "source": "x", "digest": "y"}', '{"radii_m": [1, 2, 3], "model_posting_m": 5}',
    '{"radii_m": [0, 0, 0], "model_posting_m": 0}', "[1, 2]", '["a", "b", "c"]', "\x00", "é", "a" * 100_000, "../../x", "[body]\nname = 1\n", "\ud800",
]  # fmt: skip
TABLES = (
    "control_points", "optnav_records", "optnav_patches", "optnav_meta", "gpkg_contents", "gpkg_spatial_ref_sys", "gpkg_geometry_columns",
    "gpkg_extensions", "rtree_control_points_geom",
)  # fmt: skip
Edit = Callable[[sqlite3.Connection, random.Random], str]


@kind("catalog-damaged", 6.0)
def damaged_catalog(place: Place) -> Case:
    """A catalog with damaged bytes: what is read of it is right or refused, verify says so."""
    name = place.rng.choice(("moon.gpkg", "relief.gpkg", "mesh.gpkg"))
    data, note = damaged(place.material(name), place.rng)
    whole = data == place.material(name)
    place.write("a.gpkg", data)
    return _read(place, note, verified=frozenset({OK} if whole else {DATA}))


@kind("catalog-edited", 5.0)
def edited(place: Place) -> Case:
    """A catalog whose rows were changed; checksums and seal fit."""
    rng = place.rng
    name = rng.choice(("moon.gpkg", "moon.gpkg", "relief.gpkg", "mesh.gpkg"))
    place.write("a.gpkg", place.material(name))
    path = place.folder / "a.gpkg"
    edit: Edit = rng.choice(
        (
            _manifest,
            _manifest,
            _manifest,
            _record,
            _record,
            _record,
            _patch,
            _patch,
            _patch,
            _tile,
            _cell,
            _cell,
            _table,
            _bomb,
        )
    )
    with closing(sqlite3.connect(path, isolation_level=None)) as db:
        db.execute("PRAGMA journal_mode = OFF")
        try:
            note = edit(db, rng)
        except (sqlite3.Error, UnicodeEncodeError, OverflowError) as error:
            note = f"untouched: {error}"
        try:
            _sum_up(db)
        except (sqlite3.Error, ValueError, TypeError, UnicodeEncodeError) as error:
            note += f"; manifest left: {error}"
    try:
        write_seal(path)
    except Exception as error:  # noqa: BLE001 -- whatever is left of it
        note += f"; not sealed: {error}"
    return _read(place, f"{name}: {note}", verified=frozenset({OK, DATA}))


def _sum_up(db: sqlite3.Connection) -> None:
    """Let the manifest's checksum fit, and open its seal."""
    rows = dict(db.execute("SELECT key, value FROM optnav_meta"))
    texts = {str(key): str(value) for key, value in rows.items()}
    fitting = manifest._hash_rows(texts)
    db.execute("UPDATE optnav_meta SET value = ? WHERE key = 'checksum'", (fitting,))
    db.execute("UPDATE optnav_meta SET value = ? WHERE key = 'seal'", (manifest.OPEN_SEAL,))


def _manifest(db: sqlite3.Connection, rng: random.Random) -> str:
    keys = [key for (key,) in db.execute("SELECT key FROM optnav_meta ORDER BY id")]
    key = rng.choice([key for key in keys if key not in ("checksum", "seal")])
    way = rng.random()
    if way < 0.1:
        db.execute("DELETE FROM optnav_meta WHERE key = ?", (key,))
        return f"manifest without {key}"
    if way < 0.2:
        key = rng.choice(("relief", "planes", "extra"))
        text = rng.choice(TEXTS)
        db.execute("INSERT INTO optnav_meta (key, value) VALUES (?, ?)", (key, text))
        return f"manifest with {key} = {text[:40]!r}"
    text = rng.choice(TEXTS)
    db.execute("UPDATE optnav_meta SET value = ? WHERE key = ?", (text, key))
    return f"manifest {key} = {text[:40]!r}"


def _record(db: sqlite3.Connection, rng: random.Random) -> str:
    levels = int(db.execute("SELECT value FROM optnav_meta WHERE key = 'levels'").fetchone()[0])
    layout = record_type(levels)
    number, count, data = db.execute("SELECT id, count, data FROM optnav_records").fetchone()
    records = np.frombuffer(data, layout).copy()
    name = rng.choice(layout.names or ())
    field = records[name]
    spot = tuple(rng.randrange(size) for size in field.shape)
    if field.dtype.kind == "f":
        field[spot] = (
            np.float32(rng.choice(FLOATS)) if field.dtype.itemsize == 4 else rng.choice(FLOATS)
        )
    else:
        field[spot] = rng.choice((0, 1, 2, -1, 5, 255, 2**31 - 1, -(2**31), 41251, 41252))
    changed = records.tobytes()
    if rng.random() < 0.1:
        changed, count = (
            changed[: rng.randrange(len(changed))],
            rng.choice((0, 1, 2, 3, 4096, 2**40)),
        )
    row = (count, compute_checksum(changed), changed, number)
    db.execute("UPDATE optnav_records SET count = ?, checksum = ?, data = ? WHERE id = ?", row)
    return f"record {name}{list(spot)} = {field[spot]}, {len(changed)} bytes, count {count}"


def _patch(db: sqlite3.Connection, rng: random.Random) -> str:
    rows = db.execute(
        "SELECT id, point_id, level, posting_m, size, step, value_offset, data FROM optnav_patches"
    ).fetchall()
    key, point, level, posting, size, step, offset, data = rng.choice(rows)
    which = rng.choice(("posting", "size", "step", "offset", "data", "data"))
    if which == "posting":
        posting = rng.choice(FLOATS)
    elif which == "size":
        size = rng.choice((0, 1, 2, 47, 49, 4096, 4097, 2**31 - 1, -1))
    elif which == "step":
        step = rng.choice(FLOATS)
    elif which == "offset":
        offset = rng.choice(FLOATS)
    else:
        plain = (
            rng.randbytes(2 * size * size)
            if rng.random() < 0.5
            else rng.randbytes(rng.choice((0, 1, 100, 2 * size * size + 1)))
        )
        data = rng.choice(
            (zstandard.ZstdCompressor().compress(plain), plain, b"", damaged(data, rng)[0])
        )
    try:
        header = pack_header(point, level, posting, Encoded(size, step, offset, data))
        total = compute_checksum(header, data)
    except (struct.error, TypeError):
        total = 0
    row = (posting, size, step, offset, total, data, key)
    db.execute(
        "UPDATE optnav_patches SET posting_m = ?, size = ?, step = ?, value_offset = ?, checksum = ?, data = ? WHERE id = ?",
        row,
    )
    return f"patch {key}: {which}, now {posting} {size} {step} {offset}, {len(data)} bytes"


def _bomb(db: sqlite3.Connection, rng: random.Random) -> str:
    """A frame of zeros that states, or has, gigabytes."""
    key, point, level, posting, size, step, offset = db.execute(
        "SELECT id, point_id, level, posting_m, size, step, value_offset FROM optnav_patches"
    ).fetchone()
    if rng.random() < 0.5:
        data = (
            b"\x28\xb5\x2f\xfd\xe0"
            + struct.pack("<Q", rng.choice((2**33, 2**40, 2**62)))
            + b"\x01\x00\x00"
        )
        note = "states gigabytes"
    else:
        part = zstandard.ZstdCompressor(level=1).compress(bytes(1 << 24))
        data, note = part * rng.choice((1, 40)), "has gigabytes"
        size = rng.choice((size, 4096))
    total = compute_checksum(
        pack_header(point, level, posting, Encoded(size, step, offset, data)), data
    )
    db.execute(
        "UPDATE optnav_patches SET size = ?, checksum = ?, data = ? WHERE id = ?",
        (size, total, data, key),
    )
    return f"patch {key} {note}"


def _tile(db: sqlite3.Connection, rng: random.Random) -> str:
    """A tile of the relief, with a checksum that does not fit."""
    if not db.execute("SELECT 1 FROM sqlite_master WHERE name = 'optnav_relief'").fetchone():
        return _patch(db, rng)
    column = rng.choice(
        ("layer", "tile_row", "tile_col", "size", "step", "value_offset", "checksum", "data")
    )
    value = rng.choice(NUMBERS)
    db.execute(
        f"UPDATE optnav_relief SET {column} = ? WHERE id = (SELECT min(id) FROM optnav_relief)",
        (value,),
    )
    return f"relief {column} = {value!r}"


def _cell(db: sqlite3.Connection, rng: random.Random) -> str:
    """A value of any table."""
    table = rng.choice(TABLES)
    columns = [row[1] for row in db.execute(f"PRAGMA table_info({table})")]
    column, value = rng.choice(columns), rng.choice(NUMBERS)
    (number,) = db.execute(f"SELECT min(rowid) FROM {table}").fetchone()
    db.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (value, number))
    return f"{table} {column} = {value!r}"


def _table(db: sqlite3.Connection, rng: random.Random) -> str:
    """A table that is gone, empty, a view, or has other columns."""
    table = rng.choice(TABLES)
    way = rng.choice(
        (
            "DROP TABLE {}",
            "DELETE FROM {}",
            "ALTER TABLE {} RENAME TO other",
            "ALTER TABLE {} ADD COLUMN more TEXT",
            "view",
            "mixed",
            "loop",
        )
    )
    if way == "view":
        db.execute(f"ALTER TABLE {table} RENAME TO other")
        db.execute(f"CREATE VIEW {table} AS SELECT * FROM other")
    elif way == "loop":
        db.execute(f"DROP TABLE {table}")
        db.execute(f"CREATE VIEW {table} AS SELECT * FROM {table}2")
        db.execute(
            f"CREATE VIEW {table}2 AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c LIMIT 1000) SELECT x FROM c"
        )
    elif way == "mixed":
        db.execute(f"ALTER TABLE {table} RENAME TO other")
        db.execute(f"CREATE TABLE {table} (id INTEGER PRIMARY KEY, a TEXT)")
        db.execute(f"INSERT INTO {table} VALUES (1, 'x')")
    else:
        db.execute(way.format(table))
    return f"{table}: {way}"


def _read(place: Place, note: str, *, verified: frozenset[int]) -> Case:
    """A command that reads a.gpkg."""
    rng = place.rng
    job = rng.choice(
        ("info", "info", "verify", "verify", "verify", "nearest", "show", "csv", "geojson", "gpkg", "tif", "glb", "compare", "navigate", "report")
    )  # fmt: skip
    if job == "report" and rng.random() < 0.8:  # a second each
        job = "verify"
    point = str(rng.choice((27858, 27858, 27859, 1)))
    if job == "verify":
        return Case(("-q", "catalog", "verify", "a.gpkg"), verified, note=note)
    if job == "info":
        return Case(("-q", "catalog", "info", "a.gpkg"), READ, note=note)
    if job == "nearest":
        return Case(("-q", "catalog", "nearest", "a.gpkg", "20.5", "11"), READ, note=note)
    if job == "show":
        return Case(
            ("-q", "catalog", "show", "a.gpkg", point, "-o", "new.png"), READ, "new.png", note=note
        )
    if job == "glb":
        return Case(
            ("-q", "catalog", "export", "a.gpkg", "--point", point, "-o", "new.glb"),
            READ,
            "new.glb",
            note=note,
        )
    if job == "compare":
        place.take("moon.gpkg")
        args = ("-q", "catalog", "compare", "a.gpkg", "moon.gpkg", "-o", "new.csv")
        return Case(args, READ, "new.csv", frozenset({OK, DIFFERS}), note=note)
    if job == "navigate":
        folder = rng.choice(("pictures", "near", "limb"))
        place.take(folder)
        args = ("-q", "navigate", folder, "--catalog", "a.gpkg", "-o", "new")
        return Case(args, READ, "new", frozenset({OK, NOTHING}), note=note)
    if job == "report":
        return Case(("-q", "report", "a.gpkg", "-o", "new.html"), READ, "new.html", note=note)
    return Case(
        ("-q", "catalog", "export", "a.gpkg", "-o", f"new.{job}"), READ, f"new.{job}", note=note
    )
