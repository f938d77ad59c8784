"""`optnav orbit delivery`: the folder, its report, and settings that are wrong."""

from pathlib import Path

import pytest

from catalog.config import resource
from catalog.progress import SilentProgress
from optnav_cli.frames.orbit_tables import DELIVERY_STAGES
from optnav_cli.main import run
from tests.studies import delivery as study

SETTINGS = resource("configs/orbits/delivery_moon_optical.toml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("delivery")
    (place / "delivery.toml").write_text(SETTINGS)
    command = ["orbit", "delivery", str(place / "delivery.toml"), "-o", str(place / "out")]
    assert run(command) == 0
    return place / "out"


def test_each_correction_and_the_arrival_have_a_row(folder: Path) -> None:
    rows = DELIVERY_STAGES.rows(folder / "stages.csv")
    assert [row["stage"] for row in rows] == [*(f"correction {n}" for n in (1, 2, 3)), "arrival"]
    for row in rows[:3]:
        bound, trials = row.number("bound_dv_m_s"), row.number("trials_dv_m_s")
        assert bound is not None
        assert trials is not None
        assert bound > trials > 0.0


def test_the_report_draws_the_b_plane(folder: Path, tmp_path: Path) -> None:
    assert run(["report", str(folder), "-o", str(tmp_path / "delivery.html")]) == 0
    page = (tmp_path / "delivery.html").read_text()
    assert page.count("<svg") == 3
    assert "circle of impact" in page
    assert run(["report", str(folder), "-o", str(tmp_path / "delivery.svg")]) == 0


@pytest.mark.parametrize(
    ("old", "new", "code", "words"),
    [
        ("[1.0, 3.0, 4.0]", "[1.0, 4.0, 3.0]", 3, "wanted times in order"),
        ("[1.0, 3.0, 4.0]", "[1.0, 3.0, 6.0]", 3, "correction after 6 days; the arrival"),
        ("[optical]", "[radio]\n[optical]", 3, "[radio] needs a [[station]]"),
        ('target = "moon"', 'target = "mooon"', 3, "did you mean 'moon'?"),
        ("9.809453411389116", "10.9", 4, "delivery.toml: the "),
        ("2026-03-05T12:00:00Z", "some day", 3, "time 'some day' is not understood"),
        ("arc_days = 1.0", "arc_days = nan", 3, "must be a finite number"),
    ],
)
def test_wrong_settings_are_named(
    old: str, new: str, code: int, words: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert old in SETTINGS
    (tmp_path / "delivery.toml").write_text(SETTINGS.replace(old, new))
    command = ["orbit", "delivery", str(tmp_path / "delivery.toml"), "-o", str(tmp_path / "out")]
    assert run(command) == code
    said = capfd.readouterr().err
    assert words in said
    assert "delivery.toml" in said
    assert not (tmp_path / "out").exists()


def test_measurements_are_needed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "delivery.toml").write_text(SETTINGS.partition("[optical]")[0])
    command = ["orbit", "delivery", str(tmp_path / "delivery.toml"), "-o", str(tmp_path / "out")]
    assert run(command) == 3
    assert "neither [radio] nor [optical]" in capfd.readouterr().err


def test_the_study_compares_boxes_with_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "CASES", study.CASES[1:2])
    tables = study.report(study.run(SilentProgress(), cut=1000)).tables
    assert tables[0].column("inside") == [100.0]
    assert float(str(tables[2].column("off")[0])) < 10.0
