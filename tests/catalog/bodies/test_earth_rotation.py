"""The Earth's rotation by IAU 2006/2000A and tables of the IERS."""

from itertools import pairwise
from pathlib import Path

import erfa
import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, load_ephemeris
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.rotation import (
    EARTH_RATE_M_S,
    body_from_inertial,
    read_earth_orientation,
    rotate_earth,
)
from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC

EARTH = load_body("earth")
NOON = utc_to_tdb_s("2007-04-05T12:00:00Z")
MJD = 54195  # of that day
# SOFA Tools for Earth Attitude (IAU SOFA), section 5: pole, arcsec, UT1 - UTC, s, offsets, mas.
POLE, UT1_UTC, OFFSETS = (0.0349282, 0.4833163), -0.072073685, (0.1750, -0.2259)
TERRESTRIAL = [
    [+0.973104317697535, +0.230363826239128, -0.000703163482198],
    [-0.230363800456037, +0.973104570632801, +0.000118545366625],
    [+0.000711560162668, +0.000046626403995, +0.999999745754024],
]


def finals(mjd: float, ut1: float = UT1_UTC, pole=POLE, offsets=OFFSETS, ut1_sigma=1e-5) -> str:
    """A line of finals2000A: columns as readme.finals2000A states them."""
    year, month, day, _ = erfa.jd2cal(2400000.5, mjd)
    return (
        f"{int(year) % 100:2d}{int(month):2d}{int(day):2d} {mjd:8.2f} I {pole[0]:9.6f}{3e-5:9.6f} "
        f"{pole[1]:9.6f}{3e-5:9.6f}  I{ut1:10.7f}{ut1_sigma:10.7f} {0.8:7.4f}{0.01:7.4f}  I "
        f"{offsets[0]:9.3f}{0.1:9.3f} {offsets[1]:9.3f}{0.1:9.3f}"
    )


def c04(mjd: float, columns: int, ut1: float = UT1_UTC) -> str:
    """A line of EOP C04: of series 20 with 21 columns, of series 14 with 16."""
    year, month, day, _ = erfa.jd2cal(2400000.5, mjd)
    date, (x, y), (dx, dy) = f"{year:4d} {month:3d} {day:3d}", POLE, np.array(OFFSETS) * 1e-3
    if columns == 21:
        values = [x, y, ut1, dx, dy, 0.0, 0.0, 8e-4, 3e-5, 3e-5, 1e-5, *[1e-4] * 5]
        return f"{date}   0 {mjd:10.2f} " + " ".join(f"{v:12.7f}" for v in values)
    values = [x, y, ut1, 8e-4, dx, dy, 3e-5, 3e-5, 1e-5, 1e-5, 1e-4, 1e-4]
    return f"{date} {mjd:6.0f} " + " ".join(f"{v:12.7f}" for v in values)


def table(folder: Path, lines: list[str]) -> Path:
    path = folder / "finals2000A.all"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("kind", ["finals", "c04_20", "c04_14"])
def test_the_published_example_of_sofa_is_met_by_each_kind_of_table(kind, tmp_path):
    """To 2e-12, 13 micrometres at the surface; the day's noon lies between two equal lines."""
    lines = {
        "finals": [finals(MJD + k) for k in range(3)],
        "c04_20": ["# YR MM DD HH MJD", *(c04(MJD + k, 21) for k in range(3))],
        "c04_14": ["  EOP (IERS) 14 C04", *(c04(MJD + k, 16) for k in range(3))],
    }[kind]
    orientation = read_earth_orientation(table(tmp_path, lines))
    found = rotate_earth(NOON, orientation)
    np.testing.assert_allclose(found, TERRESTRIAL, atol=2e-12 if kind != "c04_20" else 3e-12)


def test_the_rotation_without_a_table_is_that_of_sofas_own_chain():
    """`c2t06a` of SOFA's test suite, t_sofa_c.c, gives this first row; then at our time."""
    pole = 2.55060238e-7, 1.860359247e-6
    row = erfa.c2t06a(2400000.5, 53736.0, 2400000.5, 53736.0, *pole)[0]
    np.testing.assert_allclose(
        row, [-0.1810332128305897282, 0.9834769806938592296, 0.6555550962998436505e-4], atol=1e-12
    )
    utc = erfa.dtf2d("UTC", 2007, 4, 5, 12, 0, 0.0)
    tt = erfa.taitt(*erfa.utctai(*utc))
    expected = erfa.c2t06a(*tt, *utc, 0.0, 0.0)
    np.testing.assert_allclose(body_from_inertial(EARTH, NOON), expected, atol=1e-12)


def test_the_equinox_based_route_agrees_with_the_cio_based_one():
    """To 1e-11, 60 micrometres: another route through Greenwich apparent sidereal time."""
    utc = erfa.dtf2d("UTC", 2007, 4, 5, 12, 0, 0.0)
    tt = erfa.taitt(*erfa.utctai(*utc))
    matrix = erfa.pnm06a(*tt)
    expected = erfa.c2teqx(matrix, erfa.gst06(*utc, *tt, matrix), np.eye(3))
    found = body_from_inertial(EARTH, NOON)
    np.testing.assert_allclose(found, erfa.pom00(0.0, 0.0, erfa.sp00(*tt)) @ expected, atol=1e-11)


def test_ut1_does_not_jump_where_utc_has_a_leap_second(tmp_path):
    """2017-01-01: UT1 - UTC goes from -0.408 to 0.591 s, and UT1 goes on."""
    day = 57754
    lines = [finals(day + k, -0.4077 if k < 0 else 0.5912) for k in range(-2, 3)]
    motion = load_ephemeris(EARTH, [table(tmp_path, lines)])
    times = utc_to_tdb_s("2016-12-31T12:00:00Z") + 3600.0 * np.arange(25)
    turned = [motion.body_from_inertial(float(t)) for t in times]
    steps = [np.arccos((np.trace(b @ a.T) - 1.0) / 2.0) for a, b in pairwise(turned)]
    assert np.ptp(steps) * 6.378e6 < 0.1  # m; the jump would be 465 m
    assert "finals2000A.all" in motion.name


def test_without_a_table_the_size_of_the_error_is_reported():
    motion = AnalyticEphemeris(EARTH)
    assert "160 m rms" in motion.name
    assert "IERS" in motion.name
    assert motion.error_m(NOON) == 160.0


def test_a_table_moves_the_surface_by_its_ut1_and_states_its_own_error(tmp_path):
    lines = [finals(MJD + k, 0.3, (0.0, 0.0), (0.0, 0.0), 1e-3) for k in range(3)]
    motion = load_ephemeris(EARTH, [table(tmp_path, lines)])
    moved = motion.body_from_inertial(NOON) @ body_from_inertial(EARTH, NOON).T
    assert np.hypot(moved[0, 1], 0.0) / ARCSEC == pytest.approx(15.041 * 0.3, rel=1e-4)
    assert motion.error_m(NOON) == pytest.approx(1e-3 * EARTH_RATE_M_S, rel=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: lines[:1], "has 1 lines"),
        (lambda lines: [lines[0], lines[2], lines[1]], "days in order"),
        (lambda lines: [lines[0], finals(MJD + 400)], "at most 10 apart"),
        (lambda lines: [*lines, finals(MJD + 3, offsets=(80.0, -3.0))], "80 mas off the theory"),
        (lambda lines: [*lines, finals(MJD + 3, ut1=12.0)], "UT1 - UTC, s, is 12"),
        (lambda lines: [*lines, finals(MJD + 3).replace("-0.0720737", "-0.07x0737")], "line 4"),
        (lambda lines: ["no table at all", "of any kind"], "has 0 lines"),
    ],
)
def test_a_table_that_is_none_or_damaged_is_refused(change, message, tmp_path):
    lines = [finals(MJD + k) for k in range(3)]
    with pytest.raises(DataError, match=message):
        load_ephemeris(EARTH, [table(tmp_path, change(lines))])


def test_a_table_that_is_too_old_is_refused_with_its_dates(tmp_path):
    motion = load_ephemeris(EARTH, [table(tmp_path, [finals(MJD + k) for k in range(3)])])
    with pytest.raises(DataError, match="holds 2007-04-05 to 2007-04-07, not 2025-03-01"):
        motion.body_from_inertial(utc_to_tdb_s("2025-03-01T00:00:00Z"))


def test_a_table_for_another_body_or_beside_kernels_is_refused(tmp_path):
    path = table(tmp_path, [finals(MJD + k) for k in range(3)])
    with pytest.raises(DataError, match="not for moon"):
        load_ephemeris(load_body("moon"), [path])
    with pytest.raises(DataError, match="name the IERS table alone"):
        load_ephemeris(EARTH, [path, path])
    with pytest.raises(DataError, match="there is no such"):
        load_ephemeris(EARTH, [tmp_path / "missing.all"])
