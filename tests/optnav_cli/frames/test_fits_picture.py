"""FITS pictures: types, scales, gaps, extensions, row order, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from catalog.errors import DataError
from optnav_cli.archives.label import read_label
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.fits_picture import KEYWORDS, find_unit, read_fits
from optnav_cli.frames.picture import load_picture

SHAPE = (30, 40)
CAMERA = Camera("small", "pinhole", 40, 30, 60.0, (19.5, 14.5))


def cards(**values: object) -> bytes:
    """Header cards, with the END card, to whole blocks."""
    lines = []
    for key, value in values.items():
        shown = {True: "T", False: "F"}.get(value, value) if isinstance(value, bool) else value
        text = f"'{shown:8s}'" if isinstance(shown, str) and len(shown) > 1 else str(shown)
        lines.append(f"{key.replace('_', '-'):8s}= {text}".ljust(80))
    text = "".join([*lines, "END".ljust(80)])
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


def image(values: np.ndarray, **more: object) -> bytes:
    """A unit of a picture of two axes, or a first unit's begin where SIMPLE is among `more`."""
    bitpix = {"u1": 8, "i2": 16, "i4": 32, "i8": 64, "f4": -32, "f8": -64}[values.dtype.str[1:]]
    sides = {f"NAXIS{n + 1}": side for n, side in enumerate(values.shape[::-1])}
    begin = {"SIMPLE": True} if "XTENSION" not in more else {"XTENSION": more.pop("XTENSION")}
    head = cards(**begin, BITPIX=bitpix, NAXIS=values.ndim, **sides, **more)
    data = values.astype(values.dtype.newbyteorder(">")).tobytes()
    return head + data.ljust(-(-len(data) // 2880) * 2880, b"\0")


def counts(high: int = 200) -> np.ndarray:
    return np.random.default_rng(8).integers(1, high, SHAPE)


def written(path: Path, raw: bytes) -> Path:
    path.write_bytes(raw)
    return path


def header(*lines: str) -> bytes:
    text = "".join(line.ljust(80) for line in (*lines, "END"))
    return text.ljust(-(-len(text) // 2880) * 2880).encode()


BYTES = ("BITPIX  =                    8", "NAXIS   =                    2")
SIZES = ("NAXIS1  =                   40", "NAXIS2  =                   30")


def test_long_texts_and_long_keywords_are_read_as_the_standard_has_them(tmp_path: Path) -> None:
    """CONTINUE and HIERARCH as astropy writes both; a last & without a CONTINUE is a letter."""
    raw = header(
        "SIMPLE  =                    T",
        *BYTES,
        *SIZES,
        "TARGET  = 'a very long name of a target that does not fit one card, so&'",
        "CONTINUE  '  goes on with Dr. O''Neil&' / first comment",
        "CONTINUE  ' etc.' / second",
        "HIERARCH ESO TEL ALT = 12.5 / [deg] altitude",
        "HIERARCH  ESO OBS NAME= 'M = 3 / x' / name",
        "LAST    = 'A & B &'",
    )
    pixels = counts().astype("u1").tobytes()
    path = written(tmp_path / "a.fits", raw + pixels)
    label = read_label(path, "fits")
    wanted = "a very long name of a target that does not fit one card, so  goes on with "
    assert label.text("TARGET") == wanted + "Dr. O'Neil etc."
    assert label.numbers(("ESO TEL ALT",), "angle")[0] == pytest.approx(np.radians(12.5))
    assert label.text("ESO OBS NAME") == "M = 3 / x"
    assert label.text("LAST") == "A & B &"
    np.testing.assert_array_equal(load_picture(path, CAMERA).values, counts())


def test_of_a_keyword_of_words_in_two_headers_the_picture_s_counts(tmp_path: Path) -> None:
    first = header(
        "SIMPLE  =                    T",
        "BITPIX  =                    8",
        "NAXIS   =                    0",
        "HIERARCH ESO DET GAIN = 1",
        "HIERARCH ESO TEL ALT = 7",
    )
    second = header(
        "XTENSION= 'IMAGE   '",
        *BYTES,
        *SIZES,
        "PCOUNT  =                    0",
        "GCOUNT  =                    1",
        "HIERARCH ESO DET GAIN = 2",
    )
    pixels = counts().astype("u1").tobytes()
    label = read_label(written(tmp_path / "a.fits", first + second + pixels), "fits")
    assert (label.text("ESO DET GAIN"), label.text("ESO TEL ALT")) == ("2", "7")


@pytest.mark.parametrize("kind", ["u1", "i2", "i4", "i8", "f4", "f8"])
def test_a_folder_s_picture_may_be_fits_of_any_type(kind: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.fits", image(counts().astype(kind)))
    picture = load_picture(path, CAMERA)
    np.testing.assert_array_equal(picture.values, counts())
    assert picture.valid is None
    with pytest.raises(DataError, match="is 40 x 30; camera 'small' takes 40 x 31"):
        load_picture(path, replace(CAMERA, height_px=31))


def test_scale_offset_and_blank_are_applied(tmp_path: Path) -> None:
    values = counts(4000).astype(np.int16)
    gap = np.zeros(SHAPE, bool)
    gap[3:9, 5:20] = True
    values[gap] = -32768
    raw = image(values, BLANK=-32768, BSCALE="2.5E-1", BZERO="1.0D2")
    picture = load_picture(written(tmp_path / "a.fits", raw), CAMERA)
    np.testing.assert_array_equal(picture.valid, ~gap)
    np.testing.assert_allclose(picture.values[~gap], values[~gap] * 0.25 + 100.0)
    assert np.isnan(picture.values[gap]).all()
    holed = np.where(gap, np.nan, counts())
    picture = load_picture(written(tmp_path / "b.fits", image(holed)), CAMERA)
    np.testing.assert_array_equal(picture.valid, ~gap)


def test_unsigned_counts_keep_their_type_and_full_scale(tmp_path: Path) -> None:
    values = counts(60000).astype(np.uint16)
    stored = (values.astype(int) - 32768).astype(np.int16)
    path = written(tmp_path / "a.fits", image(stored, BZERO=32768, BSCALE=1))
    picture = load_picture(path, CAMERA)
    np.testing.assert_array_equal(picture.values, values)
    assert picture.saturation == 65535.0
    path = written(tmp_path / "b.fits", image(stored, BZERO=32768, SATURATE="50000.0"))
    assert load_picture(path, CAMERA).saturation == 50000.0
    assert load_picture(path, replace(CAMERA, saturation_counts=4.0)).saturation == 4.0


def test_the_picture_may_be_in_an_extension(tmp_path: Path) -> None:
    first, second = counts().astype(np.int16), counts().astype(np.int16)[::-1]
    raw = cards(SIMPLE=True, BITPIX=8, NAXIS=0, EXTEND=True, OBJECT="EARTH", ORIGIN="first")
    raw += image(first, XTENSION="IMAGE", EXTNAME="RAW-DATA", ORIGIN="unit one")
    raw += image(second, XTENSION="IMAGE", EXTNAME="MASK")
    path = written(tmp_path / "a.fits", raw)
    for extension, values in (("", first), ("1", first), ("2", second), ("mask", second)):
        camera = replace(CAMERA, extension=extension)
        np.testing.assert_array_equal(load_picture(path, camera).values, values)
    with pytest.raises(DataError, match=r"no extension '3'; there are 0 \(no data\), 1 RAW-DATA"):
        load_picture(path, replace(CAMERA, extension="3"))
    with pytest.raises(DataError, match=r"0 .* is no picture"):
        load_picture(path, replace(CAMERA, extension="0"))
    # a label has the keywords of the picture's unit, then those of the first
    label = read_label(path, "fits")
    assert (label.text("OBJECT"), label.text("ORIGIN")) == ("EARTH", "unit one")
    assert read_label(path, "fits", "mask").text("ORIGIN") == "first"


def test_rows_from_below_are_turned_and_a_further_axis_of_one_is_none(tmp_path: Path) -> None:
    values = counts().astype(np.int16)
    path = written(tmp_path / "a.fits", image(values, ROWORDER="BOTTOM-UP"))
    np.testing.assert_array_equal(load_picture(path, CAMERA).values, values[::-1])
    path = written(tmp_path / "b.fits", image(values[None], ROWORDER="TOP-DOWN"))
    np.testing.assert_array_equal(load_picture(path, CAMERA).values, values)
    path = written(tmp_path / "c.fits", image(values, ROWORDER="SIDEWAYS"))
    with pytest.raises(DataError, match="ROWORDER = SIDEWAYS; wanted TOP-DOWN or BOTTOM-UP"):
        load_picture(path, CAMERA)
    planes = np.stack([values] * 3)
    with pytest.raises(DataError, match=r"no picture of two axes; there are 0 \(40 x 30 x 3\)"):
        load_picture(written(tmp_path / "d.fits", image(planes)), CAMERA)


@pytest.mark.parametrize(
    "keyword", [name for name, entry in KEYWORDS.items() if entry.fate == "refused"]
)
def test_what_cannot_be_applied_is_refused_by_name(keyword: str, tmp_path: Path) -> None:
    values = counts().astype(np.int16)
    path = written(tmp_path / "a.fits", image(values, **{keyword: "T"}))
    remedy = KEYWORDS[keyword].why.split(":")[0]
    with pytest.raises(DataError, match=f"states {keyword} = T; {remedy}"):
        load_picture(path, CAMERA)
    for allowed in KEYWORDS[keyword].allowed:
        path.write_bytes(image(values, **{keyword: allowed or "  "}))
        np.testing.assert_array_equal(load_picture(path, CAMERA).values, values)


def test_a_compressed_picture_is_refused_by_name(tmp_path: Path) -> None:
    table = np.zeros((30, 8), np.uint8)
    raw = cards(SIMPLE=True, BITPIX=8, NAXIS=0)
    raw += image(table, XTENSION="BINTABLE", ZIMAGE=True, ZCMPTYPE="RICE_1")
    with pytest.raises(DataError, match=r"states ZIMAGE = T; .*unpack it \(funpack\)"):
        load_picture(written(tmp_path / "a.fits", raw), CAMERA)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"BITPIX  = 16", b"BITPIX  = 12", "BITPIX = 12; wanted 8, 16"),
        (b"NAXIS1  = 40", b"NAXIS1  = x ", "no picture of two axes"),
        (b"NAXIS   = 2", b"NAXIS   = 1", "no picture of two axes"),
        (b"BSCALE  = 1.0", b"BSCALE  = 0.0", "BSCALE = 0"),
        (b"BSCALE  = 1.0", b"BSCALE  = one", "BSCALE = one; wanted a number"),
        (b"BSCALE  = 1.0", b"BSCALE  = nan", "BSCALE = nan; wanted a number"),
        (b"END     ", b"        ", "no end"),
        (b"NAXIS2  = 30", b"NAXIS2  = 99999999", "MiB|cut short|takes"),
    ],
)
def test_damaged_headers_are_named(old: bytes, new: bytes, message: str, tmp_path: Path) -> None:
    raw = image(counts().astype(np.int16), BSCALE="1.0")
    raw = raw.replace(b"'1.0     '", b"1.0       ")
    assert old in raw
    path = written(tmp_path / "a.fits", raw.replace(old.ljust(len(new)), new.ljust(len(old)), 1))
    with pytest.raises(DataError, match=message):
        load_picture(path, CAMERA)


def test_files_that_break_off_are_named(tmp_path: Path) -> None:
    raw = image(counts().astype(np.int16))
    for size in (9, 80, 2000, 2880, 3000, 2880 + 2399):
        path = written(tmp_path / "a.fits", raw[:size])
        with pytest.raises(DataError, match=r"no end|cut short"):
            read_fits(path, find_unit(path))
