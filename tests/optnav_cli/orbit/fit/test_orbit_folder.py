"""`optnav orbit fit`, `evaluate` and the folder between them; what is wrong with runs is said."""

import json
import shutil

import numpy as np
import pytest

from catalog.errors import DataError
from optnav_cli.main import run
from optnav_cli.orbit.fit.folder import read_orbit
from optnav_cli.orbit.fit.oem import Oem, write_oem
from optnav_cli.orbit.fit.oem_reader import read_oem
from optnav_cli.output.run_folder import read_run
from tests.optnav_cli.orbit.fit.flights import (
    MOON,
    START_S,
    fixes_of,
    truth,
    write_run,
    write_truth_of,
)

CONFIG = "step_s = 150.0\n[forces]\ndegree = 2\n[noise]\ndensity_m2_s3 = 1e-12\n"


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A run of two hours, its truth with four hours after it, and the orbit through its fixes."""
    folder = tmp_path_factory.mktemp("orbit")
    times = START_S + np.arange(0.0, 6 * 3600.0 + 1.0, 300.0)
    states = truth(times)
    fixes = fixes_of(times[:25], states[:25])
    write_run(folder / "run", fixes)
    write_truth_of(folder / "truth.csv", times, states)
    (folder / "orbit.toml").write_text(CONFIG)
    command = ["orbit", "fit", str(folder / "run"), "--config", str(folder / "orbit.toml")]
    assert run([*command, "-o", str(folder / "orbit")]) == 0
    return folder


def fitted(place, tmp_path, *words, run_folder=None):
    name = str(run_folder or place / "run")
    config = str(place / "orbit.toml")
    return run(["orbit", "fit", name, "--config", config, *words, "-o", str(tmp_path / "orbit")])


def changed(place, tmp_path, change):
    """A copy of the run with lines of solution.csv changed by a function of their list."""
    copy = tmp_path / "run"
    shutil.copytree(place / "run", copy)
    lines = (copy / "solution.csv").read_text().splitlines()
    (copy / "solution.csv").write_text("\n".join(change(lines)) + "\n")
    return copy


def test_the_folder_holds_what_is_promised(place):
    names = {path.name for path in (place / "orbit").iterdir()}
    promised = {"orbit.toml", "orbit.csv", "residuals.csv", "disturbances.csv", "smoothed.csv"}
    assert names == promised | {"orbit.oem", "run.mcap", "manifest.json", "run.toml"}
    header = (place / "orbit" / "orbit.csv").read_text().partition("\n")[0]
    assert header.startswith(
        "utc,kind,x_m,y_m,z_m,vx_m_s,vy_m_s,vz_m_s,inertial_x_m,inertial_y_m,inertial_z_m,"
        "inertial_vx_m_s,inertial_vy_m_s,inertial_vz_m_s,cov_rr"
    )
    assert len(header.split(",")) == 14 + 21


def test_an_orbit_is_read_back_as_it_was_written(place):
    orbit = read_orbit(place / "orbit")
    assert orbit.body.name == "moon"
    assert orbit.forces.degree == 2
    assert np.abs(orbit.rows.states[-1] - orbit.state).max() < 1e-3
    assert np.allclose(orbit.rows.covariances[-1], orbit.covariance, rtol=1e-4, atol=1e-8)
    assert orbit.rows.kinds.count("fix") == 25
    oem = read_oem(place / "orbit" / "orbit.oem", "moon")
    assert np.abs(oem.states - orbit.rows.states).max() < 1e-3
    assert np.allclose(oem.covariances[-1], orbit.covariance, rtol=1e-4, atol=1e-8)


def test_the_smoothed_places_are_a_run_for_others(place, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(place / "run", copy)
    shutil.copy(place / "orbit" / "smoothed.csv", copy / "solution.csv")
    solutions = read_run(copy).solutions
    assert {solution.method for solution in solutions} == {"orbit"}


def test_an_orbit_is_compared_with_the_truth(place, capsys):
    command = ["evaluate", str(place / "orbit"), "--truth", str(place / "truth.csv")]
    assert run([*command, "--max-nees", "3", "--max-height-m", "12"]) == 0
    text = capsys.readouterr().out
    assert "the fixes used, themselves" in text
    assert "prediction, h after the last fix" in text
    document = json.loads((place / "orbit" / "evaluation.json").read_text())
    assert document["solved"] == 25
    assert max(document["velocity_rms_rnb_m_s"]) < 0.02
    assert 0.2 < document["velocity_normalised_error_squared"] < 3.0
    hours = [row["hours"] for row in document["predictions"]]
    assert hours == pytest.approx([1.0, 3.0], abs=0.1)
    assert all(row["normalised_error_squared"] < 5.0 for row in document["predictions"])
    assert run([*command, "--max-height-m", "0.01"]) == 5


def with_cell(column, text):
    """A change of one cell of the fifth fix."""

    def change(lines):
        cells = lines[5].split(",")
        cells[lines[0].split(",").index(column)] = text
        return [*lines[:5], ",".join(cells), *lines[6:]]

    return change


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        (lambda lines: lines[:3], 4, "too few fixes: 2 leave"),
        (lambda lines: [*lines[:5], lines[4]], 3, "stands there twice"),
        (lambda lines: [*lines[:5], lines[5][:40]], 3, "the row has"),
        (lambda lines: [x.replace(",solved,", ",unsolved,") for x in lines], 4, "no frame is solv"),
        (with_cell("x_m", "nan"), 3, "x_m is nan"),
        (with_cell("x_m", "1.0"), 3, "lies inside moon"),
        (with_cell("cov_xx_m2", ""), 3, "cov_xx_m2 is empty"),
        (with_cell("cov_xx_m2", "-1"), 3, "not positive definite"),
        (with_cell("utc", "yesterday"), 3, "time 'yesterday' is not understood"),
    ],
)
def test_a_run_that_cannot_be_used_is_named(change, code, words, place, tmp_path, capsys):
    copy = changed(place, tmp_path, change)
    assert fitted(place, tmp_path, run_folder=copy) == code
    message = capsys.readouterr().err
    assert words in message
    assert not (tmp_path / "orbit").exists()


def test_fixes_in_any_order_give_the_same_orbit(place, tmp_path):
    copy = changed(place, tmp_path, lambda lines: [lines[0], *lines[:0:-1]])
    assert fitted(place, tmp_path, run_folder=copy) == 0
    assert np.allclose(
        read_orbit(tmp_path / "orbit").state, read_orbit(place / "orbit").state, atol=1e-4
    )


def test_runs_of_two_bodies_are_refused(place, tmp_path, capsys):
    write_run(tmp_path / "mars", fixes_of([START_S], [[4e6, 0.0, 0.0, 0.0, 3e3, 0.0]]), "mars")
    command = ["orbit", "fit", str(place / "run"), str(tmp_path / "mars")]
    assert run([*command, "-o", str(tmp_path / "orbit")]) == 3
    assert "about mars, those of" in capsys.readouterr().err


def test_one_run_named_twice_is_refused(place, tmp_path, capsys):
    name = str(place / "run")
    assert run(["orbit", "fit", name, name, "-o", str(tmp_path / "orbit")]) == 3
    assert "named twice" in capsys.readouterr().err


def test_a_common_clock_ends_with_wrong_usage(place, tmp_path, capsys):
    assert fitted(place, tmp_path, "--solve", "clock") == 2
    assert "not observable" in capsys.readouterr().err


def test_the_orbit_of_another_fit_is_a_prior(place, tmp_path):
    shutil.copy(place / "orbit" / "orbit.oem", tmp_path / "other.oem")
    config = tmp_path / "prior.toml"
    config.write_text(CONFIG + '[[prior]]\noem = "other.oem"\n')
    command = ["orbit", "fit", str(place / "run"), "--config", str(config), "--solve", "clock"]
    assert run([*command, "-o", str(tmp_path / "orbit")]) == 0
    (clock,) = read_orbit(tmp_path / "orbit").parameters
    assert abs(clock.value[0]) < 3.0 * clock.sigma[0] < 0.2


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("CENTER_NAME = MOON", "CENTER_NAME = EARTH", "CENTER_NAME is 'EARTH'; wanted MOON"),
        ("REF_FRAME = ICRF", "REF_FRAME = ITRF", "REF_FRAME is 'ITRF'; wanted ICRF"),
        ("TIME_SYSTEM = TDB", "TIME_SYSTEM = UT1", "TIME_SYSTEM is 'UT1'"),
        ("COVARIANCE_STOP", "1.0 x", "has a word where a number belongs"),
    ],
)
def test_an_oem_of_another_centre_or_frame_is_refused(old, new, words, place, tmp_path):
    text = (place / "orbit" / "orbit.oem").read_text().replace(old, new)
    (tmp_path / "wrong.oem").write_text(text)
    with pytest.raises(DataError, match=words):
        read_oem(tmp_path / "wrong.oem", "moon")


def test_an_oem_keeps_states_and_covariances(tmp_path):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    times, states = 7e8 + np.array([0.0, 59.123456, 86400.0]), rng.normal(size=(3, 6)) * 1e6
    written = Oem("moon", times, states, times[1:2], (root @ root.T)[None])
    write_oem(tmp_path / "a.oem", written, "CRAFT", "2026-01-01T00:00:00Z")
    found = read_oem(tmp_path / "a.oem", "moon")
    assert np.allclose(found.times, times, atol=1e-6)
    assert np.allclose(found.states, states, atol=1e-5)
    assert np.allclose(found.covariances, written.covariances, rtol=1e-11)
    assert MOON.name == found.body


def test_a_folder_that_is_no_orbit_or_is_damaged_is_named(place, tmp_path):
    with pytest.raises(DataError, match=r"has no orbit.toml; name what `optnav orbit fit"):
        read_orbit(place / "run")
    copy = tmp_path / "orbit"
    shutil.copytree(place / "orbit", copy)
    text = (copy / "orbit.csv").read_text()
    (copy / "orbit.csv").write_text(text[: len(text) // 2])
    with pytest.raises(DataError, match=r"orbit.csv, line \d+: the row has"):
        read_orbit(copy)
    shutil.copy(place / "orbit" / "orbit.csv", copy)
    (copy / "orbit.toml").write_text("body = 3\n")
    with pytest.raises(DataError, match="fit the orbit again"):
        read_orbit(copy)


def test_a_state_with_two_times_is_refused(place, tmp_path):
    """A path from one to the other, of a year, would take minutes."""
    copy = tmp_path / "orbit"
    shutil.copytree(place / "orbit", copy)
    text = (copy / "orbit.toml").read_text()
    tdb_s = read_orbit(copy).epoch_s
    (copy / "orbit.toml").write_text(text.replace(f"tdb_s = {tdb_s!r}", f"tdb_s = {tdb_s + 4e7!r}"))
    with pytest.raises(DataError, match=r"has utc .*, which is tdb_s \d+.* and tdb_s \d+"):
        read_orbit(copy)
    utc = read_orbit(place / "orbit").file.state.utc
    (copy / "orbit.toml").write_text(text.replace(utc, "yesterday"))
    with pytest.raises(
        DataError, match=r"orbit.toml: \[state\] utc: time 'yesterday' is not understood"
    ):
        read_orbit(copy)


@pytest.mark.parametrize("number", ["1e308", "-1e9"])
def test_a_covariance_beyond_its_variances_is_refused(number, place, tmp_path):
    copy = tmp_path / "orbit"
    shutil.copytree(place / "orbit", copy)
    head, *lines = (copy / "orbit.csv").read_text().splitlines()
    column = head.split(",").index("cov_vr_b_m2_s")
    cells = lines[2].split(",")
    lines[2] = ",".join([*cells[:column], number, *cells[column + 1 :]])
    (copy / "orbit.csv").write_text("\n".join([head, *lines]) + "\n")
    with pytest.raises(DataError, match=r"orbit.csv, line 4: its covariance can be none"):
        read_orbit(copy)


def test_a_page_shows_sigmas_and_with_a_truth_errors(place, tmp_path):
    copy = tmp_path / "orbit"
    shutil.copytree(place / "orbit", copy)
    for name in ("evaluation.json", "evaluation.csv", "orbit_errors.csv"):
        (copy / name).unlink(missing_ok=True)
    assert run(["report", str(copy), "-o", str(tmp_path / "a.html")]) == 0
    text = (tmp_path / "a.html").read_text()
    assert "Stated sigmas over time" in text
    assert "Ellipses of 3 sigma" in text
    assert run(["evaluate", str(copy), "--truth", str(place / "truth.csv")]) == 0
    assert run(["report", str(copy), "-o", str(tmp_path / "a.html")]) == 0
    text = (tmp_path / "a.html").read_text()
    assert "Predictions after the last fix" in text
    assert "Errors along R" in text
    assert run(["report", str(copy), "-o", str(tmp_path / "a.svg")]) == 0
    assert "An orbit and its fixes against the truth" in (tmp_path / "a.svg").read_text()
