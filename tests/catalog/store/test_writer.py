"""Writing a catalog: what it keeps, and what it does to the place it is written to."""

import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from catalog.errors import OutputError
from catalog.store.reader import Catalog
from catalog.store.records import round_point
from catalog.store.writer import Written
from tests.catalog.store.written import write_points


def test_points_and_patches_come_back(world: Any, written: Written) -> None:
    with Catalog.open(written.path) as catalog:
        assert catalog.ids.tolist() == [point.id for point, _ in world.points]
        for point, patches in world.points:
            assert catalog.point(point.id) == round_point(point)
            back = catalog.patches(point.id)
            assert [p.posting_m for p in back] == [round(p.posting_m, 6) for p in patches]
            for one, other in zip(patches, back, strict=True):
                assert np.array_equal(np.isnan(one.heights_m), np.isnan(other.heights_m))
                assert np.nanmax(np.abs(one.heights_m - other.heights_m)) <= 0.2502


def test_rounding_moves_a_point_by_millimetres_only(world: Any) -> None:
    for point, _ in world.points:
        assert np.linalg.norm(round_point(point).xyz_m - point.xyz_m) < 0.004


def test_unknown_numbers_come_back_as_unknown(make: Callable[..., Any], tmp_path: Path) -> None:
    world = make(count=1)
    point, patches = world.points[0]
    odd = replace(
        point,
        radius_m=float("nan"),
        usable=False,
        recognition_rate=float("nan"),
        localisation_nodes=float("inf"),
        uniqueness=(float("nan"),) * 3,
        shadow_limit_deg=(),
    )
    path = tmp_path / "c.gpkg"
    write_points(path, world.meta, [(odd, patches)])
    with Catalog.open(path) as catalog:
        back = catalog.point(point.id)
    assert np.isnan(back.radius_m)
    assert np.isnan([back.recognition_rate, back.localisation_nodes, *back.uniqueness]).all()
    assert np.isnan(back.shadow_limit_deg).all()


def test_the_manifest_comes_back(world: Any, written: Written) -> None:
    with Catalog.open(written.path) as catalog:
        meta = catalog.meta
    assert meta.sources == world.meta.sources
    assert meta.config == world.meta.config
    assert (meta.count, meta.usable) == (written.count, written.usable)
    assert meta.digest == written.digest
    assert set(meta.point_sources) == {"first.tif", "zweite Höhe.tif"}


def test_the_same_content_gives_the_same_file(world: Any, written: Written, tmp_path: Path) -> None:
    again = world.write(tmp_path / "again.gpkg")
    assert again.path.read_bytes() == written.path.read_bytes()


def test_the_digest_does_not_know_time_place_or_program(
    world: Any, written: Written, tmp_path: Path
) -> None:
    meta = replace(
        world.meta, created_utc="2031-01-01T00:00:00Z", software="optnav 9", config="", sources={}
    )
    assert write_points(tmp_path / "x.gpkg", meta, world.points).digest == written.digest


def changed_worlds(world: Any) -> Iterator[tuple[str, Any, Any]]:
    point, patches = world.points[4]
    heights = patches[1].heights_m.copy()
    heights[20, 20] += 0.6
    moved = (patches[0], replace(patches[1], heights_m=heights), patches[2])
    yield "a height", world.meta, (point, moved)
    yield "a place", world.meta, (replace(point, lat_deg=point.lat_deg + 2e-7), patches)
    yield "a rate", world.meta, (replace(point, recognition_rate=0.55), patches)
    yield "a flag", world.meta, (replace(point, flags=point.flags ^ 2), patches)
    yield "a source", world.meta, (replace(point, source="third"), patches)
    yield "the posting", replace(world.meta, posting_m=118.5), (point, patches)
    yield "the body", replace(world.meta, body="phobos"), (point, patches)


def test_any_change_of_content_changes_the_digest(
    world: Any, written: Written, tmp_path: Path
) -> None:
    digests = {"unchanged": written.digest}
    for name, meta, changed in changed_worlds(world):
        points = [*world.points[:4], changed, *world.points[5:]]
        digests[name] = write_points(tmp_path / "x.gpkg", meta, points).digest
    assert len(set(digests.values())) == len(digests)


def test_differences_in_the_last_bits_do_not_change_the_digest(
    world: Any, written: Written, tmp_path: Path
) -> None:
    points = [
        (replace(point, localisation_nodes=point.localisation_nodes * (1 + 1e-13)), patches)
        for point, patches in world.points
    ]
    assert write_points(tmp_path / "x.gpkg", world.meta, points).digest == written.digest


def test_points_out_of_order_or_outside_their_cells_are_refused(world: Any, tmp_path: Path) -> None:
    path = tmp_path / "x.gpkg"
    with pytest.raises(ValueError, match="ascend"):
        write_points(path, world.meta, world.points[::-1])
    point, patches = world.points[0]
    astray = replace(point, lat_deg=-point.lat_deg)
    with pytest.raises(ValueError, match="not in its cell"):
        write_points(path, world.meta, [(astray, patches)])
    nowhere = replace(point, usable=True, radius_m=float("nan"))
    with pytest.raises(ValueError, match="radius is unknown"):
        write_points(path, world.meta, [(nowhere, patches)])
    with pytest.raises(ValueError, match="patches"):
        write_points(path, world.meta, [(replace(point, usable=True), patches[:2])])
    assert list(tmp_path.iterdir()) == []


def test_a_point_that_is_not_usable_may_have_no_patches(world: Any, tmp_path: Path) -> None:
    point = replace(world.points[0][0], usable=False)
    write_points(tmp_path / "x.gpkg", world.meta, [(point, ())])
    with Catalog.open(tmp_path / "x.gpkg") as catalog:
        assert catalog.patches(point.id) == ()


def test_a_catalog_without_points_can_be_written(world: Any, tmp_path: Path) -> None:
    write_points(tmp_path / "x.gpkg", world.meta, [])
    with Catalog.open(tmp_path / "x.gpkg") as catalog:
        assert len(catalog) == 0


def test_the_old_catalog_stays_whole_when_the_new_one_fails(world: Any, catalog_copy: Path) -> None:
    before = catalog_copy.read_bytes()

    def failing() -> Iterator[Any]:
        yield world.points[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_points(catalog_copy, world.meta, failing())
    assert catalog_copy.read_bytes() == before
    assert list(catalog_copy.parent.iterdir()) == [catalog_copy]


def test_a_damaged_catalog_of_ours_is_replaced(
    world: Any, written: Written, catalog_copy: Path
) -> None:
    catalog_copy.write_bytes(catalog_copy.read_bytes()[:70_000])
    assert world.write(catalog_copy).digest == written.digest


def test_the_log_of_another_program_is_not_applied_to_the_new_file(
    world: Any, catalog_copy: Path
) -> None:
    log = catalog_copy.with_name(catalog_copy.name + "-wal")
    log.write_bytes(b"of the old file")
    world.write(catalog_copy)
    assert not log.exists()


def test_files_of_others_are_left_alone(world: Any, tmp_path: Path) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("do not lose me")
    database = tmp_path / "other.sqlite"
    with sqlite3.connect(database) as db:
        db.execute("CREATE TABLE mine (x)")
    db.close()
    for path in (notes, database, tmp_path):
        with pytest.raises(OutputError):
            world.write(path)
    assert notes.read_text() == "do not lose me"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["notes.txt", "other.sqlite"]


def test_an_impossible_place_is_told(world: Any, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"c\.gpkg"):
        world.write(tmp_path / "file" / "c.gpkg")
    with pytest.raises(OutputError, match="not a name"):
        world.write(Path("/"))


def test_a_missing_folder_is_made(world: Any, tmp_path: Path) -> None:
    world.write(tmp_path / "missing" / "c.gpkg")
    assert [p.name for p in (tmp_path / "missing").iterdir()] == ["c.gpkg"]


def test_a_link_stays_and_the_file_that_it_names_is_replaced(world: Any, tmp_path: Path) -> None:
    (tmp_path / "real.gpkg").touch()
    (tmp_path / "link.gpkg").symlink_to("real.gpkg")
    world.write(tmp_path / "link.gpkg")
    assert (tmp_path / "link.gpkg").is_symlink()
    assert not (tmp_path / "real.gpkg").is_symlink()


FULL_DISK = """
import resource, sys
from pathlib import Path
from catalog.errors import OutputError
from tests.catalog.made_catalogs import make_world
world = make_world(seed=8)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
try:
    world.write(Path(sys.argv[1]))
except OutputError as error:
    print("told:", error)
"""


def test_a_full_disk_is_told_and_the_old_catalog_is_whole(catalog_copy: Path) -> None:
    """A limit on the size of files stands in for a full disk; both fail in write()."""
    before = catalog_copy.read_bytes()
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(catalog_copy)],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"told: {catalog_copy}: cannot be written")
    assert catalog_copy.read_bytes() == before
    assert list(catalog_copy.parent.iterdir()) == [catalog_copy]
