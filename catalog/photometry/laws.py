"""The simple brightness laws, and all laws by name and by number.

Lambert: equally bright from everywhere. Lommel-Seeliger: single scattering in a dark, smooth layer,
without a phase function; the law of the on-board reference. Lunar-Lambert (A. S. McEwen, Icarus 92
(1991) 298): Lommel-Seeliger near full Moon, more Lambert-like as phase grows; the Moon's
coefficients of L are those of the USGS program ISIS (class LunarLambertMcEwen, written by McEwen):
L = 1 - 0.019 g + 0.242e-3 g^2 - 1.46e-6 g^3 with g in degrees.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.errors import ConfigError
from catalog.geometry.kernel import kernel
from catalog.photometry import hapke
from catalog.photometry.hapke import stack_cosines
from catalog.photometry.sets import LUNAR, HapkeParameters

NORMAL_ALBEDO = 0.12  # the Moon's geometric albedo in V (Allen's Astrophysical Quantities, 4th ed.)
HAPKE, LOMMEL_SEELIGER, LUNAR_LAMBERT, LAMBERT = 0, 1, 2, 3  # numbers of the laws in kernels


class SurfaceLaw(NamedTuple):
    """A law with the numbers of a ground, as kernels take it.

    number   HAPKE, LOMMEL_SEELIGER, LUNAR_LAMBERT or LAMBERT
    surface  parameters of Hapke's law
    albedo   normal albedo of the other laws
    """

    number: int
    surface: HapkeParameters
    albedo: float

    def __call__(self, mu0: ArrayLike, mu: ArrayLike, cos_phase: ArrayLike) -> FloatArray:
        """Radiance factor; zero where mu0 <= 0 or mu <= 0.

        mu0, mu, cos_phase  cosines of incidence, emission and phase; shapes broadcast
        """
        cosines = stack_cosines(mu0, mu, cos_phase)
        return _evaluate_flat(cosines.reshape(3, -1), self).reshape(cosines.shape[1:])


@kernel
def lambert_scalar(mu0: float, mu: float, albedo: float) -> float:
    """Radiance factor A mu0, zero when the Sun or the camera is below the surface."""
    if not (mu0 > 0.0 and mu > 0.0):
        return 0.0
    return albedo * mu0


@kernel
def lommel_seeliger_scalar(mu0: float, mu: float, albedo: float) -> float:
    """Radiance factor 2 A mu0 / (mu0 + mu); A is what vertical light seen from above returns."""
    if not (mu0 > 0.0 and mu > 0.0):
        return 0.0
    return 2.0 * albedo * mu0 / (mu0 + mu)


@kernel
def lunar_weight(cos_phase: float) -> float:
    """Share L of the Lommel-Seeliger term.

    Beyond 103 deg of phase the cubic is negative, and would make ground that faces the Sun dark;
    there L is held at 0, pure Lambert (ours).
    """
    return compute_lunar_weight(math.degrees(math.acos(min(max(cos_phase, -1.0), 1.0))))


@kernel
def compute_lunar_weight(g: float) -> float:
    """Compute the share L of the Lommel-Seeliger term from the phase, deg."""
    weight = 1.0 + g * (-0.019 + g * (0.242e-3 - 1.46e-6 * g))
    return weight if (weight > 0.0) & (g < 110.0) else 0.0


@kernel
def compute_phase_degrees(cosine: float) -> float:
    """An arc cosine, deg, by a polynomial: right to 2e-8 rad, and a loop of it can be vectors.

    The root over 1 - x takes out the singularity at 1; the polynomial is Hastings' of degree 7.
    """
    x = abs(cosine)
    root = np.sqrt(1.0 - x if x < 1.0 else 0.0)
    series = 0.0308918810 + x * (-0.0170881256 + x * (0.0066700901 - x * 0.0012624911))
    series = 0.0889789874 + x * (-0.0501743046 + x * series)
    angle = root * (1.5707963050 + x * (-0.2145988016 + x * series))
    return math.degrees(angle if cosine >= 0.0 else math.pi - angle)


@kernel
def lunar_lambert_scalar(mu0: float, mu: float, cos_phase: float, albedo: float) -> float:
    """Radiance factor A (2 L mu0 / (mu0 + mu) + (1 - L) mu0)."""
    if mu0 <= 0.0 or mu <= 0.0:
        return 0.0
    weight = lunar_weight(cos_phase)
    return albedo * (2.0 * weight * mu0 / (mu0 + mu) + (1.0 - weight) * mu0)


@kernel
def evaluate_law(mu0: float, mu: float, cos_phase: float, law: SurfaceLaw) -> float:
    """Radiance factor of one geometry by a law's number."""
    if law.number == HAPKE:
        return hapke.reflectance_scalar(mu0, mu, cos_phase, law.surface)
    if law.number == LOMMEL_SEELIGER:
        return lommel_seeliger_scalar(mu0, mu, law.albedo)
    if law.number == LUNAR_LAMBERT:
        return lunar_lambert_scalar(mu0, mu, cos_phase, law.albedo)
    return lambert_scalar(mu0, mu, law.albedo)


@kernel
def _evaluate_flat(cosines: FloatArray, law: SurfaceLaw) -> FloatArray:
    out = np.empty(cosines.shape[1])
    for i in range(out.size):
        out[i] = evaluate_law(cosines[0, i], cosines[1, i], cosines[2, i], law)
    return out


def _evaluate_simple_law(
    number: int, mu0: ArrayLike, mu: ArrayLike, cos_phase: ArrayLike, albedo: float = NORMAL_ALBEDO
) -> FloatArray:
    """Radiance factor by a simple law; zero where mu0 <= 0 or mu <= 0.

    mu0, mu, cos_phase  cosines of incidence, emission and phase; shapes broadcast
    albedo              normal albedo
    """
    return SurfaceLaw(number, LUNAR, float(albedo))(mu0, mu, cos_phase)


lambert = partial(_evaluate_simple_law, LAMBERT)
lommel_seeliger = partial(_evaluate_simple_law, LOMMEL_SEELIGER)
lunar_lambert = partial(_evaluate_simple_law, LUNAR_LAMBERT)
LAWS = ("hapke", "lommel_seeliger", "lunar_lambert", "lambert")  # by their numbers


def find_law(name: str, surface: HapkeParameters = LUNAR) -> SurfaceLaw:
    """Find a law by its name, for a ground of Hapke's parameters; the Moon's unless given.

    Raises ConfigError for a name that is no law.
    """
    if name not in LAWS:
        raise ConfigError(f"photometry: no law is called '{name}'; use one of {', '.join(LAWS)}")
    return SurfaceLaw(LAWS.index(name), surface, NORMAL_ALBEDO)


LUNAR_HAPKE = find_law("hapke")
