"""A terrain model that is drawn finer keeps what is known of it, and gets relief of a real size."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.windows import Window
from scipy import ndimage

from catalog.errors import ConfigError
from tests.studies.drawn_mare import (
    NAME,
    beyond_means,
    drawn_finer,
    fine_relief,
    real_heights,
    twice_as_fine,
    write_drawn_mare,
)

POSTING_M = 473.8


def hills(seed: int, size: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    ground = 3e3 * ndimage.gaussian_filter(rng.normal(size=(size, size)), 6.0)
    return ground.astype(np.float32)


def test_smooth_ground_is_found_again_between_its_nodes() -> None:
    fine = hills(1, 128)
    means = fine.reshape(64, 2, 64, 2).mean(axis=(1, 3))
    inner = np.s_[16:-16, 16:-16]
    assert np.abs(twice_as_fine(means) - fine)[inner].max() < 0.02 * fine.std()
    assert beyond_means(fine)[inner].std() < 0.01 * fine.std()


def test_what_is_drawn_has_no_part_in_the_means_and_the_height_of_real_relief() -> None:
    relief = fine_relief(real_heights(), POSTING_M)
    known = hills(2, 300)
    drawn = drawn_finer(known, POSTING_M, relief)
    means = drawn.reshape(300, 2, 300, 2).mean(axis=(1, 3))
    assert np.abs(means - known).std() < 0.5 * beyond_means(drawn).std()
    for slope, height_m in fine_relief(drawn, POSTING_M).T:
        assert height_m == pytest.approx(np.interp(slope, *relief), rel=0.4)


def test_steeper_ground_loses_more_to_the_means() -> None:
    slopes, heights_m = fine_relief(real_heights(), POSTING_M)
    assert (np.diff(slopes) > 0.0).all()
    assert 2.0 < heights_m[0] < heights_m[-1] < 12.0


def test_the_model_lies_where_the_coarser_one_does(
    tmp_path: Path, shared_data: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    known_path = shared_data("moon/moon_gld100_32ppd.tif")
    monkeypatch.setenv("OPTNAV_SHARED_DATA", str(known_path.parents[1]))
    path = write_drawn_mare(tmp_path)
    assert path.name == NAME
    again = path.stat().st_mtime_ns
    assert write_drawn_mare(tmp_path).stat().st_mtime_ns == again
    with (
        rasterio.open(path) as fine,
        rasterio.open(known_path) as coarse,
    ):
        assert fine.res[0] == pytest.approx(0.5 * coarse.res[0])
        left, top = (round(v) for v in ~coarse.transform @ (fine.bounds.left, fine.bounds.top))
        rows, cols = (n // 2 for n in fine.shape)
        known = coarse.read(1, window=Window(left, top, cols, rows)).astype(np.float64)
        drawn = fine.read(1)
    means = drawn.reshape(known.shape[0], 2, known.shape[1], 2).mean(axis=(1, 3))
    assert (means - known).std() < 12.0 < 50.0 < np.roll(known, 1, axis=0).std()
    assert abs((means - known).mean()) < 0.1


def test_without_the_shared_model_it_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPTNAV_SHARED_DATA", raising=False)
    with pytest.raises(ConfigError, match="OPTNAV_SHARED_DATA"):
        write_drawn_mare(tmp_path)
