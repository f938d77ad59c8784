"""Orbits about the Earth through picked points by a lens that is off, for `study points`.

Unlike the other series, places are no drawn errors: each picture's points, geodetic on WGS 84, are
solved as `optnav navigate` solves them, with a focal length that is stated 0.5 % too long.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import load_body
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.geometry.ellipsoid import geodetic_from_xyz
from optnav_cli.dynamics.forces import Forces
from optnav_cli.dynamics.orbit_settings import ForcesSettings
from optnav_cli.frames.frames import Frame
from optnav_cli.frames.points import PickedPoint
from optnav_cli.frames.run_settings import FileAttitude, PointsSettings
from optnav_cli.orbit.fit.lens import sight_of
from optnav_cli.orbit.fit.problem import OrbitFix
from optnav_cli.orbit.fit.settings import ParameterSettings
from optnav_cli.points.method import PickedFrames
from tests.studies.orbit_fits import OrbitFigure, solved
from tests.studies.orbit_flights import TrueFlight, ephemeris_of
from tests.studies.picked_orbits import MINUTES, EarthFlights
from tests.studies.picked_pictures import CAMERA, picked_picture

LENS, LENS_SIGMA = 0.005, 0.01  # stated focal length over the true one, less 1; its prior
OFF_DEG, PLACE_M = 37.0, 10.0
MAX_FLIGHTS = 12  # of each case


@dataclass(frozen=True)
class PickedCase:
    """Pictures of a flight, points of each, and how well these are picked, px."""

    pictures: int
    points: int
    pick_px: float

    @property
    def words(self) -> str:
        """The case for people."""
        picked = f"{self.points} points picked to {self.pick_px:g} px"
        return f"lens 0.5 % off, {self.pictures} pictures, {picked}"


CASES = (PickedCase(30, 20, 0.7), PickedCase(30, 6, 2.0), PickedCase(12, 6, 2.0))


@dataclass(frozen=True)
class LensTrial:
    """A flight: its fixes, median error and stated sigma of places, m, and the lens in sigmas."""

    fixes: int
    error_m: float
    sigma_m: float
    lens_sigmas: float
    lens_sigma: float


def picked_lens_figures(trials: int, seed: int) -> list[OrbitFigure]:
    """Rows of the study over some flights of each case, at most MAX_FLIGHTS."""
    with tempfile.TemporaryDirectory() as folder:
        earth = EarthFlights(Path(folder))
        rows = []
        for number, case in enumerate(CASES):
            done = [
                lens_trial(earth, np.random.default_rng((seed, 5, number, k)), case)
                for k in range(min(trials, MAX_FLIGHTS))
            ]
            rows += _rows(case, done)
    return rows


def _rows(case: PickedCase, done: Sequence[LensTrial]) -> list[OrbitFigure]:
    count, off = len(done), np.array([abs(trial.lens_sigmas) for trial in done])
    solved_share = 100.0 * sum(trial.fixes for trial in done) / (case.pictures * count)
    errors, sigmas = [t.error_m for t in done], [t.sigma_m for t in done]
    lens_sigma = 100.0 * float(np.median([trial.lens_sigma for trial in done]))
    return [
        OrbitFigure(f"{case.words}: solved, %", "100", solved_share, count),
        OrbitFigure("place on the orbit, median, m", "≤ 300", float(np.median(errors)), count),
        OrbitFigure("the same, largest median of a flight, m", "-", max(errors), count),
        OrbitFigure("the same by the covariance, rms, m", "-", float(np.median(sigmas)), count),
        OrbitFigure("error of that lens in sigmas, rms", "1", _rms(off), count),
        OrbitFigure("the same inside 2 sigmas, %", "95", 100.0 * float((off < 2.0).mean()), count),
        OrbitFigure("its stated sigma, %", "-", lens_sigma, count),
    ]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def lens_trial(earth: EarthFlights, rng: np.random.Generator, case: PickedCase) -> LensTrial:
    """Fly, take and solve pictures, fit the orbit with the focal length by the Earth's own file."""
    flight = earth.flight(rng)
    numbers = np.sort(rng.choice(MINUTES, case.pictures, replace=False))
    tried = [_picked_fix(flight, 2 * int(k), rng, case) for k in numbers]
    fixes = [fix for fix in tried if fix is not None]
    forces = Forces(ephemeris_of("earth"), ForcesSettings())
    fit = solved(forces, fixes, [ParameterSettings("focal", prior_sigma=LENS_SIGMA)])
    nodes = [int(np.argmin(np.abs(flight.times - time))) for time in fit.problem.times]
    errors = np.linalg.norm((fit.trajectory.states - flight.states[nodes])[:, :3], axis=1)
    traces = np.trace(fit.covariances[:, :3, :3], axis1=1, axis2=2)
    sigma = float(np.sqrt(fit.parameter_covariance[0, 0]))
    return LensTrial(
        len(fixes),
        float(np.median(errors)),
        float(np.median(np.sqrt(traces))),
        (float(fit.trajectory.parameters[0]) - LENS) / sigma,
        sigma,
    )


def _picked_fix(
    flight: TrueFlight, number: int, rng: np.random.Generator, case: PickedCase
) -> OrbitFix | None:
    """Solve a picture from a state of the flight; None where it has no solution."""
    body, time = load_body("earth"), float(flight.times[number])
    place = flight.ephemeris.body_from_inertial(time) @ flight.states[number, :3]
    focal = 1.0 / (1.0 + LENS)
    picture = picked_picture(body, rng, case.points, OFF_DEG, focal, position_m=place)
    pixels = picture.pixels + rng.normal(0.0, case.pick_px, (case.points, 2))
    ground = picture.places_m + rng.normal(0.0, PLACE_M, (case.points, 3))
    lat, lon, heights = geodetic_from_xyz(ground, body.radii_m)
    latlon = np.degrees(np.column_stack([lat, lon]))
    points = [
        PickedPoint("a", str(n), pixels[n], latlon[n], float(heights[n]), case.pick_px, PLACE_M)
        for n in range(case.points)
    ]
    attitude = FileAttitude("camera_from_body", body)
    settings = PointsSettings("geodetic", "ellipsoid")
    frames = PickedFrames(attitude, settings, judges_lens=False)
    utc, camera = utc_from_tdb_s(time), CAMERA
    fix = frames.solve(Frame(f"{number}.jpg", utc, camera.name), camera, points).fix
    if fix is None:
        return None
    sight = sight_of(fix, body.radius_m)
    where, covariance = fix.position_m, fix.covariance_m2
    method = str(fix.method)
    return OrbitFix(
        f"{number}.jpg", utc, time, "run", camera.name, where, covariance, method, sight
    )
