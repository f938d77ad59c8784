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
from optnav_cli.camera.camera import Camera, Coding
from optnav_cli.frames.picture import Picture, load_picture
from optnav_cli.frames.raster_pixels import find_full_scale
from optnav_cli.frames.segmentation import measure_levels

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


def test_colour_pictures_give_their_luminance_or_a_channel(tmp_path: Path) -> None:
    red, green, blue = (content() // part for part in (1, 2, 3))
    path = coloured(tmp_path / "a.png", np.stack([red, green, blue]), None)
    picture = load_picture(path, CAMERA)
    luminance = cv2.cvtColor(np.dstack([red, green, blue]).astype(np.float32), cv2.COLOR_RGB2GRAY)
    np.testing.assert_allclose(picture.values, luminance, atol=0.1)
    (remark,) = picture.remarks
    assert "a.png is in colour: its luminance is used" in remark
    for channel, values in (("red", red), ("green", green), ("blue", blue)):
        picture = load_picture(path, replace(CAMERA, channel=channel))
        np.testing.assert_array_equal(picture.values, values)
        assert picture.remarks == ()
    stated = load_picture(path, replace(CAMERA, channel="luminance"))
    np.testing.assert_allclose(stated.values, luminance, atol=0.1)
    assert stated.remarks == ()
    reds = {n: (n, 0, 0, 255) for n in range(256)}
    palette = load_picture(coloured(tmp_path / "b.png", red[None], reds), CAMERA)
    np.testing.assert_allclose(palette.values, 0.299 * red, atol=0.01)


def test_bands_of_no_known_colour_are_refused(tmp_path: Path) -> None:
    bands = np.stack([content(), content() // 2, content() // 3, content() // 4, content()])
    refused(coloured(tmp_path / "a.tif", bands[:2], None), "2 bands .* of different content")
    refused(coloured(tmp_path / "b.tif", bands, None), "5 bands .* of different content")


def test_clear_palette_entries_have_no_value(tmp_path: Path) -> None:
    index = content(high=200)
    palette = {n: (n, n, n, 0 if n < 20 else 255) for n in range(256)}
    picture = load_picture(coloured(tmp_path / "a.png", index[None], palette), CAMERA)
    without(picture, index < 20, index)


@pytest.mark.parametrize("bits", [8, 16])
def test_white_is_zero_is_heeded(bits: int, tmp_path: Path) -> None:
    dtype = np.uint8 if bits == 8 else np.uint16
    values = content(dtype, 2**bits - 5)
    profile = {"driver": "GTiff", "width": 200, "height": 160, "count": 1, "dtype": dtype}
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        file = rasterio.open(tmp_path / "a.tif", "w", photometric="miniswhite", **profile)
    with file:
        file.write(2**bits - 1 - values, 1)
    np.testing.assert_array_equal(load_picture(tmp_path / "a.tif", CAMERA).values, values)


def exif(order: str, orientation: int) -> bytes:
    """A TIFF without pixels, as EXIF segments have it: one directory with the orientation."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    entry = struct.pack(order + "HHIHH", 274, 3, 1, orientation, 0)
    return head + struct.pack(order + "H", 1) + entry + bytes(4)


def oriented(path: Path, values: np.ndarray, orientation: int) -> Path:
    """A JPEG, PNG or TIFF with an orientation, by its own bytes."""
    saved(path, values)
    raw = path.read_bytes()
    if path.suffix == ".jpg":
        segment = b"Exif\0\0" + exif(">", orientation)
        marker = b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment
        path.write_bytes(raw[:2] + marker + raw[2:])
    elif path.suffix == ".png":
        data = exif("<", orientation)
        chunk = struct.pack(">I", len(data)) + b"eXIf" + data
        chunk += struct.pack(">I", zlib.crc32(b"eXIf" + data))
        path.write_bytes(raw[:33] + chunk + raw[33:])
    else:
        profile = {"driver": "GTiff", "width": values.shape[1], "height": values.shape[0]}
        with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
            file = rasterio.open(path, "w", count=1, dtype=values.dtype, **profile)
        with file:
            file.write(values, 1)
        raw = path.read_bytes()
        start = struct.unpack("<I", raw[4:8])[0]
        count = struct.unpack("<H", raw[start : start + 2])[0]
        entries = raw[start + 2 : start + 2 + 12 * count]
        # the directory again at the end, with one entry more, in the order of the tags
        parts = [entries[at : at + 12] for at in range(0, len(entries), 12)]
        parts.append(struct.pack("<HHIHH", 274, 3, 1, orientation, 0))
        parts.sort(key=lambda part: struct.unpack("<H", part[:2])[0])
        directory = struct.pack("<H", count + 1) + b"".join(parts) + bytes(4)
        path.write_bytes(raw[:4] + struct.pack("<I", len(raw)) + raw[8:] + directory)
    return path


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_a_turned_picture_is_refused_until_the_camera_file_says_how(
    suffix: str, tmp_path: Path
) -> None:
    """OpenCV turns pictures as viewers do: it gives what "apply" has to give."""
    x, y = np.meshgrid(np.arange(200), np.arange(160))
    values = (x // 2 + y // 2 + 20).astype(np.uint8)
    for orientation in range(2, 9):
        path = oriented(tmp_path / f"{orientation}.{suffix}", values, orientation)
        refused(path, f"states Orientation = {orientation}; .*exif_orientation")
        stored = load_picture(path, replace(CAMERA, exif_orientation="ignore")).values
        assert np.abs(stored - values).max() < 4.0
        shown = shown_by_rule(values, orientation)
        if suffix != "tif":  # which OpenCV reads of some orientations alone
            by_opencv = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            assert by_opencv is not None
            assert np.abs(by_opencv.astype(int) - shown).max() < 4
        sides = {"width_px": shown.shape[1], "height_px": shown.shape[0]}
        camera = replace(CAMERA, exif_orientation="apply", **sides)
        picture = load_picture(path, camera)
        assert np.abs(picture.values - shown).max() < 4.0
    plain = oriented(tmp_path / f"1.{suffix}", values, 1)
    assert load_picture(plain, CAMERA).values.shape == CAMERA.shape


def shown_by_rule(values: np.ndarray, orientation: int) -> np.ndarray:
    """EXIF's own words: where row 0 and column 0 of the stored picture are when it is shown."""
    row, column = {
        2: ("top", "right"),
        3: ("bottom", "right"),
        4: ("bottom", "left"),
        5: ("left", "top"),
        6: ("right", "top"),
        7: ("right", "bottom"),
        8: ("left", "bottom"),
    }[orientation]
    turned = values if row in ("top", "bottom") else values.T
    if "bottom" in (row, column):
        turned = turned[::-1]
    return turned[:, ::-1] if "right" in (row, column) else turned


def test_a_gamma_chunk_is_reported_once_no_coding_is_stated(tmp_path: Path) -> None:
    raw = saved(tmp_path / "a.png", content()).read_bytes()
    data = struct.pack(">I", 45455)
    chunk = struct.pack(">I", 4) + b"gAMA" + data + struct.pack(">I", zlib.crc32(b"gAMA" + data))
    (tmp_path / "a.png").write_bytes(raw[:33] + chunk + raw[33:])
    (remark,) = load_picture(tmp_path / "a.png", CAMERA).remarks
    assert "gAMA = 45455" in remark
    camera = replace(CAMERA, coding=Coding("gamma", 2.2))
    assert load_picture(tmp_path / "a.png", camera).remarks == ()


@pytest.mark.parametrize(
    ("coding", "linear"),
    [
        (Coding("square"), lambda counts: counts**2 / 255.0),
        (Coding("gamma", 2.2), lambda counts: 255.0 * (counts / 255.0) ** 2.2),
        (
            Coding("table", None, (0.0, 100.0, 255.0), (0.0, 200.0, 4095.0)),
            lambda counts: np.interp(counts, [0, 100, 255], [0, 200, 4095]),
        ),
    ],
)
def test_coded_counts_become_linear_in_light(
    coding: Coding, linear: Callable[[np.ndarray], np.ndarray], tmp_path: Path
) -> None:
    values = content()
    path = saved(tmp_path / "a.png", values)
    picture = load_picture(path, replace(CAMERA, coding=coding))
    np.testing.assert_allclose(picture.values, linear(values.astype(float)), rtol=1e-6)
    assert picture.saturation == pytest.approx(float(linear(np.array([255.0]))[0]))


def test_margins_of_one_value_are_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    values = np.rint(rng.normal(20.0, 2.0, CAMERA.shape)).astype(np.uint8)
    values[60:100, 80:140] = rng.integers(150, 220, (40, 60))
    edges = np.zeros(CAMERA.shape, bool)
    edges[:, :16] = True
    values[edges] = 0
    picture = load_picture(saved(tmp_path / "a.png", values), CAMERA)
    without(picture, edges, values)
    (remark,) = picture.remarks
    assert remark.startswith("a.png: 8.0 % of its pixels are margins or lost lines of one value")


def test_a_mask_picture_and_the_order_of_lines_are_the_camera_s(tmp_path: Path) -> None:
    values = content()
    path = saved(tmp_path / "a.png", values)
    mask = saved(tmp_path / "mask.png", np.where(gap(), 0, 255).astype(np.uint8))
    without(load_picture(path, replace(CAMERA, valid_mask=str(mask))), gap(), values)
    upside_down = load_picture(path, replace(CAMERA, line_order="bottom_first"))
    np.testing.assert_array_equal(upside_down.values, values[::-1])
    small = saved(tmp_path / "small.png", np.ones((5, 5), np.uint8))
    with pytest.raises(DataError, match=r"small\.png: the mask is 5 x 5; wanted the size"):
        load_picture(path, replace(CAMERA, valid_mask=str(small)))
    with pytest.raises(DataError, match="correct valid_mask"):
        load_picture(path, replace(CAMERA, valid_mask=str(tmp_path / "none.png")))


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


@pytest.mark.parametrize("suffix", ["png", "pgm", "tif"])
def test_the_mask_that_gdal_keeps_beside_a_picture_is_read(suffix: str, tmp_path: Path) -> None:
    """Written by GDAL itself, of the dataset; one of another size or kind is refused."""
    values = content()
    path = tmp_path / f"a.{suffix}"
    assert cv2.imwrite(str(path), values)
    stored = load_picture(path, CAMERA).values
    with pytest.warns(rasterio.errors.NotGeoreferencedWarning):
        file = rasterio.open(path, "r+")
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), file:
        file.write_mask(~gap())
    assert (tmp_path / f"a.{suffix}.msk").exists()
    without(load_picture(path, CAMERA), gap(), stored)
    (tmp_path / f"a.{suffix}.msk").write_bytes(b"no mask")
    with pytest.raises(DataError, match=rf"a\.{suffix}\.msk: cannot be opened"):
        load_picture(path, CAMERA)
    cv2.imwrite(str(tmp_path / "small.tif"), np.ones((5, 5), np.uint8))
    (tmp_path / "small.tif").rename(tmp_path / f"a.{suffix}.msk")
    with pytest.raises(DataError, match=r"the mask is 5 x 5; wanted the picture's size, 200 x 160"):
        load_picture(path, CAMERA)


def test_a_name_too_long_for_a_mask_beside_it_has_none(tmp_path: Path) -> None:
    values = content()
    path = saved(tmp_path / f"{'a' * 249}.png", values)
    assert load_picture(path, CAMERA).valid is None


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


def test_brightness_of_denormal_numbers_is_read_without_overflow(tmp_path: Path) -> None:
    values = np.zeros((8, 8))
    values[3, 3] = 5e-324
    path = tmp_path / "a.tif"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        profile = {"driver": "GTiff", "dtype": "float64", "count": 1, "width": 8, "height": 8}
        with rasterio.open(path, "w", **profile) as file:
            file.write(values, 1)
    picture = load_picture(path, None)
    assert np.isfinite(picture.values).all()
