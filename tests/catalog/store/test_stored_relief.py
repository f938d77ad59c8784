"""A relief in the catalog file: what goes in comes out, whatever is damaged is named."""

import hashlib
import json
import sqlite3
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from catalog.arrays import Float32Array
from catalog.errors import DataError, OutputError
from catalog.inspect.compare import compare, require_whole
from catalog.inspect.differences import format_lines, summarise
from catalog.inspect.export import export_relief
from catalog.inspect.summary import catalog_document, describe
from catalog.store import relief as stored
from catalog.store.connection import SealState
from catalog.store.patches import prepare_point
from catalog.store.reader import Catalog
from catalog.store.relief import prepare_relief
from catalog.store.verify import verify
from catalog.store.writer import Written, write_catalog
from catalog.terrain.error_model import TerrainErrorModel
from catalog.terrain.relief.relief import GlobalRelief
from tests.catalog.store.test_format import heights_of, read_as_described

TILE = 16
ROWS = 40  # no whole number of tiles: the last ones reach beyond the grid


def made_relief(seed: int = 3) -> GlobalRelief:
    rng = np.random.default_rng(seed)
    lat = np.linspace(1.5, -1.5, ROWS)[:, None]
    lon = np.linspace(-3.1, 3.1, 2 * ROWS)
    heights = 6000.0 * np.sin(2.0 * lon + lat) * np.cos(lat) + rng.normal(
        0.0, 90.0, (ROWS, 2 * ROWS)
    )
    heights = heights.astype(np.float32)
    max_heights = heights + rng.exponential(80.0, heights.shape).astype(np.float32)
    return GlobalRelief(heights, max_heights, 1737400.0, "first.tif + second.tif")


@pytest.fixture(autouse=True)
def _small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored, "TILE", TILE)


@pytest.fixture
def put(world: Any, tmp_path: Path) -> Callable[..., Written]:
    """Write the points of `world` with a relief."""

    def write(name: str, relief: GlobalRelief | None) -> Written:
        steps = (world.meta.height_step_m,) * world.meta.levels
        points = (prepare_point(point, patches, steps) for point, patches in world.points)
        ready = prepare_relief(relief) if relief is not None else None
        return write_catalog(tmp_path / name, world.meta, points, relief=ready)

    return write


@pytest.fixture
def carried(put: Callable[..., Written]) -> Written:
    return put("carried.gpkg", made_relief())


def edit(path: Path, *statements: str) -> None:
    db = sqlite3.connect(path)
    for statement in statements:
        db.execute(statement)
    db.commit()
    db.close()


def test_heights_come_back_within_half_a_metre_and_tops_as_bounds(carried: Written) -> None:
    true = made_relief()
    with Catalog.open(carried.path) as catalog:
        relief = catalog.relief()
        assert relief is not None
        assert catalog.relief() is relief
    assert (relief.radius_m, relief.source) == (true.radius_m, true.source)
    assert np.abs(relief.heights - true.heights).max() <= 0.5001
    above = relief.max_heights - true.max_heights
    assert above.min() >= -0.5001
    assert above.max() <= 4.5
    assert (relief.max_heights >= relief.heights).all()


def test_the_stated_error_of_its_first_model_comes_with_it(world: Any, tmp_path: Path) -> None:
    error = TerrainErrorModel(28.0, 1.6, 2.0, "test")
    for model, wanted in (("first.tif", 28.0), ("third.tif", None)):
        meta = replace(world.meta, terrain_errors={model: error})
        steps = (meta.height_step_m,) * meta.levels
        points = (prepare_point(point, patches, steps) for point, patches in world.points)
        ready = prepare_relief(made_relief())
        with Catalog.open(write_catalog(tmp_path / model, meta, points, relief=ready).path) as made:
            relief = made.relief()
        assert relief is not None
        assert relief.error_m == wanted


def test_whole_metres_come_back_as_they_are(put: Callable[..., Written]) -> None:
    true = made_relief()
    whole = GlobalRelief(np.rint(true.heights), np.rint(true.heights), true.radius_m, "a")
    with Catalog.open(put("whole.gpkg", whole).path) as catalog:
        relief = catalog.relief()
    assert relief is not None
    np.testing.assert_array_equal(relief.heights, whole.heights)
    np.testing.assert_array_equal(relief.max_heights, whole.heights)


def test_a_catalog_without_one_is_written_without_its_table(
    put: Callable[..., Written], written: Written, carried: Written
) -> None:
    plain = put("plain.gpkg", None)
    assert plain.path.read_bytes() == written.path.read_bytes()
    assert carried.digest != plain.digest
    with Catalog.open(plain.path) as catalog:
        assert catalog.relief() is None
        assert describe(catalog_document(catalog))["relief"] == "none"
    with Catalog.open(carried.path) as catalog:
        assert describe(catalog_document(catalog))["relief"] == (
            "40 x 80 cells of 136455 m, from first.tif + second.tif"
        )


def test_same_relief_same_bytes(put: Callable[..., Written], carried: Written) -> None:
    assert put("again.gpkg", made_relief()).path.read_bytes() == carried.path.read_bytes()


def test_tiles_and_digest_follow_from_the_description(carried: Written) -> None:
    db = sqlite3.connect(carried.path)
    meta = dict(db.execute("SELECT key, value FROM optnav_meta"))
    about = json.loads(meta["relief"])
    rows = about["rows"]
    layers = np.full((2, rows, 2 * rows), np.nan)
    whole = hashlib.sha256()
    for key, layer, i, j, n, step, offset, checksum, data in db.execute(
        "SELECT * FROM optnav_relief ORDER BY id"
    ):
        assert key == 65536 * layer + 256 * i + j
        header = struct.pack("<4q2d", layer, i, j, n, step, offset)
        assert zlib.crc32(header + data) == checksum
        counts, heights = heights_of((n, step, offset, data))
        whole.update(header + counts.tobytes())
        part = layers[layer, i * n : (i + 1) * n, j * n : (j + 1) * n]
        part[:] = heights[: part.shape[0], : part.shape[1]]
    assert whole.hexdigest() == about["digest"]
    read_as_described(carried)
    with Catalog.open(carried.path) as catalog:
        relief = catalog.relief()
    assert relief is not None
    np.testing.assert_array_equal(relief.heights, layers[0])
    np.testing.assert_array_equal(relief.max_heights, layers[0] + layers[1])


def test_verify_reads_it_and_finds_it_whole(carried: Written) -> None:
    found = verify(carried.path)
    assert found.sound, found.problems
    assert found.computed == carried.digest
    assert found.seal is SealState.WHOLE


DAMAGE = {
    "UPDATE optnav_relief SET data = substr(data, 1, length(data) / 2) WHERE id = 258": (
        "relief, means, tile 1, 2",
        "does not fit its checksum",
    ),
    "DELETE FROM optnav_relief WHERE id = 65537": ("relief, tops, tile 0, 1", "is missing"),
    "UPDATE optnav_relief SET step = 2.0 WHERE id = 0": (
        "relief, means, tile 0, 0",
        "does not fit its checksum",
    ),
    "UPDATE optnav_relief SET size = 'x' WHERE id = 1": (
        "relief, means, tile 0, 1",
        "its row of optnav_relief is damaged",
    ),
    "DROP TABLE optnav_relief": ("relief, means, tile 0, 0", "no such table: optnav_relief"),
}


@pytest.mark.parametrize(("statement", "told"), DAMAGE.items())
def test_a_damaged_tile_is_named(carried: Written, statement: str, told: tuple[str, str]) -> None:
    edit(carried.path, statement)
    found = verify(carried.path)
    assert told in [(problem.where, problem.what) for problem in found.problems]
    assert found.computed != found.stated
    with (
        Catalog.open(carried.path) as catalog,
        pytest.raises(DataError, match=rf"{told[0]}: {told[1]}; run `optnav catalog verify`"),
    ):
        catalog.relief()
    with pytest.raises(DataError, match="relief"):
        require_whole(carried.path)


def test_tiles_of_another_relief_are_told(put: Callable[..., Written], carried: Written) -> None:
    """Every tile is whole, but they are not those that the manifest speaks of."""
    other = put("other.gpkg", made_relief(seed=4))
    edit(
        carried.path,
        f"ATTACH '{other.path}' AS other",
        "DELETE FROM optnav_relief",
        "INSERT INTO optnav_relief SELECT * FROM other.optnav_relief",
    )
    found = verify(carried.path)
    assert {problem.where for problem in found.problems} >= {"optnav_relief", "digest"}


def test_a_tile_too_many_is_told(carried: Written) -> None:
    edit(
        carried.path,
        "INSERT INTO optnav_relief SELECT id + 99, layer, 9, 9, size, step, value_offset, "
        "checksum, data FROM optnav_relief LIMIT 1",
    )
    assert "optnav_relief" in [problem.where for problem in verify(carried.path).problems]


def test_compare_measures_reliefs(put: Callable[..., Written], carried: Written) -> None:
    true = made_relief()
    heights = np.rint(true.heights)
    heights[5, 7] += 30.0
    first = put(
        "a.gpkg", GlobalRelief(np.rint(true.heights), true.max_heights + 40, 1737400.0, "a")
    )
    second = put("b.gpkg", GlobalRelief(heights, true.max_heights + 40, 1737400.0, "a"))
    found = compare(first.path, second.path)
    assert not found.same
    assert found.relief is not None
    assert (found.relief.cells, found.relief.mean_max_m) == (1, 30.0)
    assert found.relief.mean_rms_m == pytest.approx(30.0 / np.sqrt(2 * ROWS * ROWS))
    assert "settings: 1" in summarise(found)
    told = "\n".join(format_lines(found))
    assert "relief: 1 cells, means max 30.000 m" in told
    assert "setting: relief: 40 rows of a (" in told
    plain = put("plain.gpkg", None)
    assert "-> none" in "\n".join(format_lines(compare(carried.path, plain.path)))
    again = put("again.gpkg", true)
    assert compare(carried.path, again.path).same


def test_gdal_reads_the_export_where_it_lies(carried: Written, tmp_path: Path) -> None:
    path = tmp_path / "relief.tif"
    with Catalog.open(carried.path) as catalog:
        assert export_relief(catalog, path) == ROWS
        relief = catalog.relief()
        export_relief(catalog, path)  # once more, over its own
    assert relief is not None
    with rasterio.open(path) as file:
        assert file.crs.is_geographic
        spheroid = file.crs.to_dict()
        assert spheroid.get("R", spheroid.get("a")) == 1737400.0
        assert file.bounds == (-180.0, -90.0, 180.0, 90.0)
        assert file.descriptions == ("mean height, m", "highest place, m")
        sample: Float32Array = next(iter(file.sample([(10.0, 50.0)])))
        np.testing.assert_array_equal(file.read(1), relief.heights)
        np.testing.assert_array_equal(file.read(2), relief.max_heights)
    row, col = int(40.0 / 4.5), int(190.0 / 4.5)
    assert tuple(sample) == (relief.heights[row, col], relief.max_heights[row, col])


def test_an_export_is_refused_with_a_reason(
    carried: Written, put: Callable[..., Written], tmp_path: Path
) -> None:
    with Catalog.open(put("plain.gpkg", None).path) as catalog, pytest.raises(
        DataError, match=r"carries no relief; name a terrain model .* \[relief\] dem"
    ):  # fmt: skip
        export_relief(catalog, tmp_path / "relief.tif")
    notes = tmp_path / "notes.tif"
    notes.write_text("mine")
    with Catalog.open(carried.path) as catalog, pytest.raises(OutputError, match="not made by"):
        export_relief(catalog, notes)
