"""Labels of archives, read alike."""

from pathlib import Path

import numpy as np
import pytest

from catalog.errors import DataError
from optnav_cli.archives.label import detect_format, read_label
from optnav_cli.frames.fits_picture import find_unit, read_fits

PDS3 = """PDS_VERSION_ID = PDS3 /* a comment = "no value" */
^IMAGE = ("A.IMG", 3)
TARGET_NAME = "67P/CHURYUMOV-
   GERASIMENKO"
START_TIME = 2014-08-05T21:07:19.029
EXPOSURE_DURATION = 2.5 <SECOND>
SC_TARGET_POSITION_VECTOR = (1.5 <KILOMETER>, -2.0 <KILOMETER>,
                             3.25E2 <KILOMETER>)
RIGHT_ASCENSION = "N/A"
OBJECT = IMAGE
  LINES = 512
  GROUP = INNER
    LINES = 4
  END_GROUP = INNER
END_OBJECT = IMAGE
END
LINES = 9
"""
PDS4 = """<?xml version="1.0"?>
<Product_Observational xmlns="http://pds.nasa.gov/pds4/pds/v1" xmlns:geom="http://x/geom">
 <Identification_Area><title>A</title></Identification_Area>
 <geom:Geometry>
  <geom:Vector_To_Target><geom:x_position unit="km">1.5</geom:x_position>
   <geom:y_position unit="km">-2</geom:y_position></geom:Vector_To_Target>
  <geom:Vector_To_Sun><geom:x_position unit="km">7</geom:x_position></geom:Vector_To_Sun>
 </geom:Geometry>
</Product_Observational>
"""


def fits(bitpix: int, values: np.ndarray, cards: tuple[str, ...] = ()) -> bytes:
    rows, columns = values.shape
    lines = ["SIMPLE  =                    T", f"BITPIX  = {bitpix}", "NAXIS   = 2",
             f"NAXIS1  = {columns}", f"NAXIS2  = {rows} / rows", *cards, "END"]  # fmt: skip
    header = "".join(line.ljust(80) for line in lines).encode()
    return header.ljust(-(-len(header) // 2880) * 2880) + values.tobytes()


def test_a_pds3_label_is_read_with_units_blocks_and_long_values(tmp_path: Path) -> None:
    path = tmp_path / "a.lbl"
    path.write_text(PDS3)
    assert detect_format(path) == "pds3"
    label = read_label(path, "pds3")
    assert label.text("TARGET_NAME") == "67P/CHURYUMOV- GERASIMENKO"
    assert label.text("START_TIME") == "2014-08-05T21:07:19.029"
    vector = label.numbers(("-SC_TARGET_POSITION_VECTOR",), "length")
    np.testing.assert_array_equal(vector, [-1500.0, 2000.0, -325_000.0])
    assert (label.text("LINES"), label.text("IMAGE.INNER.LINES")) == ("512", "4")
    with pytest.raises(DataError, match=r"a\.lbl: its label does not state RIGHT_ASCENSION"):
        label.text("RIGHT_ASCENSION")
    with pytest.raises(DataError, match=r"START_TIME is .*; wanted a number"):
        label.numbers(("START_TIME",))


def test_a_pds4_label_is_read_by_the_ends_of_its_paths(tmp_path: Path) -> None:
    path = tmp_path / "a.xml"
    path.write_text(PDS4)
    assert detect_format(path) == "pds4"
    label = read_label(path, "pds4")
    keys = ("Vector_To_Target/x_position", "-Vector_To_Target/y_position")
    np.testing.assert_array_equal(label.numbers(keys, "length"), [1500.0, 2000.0])
    np.testing.assert_array_equal(label.numbers(("Vector_To_Sun/x_position",), "length"), [7000.0])
    path.write_text(PDS4.replace("?>", "?><!DOCTYPE a [<!ENTITY b 'c'>]>", 1))
    with pytest.raises(DataError, match="no plain PDS4 label"):
        read_label(path, "pds4")
    path.write_text(PDS4[:200])
    with pytest.raises(DataError, match="damaged PDS4 label"):
        read_label(path, "pds4")


def picture(path: Path) -> np.ndarray:
    return read_fits(path, find_unit(path)).values


@pytest.mark.parametrize(
    ("bitpix", "dtype"), [(8, "u1"), (16, ">i2"), (32, ">i4"), (-32, ">f4"), (-64, ">f8")]
)
def test_fits_pictures_of_every_type_are_read(tmp_path: Path, bitpix: int, dtype: str) -> None:
    values = np.arange(12).reshape(3, 4).astype(dtype)
    path = tmp_path / "a.fit"
    path.write_bytes(fits(bitpix, values, ("NEAR-005= 'MSI''s  '", "COMMENT  = nothing")))
    assert detect_format(path) == "fits"
    label = read_label(path, "fits")
    assert label.text("NEAR-005") == "MSI's"
    np.testing.assert_array_equal(picture(path), np.arange(12).reshape(3, 4))


def test_fits_values_are_scaled_as_the_header_says(tmp_path: Path) -> None:
    values = np.array([[-32768, 0], [1, 32767]], ">i2")
    path = tmp_path / "a.fit"
    path.write_bytes(fits(16, values, ("BZERO   = 32768", "BSCALE  = 1")))
    np.testing.assert_array_equal(picture(path), [[0, 32768], [32769, 65535]])


def test_damaged_fits_files_are_refused(tmp_path: Path) -> None:
    whole = fits(-32, np.ones((3, 4), ">f4"))
    path = tmp_path / "a.fit"
    for raw, message in (
        (whole[:-8], "cut short"),
        (whole[:2000].replace(b"END", b"   "), "no end"),
        (whole.replace(b"NAXIS   = 2", b"NAXIS   = 3"), "two axes"),
        (whole.replace(b"BITPIX  = -32", b"BITPIX  = 100"), "states BITPIX = 100; wanted"),
    ):
        path.write_bytes(raw)
        with pytest.raises(DataError, match=message):
            picture(path)


def test_settings_are_read_by_section_with_lists(tmp_path: Path) -> None:
    path = tmp_path / "a.lbl"
    path.write_text("[main]\nx = 0\n\n[real]\nx = 0.5\nsun = [ 1e8 -2e8 3.5 ]\n")
    assert detect_format(path) == "settings"
    label = read_label(path, "settings")
    np.testing.assert_array_equal(label.numbers(("real.x", "real.sun")), [0.5, 1e8, -2e8, 3.5])


def test_labels_that_would_take_long_do_not(tmp_path: Path) -> None:
    """Unclosed comments and brackets are not looked for to the end again and again."""
    path = tmp_path / "a.lbl"
    path.write_text("PDS_VERSION_ID = PDS3\n" + "/*" * 100_000 + "\nA = (\n" * 20_000)
    with pytest.raises(DataError, match=r"line 2: .* is no statement"):
        read_label(path, "pds3")
    path.write_text("PDS_VERSION_ID = PDS3\n" + "/* " * 100_000 + "\nA = (\n" * 20_000)
    with pytest.raises(DataError, match="line 3: a sequence or set has no end"):
        read_label(path, "pds3")
    path.write_text("<Product_Observational>" + "<a>" * 1000 + "</a>" * 1000)
    with pytest.raises(DataError, match=r"too deep|damaged"):
        read_label(path, "pds4")
