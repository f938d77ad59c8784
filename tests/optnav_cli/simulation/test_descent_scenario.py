"""A simulated descent: its path over the ground, its inertial track, and what is no descent."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.config import resource
from catalog.errors import ConfigError
from catalog.geometry.rotations import ARCSEC
from catalog.terrain.dem.source import DemSettings, DemSource
from optnav_cli.frames.folder import read_folder
from optnav_cli.frames.run_settings import InertialSettings, read_run_settings
from optnav_cli.simulation.descent import (
    Descent,
    DescentSettings,
    ModelSettings,
    picture_times,
    surveyed_model,
    track_errors,
)
from optnav_cli.simulation.scenario import load_scenario
from optnav_cli.simulation.sections import DetailSettings, GlobeSettings, MainCamera

from .simulated import simulate

MOON = AnalyticEphemeris(load_body("moon"))
TRACK = InertialSettings()


def shipped() -> Descent:
    scenario = load_scenario(resource("configs/scenarios/descent_118m.toml"))
    assert isinstance(scenario, Descent)
    return scenario


def test_the_path_ends_over_its_place_at_its_height_and_tilt() -> None:
    scenario = shipped()
    flight = scenario.exposures(MOON)
    first, last = flight[0], flight[-1]
    lat, lon = (
        np.arcsin(last.position_m[2] / np.linalg.norm(last.position_m)),
        np.arctan2(last.position_m[1], last.position_m[0]),
    )
    assert np.degrees([lon, lat]) == pytest.approx([-15.0, -43.5], abs=1e-6)
    fall = np.linalg.norm(first.position_m) - np.linalg.norm(last.position_m)
    assert fall == pytest.approx(18e3, rel=1e-6)
    way = np.linalg.norm(first.position_m - last.position_m)
    assert way == pytest.approx(0.5 * (1700.0 + 70.0) * 240.0, rel=0.03)
    for exposure, tilt in ((first, 28.0), (last, 0.0)):
        down = -exposure.position_m / np.linalg.norm(exposure.position_m)
        boresight = exposure.camera_from_body.as_matrix()[2]
        assert np.degrees(np.arccos(boresight @ down)) == pytest.approx(tilt, abs=6.0)


def test_the_errors_of_a_track_are_common_to_its_rows() -> None:
    times = tuple(float(t) for t in np.arange(0.0, 200.0, 5.0))
    still = msgspec.structs.replace(TRACK, attitude_noise_arcsec=0.0)
    places, turns = track_errors(still, times, 3)
    for errors in (places, turns):
        # a straight line in time
        assert np.diff(errors, 2, axis=0) == pytest.approx(0.0, abs=1e-9)
    every = [track_errors(TRACK, times, seed) for seed in range(200)]
    assert np.std([p[0] for p, _ in every]) == pytest.approx(300.0, rel=0.1)
    assert np.std([p[1] - p[0] for p, _ in every]) == pytest.approx(4.0, rel=0.1)
    assert np.std([t[0] for _, t in every]) / ARCSEC == pytest.approx(12.4, rel=0.1)


def test_noise_of_the_acceleration_grows_as_it_should() -> None:
    """A velocity by the root of the time, and a place by its power of three halves over root 3."""
    times = tuple(float(t) for t in np.arange(0.0, 101.0, 4.0))
    track = InertialSettings(0.0, 0.0, 0.02, 0.0, 0.0, 0.0)
    ends = [track_errors(track, times, seed)[0][-1] for seed in range(300)]
    assert np.std(ends) == pytest.approx(0.02 * 100.0**1.5 / np.sqrt(3.0), rel=0.08)
    assert track.compute_row_sigmas(100.0)[0] == pytest.approx(0.02 * 100.0**1.5 / np.sqrt(3.0))


def test_pairs_of_heights_and_spacings_are_flown() -> None:
    settings = DescentSettings(from_km=10.0, spacing_s=((5.0, 20.0), (0.0, 5.0)), duration_s=100.0)
    steps = set(np.diff(picture_times(settings)))
    assert steps == {20.0, 5.0}


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"to_km": 30.0}, "comes from above"),
        ({"spacing_s": ((5.0, 20.0), (6.0, 5.0))}, "do not fall to 0"),
        ({"spacing_s": ()}, "do not fall to 0"),
        ({"duration_s": 99999.0, "spacing_s": 1.0}, "more than 10000 pictures"),
    ],
)
def test_what_is_no_descent_is_said(changes: dict[str, object], wanted: str) -> None:
    scenario = shipped()
    descent = msgspec.structs.replace(scenario.descent, **changes)
    with pytest.raises(ConfigError, match=wanted):
        msgspec.structs.replace(scenario, descent=descent).check()


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [({"end_deg": (30.0, 10.0)}, "has no ground"), ({"to_km": 0.01}, "over the ground")],
)
def test_a_path_off_or_in_the_ground_is_refused(changes: dict[str, object], wanted: str) -> None:
    scenario = shipped()
    descent = msgspec.structs.replace(scenario.descent, **changes)
    with pytest.raises(ConfigError, match=wanted):
        msgspec.structs.replace(scenario, descent=descent).exposures(MOON)


def test_a_folder_of_a_track_reads_back_with_its_errors(tmp_path: Path) -> None:
    camera = tmp_path / "small.toml"
    camera.write_text(
        'name = "small"\nmodel = "pinhole"\nwidth_px = 64\nheight_px = 64\n'
        "principal_point_px = [31.5, 31.5]\nfocal_length_px = 41.0\n"
        "psf_sigma_px = 0.7\npsf_error_px = 0.05\n"
    )
    scenario = Descent(
        camera=MainCamera(str(camera)),
        dem=(DemSettings(str(resource("data/tycho_gld100_256ppd.tif"))),),
        globe=GlobeSettings(str(resource("data/moon_gld100_4ppd.tif"))),
        detail=DetailSettings(seeds=()),
        descent=DescentSettings(
            from_km=4.0, duration_s=10.0, speed_m_s=(100.0, 70.0), spacing_s=10
        ),
        inertial=TRACK,
    )
    simulate(scenario, tmp_path / "pictures", workers=1)
    folder = read_folder(tmp_path / "pictures")
    assert folder.settings.inertial == TRACK
    assert [frame.problem for frame in folder.frames] == [None, None]
    first, last = folder.frames
    assert first.position_sigma_m == pytest.approx(300.0, rel=1e-6)
    assert last.position_sigma_m == pytest.approx(np.hypot(300.0, 0.8 * 10.0), abs=1e-3)
    wanted = ARCSEC * np.sqrt(12.0**2 + 0.8**2 + 3.0**2)
    assert last.attitude_sigma_rad == pytest.approx(wanted, rel=1e-4)


SMALL = Descent(
    camera=MainCamera("tsnn2_wide"),
    dem=(DemSettings(str(resource("data/tycho_gld100_256ppd.tif"))),),
    globe=GlobeSettings(str(resource("data/moon_gld100_4ppd.tif"))),
    detail=DetailSettings(seeds=(5,), smallest_m=30.0),
    descent=DescentSettings(from_km=4.0, duration_s=10.0, speed_m_s=(100.0, 70.0), spacing_s=10),
    model=ModelSettings(posting_m=30.0, error_m=1.0, margin_km=1.0),
)


def test_a_surveyed_model_is_the_truth_in_means_and_wrong_by_its_error(tmp_path: Path) -> None:
    """The same noise at another size: the model is linear in its error."""
    flight = SMALL.exposures(MOON)

    def model(error_m: float) -> DemSource:
        settings = ModelSettings(posting_m=30.0, error_m=error_m, margin_km=1.0)
        path = tmp_path / f"{error_m}.tif"
        path.write_bytes(surveyed_model(settings, SMALL, MOON.body, flight))
        assert path.read_bytes() == surveyed_model(settings, SMALL, MOON.body, flight)
        return DemSource.open(DemSettings(str(path)), tmp_path, MOON.body)

    right, wrong = model(0.0), model(2.0)
    assert right.posting_m == pytest.approx(118.45 / 4, rel=1e-3)
    west, south, east, north = np.degrees(right.latlon_bounds())
    assert west < -15.0 < east
    assert south < -43.5 < north
    heights, off = (source.read_window(0, 0, *source.shape) for source in (right, wrong))
    assert (off - heights).std() == pytest.approx(2.0, rel=0.01)
    # the truth has relief below 118 m, which its first model has not
    coarse = DemSource.open(SMALL.dem[0], tmp_path, MOON.body)
    rough = np.diff(heights, 2, axis=0).std() / right.posting_m**2
    known = np.diff(coarse.read_window(0, 0, *coarse.shape), 2, axis=0).std()
    assert rough > 3.0 * known / coarse.posting_m**2


def test_a_model_coarser_than_the_ground_is_refused() -> None:
    flight = SMALL.exposures(MOON)
    with pytest.raises(ConfigError, match="three quarters of the 118 m"):
        surveyed_model(ModelSettings(posting_m=100.0), SMALL, MOON.body, flight)


def test_a_model_of_too_much_ground_is_refused_before_the_pictures(tmp_path: Path) -> None:
    wide = msgspec.structs.replace(SMALL, model=ModelSettings(posting_m=30.0, margin_km=1e3))
    with pytest.raises(ConfigError, match="nodes are possible"):
        simulate(wide, tmp_path / "pictures", workers=1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "line", ["position_sigma_m = -300.0", "velocity = 0.8", "position_sigma_m = nan"]
)
def test_an_inertial_section_that_is_wrong_is_said(tmp_path: Path, line: str) -> None:
    path = tmp_path / "run.toml"
    path.write_text(f'body = "moon"\nattitude = "camera_from_body"\n[inertial]\n{line}\n')
    with pytest.raises(ConfigError, match="inertial"):
        read_run_settings(path)
