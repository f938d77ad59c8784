"""Body orientation."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from catalog.bodies.body import load_body
from catalog.bodies.rotation import body_from_inertial
from catalog.config import resource

BODIES = resource("configs/bodies/moon.toml").parent
SHIPPED = [path.stem for path in sorted(BODIES.glob("*.toml"))]
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


def published(name: str, times: np.ndarray) -> np.ndarray:
    """Rotations by the published series alone, without our correction and the Earth's theory."""
    body = load_body(name)
    series = msgspec.structs.replace(body.rotation, theory="series")
    return body_from_inertial(replace(body, rotation=series, rotation_correction=None), times)


def turns_m(ours: np.ndarray, spice: ModuleType, times: np.ndarray) -> np.ndarray:
    """Shifts (n, 3) of the lunar surface between a rotation and the kernels', by axis, m."""
    kernel = np.array([spice.pxform("J2000", "MOON_ME", t) for t in times])
    return Rotation.from_matrix(ours @ kernel.swapaxes(1, 2)).as_rotvec() * 1737400.0


def test_the_lunar_series_is_near_the_mean_earth_frame(spice: ModuleType) -> None:
    """80 m on average and 155 m at most are the design's numbers; 400 dates, whole surface."""
    times = epochs(400)
    ours = published("moon", times)
    at_surface_m = np.linalg.norm(turns_m(ours, spice, times), axis=1)
    assert 70.0 < at_surface_m.mean() < 90.0
    assert at_surface_m.max() < 155.0


def test_the_correction_brings_the_moon_to_five_metres_from_1900_to_2050(spice: ModuleType) -> None:
    """Random times, between those that were fitted. The stated error is the worst axis' rms."""
    moon = load_body("moon")
    times = np.random.default_rng(8).uniform(-3.1556e9, 1.6093e9, 3000)
    shift_m = turns_m(body_from_inertial(moon, times), spice, times)
    assert np.linalg.norm(shift_m, axis=1).max() < 5.0
    rms_m = np.sqrt(np.mean(shift_m**2, axis=0))
    stated_m = moon.rotation_error_m(0.0)
    assert 0.7 * stated_m < rms_m.max() < stated_m


def test_beyond_its_years_the_correction_is_not_used_and_the_error_is_the_series() -> None:
    moon = load_body("moon")
    times = np.array([-3.2e9, 0.0, 1.7e9])
    turned = body_from_inertial(moon, times) != published("moon", times)
    assert np.any(turned, axis=(1, 2)).tolist() == [False, True, False]
    for t in times:
        np.testing.assert_allclose(
            body_from_inertial(moon, float(t)),
            body_from_inertial(moon, times)[times == t][0],
            atol=1e-15,
        )
    errors_m = [moon.rotation_error_m(float(t)) for t in times]
    assert errors_m == [80.0, moon.rotation_correction.error_m, 80.0]


@pytest.mark.parametrize(
    ("name", "number"),
    [
        *(("moon", 301), ("phobos", 401), ("earth", 399), ("mars", 499), ("mercury", 199)),
        *(("eros", 2000433), ("vesta", 2000004), ("67p", 1000012)),
    ],
)
def test_the_series_is_the_one_of_the_constants_kernel(
    name: str, number: int, spice: ModuleType
) -> None:
    times = epochs(20)
    ours = published(name, times)
    theirs = np.array([spice.tipbod("J2000", number, t) for t in times])
    np.testing.assert_allclose(ours, theirs, atol=1e-10)


def test_the_pole_and_rate_of_itokawa_are_near_those_of_the_constants_kernel(
    spice: ModuleType,
) -> None:
    """0.75 deg and 0.0008 deg a day apart: the IAU's values are from before the shape model."""
    pole, theirs = (m[2] for m in (published("itokawa", 0.0), spice.tipbod("J2000", 2025143, 0.0)))
    assert np.degrees(np.arccos(pole @ theirs)) < 0.8
    rate = load_body("itokawa").rotation.meridian_deg_by_day[1]
    assert rate == pytest.approx(712.143, abs=1e-3)


@pytest.mark.parametrize("name", SHIPPED)
def test_orientations_are_rotations_for_one_or_many_times(name: str) -> None:
    body = load_body(name)
    times = epochs(6).reshape(2, 3)
    matrices = body_from_inertial(body, times)
    assert matrices.shape == (2, 3, 3, 3)
    identity = np.broadcast_to(np.eye(3), matrices.shape)
    np.testing.assert_allclose(matrices @ matrices.swapaxes(-1, -2), identity, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-14)
    np.testing.assert_array_equal(body_from_inertial(body, float(times[1, 2])), matrices[1, 2])


def test_the_moon_turns_eastward_once_in_a_sidereal_month() -> None:
    start, later = published("moon", np.array([0.0, 86400.0]))
    turn = Rotation.from_matrix(later @ start.T).as_rotvec(degrees=True)
    # inertial axes seen from the turning body run westward about its pole
    assert turn[2] == pytest.approx(-13.176, abs=0.1)
    np.testing.assert_allclose(turn[:2], 0.0, atol=0.01)


# whose file has a rotation of its own, for a reason that stands in it
OTHER_ROTATION = {"bennu", "didymos", "dimorphos", "hyperion", "itokawa", "moon", "ryugu"}


@pytest.mark.parametrize("name", [name for name in SHIPPED if name not in OTHER_ROTATION])
def test_a_body_turns_as_in_the_iau_constants_kernel(name: str, spice: ModuleType) -> None:
    """1e-6 deg from 1980 to 2040, periodic terms and all."""
    body = load_body(name)
    assert body.spice is not None
    times = np.random.default_rng(5).uniform(-6.3e8, 1.26e9, 40)
    kernel = np.array([spice.tipbod("J2000", body.spice.naif[0], t) for t in times])
    apart = Rotation.from_matrix(published(name, times) @ kernel.swapaxes(1, 2)).magnitude()
    assert np.degrees(apart.max()) < 1e-6
    # the Earth's constants leave nutation and UT1 out, its theory here does not
    ours = body_from_inertial(body, times)
    apart = Rotation.from_matrix(ours @ kernel.swapaxes(1, 2)).magnitude()
    assert np.degrees(apart.max()) < (0.3 if name == "earth" else 1e-6)
