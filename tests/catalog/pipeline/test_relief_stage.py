"""The relief of a build: of its own models, of the named one below them, or none; made once."""

from dataclasses import replace

import numpy as np
import pytest
from rasterio.transform import Affine

from catalog.errors import ConfigError, DataError
from catalog.inspect.compare import compare
from catalog.jobs.usage import StageAccount
from catalog.jobs.workspace import Workspace
from catalog.pipeline.build import run
from catalog.pipeline.config import (
    BodySettings,
    BuildConfig,
    DemSection,
    ReliefSettings,
    load_build_config,
)
from catalog.pipeline.context import IngestRun
from catalog.pipeline.ingest import ingest
from catalog.pipeline.relief import read_stored_relief, settle_relief
from catalog.progress import SilentProgress
from catalog.store.reader import Catalog
from catalog.store.relief import prepare_relief
from catalog.store.verify import verify
from catalog.terrain.dem.source import DemSettings
from catalog.terrain.relief.sums import load_relief
from tests.catalog.pipeline.coarse_tycho import BBOX, CONFIG

NAMED = '[relief]\ndem = {path = "bundled:moon_gld100_4ppd.tif"}\n'
PLAIN = CONFIG.replace(NAMED, "")


@pytest.fixture
def globe(tmp_path, dems):
    return dems.write(tmp_path / "globe.tif", dems.smooth_grid(180).astype(np.float32))


@pytest.fixture
def region(tmp_path, dems):
    """Two by two degrees about 10 N 20 E, all of it 5 km high."""
    values, affine = dems.rough_region(100)
    return dems.write(tmp_path / "region.tif", 5000.0 + 0.1 * values, affine=affine)


@pytest.fixture
def settled(tmp_path, moon):
    """Settle the relief of some models; returns the record, what was prepared, and the account."""

    def run_it(paths, **named):
        workspace = Workspace(tmp_path / "work")
        models = [DemSection(path.name, priority=i + 1) for i, path in enumerate(paths)]
        settings = ReliefSettings(DemSettings(**named) if named else None)
        config = BuildConfig(BodySettings("moon"), dem=tuple(models), relief=settings)
        place, account = tmp_path / "build.toml", StageAccount("ingest")
        of_all = IngestRun(workspace, config, place, moon, 1, SilentProgress(), account)
        mosaic, dems, *_ = ingest(replace(of_all, account=StageAccount("ingest")))
        record = settle_relief(of_all, mosaic, dems)
        prepared = read_stored_relief(workspace, record) if record is not None else None
        return record, prepared, account

    return run_it


def test_a_model_of_the_whole_body_makes_the_relief(settled, globe, moon):
    _, prepared, _ = settled([globe])
    assert prepared == prepare_relief(load_relief(str(globe), moon))
    assert (prepared.meta.rows, prepared.meta.source) == (180, "globe.tif")


def test_a_region_alone_makes_none(settled, region):
    record, prepared, account = settled([region])
    assert (record, prepared) == (None, None)
    assert (account.done, account.kept) == (0, 0)


def test_a_region_lies_on_the_named_model(settled, region, globe, moon, tmp_path):
    record, prepared, _ = settled([region], path=globe.name)
    assert prepared.meta.source == "region.tif + globe.tif"
    assert list(record.sources) == ["globe.tif (relief)"]
    below = load_relief(str(globe), moon)
    upper = np.full(below.heights.shape, np.nan)
    upper[79:81, 199:201] = 1.0  # 9 to 11 N, 19 to 21 E
    alone = prepare_relief(below)
    assert [row[:8] for row in alone.rows] != [row[:8] for row in prepared.rows]
    heights = np.vstack([np.nan_to_num(upper)])
    with_region = relief_grid(prepared)
    assert (np.abs(with_region - 5000.0) < 500.0)[heights == 1.0].all()
    np.testing.assert_allclose(
        with_region[heights == 0.0], np.rint(below.heights)[heights == 0.0], atol=0.51
    )


def relief_grid(prepared):
    """Means of a prepared relief that is no larger than two tiles."""
    from catalog.store.codec import Encoded, decode

    means = [decode(Encoded(*row[4:7], row[8])) for row in prepared.rows if row[1] == 0]
    return np.hstack(means)


def test_many_models_that_make_up_the_body_make_the_relief(settled, tmp_path, dems):
    """Four quarters, none of which is half of the body: their own posting is the relief's."""
    grid = dems.smooth_grid(180).astype(np.float32)
    quarters = []
    for i in range(4):
        place = Affine(1.0, 0.0, -180.0 + 90.0 * i, 0.0, -1.0, 90.0)
        part = grid[:, 90 * i : 90 * (i + 1)]
        quarters.append(dems.write(tmp_path / f"q{i}.tif", part, affine=place))
    _, prepared, _ = settled(quarters)
    assert prepared.meta.rows == 180
    assert prepared.meta.source == "q0.tif + q1.tif + q2.tif + q3.tif"
    np.testing.assert_allclose(relief_grid(prepared), grid, atol=0.51)


def test_it_is_made_once_and_anew_when_damaged(settled, globe, tmp_path):
    first, prepared, account = settled([globe])
    assert (account.done, account.kept) == (1, 0)
    again, same, account = settled([globe])
    assert (account.done, account.kept) == (0, 1)
    assert (again, same) == (first, prepared)
    (path,) = (tmp_path / "work").glob("relief-*/records.bin")
    path.write_bytes(path.read_bytes()[:-9])
    _, mended, account = settled([globe])
    assert account.done == 1
    assert mended == prepared


def test_bad_models_are_refused_and_named(settled, region, globe, dems, tmp_path):
    with pytest.raises(DataError, match=r"dem: .*tycho.*: 0\.\d+ % of moon is shown; a relief"):
        settled([region], path="bundled:tycho_gld100_256ppd.tif")
    with pytest.raises(DataError, match=r"\[relief\] dem: .*heights run from .*are these m\?"):
        settled([region], path=globe.name, units="km")
    mars = dems.write(
        tmp_path / "mars.tif", dems.smooth_grid(90), crs="+proj=longlat +R=3396190 +no_defs"
    )
    with pytest.raises(DataError, match=r"\[relief\] dem: .*mars.tif: .* for a body of 3396\.2 km"):
        settled([region], path=mars.name)
    with pytest.raises(DataError, match=r"dem: .*none\.tif: .*check `path` in \[relief\] dem"):
        settled([region], path="none.tif")


def test_a_relief_has_no_rank(tmp_path):
    path = tmp_path / "build.toml"
    path.write_text(PLAIN + '[relief]\ndem = {path = "a.tif", priority = 2}\n')
    with pytest.raises(ConfigError, match=r"\[relief\].*it lies below all others"):
        load_build_config(path)
    path.write_text(PLAIN + '[relief]\ndem = {path = ""}\n')
    with pytest.raises(ConfigError, match=r"\[relief\] dem path is empty"):
        load_build_config(path)
    path.write_text(PLAIN + "[relief]\nrows = 12\n")
    with pytest.raises(ConfigError, match="rows"):
        load_build_config(path)


def test_a_build_carries_it_and_a_repeated_one_too(tmp_path, moon):
    config = tmp_path / "tycho.toml"
    config.write_text(PLAIN)
    work = tmp_path / "work"
    plain = run(config, work, output=tmp_path / "plain.gpkg", bbox=BBOX, workers=1)
    config.write_text(CONFIG)
    report = run(config, work, output=tmp_path / "c.gpkg", bbox=BBOX, workers=1)
    done = {stage.name: stage.done for stage in report.account.stages}
    assert (done["ingest"], done["render"], done["check"]) == (1, 0, 0)
    assert report.digest != plain.digest
    assert verify(tmp_path / "c.gpkg").sound
    with Catalog.open(tmp_path / "c.gpkg") as catalog:
        relief = catalog.relief()
        assert "moon_gld100_4ppd.tif (relief)" in catalog.meta.sources
    whole = load_relief("bundled:moon_gld100_4ppd.tif", moon)
    differs = relief.heights != whole.heights
    rows, cols = np.nonzero(differs)  # Tycho's own model lies on top: 38-48 S, 17-5 W
    # its first row and column of pixels lie a pixel beyond these
    assert (rows.min(), rows.max()) == (4 * 128 - 1, 4 * 138 - 1)
    assert (cols.min(), cols.max()) == (4 * 163 - 1, 4 * 175 - 1)
    assert differs.sum() > 1000
    # the two are means of one product
    assert np.abs(relief.heights - whole.heights)[differs].max() < 60.0
    before = (tmp_path / "c.gpkg").read_bytes()
    again = run(config, work, output=tmp_path / "c.gpkg", bbox=BBOX, workers=1)
    assert again.digest == report.digest
    assert (tmp_path / "c.gpkg").read_bytes() == before
    told = compare(tmp_path / "plain.gpkg", tmp_path / "c.gpkg")
    assert [change.name for change in told.settings] == ["relief"]
