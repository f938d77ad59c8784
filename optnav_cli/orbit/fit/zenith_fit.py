"""Fit an orbit through zenith distances of stars alone."""

import math
from collections.abc import Sequence

from catalog.arrays import FloatArray
from optnav_cli.orbit.fit.first import with_nodes
from optnav_cli.orbit.fit.fit import OrbitFit, fit_orbit, settle_fit
from optnav_cli.orbit.fit.motion import ArcMotion
from optnav_cli.orbit.fit.problem import OrbitPrior, OrbitProblem, Trajectory
from optnav_cli.orbit.fit.settings import ParameterSettings
from optnav_cli.orbit.fit.solver import OrbitSolver
from optnav_cli.orbit.fit.zenith import ZenithSights


def zenith_problem(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
    state: FloatArray,
    step_s: float = math.inf,
) -> OrbitProblem:
    """Prepare the problem with its nodes.

    state   (6,) of about the orbit, whose motion the nodes' distance follows
    step_s  nodes are no farther apart

    Raises NoSolutionError for an arc of too many nodes.
    """
    return with_nodes(_problem_of(motion, sights, priors, parameters), state, step_s)


def _problem_of(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
) -> OrbitProblem:
    radius = motion.ephemeris.body.radius_m
    return OrbitProblem(motion, [], list(priors), list(parameters), radius, sights=sights)


def fit_zenith(
    motion: ArcMotion,
    sights: ZenithSights,
    priors: Sequence[OrbitPrior],
    parameters: Sequence[ParameterSettings],
    gate_probability: float,
) -> OrbitFit:
    """Fit. Raises NoSolutionError where the sights leave the orbit open or fit none."""
    problem = _problem_of(motion, sights, priors, parameters)
    return fit_orbit(problem, "white", gate_probability)


def settled(problem: OrbitProblem, at: Trajectory, gate_probability: float) -> OrbitFit:
    """Fit from a trajectory near it. Raises NoSolutionError where the steps do not converge."""
    return settle_fit(OrbitSolver(problem, "white"), at, gate_probability)
