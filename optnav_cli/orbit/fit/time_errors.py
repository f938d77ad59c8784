"""Fixes whose times are known to a fraction of a second: the craft's way in it as an error of each.

A stamp wrong by d moves a fix by v d along the motion; stamps of whole seconds (EXIF) are wrong by
0.29 s, 1 sigma, which is 460 m along a low lunar orbit and 2.2 km about the Earth. The velocity is
that of a first orbit, itself through the fixes with as wide an error to all sides.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.orbit.fit.problem import OrbitFix, OrbitProblem, Trajectory

WHOLE_SECOND = re.compile(r".*:\d{2}:\d{2}(?:\.0*)?\s*(?:Z|UTC)?", re.IGNORECASE)
ROUNDED_S = 12.0**-0.5  # 1 sigma of times cut or rounded to whole seconds
HALF_S = 0.5


def with_time_errors(
    problem: OrbitProblem, start: Callable[[OrbitProblem], Trajectory]
) -> OrbitProblem:
    """Add what errors of the stamps do to the covariances of the fixes.

    start  finds a trajectory near the fixes of a problem
    """
    if not any(fix.time_sigma_s for fix in problem.fixes):
        return problem
    wide = []
    for number, fix in enumerate(problem.fixes):
        position = problem.inertial(number)
        speed = float(np.linalg.norm(position)) / problem.motion.radian_s(position)
        wide.append(_moved(fix, np.eye(3) * speed))
    rough = replace(problem, fixes=wide)
    speeds = body_fixed_speeds(rough, start(rough))
    timed = [_moved(fix, speed[:, None]) for fix, speed in zip(problem.fixes, speeds, strict=True)]
    return replace(problem, fixes=timed)


def _moved(fix: OrbitFix, by_second: FloatArray) -> OrbitFix:
    timing = (fix.time_sigma_s or 0.0) ** 2 * by_second @ by_second.T
    return replace(fix, covariance_m2=fix.covariance_m2 + timing, timing_m2=timing)


def body_fixed_speeds(problem: OrbitProblem, at: Trajectory) -> FloatArray:
    """Velocities (n, 3) of the fixes along a trajectory, as the body frame sees them, m/s."""
    speeds = np.empty((len(problem.fixes), 3))
    for number, node in enumerate(problem.node_of):
        state = at.states[node]
        turned = problem.turn(number, 0.5) - problem.turn(number, -0.5)
        speeds[number] = problem.turn(number) @ state[3:] + turned @ state[:3]
    return speeds


def are_whole_seconds(fixes: Sequence[OrbitFix]) -> bool:
    """Tell whether all stamps are of whole seconds, and nothing is stated of their errors."""
    return all(WHOLE_SECOND.fullmatch(fix.utc) and not fix.time_sigma_s for fix in fixes)


def with_whole_seconds(problem: OrbitProblem) -> OrbitProblem:
    """Give each fix the error of a stamp of whole seconds."""
    return replace(problem, fixes=[replace(fix, time_sigma_s=ROUNDED_S) for fix in problem.fixes])


def lie_within_half_a_second(
    problem: OrbitProblem, at: Trajectory, residuals_m: FloatArray
) -> bool:
    """Tell whether residuals (n, 3) of fixes are those of stamps of whole seconds.

    Along the motion they are at most what half a second makes, but for the errors of the fixes;
    they are wider there than across it.
    """
    speeds = body_fixed_speeds(problem, at)
    size = np.linalg.norm(speeds, axis=1)
    along = (residuals_m * speeds).sum(axis=1) / size
    across = np.linalg.norm(residuals_m - along[:, None] * speeds / size[:, None], axis=1)
    covariances = np.array([fix.sighted_m2 for fix in problem.fixes])
    sigmas = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    inside = np.abs(along - np.median(along)) < HALF_S * size + 3.0 * sigmas
    return bool(inside.all() and np.median(np.abs(along)) > np.median(across))
