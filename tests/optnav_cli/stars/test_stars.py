"""Stars in pictures: which they are, the attitude, and what is said of pictures without."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.stars import load_bright_stars, make_stars
from catalog.errors import NoSolutionError
from catalog.geometry.rotations import ARCSEC
from optnav_cli.camera.camera import Camera
from optnav_cli.camera.camera_file import preset_camera
from optnav_cli.frames.picture import load_picture
from optnav_cli.reasons import ReasonCode, describe_length
from optnav_cli.stars.identify import StarIdentifier
from optnav_cli.stars.sky import SkyView, find_star_attitude
from optnav_cli.stars.spots import StarSpots, find_spots
from tests.optnav_cli.made_skies import (
    CAMERA,
    UTC,
    add_body,
    drawn_sky,
    sky_directions,
    spots_of,
    turned,
)

ORION = turned(84.0, -1.0, 20.0)
REAL = Path(os.environ.get("OPTNAV_SHARED_DATA", "")) / "stars" / "star_field.tiff"


def errors_arcsec(found: Rotation, true: Rotation) -> np.ndarray:
    """About the camera's axes."""
    return (found * true.inv()).as_rotvec() / ARCSEC


def found_in(picture, camera=CAMERA):
    return StarIdentifier(camera, sky_directions()).identify(find_spots(picture, 65535.0))


@pytest.mark.parametrize(
    "pointing", [(84.0, -1.0, 20.0), (200.0, 55.0, -70.0), (266.0, -29.0, 170.0)]
)
def test_a_drawn_sky_gives_its_attitude_inside_the_sigmas(pointing):
    turn = turned(*pointing)
    fix = found_in(drawn_sky(turn, seed=int(pointing[0])))
    off = errors_arcsec(fix.camera_from_sky, turn) * ARCSEC
    assert off @ np.linalg.solve(fix.covariance, off) < 14.2
    assert np.abs(off[:2]).max() / ARCSEC < 8.0
    assert fix.residual_rms_px < 0.2
    assert fix.chance < 1e-5


def test_stars_beside_a_lit_body_and_its_glare_are_found():
    fix = found_in(add_body(drawn_sky(ORION)))
    assert np.abs(errors_arcsec(fix.camera_from_sky, ORION))[:2].max() < 10.0


def test_a_lit_bodys_relief_is_no_noise_of_the_sky():
    """With a third of the picture it counted 1.6 times, and hid stars as faint."""
    sky, rng = drawn_sky(ORION), np.random.default_rng(3)
    beside = add_body(sky, (150, 330), 160, 0.0)
    lit = beside > 50_000.0
    beside[lit] += rng.normal(0.0, 3000.0, int(lit.sum())).astype(np.float32)
    alone, with_body = find_spots(sky), find_spots(beside)
    assert with_body.body > 0.3
    away = np.linalg.norm(alone.pixels[:, None] - with_body.pixels, axis=2)
    same = away.min(axis=0) < 0.2
    assert same.sum() > 15
    ratio = with_body.sigma_px[same] / alone.sigma_px[away.argmin(axis=0)[same]]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)


def test_a_lens_longer_by_half_a_per_cent_is_told_by_the_stars():
    longer = CAMERA.with_focal_factor(1.005)
    fix = found_in(drawn_sky(ORION, longer))
    assert fix.focal_scale == pytest.approx(1.005, abs=3e-4)
    assert np.abs(errors_arcsec(fix.camera_from_sky, ORION))[:2].max() < 10.0


@pytest.mark.parametrize("name", ["unk", "kam_s", "shnk"])
def test_random_pointings_with_false_spots_are_found_and_none_wrong(name):
    camera, rng = preset_camera(name), np.random.default_rng(11)
    identifier, solved = StarIdentifier(camera, load_bright_stars().propagate(None)), 0
    for _ in range(12):
        turn = Rotation.random(random_state=rng)
        fix = identifier.identify(spots_of(turn, camera, rng, 5.0, 4))
        solved += 1
        off = np.linalg.norm(errors_arcsec(fix.camera_from_sky, turn)) * ARCSEC
        assert off * camera.focal_length_px < 3.0
    assert solved == 12


def test_random_spots_are_never_a_sky():
    camera, rng = preset_camera("kam_s"), np.random.default_rng(5)
    identifier = StarIdentifier(camera, load_bright_stars().propagate(None))
    for count in rng.integers(5, 40, 4):
        places = rng.uniform(0.0, 2047.0, (count, 2))
        spots = StarSpots(places, np.ones(count), np.full(count, 0.1), 0, 0, 0.0)
        with pytest.raises(NoSolutionError, match="no stars of the catalog"):
            identifier.identify(spots)


def refusal(picture) -> NoSolutionError:
    with pytest.raises(NoSolutionError) as caught:
        found_in(picture)
    return caught.value


def test_a_mirrored_picture_is_said_to_be_mirrored():
    error = refusal(np.ascontiguousarray(drawn_sky(ORION)[:, ::-1]))
    assert error.code == ReasonCode.MIRRORED


@pytest.mark.parametrize("factor", [0.935, 1.1])
def test_a_focal_length_wrong_by_up_to_ten_per_cent_is_named(factor):
    error = refusal(drawn_sky(ORION, CAMERA.with_focal_factor(factor)))
    assert error.code == ReasonCode.WRONG_LENS
    assert describe_length(factor - 1.0) in str(error)


def test_trailed_stars_are_named():
    error = refusal(drawn_sky(ORION, trail_px=14.0))
    assert "trailed" in str(error)
    assert "fewer than the 4" not in str(error)


def test_hot_pixels_alone_are_no_stars():
    rng = np.random.default_rng(2)
    picture = rng.normal(100.0, 4.0, CAMERA.shape).astype(np.float32)
    picture[rng.integers(10, 500, 40), rng.integers(10, 500, 40)] = 9000.0
    error = refusal(picture)
    assert error.code == ReasonCode.FEW_STARS
    assert "hot pixels" in str(error)


@pytest.mark.parametrize("value", [0.0, 65535.0])
def test_black_and_saturated_pictures_have_too_few_stars(value):
    error = refusal(np.full(CAMERA.shape, value, np.float32))
    assert error.code == ReasonCode.FEW_STARS


def test_three_stars_are_too_few():
    picture = drawn_sky(turned(193.0, 27.0, 0.0), faintest=4.4)
    assert refusal(picture).code in (ReasonCode.FEW_STARS, ReasonCode.NO_STARS)


def test_without_aberration_the_attitude_is_twenty_arc_seconds_off():
    picture = drawn_sky(ORION)
    plain = StarIdentifier(CAMERA, load_bright_stars().propagate(utc_to_tdb_s(UTC)))
    wrong = plain.identify(find_spots(picture)).camera_from_sky
    right = found_in(picture).camera_from_sky
    assert 10.0 < np.linalg.norm(errors_arcsec(wrong, right)) < 25.0


def test_beside_the_lit_moon_stars_without_aberration_turn_the_moon_by_twenty_arc_seconds():
    """From 10 000 km that is a kilometre across the line of sight."""
    picture, moon = add_body(drawn_sky(ORION)), load_body("moon")
    seen = find_star_attitude(picture, None, CAMERA, SkyView(moon, utc_to_tdb_s(UTC)))
    plain = StarIdentifier(CAMERA, load_bright_stars().propagate(utc_to_tdb_s(UTC)))
    wrong = plain.identify(find_spots(picture)).camera_from_sky
    ground = (0.0, 0.0, 1.0)  # of a sight along the boresight, inertial axes
    right = ORION.inv().apply(ground)

    def off_arcsec(found: Rotation) -> float:
        return float(np.linalg.norm(found.inv().apply(ground) - right)) / ARCSEC

    # of the Moon's motion about the Sun, and not of the Earth's, with which the sky is drawn: 0.7"
    assert off_arcsec(seen.camera_from_inertial) < 3.0 * seen.sigma_rad / ARCSEC
    assert off_arcsec(seen.camera_from_inertial) < 6.0
    assert 14.0 < off_arcsec(wrong) < 25.0


def test_a_sight_says_its_sigma_and_a_time_not_known_widens_it():
    picture, body = drawn_sky(ORION), load_body("earth")
    known = find_star_attitude(picture, None, CAMERA, SkyView(body, utc_to_tdb_s(UTC)))
    unknown = find_star_attitude(picture, None, CAMERA, SkyView(body, None))
    assert np.abs(errors_arcsec(known.camera_from_inertial, ORION)[:2]).max() < 12.0
    assert 1.0 < known.sigma_rad / ARCSEC < 6.0
    assert 10.0 < unknown.sigma_rad / ARCSEC < 20.0


def test_proper_motion_is_the_catalogues():
    """Rigil Kentaurus moves by 3.71" a year: Hipparcos 71683."""
    stars = load_bright_stars()
    number = stars.names.index("Rigil Kentaurus")
    moved = stars.propagate(utc_to_tdb_s("2016-04-01T00:00:00Z"))[number]
    angle = np.arccos(moved @ stars.directions[number]) / ARCSEC
    assert angle / 25.0 == pytest.approx(3.71, abs=0.02)
    assert replace(stars, names=("",) * len(stars.names)).label(number) == "HIP 71683"


@pytest.mark.skipif(not REAL.is_file(), reason="OPTNAV_SHARED_DATA has no stars/star_field.tiff")
def test_a_real_frame_is_solved_to_four_arc_seconds():
    focal = 512.0 / np.tan(np.radians(11.4 / 2.0))
    camera = Camera("esa", "pinhole", 1024, 768, focal, (511.5, 383.5))
    picture = load_picture(REAL, camera)
    fix = StarIdentifier(camera, load_bright_stars().propagate(None)).identify(
        find_spots(picture.values)
    )
    assert fix.used.sum() >= 20
    assert fix.residual_rms_px / focal / ARCSEC < 4.0
    assert np.sqrt(np.diag(fix.covariance))[:2].max() / ARCSEC < 3.0
    axis = fix.camera_from_sky.inv().apply((0.0, 0.0, 1.0))
    assert np.degrees(np.arcsin(axis[2])) == pytest.approx(64.225, abs=0.01)


def test_sunlit_peaks_beyond_a_terminator_are_no_stars():
    """Half a disc, and bright specks on its night side: brighter than all stars."""
    picture = drawn_sky(turned(84.0, -1.0, 20.0))
    rows, cols = np.mgrid[: picture.shape[0], : picture.shape[1]]
    disc = np.hypot(cols - 150, rows - 330) < 90
    picture[disc & (cols < 150)] = 60_000.0
    plain = len(find_spots(picture, 65535.0))
    for number, row in enumerate(range(260, 400, 12)):
        x, y = 160 + 7 * (number % 4), row
        square = (cols - x) ** 2 + (rows - y) ** 2
        picture += (9000.0 * np.exp(-0.5 * square)).astype(np.float32)
    spots = find_spots(picture, 65535.0)
    assert len(spots) == plain
    assert (np.hypot(spots.pixels[:, 0] - 150, spots.pixels[:, 1] - 330) > 90).all()


def whole_sky(count: int, faintest: float):
    """Stars as Gaia counts them, evenly over the sky: each magnitude has 2.5 times as many."""
    rng = np.random.default_rng(17)
    places = [rng.uniform(0.0, 360.0, count), np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, count)))]
    magnitudes = np.sort(faintest + 2.5 * np.log10(rng.uniform(1e-4, 1.0, count)))
    motions = rng.normal(0.0, 20.0, (count, 2))
    return make_stars(np.stack(places, 1), motions, magnitudes, 2016.0, ("",) * count)


NARROW = Camera("narrow", "pinhole", 1024, 1024, 512.0 / np.tan(np.radians(1.0)), (511.5, 511.5))


@pytest.fixture(scope="module")
def deep():
    """120,000 stars to magnitude 9, for a field of 2 deg."""
    stars = whole_sky(120_000, 9.0)
    return StarIdentifier(NARROW, stars.propagate(None), stars)


def deep_spots(deep: StarIdentifier, turn: Rotation, rng, false: int) -> StarSpots:
    """Nine in ten of the stars in view, 0.15 px off, and false spots; the lens is 0.3 % off."""
    sky = turn.apply(deep.directions)
    near = np.flatnonzero(sky[:, 2] > 0.99)
    pixels = NARROW.project(sky[near])
    seen = NARROW.contains(pixels) & (rng.random(len(near)) > 0.1)
    middle = np.array(NARROW.principal_point_px)
    places = middle + (1.0 + rng.normal(0.0, 0.003)) * (pixels[seen] - middle)
    places = np.vstack([places, rng.uniform(0.0, 1023.0, (false, 2))])
    places += rng.normal(0.0, 0.15, places.shape)
    light = np.append(deep.catalog.magnitudes[near[seen]], rng.uniform(6.0, 9.0, false))
    order = np.argsort(light + rng.normal(0.0, 0.2, len(light)))
    return StarSpots(places[order], -light[order], np.full(len(order), 0.15), 0, 0, 0.0)


def test_fields_of_2_deg_are_identified_with_a_catalogue_to_magnitude_9(deep):
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        high = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0)))
        turn = turned(rng.uniform(0.0, 360.0), high, rng.uniform(-180.0, 180.0))
        spots = deep_spots(deep, turn, rng, 3)
        fix = deep.attempt(spots)
        if len(spots) < 3 + 6:
            continue  # a gap of the sky: five stars of it could be chance
        assert fix is not None
        off = (fix.camera_from_sky * turn.inv()).as_rotvec()
        squares.append(off @ np.linalg.solve(fix.covariance, off))
        assert np.linalg.norm(off[:2]) < 5.0 * ARCSEC
    assert len(squares) >= 6
    assert max(squares) < 20.0


def test_a_wrong_sky_gives_no_attitude_with_a_catalogue_of_120000_stars(deep):
    for seed in range(3):
        rng = np.random.default_rng(1000 + seed)
        count = int(rng.integers(6, 40))
        light = np.sort(rng.random(count))[::-1]
        places = rng.uniform(5.0, 1018.0, (count, 2))
        spots = StarSpots(places, light, np.full(count, 0.15), 0, 0, 0.0)
        assert deep.attempt(spots) is None
