"""Orbits through series of picked pictures of the Earth: nodes, lens, clock, times.

For `study points`. The truth is pulled by J2 to J4, C22, S22, terms of full order and drag, and
flown by scipy's integrator; fits know neither drag nor C22 and S22.
Pictures are taken at 30 of 172 minutes, 37 deg off the nadir in any direction, from the height and
inclination of a station.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from catalog.arrays import FloatArray
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.geometry.rotations import rnb_axes
from catalog.geometry.vectors import angle_between
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.frames.run_settings import RunSettings, write_run_settings
from optnav_cli.orbit.fit.fit import OrbitFit
from optnav_cli.orbit.fit.folder import read_orbit
from optnav_cli.orbit.fit.known_orbit import picture_times
from optnav_cli.orbit.fit.output import write_orbit_folder
from optnav_cli.orbit.fit.parameters import UNOBSERVED
from optnav_cli.orbit.fit.predict import OrbitPath
from optnav_cli.orbit.fit.problem import OrbitFix, OrbitPrior
from optnav_cli.orbit.fit.settings import NoiseSettings, OrbitFitSettings, ParameterSettings
from tests.studies.orbit_fits import OrbitFigure, solved
from tests.studies.orbit_flights import LENS, TrueFlight, ephemeris_of, every, fly, sight_of

HEIGHT_M, INCLINATION_DEG, MINUTES, PICTURES = 420e3, 51.6, 172, 30
# Normalised, of EGM96 (Lemoine et al., NASA/TP-1998-206861), GM and radius of it.
GM_KM3_S2, RADIUS_KM = 398600.4415, 6378.1363
TRUE_TERMS = {
    (2, 0): (-4.84165371736e-4, 0.0),
    (2, 2): (2.43914352398e-6, -1.40016683654e-6),
    (3, 0): (9.57254173792e-7, 0.0),
    (4, 0): (5.39873863789e-7, 0.0),
    (3, 3): (7.21072657057e-7, 1.41435626958e-6),
    (4, 4): (-1.88481367449e-7, 3.08848036904e-7),
}
DRAG_M_S2 = 5e-7  # at 420 km
SERIES_M, PICKED_M = (3000.0, 3000.0, 4500.0), (220.0, 220.0, 190.0)  # across twice, up
CLOCK_S, NODE_DEG = 6.0, 0.01
TIMED_M = 300.0
OPEN_M, OPEN_M_S = 1e6, 1e3  # of a prior that states the node alone


@dataclass(frozen=True, eq=False)
class _Series:
    """A true flight over all minutes and fixes at some."""

    flight: TrueFlight
    fixes: list[OrbitFix]


class EarthFlights:
    """Forces of the truth and of the fits."""

    def __init__(self, folder: Path) -> None:
        ephemeris = ephemeris_of("earth")
        fewer = {term: value for term, value in TRUE_TERMS.items() if term != (2, 2)}
        self.true, self.fit = (
            Forces(ephemeris, ForcesSettings(degree=4, field=_field(folder / name, terms)))
            for name, terms in (("true.tab", TRUE_TERMS), ("fewer.tab", fewer))
        )

    def flight(self, rng: np.random.Generator) -> TrueFlight:
        """Fly an orbit of the station, a state each half minute."""
        start = _start(rng, self.true)
        speed = float(np.linalg.norm(start[3:]))

        def drag(_: float, y: FloatArray) -> FloatArray:
            force: FloatArray = -DRAG_M_S2 * y[3:] / speed
            return force

        return fly(self.true, start, every(0.5, MINUTES / 60.0), push=drag)

    def series(
        self, rng: np.random.Generator, sizes_m: Sequence[float], lens: float, clock_s: float
    ) -> _Series:
        """sizes_m: 1 sigma of fixes twice across and up; clock_s: pictures are so much later."""
        flight = self.flight(rng)
        kept = np.sort(rng.choice(MINUTES, PICTURES, replace=False))
        fixes = []
        for number in kept:
            time, state = float(flight.times[2 * number]), flight.states[2 * number]
            place = flight.ephemeris.body_from_inertial(time) @ state[:3]
            axes = rnb_axes(place, rng.normal(size=3))  # R is up
            spread = np.array([sizes_m[2], sizes_m[0], sizes_m[1]])
            sight = sight_of(place, axes[1], flight.body.radius_m)
            place = place + (spread * rng.normal(size=3)) @ axes + lens * sight
            covariance = (axes.T * spread**2) @ axes
            stamp = time - clock_s
            fixes.append(
                OrbitFix(
                    f"{number}.jpg",
                    utc_from_tdb_s(stamp),
                    stamp,
                    "run",
                    "tele",
                    place,
                    covariance,
                    sight_m=sight,
                )
            )
        return _Series(flight, fixes)

    def fitted(
        self,
        series: _Series,
        parameters: Sequence[ParameterSettings] = (),
        priors: Sequence[OrbitPrior] = (),
    ) -> OrbitFit:
        """The orbit through a series."""
        return solved(self.fit, series.fixes, parameters, NoiseSettings(), priors)


def _field(path: Path, terms: dict[tuple[int, int], tuple[float, float]]) -> str:
    lines = [f"{RADIUS_KM},{GM_KM3_S2},0,4,4,1,0,0"]
    for n in range(2, 5):
        for m in range(n + 1):
            c, s = terms.get((n, m), (0.0, 0.0))
            lines.append(f"{n},{m},{c:.12e},{s:.12e}")
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    return str(path.resolve())


def _start(rng: np.random.Generator, forces: Forces) -> FloatArray:
    """A state (6,) on a circular orbit of the station's height and inclination."""
    node, along = rng.uniform(0.0, 2.0 * np.pi, 2)
    tilt = np.radians(INCLINATION_DEG)
    turn = Rotation.from_euler("ZXZ", [node, tilt, along]).as_matrix()
    radius = forces.motion.body.radius_m + HEIGHT_M
    return np.concatenate([radius * turn[:, 0], np.sqrt(forces.gm / radius) * turn[:, 1]])


def _path(fit: OrbitFit, times: FloatArray) -> FloatArray:
    """States (n, 6) of a fit, inertial."""
    motion = fit.problem.motion_at(fit.trajectory)
    found: FloatArray = motion.path(fit.trajectory.states[0], float(fit.problem.times[0]), times)
    return found


def _offsets(fit: OrbitFit, flight: TrueFlight) -> FloatArray:
    """(n, 3) of the path along R, N, B, m."""
    states = _path(fit, flight.times)
    axes = np.array([rnb_axes(true[:3], true[3:]) for true in flight.states])
    found: FloatArray = (axes @ (states - flight.states)[:, :3, None])[:, :, 0]
    return found


def _nodes(fit: OrbitFit, flight: TrueFlight) -> list[float]:
    """How far the places where the path rises through the equator are off on the ground, m."""
    crossings = []
    for states in (_path(fit, flight.times), flight.states):
        fixed = [
            flight.ephemeris.body_from_inertial(float(time)) @ state[:3]
            for time, state in zip(flight.times, states, strict=True)
        ]
        crossings.append(_rises(flight.times, np.array(fixed)))
    found, true = crossings
    radius = flight.body.radius_m
    return [radius * min(float(angle_between(place, other)) for other in found) for place in true]


def _rises(times: FloatArray, fixed: FloatArray) -> FloatArray:
    """(k, 3), m, where a body-fixed path (n, 3) rises through z = 0."""
    path = CubicSpline(times, fixed)
    z = fixed[:, 2]
    found = []
    for k in np.flatnonzero((z[:-1] < 0.0) & (z[1:] >= 0.0)):
        ends = float(times[k]), float(times[k + 1])
        at = brentq(lambda t: float(path(t)[2]), *ends)
        found.append(np.asarray(path(at), np.float64))
    return np.array(found).reshape(-1, 3)


def _of_node(states: FloatArray) -> FloatArray:
    """(6,) derivative of the node's longitude by a state, rad."""
    steps = np.concatenate([np.full(3, 1.0), np.full(3, 1e-3)])
    found = np.empty(6)
    for k, step in enumerate(steps):
        sides = []
        for side in (step, -step):
            moved = states.copy()
            moved[k] += side
            across = np.cross(moved[:3], moved[3:])
            sides.append(np.arctan2(across[0], -across[1]))
        found[k] = (sides[0] - sides[1]) / (2.0 * step)
    return found


def _node_prior(flight: TrueFlight, rng: np.random.Generator) -> OrbitPrior:
    """A prior that states the node to NODE_DEG and the rest hardly."""
    state, sigma = flight.states[0], np.radians(NODE_DEG)
    by = _of_node(state)
    open_state = np.diag(np.repeat([OPEN_M**-2, OPEN_M_S**-2], 3))
    covariance = np.linalg.inv(open_state + np.outer(by, by) / sigma**2)
    off = np.linalg.cholesky(covariance) @ rng.normal(size=6)
    # the node alone is drawn: a first orbit as far off as the rest allows would be none
    angle = float(by @ off)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    about = np.concatenate([turn @ state[:3], turn @ state[3:]])
    return OrbitPrior(float(flight.times[0]), about, covariance, "node")


def series_figures(trials: int, seed: int) -> list[OrbitFigure]:
    """All rows."""
    with tempfile.TemporaryDirectory() as folder:
        earth = EarthFlights(Path(folder))
        return [
            *_random_errors(earth, trials, seed),
            *_lens(earth, trials, seed),
            *_clock(earth, trials, seed),
            *_times(earth, Path(folder), trials, seed),
        ]


def _random_errors(earth: EarthFlights, trials: int, seed: int) -> list[OrbitFigure]:
    nodes: list[float] = []
    for k in range(trials):
        series = earth.series(np.random.default_rng((seed, 1, k)), SERIES_M, 0.0, 0.0)
        nodes += _nodes(earth.fitted(series), series.flight)
    what = "30 of 172 pictures, errors of 3/3/4.5 km: places of ascending nodes, mean, km"
    return [
        OrbitFigure(what, "≤ 1", float(np.mean(nodes)) / 1e3, trials),
        OrbitFigure("the same, largest, km", "-", max(nodes) / 1e3, trials),
    ]


def _lens(earth: EarthFlights, trials: int, seed: int) -> list[OrbitFigure]:
    focal = ParameterSettings("focal", prior_sigma=0.01)
    found, sizes = [], []
    for k in range(trials):
        series = earth.series(np.random.default_rng((seed, 2, k)), PICKED_M, LENS, 0.0)
        fit = earth.fitted(series, [focal])
        off = _offsets(fit, series.flight)
        sizes.append((np.mean(np.linalg.norm(off[:, 1:], axis=1)), np.mean(np.abs(off[:, 0]))))
        sigma = float(np.sqrt(fit.parameter_covariance[0, 0]))
        found.append((float(fit.trajectory.parameters[0]) - LENS, sigma))
    across, up = (float(v) for v in np.mean(sizes, axis=0))
    error, sigma = (float(np.sqrt(np.mean(np.square(v)))) for v in zip(*found, strict=True))
    return [
        OrbitFigure("lens 0.9 % off and a parameter: across, mean, m", "≤ 150", across, trials),
        OrbitFigure("the same, radial, m", "≤ 60", up, trials),
        OrbitFigure("error of the lens, rms, %", "-", 100.0 * error, trials),
        OrbitFigure("its stated sigma, %", "0.007", 100.0 * sigma, trials),
    ]


def _clock(earth: EarthFlights, trials: int, seed: int) -> list[OrbitFigure]:
    clock = ParameterSettings("clock", prior_sigma=10.0)
    shares, nodes, sigmas, errors = [], [], [], []
    for k in range(trials):
        rng = np.random.default_rng((seed, 3, k))
        series = earth.series(rng, PICKED_M, 0.0, CLOCK_S)
        alone = earth.fitted(series, [clock])
        shares.append(float(np.sqrt(alone.parameter_covariance[0, 0])) / clock.sigma)
        nodes += _nodes(alone, series.flight)
        fit = earth.fitted(series, [clock], [_node_prior(series.flight, rng)])
        sigmas.append(float(np.sqrt(fit.parameter_covariance[0, 0])))
        errors.append(float(fit.trajectory.parameters[0]) - CLOCK_S)
    return [
        OrbitFigure(
            "a clock 6 s off without other knowledge: its sigma over the prior's",
            f"> {UNOBSERVED:g}: said",
            float(np.mean(shares)),
            trials,
        ),
        OrbitFigure(
            "the same: the path over the ground, nodes, km",
            "-",
            float(np.mean(nodes)) / 1e3,
            trials,
        ),
        OrbitFigure(
            "with a prior of the node of 0.01°: stated sigma, s",
            "≤ 2.5",
            float(np.mean(sigmas)),
            trials,
        ),
        OrbitFigure(
            "its error, rms, s", "≤ 2.5", float(np.sqrt(np.mean(np.square(errors)))), trials
        ),
    ]


def _times(earth: EarthFlights, folder: Path, trials: int, seed: int) -> list[OrbitFigure]:
    """Times of pictures whose places are good to 0.3 km, stamped to 20 s, by a known orbit."""
    rng = np.random.default_rng((seed, 4))
    exact = earth.series(rng, (10.0, 10.0, 10.0), 0.0, 0.0)
    fit = earth.fitted(exact)
    place = folder / "orbit"
    place.mkdir()
    forces = ForcesSettings(degree=4, field=earth.fit.settings.field)
    write_orbit_folder(place, fit, fit, OrbitFitSettings(forces=forces), ())
    write_run_settings(RunSettings("earth", "camera_from_body"), place)
    path, flight = OrbitPath(read_orbit(place)), exact.flight
    inner = rng.choice(np.arange(20, len(flight.times) - 20), max(trials, 20), replace=False)
    fixes, true = [], []
    for k in inner:
        time, state = float(flight.times[k]), flight.states[k]
        where = flight.ephemeris.body_from_inertial(time) @ state[:3]
        where = where + TIMED_M * rng.normal(size=3)
        stamp = time + 20.0 * float(rng.normal())
        utc, covariance = utc_from_tdb_s(stamp), TIMED_M**2 * np.eye(3)
        fixes.append(OrbitFix(f"{k}.jpg", utc, stamp, "run", "tele", where, covariance))
        true.append(time)
    timed = picture_times(path, fixes, 300.0)
    known = [(t.best, time) for t, time in zip(timed, true, strict=True) if t.best is not None]
    errors = [best.tdb_s - time for best, time in known]
    sigmas = [best.sigma_s for best, _ in known]
    count = len(known)
    return [
        OrbitFigure(
            "time of a picture, orbit known, position to 0.3 km: error, rms, s",
            "≤ 0.1",
            float(np.sqrt(np.mean(np.square(errors)))),
            count,
        ),
        OrbitFigure("its stated sigma, s", "0.04", float(np.mean(sigmas)), count),
    ]
