"""Positions from discs of half a pixel to six, drawn with a law and a blur that are not told."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.errors import NoSolutionError
from optnav_cli.frames.picture import Picture
from optnav_cli.outline.disc.brightness_centre import navigate
from optnav_cli.outline.disc.moments import compute_sphere_moments, load_disc_sizes
from optnav_cli.outline.neighbour import CameraView
from tests.optnav_cli.outline.disc.drawn_discs import blurred_disc, expose, far_camera, placed

BODY = load_body("moon")
CAMERA = far_camera(44)


def drawn(rng, radius_px, phase_deg, blur_px, snr=50.0):
    centre, sun = placed(CAMERA, radius_px, phase_deg, rng)
    light = blurred_disc(CAMERA, centre, sun, "hapke", blur_px)
    return expose(light, snr, rng), centre, sun


def centre_fix(picture, camera, turn, sigma_rad, sun_body, saturation=None):
    view = CameraView(camera, turn, sigma_rad, sun_body)
    return navigate(Picture(picture, saturation), view, BODY)


def centre_px(fix):
    return fix.evidence.outline.points_px[0]


def test_positions_of_150_discs_are_as_good_as_they_say():
    """The drawn spheres' centres lie off the centre of mass as the Moon's figure does."""
    rng = np.random.default_rng(11)
    normalised, missed, shares = [], [], []
    for _ in range(150):
        radius = rng.uniform(0.5, 6.0)
        picture, centre, sun = drawn(rng, radius, rng.uniform(0.0, 120.0), rng.uniform(0.5, 1.1))
        turn = Rotation.random(random_state=rng)
        fix, _ = centre_fix(picture, CAMERA, turn, 0.0, turn.inv().apply(sun), saturation=255.0)
        mass = centre + rng.normal(0.0, load_disc_sizes().figure * BODY.radius_m, 3)
        error = fix.position_m + turn.inv().apply(mass)
        normalised.append(error @ np.linalg.solve(fix.covariance_m2, error) / 3.0)
        missed.append(np.linalg.norm(centre_px(fix) - CAMERA.project(centre)))
        position = fix.position_m
        share = np.sqrt(position @ fix.covariance_m2 @ position) / (position @ position)
        shares.append((radius, share))
    assert 0.7 < np.mean(normalised) < 1.4
    assert np.median(missed) < 0.06
    radii, sigmas = np.array(shares).T
    assert np.median(sigmas[radii > 4.0]) < 0.06
    assert np.median(sigmas[radii < 1.5]) > 0.2


def test_the_correction_depends_on_the_phase_and_hardly_on_the_law():
    for phase_deg in (20.0, 50.0, 80.0, 110.0):
        offsets = [moments.offset[0] for moments in compute_sphere_moments(np.radians(phase_deg))]
        assert min(offsets) > 0.11
        assert max(offsets) - min(offsets) < 0.035
    # a full Lambert sphere is bright as mu: r^2 mu over the disc has a mean of 2/5, an axis half
    lambert = compute_sphere_moments(0.0)[2]
    assert lambert.offset == pytest.approx(0.0, abs=1e-9)
    assert np.diag(lambert.second) == pytest.approx(0.2, abs=2e-3)
    # Lommel-Seeliger is even at full phase: a uniform disc has r^2 / 4
    assert compute_sphere_moments(0.0)[1].second[0, 0] == pytest.approx(0.25, abs=2e-3)


def test_an_attitude_error_widens_the_position_across_the_line_of_sight():
    picture, centre, sun = drawn(np.random.default_rng(4), 4.0, 40.0, 0.8)
    still = Rotation.identity()
    exact, _ = centre_fix(picture, CAMERA, still, 0.0, sun)
    loose, _ = centre_fix(picture, CAMERA, still, 1e-3, sun)
    distance = np.linalg.norm(exact.position_m)
    grown = loose.covariance_m2 - exact.covariance_m2
    across = np.cross(centre / np.linalg.norm(centre), [1.0, 0.0, 0.0])
    assert across @ grown @ across == pytest.approx((1e-3 * distance) ** 2, rel=0.01)
    assert exact.position_m @ grown @ exact.position_m < 1e-6 * (1e-3 * distance**2) ** 2


def test_what_is_no_single_small_disc_is_told():
    rng = np.random.default_rng(3)
    picture, _, sun = drawn(rng, 3.0, 40.0, 0.8)
    still = Rotation.identity()
    with pytest.raises(NoSolutionError, match="which is the body"):
        centre_fix(np.hstack([picture, picture]), far_camera(88), still, 0.0, sun)
    empty = np.clip(np.rint(rng.normal(3.0, 0.8, picture.shape)), 0, 255).astype(np.float32)
    with pytest.raises(NoSolutionError, match="no body"):
        centre_fix(empty, CAMERA, still, 0.0, sun)
    with pytest.raises(NoSolutionError, match="frame cuts"):
        centre_fix(np.roll(picture, 21, axis=0), CAMERA, still, 0.0, sun)
    full = np.minimum((picture - 3.0) * 20.0 + 3.0, 255.0).astype(np.float32)
    with pytest.raises(NoSolutionError, match="saturated"):
        centre_fix(full, CAMERA, still, 0.0, sun, saturation=255.0)
    with pytest.raises(NoSolutionError, match="the phase is 1"):
        centre_fix(picture, CAMERA, still, 0.0, np.array([0.0, 0.05, 1.0]) / 1.00125)


def test_stars_and_hot_pixels_beside_the_disc_do_not_move_it():
    rng = np.random.default_rng(8)
    picture, centre, sun = drawn(rng, 4.0, 60.0, 0.8)
    star = np.zeros_like(picture)
    star[4, 5] = 500.0
    spoilt = picture + cv2.GaussianBlur(star, (0, 0), 0.9)
    spoilt[30, 30] = 250.0
    clean, _ = centre_fix(picture, CAMERA, Rotation.identity(), 0.0, sun)
    fix, _ = centre_fix(spoilt, CAMERA, Rotation.identity(), 0.0, sun)
    assert np.linalg.norm(centre_px(fix) - centre_px(clean)) < 0.02
    assert np.linalg.norm(centre_px(fix) - CAMERA.project(centre)) < 0.15
