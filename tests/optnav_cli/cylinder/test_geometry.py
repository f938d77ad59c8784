"""A lit cylinder: its geometry, the printed formulas, and the fit against drawn pictures."""

import math

import cv2
import numpy as np
import pytest

from catalog.errors import NoSolutionError
from optnav_cli.camera.camera import Camera
from optnav_cli.cylinder.fit import HeightModel, ProfileModel, fit_cylinder
from optnav_cli.cylinder.geometry import (
    CylinderSize,
    IdealLens,
    compute_bearing,
    compute_half_width,
    compute_psi,
    compute_surface_distance,
    find_lit_edges,
    solve_printed_formulas,
)
from optnav_cli.cylinder.profile import measure_printed_extent, measure_profile
from optnav_cli.simulation.cylinder_scenario import CylinderSurface, draw_cylinder
from optnav_cli.simulation.sections import SensorSettings
from optnav_cli.simulation.sensor import expose

CAMERA = Camera("small", "pinhole", 320, 240, 907.5, (159.5, 119.5))
LENS = IdealLens(907.5, 907.5, 159.5, 119.5)
RADIUS, HEIGHT = 0.14, 0.15
SIZE = CylinderSize(RADIUS, HEIGHT)


def seen(distance: float, bearing: float, theta_deg: float, seed: int = 1) -> np.ndarray:
    """A picture of rough, glossy cloth under a wide source 5 degrees high: none is in the fit."""
    surface = CylinderSurface(
        reflectance="oren_nayar", gloss=0.15, gloss_power=15.0, ambient=0.03, background=0.0
    )
    place = distance, bearing, math.radians(theta_deg)
    light = draw_cylinder(CAMERA, (RADIUS, HEIGHT), place, surface)
    counts = expose(light, SensorSettings(0.8, 90.0), np.random.default_rng(seed))
    return counts.astype(np.float32)


def test_bearings_lead_back_to_places_of_the_surface() -> None:
    widest = 0.5 * math.pi - compute_half_width(RADIUS, 1.3)
    psi = np.linspace(-widest, widest, 21)[1:-1]
    assert compute_psi(compute_bearing(psi, RADIUS, 1.3), RADIUS, 1.3) == pytest.approx(
        psi, abs=1e-9
    )


def test_the_limb_is_a_tangent() -> None:
    limb = compute_half_width(RADIUS, 1.3)
    assert float(compute_bearing(0.5 * math.pi - limb, RADIUS, 1.3)) == pytest.approx(limb)


def test_the_printed_formula_gives_31_degrees_for_a_full_face() -> None:
    distance = 1.34
    left, right = find_lit_edges(0.0, RADIUS, distance)
    height = HEIGHT / (distance - RADIUS)
    d_m, theta = solve_printed_formulas(height, right - left, SIZE)
    assert d_m == pytest.approx(1.2)
    assert math.degrees(theta) == pytest.approx(31.4, abs=0.1)


@pytest.mark.parametrize(("theta", "printed"), [(30, 38.5), (60, 61.1), (90, 89.9), (120, 120.5)])
def test_the_printed_formula_gives_what_exact_widths_make_of_it(
    theta: float, printed: float
) -> None:
    left, right = find_lit_edges(math.radians(theta), RADIUS, 1.34)
    _, found = solve_printed_formulas(HEIGHT / 1.2, right - left, SIZE)
    assert math.degrees(found) == pytest.approx(printed, abs=0.1)


def test_the_printed_formula_says_where_it_has_no_angle() -> None:
    with pytest.raises(NoSolutionError, match="has no angle"):
        solve_printed_formulas(HEIGHT / 1.2, 0.5, SIZE)


@pytest.mark.parametrize(
    ("distance", "bearing", "theta"), [(1.34, 0.01, 2.0), (1.0, 0.0, -40.0), (1.8, -0.03, 75.0)]
)
def test_a_fit_finds_the_cylinder_within_its_errors(
    distance: float, bearing: float, theta: float
) -> None:
    fit = fit_cylinder(measure_profile(seen(distance, bearing, theta), 255.0), LENS, SIZE)
    sigma = np.sqrt(np.diag(fit.covariance))
    assert abs(fit.distance_m - distance) < min(2e-3, 4.0 * sigma[0] + 2e-4)
    assert abs(math.degrees(fit.theta) - theta) < 0.5
    assert abs(fit.theta - math.radians(theta)) < 4.0 * sigma[2]
    assert fit.bearing == pytest.approx(bearing, abs=5e-4)


def test_a_crescent_states_the_errors_of_grazing_light() -> None:
    fit = fit_cylinder(measure_profile(seen(1.3, 0.0, 138.0), 255.0), LENS, SIZE)
    sigma = np.sqrt(np.diag(fit.covariance))
    assert 1e-4 < sigma[0] < 5e-4
    assert abs(fit.distance_m - 1.3) < 3.0 * sigma[0]
    assert abs(math.degrees(fit.theta) - 138.0) < 3.0 * math.degrees(sigma[2])


@pytest.mark.parametrize("model", [ProfileModel, HeightModel])
def test_a_model_costs_alone_what_it_costs_with_its_derivatives(model: type[HeightModel]) -> None:
    profile = measure_profile(seen(1.34, 0.01, 40.0), 255.0)
    fit = fit_cylinder(profile, LENS, SIZE)
    made = model(profile, LENS, RADIUS if model is ProfileModel else SIZE)
    for off in (0.0, 0.02, -0.02):
        state = fit.state.copy()
        state[:3] += off
        assert made.cost(state) == made.linearise(state).cost


@pytest.mark.parametrize(("theta", "seed"), [(-137.0, 3), (141.0, 4), (93.0, 5)])
def test_a_fit_does_not_stay_in_a_minimum_of_unlikely_cloth(theta: float, seed: int) -> None:
    fit = fit_cylinder(measure_profile(seen(1.6, 0.01, theta, seed), 255.0), LENS, SIZE)
    assert fit.distance_m == pytest.approx(1.6, abs=5e-3)
    assert math.degrees(fit.theta) == pytest.approx(theta, abs=2.5)


def test_only_the_part_of_a_picture_that_shows_the_strip_is_drawn() -> None:
    surface = CylinderSurface(background=0.01)
    place = 2.0, 0.05, 0.6
    drawn = draw_cylinder(CAMERA, (RADIUS, HEIGHT), place, surface)
    wide = Camera("wide", "pinhole", 480, 240, 907.5, (239.5, 119.5))
    same = draw_cylinder(wide, (RADIUS, HEIGHT), place, surface)
    assert np.array_equal(drawn, same[:, 80:400])
    away = draw_cylinder(CAMERA, (RADIUS, HEIGHT), (2.0, 0.8, 0.6), surface)
    assert (away == np.float32(0.01)).all()


def test_two_bodies_are_not_a_cylinder() -> None:
    picture = seen(2.4, -0.08, 30.0)
    picture[:, 200:] = picture[:, :120][:, ::-1]
    with pytest.raises(NoSolutionError, match="two bodies"):
        measure_profile(picture, 255.0)


def test_a_dark_picture_shows_nothing() -> None:
    noise = np.random.default_rng(1).normal(3.0, 1.0, (240, 320)).astype(np.float32)
    with pytest.raises(NoSolutionError, match=r"stands out|no lit body"):
        measure_profile(noise, 255.0)


@pytest.mark.parametrize("theta", [-60.0, 30.0, 95.0])
@pytest.mark.parametrize("gain", [1.3, 2.0])
def test_what_is_overexposed_tells_nothing_and_the_rest_does(gain: float, theta: float) -> None:
    """With the clipped columns as they are, theta is off by 1 to 3 deg, 10 to 100 sigmas."""
    picture = np.minimum(np.rint(gain * seen(1.34, 0.01, theta)), 255.0)
    fit = fit_cylinder(measure_profile(picture, 255.0), LENS, SIZE)
    sigma = np.sqrt(np.diag(fit.covariance))
    assert abs(fit.theta - math.radians(theta)) < 4.0 * sigma[2]
    assert abs(fit.distance_m - 1.34) < 4.0 * sigma[0] + 2e-4


@pytest.mark.parametrize(
    ("gain", "text"), [(20.0, "columns are at full scale"), (0.15, "counts brighter")]
)
def test_a_picture_exposed_too_long_or_too_short_is_refused(gain: float, text: str) -> None:
    picture = np.minimum(np.rint(gain * seen(1.34, 0.01, 5.0)), 255.0).astype(np.float32)
    with pytest.raises(NoSolutionError, match=text):
        measure_profile(picture, 255.0)


@pytest.mark.parametrize("height", [0.97, 1.03])
def test_a_strip_of_another_height_is_refused(height: float) -> None:
    other = CylinderSize(RADIUS, HEIGHT * height)
    with pytest.raises(NoSolutionError, match=r"lit cylinder|upright|settle"):
        fit_cylinder(measure_profile(seen(1.34, 0.01, 66.0), 255.0), LENS, other)


def test_a_picture_out_of_focus_is_refused() -> None:
    picture = cv2.GaussianBlur(seen(1.0, 0.0, -40.0), (0, 0), 8.0)
    with pytest.raises(NoSolutionError, match=r"out of focus: blurred by 7"):
        fit_cylinder(measure_profile(picture, 255.0), LENS, SIZE)


def test_the_printed_formulas_are_not_given_a_width_that_is_cut() -> None:
    with pytest.raises(NoSolutionError, match="has no width"):
        measure_printed_extent(measure_profile(seen(1.34, 0.17, 20.0), 255.0))


def test_a_sphere_is_not_taken_for_a_cylinder() -> None:
    y, x = np.mgrid[:240, :320]
    square = (x - 160.0) ** 2 + (y - 120.0) ** 2
    depth = np.sqrt(np.maximum(70.0**2 - square, 0.0)) / 70.0
    noise = np.random.default_rng(1).normal(2.0, 1.0, depth.shape)
    with pytest.raises(NoSolutionError):
        fit_cylinder(measure_profile((200.0 * depth + noise).astype(np.float32), 255.0), LENS, SIZE)


@pytest.mark.parametrize("gloss", [0.0, 0.3])
def test_gloss_on_the_middle_of_the_strip_leaves_its_height_alone(gloss: float) -> None:
    """Against half the middle's brightness the ends of a glossy strip lie 0.05 px inside."""
    surface = CylinderSurface(gloss=gloss, gloss_power=30.0, light_elevation_deg=0.0)
    off = []
    for step in range(8):  # the phase of the pixels
        distance = 1.2 + 0.013 * step
        place = distance, 0.0, math.radians(110.0)
        light = draw_cylinder(CAMERA, (RADIUS, HEIGHT), place, surface)
        counts = expose(light, SensorSettings(0.8, 1000.0), np.random.default_rng(step))
        profile = measure_profile(counts.astype(np.float32), 255.0)
        bearing = np.arctan((profile.height_columns - LENS.centre_x_px) / LENS.focal_x_px)
        psi = compute_psi(bearing, RADIUS, distance)
        depth = compute_surface_distance(psi, RADIUS, distance) * np.cos(bearing)
        middle = np.abs(profile.height_columns - 230.0) < 25.0
        off.append((profile.heights - LENS.focal_y_px * HEIGHT / depth)[middle].mean())
    assert abs(float(np.mean(off))) < 0.025
