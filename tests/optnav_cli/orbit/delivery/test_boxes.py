"""Deliveries: the B-plane, partials of the path, navigation, and boxes that hold all trials."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.errors import ConfigError, NoSolutionError
from optnav_cli.orbit.delivery import boxes as delivery
from optnav_cli.orbit.delivery.boxes import (
    DeliveryTask,
    biased_navigation,
    cover,
    delivery_task,
    fly_deliveries,
)
from optnav_cli.orbit.delivery.path import b_plane
from optnav_cli.orbit.delivery.settings import (
    AimSettings,
    DeliverySettings,
    ThrustSettings,
    load_delivery_settings,
)

MOON = load_body("moon")
SETTINGS = load_delivery_settings(Path("bundled:delivery_moon"))
POLE = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def task() -> DeliveryTask:
    return delivery_task(SETTINGS, MOON, "moon.toml")


def test_the_b_plane_is_that_of_the_asymptote() -> None:
    """Far away the path is its asymptote: B is the part of the place across the velocity."""
    speed, far = 2000.0, 4e9
    s = np.array([0.6, 0.0, 0.8])
    e_eta = np.cross(POLE, s) / np.linalg.norm(np.cross(POLE, s))
    e_xi = np.cross(e_eta, s)
    b = 5.0e6 * e_xi - 3.0e6 * e_eta
    found = b_plane(np.concatenate([b - far * s, speed * s]), 1e9, POLE)
    assert found.aim[:2] == pytest.approx([5.0e6, -3.0e6], rel=2e-4)
    assert found.aim[2] == pytest.approx(far / speed, rel=1e-3)
    assert found.speed_m_s == pytest.approx(speed, rel=1e-4)


def test_the_usual_axes_have_xi_along_r_and_eta_against_t() -> None:
    """T = S x N, R = S x T: xi = B.R, eta = -B.T; (xi, eta, S) is right-handed."""
    s = np.array([0.48, 0.6, 0.64])
    e_eta = np.cross(POLE, s) / np.linalg.norm(np.cross(POLE, s))
    e_xi = np.cross(e_eta, s)
    t = np.cross(s, POLE) / np.linalg.norm(np.cross(s, POLE))
    assert np.cross(s, t) == pytest.approx(e_xi)
    assert -t == pytest.approx(e_eta)
    assert np.cross(e_xi, e_eta) == pytest.approx(s)


def test_a_bound_path_has_no_b_plane() -> None:
    with pytest.raises(NoSolutionError, match="bound to it"):
        b_plane(np.array([1e7, 0.0, 0.0, 0.0, 500.0, 0.0]), MOON.gm_m3_s2, POLE)


def test_the_path_leads_to_the_aim(task: DeliveryTask) -> None:
    assert task.path.plane.aim[:2] == pytest.approx([6.0e6, 1.0e6], abs=1.0)
    assert (task.path.pericentre_s - task.path.tdb_s[0]) / 86400.0 == pytest.approx(4.5, abs=1e-4)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_partials_of_corrections_agree_with_flown_differences(
    task: DeliveryTask, number: int
) -> None:
    """By paths whose velocity differs by 1 cm/s, on to the same place before the target."""
    correction = task.corrections[number]
    at = task.path.number_of(task.path.tdb_s[0] + correction.day * 86400.0)
    motion, state = task.path.motion, task.path.states[at]
    begin = float(task.path.tdb_s[at])
    end = max(float(task.path.tdb_s[task.path.entry]), begin + 600.0)
    columns = []
    for axis in range(3):
        ends = []
        for way in (1.0, -1.0):
            other = state.copy()
            other[3 + axis] += way * 0.01
            flown = motion.fly(other, np.array([begin, end]))[0][-1]
            ends.append(motion.arrival(flown, end).aim)
        columns.append((ends[0] - ends[1]) / 0.02)
    numeric = np.array(columns).T
    scale = np.abs(numeric).max(axis=1, keepdims=True)
    assert np.abs((numeric - correction.w) / scale).max() < (2e-2 if number == 2 else 2e-3)


def test_the_navigation_is_that_of_drawn_biases(task: DeliveryTask) -> None:
    for arc in task.arcs:
        random, every = arc.covariance()
        drawn = biased_navigation(arc, 2000, 1).std(axis=0)
        assert drawn == pytest.approx(np.sqrt(np.diag(every)), rel=0.1)
        assert (np.diag(every) >= np.diag(random)).all()


def test_all_trials_with_cut_errors_lie_in_the_boxes(task: DeliveryTask) -> None:
    boxes = cover(task)
    trials = fly_deliveries(task, 50_000, 4, cut=True)
    for box, errors in zip(boxes, trials.errors, strict=True):
        assert box.holds(errors).all()
    for box, dv in zip(boxes[1:], trials.dv_m_s, strict=True):
        assert dv.max() <= box.dv_m_s
    assert trials.total.max() <= boxes[-1].spent.max()


def test_bounds_are_not_much_larger_than_trials(task: DeliveryTask) -> None:
    boxes = cover(task)
    trials = fly_deliveries(task, 100_000, 5, cut=False)
    assert boxes[-1].spent.max() < 1.3 * np.percentile(trials.total, 99.73)
    arrived = np.percentile(np.abs(trials.errors[-1]), 99.73, axis=0)
    assert (boxes[-1].reach < 2.0 * arrived).all()


def test_points_outside_are_not_held(task: DeliveryTask) -> None:
    box = cover(task)[-1]
    assert not box.holds(np.array([[1e9, 0.0, 0.0], [0.0, -1e9, 0.0]])).any()


def test_later_corrections_leave_smaller_errors(task: DeliveryTask) -> None:
    """Until the last one, half a day before the arrival: its xi is the navigation's then."""
    reach = np.array([box.reach for box in cover(task)])
    assert (np.diff(reach[:3, :2], axis=0) < 0.0).all()
    assert (np.diff(reach[:, 1]) < 0.0).all()


def test_directions_lie_about_the_sphere_as_near_as_they_are_taken_to() -> None:
    rng = np.random.default_rng(1)
    any_way = rng.normal(size=(20_000, 3))
    any_way /= np.linalg.norm(any_way, axis=1)[:, None]
    nearest = np.arccos((any_way @ delivery._directions().T).max(axis=1))
    assert nearest.max() < delivery.NEXT_RAD


def test_the_bound_of_all_corrections_is_reached_by_errors_at_their_bounds(
    task: DeliveryTask,
) -> None:
    """Injection and navigation at their bounds as the first burn wants it most."""
    first = task.corrections[0]
    inverse, bound = np.linalg.inv(first.w), task.settings.burns.bound_sigmas
    burns = []
    for way in delivery._directions():
        pull = way @ inverse
        injected = bound * task.injection @ np.sign(pull @ task.injection)
        known = bound * first.errors @ pull / np.sqrt(pull @ first.errors @ pull)
        burns.append(np.linalg.norm(inverse @ (injected + known)))
    each, total = delivery.dv_bounds(task)
    assert max(burns) <= each[0] <= 1.01 * max(burns)
    assert each[0] < total <= sum(each)


def test_thrust_that_is_wrong_widens_the_arrival(task: DeliveryTask) -> None:
    thrust = ThrustSettings(acceleration_m_s2=1e-4, start_day=3.2, end_day=3.6)
    other = delivery_task(msgspec.structs.replace(SETTINGS, thrust=thrust), MOON, "moon.toml")
    assert np.trace(other.corrections[2].unknown) > 0.0
    assert not other.corrections[0].unknown.any()
    wide = fly_deliveries(other, 20_000, 1, cut=False).errors[2].std(axis=0)
    assert (wide > fly_deliveries(task, 20_000, 1, cut=False).errors[2].std(axis=0)).all()


def replaced(**section: object) -> DeliverySettings:
    delivery = msgspec.structs.replace(SETTINGS.delivery, **section)
    return msgspec.structs.replace(SETTINGS, delivery=delivery)


def test_a_correction_after_the_arrival_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"correction after 5 days; the arrival .* 4\.50 days"):
        delivery_task(replaced(corrections_days=(1.0, 5.0)), MOON, "moon.toml")


def test_a_start_that_misses_the_target_is_refused() -> None:
    wrong = replaced(velocity_km_s=(0.0, 11.0, 4.0))
    with pytest.raises(NoSolutionError, match=r"does not come within \d+ km of moon"):
        delivery_task(wrong, MOON, "moon.toml")


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (
            {"position_km": (0.0, 1778.8, 1196.7)},
            "the start is 2144 km from the centre of the earth",
        ),
        ({"velocity_km_s": (-9.0, -2.5, -1.7)}, r"the path meets the earth \d+ s after the start"),
    ],
)
def test_a_path_through_the_centre_is_refused_at_once(wrong: dict[str, object], why: str) -> None:
    with pytest.raises(NoSolutionError, match=why):
        delivery_task(replaced(**wrong), MOON, "moon.toml")


def test_an_aim_out_of_reach_is_refused() -> None:
    aim = AimSettings(xi_km=6000.0, eta_km=1000.0, pericentre="2026-03-03T12:00:00Z")
    with pytest.raises(NoSolutionError):
        delivery_task(msgspec.structs.replace(SETTINGS, aim=aim), MOON, "moon.toml")


def test_an_arc_that_no_station_sees_is_refused() -> None:
    station = msgspec.structs.replace(SETTINGS.station[0], lat_deg=-89.0)
    radio = msgspec.structs.replace(SETTINGS.radio, min_elevation_deg=60.0)
    wrong = msgspec.structs.replace(SETTINGS, station=(station,), radio=radio)
    with pytest.raises(NoSolutionError, match="no station sees the craft"):
        delivery_task(wrong, MOON, "moon.toml")


def test_a_correction_that_cannot_change_the_arrival_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The limit is lowered to what this path has: no shipped one has a singular W."""
    monkeypatch.setattr(delivery, "MAX_CONDITION", 2.2)
    with pytest.raises(ConfigError, match=r"correction after 1 days cannot change .* 2\.4e\+00"):
        delivery_task(SETTINGS, MOON, "moon.toml")


def test_corrections_that_make_errors_larger_than_the_path_are_refused(task: DeliveryTask) -> None:
    """Burns whose fixed error alone moves the arrival by more than the way to it."""
    burns = msgspec.structs.replace(task.settings.burns, fixed_m_s=3e4)
    wild = replace(task, settings=msgspec.structs.replace(task.settings, burns=burns))
    with pytest.raises(NoSolutionError, match=r"grow without bound: .* km after the correction of"):
        cover(wild)
