"""Rays over nested grids against exact intersections, the photometric law and shadow geometry."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.optimize import brentq

from catalog.geometry.grid import interpolate_bilinear
from catalog.geometry.latlon import body_from_local, latlon_from_xyz, xyz_from_latlon
from catalog.photometry.laws import LUNAR_HAPKE
from catalog.rendering.rays.ground import Ground, crop_surroundings, make_ground, make_whole_sphere
from catalog.rendering.rays.light import compute_lit_share
from catalog.rendering.rays.march import CROSSING_M, FINE, SKY, WIDE, Ray, intersect_ground, refine
from catalog.rendering.rays.scene import Scene

RADIUS_M = 1_737_400.0
STEP = 200.0 / RADIUS_M
LAT, LON = np.radians(-43.0), np.radians(-11.0)
SIZE = 300


def globe(height_m: float = 0.0) -> Ground:
    return make_whole_sphere(np.full((90, 180), height_m, np.float32), RADIUS_M, LON + np.pi)


def fine(heights: np.ndarray) -> Ground:
    rows, cols = heights.shape
    step_lon = STEP / np.cos(LAT)
    north, west = LAT + (rows - 1) / 2 * STEP, LON - (cols - 1) / 2 * step_lon
    return make_ground(heights.astype(np.float32), north, west, STEP, step_lon, RADIUS_M)


def hills(seed: int = 3) -> np.ndarray:
    """Rough ground of 60 x 60 km with 2 km of relief that fades to 0 at the border."""
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    rng = np.random.default_rng(seed)
    z = np.zeros((SIZE, SIZE))
    for _ in range(30):
        k = rng.uniform(2.0, 25.0, 2)
        z += 2500.0 / np.hypot(*k) * np.cos(2 * np.pi * (k[0] * x + k[1] * y) + rng.uniform(0, 6))
    fade = np.clip(np.minimum.reduce([x, 1 - x, y, 1 - y]) * 8.0, 0.0, 1.0)
    return z * fade


def height_over(ground: Ground, point: np.ndarray) -> np.ndarray:
    """Height (m) of points (..., 3) over the ground, by exact latitude and longitude."""
    lat, lon, r = latlon_from_xyz(point)
    row = (ground.north - lat) / ground.step_lat
    col = (lon - ground.west) / ground.step_lon
    places = np.atleast_1d(row), np.atleast_1d(col)
    below = map_coordinates(ground.heights, places, np.float64, order=1)
    return r - RADIUS_M - below.reshape(r.shape)


def traced(ground: Ground, wide: Ground, origin: np.ndarray, rays: np.ndarray):
    """What rays (n, 3) from one origin meet, and how far away."""
    found = [intersect_ground(ground, wide, Ray(*origin, *ray), 0.0)[:2] for ray in rays]
    return np.array([kind for kind, _ in found]), np.array([distance for _, distance in found])


def rays_to_ground(origin: np.ndarray, count: int, seed: int, half_deg: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    lat = LAT + np.radians(rng.uniform(-half_deg, half_deg, count))
    lon = LON + np.radians(rng.uniform(-half_deg, half_deg, count))
    rays = xyz_from_latlon(lat, lon, RADIUS_M) - origin
    return rays / np.linalg.norm(rays, axis=1)[:, None]


@pytest.mark.parametrize(
    ("back_km", "height_km", "tolerance_m"),
    [(0.0, 100.0, 0.5), (150.0, 80.0, 0.5), (60.0, 4.0, 2.0)],
)
def test_hits_are_the_first_crossings_of_a_dense_search(
    back_km: float, height_km: float, tolerance_m: float
):
    """From above, slanting and grazing: 20 m steps and a root finder on exact coordinates.

    The ray's polynomials are good to 0.2 m, which a grazing ray stretches along itself.
    """
    ground = fine(hills())
    origin = xyz_from_latlon(LAT - back_km * 1e3 / RADIUS_M, LON, RADIUS_M + height_km * 1e3)
    rays = rays_to_ground(origin, 60, 1, 0.7)
    kind, distance = traced(ground, globe(), origin, rays)
    assert np.count_nonzero(kind == FINE) > 40
    for ray, what, found in zip(rays, kind, distance, strict=True):
        if what != FINE:
            continue
        s = np.arange(max(found - 60e3, 0.0), found + 500.0, 20.0)
        above = height_over(ground, origin + s[:, None] * ray)
        first = int(np.argmax(above < 0.0))
        assert above[first] < 0.0
        exact = brentq(
            lambda t, d=ray: float(height_over(ground, origin + t * d)), s[first - 1], s[first]
        )
        assert found == pytest.approx(exact, abs=tolerance_m)


def test_a_crossing_lies_where_bisection_finds_it():
    ground = fine(hills())
    rng = np.random.default_rng(5)
    for step in (0.015, 3.0, 70.0, 4000.0):
        for row, col in rng.uniform(20, SIZE - 20, (40, 2)):
            # over the cell's border by as much as a walk goes
            over = np.ceil(row) + 1e-3 - row, np.floor(col) - 1e-3 - col

            def clearance(t, ray, row=row, col=col, over=over):
                return ray(t) - interpolate_bilinear(
                    ground.heights, row + t * over[0], col + t * over[1]
                )

            above, below = rng.uniform(0.0, 0.5 * step, 2)
            first = above - clearance(0.0, lambda _: 0.0)
            last = -below - clearance(1.0, lambda _: 0.0)
            low, high = 0.0, 1.0
            while (high - low) * step >= CROSSING_M:
                middle = 0.5 * (low + high)
                clear = clearance(middle, lambda t, a=first, b=last: a + t * (b - a)) > 0.0
                low, high = (middle, high) if clear else (low, middle)
            found = refine(ground, step, (row, col), over, (first, last))
            assert found == 0.5 * (low + high)


def test_the_limb_of_a_bare_sphere_is_where_the_tangent_is():
    ground, wide = fine(np.zeros((20, 20))), globe()
    height = 100e3
    origin = xyz_from_latlon(LAT, LON, RADIUS_M + height)
    axes = body_from_local(LAT, LON)
    limb = np.arcsin(RADIUS_M / (RADIUS_M + height))
    azimuth = np.radians(np.arange(0.0, 360.0, 15.0))
    for off, expected in ((-1e-4, WIDE), (1e-4, SKY)):  # a fifteenth of a fisheye's pixel
        e = np.sin(limb + off)
        local = np.stack(
            [e * np.sin(azimuth), e * np.cos(azimuth), np.full(24, -np.cos(limb + off))], 1
        )
        kind, _ = traced(ground, wide, origin, local @ axes.T)
        assert (kind == expected).all()


def test_rays_to_the_poles_and_across_180_degrees_hit_the_sphere():
    ground, wide = fine(np.zeros((20, 20))), globe(500.0)
    for lat_deg, lon_deg in ((90.0, 0.0), (-90.0, 0.0), (0.0, 180.0), (10.0, -180.0), (89.9, 77.0)):
        place = xyz_from_latlon(np.radians(lat_deg), np.radians(lon_deg), 1.0)
        kind, distance = traced(ground, wide, place * 2e6, -place[None])
        assert kind[0] == WIDE
        assert distance[0] == pytest.approx(2e6 - RADIUS_M - 500.0, abs=0.5)


def pinhole(size: int, focal_px: float) -> np.ndarray:
    x = np.arange(size + 1) - size / 2
    rays = np.stack([*np.meshgrid(x / focal_px, x / focal_px), np.ones((size + 1,) * 2)], -1)
    return rays / np.linalg.norm(rays, axis=-1)[..., None]


def down_camera() -> np.ndarray:
    """Body from camera: x east, y south, z down at the scene."""
    axes = body_from_local(LAT, LON)
    return np.stack([axes[:, 0], -axes[:, 1], -axes[:, 2]], axis=1)


def sun_at(elevation_deg: float, azimuth_deg: float) -> np.ndarray:
    e, a = np.radians([elevation_deg, azimuth_deg])
    local = np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])
    return body_from_local(LAT, LON) @ local


@pytest.mark.parametrize("flat_is_fine", [True, False])
def test_a_smooth_sphere_has_the_radiance_of_the_law(flat_is_fine: bool):
    size = SIZE if flat_is_fine else 8
    scene = Scene(fine(np.zeros((size, size))), globe(), sun_at(35.0, 70.0))
    origin = xyz_from_latlon(LAT, LON, RADIUS_M + 60e3)
    rotation = down_camera()
    picture = scene.picture(origin, pinhole(64, 120.0) @ rotation.T)
    for row, col in ((4, 5), (20, 60), (50, 12)):
        ray = np.array([(col - 31.5) / 120.0, (row - 31.5) / 120.0, 1.0])
        ray = rotation @ (ray / np.linalg.norm(ray))
        along = origin @ ray
        point = origin + ray * (-along - np.sqrt(along**2 - origin @ origin + RADIUS_M**2))
        normal = point / RADIUS_M
        expected = LUNAR_HAPKE(normal @ scene.sun, -normal @ ray, -ray @ scene.sun)
        # the picture is a mean over a pixel, the law is at its middle
        assert picture[row, col] == pytest.approx(float(expected), rel=2e-3)


def test_a_peak_appears_where_its_top_projects():
    """A cone's bright flank and dark flank meet at the top: their symmetric point within 0.05 px.

    The Sun in the south and in the north: the mean picture is symmetric about the peak, save for
    the slant of its projection, which is left out by looking straight down on it.
    """
    y, x = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2.0
    cone = 400.0 * np.exp(-(x**2 + y**2) / (2 * 6.0**2))
    ground = fine(cone)
    origin = xyz_from_latlon(LAT, LON, RADIUS_M + 60e3)
    corners = (
        pinhole(101, 400.0) @ down_camera().T
    )  # 150 m a pixel; the peak in the middle, (50, 50)
    moments = []
    for azimuth in (0.0, 90.0, 180.0, 270.0):
        flat = Scene(fine(np.zeros((SIZE, SIZE))), globe(), sun_at(40.0, azimuth))
        change = Scene(ground, globe(), sun_at(40.0, azimuth)).picture(origin, corners)
        moments.append(change - flat.picture(origin, corners))
    total = np.abs(np.sum(moments, axis=0))
    rows, cols = np.mgrid[:101, :101]
    assert (total * cols).sum() / total.sum() == pytest.approx(50.0, abs=0.05)
    assert (total * rows).sum() / total.sum() == pytest.approx(50.0, abs=0.05)


@pytest.mark.parametrize(("elevation_deg", "azimuth_deg"), [(8.0, 250.0), (20.0, 30.0)])
def test_shadows_are_those_of_a_dense_march_to_the_sun(elevation_deg: float, azimuth_deg: float):
    ground = fine(hills(5))
    around = crop_surroundings(globe(), ground, 0.06)
    sun = sun_at(elevation_deg, azimuth_deg)
    rng = np.random.default_rng(2)
    agree, dark = 0, 0
    for i, j in rng.integers(40, SIZE - 40, (300, 2)):
        lat, lon = ground.north - i * ground.step_lat, ground.west + j * ground.step_lon
        place = xyz_from_latlon(lat, lon, RADIUS_M + float(ground.heights[i, j]))
        share = compute_lit_share(ground, around, around, *place, sun)
        s = np.arange(200.0, 25e3, 15.0)
        angle = (height_over(ground, place + s[:, None] * sun) / s).min()
        exact = np.clip(0.5 + angle / (2 * 0.00465), 0.0, 1.0)
        agree += abs(share - exact) < 0.1
        dark += exact < 0.5
    assert dark > 20
    assert agree >= 294


def test_a_picture_does_not_depend_on_what_was_looked_at_before():
    heights, sun = hills(), sun_at(15.0, 120.0)
    corners = pinhole(80, 300.0) @ down_camera().T
    origin = xyz_from_latlon(LAT, LON, RADIUS_M + 40e3)
    alone = Scene(fine(heights), globe(), sun).picture(origin, corners)
    scene = Scene(fine(heights), globe(), sun)
    scene.picture(xyz_from_latlon(LAT + 0.004, LON, RADIUS_M + 50e3), corners)
    assert scene.picture(origin, corners).tobytes() == alone.tobytes()
    assert alone.std() > 0.005


def test_a_hole_in_the_ground_is_refused():
    heights = np.zeros((20, 20))
    heights[3, 4] = np.nan
    with pytest.raises(ValueError, match="every node"):
        fine(heights)
