"""Commands of orbits, killed while they write: the same command again gives the same bytes."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from optnav_cli.main import run as optnav
from tests.optnav_cli.orbit.fit.flights import flight, write_run

CHECKOUT = Path(__file__).resolve().parents[4]
# The last file of a folder is its manifest: all others are there by then.
KILLED = (
    "import os, sys; from optnav_cli.output import manifest; "
    "manifest.write_manifest = lambda *a, **k: os.kill(os.getpid(), 9); "
    "from optnav_cli.main import run; sys.exit(run(sys.argv[1:]))"
)
FIT = "[forces]\ndegree = 2\n[noise]\ndensity_m2_s3 = 1e-12\n"
QSO = (
    '[qso]\nbody = "phobos"\ntime = "2026-01-01T07:23:25Z"\ndistance_km = 80.0\n'
    "longitude_deg = 90.0\ndays = 0.6\n"
)
LANDING = (
    '[landing]\ntime = "2026-01-01T07:23:25Z"\ntarget_lat_deg = 0.0\ntarget_lon_deg = 90.0\n'
    "trials = 0\n"
)


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        (("orbit", "fit", "run", "--config"), FIT),
        (("orbit", "qso"), QSO),
        (("orbit", "landing"), LANDING),
        (("orbit", "delivery"), "bundled:delivery_moon_optical"),
    ],
)
def test_a_killed_command_leaves_nothing_and_the_same_one_gives_the_same_bytes(
    command, settings, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "run", flight(minutes=40.0).fixes)
    if not settings.startswith("bundled:"):
        (tmp_path / "settings.toml").write_text(settings, encoding="utf-8")
        settings = "settings.toml"
    words = [*command, settings, "-q", "-o"]
    before = {path.name for path in tmp_path.iterdir()}
    code = [sys.executable, "-c", KILLED, *words, "out"]
    done = subprocess.run(
        code, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(CHECKOUT)}, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert not (tmp_path / "out").exists()
    assert optnav([*words, "out"]) == 0
    assert optnav([*words, "clean"]) == 0
    files = {path.name for path in (tmp_path / "clean").iterdir()}
    assert {path.name for path in (tmp_path / "out").iterdir()} == files
    for name in files - {"manifest.json"}:
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "clean" / name).read_bytes()
    assert {path.name for path in tmp_path.iterdir()} - before == {"out", "clean"}
