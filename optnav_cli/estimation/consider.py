"""Errors that measurements share: considered in a covariance, or solved for beside the state.

Correlated errors that nobody states are seen in the residuals: a sandwich of the scores, as
statisticians call it, with Bartlett's triangle over the azimuth about the nadir.
"""

import numpy as np

from catalog.arrays import FloatArray
from catalog.geometry.kernel import kernel
from optnav_cli.estimation.least_squares import Estimate, Linearisation, mirrored

CORRELATION_DEG = 30.0  # errors of points farther apart count as independent
BINS = 72
MIN_LEFT = 0.05  # of a direction's scatter; the fit takes more of it on the shortest arcs
MIN_FREEDOM = 2.0


def considered(gain: FloatArray, errors: FloatArray) -> FloatArray:
    """Covariance (k, k) that shared errors leave in a state: considered, not estimated.

    gain (k, n) d state / d measurement;  errors (n, m) one sigma of each of m errors
    """
    moved = gain @ errors
    return moved @ moved.T


def correlated(gain: FloatArray, roots: FloatArray, correlation: FloatArray) -> FloatArray:
    """Add errors that measurements share to a covariance (k, k) of independent ones.

    gain (k, n d) d state / d measurement;  roots (n, d, d) Cholesky's of their covariances
    correlation (n, n) of their errors
    """
    count, size, _ = roots.shape
    moved = np.einsum("knd,nde->kne", gain.reshape(-1, count, size), roots)
    others = correlation - np.diag(np.diag(correlation))
    covariance: FloatArray = np.einsum("kne,nm,lme->kl", moved, others, moved, optimize=True)
    return covariance


def with_shared_errors(
    estimate: Estimate[FloatArray], errors: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """State (k,) and covariance (k, k) when measurements share errors of known shapes.

    errors (n, m)  one sigma of each of m errors of the first model's measurements

    The sizes of the errors are unknowns with a prior of one sigma, solved for beside the state:
    those that the residuals show are taken out, the others remain in the covariance. How much the
    residuals can show goes by the estimate's covariance, not by the stated noise.
    """
    measured = estimate.measured
    shift = measured.gain(estimate.noise) @ errors
    seen = errors - measured.jacobian @ shift  # what the fit leaves of each in the residuals
    excess = float(np.trace(np.linalg.solve(estimate.noise, estimate.covariance)))
    weighted = seen * (measured.weights / max(excess / len(shift), 1.0))[:, None]
    spread = np.linalg.inv(np.eye(seen.shape[1]) + weighted.T @ seen)
    sizes = spread @ (weighted.T @ measured.residuals)
    return estimate.state - shift @ sizes, estimate.covariance + shift @ spread @ shift.T


def azimuth_correlated(
    measured: Linearisation, noise: FloatArray, azimuths: FloatArray
) -> FloatArray:
    """Covariance (3, 3), m^2, of a position from angles, in no direction below the stated noise.

    noise     (3, 3) inverse of the fit's normal matrix
    azimuths  (n,)   rad about the nadir, -pi..pi
    """
    meat, expected, windows = _meat(
        measured.jacobian, measured.residuals, measured.weights, noise, azimuths
    )
    return _sandwich(noise, meat, expected, windows)


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
    rows: FloatArray,
    residuals: FloatArray,
    weights: FloatArray,
    inverse: FloatArray,
    azimuths: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """Products of scores, those apart weighted by Bartlett's triangle, and their expectation.

    The expectation is for errors of the stated size that bins do not share. With N_b the part of a
    bin in the normal matrix N, the fit leaves E g_b g_c' = (b = c) N_b - N_b inv(N) N_c.
    Returns both (3, 3), and how many windows of CORRELATION_DEG the points fill.
    """
    scores, normals = _binned(rows, residuals, weights, azimuths)
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
def _binned(
    rows: FloatArray, residuals: FloatArray, weights: FloatArray, azimuths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Scores (BINS, 3) and normal matrices (BINS, 3, 3) of the points in each bin of azimuth."""
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
    return scores, normals


@kernel
def _sandwich(
    noise: FloatArray, meat: FloatArray, expected: FloatArray, windows: float
) -> FloatArray:
    """Covariance (3, 3) from scores that are correlated over a window.

    In units of the stated noise the scatter of the scores is compared with what the fit would have
    left of it. Few windows give a bad estimate of a direction's scatter: half of the answer is that
    of all three together. It is raised for what so few may miss, and in no direction falls below
    the stated noise.
    """
    lower = np.linalg.cholesky(noise)
    upper = np.ascontiguousarray(lower.T)
    seen, left = upper @ meat @ lower, upper @ expected @ lower
    values, vectors = np.linalg.eigh(left)
    root = vectors / np.sqrt(np.maximum(values, MIN_LEFT)) @ vectors.T
    pooled = np.trace(seen) / max(np.trace(left), 3.0 * MIN_LEFT)
    observed = 0.5 * (root @ seen @ root + pooled * np.eye(3))
    observed *= 1.0 + 2.0 / max(1.5 * windows - 3.0, MIN_FREEDOM)
    values, vectors = np.linalg.eigh(0.5 * (observed + observed.T))
    raised = vectors * np.maximum(values, 1.0) @ vectors.T
    covariance: FloatArray = lower @ raised @ upper
    return covariance
