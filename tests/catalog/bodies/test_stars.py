"""The bundled stars: their aberration against another library."""

import erfa
import numpy as np

from catalog.bodies.stars import LIGHT_M_S, apply_aberration
from catalog.geometry.rotations import ARCSEC


def test_aberration_is_that_of_the_standards_of_fundamental_astronomy() -> None:
    """To first order in v/c: the next is 0.001" at the Earth's 30 km/s."""
    rng = np.random.default_rng(1)
    stars = rng.normal(size=(500, 3))
    stars /= np.linalg.norm(stars, axis=1)[:, None]
    for velocity in 3e4 * np.linalg.qr(rng.normal(size=(3, 3)))[0]:
        share = velocity / LIGHT_M_S
        wanted = erfa.ab(stars, share, 1.0, np.sqrt(1.0 - share @ share))
        off = np.linalg.norm(np.cross(apply_aberration(stars, velocity), wanted), axis=1)
        assert off.max() < 1.1e-3 * ARCSEC
        assert np.linalg.norm(np.cross(stars, wanted), axis=1).max() > 20.0 * ARCSEC
