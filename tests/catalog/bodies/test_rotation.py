"""Body orientation."""

from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.rotation import CENTURY_S, DAY_S, body_from_inertial, pole_and_meridian

KERNELS = [
    "naif0012.tls",
    "pck00011.tpc",
    "moon_080317.tf",
    "moon_assoc_me.tf",
    "moon_pa_de421_1900-2050.bpc",
]


@pytest.fixture
def spice(shared_data: Callable[[str], Path]) -> Iterator[ModuleType]:
    module = pytest.importorskip("spiceypy", reason="needs spiceypy")
    paths = [str(shared_data(f"spice/{name}")) for name in KERNELS]
    module.furnsh(paths)
    yield module
    for path in paths:
        module.unload(path)


def epochs(count: int) -> np.ndarray:
    """TDB seconds between 1997 and 2010."""
    return np.random.default_rng(3).uniform(-9.4e7, 3.15e8, count)


def test_the_lunar_series_is_near_the_mean_earth_frame(spice: ModuleType) -> None:
    """80 m on average and 155 m at most are the design's numbers; 400 dates, whole surface."""
    times = epochs(400)
    series = body_from_inertial(load_body("moon"), times)
    kernel = np.array([spice.pxform("J2000", "MOON_ME", t) for t in times])
    difference = series @ kernel.swapaxes(1, 2)
    angle = np.arcsin(np.linalg.norm(difference - difference.swapaxes(1, 2), axis=(1, 2)) / 8**0.5)
    at_surface_m = angle * 1737400.0
    assert 70.0 < at_surface_m.mean() < 90.0
    assert at_surface_m.max() < 155.0


@pytest.mark.parametrize("name", ["moon", "phobos", "earth", "mars"])
def test_the_series_is_the_one_of_the_constants_kernel(name: str, spice: ModuleType) -> None:
    times = epochs(20)
    ours = body_from_inertial(load_body(name), times)
    theirs = np.array([spice.pxform("J2000", f"IAU_{name.upper()}", t) for t in times])
    np.testing.assert_allclose(ours, theirs, atol=1e-10)


@pytest.mark.parametrize("name", ["moon", "phobos", "earth", "mars"])
def test_orientations_are_rotations_for_one_or_many_times(name: str) -> None:
    body = load_body(name)
    times = epochs(6).reshape(2, 3)
    matrices = body_from_inertial(body, times)
    assert matrices.shape == (2, 3, 3, 3)
    identity = np.broadcast_to(np.eye(3), matrices.shape)
    np.testing.assert_allclose(matrices @ matrices.swapaxes(-1, -2), identity, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-14)
    np.testing.assert_array_equal(body_from_inertial(body, float(times[1, 2])), matrices[1, 2])


def test_the_pole_of_the_body_is_the_pole_of_the_series() -> None:
    moon = load_body("moon")
    ra, dec, _ = pole_and_meridian(moon.rotation, 1e8)
    pole = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    np.testing.assert_allclose(body_from_inertial(moon, 1e8) @ pole, [0.0, 0.0, 1.0], atol=1e-15)


def test_the_moon_turns_eastward_once_in_a_sidereal_month() -> None:
    moon = load_body("moon")
    _, _, start = pole_and_meridian(moon.rotation, 0.0)
    _, _, later = pole_and_meridian(moon.rotation, DAY_S)
    assert np.degrees(later - start) == pytest.approx(13.176, abs=0.1)
    assert CENTURY_S == 36525 * 86400
