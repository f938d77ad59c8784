"""What two catalogs say apart is found, measured and told; damage is never called a difference."""

import csv
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard

from catalog.arrays import FloatArray
from catalog.control_point import Flag, Patch
from catalog.errors import DataError, OutputError
from catalog.geometry.latlon import angular_distance
from catalog.inspect.compare import Comparison, compare, require_whole
from catalog.inspect.differences import SHOWN, format_lines, summarise, write_table
from catalog.store.reader import Catalog
from catalog.store.writer import Written

RADIUS_M = 1737400.0


@pytest.fixture
def against(world: Any, written: Written, tmp_path: Path) -> Callable[..., Comparison]:
    """Compare the catalog of `world` with one of changed points or another manifest."""

    def run(points: Any = None, **meta: Any) -> Comparison:
        kind = type(world)
        other = kind(replace(world.meta, **meta), world.points if points is None else points)
        return compare(written.path, other.write(tmp_path / "other.gpkg").path)

    return run


def text_of(found: Comparison) -> str:
    return "\n".join(format_lines(found))


def changed(world: Any, rows: dict[int, Any]) -> list[Any]:
    """The points of a world, some rows of them replaced (None: left out)."""
    points = [rows.get(row, pair) for row, pair in enumerate(world.points)]
    return [pair for pair in points if pair is not None]


def test_time_program_config_and_hashes_are_told_but_are_no_content(
    against: Callable[..., Comparison],
) -> None:
    found = against(
        created_utc="2030-01-01T00:00:00Z",
        software="optnav 9.9",
        config='[body]\nname = "moon"\n[check]\ntrials = 7\n',
        sources={"first.tif": "sha256 22", "zweite Höhe.tif": "sha256 11"},
    )
    assert found.same
    assert summarise(found) == ""
    told = text_of(found)
    assert "not content: software: optnav test -> optnav 9.9" in told
    assert "not content: created_utc: 2026-01-02T03:04:05Z -> 2030-01-01T00:00:00Z" in told
    assert "not content: source first.tif: sha256 00 -> sha256 22" in told
    assert "not content: config check.trials: none -> 7" in told
    assert "zweite" not in told


def test_a_config_that_is_quite_another_is_cut_short(against: Callable[..., Comparison]) -> None:
    found = against(config="".join(f"key_{n} = {n}\n" for n in range(30)))
    told = [line for line in format_lines(found) if line.startswith("not content: ")]
    assert len(told) == SHOWN + 1
    assert told[-1] == f"not content: and {31 - SHOWN} more"  # and [body] name, which is gone


def test_points_in_one_catalog_only_are_named(
    world: Any, against: Callable[..., Comparison]
) -> None:
    found = against(changed(world, {2: None, 5: None}))
    gone = [world.points[2][0].id, world.points[5][0].id]
    assert found.first.only["id"].tolist() == gone
    assert not len(found.second.only)
    assert not len(found.ids)
    assert summarise(found) == "points only in whole.gpkg: 2"
    assert f"  {gone[0]}: at " in text_of(found)


def test_moved_points_are_told_by_distance_the_farthest_first(
    world: Any, against: Callable[..., Comparison]
) -> None:
    rows, wanted = {}, {}
    for row, step in ((1, 0.001), (4, 0.02), (7, 0.00001)):
        point, patches = world.points[row]
        place = (point.lat_deg + (step if point.lat_deg < 0.0 else -step), point.lon_deg)
        rows[row] = (replace(point, lat_deg=place[0]), patches)
        angle = angular_distance(*np.radians((point.lat_deg, point.lon_deg)), *np.radians(place))
        wanted[point.id] = float(angle) * RADIUS_M
    found = against(changed(world, rows))
    assert found.ids.tolist() == sorted(wanted)
    # places are rounded to 1e-7 degrees: 3 mm
    assert found.moved_m == pytest.approx([wanted[i] for i in sorted(wanted)], abs=0.01)
    assert found.moved_m.min() < 0.4
    told = text_of(found).splitlines()
    first = next(n for n, line in enumerate(told) if line.startswith("moved: 3 points, median 30."))
    assert [int(line.split(":")[0]) for line in told[first + 1 : first + 4]] == sorted(
        wanted, key=lambda i: -wanted[i]
    )


def test_changed_heights_are_measured(
    world: Any, against: Callable[..., Comparison], written: Written, tmp_path: Path
) -> None:
    point, patches = world.points[3]
    rng = np.random.default_rng(6)
    heights = [patch.heights_m.copy() for patch in patches]
    heights[0] += rng.normal(0.0, 4.0, heights[0].shape).astype(np.float32)
    heights[1][20, 20] += 31.0
    heights[2][:2, -3:] = np.nan
    other = tuple(Patch(p.posting_m, h) for p, h in zip(patches, heights))
    found = against(changed(world, {3: (point, other)}))
    assert found.ids.tolist() == [point.id]
    with Catalog.open(written.path) as a, Catalog.open(tmp_path / "other.gpkg") as b:
        pairs = zip(a.patches(point.id), b.patches(point.id))
        apart: FloatArray = np.concatenate(
            [(p.heights_m.astype(float) - q.heights_m).ravel() for p, q in pairs]
        )
    known = apart[np.isfinite(apart)]
    assert found.height_max_m == pytest.approx([np.abs(known).max()])
    assert found.height_max_m[0] == pytest.approx(31.0, abs=1.0)
    assert found.height_rms_m == pytest.approx([np.sqrt(np.mean(known**2))])
    assert found.holes.tolist() == [6]
    assert "6 nodes with a height in one only" in text_of(found)
    assert summarise(found) == "other heights in place: 1"


def test_heights_of_moved_points_are_not_compared(
    world: Any, against: Callable[..., Comparison]
) -> None:
    point, patches = world.points[3]
    moved = replace(point, lon_deg=point.lon_deg + 1e-3)
    other = tuple(Patch(p.posting_m, p.heights_m + 100.0) for p in patches)
    found = against(changed(world, {3: (moved, other)}))
    assert np.isnan(found.height_max_m).all()
    assert summarise(found) == "moved: 1"
    assert "heights of points" not in text_of(found)


def test_use_reasons_certificates_and_terrain_models_are_told(
    world: Any, against: Callable[..., Comparison]
) -> None:
    usable = next(n for n, (p, _) in enumerate(world.points) if p.usable)
    rejected = next(n for n, (p, _) in enumerate(world.points) if not p.usable)
    plain = next(n for n, (p, _) in enumerate(world.points) if n not in (usable, rejected))
    (a, pa), (b, pb), (c, pc) = (world.points[n] for n in (usable, rejected, plain))
    other = "first.tif" if c.source != "first.tif" else "zweite Höhe.tif"
    found = against(
        changed(
            world,
            {
                usable: (replace(a, usable=False, flags=Flag.FLAT | Flag.SHADOWED), pa),
                rejected: (replace(b, usable=True, flags=Flag.NONE), pb),
                plain: (
                    replace(
                        c,
                        recognition_rate=c.recognition_rate / 2.0 + 0.1,
                        uniqueness=(*c.uniqueness[:-1], c.uniqueness[-1] + 0.25),
                        localisation_nodes=float("nan"),
                        source=other,
                        radius_m=c.radius_m - 2.5,
                    ),
                    pc,
                ),
            },
        )
    )
    told = text_of(found).splitlines()
    assert "no longer usable: 1 point" in told
    assert f"  {a.id}: usable -> not usable (flat, shadowed)" in told
    assert "newly usable: 1 point" in told
    assert "other terrain model: 1 point" in told
    assert f"  {c.id}: {c.source} -> {other}" in told
    assert "localisation_nodes: 1 point, 1 known in one only" in told
    assert "uniqueness: 1 point, median 0.25, max 0.25" in told
    assert f"  {c.id}: -2.500 m" in told
    assert any(line.startswith("recognition_rate: 1 point") for line in told)
    assert not any(line.startswith(("trials", "shadow", "heights", "moved")) for line in told)


def test_many_differences_are_cut_short_and_the_table_has_all(
    make: Callable[..., Any], tmp_path: Path
) -> None:
    world = make(seed=3, count=40, size=16)
    old = world.write(tmp_path / "old.gpkg").path
    kept = [(replace(p, radius_m=p.radius_m + n), q) for n, (p, q) in enumerate(world.points)][:-2]
    new = type(world)(world.meta, kept).write(tmp_path / "new.gpkg").path
    found = compare(old, new)
    told = text_of(found).splitlines()
    assert "radius of points in place: 37 points, median 19, max 37 m" in told
    assert f"  and {37 - SHOWN} more" in told
    assert write_table(found, tmp_path / "all.csv") == 39
    with (tmp_path / "all.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["id"]) for row in rows] == [p.id for p, _ in world.points[1:]]
    assert [row["change"] for row in rows] == ["differs"] * 37 + ["only in first"] * 2
    assert [float(row["radius_change_m"]) for row in rows[:37]] == list(range(1, 38))
    write_table(found, tmp_path / "all.csv")  # its own table may be replaced
    (tmp_path / "all.csv").write_text("notes")
    with pytest.raises(OutputError, match="not made by optnav"):
        write_table(found, tmp_path / "all.csv")


def test_settings_that_differ_are_told_and_points_compared_where_ids_mean_the_same(
    world: Any, against: Callable[..., Comparison], make: Callable[..., Any], tmp_path: Path
) -> None:
    found = against(posting_m=200.0)
    assert "setting: posting_m: 118.45 -> 200.0" in text_of(found)
    assert (found.comparable, summarise(found)) == (True, "settings: 1")
    finer = make(seed=7, count=12, cell_deg=5.0).write(tmp_path / "finer.gpkg").path
    found = compare(tmp_path / "other.gpkg", finer)
    assert not found.comparable
    assert not len(found.ids)
    assert not len(found.first.only)
    assert "not compared" in text_of(found)


def test_catalogs_of_more_and_fewer_levels_are_compared_in_what_both_have(
    world: Any, against: Callable[..., Comparison]
) -> None:
    fewer = [(replace(p, uniqueness=p.uniqueness[:2]), q[:2]) for p, q in world.points]
    found = against(fewer, levels=2)
    assert "setting: levels: 3 -> 2" in text_of(found)
    assert found.patches.all()
    assert found.height_max_m.tolist() == [0.0] * len(world.points)
    assert not found.mark_changed("uniqueness").any()


def edit(path: Path, statement: str, values: tuple[object, ...] = ()) -> None:
    db = sqlite3.connect(path)
    db.execute(statement, values)
    db.commit()
    db.close()


def test_the_same_heights_packed_in_another_way_are_the_same(
    written: Written, catalog_copy: Path
) -> None:
    from catalog.store.patches import pack_header
    from catalog.store.records import compute_checksum

    db = sqlite3.connect(catalog_copy)
    key, data = db.execute("SELECT id, data FROM optnav_patches LIMIT 1 OFFSET 4").fetchone()
    row = db.execute(
        "SELECT point_id, level, posting_m, size, step, value_offset FROM optnav_patches "
        "WHERE id = ?",
        (key,),
    ).fetchone()
    db.close()
    from catalog.store.codec import Encoded

    raw = zstandard.ZstdDecompressor().decompress(data, max_output_size=1 << 20)
    again = zstandard.ZstdCompressor(level=19).compress(raw)
    assert again != data
    edit(
        catalog_copy,
        "UPDATE optnav_patches SET data = ?, checksum = ? WHERE id = ?",
        (again, compute_checksum(pack_header(*row[:3], Encoded(*row[3:], again)), again), key),
    )
    assert compare(written.path, catalog_copy).same


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE optnav_patches SET data = zeroblob(900) WHERE level = 2",
        "DELETE FROM optnav_patches WHERE level = 1",
        "UPDATE optnav_records SET checksum = checksum + 1",
        "UPDATE optnav_meta SET value = '99' WHERE key = 'count'",
    ],
)
def test_a_damaged_catalog_is_refused_on_either_side(
    statement: str, written: Written, catalog_copy: Path
) -> None:
    edit(catalog_copy, statement)
    for pair in ((written.path, catalog_copy), (catalog_copy, written.path)):
        with pytest.raises(DataError, match=r"copy\.gpkg"):
            compare(*pair)
    with pytest.raises(DataError, match=r"copy\.gpkg"):
        require_whole(catalog_copy)


def test_a_digest_that_is_not_that_of_the_content_is_told(
    written: Written, catalog_copy: Path
) -> None:
    """Patches of two points exchanged, with their checksums made anew."""
    from catalog.store.codec import Encoded
    from catalog.store.patches import pack_header
    from catalog.store.records import compute_checksum

    db = sqlite3.connect(catalog_copy)
    (key, number, size, posting, step, offset, data) = db.execute(
        "SELECT id, point_id, size, posting_m, step, value_offset, data FROM optnav_patches "
        "WHERE level = 0 LIMIT 1"
    ).fetchone()
    db.close()
    moved = Encoded(size, step, offset + 1.0, data)
    sum_ = compute_checksum(pack_header(number, 0, posting, moved), data)
    edit(
        catalog_copy,
        "UPDATE optnav_patches SET value_offset = ?, checksum = ? WHERE id = ?",
        (offset + 1.0, sum_, key),
    )
    with pytest.raises(DataError, match="a digest that they state"):
        compare(written.path, catalog_copy)
