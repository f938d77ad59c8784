"""Which cells a build works on, and how they are cut into chunks."""

import numpy as np
import pytest
from rasterio.transform import Affine

from catalog.errors import DataError, UsageError
from catalog.geometry.cells import CellGrid
from catalog.jobs.usage import StageAccount
from catalog.jobs.workspace import Workspace
from catalog.pipeline.config import BodySettings, BuildConfig, DemSection
from catalog.pipeline.context import IngestRun
from catalog.pipeline.ingest import BLOCK_CELLS, cut_chunks, find_covered_cells, ingest
from catalog.progress import SilentProgress
from catalog.terrain.dem.mosaic import Mosaic
from catalog.terrain.dem.source import DemSettings


def mosaic_of(moon, folder, path) -> Mosaic:
    one = DemSettings(path=path.name)
    return Mosaic.from_files([one], path.parent, moon, folder / "overviews")


def test_a_global_model_covers_every_cell(tmp_path, dems, moon):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(180).astype(np.float32))
    cells = find_covered_cells(mosaic_of(moon, tmp_path, path), CellGrid(1.0), None)
    np.testing.assert_array_equal(cells, np.arange(41_252))


def test_a_region_covers_the_cells_it_touches(tmp_path, dems, moon):
    values, affine = dems.rough_region(300)  # 6° about 10 N 20 E
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    grid = CellGrid(1.0)
    cells = find_covered_cells(mosaic_of(moon, tmp_path, path), grid, None)
    middles = np.array([grid.centre_deg(int(cell)) for cell in cells])
    assert 36 <= cells.size <= 64
    assert np.abs(middles - [10.0, 20.0]).max() < 3.6
    # and none with its middle well inside is forgotten
    inside = grid.find_cells_in_bbox(17.6, 7.6, 22.4, 12.4)
    assert np.isin(inside, cells).all()


def test_a_small_region_of_small_cells_asks_its_latitudes_only(tmp_path, dems, moon, monkeypatch):
    """A body has a million cells of 0.2 deg; a model of 6 deg needs no question of the others."""
    values, affine = dems.rough_region(300)
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    mosaic, asked = mosaic_of(moon, tmp_path, path), []
    covers = mosaic.covers
    monkeypatch.setattr(mosaic, "covers", lambda *a: (asked.append(len(a[0])), covers(*a))[1])
    cells = find_covered_cells(mosaic, CellGrid(0.2), None)
    assert cells.size > 800
    assert sum(asked) < 60_000


def test_a_hole_in_the_middle_of_a_cell_does_not_drop_it(tmp_path, dems, moon):
    values, affine = dems.rough_region(300)
    values[140:160, 140:160] = np.nan
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    grid = CellGrid(1.0)
    cells = find_covered_cells(mosaic_of(moon, tmp_path, path), grid, None)
    assert int(grid.find_cells(10.0, 20.0)) in cells


def test_a_bbox_crosses_180_degrees_where_west_is_greater(tmp_path, dems, moon):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(180).astype(np.float32))
    grid = CellGrid(5.0)
    cells = find_covered_cells(mosaic_of(moon, tmp_path, path), grid, (170.0, -10.0, -170.0, 10.0))
    lon = np.array([grid.centre_deg(int(cell))[1] for cell in cells])
    assert cells.size == 16
    assert (np.abs(lon) > 170.0).all()


@pytest.mark.parametrize(
    "bbox", [(0.0, 10.0, 5.0, -10.0), (0.0, -95.0, 5.0, 0.0), (3.0, 0.0, 3.0, 5.0)]
)
def test_a_bbox_that_is_none_is_refused(tmp_path, dems, moon, bbox):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(180).astype(np.float32))
    with pytest.raises(UsageError, match="W,S,E,N"):
        find_covered_cells(mosaic_of(moon, tmp_path, path), CellGrid(5.0), bbox)


def test_a_bbox_outside_the_model_names_what_the_model_covers(tmp_path, dems, moon):
    values, affine = dems.rough_region(100)
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    with pytest.raises(DataError, match=r"--bbox 100,0,120,20 .*r.tif covers 19,9,21,11"):
        find_covered_cells(
            mosaic_of(moon, tmp_path, path), CellGrid(1.0), (100.0, 0.0, 120.0, 20.0)
        )


def test_chunks_hold_every_cell_once_and_neighbours_together():
    grid = CellGrid(1.0)
    chunks = cut_chunks(grid, np.arange(grid.total))
    assert sorted(cell for chunk in chunks for cell in chunk) == list(range(grid.total))
    assert max(map(len, chunks)) == 256
    for chunk in chunks[50:150:10]:  # away from the poles a chunk is a compact block
        lat, lon = np.array([grid.centre_deg(cell) for cell in chunk]).T
        assert np.ptp(lat) < 2 * BLOCK_CELLS
        spread = np.ptp(np.mod(lon - lon[0] + 180.0, 360.0)) * np.cos(np.radians(lat.mean()))
        assert spread < 4 * BLOCK_CELLS


def test_few_cells_make_many_small_chunks():
    chunks = cut_chunks(CellGrid(1.0), np.arange(20_000, 20_080))
    assert len(chunks) >= 26
    assert max(map(len, chunks)) == 3


def ingested(workspace, path, moon, **settings):
    one = DemSection(path=path.name, **settings)
    config = BuildConfig(BodySettings("moon"), dem=(one,))
    place, account = path.parent / "build.toml", StageAccount("ingest")
    return ingest(IngestRun(workspace, config, place, moon, 1, SilentProgress(), account))


def test_the_record_of_a_model_says_what_was_read(tmp_path, dems, moon):
    values, affine = dems.rough_region(100)
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    _, (record,), *_ = ingested(Workspace(tmp_path / "work"), path, moon)
    assert (record.name, record.rows, record.cols, record.heights) == ("r.tif", 100, 100, "height")
    assert record.lowest_m == pytest.approx(values.min())
    assert record.bounds_deg == pytest.approx((19.0, 9.0, 21.0, 11.0))
    import hashlib

    whole = hashlib.sha256(hashlib.sha256(path.read_bytes()).digest()).hexdigest()
    assert record.sha256 == whole


def test_a_changed_file_is_read_again_and_the_old_overviews_go(tmp_path, dems, moon):
    values, affine = dems.rough_region(100)
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    workspace = Workspace(tmp_path / "work")
    _, (before,), *_ = ingested(workspace, path, moon)
    _, (same,), *_ = ingested(workspace, path, moon)
    assert same.folder == before.folder
    dems.write(path, values + 1.0, affine=affine)
    _, (after,), *_ = ingested(workspace, path, moon)
    assert after.folder != before.folder
    assert [p.name for p in (tmp_path / "work").glob("dem-*") if p.is_dir()] == [after.folder]


def test_settings_that_change_heights_change_the_overviews(tmp_path, dems, moon):
    values, affine = dems.rough_region(100)
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    workspace = Workspace(tmp_path / "work")
    _, (plain,), *_ = ingested(workspace, path, moon)
    mosaic, (halved,), *_ = ingested(workspace, path, moon, scale=0.5)
    assert halved.folder != plain.folder
    assert halved.lowest_m == pytest.approx(0.5 * plain.lowest_m)
    assert mosaic.pyramids[0].read(1, 0, 0, 1, 1)[0, 0] == pytest.approx(
        0.5 * values[:2, :2].mean(), abs=1.0
    )


def test_a_polar_tile_covers_the_pole(tmp_path, dems, moon):
    rng = np.random.default_rng(2)
    path = dems.write(
        tmp_path / "pole.tif",
        rng.normal(0.0, 300.0, (200, 200)).astype(np.float32),
        crs=f"+proj=stere +lat_0=-90 +lon_0=0 {dems.sphere}",
        affine=Affine(2000.0, 0.0, -200e3, 0.0, -2000.0, 200e3),
    )
    grid = CellGrid(2.0)
    cells = find_covered_cells(mosaic_of(moon, tmp_path, path), grid, None)
    assert 0 in cells  # the first cells lie about the south pole
    assert max(grid.bounds_deg(int(cell))[1] for cell in cells) <= -80.0


def test_how_a_model_ranks_and_ends_does_not_make_its_overviews_again(tmp_path, dems, moon):
    values, affine = dems.rough_region(100)
    values[10, 10] = np.nan
    path = dems.write(tmp_path / "r.tif", values, affine=affine)
    workspace = Workspace(tmp_path / "work")
    _, (plain,), *_ = ingested(workspace, path, moon)
    place = tmp_path / "work" / plain.folder / "pyramid.json"
    made = place.stat().st_mtime_ns
    _, (other,), *_ = ingested(workspace, path, moon, priority=3, feather_km=2.0)
    assert (other.folder, other.feather_km) == (plain.folder, 2.0)
    assert place.stat().st_mtime_ns == made
