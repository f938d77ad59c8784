"""Values that stand for no data without a tag are found; ground that only looks so is not."""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from catalog.config import resource
from catalog.errors import DataError
from catalog.terrain.dem.source import DemSettings, DemSource
from catalog.terrain.dem.validity import HeightSample, find_shared_end
from catalog.terrain.pyramid.pyramid import HeightPyramid
from catalog.terrain.relief.sums import build_relief
from catalog.terrain.slopes import summarise_slopes

SIZE = 200
Y, X = np.mgrid[:SIZE, :SIZE] / SIZE - 0.5
R = np.hypot(X, Y)


def rough(rms_m, seed=4):
    field = gaussian_filter(np.random.default_rng(seed).standard_normal((SIZE, SIZE)), 5.0)
    return np.asarray(rms_m * (field - field.mean()) / field.std())


def smeared(field, value):
    """A hole of a value whose border an interpolation has mixed with the ground."""
    share = np.clip((0.3 - R) * SIZE, 0.0, 1.0)
    return share * value + (1.0 - share) * field


NO_GROUND = {
    "-9999 in a hole": np.where(R < 0.2, -9999.0, rough(150.0)),
    "-9999 in single pixels": np.where(
        np.random.default_rng(1).random((SIZE, SIZE)) < 5e-4, -9999.0, rough(150.0)
    ),
    "-32768 about a strip": np.where(abs(X + Y) > 0.2, -32768.0, rough(150.0)),
    "0 above heights about -3000": np.where(R < 0.2, 0.0, rough(150.0) - 3000.0),
    "9999 above": np.where(R > 0.5, 9999.0, rough(150.0)),
    "-9999 with a mixed border": smeared(rough(150.0), -9999.0),
    "-9999 of a smooth model": np.where(R < 0.1, -9999.0, 3000.0 * np.sin(9 * X) * np.cos(7 * Y)),
    "both ends": np.where(R < 0.1, -9999.0, np.where(R > 0.6, 9999.0, rough(150.0))),
}
GROUND = {
    "rough": rough(150.0),
    "whole metres": np.rint(rough(150.0)),
    "clipped at 0": np.maximum(rough(150.0), 0.0),
    "clipped above": np.minimum(rough(150.0), 60.0),
    "a lake in whole metres": np.maximum(np.rint(rough(150.0)), -80.0),
    "a flat floor and a hill": np.maximum(0.0, (0.1 - R) * SIZE * 80.0),
    "a flat floor in a bowl": np.maximum(R - 0.3, 0.0) * SIZE * 100.0,
    "counts of 100 m": np.rint(rough(300.0) / 100.0) * 100.0,
    "counts of 20 m": np.rint(rough(150.0) / 20.0) * 20.0,
    "two levels": np.where(X > 0.0, 100.0, 0.0),
    "a plain": np.zeros((SIZE, SIZE)),
    "boulders on a plain": np.sqrt(np.maximum(0.0, 600.0**2 - ((R - 0.2) * 20000.0) ** 2)),
    "one spike": np.where(R < 0.003, 5000.0, rough(150.0)),
}


@pytest.mark.parametrize("posting_m", [118.0, 7580.0])
@pytest.mark.parametrize("name", [name for name in NO_GROUND if "mixed" not in name])
def test_a_shared_value_beyond_a_gap_is_found(name, posting_m):
    values = NO_GROUND[name].astype(np.float32).ravel()
    end = find_shared_end(values, posting_m)
    assert end is not None
    extreme = values.min() if end.lowest else values.max()
    assert end.height == extreme
    assert end.share == pytest.approx(np.mean(values == extreme))


def test_a_value_that_resampling_mixed_with_the_ground_is_found():
    values = NO_GROUND["-9999 with a mixed border"].astype(np.float32).ravel()
    end = find_shared_end(values, 118.0)
    assert end is not None
    assert end.height == -9999.0


@pytest.mark.parametrize("name", GROUND)
@pytest.mark.parametrize("posting_m", [118.0, 948.0])
def test_ground_that_shares_an_extreme_is_not(name, posting_m):
    values = (GROUND[name] * posting_m / 118.0).astype(np.float32).ravel()
    assert find_shared_end(values, posting_m) is None


@pytest.mark.parametrize("name", ["tycho_gld100_256ppd.tif", "moon_gld100_4ppd.tif"])
def test_shipped_models_are_ground(moon, name):
    source = DemSource.open(DemSettings(str(resource(f"data/{name}"))), Path(), moon)
    source.check_window(source.read_window(0, 0, *source.shape))


def test_a_sample_holds_every_so_many_pixels():
    sample = HeightSample((4000, 4000))
    assert sample.step == 2
    sample.add(np.array([[1.0, 2.0, np.nan], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]], np.float32))
    np.testing.assert_array_equal(sample.heights, [1.0, 7.0, 9.0])


@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_every_reader_names_the_value_to_state(tmp_path, dems, moon, dtype):
    values = NO_GROUND["-9999 in a hole"].astype(dtype)
    _, affine = dems.rough_region(SIZE)
    path = dems.write(tmp_path / "untagged.tif", values, affine=affine)
    globe = dems.smooth_grid(64)
    globe[20:30, 40:60] = -9999.0
    whole = dems.write(tmp_path / "whole.tif", globe.astype(dtype))

    def source(path, **settings):
        return DemSource.open(DemSettings(path.name, **settings), tmp_path, moon)

    lat, lon = source(path).georeference.latlon_from_pixel([20.0, 180.0], [20.0, 180.0])
    readers = [
        lambda: HeightPyramid.build(source(path), tmp_path / "levels"),
        lambda: summarise_slopes(source(path), 2000.0),
        lambda: source(path).heights_at(lat, lon),
        lambda: build_relief(source(whole)),
    ]
    for reader in readers:
        with pytest.raises(DataError, match=r"lowest height, -9999 m.*state nodata = -9999"):
            reader()
    assert not (tmp_path / "levels").exists()
    # a stated value settles it, be it this one or another
    stated, other = source(path, nodata=-9999.0), source(path, nodata=-1e9)
    assert np.isnan(stated.heights_at(lat, lon)).tolist() == [False, False]
    assert summarise_slopes(other, 2000.0)[0].rms_deg > summarise_slopes(stated, 2000.0)[0].rms_deg


def test_the_stated_value_is_the_stored_one(tmp_path, dems, moon):
    """Of counts with a scale and an offset."""
    values = np.where(R < 0.2, -9999.0, rough(150.0) * 2.0 + 200.0).astype(np.int16)
    _, affine = dems.rough_region(SIZE)
    path = dems.write(tmp_path / "scaled.tif", values, affine=affine)
    source = DemSource.open(DemSettings(path.name, scale=0.5, offset=-100.0), tmp_path, moon)
    with pytest.raises(DataError, match=r"-5099.5 m.*state nodata = -9999 in its \[\[dem\]\]"):
        summarise_slopes(source, 2000.0)


@pytest.mark.parametrize("height", [3e7, -13000.0])
def test_slopes_and_places_refuse_heights_that_the_body_cannot_have(tmp_path, dems, moon, height):
    rough_m, affine = dems.rough_region(64)
    rough_m[30, 30] = height
    path = dems.write(tmp_path / "spike.tif", rough_m, affine=affine)
    source = DemSource.open_alone(path, moon)
    with pytest.raises(DataError, match="on moon they lie between"):
        summarise_slopes(source, 2000.0)
    lat, lon = source.georeference.latlon_from_pixel([5.0, 60.0], [5.0, 60.0])
    with pytest.raises(DataError, match="on moon they lie between"):
        source.heights_at(lat, lon)
