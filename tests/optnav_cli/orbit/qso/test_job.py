"""`optnav orbit qso`: the folder, its report, and settings that are wrong."""

from pathlib import Path

import numpy as np
import pytest

from catalog.progress import SilentProgress
from optnav_cli.frames.orbit_tables import QSO, QSO_PASSES
from optnav_cli.main import run
from optnav_cli.orbit.fit.oem_reader import read_oem
from optnav_cli.orbit.qso.search import phase_rate
from tests.studies.qso import periodic_rate
from tests.studies.qso import report as study_report
from tests.studies.qso import run as run_study

SETTINGS = """[qso]
time = "2026-01-01T00:00:00Z"
distance_km = [55.0, 12.0]
anomaly_deg = [0.0]
days = 2.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("qso")
    (place / "qso.toml").write_text(SETTINGS)
    assert run(["orbit", "qso", str(place / "qso.toml"), "-o", str(place / "out")]) == 0
    return place / "out"


def test_a_row_an_orbit_and_one_with_the_reason_where_there_is_none(folder: Path) -> None:
    found, missing = QSO.rows(folder / "qso.csv")
    assert (found["status"], missing["status"]) == ("solved", "unsolved")
    assert "nearer than any quasi-satellite orbit" in missing["reason"]
    assert found.number("spread_km") == pytest.approx(0.7, abs=0.6)
    fixed = found.vector(("x_m", "y_m", "z_m"))
    assert fixed == pytest.approx([0.0, 66_400.0, 0.0], abs=1e-2)
    passes = QSO_PASSES.rows(folder / "passes.csv")
    assert {row["orbit"] for row in passes} == {"1"}
    assert len(passes) == int(found["passes"]) >= 7


def test_body_fixed_velocities_are_the_rates_of_body_fixed_places(folder: Path) -> None:
    """Of the first state: the orbit runs backwards, 9 m/s over the ground at 55 km."""
    row = QSO.rows(folder / "qso.csv")[0]
    velocity = row.vector(("vx_m_s", "vy_m_s", "vz_m_s"))
    assert velocity is not None
    assert velocity[0] == pytest.approx(9.16, abs=0.1)
    assert abs(velocity[2]) < 0.01


def test_the_ephemeris_message_holds_the_states_in_km(folder: Path) -> None:
    lines = (folder / "orbit_01.oem").read_text().splitlines()
    assert "CENTER_NAME = PHOBOS" in lines
    again = read_oem(folder / "orbit_01.oem", "phobos")
    assert len(again.times) == 2 * 144 + 1
    first = lines[lines.index("META_STOP") + 2].split()
    row = QSO.rows(folder / "qso.csv")[0]
    state = row.vector([f"inertial_{name}" for name in ("x_m", "y_m", "z_m")])
    assert state is not None
    assert np.array(first[1:4], dtype=float) == pytest.approx(state / 1e3, abs=1e-6)
    assert len(lines) - lines.index("META_STOP") - 2 == 2 * 144 + 1


def test_the_report_draws_the_rings(folder: Path, tmp_path: Path) -> None:
    assert run(["report", str(folder), "-o", str(tmp_path / "qso.html")]) == 0
    page = (tmp_path / "qso.html").read_text()
    assert page.count("<svg") == 4  # two rings, two plots of passes
    assert "Orbit 1, least drift" in page
    assert run(["report", str(folder), "-o", str(tmp_path / "qso.svg")]) == 0
    assert "usual drift" in (tmp_path / "qso.svg").read_text()


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("[qso]\ndistance_km = 50.0\n", 3, "[qso] needs the setting 'time'"),
        ('[qso]\ntime = "noon"\ndistance_km = 50.0\n', 3, "time 'noon' is not understood"),
        ('[qso]\ntime = "2026-01-01"\ndistance_km = 0.0\n', 3, "distance_km = 0.0"),
        ('[qso]\ntime = "2026-01-01T00:00Z"\ndistance_km = []\n', 3, "asks for 0 orbits"),
        (
            '[qso]\ntime = "2026-01-01T00:00Z"\ndistance_km = 50.0\nbody = "moon"\n',
            3,
            "has no [orbit] about a planet",
        ),
        (
            '[qso]\ntime = "2026-01-01T00:00Z"\ndistance_km = 5.0\n',
            4,
            "no orbit was found; the first: 5 km from the surface is nearer",
        ),
        (
            '[qso]\ntime = "2026-01-01T00:00Z"\ndistance_km = 50.0\n[force]\n',
            3,
            "did you mean [forces]?",
        ),
    ],
)
def test_wrong_settings_are_named(
    text: str, code: int, words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "wrong.toml").write_text(text)
    assert run(["orbit", "qso", str(tmp_path / "wrong.toml"), "-o", str(tmp_path / "out")]) == code
    said = capfd.readouterr().err
    assert words in said
    assert "wrong.toml" in said or "moon: its body file" in said


def test_a_damaged_folder_is_said_to_be(folder: Path, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "paths.csv").write_text("orbit,kind\n1,orbit\n")
    assert run(["report", str(copy), "-o", str(tmp_path / "page.html")]) == 3


def test_the_study_shows_rings_within_a_tenth_of_the_source() -> None:
    tables = study_report(run_study(SilentProgress(), anomalies=1)).tables
    rings = list(zip(tables[0].column("seed_ring"), tables[0].column("ring")))[:3]
    assert all(abs(float(ours) / float(theirs) - 1.0) < 0.1 for theirs, ours in rings)  # type: ignore[arg-type]
    assert max(map(float, tables[2].column("worst"))) < 3.0  # type: ignore[arg-type]


def test_the_theory_nears_the_exact_rate_of_a_moon_on_a_circle_far_out() -> None:
    """Off by 15, 4 and 0.7 % at 50, 100 and 200 km from Phobos: by the square of the distance."""
    off = [phase_rate(d) / periodic_rate(d) - 1.0 for d in (2.57, 4.66, 8.85)]
    assert off == pytest.approx([0.148, 0.0425, 0.0073], rel=0.02)
