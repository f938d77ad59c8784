"""Arcs and predictions that are longer than the SPICE kernels they are flown by."""

import re
from dataclasses import replace

import pytest

from catalog.bodies.epochs import utc_from_tdb_s, utc_to_tdb_s
from optnav_cli.main import run as optnav
from tests.optnav_cli.orbit.fit.flights import START_S, flight, write_run

COVERED = re.compile(r"they cover \S+ to (\S+)")


def shifted(fixes, by_s):
    """Fixes at other times; a body-fixed orbit that began later is another one as good."""
    moved = [fix.tdb_s + by_s for fix in fixes]
    return [
        replace(fix, tdb_s=time, utc=utc_from_tdb_s(time, 6))
        for fix, time in zip(fixes, moved, strict=True)
    ]


@pytest.fixture
def config(kernels, tmp_path):
    """Settings with kernels that end in 2009."""
    path = tmp_path / "orbit.toml"
    names = ", ".join(f'"{kernel}"' for kernel in kernels)
    path.write_text(f"[forces]\ndegree = 2\n\n[spice]\nkernels = [{names}]\n", encoding="utf-8")
    return path


def test_an_arc_beyond_the_kernels_is_refused_with_what_they_cover(config, tmp_path, capsys):
    run = write_run(tmp_path / "run", flight(minutes=40.0).fixes)
    words = ["orbit", "fit", str(run), "--config", str(config), "-o", str(tmp_path / "orbit")]
    assert optnav(words) == 3
    message = capsys.readouterr().err
    assert COVERED.search(message), message
    assert not (tmp_path / "orbit").exists()


def test_an_arc_that_outlasts_the_kernels_and_a_prediction_beyond_them(config, tmp_path, capsys):
    fixes = flight(minutes=40.0).fixes
    run = write_run(tmp_path / "first", fixes)
    words = ["orbit", "fit", str(run), "--config", str(config), "-o", str(tmp_path / "orbit")]
    assert optnav(words) == 3
    end = COVERED.search(capsys.readouterr().err)
    assert end is not None
    last_s = utc_to_tdb_s(end[1].rstrip(";,."))
    for name, before_s, code in (("crossing", 1200.0, 3), ("inside", 6 * 3600.0, 0)):
        run = write_run(tmp_path / name, shifted(fixes, last_s - before_s - START_S))
        place = tmp_path / f"orbit-{name}"
        assert optnav([*words[:2], str(run), *words[3:-1], str(place)]) == code
        assert ("they cover" in capsys.readouterr().err) == (code == 3)
    to = utc_from_tdb_s(last_s + 86400.0)
    assert optnav(["orbit", "predict", str(tmp_path / "orbit-inside"), "--to", to]) == 3
    assert "they cover" in capsys.readouterr().err
