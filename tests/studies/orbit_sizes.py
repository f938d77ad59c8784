"""What the noise of orbits is chosen by: flights over fields with drawn errors, on a grid of sizes.

For each set of sizes the orbits through the same fixes are held against the truth. That one is best
with which errors of places, of states and of predictions are nearest to what is stated, in the
logarithm of the sigmas. Its numbers stand in configs/models/orbit.toml.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from optnav_cli.orbit.fit.motion import ArcMotion, OrbitNoiseSizes
from optnav_cli.orbit.fit.settings import NoiseSettings
from tests.studies.orbit_fits import AHEAD_H, Judged, OrbitFigure, moon, solved
from tests.studies.orbit_flights import day_fixes, rough_flights

ACROSS, ALONG, LOCAL = (1.0, 1.5, 2.0), (0.001, 0.003), (1.0, 1.4, 2.0)


def sizes(trials: int, seed: int) -> list[OrbitFigure]:
    """How far each set of sizes is off, the best set last."""
    count = max(trials // 3, 1)
    grid = [OrbitNoiseSizes(*one) for one in product(ACROSS, ALONG, LOCAL)]
    forces, judged = moon(50), [Judged() for _ in grid]
    for arc, whole, noise in rough_flights(seed, count):
        fixes = day_fixes(arc, noise)
        for k in range(0, len(grid), len(LOCAL)):
            # what is local moves neither the orbit nor its predictions: one fit for all
            fit = solved(forces, fixes, sizes=grid[k])
            judged[k].add(fit, arc, whole)
            states, rest = (
                fit.trajectory.states,
                fit.covariances - fit.problem.motion.local(fit.trajectory.states),
            )
            for other in range(k + 1, k + len(LOCAL)):
                local = ArcMotion(forces, NoiseSettings(), sizes=grid[other]).local(states)
                judged[other].add(replace(fit, covariances=rest + local), arc)
                judged[other].ahead.update(judged[k].ahead)
    scored = sorted(zip(grid, judged, strict=True), key=lambda pair: -_far_from_stated(pair[1]))
    return [
        OrbitFigure(_words(one, found), "nearest to 1", _far_from_stated(found), count)
        for one, found in scored
    ]


def _logs(found: Judged) -> list[float]:
    """Logarithms of stated sigmas over errors: places, states, predictions."""
    squares = [-0.5 * float(np.log(np.mean(s))) for s in (found.of_places, found.squares)]
    ahead = [found.ahead_m(hours) for hours in AHEAD_H]
    return [*squares, *(float(np.log(stated / error)) for error, stated in ahead)]


def _far_from_stated(found: Judged) -> float:
    """By which factor sigmas are off what they should be, rms of four kinds."""
    return float(np.exp(np.sqrt(np.mean(np.square(_logs(found))))))


def _words(one: OrbitNoiseSizes, found: Judged) -> str:
    parts = ("places", "states", *(f"{hours:.0f} h ahead" for hours in AHEAD_H))
    ratios = zip(parts, np.exp(_logs(found)), strict=True)
    shown = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios)
    return f"across {one.across:g}, along {one.along:g}, local {one.local:g}: sigmas of {shown}"
