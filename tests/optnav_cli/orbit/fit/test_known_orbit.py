"""Times of pictures by orbits from elsewhere: an OEM, a SPICE kernel, two-line elements."""

from dataclasses import replace

import erfa
import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from catalog.errors import DataError
from catalog.tables import CsvColumn, CsvTable
from optnav_cli.main import run
from optnav_cli.orbit.fit.known_orbit import _utc_days, known_orbit, picture_times
from optnav_cli.orbit.fit.oem import CRAFT, Oem, write_oem, write_spk
from optnav_cli.orbit.fit.problem import OrbitFix
from tests.optnav_cli.orbit.fit.flights import MOON, START_S, fixes_of, truth, write_run

SIGMA_M = 15.0
TIMES = START_S + np.arange(0.0, 5401.0, 60.0)
LATE_S = 40.0  # of the stamps
# ISS, of NASA's page of 2008 that the format's description in Wikipedia shows
ISS = (
    "1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927",
    "2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537",
)


@pytest.fixture(scope="module")
def states():
    return truth(TIMES)


@pytest.fixture(scope="module")
def pictures(states):
    """Places at a few of the times, with stamps that are late."""
    odd = fixes_of(TIMES[7::20], states[7::20], sigma_m=SIGMA_M)
    return [replace(f, tdb_s=f.tdb_s + LATE_S, utc=utc_from_tdb_s(f.tdb_s + LATE_S)) for f in odd]


@pytest.fixture(params=["oem", "bsp"])
def orbit_file(request, states, tmp_path):
    path = tmp_path / f"craft.{request.param}"
    if request.param == "oem":
        write_oem(path, Oem("moon", TIMES, states), "CRAFT")
    else:
        pytest.importorskip("spiceypy", reason="spiceypy (extra spice) is not there")
        write_spk(path, TIMES, states, CRAFT, 301)
    return path


def test_a_file_tells_the_times_of_pictures(orbit_file, pictures):
    timed = picture_times(known_orbit(orbit_file, MOON, CRAFT), pictures, 600.0)
    for one, picture in zip(timed, pictures, strict=True):
        assert one.best is not None
        assert abs(one.best.tdb_s - (picture.tdb_s - LATE_S)) < 4.0 * one.best.sigma_s < 0.1


def test_pictures_without_a_time_are_sought_over_the_whole_orbit(orbit_file, pictures, tmp_path):
    wanted = [picture.tdb_s - LATE_S for picture in pictures]
    write_run(tmp_path / "run", [replace(picture, utc="") for picture in pictures])
    out = tmp_path / "times.csv"
    command = ["orbit", "time", str(tmp_path / "run"), "--orbit", str(orbit_file), "-o", str(out)]
    assert run(command) == 0
    table = CsvTable((CsvColumn("file", "", "text"), CsvColumn("utc", "", "text")))
    found = table.read(out, lambda row: utc_to_tdb_s(row["utc"]))
    assert found == pytest.approx(wanted, abs=0.1)


def test_an_orbit_fit_asks_for_the_times(pictures, tmp_path, capsys):
    write_run(tmp_path / "run", [replace(picture, utc="") for picture in pictures])
    assert run(["orbit", "fit", str(tmp_path / "run"), "-o", str(tmp_path / "orbit")]) == 3
    assert "has no utc; `optnav orbit time` finds it" in capsys.readouterr().err


def test_a_gap_of_an_oem_is_not_bridged(states, pictures, tmp_path):
    write_oem(tmp_path / "a.oem", Oem("moon", TIMES[:20], states[:20]), "CRAFT")
    write_oem(tmp_path / "b.oem", Oem("moon", TIMES[60:], states[60:]), "CRAFT")
    text = (tmp_path / "b.oem").read_text()
    both = (tmp_path / "a.oem").read_text() + text[text.index("META_START") :]
    (tmp_path / "both.oem").write_text(both)
    timed = picture_times(known_orbit(tmp_path / "both.oem", MOON, CRAFT), pictures, 0.0)
    inside = [0, 3, 4]  # numbers 7, 67, 87 of the times; 27 and 47 lie in the gap
    assert [k for k, one in enumerate(timed) if one.passes] == inside


def tle(tmp_path, lines=ISS):
    path = tmp_path / "iss.tle"
    path.write_text("ISS (ZARYA)\n" + "\n".join(lines) + "\n")
    return path


def test_two_line_elements_are_turned_as_sofa_turns_them(tmp_path):
    """Through the true equator and equinox of date and the celestial poles instead of GMST."""
    pytest.importorskip("sgp4", reason="sgp4 (extra tle) is not there")
    from sgp4.api import Satrec

    path = known_orbit(tle(tmp_path), load_body("earth"), CRAFT)
    time = utc_to_tdb_s("2008-09-21T00:00:00Z")
    fixed, spreads = path.fixed(np.array([time]))
    utc = _utc_days(time)
    tt = erfa.taitt(*erfa.utctai(*utc))
    place = 1e3 * np.array(Satrec.twoline2rv(*ISS).sgp4(*utc)[1])
    true_of_date = erfa.rz(erfa.eqeq94(*tt), np.eye(3)).T @ place
    celestial = erfa.pnm06a(*tt).T @ true_of_date
    assert fixed[0, :3] == pytest.approx(erfa.c2t06a(*tt, *utc, 0.0, 0.0) @ celestial, abs=20.0)
    assert np.sqrt(spreads[0, 0, 0]) == pytest.approx(1.5e3, rel=0.1)


def test_two_line_elements_tell_the_times_of_pictures(tmp_path):
    pytest.importorskip("sgp4", reason="sgp4 (extra tle) is not there")
    path = known_orbit(tle(tmp_path), load_body("earth"), CRAFT)
    time = utc_to_tdb_s("2008-09-21T00:00:00Z")
    place = path.fixed(np.array([time]))[0][0, :3]
    stamp = time + 30.0
    fix = OrbitFix("a.png", utc_from_tdb_s(stamp), stamp, "run", "unk", place, 1e4 * np.eye(3))
    (timed,) = picture_times(path, [fix], 600.0)
    assert timed.best is not None
    assert abs(timed.best.tdb_s - time) < 0.02
    assert timed.best.sigma_s == pytest.approx(1.5e3 / 7.3e3, rel=0.15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda one, two: (one[:-1] + "8", two), "line 1 of its TLE fails its checksum"),
        (lambda one, two: (one, two[:20] + "9" + two[21:]), "line 2 of its TLE fails"),
        (lambda one, two: (one, two, one, two), "has 2 sets of two lines"),
        (lambda one, two: (one,), "is no orbit that is known here"),
    ],
)
def test_a_damaged_set_of_lines_is_refused(change, words, tmp_path):
    pytest.importorskip("sgp4", reason="sgp4 (extra tle) is not there")
    with pytest.raises(DataError, match=words):
        known_orbit(tle(tmp_path, change(*ISS)), load_body("earth"), CRAFT)


def test_elements_about_another_body_or_of_another_year_are_refused(tmp_path):
    pytest.importorskip("sgp4", reason="sgp4 (extra tle) is not there")
    with pytest.raises(DataError, match="a TLE is about the Earth, the fixes about moon"):
        known_orbit(tle(tmp_path), MOON, CRAFT)
    path = known_orbit(tle(tmp_path), load_body("earth"), CRAFT)
    with pytest.raises(DataError, match="more than 30 days from the pictures"):
        path.spans(np.array([utc_to_tdb_s("2009-09-21T00:00:00Z")]), 0.0)


def test_a_file_of_no_known_kind_is_named(tmp_path):
    (tmp_path / "x.txt").write_text("hello\n")
    with pytest.raises(DataError, match="wanted a folder of `optnav orbit fit`, a CCSDS OEM"):
        known_orbit(tmp_path / "x.txt", MOON, CRAFT)


def test_picked_points_need_no_time(tmp_path, capsys):
    pictures = tmp_path / "picked"
    assert run(["config", "template", "points", "-o", str(pictures)]) == 0
    assert run(["navigate", str(pictures), "-o", str(tmp_path / "timed")]) == 0
    frames = pictures / "frames.csv"
    head, *rows = frames.read_text().splitlines()
    bare = [",".join([row.split(",")[0], "", *row.split(",")[2:]]) for row in rows]
    frames.write_text("\n".join([head, *bare]) + "\n")
    assert run(["navigate", str(pictures), "-o", str(tmp_path / "run")]) == 0
    for name in ("x_m", "cov_xx_m2"):
        table = CsvTable((CsvColumn(name, ""),))
        timed, found = (
            table.read(tmp_path / which / "solution.csv", lambda row, name=name: row.number(name))
            for which in ("timed", "run")
        )
        assert found == timed
    settings = pictures / "run.toml"
    settings.write_text(settings.read_text().replace("camera_from_body", "camera_from_inertial"))
    assert run(["navigate", str(pictures), "-o", str(tmp_path / "run")]) == 4
    table = (tmp_path / "run" / "solution.csv").read_text()
    assert "utc is empty, and attitudes are against the stars; add the time" in table
