"""Predictions of stored orbits against a truth that scipy flew; their files read back."""

from dataclasses import replace

import numpy as np
import pytest

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import NothingToDoError
from catalog.progress import SilentProgress
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.main import run as optnav
from optnav_cli.orbit.fit.files import predict_orbit
from optnav_cli.orbit.fit.folder import read_orbit
from optnav_cli.orbit.fit.job import fit_runs
from optnav_cli.orbit.fit.oem import write_spk
from optnav_cli.orbit.fit.oem_reader import read_oem
from optnav_cli.orbit.fit.predict import OrbitPath
from optnav_cli.orbit.fit.settings import OrbitFitSettings, ParameterSettings
from tests.optnav_cli.orbit.fit.flights import QUIET, START_S, flight, truth, write_run

SETTINGS = OrbitFitSettings(forces=ForcesSettings(degree=2), noise=QUIET)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """An orbit through 90 minutes of fixes."""
    folder = tmp_path_factory.mktemp("orbit")
    run = write_run(folder / "run", flight().fixes)
    fit_runs([run], folder / "orbit", SETTINGS)
    return folder / "orbit"


def off_by_sigmas(rows, states):
    """Error squared over its covariance, a component."""
    pairs = zip(rows.states - states, rows.covariances, strict=True)
    return np.array([e @ np.linalg.solve(p, e) / 6.0 for e, p in pairs])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_prediction_is_as_far_off_as_it_says(stored, side):
    path = OrbitPath(read_orbit(stored))
    edge = path.last_s if side > 0.0 else path.first_s
    times = np.sort(edge + side * np.array([600.0, 3600.0, 10_800.0]))
    rows = path.rows(times).rows
    assert rows.kinds == ["prediction"] * 3
    order = times[:: int(side)]
    true = truth(np.concatenate([[START_S], order]))[1:][:: int(side)]
    errors = np.linalg.norm((rows.states - true)[:, :3], axis=1)
    sigmas = np.sqrt(np.trace(rows.covariances[:, :3, :3], axis1=1, axis2=2))
    assert np.all(np.diff(sigmas[:: int(side)]) > 0.0)
    assert errors.max() < 3.0 * sigmas.max()
    assert off_by_sigmas(rows, true).max() < 3.0


def test_within_the_arc_the_path_is_that_of_the_stored_states(stored):
    path = OrbitPath(read_orbit(stored))
    stored_rows = path.orbit.rows
    rows = path.rows(np.append(stored_rows.times[3], stored_rows.times[3] + 17.0)).rows
    assert rows.kinds == ["between"] * 2
    assert np.array_equal(rows.states[0], stored_rows.states[3])
    # the next stored state goes back to the same place
    other = path._carried(replace_at(path, stored_rows, 4), float(stored_rows.times[3] + 17.0), ())
    assert np.linalg.norm(rows.states[1] - other.state) < 0.5


def replace_at(path, rows, number):
    first = path._between(float(rows.times[0]))
    return replace(
        first,
        tdb_s=float(rows.times[number]),
        state=rows.states[number],
        covariance=rows.covariances[number],
    )


def test_force_parameters_widen_a_prediction(tmp_path):
    run = write_run(tmp_path / "run", flight().fixes)
    plain = SETTINGS
    considered = ParameterSettings("acceleration", prior_sigma=1e-6, mode="consider")
    sigmas = []
    for name, parameters in (("plain", ()), ("with", (considered,))):
        settings = OrbitFitSettings(forces=plain.forces, noise=QUIET, parameter=parameters)
        fit_runs([run], tmp_path / name, settings)
        path = OrbitPath(read_orbit(tmp_path / name))
        row = path.rows(np.array([path.last_s + 7200.0])).rows
        sigmas.append(float(np.sqrt(np.trace(row.covariances[0, :3, :3]))))
    # 1e-6 m/s^2 along the path for 2 h: 3/2 a t^2 is 78 m
    assert sigmas[1] > sigmas[0] + 40.0


def test_a_path_into_the_ground_is_predicted_to_there_and_said(tmp_path, caplog):
    """From 20 km, 12 m/s slower: the lowest point lies under the ground."""
    states = truth(np.array([START_S]), height_m=20e3)
    slower = states[0].copy()
    slower[3:] *= 1.0 - 12.0 / np.linalg.norm(slower[3:])
    low = flight(minutes=15.0, every_s=100.0, height_m=20e3, kick_s=0.01,
                 kick_m_s=tuple(slower[3:] - states[0, 3:]))  # fmt: skip
    run = write_run(tmp_path / "run", low.fixes)
    fit_runs([run], tmp_path / "orbit", SETTINGS)
    to = utc_from_tdb_s(START_S + 7200.0)
    path, prediction = predict_orbit(tmp_path / "orbit", to, 60.0, SilentProgress())
    assert "meets the body's surface at 2022-03-08T08:49" in caplog.text
    heights = np.array(
        [path.height_m(t, s) for t, s in zip(prediction.rows.times, prediction.rows.states)]
    )
    assert heights.min() > 0.0
    assert 0.0 < prediction.meets_s - prediction.rows.times[-1] <= 60.0
    met = path._motion.carry(
        prediction.rows.states[-1],
        float(prediction.rows.times[-1]),
        prediction.meets_s - float(prediction.rows.times[-1]),
    )[0]
    assert abs(path.height_m(prediction.meets_s, met)) < 5.0
    with pytest.raises(NothingToDoError, match="before the first step"):
        predict_orbit(tmp_path / "orbit", to, 7000.0, SilentProgress())


@pytest.mark.parametrize(
    ("to", "step", "code", "words"),
    [
        ("2022-03-08T09:00:00Z", "60", 2, "lies within the arc, 2022-03-08T08:25:31Z to"),
        ("2022-03-18T09:00:00Z", "1", 2, "give a longer step"),
        ("2023-03-08T09:00:00Z", "1e6", 3, "365 days from the time asked for; wanted at most 100"),
        ("soon", "60", 3, "not understood"),
        ("2022-03-08T12:00:00Z", "0", 2, "--step"),
    ],
)
def test_a_time_that_cannot_be_predicted_to_is_refused(stored, to, step, code, words, capsys):
    assert optnav(["orbit", "predict", str(stored), "--to", to, "--step", step]) == code
    assert words in capsys.readouterr().err


def test_a_folder_that_is_no_orbit_is_named(tmp_path, capsys):
    assert optnav(["orbit", "export", str(tmp_path), "-o", str(tmp_path / "a.oem")]) == 3
    assert "has no orbit.toml" in capsys.readouterr().err


def test_a_prediction_is_printed_or_written(stored, tmp_path, capsys):
    words = ["orbit", "predict", str(stored), "--to", "2022-03-08T12:00:00Z", "--step", "600"]
    assert optnav(words) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].startswith("2022-03-08T12:00:00.000Z")
    assert optnav([*words, "-o", str(tmp_path / "a.csv")]) == 0
    table = (tmp_path / "a.csv").read_text().splitlines()
    assert table[0] == (stored / "orbit.csv").read_text().splitlines()[0]
    assert len(table) == len(lines) - 1
    assert all(",prediction," in line for line in table[1:])
    assert optnav([*words, "-o", str(tmp_path / "a.oem")]) == 0
    assert len(read_oem(tmp_path / "a.oem", "moon").covariances) == len(table) - 1


def test_an_exported_oem_says_to_another_program_what_the_orbit_says(stored, tmp_path):
    ndm = pytest.importorskip("ccsds_ndm.ndm_io", reason="ccsds-ndm (extra test) is not there")
    assert optnav(["orbit", "export", str(stored), "-o", str(tmp_path / "a.oem")]) == 0
    orbit = read_orbit(stored)
    segment = ndm.NdmIo().from_path(tmp_path / "a.oem").body.segment[0]
    meta, data = segment.metadata, segment.data
    assert (meta.center_name, meta.time_system, meta.ref_frame) == ("MOON", "TDB", "ICRF")
    assert len(data.state_vector) == len(data.covariance_matrix) == len(orbit.rows.times)
    for number in (0, -1):
        row, state = data.state_vector[number], orbit.rows.states[number] / 1e3
        place = [row.x.value, row.y.value, row.z.value]
        speed = [row.x_dot.value, row.y_dot.value, row.z_dot.value]
        assert np.allclose([*map(float, place)], state[:3], atol=1e-9)
        assert np.allclose([*map(float, speed)], state[3:], atol=1e-9)
        matrix = data.covariance_matrix[number]
        spread = orbit.rows.covariances[number] / 1e6
        assert float(matrix.cx_x.value) == pytest.approx(spread[0, 0], rel=1e-9)
        assert float(matrix.cz_dot_y.value) == pytest.approx(spread[5, 1], rel=1e-9)


def test_an_exported_kernel_gives_spice_the_states(stored, tmp_path):
    spice = pytest.importorskip("spiceypy", reason="the extra spice is not there")
    file = tmp_path / "a.bsp"
    assert optnav(["orbit", "export", str(stored), "-o", str(file), "--craft", "-123"]) == 0
    assert optnav(["orbit", "export", str(stored), "-o", str(tmp_path / "b.bsp")]) == 0
    path = OrbitPath(read_orbit(stored))
    times = path.first_s + np.array([0.0, 1000.3, 5399.0])
    wanted = path.rows(times).rows.states
    spice.furnsh(str(file))
    try:
        for time, state in zip(times, wanted, strict=True):
            found = 1e3 * spice.spkgeo(-123, float(time), "J2000", 301)[0]
            assert np.abs(found - state)[:3].max() < 0.5
            assert np.abs(found - state)[3:].max() < 1e-2
    finally:
        spice.unload(str(file))


def test_states_of_two_cameras_at_nearly_one_time_do_not_spoil_a_kernel(stored, tmp_path):
    spice = pytest.importorskip("spiceypy", reason="the extra spice is not there")
    path = OrbitPath(read_orbit(stored))
    first = path.first_s
    even = first + 300.0 * np.arange(11.0)
    times = np.sort(np.concatenate([even, even[:-1] + 2e-5, [even[-1] - 1e-4]]))
    write_spk(tmp_path / "twins.bsp", times, path.rows(times).rows.states, -999, 301)
    spice.furnsh(str(tmp_path / "twins.bsp"))
    try:
        for time in (first, first + 2999.0, float(even[-1])):
            wanted = path.rows(np.array([time])).rows.states[0]
            found = 1e3 * spice.spkgeo(-999, time, "J2000", 301)[0]
            assert np.abs(found - wanted)[:3].max() < 0.5
    finally:
        spice.unload(str(tmp_path / "twins.bsp"))


def test_an_exported_table_is_that_of_the_folder(stored, tmp_path):
    assert optnav(["orbit", "export", str(stored), "-o", str(tmp_path / "a.csv")]) == 0
    assert (tmp_path / "a.csv").read_bytes() == (stored / "orbit.csv").read_bytes()
