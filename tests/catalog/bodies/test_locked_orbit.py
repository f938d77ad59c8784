"""Mars as Phobos sees it, against published ephemerides."""

import numpy as np
import pytest

from catalog.bodies.body import load_body
from catalog.bodies.ephemeris import AnalyticEphemeris
from catalog.bodies.rotation import body_from_inertial

DAY_S = 86400.0
AU_M = 149597870691.0
PHOBOS = load_body("phobos")
# Phobos from Mars, ICRF, AU: the examples of MarsSatV1_0's description (IMCCE), days after J2000
IMCCE = (
    (0.0, (-0.000013308157, -0.000058444725, -0.000021266023)),
    (10.0, (0.000050907508, 0.000033574979, -0.000011296402)),
    (20.0, (-0.000051052809, 0.000012426617, 0.000033811410)),
)


def horizons() -> tuple[float, np.ndarray]:
    """Phobos from Mars by JPL Horizons' elements for 2024-11-28, ecliptic of J2000; ICRF, m."""
    a, e = 9.378884043199467e6, 1.488911986011352e-2
    tilt, node, lowest, anomaly = np.radians(
        [26.12626927005928, 84.86814910358899, 343.8114266487729, 135.9109130946083]
    )
    r, u = a * (1.0 - e * e) / (1.0 + e * np.cos(anomaly)), lowest + anomaly
    x = np.cos(node) * np.cos(u) - np.sin(node) * np.sin(u) * np.cos(tilt)
    y = np.sin(node) * np.cos(u) + np.cos(node) * np.sin(u) * np.cos(tilt)
    z = np.sin(u) * np.sin(tilt)
    c, s = np.cos(np.radians(84381.448 / 3600.0)), np.sin(np.radians(84381.448 / 3600.0))
    return 9097.5 * DAY_S, r * np.array([x, c * y - s * z, s * y + c * z])


@pytest.mark.parametrize(
    ("tdb_s", "phobos_m"),
    [*((day * DAY_S, AU_M * np.array(place)) for day, place in IMCCE), horizons()],
)
def test_mars_stands_where_published_ephemerides_have_it(
    tdb_s: float, phobos_m: np.ndarray
) -> None:
    found = AnalyticEphemeris(PHOBOS).position_m("mars", tdb_s)
    distances = np.linalg.norm(found), np.linalg.norm(phobos_m)
    assert distances[0] == pytest.approx(distances[1], abs=300.0)
    off = np.degrees(np.arcsin(np.linalg.norm(np.cross(found, phobos_m)) / np.prod(distances)))
    assert off < 0.021
    assert found @ phobos_m < 0.0
    # the mean side towards Mars is the prime meridian
    towards = body_from_inertial(PHOBOS, tdb_s) @ found / distances[0]
    assert np.degrees(np.arccos(towards[0])) < 3.0
