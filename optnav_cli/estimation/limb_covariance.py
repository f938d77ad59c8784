"""Covariance of a limb fit whose neighbouring points err together.

Relief and edge model err alike along a stretch of limb, so the covariance is a sandwich: scores
are summed over bins of azimuth about the nadir and correlated over CORRELATION_DEG. What the fit
has taken of them with its three unknowns is put back.
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel
from optnav_cli.estimation.symmetric import mirrored

CORRELATION_DEG = 30.0  # errors of points farther apart count as independent
BINS = 72
LEAST_LEFT = 0.05  # of a direction's scatter; the fit takes more of it on the shortest arcs
LEAST_FREEDOM = 2.0


def correlated_covariance(
    rates: FloatArray,
    residuals: FloatArray,
    information: FloatArray,
    noise_m2: FloatArray,
    azimuths: FloatArray,
) -> FloatArray:
    """Covariance (3, 3), m^2, in no direction below the stated noise.

    rates        (n, 3) d residual / d position, rad a m;  residuals (n,) rad
    information  (n,)   rad^-2, weight of each point in the fit
    noise_m2     (3, 3) inverse of the fit's normal matrix
    azimuths     (n,)   rad about the nadir, -pi..pi
    """
    meat, expected, windows = _meat(rates, residuals, information, noise_m2, azimuths)
    return np.asarray(_sandwich(noise_m2, meat, expected, windows))


@kernel
def azimuths_about_nadir(rays: FloatArray, position: FloatArray) -> FloatArray:
    """Azimuth (n,) of rays (n, 3) about the nadir, rad, from an origin fixed by the position."""
    u = position / np.sqrt((position * position).sum())
    least = np.argmin(np.abs(u))
    first = -u[least] * u
    first[least] += 1.0
    first /= np.sqrt((first * first).sum())
    second = np.cross(u, first)
    out = np.empty(rays.shape[0])
    for i in range(out.size):
        x = rays[i, 0] * first[0] + rays[i, 1] * first[1] + rays[i, 2] * first[2]
        y = rays[i, 0] * second[0] + rays[i, 1] * second[1] + rays[i, 2] * second[2]
        out[i] = np.arctan2(y, x)
    return out


@kernel
def _meat(
    rows: FloatArray, residuals: FloatArray, weights: FloatArray, inverse: FloatArray,
    azimuths: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:  # fmt: skip
    """Products of scores, those apart weighted by Bartlett's triangle, and their expectation.

    The expectation is for errors of the stated size that bins do not share. With N_b the part of a
    bin in the normal matrix N, the fit leaves E g_b g_c' = (b = c) N_b - N_b inv(N) N_c.
    Returns both (3, 3), and how many windows of CORRELATION_DEG the points fill.
    """
    scores, normals = np.zeros((BINS, 3)), np.zeros((BINS, 3, 3))
    for i in range(azimuths.size):
        at = int((azimuths[i] / (2.0 * np.pi) + 0.5) * BINS) % BINS
        for k in range(3):
            scaled = weights[i] * rows[i, k]
            scores[at, k] += scaled * residuals[i]
            for m in range(k, 3):
                normals[at, k, m] += scaled * rows[i, m]
    for i in range(BINS):
        mirrored(normals[i])
    reach = round(CORRELATION_DEG * BINS / 360.0)
    meat, expected, seen = np.zeros((3, 3)), np.zeros((3, 3)), 0
    score, normal = np.empty(3), np.empty((3, 3))
    for i in range(BINS):
        if normals[i, 0, 0] + normals[i, 1, 1] + normals[i, 2, 2] == 0.0:
            continue
        seen += 1
        score[:] = 0.0
        normal[:] = 0.0
        for lag in range(1 - reach, reach):
            share = 1.0 - abs(lag) / reach
            other = (i + lag) % BINS
            for k in range(3):
                score[k] += share * scores[other, k]
                for m in range(3):
                    normal[k, m] += share * normals[other, k, m]
        for k in range(3):
            for m in range(3):
                meat[k, m] += scores[i, k] * score[m]
                left = normals[i, k, m]
                for a in range(3):
                    for b in range(3):
                        left -= normals[i, k, a] * inverse[a, b] * normal[b, m]
                expected[k, m] += left
    return meat, expected, seen * (360.0 / BINS) / CORRELATION_DEG


@kernel
def _sandwich(
    noise: FloatArray, meat: FloatArray, expected: FloatArray, windows: float
) -> FloatArray:
    """Covariance (3, 3) from scores that are correlated over a window.

    In units of the stated noise the scatter of the scores is compared with what the fit would have
    left of it. Few windows know the scatter of a direction badly: half of the answer is that of
    all three together. It is raised for what an estimate from so few may miss, and in no
    direction falls below the stated noise.
    """
    lower = np.linalg.cholesky(noise)
    upper = np.ascontiguousarray(lower.T)
    seen, left = upper @ meat @ lower, upper @ expected @ lower
    values, vectors = np.linalg.eigh(left)
    root = vectors / np.sqrt(np.maximum(values, LEAST_LEFT)) @ vectors.T
    pooled = np.trace(seen) / max(np.trace(left), 3.0 * LEAST_LEFT)
    own = 0.5 * (root @ seen @ root + pooled * np.eye(3))
    own *= 1.0 + 2.0 / max(1.5 * windows - 3.0, LEAST_FREEDOM)
    values, vectors = np.linalg.eigh(0.5 * (own + own.T))
    raised = vectors * np.maximum(values, 1.0) @ vectors.T
    covariance: FloatArray = lower @ raised @ upper
    return covariance
