"""Which method a frame is solved by, which one stands where two disagree, and the reasons.

Outlines and control points are stood in for by answers with stated errors: what they do with
pictures is tested with them.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.control_points.settings import NavigateSettings
from optnav_cli.dynamics.forces import Forces, OrbitMotion
from optnav_cli.fix import (
    Evidence,
    Fix,
    GateMargins,
    MatchRow,
    Method,
    OutlineMarks,
    UnsolvedFrameError,
)
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.picture import Picture
from optnav_cli.navigate import answers
from optnav_cli.navigate.answers import NavigationInputs
from optnav_cli.navigate.autonomous import Navigator
from optnav_cli.reasons import Reason, ReasonCode

MOON = load_body("moon")
MOTION = AnalyticEphemeris(MOON)
START_S = 8.2e8
SUN = np.array([1.0, 0.0, 0.0])
MARKS = OutlineMarks.mark_disc(np.array([31.5, 31.5]))
WIDE = Camera("wide", "pinhole", 64, 64, 100.0, (31.5, 31.5))
NARROW = Camera("narrow", "pinhole", 64, 64, 1000.0, (31.5, 31.5))
PICTURE = Picture(np.zeros((64, 64), dtype=np.float32), 255.0)
TURN = Rotation.from_euler("xyz", [0.3, -0.2, 0.1])


@dataclass
class Layer:
    postings_m: np.ndarray


@dataclass
class Field:
    """The one thing that the loop itself asks of the control points: how coarse they get."""

    layers: list


class Sky:
    """Stands in for both methods: by frame, what the picture would give them."""

    def __init__(self, monkeypatch):
        self.truth = flight()
        self.outlines: dict[int, np.ndarray | str] = {}
        self.no_points: dict[int, int] = {}
        self.point_sun_deg = 30.0
        self.margins: GateMargins | None = None
        self.priors: list = []
        self.right = TURN
        self.method = Method.HORIZON
        self.frame = None
        monkeypatch.setattr(answers.outline, "navigate", self.outline)
        monkeypatch.setattr(answers.control_points, "navigate", self.points)
        coarse = Field([Layer(np.array([948.0, 15168.0]))])
        self.world = NavigationInputs(coarse, MOTION, None, NavigateSettings(), None)
        self.navigator = Navigator(self.world)

    def outline(self, picture, camera, camera_from_body, *_):
        known = self.outlines.get(self.frame, "only stars")
        if isinstance(known, str) or (camera_from_body * self.right.inv()).magnitude() > 0.1:
            raise NoSolutionError(
                known if isinstance(known, str) else "the Sun is on the dark side",
                ReasonCode.NO_LIMB,
            )
        place = self.truth[self.frame] + known
        evidence = Evidence(residual_rms_px=0.1, n_limb=900, arc_deg=200.0, outline=MARKS)
        return Fix(self.method, place, np.eye(3) * 200.0**2, camera_from_body, 0.0, evidence)

    def points(self, observation, prior, *_):
        self.priors.append(prior)
        wrong = (observation.camera_from_body * self.right.inv()).magnitude() > 0.1
        if self.frame in self.no_points or wrong:
            count = 24 if wrong else self.no_points[self.frame]
            reason = Reason(ReasonCode.POINTS_DISAGREE, "no 2 matches agree on a position")
            evidence = replace(tried(count, self.point_sun_deg), margins=self.margins)
            raise UnsolvedFrameError(reason, evidence)
        return Fix(
            Method.CONTROL_POINTS,
            self.truth[self.frame] + [10.0, -5.0, 8.0],
            np.eye(3) * 15.0**2,
            observation.camera_from_body,
            0.0,
        )

    def see(self, number, camera=WIDE, **changes):
        self.frame = number
        frame = Frame(
            file=f"{camera.name}_{number}.png",
            utc="2025-12-26T00:00:00Z",
            camera=camera.name,
            tdb_s=START_S + 60.0 * number,
            camera_from_body=TURN,
            attitude_sigma_rad=5e-5,
            sun_body=SUN,
        )
        return self.navigator.solve(replace(frame, **changes), camera, PICTURE)


def tried(count, sun_deg):
    """Evidence of so many control points without a match."""
    row = MatchRow("a.png", 1, 0, np.zeros(3), np.zeros(2), sun_elevation_deg=sun_deg)
    return Evidence(n_predicted=count, n_matched=0, n_used=0, matches=(row,) * count)


def flight(count=16):
    """Body-fixed positions of a low orbit every 60 s."""
    radius = MOON.radius_m + 100e3
    speed = np.sqrt(MOON.gm_m3_s2 / radius)
    state = np.array([radius, 0.0, 0.0, 0.0, speed * 0.6, speed * 0.8])
    times = START_S + 60.0 * np.arange(count)
    states, _ = OrbitMotion(Forces(MOTION)).propagate(state, START_S, times)
    return [MOTION.body_from_inertial(t) @ s[:3] for t, s in zip(times, states, strict=True)]


@pytest.fixture
def sky(monkeypatch):
    return Sky(monkeypatch)


def test_control_points_are_found_from_the_horizon(sky):
    sky.outlines[0] = np.array([300.0, -200.0, 100.0])
    row = sky.see(0)
    assert (row.method, row.prior, row.n_limb, row.arc_deg) == (
        "control_points", "horizon", 900, 200.0,
    )  # fmt: skip
    assert np.sqrt(np.diag(sky.priors[0].covariance_m2)) == pytest.approx(200.0)
    assert row.reason == ""


def test_the_horizon_stands_where_too_few_points_are_in_view(sky):
    sky.outlines[0] = np.array([300.0, -200.0, 100.0])
    sky.no_points[0] = 3
    row = sky.see(0)
    assert row.solved
    assert (row.method, row.n_used, row.n_limb) == ("horizon", None, 900)
    assert row.reason == "control points: no 2 matches agree on a position"


def test_from_afar_no_points_are_searched(sky):
    sky.truth[0] = np.array([5e7, 0.0, 0.0])
    sky.outlines[0] = np.array([9e3, 0.0, 0.0])
    row = sky.see(0, NARROW)
    assert row.method == "horizon"
    assert "the body is 72 px across: its limb tells more" in row.reason
    assert sky.priors == []


def test_many_missed_points_refuse_the_horizon(sky):
    sky.outlines[0] = np.array([20e3, 0.0, 0.0])
    sky.no_points[0] = 24
    row = sky.see(0)
    assert not row.solved
    assert "24 well-lit control points into view, but they are not there" in row.reason
    assert "focal length" in row.reason
    assert row.reason_code == ReasonCode.POINTS_MISSING


@pytest.mark.parametrize(
    ("decades", "scatter", "solved"), [(3.0, 1.05, True), (3.0, 1.6, False), (-1.0, 1.05, False)]
)
def test_points_that_scatter_by_their_model_confirm_the_horizon(sky, decades, scatter, solved):
    """They are there, by more than chance, though their model is too coarse for their pixels."""
    sky.outlines[0] = np.zeros(3)
    sky.no_points[0] = 24
    sky.margins = GateMargins(decades, scatter)
    row = sky.see(0)
    assert row.solved == solved
    if solved:
        assert row.method == "horizon"
        assert "control points: no 2 matches agree" in row.reason
    else:
        assert row.reason_code == ReasonCode.POINTS_MISSING


def test_missed_points_under_a_high_sun_do_not_refuse_the_horizon(sky):
    sky.outlines[0] = np.zeros(3)
    sky.no_points[0] = 24
    sky.point_sun_deg = 58.0
    row = sky.see(0)
    assert (row.method, row.status) == ("horizon", "solved")
    assert "control points: no 2 matches agree" in row.reason


def test_the_narrow_camera_begins_where_the_wide_one_is_at_the_same_time(sky):
    sky.outlines[0] = np.zeros(3)
    sky.see(0)
    row = sky.see(0, NARROW)
    assert row.prior == "wide camera, wide_0.png"
    assert row.method == "control_points"
    # a minute later a single fix says too little
    assert "no frame before leads here" in sky.see(1, NARROW).reason


def test_a_part_of_a_small_disc_is_left_to_control_points(sky):
    """A narrow camera that shows no limb of a body whose whole limb would tell more."""
    sky.truth[0] = np.array([8e6, 0.0, 0.0])
    sky.outlines[0] = np.array([500.0, 0.0, 0.0])
    assert "px across" in sky.see(0).reason
    sky.outlines[0] = "the body fills the picture"
    row = sky.see(0, NARROW)
    assert row.method == "control_points"
    assert row.prior == "wide camera, wide_0.png"


def test_the_arc_serves_where_no_limb_is_in_view(sky):
    for number in range(4):
        sky.outlines[number] = np.zeros(3)
        assert sky.see(number).prior == "horizon"
    row = sky.see(4)
    assert (row.method, row.prior) == ("control_points", "arc of 4 fixes")
    assert np.linalg.norm(sky.priors[-1].position_m - sky.truth[4]) < 500.0


def test_a_prediction_alone_is_no_solution(sky):
    for number in range(4):
        sky.outlines[number] = np.zeros(3)
        sky.see(number)
    sky.no_points[4] = 24
    row = sky.see(4)
    assert not row.solved
    assert "only stars" in row.reason


def test_a_broken_frame_does_not_lose_the_track(sky):
    for number in range(4):
        sky.outlines[number] = np.zeros(3)
        sky.see(number)
    sky.no_points = dict.fromkeys((4, 5, 6), 24)
    assert not any(sky.see(number).solved for number in (4, 5, 6))
    row = sky.see(7)
    assert row.solved
    assert row.prior == "arc of 4 fixes"


def test_a_lone_horizon_off_the_arc_is_refused_until_the_next_agrees(sky):
    for number in range(4):
        sky.outlines[number] = np.zeros(3)
        sky.see(number)
    sky.no_points = dict.fromkeys(range(4, 9), 2)
    sky.outlines[4] = np.array([0.0, 40e3, 0.0])
    row = sky.see(4)
    assert not row.solved
    assert "from where the arc of 4 fixes leads: one of both is wrong" in row.reason
    assert row.reason_code == ReasonCode.CONTRADICTS_ARC
    sky.outlines[5] = np.zeros(3)
    assert sky.see(5).reason == "control points: no 2 matches agree on a position"
    for number in (6, 7):
        sky.outlines[number] = np.array([0.0, 40e3, 0.0])
    assert not sky.see(6).solved
    again = sky.see(7)
    assert again.solved
    assert "as the frame before: a manoeuvre" in again.reason


def test_a_bright_spot_no_craft_can_have_flown_to_is_refused(sky):
    """A lit peak on the night side, or a planet, looks like the whole body from far away."""
    for number in range(2):
        sky.outlines[number] = np.zeros(3)
        sky.see(number)
    # long after the arc's end
    sky.truth[5] = np.array([3e8, 0.0, 0.0])
    sky.outlines[5] = np.array([1e6, 0.0, 0.0])
    row = sky.see(5, tdb_s=START_S + 3000.0)
    assert not row.solved
    assert "s before: no craft flies so fast" in row.reason
    assert row.reason_code == ReasonCode.TOO_FAST
    assert sky.see(5, tdb_s=START_S + 3e6).solved


def test_two_methods_that_agree_end_the_arc(sky):
    for number in range(4):
        sky.outlines[number] = np.zeros(3)
        sky.see(number)
    sky.truth = [place + [0.0, 30e3, 0.0] for place in sky.truth]
    sky.outlines[4] = np.zeros(3)
    row = sky.see(4)
    assert row.solved
    assert "from where the arc of 4 fixes leads: a manoeuvre" in row.reason
    sky.outlines[5] = np.zeros(3)
    assert sky.see(5).reason == ""


def test_a_horizon_far_from_the_points_it_led_to_is_remarked(sky):
    sky.outlines[0] = np.array([2e3, 0.0, 0.0])
    row = sky.see(0)
    assert row.solved
    assert "the horizon lies 2.0 km (10 sigmas) off" in row.reason


def test_a_prior_of_the_file_is_used_and_says_so(sky):
    known = {"position_m": sky.truth[0] + 1e3, "position_sigma_m": 3e3}
    row = sky.see(0, **known)
    assert (row.method, row.prior, row.n_limb) == ("control_points", "frames.csv", None)
    sky.no_points[1] = 24
    failed = sky.see(1, position_m=sky.truth[1], position_sigma_m=3e3)
    assert not failed.solved
    assert failed.reason == "no 2 matches agree on a position"


def test_a_silhouette_that_the_prior_holds_stands_in_for_missed_points(sky):
    """Its own position is searched from, and stands where that finds no point either."""
    sky.method = Method.SILHOUETTE
    sky.no_points[0] = 24
    sky.outlines[0] = np.array([300.0, -200.0, 100.0])
    row = sky.see(0, position_m=sky.truth[0] + 2e3, position_sigma_m=3e3)
    assert row.solved
    assert (row.method, row.prior) == ("silhouette", "frames.csv")
    assert row.reason == "control points: no 2 matches agree on a position"
    assert [prior.source for prior in sky.priors] == ["frames.csv", "silhouette"]
    assert row.n_limb == 900
    # of a free attitude the stated one is no place to search from
    sky.no_points[1], sky.outlines[1] = 24, np.zeros(3)
    known = {"position_m": sky.truth[1] + 2e3, "position_sigma_m": 3e3}
    free = sky.see(1, attitude_sigma_rad=None, **known)
    assert free.method == "silhouette"
    assert len(sky.priors) == 3


@pytest.mark.parametrize(("method", "off_m"), [(Method.SILHOUETTE, 60e3), (Method.HORIZON, 0.0)])
def test_other_outlines_do_not_overrule_missed_points_of_a_prior(sky, method, off_m):
    sky.method = method
    sky.no_points[0] = 24
    sky.outlines[0] = np.array([off_m, 0.0, 0.0])
    assert not sky.see(0, position_m=sky.truth[0], position_sigma_m=3e3).solved


@pytest.mark.parametrize("prior", [True, False])
@pytest.mark.parametrize("inertial", [True, False])
def test_the_inverse_rotation_is_named(sky, prior, inertial):
    sky.outlines[0] = np.zeros(3)
    sky.navigator = Navigator(replace(sky.world, inertial=inertial))
    turn = np.eye(3)
    if inertial:
        turn = MOTION.body_from_inertial(START_S)
    stated = (TURN * Rotation.from_matrix(turn)).inv() * Rotation.from_matrix(turn).inv()
    known = {"position_m": sky.truth[0], "position_sigma_m": 3e3} if prior else {}
    row = sky.see(0, camera_from_body=stated, **known)
    assert not row.solved
    wanted = "camera_from_inertial" if inertial else "camera_from_body"
    assert f"the picture fits the inverse rotation: wanted the quaternion of {wanted}" in row.reason
    assert row.reason_code == ReasonCode.WRONG_ATTITUDE


def test_without_anything_the_reason_says_what_is_missing(sky):
    row = sky.see(0)
    assert row.reason == "no prior: only stars; and no frame before leads here"
    assert row.reason_code == ReasonCode.NO_PRIOR
    assert "quaternion is empty" in sky.see(0, camera_from_body=None).reason
