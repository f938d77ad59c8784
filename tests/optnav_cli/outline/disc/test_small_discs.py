"""Discs that a known blur tells from stars, and discs of a short limb fitted whole."""

from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.errors import NoSolutionError
from optnav_cli.frames.picture import Picture
from optnav_cli.outline import method as outline
from tests.optnav_cli.outline.disc.drawn_discs import (
    FINE,
    blurred_disc,
    expose,
    far_camera,
    placed,
)

BODY = load_body("moon")
STILL = Rotation.identity()
PSF = 0.7


def calibrated(size_px, psf=PSF):
    return replace(far_camera(size_px), psf_sigma_px=psf, psf_error_px=0.05)


def drawn(camera, radius_px, phase_deg, rng, psf=PSF):
    centre, sun = placed(camera, radius_px, phase_deg, rng)
    counts = expose(blurred_disc(camera, centre, sun, "hapke", psf), 50.0, rng)
    return Picture(counts, 255.0), centre, sun


def star(size_px, psf, rng, peak):
    fine = np.zeros((FINE * size_px, FINE * size_px))
    x, y = rng.integers(FINE * (size_px // 2 - 3), FINE * (size_px // 2 + 3), 2)
    fine[y, x] = 1.0
    light = cv2.resize(cv2.GaussianBlur(fine, (0, 0), psf * FINE), (size_px, size_px),
                       interpolation=cv2.INTER_AREA)  # fmt: skip
    counts = rng.poisson(20.0 * peak * light / light.max()) / 20.0
    counts += rng.normal(2.5, 0.6, counts.shape)
    return Picture(np.clip(np.rint(counts), 0, 255).astype(np.float32), 255.0)


def reason_without_blur(picture, sun):
    try:
        outline.navigate(picture, far_camera(44), STILL, 0.0, sun, BODY, None)
    except NoSolutionError as error:
        return str(error)
    return ""


def test_a_known_blur_tells_discs_of_2_7_px_from_stars():
    camera, rng = calibrated(44), np.random.default_rng(21)
    normalised = []
    unknown = 0
    for _ in range(12):
        picture, centre, sun = drawn(camera, 1.35, rng.uniform(20.0, 70.0), rng)
        with suppress(NoSolutionError):
            fix = outline.navigate(picture, camera, STILL, 0.0, sun, BODY, None)
            error = fix.position_m + centre
            normalised.append(error @ np.linalg.solve(fix.covariance_m2, error) / 3.0)
            assert fix.method == "brightness_centre"
        unknown += "psf_sigma_px" in reason_without_blur(picture, sun)
    assert len(normalised) >= 8
    assert unknown >= 10
    assert 0.2 < np.mean(normalised) < 2.0


@pytest.mark.parametrize("peak", [60.0, 200.0, 700.0, 2000.0])
def test_a_star_is_no_disc_even_where_it_is_burnt_out(peak):
    rng = np.random.default_rng(int(peak))
    sun = np.array([0.6, 0.0, -0.8])
    for psf in (0.5, 0.7, 1.0):
        camera = calibrated(44, psf)
        with pytest.raises(NoSolutionError, match=r"a star|saturated"):
            outline.navigate(star(44, psf, rng, peak), camera, STILL, 0.0, sun, BODY, None)


@pytest.mark.parametrize("phase_deg", [15.0, 60.0, 105.0])
def test_a_disc_of_twenty_pixels_is_right_to_some_hundredths_of_one(phase_deg):
    """Its limb's profiles leave 0.1 px at 60 deg and half a pixel and more at 105."""
    camera, rng = calibrated(64, 1.0), np.random.default_rng(4)
    picture, centre, sun = drawn(camera, 10.0, phase_deg, rng, 1.0)
    fix = outline.navigate(picture, camera, STILL, 0.0, sun, BODY, None)
    missed = camera.project(-fix.position_m) - camera.project(centre)
    assert "fitted whole" in fix.reason.text
    assert np.linalg.norm(missed) < 0.06
    ratio = np.linalg.norm(fix.position_m) / np.linalg.norm(centre)
    assert abs(ratio - 1.0) * 10.0 < 0.08
    error = fix.position_m + centre
    assert error @ np.linalg.solve(fix.covariance_m2, error) < 14.2  # 99.7 % of three


def test_the_light_on_a_small_disc_betrays_a_sun_turned_about_the_line_of_sight():
    camera, rng = calibrated(64), np.random.default_rng(6)
    picture, centre, sun = drawn(camera, 12.0, 35.0, rng)
    turned = Rotation.from_rotvec(0.8 * centre / np.linalg.norm(centre)).apply(sun)
    with pytest.raises(NoSolutionError, match="Sun"):
        outline.navigate(picture, camera, STILL, 0.0, turned, BODY, None)
