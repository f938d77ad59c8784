"""Rotation, Sun and neighbours by either source."""

from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris, Ephemeris, Neighbour, SpiceEphemeris
from catalog.errors import DataError

TIMES = np.random.default_rng(11).uniform(-9.4e7, 3.15e8, 200)  # 1997 to 2009
LATE = 8.0e8  # 2025, beyond the planets' kernel


@pytest.mark.parametrize(("name", "frame"), [("moon", "MOON_ME"), ("mars", "IAU_MARS")])
def test_kernels_give_the_rotation_of_the_toolkit(
    name: str, frame: str, kernels: list[Path]
) -> None:
    import spiceypy

    motion = SpiceEphemeris(load_body(name), kernels)
    for t in TIMES[:20]:
        ours = motion.body_from_inertial(t)
        np.testing.assert_array_equal(ours, spiceypy.pxform("J2000", frame, t))
        np.testing.assert_allclose(ours @ motion.sun_inertial(t), motion.sun_body(t), atol=1e-15)


@pytest.mark.parametrize(
    ("name", "of", "rms_km", "most_km"),
    [
        # limits: a fifth over what 1000 dates of 1997-2009 show
        ("moon", "earth", 8.5, 27.0),
        ("moon", "sun", 10.0, 30.0),
        ("earth", "moon", 8.5, 27.0),
        ("earth", "sun", 5.0, 14.0),
        ("mars", "sun", 9800.0, 23500.0),
        ("moon", "mars", 9800.0, 23500.0),
    ],
)
def test_neighbours_stand_where_de405_has_them(
    name: str, of: Neighbour, rms_km: float, most_km: float, kernels: list[Path]
) -> None:
    body = load_body(name)
    analytic, spice = AnalyticEphemeris(body), SpiceEphemeris(body, kernels)
    apart = [analytic.position_m(of, t) - spice.position_m(of, t) for t in TIMES]
    distance_km = np.linalg.norm(apart, axis=1) / 1e3
    assert np.sqrt(np.mean(distance_km**2)) < rms_km
    assert distance_km.max() < most_km


def test_the_earths_tide_on_a_lunar_orbit_is_good_to_a_part_in_five_thousand(
    kernels: list[Path],
) -> None:
    """What moon98's kilometres mean: the tide goes as 1/r^3 and turns with the direction."""
    moon = load_body("moon")
    analytic, spice = AnalyticEphemeris(moon), SpiceEphemeris(moon, kernels)
    place = np.array([2.0e6, 0.0, 0.0])
    for t in TIMES[:50]:
        tides = []
        for motion in (analytic, spice):
            earth = motion.position_m("earth", t)
            towards = earth - place
            tides.append(
                towards / np.linalg.norm(towards) ** 3 - earth / np.linalg.norm(earth) ** 3
            )
        error = np.linalg.norm(tides[0] - tides[1]) / np.linalg.norm(tides[1])
        assert error < 2e-4


def test_a_place_and_the_way_back_are_opposite() -> None:
    moon, earth = AnalyticEphemeris(load_body("moon")), AnalyticEphemeris(load_body("earth"))
    for t in (*TIMES[:3], LATE):
        there, back = moon.position_m("earth", t), earth.position_m("moon", t)
        np.testing.assert_array_equal(there, -back)
        assert 3.5e8 < np.linalg.norm(there) < 4.1e8
        sun = moon.position_m("sun", t) - there
        np.testing.assert_allclose(sun, earth.position_m("sun", t), atol=1.0)


def test_what_has_no_theory_is_refused() -> None:
    with pytest.raises(DataError, match="no theory here of moon as seen from moon"):
        AnalyticEphemeris(load_body("moon")).position_m("moon", 0.0)


def test_mars_is_that_of_phobos_rotation_where_kernels_lack_its_orbit(
    kernels: list[Path],
) -> None:
    phobos = load_body("phobos")
    found = SpiceEphemeris(phobos, kernels).position_m("mars", TIMES[0])
    np.testing.assert_array_equal(found, AnalyticEphemeris(phobos).position_m("mars", TIMES[0]))


def test_a_time_outside_the_kernels_is_answered_with_what_they_cover(kernels: list[Path]) -> None:
    motion = SpiceEphemeris(load_body("moon"), kernels)
    with pytest.raises(DataError, match=r"cover 1997-01-01T00:00:00Z to 2010-01-01T23:59:57Z"):
        motion.sun_inertial(LATE)
    with pytest.raises(DataError, match="cover 1997"):
        motion.position_m("earth", LATE)
    motion.body_from_inertial(LATE)  # the frame's own kernel reaches to 2050
    with pytest.raises(DataError, match=r"MOON_ME at 2095.* cover 1899-12-31T.* to 2050-12-31T"):
        motion.body_from_inertial(3.0e9)


def test_without_an_orbit_kernel_the_sun_stays_analytic_and_the_name_says_so(
    kernels: list[Path],
) -> None:
    moon = load_body("moon")
    motion = SpiceEphemeris(moon, kernels[:4])
    assert "the Sun by analytic theory" in motion.name
    assert "analytic" not in SpiceEphemeris(moon, kernels).name
    expected = AnalyticEphemeris(moon)
    np.testing.assert_array_equal(motion.sun_inertial(LATE), expected.sun_inertial(LATE))
    np.testing.assert_array_equal(
        motion.position_m("earth", LATE), expected.position_m("earth", LATE)
    )


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        ([0, 1, 2, 4], "nothing about the frame MOON_ME .*add the kernel that has it"),
        ([0, 3, 4], r"none defines the frame MOON_ME; add its frame kernel \(\.tf\)"),
        ([], "none defines the frame MOON_ME"),
    ],
)
def test_an_incomplete_set_is_refused(kept: list[int], message: str, kernels: list[Path]) -> None:
    with pytest.raises(DataError, match=message):
        SpiceEphemeris(load_body("moon"), [kernels[i] for i in kept])


def test_constants_of_another_body_are_refused(kernels: list[Path], tmp_path: Path) -> None:
    """Mars' pole and spin under the name of Phobos."""
    wrong = tmp_path / "wrong.tpc"
    wrong.write_text(
        "KPL/PCK\n\\begindata\nBODY401_POLE_RA = ( 10. 0. 0. )\nBODY401_POLE_DEC = ( 52. 0. 0. )\n"
        "BODY401_PM = ( 35. 1128.8 0. )\nBODY401_NUT_PREC_RA = ( 0. )\n"
    )
    with pytest.raises(DataError, match=r"the frame IAU_PHOBOS is .* deg from the analytic theory"):
        SpiceEphemeris(load_body("phobos"), [*kernels, wrong])
    SpiceEphemeris(load_body("phobos"), kernels)


def test_two_sets_in_one_process_do_not_mix(kernels: list[Path]) -> None:
    moon = load_body("moon")
    first: Ephemeris = SpiceEphemeris(moon, kernels)
    expected = first.sun_inertial(1e8)
    SpiceEphemeris(moon, kernels[:4])
    np.testing.assert_array_equal(first.sun_inertial(1e8), expected)
