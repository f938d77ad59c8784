"""Builds of a few cells of the real Tycho model: the same bytes by every way to them."""

import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from catalog.config import resource
from catalog.errors import ConfigError, DataError, NothingToDoError, OutputError, UsageError
from catalog.inspect.summary import catalog_document, describe
from catalog.jobs.workspace import hash_package
from catalog.pipeline.build import STAGES, run
from catalog.store.manifest import rows_from_meta
from catalog.store.reader import Catalog
from catalog.store.verify import verify
from tests.catalog.pipeline.coarse_tycho import BBOX, CONFIG


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "tycho.toml"
    path.write_text(CONFIG)
    return path


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """What an undisturbed build by one process reports."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "tycho.toml").write_text(CONFIG)
    return built(folder / "tycho.toml", folder / "c.gpkg", bbox=BBOX, workers=1)


@pytest.fixture(scope="module")
def digest(undisturbed):
    """Its content."""
    return undisturbed.digest


@pytest.fixture
def output(undisturbed, tmp_path):
    """A copy of its catalog, with the work folder beside it."""
    shutil.copytree(undisturbed.work, tmp_path / "c.gpkg.work")
    return Path(shutil.copy2(undisturbed.output, tmp_path / "c.gpkg"))


def built(config, output, **options):
    report = run(config, output=output, **options)
    assert output.is_file()
    assert report.points > 5
    assert report.usable > 0
    return report


def written_pieces(report):
    """Pieces of the write stage that were done, and those that were kept."""
    (stage,) = (stage for stage in report.account.stages if stage.name == "write")
    return stage.done, stage.kept


def test_two_processes_write_what_one_writes(config, digest, tmp_path):
    assert built(config, tmp_path / "two.gpkg", bbox=BBOX, workers=2).digest == digest


def test_the_work_folder_lies_beside_the_output_and_nothing_is_done_twice(config, digest, tmp_path):
    output = tmp_path / "c.gpkg"
    first = built(config, output, bbox=BBOX, workers=1)
    assert first.work == tmp_path / "c.gpkg.work"
    before = output.read_bytes()
    again = built(config, output, bbox=BBOX, workers=1)
    assert again.digest == first.digest == digest
    done = {account.name: account.done for account in again.account.stages}
    kept = {account.name: account.kept for account in again.account.stages}
    assert done["render"] == done["select"] == done["check"] == 0
    assert kept["render"] == kept["check"] > 5
    assert (again.points, again.usable) == (first.points, first.usable)
    # so few that each is a piece, cut for the check already
    assert written_pieces(first) == (0, first.points)
    assert written_pieces(again) == (0, first.points)
    assert output.read_bytes() == before


def test_a_damaged_catalog_is_written_again(config, undisturbed, output):
    whole = output.read_bytes()
    for place in (40, len(whole) // 2, len(whole) - 1):
        damaged = bytearray(whole)
        damaged[place] ^= 4
        output.write_bytes(damaged)
        again = built(config, output, bbox=BBOX, workers=1)
        assert written_pieces(again) == (undisturbed.points, 0), place
        assert verify(output).sound, place


def test_a_catalog_of_other_words_or_elsewhere_is_written(config, digest, tmp_path):
    output, work = tmp_path / "c.gpkg", tmp_path / "work"
    built(config, output, work=work, bbox=BBOX, workers=1)
    config.write_text(CONFIG + "# the manifest holds this comment\n")
    again = built(config, output, work=work, bbox=BBOX, workers=1)
    assert written_pieces(again) == (again.points, 0)
    other = tmp_path / "d.gpkg"
    assert built(config, other, work=work, bbox=BBOX, workers=1).output == other


def test_stages_run_alone_on_one_workspace(config, digest, tmp_path):
    work = tmp_path / "work"
    for stage in STAGES[:-1]:
        run(config, work, stages=[stage], bbox=BBOX, workers=1)
    report = run(config, work, stages=["write"], output=tmp_path / "c.gpkg", bbox=BBOX, workers=1)
    assert report.digest == digest


@pytest.mark.parametrize(
    ("stage", "needed"), [("select", "render"), ("check", "select"), ("write", "select")]
)
def test_a_stage_whose_forerunner_is_missing_says_which_command_to_run(
    config, tmp_path, stage, needed
):
    with pytest.raises(UsageError, match=f"first run: optnav {needed} .*--work"):
        run(
            config,
            tmp_path / "work",
            stages=[stage],
            bbox=BBOX,
            workers=1,
            output=tmp_path / "c.gpkg",
        )


def test_a_damaged_result_is_made_again(config, digest, output, tmp_path):
    for name in ("render", "check"):
        chunk = sorted(tmp_path.glob(f"c.gpkg.work/{name}-*/chunk-*.bin"))[3]
        data = bytearray(chunk.read_bytes())
        data[len(data) // 2] ^= 1
        chunk.write_bytes(data)
    again = built(config, output, bbox=BBOX, workers=1)
    assert again.digest == digest
    assert {a.name: a.done for a in again.account.stages if a.name in ("render", "check")} == {
        "render": 1,
        "check": 1,
    }


def test_changed_settings_make_their_stage_and_the_next_ones_anew(config, output, tmp_path):
    config.write_text(CONFIG + "\n[select]\npercentile = 50.0\n")
    second = built(config, output, bbox=BBOX, workers=1)
    done = {account.name: account.done for account in second.account.stages}
    assert done["render"] == 0
    assert done["select"] == 1
    assert done["check"] > 0
    # what no settings lead to any more is gone
    for name in ("render", "select", "check"):
        assert len(list(second.work.glob(f"{name}-*"))) == 1
    assert second.work == tmp_path / "c.gpkg.work"


def test_another_bbox_is_another_build(config, undisturbed, output):
    west, south, east, north = BBOX
    second = built(config, output, bbox=(west, south, east - 2.0, north), workers=1)
    assert second.points < undisturbed.points
    assert second.digest != undisturbed.digest


def test_a_copy_of_the_model_elsewhere_gives_the_same_content(config, digest, tmp_path):
    from catalog.config import resource

    copy = tmp_path / "elsewhere" / "tycho_gld100_256ppd.tif"
    copy.parent.mkdir()
    copy.write_bytes(resource("data/tycho_gld100_256ppd.tif").read_bytes())
    config.write_text(CONFIG.replace("bundled:tycho", "elsewhere/tycho"))
    assert built(config, tmp_path / "c.gpkg", bbox=BBOX, workers=1).digest == digest


def test_a_bbox_without_ground_is_refused_before_any_work(config, tmp_path):
    with pytest.raises(DataError, match=r"--bbox 100,0,110,10 .*tycho_gld100_256ppd.tif covers"):
        run(config, output=tmp_path / "c.gpkg", bbox=(100.0, 0.0, 110.0, 10.0), workers=1)
    assert not (tmp_path / "c.gpkg").exists()


def test_ground_too_small_for_a_patch_ends_with_nothing_done(config, dems, tmp_path):
    values, affine = dems.rough_region(40)
    dems.write(tmp_path / "tiny.tif", values, affine=affine)
    config.write_text('[body]\nname = "moon"\n[[dem]]\npath = "tiny.tif"\n')
    with pytest.raises(NothingToDoError) as caught:
        run(config, output=tmp_path / "c.gpkg", workers=1)
    assert caught.value.exit_code == 4


def test_ground_without_relief_gives_no_usable_point(config, dems, tmp_path):
    affine = dems.rough_region(400)[1]
    flat = np.full((400, 400), 100.0, dtype=np.float32)
    dems.write(tmp_path / "flat.tif", flat, affine=affine)
    config.write_text(
        CONFIG.replace("bundled:tycho_gld100_256ppd.tif", "flat.tif").replace(
            "[pyramid]", 'units = "m"\n[pyramid]'
        )
    )
    with pytest.raises(NothingToDoError):
        run(config, output=tmp_path / "c.gpkg", bbox=(19.0, 9.0, 21.0, 11.0), workers=1)


def test_patches_wider_than_the_body_are_refused(config, tmp_path):
    config.write_text(CONFIG.replace("levels = 3", "levels = 8").replace("474.0", "4740.0"))
    with pytest.raises(ConfigError, match=r"\[pyramid\] the coarsest patch"):
        run(config, output=tmp_path / "c.gpkg", bbox=BBOX, workers=1)


def test_wrong_calls_are_refused(config, tmp_path):
    with pytest.raises(UsageError, match="-o"):
        run(config, tmp_path / "work")
    with pytest.raises(UsageError, match="--work"):
        run(config, stages=["render"])
    with pytest.raises(UsageError, match="--workers 0"):
        run(config, output=tmp_path / "c.gpkg", workers=0)


def test_a_work_folder_of_someone_else_is_refused(config, tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="not a work folder of optnav"):
        run(config, tmp_path / "work", output=tmp_path / "c.gpkg", bbox=BBOX)


class Counting:
    """Progress that remembers what was shown."""

    def __init__(self):
        self.shown = {}

    @contextmanager
    def stage(self, name, total, unit):
        self.now = self.shown[name] = [0, total]
        yield self

    def advance(self, n=1, note=""):
        self.now[0] += n

    keep = advance


def test_progress_of_every_stage_reaches_its_total(config, tmp_path):
    progress = Counting()
    built(config, tmp_path / "c.gpkg", bbox=BBOX, workers=1, progress=progress)
    assert set(progress.shown) >= {"render", "select", "check", "write"}
    for name, (done, total) in progress.shown.items():
        assert done == total, name


def test_keys_change_with_the_code_that_makes_the_results():
    assert hash_package.__wrapped__() == hash_package.__wrapped__()
    assert len(hash_package()) == 64


def test_a_body_file_is_all_that_another_body_needs(config, tmp_path):
    """The catalog carries what it needs of the body: it opens where the file is not."""
    text = resource("configs/bodies/moon.toml").read_text(encoding="utf-8")
    body = tmp_path / "bodies/selene.toml"
    body.parent.mkdir()
    body.write_text(text.replace('name = "moon"', 'name = "selene"', 1))
    config.write_text(CONFIG.replace('name = "moon"', 'name = "bodies/selene.toml"'))
    report = built(config, tmp_path / "c.gpkg", bbox=BBOX, workers=1)
    body.unlink()
    with Catalog.open(report.output) as catalog:
        assert (catalog.meta.body, catalog.meta.radius_m) == ("selene", 1737400.0)
        assert len(catalog.patches(int(catalog.ids[0]))) == catalog.meta.levels
    with pytest.raises(ConfigError, match=r"\[body\] name: .*selene.toml: there is no such file"):
        run(config, output=tmp_path / "d.gpkg", bbox=BBOX, workers=1)


GLOBE = """
[[dem]]
path = "bundled:moon_gld100_4ppd.tif"
priority = 2
"""


def test_stated_errors_stand_in_the_catalog_and_are_no_content(config, tmp_path):
    output = tmp_path / "c.gpkg"
    config.write_text(CONFIG + GLOBE)
    plain = built(config, output, bbox=BBOX, workers=1)
    tycho = CONFIG.replace('256ppd.tif"', '256ppd.tif"\nproduct = "gld100"')
    config.write_text(tycho + GLOBE + "error_m = 60.0\nresolution_km = 20.0\n")
    stated = built(config, output, bbox=BBOX, workers=1)
    assert stated.digest == plain.digest
    assert {account.name: account.done for account in stated.account.stages}["render"] == 0
    assert verify(output).sound
    with Catalog.open(output) as catalog:
        meta = catalog.meta
        assert {name: e.error_m for name, e in meta.terrain_errors.items()} == {
            "tycho_gld100_256ppd.tif": 28.0,
            "moon_gld100_4ppd.tif": 60.0,
        }
        # the model that counts most at a point states its error
        both = "tycho_gld100_256ppd.tif + moon_gld100_4ppd.tif"
        assert meta.find_error(both).resolution_km == 1.6
        assert meta.find_error("other.tif + moon_gld100_4ppd.tif") is None
        document = catalog_document(catalog)
    found = document["terrain_errors"]["tycho_gld100_256ppd.tif"]
    assert found["template_sigma_m"] == sorted(found["template_sigma_m"], reverse=True)
    said = describe(document)["error of tycho_gld100_256ppd.tif"]
    assert "28 m over 2 km" in said
    assert "1 of GLD100's" in said


def test_a_catalog_without_stated_errors_has_no_row_of_them(undisturbed):
    with Catalog.open(undisturbed.output) as catalog:
        assert "terrain_errors" not in rows_from_meta(catalog.meta)
        document = catalog_document(catalog)
    assert document["terrain_errors"] == {}
    assert "none stated" in describe(document)["terrain_errors"]


def test_an_error_larger_than_the_relief_is_refused(config, tmp_path):
    config.write_text(CONFIG.replace('256ppd.tif"', '256ppd.tif"\nerror_m = 28000.0'))
    with pytest.raises(ConfigError, match=r"28000 m, but its heights differ by \d+"):
        run(config, output=tmp_path / "c.gpkg", bbox=BBOX, workers=1)
