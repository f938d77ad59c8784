"""The limb in pictures of drawn discs, whose true edge is known to the last digit."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.frames.segmentation import measure_levels
from optnav_cli.outline.limb.detection import find_limb
from optnav_cli.outline.one_body import describe_wrong_sun, measure_sun_side
from tests.optnav_cli.conftest import pixel_grid
from tests.optnav_cli.outline.disc.drawn_discs import (
    RADIUS_M,
    blurred_disc,
    disc_distance,
    expose,
    far_camera,
    sun_at_phase,
)


def scene(radius_px, phase_deg, law="hapke", blur_px=0.8, seed=0, size_px=None, middle=None):
    """A camera, the body's centre, the Sun and the mean light of a disc near the middle."""
    rng = np.random.default_rng(seed)
    camera = far_camera(size_px or int(2 * radius_px + 60))
    shift = rng.uniform(-0.5, 0.5, 2) if middle is None else np.array(middle)
    axis = np.append(shift / camera.focal_length_px, 1.0)
    centre = disc_distance(camera, radius_px) * axis / np.linalg.norm(axis)
    sun = sun_at_phase(centre, phase_deg, rng.uniform(0.0, 360.0))
    return camera, centre, sun, blurred_disc(camera, centre, sun, law, blur_px), rng


def outward_px(camera, centre, limb):
    """How far points lie outside the true limb, px."""
    rays = camera.unproject(limb.pixels)
    distance = np.linalg.norm(centre)
    axis = centre / distance
    off = np.arctan2(np.linalg.norm(np.cross(rays, axis), axis=1), rays @ axis)
    return (np.tan(off) - np.tan(np.arcsin(RADIUS_M / distance))) * camera.focal_length_px


@pytest.mark.parametrize(
    ("radius_px", "phase_deg", "law", "blur_px"),
    [
        (40, 60, "lommel_seeliger", 1.0),
        (40, 60, "hapke", 0.5),
        (100, 20, "hapke", 0.8),
        (100, 110, "hapke", 0.8),
        (100, 60, "lommel_seeliger", 1.2),
    ],
)
def test_edges_are_unbiased_and_their_sigmas_honest(radius_px, phase_deg, law, blur_px):
    """A plain step would be off by 0.1 px and more; 0.02 px is 0.03 % of range at 40 000 km."""
    camera, centre, sun, light, rng = scene(radius_px, phase_deg, law, blur_px)
    limb = find_limb(expose(light, 50.0, rng), camera, sun, saturation=255.0)
    outward = outward_px(camera, centre, limb)
    weight = limb.sigma_px**-2
    assert abs(weight @ outward / weight.sum()) < 0.02
    assert 0.5 < np.mean(((outward - outward.mean()) / limb.sigma_px) ** 2) < 2.0
    assert limb.blur_px == pytest.approx(np.hypot(blur_px, 12**-0.5), abs=0.04)
    assert len(limb) > 2.0 * radius_px
    assert not limb.cut_by_frame


def test_a_small_disc_has_edges_within_their_stated_common_error():
    """Eight pixels of radius: blur and law cannot be told apart well, and the sigma says so."""
    shares = []
    for seed in range(6):
        camera, centre, sun, light, rng = scene(8, 50, seed=seed)
        limb = find_limb(expose(light, 50.0, rng), camera, sun, saturation=255.0)
        outward = outward_px(camera, centre, limb)
        shares.append(outward.mean() / limb.common_sigma_px)
    assert np.sqrt(np.mean(np.square(shares))) < 2.0
    assert np.max(np.abs(outward)) < 0.5


def test_the_normals_point_at_the_body_and_the_cone_is_the_true_one():
    camera, centre, sun, light, rng = scene(40, 40)
    limb = find_limb(expose(light, 50.0, rng), camera, sun)
    towards = camera.project(centre) - limb.pixels
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    assert ((towards * limb.inward).sum(axis=1) > 0.999).all()
    away = np.arccos(limb.cone_axis_camera @ centre / np.linalg.norm(centre))
    assert away * camera.focal_length_px < 0.1
    angle = np.arcsin(RADIUS_M / np.linalg.norm(centre))
    assert limb.cone_angle == pytest.approx(angle, rel=0.003)


def test_rods_stars_and_hot_pixels_do_not_move_the_limb():
    camera, centre, sun, light, rng = scene(60, 70)
    picture = expose(light, 50.0, rng)
    cv2.line(picture, (0, 40), (179, 70), 150.0, 5)
    cv2.line(picture, (60, 0), (20, 179), 0.0, 5)
    for x, y in rng.integers(2, 178, (25, 2)):
        picture[y, x] = 200.0
    limb = find_limb(picture, camera, sun, saturation=255.0)
    outward = outward_px(camera, centre, limb)
    assert abs(np.median(outward)) < 0.03
    assert np.mean(np.abs(outward) < 0.3) > 0.9


def test_a_fisheye_s_limb_beyond_its_axis_is_a_cone():
    """An even disc, 60 deg of half angle and 25 deg off the axis, in an equidistant lens."""
    camera = Camera("wide", "equidistant", 400, 400, 120.0, (199.5, 199.5))
    axis = np.array([np.sin(0.43), 0.1, np.cos(0.43)])
    axis /= np.linalg.norm(axis)
    fine = (np.arange(1600) + 0.5) / 4 - 0.5
    rays = camera.unproject(np.stack(np.meshgrid(fine, fine), axis=-1))
    body = (rays @ axis > np.cos(np.radians(60.0))).astype(np.float32) * 180.0
    picture = cv2.resize(cv2.GaussianBlur(body, (0, 0), 3.2), (400, 400), None, 0, 0, 3)
    limb = find_limb(picture + 3.0, camera, None)
    assert limb.arc_deg > 330.0
    assert np.degrees(limb.cone_angle) == pytest.approx(60.0, abs=0.02)
    assert np.degrees(np.arccos(min(limb.cone_axis_camera @ axis, 1.0))) < 0.02


@pytest.mark.parametrize("softness_px", [0.6, 0.8])
def test_an_even_disc_under_a_high_sun_has_a_limb(softness_px):
    """No mixture of brightness laws is even up to such an edge; some of them turn it dark."""
    camera = Camera("wide", "equidistant", 400, 400, 120.0, (199.5, 199.5))
    axis = np.array([0.02, 0.01, 1.0])
    axis /= np.linalg.norm(axis)
    off_axis = np.arccos(camera.unproject(pixel_grid(camera)) @ axis)
    depth_px = (np.radians(66.0) - off_axis) * camera.focal_length_px
    light = 200.0 / (1.0 + np.exp(-np.clip(depth_px / softness_px, -50.0, 50.0)))
    noise = np.random.default_rng(1).normal(3.0, 1.5, light.shape)
    picture = np.clip(np.rint(light + noise), 0, 255).astype(np.float32)
    limb = find_limb(picture, camera, -axis, saturation=255.0)
    found = np.arccos(camera.unproject(limb.pixels) @ axis)
    assert abs(found.mean() - np.radians(66.0)) * camera.focal_length_px < 0.3
    assert limb.arc_deg > 330.0


def stars(size_px, rng):
    picture = np.zeros((size_px, size_px))
    for x, y in rng.integers(5, size_px - 5, (40, 2)):
        picture[y, x] = rng.uniform(200.0, 3000.0)
    return cv2.GaussianBlur(picture, (0, 0), 0.9)


def counts(picture, rng):
    return np.clip(np.rint(picture + rng.normal(3.0, 0.8, picture.shape)), 0, 255).astype(
        np.float32
    )


def test_a_picture_without_a_limb_says_why():
    rng = np.random.default_rng(1)
    camera, _, sun, light, _ = scene(60, 70, size_px=340)
    grown = light / np.quantile(light[light > 0], 0.95) * 180.0
    with pytest.raises(NoSolutionError, match="no body in the picture"):
        find_limb(counts(np.zeros((340, 340)), rng), camera, sun)
    with pytest.raises(NoSolutionError, match="stars or a disc too small"):
        find_limb(counts(stars(340, rng), rng), camera, sun)
    ground = cv2.GaussianBlur(rng.normal(120.0, 200.0, (340, 340)), (0, 0), 3.0)
    with pytest.raises(NoSolutionError, match="body fills the picture"):
        find_limb(counts(np.maximum(ground, 40.0), rng), camera, sun)
    with pytest.raises(NoSolutionError, match="saturated"):
        find_limb(counts(grown * 40.0, rng), camera, sun, saturation=255.0)
    two = grown + np.roll(grown, (95, 95), axis=(0, 1))
    with pytest.raises(NoSolutionError, match="two bodies"):
        find_limb(counts(two, rng), camera, sun)


def test_the_terminator_alone_is_no_limb():
    """A half disc whose lit limb lies outside the picture."""
    rng = np.random.default_rng(2)
    camera, centre, _, _, _ = scene(150, 90, size_px=200, middle=(40.0, 0.0))
    sun = np.array([centre[2], 0.0, -centre[0]]) / np.linalg.norm(centre)
    light = blurred_disc(camera, centre, sun, "hapke", 0.8)
    assert light[:, -40:].mean() > 100.0 * light[:, :40].mean()
    with pytest.raises(NoSolutionError, match=r"no lit limb|no limb|lit limb in view"):
        find_limb(counts(light / light.max() * 180.0, rng), camera, sun)


def test_structure_over_half_of_the_limb_is_told():
    camera, _, sun, light, rng = scene(60, 70)
    picture = expose(light, 50.0, rng)
    limb = find_limb(picture, camera, sun)
    middle = limb.pixels.mean(axis=0)
    across = np.array([-limb.inward.mean(axis=0)[1], limb.inward.mean(axis=0)[0]])
    side = (pixel_grid(camera) - middle) @ across > 0.0
    picture[side] = 3.0
    with pytest.raises(NoSolutionError, match="covers the rest"):
        find_limb(picture, camera, sun)


@pytest.mark.parametrize("phase_deg", [30, 70, 110])
def test_the_lit_side_tells_where_the_sun_is_not(phase_deg):
    camera, centre, sun, light, rng = scene(60, phase_deg)
    limb = find_limb(expose(light, 50.0, rng), camera, None)
    rays = camera.unproject(limb.pixels)
    assert describe_wrong_sun(limb, camera, sun) == ""
    for turn in (-40.0, 90.0, 180.0):
        other = Rotation.from_rotvec(np.radians(turn) * centre / np.linalg.norm(centre)).apply(sun)
        side = measure_sun_side(limb, rays, other)
        assert side.angle == pytest.approx(np.radians(abs(turn)), abs=side.sigma)
        assert "from where attitude and time put the Sun" in describe_wrong_sun(limb, camera, other)
    # with the Sun behind the camera no side is the lit one, but then all of the disc is lit
    back = -centre / np.linalg.norm(centre)
    doubt = describe_wrong_sun(limb, camera, back)
    assert ("of the disc is lit, and 100 % should be" in doubt) == (phase_deg > 45)


def test_the_wrong_sun_gives_no_limb():
    camera, centre, sun, light, rng = scene(60, 70)
    half = Rotation.from_rotvec(np.pi * centre / np.linalg.norm(centre))
    with pytest.raises(NoSolutionError, match="no lit limb where the Sun claims it"):
        find_limb(expose(light, 50.0, rng), camera, half.apply(sun))


def holes(picture, centre_px):
    """Where margins, lost lines and a block across the limb have no value."""
    gap = np.zeros(picture.shape, bool)
    gap[:, :25], gap[140:148] = True, True
    x, y = np.rint(centre_px).astype(int)
    gap[y - 120 : y - 80, x - 12 : x + 13] = True
    return gap


def test_pixels_without_a_value_are_neither_sky_nor_ground():
    """The limb is as good about gaps as without them; none of its points stands at a gap."""
    camera, centre, sun, light, rng = scene(100, 60)
    picture = expose(light, 50.0, rng) + np.float32(40.0)
    gap = holes(picture, camera.project(centre))
    whole = measure_levels(picture)
    picture[gap] = np.nan
    limb = find_limb(picture, camera, sun, saturation=290.0)
    outward = outward_px(camera, centre, limb)
    weight = limb.sigma_px**-2
    assert abs(weight @ outward / weight.sum()) < 0.02
    assert 0.5 < np.mean(((outward - outward.mean()) / limb.sigma_px) ** 2) < 2.0
    assert limb.cut_by_frame
    at = np.rint(limb.pixels).astype(int)
    assert not gap[at[:, 1], at[:, 0]].any()
    assert measure_levels(picture).sky == pytest.approx(whole.sky, abs=0.3)
    assert measure_levels(picture).noise == pytest.approx(whole.noise, rel=0.1)


def test_a_third_of_the_lit_pixels_at_full_scale_is_refused_with_share_and_scale():
    camera, _, sun, light, rng = scene(100, 40)
    picture = expose(light, 50.0, rng)
    lit = picture[picture > 30.0]
    full = float(np.quantile(lit, 0.55))
    with pytest.raises(NoSolutionError, match=rf"saturated: 4\d % .* {full:g} counts") as caught:
        find_limb(np.minimum(picture, full), camera, sun, saturation=full)
    assert caught.value.code == "saturated"


def with_plume(light, camera, centre, sun):
    """The light with a fan beyond the middle of the lit limb, a quarter as bright, and haze."""
    pixel = pixel_grid(camera)
    middle = camera.project(centre)
    towards = np.array(sun[:2]) / np.hypot(*sun[:2])
    away = pixel - middle
    radius = np.linalg.norm(away, axis=-1)
    aside = np.degrees(np.arccos(np.clip(away @ towards / np.maximum(radius, 1e-9), -1.0, 1.0)))
    limb = camera.focal_length_px * np.tan(np.arcsin(RADIUS_M / np.linalg.norm(centre)))
    beyond = np.maximum(radius - limb, 0.0)
    fan = 0.2 * np.exp(-0.5 * (aside / 20.0) ** 2 - beyond / 30.0) * (radius > limb)
    return light + np.median(light[light > 0.2 * light.max()]) * (fan + 0.03)


def test_plumes_beyond_a_crescent_are_no_ground():
    camera, centre, sun, light, rng = scene(120, 140, size_px=500)
    limb = find_limb(expose(with_plume(light, camera, centre, sun), 50.0, rng), camera, sun)
    outward = outward_px(camera, centre, limb)
    assert limb.arc_deg > 80.0
    assert abs(np.median(outward)) < 3.0 * limb.common_sigma_px


@pytest.mark.parametrize("phase_deg", [30, 60, 110])
def test_a_wide_halo_does_not_hide_the_limb(phase_deg):
    """A quarter of the light lies in a halo of 15 px: above the first threshold as far as 20 px."""
    camera, centre, sun, light, rng = scene(100, phase_deg)
    scattered = 0.75 * light + 0.25 * cv2.GaussianBlur(light, (0, 0), 15.0)
    limb = find_limb(expose(scattered, 50.0, rng), camera, sun)
    outward = outward_px(camera, centre, limb)
    assert abs(np.median(outward)) < 3.0 * limb.common_sigma_px


def test_burnt_in_text_is_not_joined_to_the_limb():
    camera, centre, sun, light, rng = scene(60, 70, size_px=420)
    writing = np.zeros(light.shape, np.uint8)
    for line in range(3):
        for left in (5, 275):
            place, font = (left, 20 + 25 * line), cv2.FONT_HERSHEY_SIMPLEX
            cv2.putText(writing, "2008-05-11 16:20", place, font, 0.5, 255.0, 2)
    picture = np.maximum(expose(light, 50.0, rng), writing).astype(np.float32)
    limb = find_limb(picture, camera, sun)
    assert abs(np.median(outward_px(camera, centre, limb))) < 3.0 * limb.common_sigma_px


def test_structure_beyond_the_limb_is_no_stray_light():
    """Lit ground all round a dark disc has edges of its own."""
    rng = np.random.default_rng(5)
    camera, _, sun, light, _ = scene(60, 60, size_px=300)
    ground = cv2.GaussianBlur(rng.normal(size=light.shape), (0, 0), 4.0)
    ground = np.clip(60.0 + 40.0 * ground / ground.std(), 0.0, 255.0)
    picture = np.maximum(ground, 150.0 * light / light.max()).astype(np.float32)
    with pytest.raises(NoSolutionError):
        find_limb(picture, camera, sun)


@pytest.mark.parametrize(("radius_px", "phase_deg"), [(60, 30), (100, 60), (100, 110)])
@pytest.mark.parametrize("power", [1.0, 0.7, 0.5])
def test_a_limb_shows_that_counts_are_not_linear(radius_px, phase_deg, power):
    """As they stand, counts under a square root put the limb 0.36 px out, 20 stated sigmas."""
    camera, centre, sun, light, rng = scene(radius_px, phase_deg)
    linear = expose(light, 50.0, rng) + np.float32(8.0)
    coded = np.rint(255.0 * np.clip(linear / 255.0, 0.0, 1.0) ** power).astype(np.float32)
    limb = find_limb(coded, camera, sun)
    assert (limb.exponent == 1.0) == (power == 1.0)
    assert limb.exponent == pytest.approx(1.0 / power, rel=0.16)
    outward = outward_px(camera, centre, limb)
    weight = limb.sigma_px**-2
    assert abs(weight @ outward / weight.sum()) < 3.0 * limb.common_sigma_px


def test_a_halo_is_not_taken_for_a_coding():
    camera, _, sun, light, rng = scene(100, 60)
    scattered = 0.9 * light + 0.1 * cv2.GaussianBlur(light, (0, 0), 6.0)
    limb = find_limb(expose(scattered, 50.0, rng), camera, sun)
    assert limb.exponent == 1.0
