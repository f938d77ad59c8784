"""Gravity files: three formats read alike, and what is wrong with a file is said."""

import logging
import os
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.config import resource
from catalog.errors import DataError
from optnav_cli.dynamics.gravity_field import named_field, oblate_field, read_field
from optnav_cli.dynamics.orbit_settings import ForcesSettings

MOON = load_body("moon")
SHIPPED = resource("data/moon_glgm3_50.tab")
GM, R = 4902.8001184575496e9, 1738e3
TOP = 6


def rows(degree=TOP, *, unnormalised=False):
    """Degree, order, C, S of a made field that follows Kaula's rule."""
    rng = np.random.default_rng(3)
    for n in range(2, degree + 1):
        for m in range(n + 1):
            c, s = 2e-4 / n**2 * rng.normal(size=2)
            fall = 10.0 ** (-1.5 * m) if unnormalised else 1.0
            yield n, m, c * fall, (s if m else 0.0) * fall


def shadr(made, head=f"1738.0, {GM / 1e9}, 0, {TOP}, {TOP}, 1, 0, 0"):
    return "\n".join([head, *(f"{n}, {m}, {c:.12e}, {s:.12e}" for n, m, c, s in made)]) + "\n"


def icgem(made, extra=""):
    head = f"product_type gravity_field\ngravity_constant {GM:.10e}\nradius {R}\n"
    body = "\n".join(f"gfc {n} {m} {c:.12e} {s:.12e} 1e-9 2e-9" for n, m, c, s in made)
    return f"{head}max_degree {TOP}\n{extra}end_of_head ====\n{body}\n".replace("e-", "D-")


def cof(made):
    lines = [f"POTFIELD{TOP:3d}{TOP:3d}  1 {GM:.14E} {R:.14E} 1.0000000000E+00"]
    for n, m, c, s in made:
        sine = f"{s:21.14E}" if m else ""
        lines.append(f"RECOEF  {n:3d}{m:3d}   {c:21.14E}{sine}")
    return "\n".join([*lines, "END"]) + "\n"


def read(tmp_path, text, name="field.tab", body=MOON):
    path = tmp_path / name
    path.write_text(text)
    return read_field(path, body)


def test_the_three_formats_say_the_same(tmp_path):
    whole = list(rows())
    first = read(tmp_path, shadr(whole))
    for text, name in ((icgem(whole), "f.gfc"), (cof(whole), "f.cof")):
        other = read(tmp_path, text, name)
        assert other.degree == first.degree == TOP
        assert np.allclose(other.c, first.c, atol=1e-16, rtol=1e-10)
        assert np.allclose(other.s, first.s, atol=1e-16, rtol=1e-10)
        assert other.radius_m == first.radius_m == R
    assert first.errors is None
    stated = read(tmp_path, icgem(whole), "f.gfc").errors
    # all 7 orders of degree 6, each with hypot(1, 2) e-9, over 2n + 1
    assert stated[6] == pytest.approx(np.sqrt(7.0 * 5.0 / 13.0) * 1e-9)


def test_the_shipped_field_is_glgm3_cut_to_degree_50(caplog):
    field = read_field(SHIPPED, MOON)
    assert field.degree == 50
    assert field.c[2, 0] == pytest.approx(-0.9089014554764100e-04, abs=1e-11)
    assert field.s[50, 50] == pytest.approx(1.918106e-8, abs=1e-13)
    assert not caplog.records
    shared = os.environ.get("OPTNAV_SHARED_DATA")
    if not shared:
        pytest.skip("OPTNAV_SHARED_DATA is not set: no GLGM-3 of degree 150 to compare with")
    with caplog.at_level(logging.WARNING):
        whole = read_field(Path(shared) / "gravity" / "glgm3150.txt", MOON)
    assert whole.degree == 150
    assert np.abs(whole.c[:51, :51] - field.c).max() < 1e-11
    assert np.abs(whole.s[:51, :51] - field.s).max() < 1e-11
    # GLGM-3's own header has a zero too many
    assert "4900.28002 km3/s2, 5.1e-04 off" in caplog.text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (shadr(list(rows())[:-3]), "is cut or lacks rows: degree 6, order 4"),
        (shadr(rows(unnormalised=True)), "not normalised"),
        (shadr(rows(), "1738.0, 4902.8, 0, 6, 6, 0, 0, 0"), "says that its coefficients are not"),
        (icgem(rows(), "norm unnormalized\n"), "says that its coefficients are not"),
        (shadr(rows(), "6378.0, 398600.4, 0, 6, 6, 1, 0, 0"), "of this body"),
        (shadr(rows(), "1738.0, nan, 0, 6, 6, 1, 0, 0"), "wanted numbers above 0"),
        (shadr(rows(), "no header"), "line 1"),
        (shadr([*rows(), (2, 0, 0.0, 0.0)]), "line 27: degree 2, order 0 is there a second time"),
        (shadr([(1, 1, 1e-3, 0.0), *rows()]), "centre of mass"),
        (shadr(rows()).replace("5, 5, ", "5, 5, nan, nan,"), "line 19: a coefficient is no number"),
        (shadr(rows()).replace("5, 5, ", "5, 7, "), "order up to it"),
        ("", "line 1"),
        ("\0\0\0", "is not text"),
        (cof(rows()).replace("RECOEF    6  6", "RECOEF"), "line 26"),
        (cof(rows()).splitlines()[1], "line 1"),
        (icgem(rows()).replace("radius", "rim"), "lacks earth_gravity_constant, radius"),
    ],
)
def test_a_file_that_is_no_whole_field_is_refused(text, words, tmp_path):
    with pytest.raises(DataError, match=words):
        read(tmp_path, text)


def test_a_gm_that_is_a_little_off_is_said_and_one_that_is_not_scales(tmp_path, caplog):
    whole = list(rows())
    exact = read(tmp_path, shadr(whole))
    near = read(tmp_path, shadr(whole, "1738.0, 4902.85, 0, 6, 6, 1, 0, 0"))
    assert near.c[3, 1] / exact.c[3, 1] == pytest.approx(4902.85e9 / GM, rel=1e-9)
    assert not caplog.records
    off = read(tmp_path, shadr(whole, "1738.0, 4900.28, 0, 6, 6, 1, 0, 0"))
    assert "5.1e-04 off moon's 4902.80012; the latter is used" in caplog.text
    assert np.array_equal(off.c, list_as_field(whole))


def list_as_field(whole):
    c = np.zeros((TOP + 1, TOP + 1))
    for n, m, cosine, _ in whole:
        c[n, m] = float(f"{cosine:.12e}")
    return c


def test_forces_choose_the_field_by_body_and_degree(tmp_path):
    here = Path()
    assert named_field(MOON, ForcesSettings(), here).degree == 50
    assert named_field(MOON, ForcesSettings(degree=20), here).degree == 20
    assert named_field(MOON, ForcesSettings(degree=2), here) is None
    assert named_field(load_body("mars"), ForcesSettings(), here) is None
    with pytest.raises(DataError, match=r"ends at degree 50.*set a lower degree"):
        named_field(MOON, ForcesSettings(degree=60), here)
    with pytest.raises(DataError, match="ships no gravity field of mars"):
        named_field(load_body("mars"), ForcesSettings(degree=10), here)
    (tmp_path / "own.gfc").write_text(icgem(rows()))
    own = named_field(MOON, ForcesSettings(field="own.gfc", degree=4), tmp_path)
    assert own.degree == 4
    assert len(own.errors) == 5
    with pytest.raises(DataError, match="there is no such gravity field"):
        named_field(MOON, ForcesSettings(field="other.gfc"), tmp_path)


def test_a_field_in_the_wrong_axes_is_noticed(tmp_path, caplog):
    (tmp_path / "grail.tab").write_text(
        shadr((n, m, c, 1e-10 if (n, m) == (2, 2) else s) for n, m, c, s in rows())
    )
    named_field(MOON, ForcesSettings(field="grail.tab", field_frame="principal_axes"), tmp_path)
    assert not caplog.records
    named_field(MOON, ForcesSettings(field="grail.tab"), tmp_path)
    assert "principal axes" in caplog.text


def test_j2_and_c22_of_a_body_file_are_normalised_as_the_file_says():
    """The Moon's file: -sqrt(5) C20 and sqrt(5/12) C22 of GLGM-3."""
    field, whole = oblate_field(MOON.gravity, "moon"), read_field(SHIPPED, MOON)
    for m in (0, 2):
        assert field.c[2, m] == pytest.approx(whole.c[2, m], rel=1e-6)
