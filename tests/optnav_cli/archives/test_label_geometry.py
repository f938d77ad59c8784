"""Time, attitude and vectors by the keywords of a table."""

from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.errors import DataError
from optnav_cli.archives.label import ArchiveLabel, read_label
from optnav_cli.archives.label_geometry import (
    AttitudeKeys,
    TimeKeys,
    VectorKeys,
    find_axes,
    is_vector_stated,
    read_attitude,
    read_time,
    read_vector,
)

MOON = load_body("moon")
VECTOR = VectorKeys(keys=("V",))
BORESIGHT = AttitudeKeys(boresight=("RA", "DEC", "CLOCK"))


def pds3(folder: Path, **stated: str) -> ArchiveLabel:
    path = folder / "a.lbl"
    lines = [f"{key} = {value}" for key, value in {"PDS_VERSION_ID": "PDS3", **stated}.items()]
    path.write_text("\n".join([*lines, "END", ""]))
    return read_label(path, "pds3")


def fits(folder: Path, *cards: str) -> ArchiveLabel:
    path = folder / "a.fit"
    lines = ["SIMPLE  =                    T", "NAXIS   = 0", *cards, "END"]
    path.write_bytes("".join(line.ljust(80) for line in lines).encode().ljust(2880))
    return read_label(path, "fits")


def pds4(folder: Path, elements: str) -> ArchiveLabel:
    path = folder / "a.xml"
    path.write_text(f"<Product_Observational><G>{elements}</G></Product_Observational>")
    return read_label(path, "pds4")


@pytest.mark.parametrize(
    "value",
    [
        "(1.5, -2, 3E1)", "(1500 <m>, -2000 <M>, 3D4 <meter>)", "(1.5, -2, 30) <KM>",
        "{1.5 <km>, -2000 <m>, 30000000 <mm>}", "((1.5, -2), (30)) <kilometers>",
        "(1.5, -2, 16#1E#) <N/A>",
    ],
)  # fmt: skip
def test_lengths_of_pds3_are_metres_in_every_unit(tmp_path: Path, value: str) -> None:
    vector = read_vector(pds3(tmp_path, V=value), VECTOR, MOON)
    np.testing.assert_allclose(vector, [1500.0, -2000.0, 30_000.0], rtol=1e-12)


def test_the_unit_of_the_table_holds_where_none_is_stated(tmp_path: Path) -> None:
    keys = VectorKeys(keys=("V",), unit_m=1.0)
    bare = read_vector(pds3(tmp_path, V="(1, 2, 3)"), keys, MOON)
    stated = read_vector(pds3(tmp_path, V="(1, 2, 3) <km>"), keys, MOON)
    np.testing.assert_allclose(stated, 1e3 * bare)


def test_units_of_pds4_and_fits_are_converted(tmp_path: Path) -> None:
    by_attribute = '<x unit="m">1500</x><y unit="km">-2</y><z>30</z>'
    keys = VectorKeys(keys=("G/x", "G/y", "G/z"))
    vector = read_vector(pds4(tmp_path, by_attribute), keys, MOON)
    np.testing.assert_allclose(vector, [1500.0, -2000.0, 30_000.0])
    keys = VectorKeys(keys=("X", "Y", "Z"))
    cards = ("X       = 1500. / [m] x", "Y       = '-2' / position, in (y) km", "Z       = 3.0D1")
    np.testing.assert_allclose(read_vector(fits(tmp_path, *cards), keys, MOON), vector)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("(1, 2, 3) <deg>", r"a\.lbl: V = 1 <deg>, which is a unit of angle; wanted a length"),
        ("(1, 2, 3) <furlong>", "V = 1 <furlong>, which is no unit that is known"),
        ("(1, 2, 3) <km/s>", "unit of speed"),
        ("(1, 2)", "V are 2 numbers; wanted 3"),
        ("(1, 2, x)", "V is 'x'; wanted a number"),
        ("(1, 2, 1_000)", "V is '1_000'; wanted a number"),
        ("(1, 2, 1E33)", "no number below 1e"),
        ("(1, 2, 2#12#)", "wanted a number"),
    ],
)
def test_other_units_and_no_numbers_are_refused_by_name(
    tmp_path: Path, value: str, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        read_vector(pds3(tmp_path, V=value), VECTOR, MOON)


def test_angles_are_radians_in_every_unit(tmp_path: Path) -> None:
    degrees = read_attitude(pds3(tmp_path, RA="30", DEC="-40 <deg>", CLOCK="7.5"), BORESIGHT)
    others = pds3(
        tmp_path, RA="523.5987755982989 <mrad>", DEC="-144000 <arcsec>", CLOCK="450 <arcmin>"
    )
    assert (read_attitude(others, BORESIGHT) * degrees.inv()).magnitude() < 1e-12
    with pytest.raises(DataError, match=r"RA = 2 <hour>, which is a unit of time; wanted an angle"):
        read_attitude(pds3(tmp_path, RA="2 <hour>", DEC="0", CLOCK="0"), BORESIGHT)
    with pytest.raises(DataError, match="wanted angles within one turn"):
        read_attitude(pds3(tmp_path, RA="-999.0", DEC="0", CLOCK="0"), BORESIGHT)


@pytest.mark.parametrize(
    ("value", "half_s"),
    [("2", 1e-3), ("2 <ms>", 1e-3), ("2 <s>", 1.0), ("2 <MICROSECONDS>", 1e-6)],
)
def test_half_of_the_exposure_is_added_in_its_unit(
    tmp_path: Path, value: str, half_s: float
) -> None:
    keys = TimeKeys(utc="T", exposure="E", exposure_s=1e-3)
    start = "2014-217T12:00:00.25"
    utc, tdb_s = read_time(pds3(tmp_path, T=start, E=value), keys)
    assert tdb_s == pytest.approx(utc_to_tdb_s(start) + half_s, abs=6e-4)  # whole ms
    assert utc.startswith("2014-08-05T12:00:0")


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ("2014-08-05", "T: time '2014-08-05' is not understood"),
        ("2014-08-05T12:00:00-08:00", r"T: time .* is not UTC \(it ends in '-08:00'\)"),
        ("2014-367T00:00:00", "T: .* 2014 has no day 367"),
        ("soon", "T: time 'soon' is not understood"),
        ("", "does not state T"),
        ("UNK", "does not state T"),
    ],
)
def test_a_time_that_is_not_understood_names_file_and_keyword(
    tmp_path: Path, time: str, message: str
) -> None:
    with pytest.raises(DataError, match=rf"a\.lbl: .*{message}"):
        read_time(pds3(tmp_path, T=time), TimeKeys(utc="T"))


def test_a_time_in_fields_is_read(tmp_path: Path) -> None:
    label = pds3(tmp_path, Y="1996", D="178", H="8", M="46", S="4", MS="890")
    keys = TimeKeys(fields=("Y", "D", "H", "M", "S", "MS"))
    assert read_time(label, keys)[0] == "1996-06-26T08:46:04.890Z"


def test_a_position_is_a_range_above_a_point(tmp_path: Path) -> None:
    keys = VectorKeys(sub_point=("LAT", "LON"), range="R")
    stated = {"LAT": "30.0", "LON": "60.0 <deg>", "R": "2000.0 <km>"}
    x, y, z = 2e6 * np.array([np.sqrt(3.0) / 4.0, 0.75, 0.5])
    label = pds3(tmp_path, **stated)
    assert find_axes(label, keys) == "body"
    np.testing.assert_allclose(read_vector(label, keys, MOON), [x, y, z])
    west = pds3(tmp_path, **stated, POSITIVE_LONGITUDE_DIRECTION="WEST")
    np.testing.assert_allclose(read_vector(west, keys, MOON), [x, -y, z])
    by_table = VectorKeys(sub_point=("LAT", "LON"), range="R", longitude="west")
    np.testing.assert_allclose(read_vector(label, by_table, MOON), [x, -y, z])
    for change, message in (
        ({"LAT": "95"}, "LAT is 95 deg; wanted -90 to 90"),
        ({"R": "-999"}, "R is -999000 m; wanted a distance > 0"),
        ({"POSITIVE_LONGITUDE_DIRECTION": "UP"}, "DIRECTION = UP; wanted WEST or EAST"),
    ):
        with pytest.raises(DataError, match=message):
            read_vector(pds3(tmp_path, **{**stated, **change}), keys, MOON)


def test_planetographic_latitudes_are_brought_to_the_centre(tmp_path: Path) -> None:
    """On an ellipsoid of 2:1 the normal at 45 deg belongs to a point at atan(1/4)."""
    body = load_body("phobos")
    equator, pole = float(np.mean(body.radii_m[:2])), body.radii_m[2]
    keys = VectorKeys(sub_point=("LAT", "LON"))
    label = pds3(tmp_path, LAT="45", LON="0", COORDINATE_SYSTEM_NAME="PLANETOGRAPHIC")
    direction = read_vector(label, keys, body)
    assert direction[2] / direction[0] == pytest.approx((pole / equator) ** 2)
    plain = read_vector(pds3(tmp_path, LAT="45", LON="0"), keys, body)
    assert plain[2] == pytest.approx(plain[0])


@pytest.mark.parametrize(
    ("frame", "axes"),
    [("J2000", "inertial"), ("EME J2000", "inertial"), ("ICRF", "inertial"),
     ("CERES_FIXED", "body"), ("IAU_MOON", "body"), ("PLANETOCENTRIC", "inertial"),
     ("UNK", "inertial")],
)  # fmt: skip
def test_the_frame_that_a_label_names_is_heeded(tmp_path: Path, frame: str, axes: str) -> None:
    label = pds3(tmp_path, V="(1, 2, 3)", COORDINATE_SYSTEM_NAME=f'"{frame}"')
    assert find_axes(label, VECTOR) == axes
    assert find_axes(label, VectorKeys(keys=("V",), axes="camera")) == "camera"
    tag = "Reference_Frame_Identification"
    elements = f"<W><x>1</x></W><{tag}><name>{frame}</name></{tag}>"
    assert find_axes(pds4(tmp_path, elements), VectorKeys(keys=("W/x",))) == axes


def test_a_frame_that_is_not_known_is_refused(tmp_path: Path) -> None:
    label = pds3(tmp_path, V="(1, 2, 3)", COORDINATE_SYSTEM_NAME='"S/C-COORDS"')
    with pytest.raises(DataError, match="COORDINATE_SYSTEM_NAME = S/C-COORDS for V, a frame"):
        find_axes(label, VECTOR)
    turned = (
        "<O><ra>1</ra><dec>2</dec><c>3</c><Reference_Frame_Identification><name>IAU_MOON</name>"
        "</Reference_Frame_Identification></O>"
    )
    with pytest.raises(DataError, match="in the frame of the body; wanted one in J2000"):
        read_attitude(pds4(tmp_path, turned), AttitudeKeys(boresight=("O/ra", "O/dec", "O/c")))


def test_elements_of_one_name_are_told_apart_by_what_is_in_them(tmp_path: Path) -> None:
    label = pds4(
        tmp_path,
        "<Q><q>0.5</q><To><name>Spacecraft</name></To></Q><Q><q>0.7</q><To><name>Camera</name></To></Q>",
    )
    np.testing.assert_array_equal(label.numbers(("Q[To/name=Camera]/q",)), [0.7])
    np.testing.assert_array_equal(label.numbers(("Q[To/name=spacecraft]/q",)), [0.5])
    assert not label.is_stated("Q[To/name=Body]/q")
    with pytest.raises(DataError, match=r"states Q/q several times \(0\.5, 0\.7\)"):
        label.numbers(("Q/q",))


def test_a_keyword_that_is_stated_twice_differently_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.lbl"
    path.write_text(
        "PDS_VERSION_ID = PDS3\nOBJECT = A\nX = 1\nEND_OBJECT\nX = 2\nY = 3\nY = 4\nEND\n"
    )
    label = read_label(path, "pds3")
    assert label.numbers(("X", "A.X")).tolist() == [2.0, 1.0]
    with pytest.raises(DataError, match="states Y several times"):
        label.text("Y")


@pytest.mark.parametrize("value", ['"N/A"', "UNK", '("N/A", "N/A", "N/A")', "(\n)", "", "'NULL'"])
def test_a_value_for_missing_ones_is_none(tmp_path: Path, value: str) -> None:
    assert not is_vector_stated(pds3(tmp_path, V=value, NEXT="1"), VECTOR)
    assert is_vector_stated(pds3(tmp_path, V="(1, 2, 3)"), VECTOR)
