"""The ground of the global bench: seamless, the same however it is cut, rough as the real one."""

import os
import shutil
import subprocess
from collections import namedtuple
from pathlib import Path

import msgspec
import numpy as np
import pytest
import rasterio

from catalog.geometry.latlon import xyz_from_latlon
from catalog.jobs.usage import Account, StageAccount
from tests.bench.global_moon import figures, hillshade, likeness, place, terrain
from tests.bench.global_moon.__main__ import main
from tests.bench.global_moon.builds import CELLS, Build
from tests.bench.global_moon.clock import Used
from tests.bench.global_moon.terrain import Ground

ROWS, FACTOR = 360, 4  # of a small model, and pixels to one of it


def heights_at(lat, lon):
    """Hills known everywhere, a few of the model's pixels wide, m."""
    x, y, z = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    return 2000.0 * np.sin(19.0 * x + 1.0) * np.cos(23.0 * y) + 1500.0 * np.sin(17.0 * z + 5.0 * x)


@pytest.fixture(scope="module")
def model(tmp_path_factory) -> Path:
    """A model of means over its pixels, of a small body, so that the relief is wide for them."""
    path = tmp_path_factory.mktemp("model") / "model.tif"
    fine = 5
    lat = np.pi / 2.0 - (np.arange(fine * ROWS) + 0.5) * np.pi / (fine * ROWS)
    lon = (np.arange(2 * fine * ROWS) + 0.5) * np.pi / (fine * ROWS)
    means = heights_at(lat[:, None], lon[None, :]).reshape(ROWS, fine, -1, fine).mean(axis=(1, 3))
    posting = 948.0
    radius = posting * ROWS / np.pi
    with rasterio.open(
        path, "w", driver="GTiff", height=ROWS, width=2 * ROWS, count=1, dtype="int16",
        crs=f"+proj=eqc +R={radius} +no_defs", nodata=-32768,
        transform=rasterio.Affine(posting, 0, 0, 0, -posting, posting * ROWS / 2),
    ) as out:  # fmt: skip
        out.write(np.rint(means).astype(np.int16), 1)
    return path


def test_means_over_a_pixel_of_the_model_are_the_model(model, monkeypatch):
    monkeypatch.setattr(terrain, "AMPLITUDES_M", (0.0, 0.0))
    with rasterio.open(model) as source:
        wanted = source.read(1).astype(float)
    made = Ground(model, FACTOR).window(0, 0, FACTOR * ROWS, 2 * FACTOR * ROWS).astype(float)
    means = made.reshape(ROWS, FACTOR, -1, FACTOR).mean(axis=(1, 3))
    assert np.sqrt(np.mean((means - wanted) ** 2)) < 0.5


def test_without_relief_the_ground_is_the_known_surface(model, monkeypatch):
    monkeypatch.setattr(terrain, "AMPLITUDES_M", (0.0, 0.0))
    made = Ground(model, FACTOR).window(400, -200, 100, 400)
    n = FACTOR * ROWS
    lat = np.pi / 2.0 - (400.5 + np.arange(100)) * np.pi / n
    lon = (-199.5 + np.arange(400)) * np.pi / n
    assert np.abs(made - heights_at(lat[:, None], lon[None, :])).max() < 4.0


def test_the_ground_does_not_depend_on_how_it_is_cut(model):
    ground = Ground(model, FACTOR)
    whole = ground.window(0, 0, 300, 2 * FACTOR * ROWS)
    parts = Ground(model, FACTOR)
    cut = np.vstack([parts.window(row, 0, 75, 2 * FACTOR * ROWS) for row in range(0, 300, 75)])
    np.testing.assert_array_equal(whole, cut)
    np.testing.assert_array_equal(whole[100:140, 333:444], parts.window(100, 333, 40, 111))


def test_the_seam_is_as_smooth_as_any_other_place(model):
    ground = Ground(model, FACTOR)
    across = ground.window(500, -40, 400, 80).astype(float)
    steps = np.abs(np.diff(across, n=2, axis=1)).mean(axis=0)
    assert steps[38:41].max() < 1.3 * steps.max(initial=0.0, where=np.abs(np.arange(78) - 39) > 3)
    cols = 2 * FACTOR * ROWS
    np.testing.assert_array_equal(across, ground.window(500, cols - 40, 400, 80))


@pytest.mark.parametrize("row", [0, FACTOR * ROWS - 1])
def test_around_a_pole_all_columns_agree(model, row):
    """The first row is a ring of half a pixel about the pole: it can differ by its slope alone."""
    ring = Ground(model, FACTOR).window(row, 0, 1, 2 * FACTOR * ROWS)[0].astype(float)
    assert np.ptp(ring) < 237.0 * 2.0 * np.tan(np.radians(25.0))
    assert np.abs(np.diff(np.append(ring, ring[0]))).max() <= 2.0


def test_the_relief_has_no_direction_on_the_sphere(model, monkeypatch):
    """Slopes of the added relief alone, toward east and north, where columns crowd."""
    ground = Ground(model, FACTOR)
    monkeypatch.setattr(terrain, "AMPLITUDES_M", (0.0, 0.0))
    bare = Ground(model, FACTOR)
    for row in (20, 200, 700):
        relief = ground.window(row, 0, 40, 2880).astype(float) - bare.window(row, 0, 40, 2880)
        lat = np.pi / 2.0 - (row + 20.0) * np.pi / (FACTOR * ROWS)
        skip = max(1, round(1.0 / np.cos(lat)))  # columns as far apart as rows
        north = np.diff(relief, axis=0).std() / 237.0
        east = (relief[:, skip:] - relief[:, :-skip]).std() / (237.0 * skip * np.cos(lat))
        assert relief.std() > 1.0
        assert east == pytest.approx(north, rel=0.25), row


def test_another_seed_is_other_ground(model):
    one, other = (Ground(model, FACTOR, seed).window(300, 0, 60, 60) for seed in (1, 2))
    assert (one != other).mean() > 0.5


def test_a_raster_is_written_once_and_kept(model, tmp_path):
    target = tmp_path / "moon.tif"
    assert terrain.make(model, target, 2)
    first = target.read_bytes()
    with rasterio.open(target) as raster:
        assert raster.shape == (2 * ROWS, 4 * ROWS)
        assert raster.profile["blockxsize"] == raster.profile["blockysize"] == terrain.TILE
        assert raster.dtypes == ("int16",)
        assert raster.compression is None
        assert raster.bounds == pytest.approx((0, -948 * 180, 948 * 720, 948 * 180))
        whole = raster.read(1)
    np.testing.assert_array_equal(whole, Ground(model, 2).window(0, 0, 2 * ROWS, 4 * ROWS))
    assert not terrain.make(model, target, 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["moon.json", "moon.tif"]
    # cut short, or by another recipe: made again, the same bytes
    target.write_bytes(first[:-1000])
    assert terrain.make(model, target, 2)
    assert target.read_bytes() == first
    recipe = terrain.recipe_path(target)
    recipe.write_bytes(recipe.read_bytes().replace(b'"seed": 1', b'"seed": 9'))
    assert terrain.make(model, target, 2)
    assert msgspec.json.decode(recipe.read_bytes())["seed"] == 1


def test_a_model_with_holes_is_refused(model, tmp_path):
    with rasterio.open(model) as source:
        profile, heights = source.profile, source.read(1)
    heights[7, 7] = -32768
    with rasterio.open(tmp_path / "holes.tif", "w", **profile) as out:
        out.write(heights, 1)
    with pytest.raises(ValueError, match="holes"):
        Ground(tmp_path / "holes.tif", 2)


def test_the_ground_is_as_rough_as_the_real_one(shared_data):
    """Against GLD100's own 118 m, which the model of 948 m is the mean of.

    Octaves may differ by a fifth: the real crop has lines of its own in its spectrum.
    """
    crop = likeness.real_crop()
    ground = Ground(shared_data("moon/moon_gld100_32ppd.tif"), 8)
    made = ground.window(crop.row, crop.col, *crop.heights.shape).astype(float)
    means = crop.heights.reshape(crop.heights.shape[0] // 8, 8, -1, 8).mean(axis=(1, 3))
    ours = made.reshape(*means.shape[:1], 8, -1, 8).mean(axis=(1, 3))
    assert np.std(ours - means) < 5.0  # the added relief's longest waves
    real, found = likeness.statistics(crop.heights, crop), likeness.statistics(made, crop)
    assert found.rms_slope_deg == pytest.approx(real.rms_slope_deg, rel=0.02)
    np.testing.assert_allclose(found.octaves_m, real.octaves_m, rtol=0.2)


def test_the_bench_is_skipped_with_a_word_where_the_disk_lacks_room(tmp_path, monkeypatch, capsys):
    model = tmp_path / place.MODEL
    model.parent.mkdir()
    model.write_bytes(b"")
    monkeypatch.setenv("OPTNAV_SHARED_DATA", str(tmp_path))
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(int(1e12), int(9.93e11), int(7e9)))
    assert main([str(tmp_path / "new")]) == 0
    word = capsys.readouterr().out
    assert "skipped" in word
    assert str(tmp_path / "new") in word
    # 92 160 x 46 080 pixels: 8.5 GB, 5.7 GB of overviews, 5 GB of all else
    assert "7.0 GB free, and 19.2 GB are wanted (raster 8.5 GB" in word
    assert not any((tmp_path / "new").iterdir())


def test_room_counts_what_is_there_and_what_will_be_replaced(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(int(1e12), 0, int(10.65e9)))
    assert place.lacking_room(tmp_path, 256, []) is not None
    raster = place.raster_path(tmp_path, 256)
    with raster.open("wb") as file:
        file.truncate(8_493_465_600)  # a file with a hole takes no room here
    assert place.lacking_room(tmp_path, 256, []) is not None
    (tmp_path / "old.work" / "dem-1").mkdir(parents=True)
    with (tmp_path / "old.work" / "dem-1" / "level-01.tif").open("wb") as file:
        file.truncate(20_000_000)
    assert place.lacking_room(tmp_path, 256, [tmp_path / "old.work"]) is None


def test_the_bench_is_skipped_with_a_word_where_the_model_does_not_lie(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("OPTNAV_SHARED_DATA", str(tmp_path / "nowhere"))
    assert main([str(tmp_path / "new")]) == 0
    assert "moon_gld100_32ppd.tif" in capsys.readouterr().out


def test_the_make_target_wants_a_folder():
    def make(*words: str) -> subprocess.CompletedProcess[str]:
        bare = {name: value for name, value in os.environ.items() if name != "DIR"}
        return subprocess.run(
            ["make", *words], cwd=place.CHECKOUT, env=bare, capture_output=True, text=True
        )

    refused = make("bench-global")
    assert refused.returncode == 2
    assert "make bench-global DIR=/some/folder" in refused.stderr
    planned = make("--dry-run", "bench-global", "DIR=/some/folder")
    assert 'python -m tests.bench.global_moon "/some/folder"' in planned.stdout


@pytest.mark.parametrize("words", [["x", "--ppd", "100"], ["x", "--strip-deg", "0"], []])
def test_wrong_words_are_refused(words, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    assert "wanted" in capsys.readouterr().err or not words


def test_a_strip_s_time_is_scaled_up_by_its_cells_but_for_reading_the_terrain():
    names = ("ingest", "render", "select", "check", "write")
    stages = [StageAccount(name, seconds=10.0, cpu_s=15.0) for name in names]
    account = Account("optnav", 2, cells=CELLS // 4, stages=stages)
    build = Build(Path("moon.gpkg"), account, Used(52.0, 80.0))
    # ten seconds of ingest and two of starting stay as they are; of processors 15 and 5
    assert build.whole_moon == pytest.approx((12.0 + 4 * 40.0, 20.0 + 4 * 60.0))


def test_one_hillshade_pass_is_timed_and_leaves_nothing(model, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))  # without gdaldem: the GDAL that rasterio brings
    used = hillshade.one_pass(model, tmp_path)
    assert used.cpu_s > 0.0
    assert used.wall_s > 0.0
    assert list(tmp_path.iterdir()) == []


class Listed:
    """A catalog of given directions; `nearest` is right but for one point that it never finds."""

    def __init__(self, direction, missed=None):
        self.direction, self.missed = direction, missed
        self.ids = np.arange(10, 10 + len(direction))

    def __len__(self):
        return len(self.ids)

    def nearest(self, lat_deg, lon_deg):
        place = xyz_from_latlon(np.radians(lat_deg), np.radians(lon_deg), 1.0)
        distance = np.linalg.norm(self.direction - place, axis=1)
        if self.missed is not None:
            distance[self.missed] = 9.0
        return int(self.ids[np.argmin(distance)])


def test_a_wrong_nearest_point_is_noticed():
    rng = np.random.default_rng(5)
    lat, lon = figures.places(rng, 400)
    assert {90.0, -90.0} <= set(lat)
    assert {180.0, -180.0} <= set(lon)
    assert ((lat >= -90.0) & (lat <= 90.0)).all()
    direction = xyz_from_latlon(*np.radians(figures.places(rng, 60)), 1.0)
    right = Listed(direction)
    assert figures.disagreements(right, lat, lon) == 0
    closest = int(right.ids.searchsorted(right.nearest(float(lat[300]), float(lon[300]))))
    assert figures.disagreements(Listed(direction, closest), lat, lon) > 0
