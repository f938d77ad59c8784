"""Added relief: the same ground from every side, the stated statistics, nothing below zero mean."""

import numpy as np
import pytest

from catalog.geometry.projection import Stereographic, make_node_grid
from catalog.terrain.synthetic import fractal, relief
from catalog.terrain.synthetic.relief import SyntheticRelief

RADIUS_M = 1_737_400.0
POSTING_M = 118.45
STEP = 29.6 / RADIUS_M


def detail(seed: int = 1, **settings: float) -> SyntheticRelief:
    return SyntheticRelief(seed, POSTING_M, RADIUS_M, **settings)


def window(ground: SyntheticRelief, lat_deg: float, lon_deg: float, size: int) -> np.ndarray:
    lat = np.radians(lat_deg)
    return ground.window(lat, np.radians(lon_deg), STEP, STEP / np.cos(lat), size, size)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_other_ground():
    first = window(detail(7), -43.0, -11.0, 64)
    assert first.tobytes() == window(detail(7), -43.0, -11.0, 64).tobytes()
    other = window(detail(8), -43.0, -11.0, 64)
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.2


def test_a_window_is_the_same_ground_as_a_larger_window_around_it():
    lat, step_lon = np.radians(-43.0), STEP / np.cos(np.radians(-43.0))
    large = detail().window(lat, 0.1, STEP, step_lon, 128, 128)
    small = detail().window(lat - 40 * STEP, 0.1 + 30 * step_lon, STEP, step_lon, 50, 60)
    np.testing.assert_allclose(small, large[40:90, 30:90], atol=1e-4)


@pytest.mark.parametrize(("lat_deg", "lon_deg"), [(-43.0, -11.0), (20.0, 180.0), (0.0, -180.0)])
def test_means_of_point_heights_over_a_node_are_the_window(lat_deg: float, lon_deg: float):
    """Points 5 x 5 a node, craters of 60 m and more: bowls and octaves are resolved by both."""
    ground = detail(smallest_m=59.0, rms_slope_deg=0.01)
    step, n = 10.0 / RADIUS_M, 24
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    step_lon = step / np.cos(lat)
    grid = ground.window(lat, lon, step, step_lon, n, n)
    sub = (np.arange(5) - 2.0) / 5.0
    rows = (np.arange(n)[:, None] + sub).ravel()
    points = ground.heights((lat - rows * step)[:, None], (lon + rows * step_lon)[None, :])
    means = points.reshape(n, 5, n, 5).mean(axis=(1, 3))
    assert points.std() > 0.2
    # a node of 10 m takes one sample of such craters: it differs at the sharp rims of fresh ones
    assert np.std(grid - means) < 0.1 * points.std()


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg"), [(-43.0, -11.0), (90.0, 0.0), (-90.0, 50.0), (89.998, 120.0), (5, 180)]
)
def test_a_map_grid_shows_the_ground_of_the_points(lat_deg: float, lon_deg: float):
    ground = detail(smallest_m=59.0)
    projection = Stereographic(np.radians(lat_deg), np.radians(lon_deg), RADIUS_M)
    grid = ground.sample_local(projection, 5.0, 120)
    lat, lon = projection.latlon(*make_node_grid(120, 5.0))
    points = ground.heights(lat, lon)
    assert points.std() > 0.5
    # what differs is the mean over a 5 m node, strongest at the sharp rims of fresh craters
    assert np.std(grid - points) < 0.1


def test_craters_far_below_a_node_are_left_out_instead_of_filling_the_memory():
    """Craters down to 1 cm over 36 km would be 1e13."""
    settings = {"rms_slope_deg": 0.01, "saturation": 0.05}
    fine, coarse = detail(smallest_m=0.01, **settings), detail(smallest_m=7.403, **settings)
    grids = [window(ground, -43.0, -11.0, 300) for ground in (fine, coarse)]
    assert grids[1].std() > 1.0
    assert np.abs(grids[0] - grids[1]).max() < 0.05 * grids[1].std()


def test_points_on_both_sides_of_180_degrees_join():
    ground = detail()
    lat = np.radians(np.linspace(-1.0, 1.0, 50))
    east, west = ground.heights(lat, np.pi - 1e-9), ground.heights(lat, -np.pi + 1e-9)
    np.testing.assert_allclose(east, west, atol=0.01)
    assert east.std() > 0.5


def test_a_crater_of_any_wear_holds_no_net_volume():
    x = (np.arange(50_000) + 0.5) / 50_000 * relief.REACH
    for wear in (0.0, 0.4, 1.0):
        heights = np.array([relief.evaluate_profile(r, wear) for r in x])
        bowl = float(np.sum(np.minimum(heights, 0.0) * x))
        assert abs(float(np.sum(heights * x))) < 2e-3 * abs(bowl)
        assert heights.max() - heights.min() == pytest.approx(1.0, abs=0.01)
        assert x[heights.argmax()] == pytest.approx(1.0, abs=0.01)


def test_crater_counts_follow_the_equilibrium_law_at_every_latitude():
    """N(> D) = 0.05 * 1.54 D^-2 inside a box; 4 sigma of a Poisson count."""
    for south_deg, width_deg in ((-43.0, 1.0), (0.0, 1.0), (88.0, 90.0)):
        south, width = np.radians(south_deg), np.radians(width_deg)
        north = south + np.radians(0.5)
        population = relief.Population(5, 3, 236.9, 0.05, RADIUS_M)
        table = relief.make_crater_table(population, south, 3.0, north, width)
        east = np.mod(table[:, relief.LON] - 3.0, 2.0 * np.pi)
        lat = table[:, relief.LAT]
        inside = (lat >= south) & (lat < north) & (east < width)
        area = RADIUS_M**2 * width * (np.sin(north) - np.sin(south))
        diameters = table[inside, relief.DIAMETER]
        top = diameters.max()
        assert top <= 236.9
        for low, high in ((29.7, 236.9), (60.0, 120.0), (118.5, 236.9)):
            expected = 0.05 * 1.54 * area * (low**-2 - high**-2)
            found = np.count_nonzero((diameters > low) & (diameters <= high))
            assert abs(found - expected) < 4.0 * np.sqrt(expected)


def test_random_relief_has_the_stated_slope():
    ground = detail(saturation=1e-9, rms_slope_deg=6.0)
    lat = np.radians(-43.0) + np.arange(400) * 2.0 / RADIUS_M
    east = ground.heights(lat[:, None], np.arange(400)[None] * 2.0 / RADIUS_M / np.cos(lat[0]))
    slopes = np.hypot(*np.gradient(east, 2.0))
    # 0.8 km holds some 100 independent places: about 5 % of scatter
    assert np.sqrt(np.mean(slopes**2)) == pytest.approx(np.tan(np.radians(6.0)), rel=0.12)


def test_the_relief_leaves_the_dem_as_it_is():
    """Means over the DEM's own resolution, two postings, keep under a quarter of the relief."""
    relief = window(detail(), -43.0, -11.0, 1024)
    assert relief.std() > 1.5
    assert abs(relief.mean()) < 0.02
    assert relief.reshape(128, 8, 128, 8).mean(axis=(1, 3)).std() < 0.25 * relief.std()
    assert relief.reshape(32, 32, 32, 32).mean(axis=(1, 3)).std() < 0.06 * relief.std()


def test_the_lattice_noise_has_no_net_height():
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    one = np.array([1.0])
    values = fractal.sum_noise(fractal.Octaves(4, one, one, 5000.0), directions)
    assert abs(values.mean()) < 0.003
    assert values.std() > 0.15


def test_a_smallest_size_above_the_largest_is_refused():
    with pytest.raises(ValueError, match="smallest relief"):
        detail(smallest_m=300.0)
