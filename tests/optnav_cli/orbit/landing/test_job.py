"""`optnav orbit landing`: the folder, its report, and settings that are wrong."""

from pathlib import Path

import pytest

from catalog.progress import SilentProgress
from optnav_cli.frames.orbit_tables import LANDING, LANDING_IMPULSE
from optnav_cli.main import run
from tests.studies import landing as study

SETTINGS = """[landing]
time = "2026-01-01T07:23:25Z"
target_lat_deg = 0.0
target_lon_deg = 90.0
trials = 2
[beams]
every_s = 60.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("landing")
    (place / "landing.toml").write_text(SETTINGS)
    command = ["orbit", "landing", str(place / "landing.toml"), "-o", str(place / "out")]
    assert run(command) == 0
    return place / "out"


def test_each_trial_has_its_row_in_order(folder: Path) -> None:
    rows = LANDING.rows(folder / "landing.csv")
    assert [row["trial"] for row in rows] == ["1", "2"]
    for row in rows:
        assert row["status"] == "solved"
        down = row.number("down_m_s")
        assert down is not None
        assert 1.5 < down < 2.0


def test_the_impulse_table_shows_newtons_steps(folder: Path) -> None:
    left = [row.number("left_m_s") for row in LANDING_IMPULSE.rows(folder / "impulse.csv")]
    assert left[2] is not None
    assert left[2] < 1e-4


def test_the_same_settings_give_the_same_landing(folder: Path, tmp_path: Path) -> None:
    settings = str(folder.parent / "landing.toml")
    assert run(["-q", "orbit", "landing", settings, "-o", str(tmp_path / "again")]) == 0
    for name in ("landing.csv", "impulse.csv", "path.csv", "transfer.oem"):
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes()


def test_the_report_draws_the_path_and_the_touchdowns(folder: Path, tmp_path: Path) -> None:
    assert run(["report", str(folder), "-o", str(tmp_path / "landing.html")]) == 0
    page = (tmp_path / "landing.html").read_text()
    assert page.count("<svg") == 3
    assert "2 of 2" in page
    assert run(["report", str(folder), "-o", str(tmp_path / "landing.svg")]) == 0
    assert "touchdowns" in (tmp_path / "landing.svg").read_text()


@pytest.mark.parametrize(
    ("old", "new", "code", "words"),
    [
        ("trials = 2", "trials = 2\ncorrections_s = [2000.0]", 3, "before the arrival after 1800"),
        ("trials = 2", "trials = 2\ncorrections_s = [900.0, 600.0]", 3, "wanted times in order"),
        ("target_lat_deg = 0.0", "", 3, "needs the setting 'target_lat_deg'"),
        ("07:23:25Z", "25:00Z", 3, "landing.toml: [landing] time"),
        ("[beams]", "[departure]\nposition_m = [1.0, 2.0, 3.0]\n[beams]", 3, "give both"),
        ("[beams]", "[departure]\ndistance_km = 5.0\n[beams]", 4, "is nearer than any"),
        (
            "[beams]",
            "[departure]\nposition_m = [47e3, -16e3, -36e3]\nvelocity_m_s = [0, 1, 0]\n[beams]",
            4,
            "landing.toml: ",
        ),
        (
            "[beams]",
            '[surface]\nmesh = { path = "none.obj", units = "km" }\n[beams]',
            3,
            "none.obj: there is no such",
        ),
    ],
)
def test_wrong_settings_are_named(
    old: str, new: str, code: int, words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "landing.toml").write_text(SETTINGS.replace(old, new))
    command = ["orbit", "landing", str(tmp_path / "landing.toml"), "-o", str(tmp_path / "out")]
    assert run(command) == code
    assert words in capfd.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_study_makes_its_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "DEPARTURES", 5)
    monkeypatch.setattr(study, "RAYS", 400)
    tables = study.report(study.run(SilentProgress(), trials=1, fits=1)).tables
    assert [float(str(left)) for left in tables[0].column("left")] < [0.2, 1e-3, 1e-4]
    assert tables[1].column("settled")[0] == pytest.approx(100.0, abs=0.5)
    assert tables[4].column("landed") == [1, 1]
