"""Picture files."""

import os
import struct
import tracemalloc
import warnings
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from catalog.errors import DataError
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.full_scale import find_full_scale
from optnav_cli.frames.picture import Picture, load_picture
from optnav_cli.measurements.segmentation import measure_levels

CAMERA = Camera("test", "pinhole", 200, 160, 300.0, (99.5, 79.5))


def content(dtype: type = np.uint8, high: int = 250) -> np.ndarray:
    return np.random.default_rng(4).integers(1, high, CAMERA.shape).astype(dtype)


def saved(path: Path, values: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), values)
    return path


@pytest.mark.parametrize("suffix", ["png", "tif", "pgm"])
@pytest.mark.parametrize(
    ("dtype", "high", "top"), [(np.uint8, 250, 255.0), (np.uint16, 60000, 65535.0)]
)
def test_grey_pictures_of_8_and_16_bit_read_as_written(
    suffix: str, dtype: type, high: int, top: float, tmp_path: Path
) -> None:
    values = content(dtype, high)
    picture = load_picture(saved(tmp_path / f"a.{suffix}", values), CAMERA)
    assert picture.values.dtype == np.float32
    np.testing.assert_array_equal(picture.values, values)
    assert picture.saturation == top


def test_a_float_tiff_has_no_saturation(tmp_path: Path) -> None:
    values = content().astype(np.float32) / 7.0
    path = tmp_path / "a.tif"
    profile = {"driver": "GTiff", "width": 200, "height": 160, "count": 1, "dtype": "float32"}
    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        rasterio.open(path, "w", **profile) as file,
    ):
        file.write(values, 1)
    picture = load_picture(path, CAMERA)
    np.testing.assert_array_equal(picture.values, values)
    assert picture.saturation is None


@pytest.mark.parametrize(("brightest", "exponent"), [(1.2, 15), (0.3, 17), (2e-4, 28)])
def test_a_picture_of_brightness_below_a_count_is_not_empty(
    brightest: float, exponent: int, tmp_path: Path
) -> None:
    rows, cols = np.indices(CAMERA.shape)
    disc = np.hypot(rows - 80.0, cols - 100.0) < 40.0
    noise = np.random.default_rng(3).normal(0.0, 0.002, CAMERA.shape)
    values = (brightest * (0.7 * disc + noise)).astype(np.float32)
    values[80, 100] = brightest
    picture = load_picture(coloured(tmp_path / "a.tif", values[None], None), CAMERA)
    np.testing.assert_array_equal(picture.values, values * np.float32(2.0**exponent))
    threshold = measure_levels(picture.values).threshold
    np.testing.assert_array_equal(picture.values > threshold, disc)
    # whole numbers are counts, however few
    whole = coloured(tmp_path / "b.tif", disc[None].astype(np.float32), None)
    np.testing.assert_array_equal(load_picture(whole, CAMERA).values, disc)


def coloured(path: Path, bands: np.ndarray, palette: dict[int, tuple[int, ...]] | None) -> Path:
    """A PNG or TIFF of bands (n, h, w), perhaps with a palette."""
    driver = "PNG" if path.suffix == ".png" else "GTiff"
    profile = {"driver": driver, "width": 200, "height": 160, "count": len(bands)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path, "w", dtype=bands.dtype, **profile) as file:
            file.write(bands)
            if palette is not None:
                file.write_colormap(1, palette)
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("count", [2, 3, 4])
def test_colour_files_with_equal_bands_are_gray(count: int, dtype: type, tmp_path: Path) -> None:
    gray = content(dtype)
    opaque = np.full_like(gray, np.iinfo(dtype).max)
    bands = [gray] * (count if count == 3 else count - 1) + [opaque] * (count != 3)
    picture = load_picture(coloured(tmp_path / "a.png", np.stack(bands), None), CAMERA)
    np.testing.assert_array_equal(picture.values, gray)
    assert picture.saturation == np.iinfo(dtype).max


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_a_palette_of_grays_is_gray(suffix: str, tmp_path: Path) -> None:
    index = content(high=200)
    palette = {n: (255 - n, 255 - n, 255 - n, 255) for n in range(256)}
    path = coloured(tmp_path / f"a.{suffix}", index[None], palette)
    np.testing.assert_array_equal(load_picture(path, CAMERA).values, 255 - index)


def test_colours_are_refused(tmp_path: Path) -> None:
    gray = content()
    tinted = gray.copy()
    tinted[7, 9] -= 1
    refused(
        coloured(tmp_path / "tinted.png", np.stack([gray, tinted, gray]), None),
        rf"in colour: at pixel \(9, 7\) one band is {gray[7, 9]} and another {tinted[7, 9]}",
    )
    reds = {n: (n, 0, 0, 255) for n in range(256)}
    refused(coloured(tmp_path / "reds.png", gray[None], reds), "in colour")


def without(picture: Picture, gap: np.ndarray, values: np.ndarray) -> None:
    """Demand that the pixels of a gap, and no others, have no value."""
    assert picture.valid is not None
    np.testing.assert_array_equal(picture.valid, ~gap)
    np.testing.assert_array_equal(picture.values, np.where(gap, np.nan, values))


def gap() -> np.ndarray:
    mask = np.zeros(CAMERA.shape, bool)
    mask[:, :12], mask[70:80, 90:120] = True, True
    return mask


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_transparent_pixels_have_no_value(suffix: str, tmp_path: Path) -> None:
    gray, alpha = content(), np.where(gap(), 0, 255).astype(np.uint8)
    path = tmp_path / f"a.{suffix}"
    if suffix == "png":
        coloured(path, np.stack([gray, gray, gray, alpha]), None)
    else:
        profile = {"driver": "GTiff", "width": 200, "height": 160, "count": 2, "dtype": "uint8"}
        with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
            file = rasterio.open(path, "w", alpha="yes", photometric="minisblack", **profile)
        with file:
            file.write(np.stack([gray, alpha]))
    without(load_picture(path, CAMERA), gap(), gray)


def test_a_mask_band_and_a_no_data_value_leave_pixels_without_a_value(tmp_path: Path) -> None:
    values = content(np.uint16, 4000)
    values[gap()] = 4050
    profile = {"driver": "GTiff", "width": 200, "height": 160, "count": 1, "dtype": "uint16"}
    for name, more in (("mask", {}), ("nodata", {"nodata": 4050})):
        with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
            file = rasterio.open(tmp_path / f"{name}.tif", "w", **profile, **more)
        with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), file:
            file.write(values, 1)
            if not more:
                file.write_mask(~gap())
        without(load_picture(tmp_path / f"{name}.tif", CAMERA), gap(), values)


def test_nan_and_what_lies_outside_the_usable_area_have_no_value(tmp_path: Path) -> None:
    values = content().astype(np.float32)
    holed = np.where(gap(), np.float32(np.nan), values)
    path = coloured(tmp_path / "a.tif", holed[None], None)
    without(load_picture(path, CAMERA), gap(), values)
    outside = np.ones(CAMERA.shape, bool)
    outside[5:151, 20:191] = False
    camera = replace(CAMERA, valid_area_px=(20, 5, 190, 150))
    without(load_picture(path, camera), gap() | outside, values)
    nothing = coloured(tmp_path / "b.tif", np.full_like(holed, np.nan)[None], None)
    refused(nothing, "no pixel of the picture has a value")


@pytest.mark.parametrize(
    ("kind", "full", "factor"),
    [("uint16", 4095.0, 1), ("uint16", 16383.0, 1), ("uint16", 65520.0, 16), ("uint8", 240.0, 1)]
    + [("float32", 4095.0, 1), ("float32", 1.17, 1), ("int16", 16383.0, 1)],
)
def test_clipped_pixels_show_the_full_scale(
    kind: str, full: float, factor: int, tmp_path: Path
) -> None:
    random = np.random.default_rng(2)
    light = random.uniform(0.05, 1.6, CAMERA.shape) * full
    counts = np.minimum(light, full)
    if full > 2.0:
        counts = np.floor(counts / factor) * factor
    values = counts.astype(kind)
    picture = load_picture(coloured(tmp_path / "a.tif", values[None], None), CAMERA)
    assert picture.saturation is not None
    share = float((picture.values >= picture.saturation).mean())
    assert share == pytest.approx(float((light >= full).mean()), abs=1e-3)
    stated = replace(CAMERA, saturation_counts=0.5 * full)
    picture = load_picture(tmp_path / "a.tif", stated)
    half = float((picture.values >= picture.saturation).mean())
    assert half == pytest.approx(float((light >= 0.5 * full).mean()), abs=2e-2)


@pytest.mark.parametrize("spread", [1, 257])
def test_smooth_histograms_show_no_full_scale(spread: int) -> None:
    random = np.random.default_rng(5)
    for peak in (20.0, 200.0, 3000.0):
        light = random.normal(0.6 * peak, 0.1 * peak, (300, 300)) + random.normal(2.0, 1.0)
        counts = np.clip(np.rint(light), 0, None).astype(np.uint16) * spread
        assert find_full_scale(counts) is None
        assert find_full_scale(light.astype(np.float32)) is None


def refused(path: Path, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        load_picture(path, CAMERA)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_or_empty_file_is_named(tmp_path: Path) -> None:
    refused(tmp_path / "none.png", "no such picture")
    (tmp_path / "empty.png").touch()
    refused(tmp_path / "empty.png", "empty file")


@pytest.mark.parametrize("suffix", ["png", "tif", "pgm"])
@pytest.mark.parametrize("share", [0.9, 0.5, 0.01])
def test_a_truncated_picture_is_refused_and_not_filled_up(
    suffix: str, share: float, tmp_path: Path
) -> None:
    path = saved(tmp_path / f"a.{suffix}", content())
    raw = path.read_bytes()
    path.write_bytes(raw[: int(len(raw) * share)])
    refused(path, "broken|damaged")


def test_a_flipped_bit_in_a_png_is_found(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", content())
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 4
    path.write_bytes(raw)
    refused(path, "broken: wrong checksum")


def test_a_text_named_png_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_text("this is not a picture")
    refused(path, "broken or of no known kind")


def test_a_picture_of_another_size_names_both_sizes(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.png", content()[:, :100])
    refused(path, "100 x 160; camera 'test' takes 200 x 160")
    # the transposed picture has the right number of pixels
    refused(saved(tmp_path / "b.png", content().T.copy()), "160 x 200")


def test_colour_is_refused(tmp_path: Path) -> None:
    grey = content()
    refused(saved(tmp_path / "a.png", np.dstack([grey, grey // 2, grey])), "colour")


@pytest.mark.parametrize(
    ("value", "message"), [(0, "all black"), (255, "all white"), (90, "same value, 90")]
)
def test_a_picture_without_content_is_refused(value: int, message: str, tmp_path: Path) -> None:
    refused(saved(tmp_path / "a.png", np.full(CAMERA.shape, value, np.uint8)), message)


def test_a_picture_with_infinities_is_refused(tmp_path: Path) -> None:
    values = content().astype(np.float32)
    values[3, 4] = np.inf
    refused(saved(tmp_path / "a.tif", values), "not finite")


def test_a_picture_beyond_single_precision_is_refused(tmp_path: Path) -> None:
    values = content().astype(np.float64)
    values[3, 4] = 1e300
    refused(saved(tmp_path / "a.tif", values), r"values of .* to 1e\+300; wanted at most 1e\+30")


def test_the_apollo_frame_and_its_cube_read(shared_data: Callable[[str], Path]) -> None:
    frame = Camera("metric", "pinhole", 1012, 1012, 673.3, (505.5, 505.5))
    crop = Camera("crop", "pinhole", 500, 500, 673.3, (0.0, 0.0))
    png = load_picture(shared_data("apollo15/AS15-M-0297_SML.png"), frame)
    assert png.saturation == 255.0
    # the digital count of the scan is a 16-bit one, stored as real numbers
    cube = load_picture(shared_data("apollo15/AS15-M-0297_crop.cub"), crop)
    assert cube.saturation is None
    assert 2e4 < float(np.median(cube.values)) < 2.2e4


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "loop.png").symlink_to("loop.png")
    (tmp_path / "folder.png").mkdir()
    wanted = {"pipe": "pipe or a device", "loop": "cannot be read", "folder": "is a folder"}
    for name, message in wanted.items():
        refused(tmp_path / f"{name}.png", message)


def test_a_huge_picture_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    """40 000 x 40 000 pixels of one value are 8 MB as a file and 6.4 GB as numbers."""
    path = tmp_path / "huge.png"

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    head = struct.pack(">IIBBBBB", 40_000, 40_000, 8, 0, 0, 0, 0)
    data = zlib.compress(bytes(100))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    )
    tracemalloc.start()
    refused(path, "40000 x 40000; camera")
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()
