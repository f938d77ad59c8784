"""Fits of the study of orbits, and what they add up to against the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.orbit.fit.fit import OrbitFit, fit_orbit
from optnav_cli.orbit.fit.motion import ArcMotion, OrbitNoiseSizes
from optnav_cli.orbit.fit.problem import OrbitFix, OrbitPrior, OrbitProblem
from optnav_cli.orbit.fit.settings import NoiseSettings, ParameterSettings
from tests.studies.orbit_flights import TrueFlight, ephemeris_of

GATE = 1e-5
AHEAD_H = (3.0, 12.0)


@dataclass(frozen=True)
class OrbitFigure:
    """A figure: what it measures, on how many flights, what is wanted, what was found."""

    what: str
    wanted: str
    found: float | None
    flights: int


@dataclass(frozen=True, eq=False)
class Judged:
    """Fits against their truth.

    squares   (flights,) mean normalised errors squared, a component of the state; of_places: of
              the place alone
    places    (n, 3) errors of places;  inside  their shares within 3 sigmas
    ahead     by hours: rows of squared error and of stated variance, a component
    """

    squares: list[float] = field(default_factory=list)
    of_places: list[float] = field(default_factory=list)
    places: list[FloatArray] = field(default_factory=list)
    inside: list[float] = field(default_factory=list)
    ahead: dict[float, list[tuple[float, float]]] = field(default_factory=dict)
    values: list[tuple[float, float]] = field(default_factory=list)

    def add(self, fit: OrbitFit, arc: TrueFlight, whole: TrueFlight | None = None) -> None:
        """A fit whose nodes are the times of an arc; predictions against the whole flight."""
        nodes = [int(np.argmin(np.abs(fit.problem.times - t))) for t in arc.times]
        errors = fit.trajectory.states[nodes] - arc.states
        covariances = fit.covariances[nodes]
        pairs = list(zip(errors, covariances, strict=True))
        squares = [float(e @ np.linalg.solve(p, e)) / 6.0 for e, p in pairs]
        sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))[:, :3]
        self.squares.append(float(np.mean(squares)))
        places = [float(e[:3] @ np.linalg.solve(p[:3, :3], e[:3])) / 3.0 for e, p in pairs]
        self.of_places.append(float(np.mean(places)))
        self.places.append(errors[:, :3])
        self.inside.append(float(np.mean(np.abs(errors[:, :3]) < 3.0 * sigmas)))
        for hours in AHEAD_H if whole is not None else ():
            self._predict(fit, whole, hours)

    def _predict(self, fit: OrbitFit, whole: TrueFlight | None, hours: float) -> None:
        if whole is None:
            return
        start = float(fit.problem.times[-1])
        k = int(np.argmin(np.abs(whole.times - start - 3600.0 * hours)))
        error, variance = predicted(fit, float(whole.times[k]), whole.states[k])
        self.ahead.setdefault(hours, []).append((float(error @ error) / 3.0, variance / 3.0))

    def ahead_m(self, hours: float) -> tuple[float, float]:
        """Error and stated sigma of predictions, rms a component, m."""
        error, stated = np.sqrt(np.mean(self.ahead[hours], axis=0))
        return float(error), float(stated)

    def rms_m(self) -> float:
        """Of places, a component."""
        return float(np.sqrt(np.mean(np.concatenate(self.places) ** 2)))


def predicted(fit: OrbitFit, tdb_s: float, truth: FloatArray) -> tuple[FloatArray, float]:
    """Error (3,) of a prediction, and the trace of its stated covariance."""
    problem = fit.problem
    names = [p.name for p in problem.estimated if p.name == "acceleration"]
    motion = problem.motion_at(fit.trajectory)
    start = float(problem.times[-1])
    step = motion.step(fit.trajectory.states[-1], start, tdb_s, names)
    width = step.by_parameters.shape[1]
    bring = np.concatenate([step.transition, step.by_parameters], axis=1)
    covariance = bring @ fit.last_covariance[: 6 + width, : 6 + width] @ bring.T + step.noise
    return step.state[:3] - truth[:3], float(np.trace(covariance[:3, :3]))


def solved(
    forces: Forces,
    fixes: Sequence[OrbitFix],
    parameters: Sequence[ParameterSettings] = (),
    noise: NoiseSettings | None = None,
    priors: Sequence[OrbitPrior] = (),
    sizes: OrbitNoiseSizes | None = None,
) -> OrbitFit:
    """The orbit through fixes."""
    noise = noise or NoiseSettings()
    motion = ArcMotion(forces, noise, sizes=sizes)
    radius = forces.motion.body.radius_m
    problem = OrbitProblem(motion, list(fixes), list(priors), list(parameters), radius)
    return fit_orbit(problem, noise.model, GATE)


def moon(degree: int) -> Forces:
    """The Moon's forces to a degree."""
    return Forces(ephemeris_of("moon"), ForcesSettings(degree=degree))
