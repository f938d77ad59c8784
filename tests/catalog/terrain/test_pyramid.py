"""Overviews against numpy's means of the whole file, and the memory that making them takes."""

import subprocess
import sys
import textwrap

import numpy as np
import pytest
import rasterio

from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.pyramid.overviews import level_path
from catalog.terrain.pyramid.pyramid import HeightPyramid


def pyramid_of(path, moon, workers=1, **settings) -> HeightPyramid:
    one = DemSettings(path=path.name, **settings)
    folder = path.parent / f"{path.stem}-overviews"
    return HeightPyramid.load_or_build(one, path.parent, moon, folder, workers)


def block_means(values, factor):
    rows, cols = values.shape
    return values.reshape(rows // factor, factor, cols // factor, factor).mean(axis=(1, 3))


def test_every_level_holds_area_means_of_the_whole_file(tmp_path, dems, moon):
    values = dems.smooth_grid(768).astype(np.float32)
    pyramid = pyramid_of(dems.write(tmp_path / "globe.tif", values), moon)
    assert pyramid.levels == 5
    for level in range(1, pyramid.levels):
        rows, cols = pyramid.shape(level)
        made = pyramid.read(level, 0, 0, rows, cols)
        # heights are rounded to a power of two near a 1500th of the posting: 4 m here
        expected = block_means(values.astype(np.float64), 2**level)
        assert np.abs(made - expected).max() <= 0.5 * level * 4.0 + 1e-3


def test_windows_larger_than_the_file_or_smaller_give_the_same(tmp_path, dems, moon, monkeypatch):
    values = dems.smooth_grid(600).astype(np.float32)
    whole = pyramid_of(dems.write(tmp_path / "a.tif", values), moon)
    monkeypatch.setattr("catalog.terrain.pyramid.overviews.WINDOW", 512)
    cut = pyramid_of(dems.write(tmp_path / "b.tif", values), moon, workers=2)
    for level in range(1, whole.levels):
        shape = whole.shape(level)
        np.testing.assert_array_equal(
            whole.read(level, 0, 0, *shape), cut.read(level, 0, 0, *shape)
        )
    assert whole.record.lowest_m == cut.record.lowest_m


def test_odd_sides_and_holes_are_averaged_over_what_is_there(tmp_path, dems, moon):
    values, affine = dems.rough_region(301)
    values = values[:, :215].copy()
    values[100:103, 50:53] = np.nan
    path = dems.write(tmp_path / "odd.tif", values, affine=affine)
    pyramid = pyramid_of(path, moon)
    assert pyramid.shape(1) == (151, 108)
    made = pyramid.read(1, 0, 0, 151, 108)
    assert made[150, 10] == pytest.approx(values[300, 20:22].mean(), abs=1.0)
    assert made[10, 107] == pytest.approx(values[20:22, 214].mean(), abs=1.0)
    # a whole empty block is empty; one with a single value of four too; half is enough
    assert np.isnan(made[50, 25])
    assert np.isnan(made[51, 26]) is np.False_
    assert made[50, 26] == pytest.approx(np.nanmean(values[100:102, 52:54]), abs=1.0)


def test_a_file_of_long_strips_is_copied_into_tiles(tmp_path, dems, moon, monkeypatch):
    monkeypatch.setattr("catalog.terrain.pyramid.overviews.MAX_STRIP", 500)
    counts = np.round(dems.smooth_grid(300) * 2.0).astype(np.int16)
    path = dems.write(tmp_path / "strips.tif", counts, blockysize=1)
    pyramid = pyramid_of(path, moon, scale=0.5)
    assert pyramid.record.tiled_copy
    assert level_path(pyramid.folder, 0).exists()
    np.testing.assert_array_equal(
        pyramid.read(0, 40, 100, 60, 80), counts[40:100, 100:180] * np.float32(0.5)
    )


def test_overviews_are_made_once_and_again_when_the_file_changes(tmp_path, dems, moon):
    values = dems.smooth_grid(200).astype(np.float32)
    path = dems.write(tmp_path / "globe.tif", values)
    first = pyramid_of(path, moon)
    made = level_path(first.folder, 1).stat().st_mtime_ns
    assert level_path(pyramid_of(path, moon).folder, 1).stat().st_mtime_ns == made
    dems.write(path, values + 100.0)
    again = pyramid_of(path, moon)
    assert again.read(1, 0, 0, 4, 4).mean() == pytest.approx(
        first.source.convert(values[:8, :8]).mean() + 100.0, abs=8.0
    )


def test_a_half_made_folder_is_not_taken_for_overviews(tmp_path, dems, moon):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(200).astype(np.float32))
    partial = tmp_path / "globe-overviews.partial"
    partial.mkdir()
    (partial / "level-01.tif").write_bytes(b"torn")
    assert pyramid_of(path, moon).read(1, 0, 0, 5, 5).shape == (5, 5)
    assert not partial.exists()


def test_overviews_carry_their_own_place(tmp_path, dems, moon):
    values, affine = dems.rough_region(256)
    pyramid = pyramid_of(dems.write(tmp_path / "region.tif", values, affine=affine), moon)
    with rasterio.open(level_path(pyramid.folder, 2)) as dataset:
        assert dataset.bounds == pytest.approx((17.44, 7.44, 22.56, 12.56))
        assert dataset.crs.to_dict()["R"] == moon.radius_m


def test_the_coarsest_level_that_fits_a_posting_is_chosen(tmp_path, dems, moon):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(768).astype(np.float32))
    pyramid = pyramid_of(path, moon)
    posting = pyramid.source.posting_m
    wanted = [0.5, 0.99, 1.9, 1.95, 2.0, 3.9, 8.0, 1e4]
    assert [pyramid.choose_level(posting * w) for w in wanted] == [0, 0, 0, 1, 1, 2, 3, 4]


@pytest.mark.parametrize("workers", [1, 2])
def test_the_file_is_never_whole_in_memory(shared_data, tmp_path, workers):
    """The 66-megapixel Moon (133 MB of int16) in a process of its own.

    Bound: a window is 32 MB of counts with 11 MB of means, one in work and one waiting for each
    thread, GDAL keeps 96 MB: less than 300 MB beyond what the imports take, whatever the file.
    """
    path = shared_data("moon/moon_gld100_32ppd.tif")
    code = f"""
        import resource
        from pathlib import Path
        from catalog.bodies.body import load_body
        from catalog.terrain.pyramid.pyramid import HeightPyramid
        from catalog.terrain.dem.source import DemSettings
        def peak():
            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        moon = load_body("moon")
        one = DemSettings(path="{path}")
        # compile first: the compiler's own memory is not the file's
        small = DemSettings(path="{path.with_name("moon_gld100_4ppd.tif")}")
        HeightPyramid.load_or_build(small, Path("/"), moon, Path("{tmp_path}/small"))
        before = peak()
        made = HeightPyramid.load_or_build(one, Path("/"), moon, Path("{tmp_path}/m"), {workers})
        print(peak() - before, made.record.valid_share)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True
    )
    grown, share = map(float, done.stdout.split())
    assert share == 1.0
    assert grown < (170.0 if workers == 1 else 300.0)


def test_sources_can_be_read_by_threads_with_handles_of_their_own(tmp_path, dems, moon):
    path = dems.write(tmp_path / "globe.tif", dems.smooth_grid(64).astype(np.float32))
    source = DemSource.open(DemSettings(path=path.name), tmp_path, moon)
    other = source.reopen()
    source.close()
    np.testing.assert_array_equal(other.read_window(0, 0, 4, 4), source.read_window(0, 0, 4, 4))


def test_blocks_with_a_hole_are_known_whatever_the_windows(tmp_path, dems, moon, monkeypatch):
    values = dems.smooth_grid(150).astype(np.float32)
    holes = np.random.default_rng(6).integers(0, (150, 300), (30, 2))
    values[holes[:, 0], holes[:, 1]] = np.nan
    monkeypatch.setattr("catalog.terrain.pyramid.overviews.WINDOW", 64)
    pyramid = pyramid_of(dems.write(tmp_path / "globe.tif", values), moon, workers=2)
    expected = np.ones((19, 38), dtype=bool)
    expected[holes[:, 0] // 8, holes[:, 1] // 8] = False
    np.testing.assert_array_equal(pyramid.load_hole_free_blocks(), expected)
