"""The README's description of the format is enough: a catalog read with nothing of ours."""

import hashlib
import json
import sqlite3
import struct
import zlib
from typing import Any

import numpy as np
import zstandard

from catalog.arrays import FloatArray, Int16Array
from catalog.geometry.projection import make_node_grid
from catalog.store.reader import Catalog
from catalog.store.writer import Written

Row = tuple[Any, ...]


def heights_of(row: Row) -> tuple[Int16Array, FloatArray]:
    """Counts and heights of a row (size, step, value_offset, data)."""
    size, step, offset, data = row
    raw = zstandard.ZstdDecompressor().decompress(data, max_output_size=2 * size * size)
    high, low = np.frombuffer(raw, np.uint8).reshape(2, size, size).astype(np.int64)
    f = 256 * high + low
    r = np.where(f % 2 == 0, f // 2, -(f + 1) // 2)
    sums = np.cumsum(np.cumsum(r, axis=1), axis=0) % 65536
    counts = np.where(sums < 32768, sums, sums - 65536).astype("<i2")
    return counts, np.where(counts == -32768, np.nan, offset + step * counts)


def test_records_patches_and_digest_follow_from_the_description(written: Written) -> None:
    read_as_described(written)


def read_as_described(written: Written) -> None:
    """Read all of a catalog but its relief; its digest must come out."""
    db = sqlite3.connect(written.path)
    meta = dict(db.execute("SELECT key, value FROM optnav_meta"))
    covered = sorted(set(meta) - {"checksum", "seal"})
    text = "".join(f"{key}\n{meta[key]}\n" for key in covered)
    assert hashlib.sha256(text.encode()).hexdigest() == meta["checksum"]
    data = written.path.read_bytes()
    counter, stated = meta["seal"].split(":")
    open_file = data.replace(meta["seal"].encode(), b"0" * 8 + b":" + b"0" * 64)
    assert (data[24:28].hex(), hashlib.sha256(open_file).hexdigest()) == (counter, stated)
    levels = int(meta["levels"])
    record = struct.Struct(f"<q6d5i{levels}f36f")
    sources = json.loads(meta["point_sources"])
    points = b""
    with Catalog.open(written.path) as catalog:
        for count, checksum, data in db.execute(
            "SELECT count, checksum, data FROM optnav_records ORDER BY id"
        ):
            assert (zlib.crc32(data), count * record.size) == (checksum, len(data))
            for number in range(count):
                packed = data[number * record.size : (number + 1) * record.size]
                values = record.unpack(packed)
                point = catalog.point(values[0])
                assert values[1:4] == (point.lat_deg, point.lon_deg, point.radius_m)
                assert values[7:10] == (point.trials, int(point.flags), int(point.usable))
                assert sources[values[11]] == point.source
                assert np.allclose(values[12 : 12 + levels], point.uniqueness, atol=1e-6)
                points += hashlib.sha256(packed + patches_digest(db, catalog, values[0])).digest()
    numbers = {"cell_deg", "height_step_m", "posting_m", "radius_m", "count", "levels", "size"}
    content = {key: json.loads(meta[key]) for key in numbers | {"point_sources"}}
    content |= {key: meta[key] for key in ("body", "projection")}
    if "relief" in meta:
        content["relief"] = json.loads(meta["relief"])
    line = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert hashlib.sha256(line.encode() + b"\n" + points).hexdigest() == meta["digest"]
    db.close()


def patches_digest(db: sqlite3.Connection, catalog: Catalog, number: int) -> bytes:
    """Digest of a point's patches; compares their heights with the reader's on the way."""
    whole = hashlib.sha256()
    patches = catalog.patches(number)
    for level, patch in enumerate(patches):
        posting, size, step, offset, checksum, data = db.execute(
            "SELECT posting_m, size, step, value_offset, checksum, data FROM optnav_patches "
            "WHERE id = ?",
            (256 * number + level,),
        ).fetchone()
        header = struct.pack("<4q3d", number, 0, level, size, posting, step, offset)
        assert zlib.crc32(header + data) == checksum
        counts, heights = heights_of((size, step, offset, data))
        assert np.array_equal(heights.astype(np.float32), patch.heights_m, equal_nan=True)
        whole.update(header + counts.tobytes())
    return whole.digest()


def test_directions_of_nodes_follow_from_the_description(written: Written) -> None:
    with Catalog.open(written.path) as catalog:
        point, radius = next(catalog.points()), catalog.meta.radius_m
        posting, n = catalog.meta.posting_m, catalog.meta.size
    row, col = np.mgrid[:n, :n]
    x, y = (col - (n - 1) / 2) * posting, ((n - 1) / 2 - row) * posting
    u, v = x / (2 * radius), y / (2 * radius)
    s = 1 + u**2 + v**2
    local = np.stack([2 * u, 2 * v, 2 - s], axis=-1) / s[..., None]
    projection = point.projection(radius)
    ours = projection.local_directions(*make_node_grid(n, posting))
    assert np.allclose(local, ours, atol=1e-15)
