"""First orbits of zenith distances: circular ones whose directions fit them best.

cos(phi) = s . u(t) is linear in the vectors that the direction u of a nearly circular orbit of a
given mean motion is made of; the mean motion is searched, and Kepler's law gives the distance. Two
stars leave two directions, mirrored in their plane: both are returned.
"""

from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.orbit.fit.zenith import ZenithSights

# Of the mean motion: no orbit is lower than this share of the radius; steps in radians at the ends.
LOWEST, STEP_RAD = 0.97, 0.4
MAX_RAD = 120.0  # of the lowest orbit's motion: what is looked at of a long arc
MAX_USED = 300  # sights
# What a direction may differ from the model's, and its vectors but the first two: small orbits'
# eccentricities.
MODEL_ERROR, ECCENTRIC = 3e-3, 0.1
FLAT = 1e-6  # of the stars' moments: below it they lie in one plane
SHAPE_ERROR = 0.1
MAX_FOUND = 4


@dataclass(frozen=True, eq=False)
class FirstOrbit:
    """A state (6,) at a time, inertial, and how badly its model fits."""

    tdb_s: float
    state: FloatArray
    cost: float


def first_orbits(sights: ZenithSights, gm: float, radius_m: float) -> list[FirstOrbit]:
    """Circular orbits that may have the sights, the best one first; of two stars in mirrored pairs.

    The sights are of two stars or more.
    """
    fastest = float(np.sqrt(gm / (LOWEST * radius_m) ** 3))
    times = sights.tdb_s - sights.tdb_s[0]
    inside = np.flatnonzero(times <= MAX_RAD / fastest)
    used = inside[np.unique(np.linspace(0, len(inside) - 1, MAX_USED).round().astype(int))]
    times, stars = times[used], sights.directions[used]
    middle = 0.5 * float(times[-1])
    since, cosines = times - middle, np.cos(sights.values_rad[used])
    steps = max(int(np.ceil(fastest * float(times[-1]) / STEP_RAD)), 4)
    rates = fastest * np.arange(1, steps + 1) / steps
    vectors, costs = _fitted(rates, since, stars, cosines)
    moments, axes = np.linalg.eigh(stars.T @ stars / len(stars))
    across = axes[:, 0] if moments[0] < FLAT else None
    candidates = []
    for k, rate in enumerate(rates):
        for cosine_axis, sine_axis in _pairs(vectors[k, 1], vectors[k, 2], across):
            off = [
                float(cosine_axis @ cosine_axis) - 1.0,
                float(sine_axis @ sine_axis) - 1.0,
                2.0 * float(cosine_axis @ sine_axis),
            ]
            cost = float(costs[k]) + float(np.square(off).sum()) / SHAPE_ERROR**2
            left, _, right = np.linalg.svd(np.array([cosine_axis, sine_axis]), full_matrices=False)
            first, second = left @ right
            size = float(gm / rate**2) ** (1.0 / 3.0)
            state = np.concatenate([size * first, size * rate * second])
            candidates.append(FirstOrbit(float(sights.tdb_s[0]) + middle, state, cost))
    return sorted(candidates, key=lambda orbit: orbit.cost)[:MAX_FOUND]


def _fitted(
    rates: FloatArray, since: FloatArray, stars: FloatArray, cosines: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Vectors (k, 5, 3) of 1, cos, sin, cos and sin of twice, and costs (k,) of each rate."""
    angle = rates[:, None] * since
    basis = np.ones((*angle.shape, 5))
    basis[..., 1], basis[..., 2] = np.cos(angle), np.sin(angle)
    basis[..., 3], basis[..., 4] = np.cos(2.0 * angle), np.sin(2.0 * angle)
    rows = (basis[..., None] * stars[:, None]).reshape(len(rates), len(since), 15)
    ridge = np.repeat([ECCENTRIC, 1.0, 1.0, ECCENTRIC, ECCENTRIC], 3) ** -2.0
    normal = rows.transpose(0, 2, 1) @ rows / MODEL_ERROR**2 + np.diag(ridge)
    right = rows.transpose(0, 2, 1) @ cosines / MODEL_ERROR**2
    solution = np.linalg.solve(normal, right[..., None])[..., 0]
    residuals = (rows @ solution[..., None])[..., 0] - cosines
    costs = (residuals**2).sum(axis=1) / MODEL_ERROR**2 + (solution**2 * ridge).sum(axis=1)
    return np.asarray(solution.reshape(-1, 5, 3), np.float64), np.asarray(costs, np.float64)


def _pairs(
    first: FloatArray, second: FloatArray, across: FloatArray | None
) -> list[tuple[FloatArray, FloatArray]]:
    """The two axes; where the stars lie in a plane, with what lies across it, either way."""
    if across is None:
        return [(first, second)]
    first, second = first - (first @ across) * across, second - (second @ across) * across
    a, b = (float(np.sqrt(max(1.0 - float(v @ v), 0.0))) for v in (first, second))
    sign = -1.0 if float(first @ second) > 0.0 else 1.0
    return [(first + side * a * across, second + side * sign * b * across) for side in (1.0, -1.0)]
