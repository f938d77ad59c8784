"""Hapke's bidirectional reflectance of a rough particulate surface.

Source: B. Hapke, Theory of Reflectance and Emittance Spectroscopy (2nd ed., 2012); roughness as in
Hapke, Icarus 59 (1984) 41; H functions as in Hapke, Icarus 157 (2002) 523. The porosity factor is 1
and there is no coherent backscatter, as in the lunar fits of Sato et al., JGR Planets 119 (2014)
1775. Symbols are Hapke's: i, e, g for incidence, emission, phase; psi the azimuth between the
planes of incidence and emission.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel
from catalog.photometry.sets import HapkeParameters


@kernel
def h_function(x: float, w: float) -> float:
    """Chandrasekhar's H for isotropic scatterers; Hapke's 2002 approximation, better than 1 %."""
    gamma = math.sqrt(1.0 - w)
    r0 = (1.0 - gamma) / (1.0 + gamma)
    if x <= 0.0:
        return 1.0
    return 1.0 / (1.0 - w * x * (r0 + (1.0 - 2.0 * r0 * x) / 2.0 * math.log((1.0 + x) / x)))


@kernel
def phase_function(cos_g: float, b: float, c: float) -> float:
    """Double Henyey-Greenstein function, of mean 1 over the sphere; c > 0 scatters backwards."""
    back = 1.0 - 2.0 * b * cos_g + b * b
    ahead = 1.0 + 2.0 * b * cos_g + b * b
    lobe = 1.0 - b * b
    return 0.5 * (
        (1.0 + c) * lobe / (back * math.sqrt(back)) + (1.0 - c) * lobe / (ahead * math.sqrt(ahead))
    )


@kernel
def opposition_surge(cos_g: float, bs0: float, hs: float) -> float:
    """Shadow-hiding factor 1 + Bs0 Bs(g), Bs = 1 / (1 + tan(g/2) / hs)."""
    if bs0 == 0.0:
        return 1.0
    # tan(g/2) from the cosine alone; at g = 180 deg it is infinite and the surge is gone
    half = math.sqrt(max(1.0 - cos_g, 0.0) / max(1.0 + cos_g, 1e-300))
    return 1.0 + bs0 / (1.0 + half / hs)


@kernel
def _compute_e1_e2(cot_x: float, cot_theta: float) -> tuple[float, float]:
    e1 = math.exp(-2.0 / math.pi * cot_theta * cot_x)
    return e1, math.exp(-cot_theta * cot_theta * cot_x * cot_x / math.pi)


@kernel
def compute_rough_cosines(
    mu0: float, mu: float, cos_g: float, tan_theta: float
) -> tuple[float, float, float]:
    """Effective cosines of incidence and emission, and the shadowing S, of a rough surface.

    mu0, mu   cosines of incidence and emission on the mean surface, both positive
    cos_g     cosine of phase
    Returns (mu0e, mue, S).
    """
    if tan_theta <= 0.0:
        return mu0, mu, 1.0
    sin_i = math.sqrt(max(1.0 - mu0 * mu0, 0.0))
    sin_e = math.sqrt(max(1.0 - mu * mu, 0.0))
    # psi has no meaning when either ray is vertical, and nothing depends on it there
    cos_psi = 1.0
    if sin_i * sin_e > 1e-9:
        cos_psi = min(max((cos_g - mu0 * mu) / (sin_i * sin_e), -1.0), 1.0)
    sin2_half = 0.5 * (1.0 - cos_psi)
    psi_over_pi = math.acos(cos_psi) / math.pi
    # f = exp(-2 tan(psi / 2))
    f = math.exp(-2.0 * math.sqrt(sin2_half / max(1.0 - sin2_half, 1e-12)))

    cot_theta = 1.0 / tan_theta
    chi = 1.0 / math.sqrt(1.0 + math.pi * tan_theta * tan_theta)
    cot_i = mu0 / max(sin_i, 1e-9)
    cot_e = mu / max(sin_e, 1e-9)
    e1_i, e2_i = _compute_e1_e2(cot_i, cot_theta)
    e1_e, e2_e = _compute_e1_e2(cot_e, cot_theta)
    eta_i = chi * (mu0 + sin_i * tan_theta * e2_i / (2.0 - e1_i))
    eta_e = chi * (mu + sin_e * tan_theta * e2_e / (2.0 - e1_e))
    if mu0 >= mu:  # i <= e: the facets that hide are tilted by the view
        below = 2.0 - e1_e - psi_over_pi * e1_i
        mu0e = chi * (mu0 + sin_i * tan_theta * (cos_psi * e2_e + sin2_half * e2_i) / below)
        mue = chi * (mu + sin_e * tan_theta * (e2_e - sin2_half * e2_i) / below)
        visible = chi / (1.0 - f + f * chi * mu0 / eta_i)
    else:
        below = 2.0 - e1_i - psi_over_pi * e1_e
        mu0e = chi * (mu0 + sin_i * tan_theta * (e2_i - sin2_half * e2_e) / below)
        mue = chi * (mu + sin_e * tan_theta * (cos_psi * e2_i + sin2_half * e2_e) / below)
        visible = chi / (1.0 - f + f * chi * mu / eta_e)
    return mu0e, mue, mue / eta_e * mu0 / eta_i * visible


@kernel
def reflectance_scalar(mu0: float, mu: float, cos_phase: float, surface: HapkeParameters) -> float:
    """Radiance factor (pi r) of one geometry; zero with the Sun or the camera below the surface."""
    if mu0 <= 0.0 or mu <= 0.0:
        return 0.0
    mu0e, mue, shadowing = compute_rough_cosines(mu0, mu, cos_phase, math.tan(surface.theta_bar))
    # far from the Sun's plane at grazing light the effective cosines may round to just below zero
    mu0e, mue = max(mu0e, 0.0), max(mue, 0.0)
    if mu0e + mue <= 0.0:
        return 0.0
    once = phase_function(cos_phase, surface.b, surface.c) * opposition_surge(
        cos_phase, surface.bs0, surface.hs
    )
    often = h_function(mu0e, surface.w) * h_function(mue, surface.w) - 1.0
    return surface.w / 4.0 * mu0e / (mu0e + mue) * (once + often) * max(shadowing, 0.0)


@kernel
def _evaluate_flat(cosines: FloatArray, surface: HapkeParameters) -> FloatArray:
    out = np.empty(cosines.shape[1])
    for i in range(out.size):
        out[i] = reflectance_scalar(cosines[0, i], cosines[1, i], cosines[2, i], surface)
    return out


def stack_cosines(mu0: ArrayLike, mu: ArrayLike, cos_phase: ArrayLike) -> FloatArray:
    """(3, ...) cosines of incidence, emission and phase, broadcast against each other."""
    return np.stack(np.broadcast_arrays(mu0, mu, cos_phase)).astype(np.float64)


def reflectance(
    mu0: ArrayLike, mu: ArrayLike, cos_phase: ArrayLike, surface: HapkeParameters
) -> FloatArray:
    """Radiance factor (pi times the bidirectional reflectance).

    mu0, mu, cos_phase  cosines of incidence, emission and phase; shapes broadcast
    surface             Hapke's parameters
    Returns the broadcast shape; zero where mu0 <= 0 or mu <= 0.
    """
    cosines = stack_cosines(mu0, mu, cos_phase)
    return _evaluate_flat(cosines.reshape(3, -1), surface).reshape(cosines.shape[1:])
