"""Moon and Earth in one picture, and the one taken for the other: discs at the true places."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.picture import Picture
from optnav_cli.outline import method as outline
from optnav_cli.outline.neighbour import find_other_body
from tests.optnav_cli.outline.disc.drawn_discs import RADIUS_M, blurred_disc, expose

MOON = load_body("moon")
TDB_S = 8.2e8
EARTH = find_other_body(AnalyticEphemeris(MOON), TDB_S)
CAMERA = Camera("wide", "pinhole", 260, 260, 650.0, (129.5, 129.5))
SIDE = np.cross(EARTH.centre_m, [0.1, 0.2, 1.0])
SIDE /= np.linalg.norm(SIDE)


def view(position, towards, roll=0.4):
    """Attitude that looks along a body-frame vector, and the Sun 50 degrees off behind it."""
    z = towards / np.linalg.norm(towards)
    x = np.cross(z, [0.3, 0.4, 1.0])
    x /= np.linalg.norm(x)
    turn = Rotation.from_rotvec([0.0, 0.0, roll]) * Rotation.from_matrix(
        np.stack([x, np.cross(z, x), z])
    )
    sun = -z * np.cos(0.87) + x * np.sin(0.87)
    return position, turn, sun


def drawn(position, turn, sun, *bodies):
    """The picture of the Moon, the Earth or both; a sphere nearer by as much is the Moon's size."""
    total = np.zeros(CAMERA.shape)
    for name in bodies:
        centre, radius = (np.zeros(3), RADIUS_M) if name == "moon" else (
            EARTH.centre_m, EARTH.radius_m
        )  # fmt: skip
        there = turn.apply(centre - position) * (RADIUS_M / radius)
        total += blurred_disc(CAMERA, there, turn.apply(sun), "hapke", 0.8)
    return Picture(expose(total, 50.0, np.random.default_rng(5)), 255.0)


def solve(picture, _, turn, sun):
    return outline.navigate(picture, CAMERA, turn, 5e-5, sun, MOON, None, EARTH)


def beyond(distance_m, off_deg):
    """A place from which Moon and Earth are so far apart, looking between them."""
    line = EARTH.centre_m / np.linalg.norm(EARTH.centre_m)
    aside = Rotation.from_rotvec(np.radians(off_deg) * SIDE).apply(line)
    position = -distance_m * aside
    earth = EARTH.centre_m - position
    return view(position, aside + earth / np.linalg.norm(earth))


@pytest.mark.parametrize(
    "place",
    [beyond(40e6, 10.0), beyond(140e6, 10.0), beyond(250e6, 10.0)],
    ids=["Moon larger", "same size", "Earth larger"],
)
def test_the_moon_is_told_from_the_earth_by_where_each_must_stand(place):
    """Also where the Earth is the larger disc, and where both have one size."""
    fix = solve(drawn(*place, "moon", "earth"), *place)
    assert "the earth is in the picture too" in fix.reason.text
    error = fix.position_m - place[0]
    assert error @ np.linalg.solve(fix.covariance_m2, error) < 16.0
    assert np.linalg.norm(error) < 0.1 * np.linalg.norm(place[0])


def test_discs_whose_places_do_not_fit_are_not_guessed():
    """A wrong turn about the line of sight, under which the Sun alone would still be right."""
    position, turn, sun = beyond(40e6, 10.0)
    wrong = Rotation.from_rotvec([0.0, 0.0, 2.0]) * turn
    with pytest.raises(NoSolutionError, match=r"two bodies|the earth should be seen about"):
        solve(
            drawn(position, turn, sun, "moon", "earth"),
            position,
            wrong,
            wrong.inv().apply(turn.apply(sun)),
        )


def test_a_lone_disc_without_the_earth_that_should_stand_beside_it_is_refused():
    place = beyond(40e6, 10.0)
    with pytest.raises(NoSolutionError, match="the earth should be seen about"):
        solve(drawn(*place, "moon"), *place)


def test_the_earth_seen_from_a_low_orbit_is_not_the_moon():
    low = np.cross(EARTH.centre_m, SIDE)
    place = view(2.0e6 * low / np.linalg.norm(low), EARTH.centre_m)
    with pytest.raises(NoSolutionError, match="the disc is where the earth stands"):
        solve(drawn(*place, "earth"), *place)
    # with nothing known of an Earth it would be a Moon far off
    alone = outline.navigate(drawn(*place, "earth"), CAMERA, place[1], 5e-5, place[2], MOON, None)
    assert np.linalg.norm(alone.position_m) > 80e6


def test_a_lone_moon_elsewhere_is_solved_without_a_word():
    place = view(30e6 * SIDE, -SIDE)
    fix = solve(drawn(*place, "moon"), *place)
    assert "earth" not in fix.reason.text
    error = fix.position_m - place[0]
    assert error @ np.linalg.solve(fix.covariance_m2, error) < 16.0


def test_a_spot_no_wider_than_a_star_is_no_body():
    star = np.zeros(CAMERA.shape)
    star[101, 140] = 400.0
    light = cv2.GaussianBlur(star, (0, 0), 0.9)
    picture = Picture(expose(light, 50.0, np.random.default_rng(1)), 255.0)
    _, turn, sun = view(30e6 * SIDE, -SIDE)
    with pytest.raises(NoSolutionError, match="a star or a planet looks the same"):
        outline.navigate(picture, CAMERA, turn, 5e-5, sun, MOON, None)
