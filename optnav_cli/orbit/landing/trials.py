"""Landings with drawn errors: transfer with navigation and corrections, descent, braking."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.body import Body
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.rotation import body_from_inertial
from catalog.errors import NoSolutionError
from catalog.geometry.vectors import perpendicular_basis
from catalog.terrain.mesh.rays import MeshRays
from catalog.terrain.mesh.refine import refine_shape
from catalog.terrain.mesh.shape import Shape, load_shape
from catalog.terrain.synthetic import fractal
from optnav_cli.orbit.landing.descent import (
    Departure,
    Site,
    Touchdown,
    VerticalDescent,
    check_clear,
    depart,
)
from optnav_cli.orbit.landing.navigation import (
    BeamRanges,
    GroundEstimate,
    RangeFix,
    RangeNavigator,
    SurfaceError,
    beams_about,
)
from optnav_cli.orbit.landing.rays import DigitalSurface
from optnav_cli.orbit.landing.settings import LandingSettings
from optnav_cli.orbit.qso.motion import MoonMotion, split
from optnav_cli.orbit.qso.search import QsoSearch, QsoStart
from optnav_cli.orbit.qso.settings import motion_of_moon

STEP_S = 60.0
QSO_DAYS = 1.0
MARGIN_M = 400.0  # about the feet of the descent's beams: the craft may stand so far aside
# Spacings of the surface's errors by their length, and their shares of the variance: least squares
# to the exponential correlation that the navigator takes, within 0.01 of it from 0.1 to 6 lengths.
SPACINGS, SHARES = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25), (0.071, 0.228, 0.320, 0.181, 0.088, 0.112)


@dataclass(frozen=True, eq=False)
class LandingTask:
    """Inputs that all trials of a landing have in common.

    nodes    (m, 3) of the ground, body frame: vertices of the model under the descent
    corners  (faces, 3) numbers of the nodes that are a face's corners, or -1
    """

    settings: LandingSettings
    motion: MoonMotion
    shape: Shape
    model: DigitalSurface
    site: Site
    departure: Departure
    before: FloatArray
    path: FloatArray
    nodes: FloatArray
    corners: IntArray


@dataclass
class LandingTrial:
    """One trial: the transfer's fix at the arrival and where the craft was.

    ground  at the task's nodes, by the last part of the transfer
    """

    number: int
    reason: str = ""
    state: FloatArray = field(default_factory=lambda: np.full(6, np.nan))
    fix: RangeFix | None = None
    ground: GroundEstimate | None = None
    arrival: FloatArray = field(default_factory=lambda: np.full(6, np.nan))
    covariance: FloatArray = field(default_factory=lambda: np.full((6, 6), np.nan))
    dv_m_s: float = 0.0
    steps: int = 0
    starts: int = 0

    @property
    def error(self) -> FloatArray:
        difference: FloatArray = self.arrival - self.state
        return difference

    @property
    def nees(self) -> float:
        return float(self.error @ np.linalg.solve(self.covariance, self.error)) / 6.0


def landing_task(settings: LandingSettings, moon: Body, beside: Path) -> LandingTask:
    """The nominal landing. Raises NoSolutionError where there is none, ConfigError, DataError."""
    section = settings.landing
    motion = motion_of_moon(settings.forces, moon, beside)
    # cut once: the cubics over its edges make flat faces round, whose slopes jump less
    shape = refine_shape(load_shape(settings.surface.mesh, beside, moon), 1)
    model = DigitalSurface(MeshRays(shape.vertices[shape.faces]), moon.radii_m)
    site = Site.at(np.radians(section.target_lat_deg), np.radians(section.target_lon_deg), model)
    begin = utc_to_tdb_s(section.time)
    before = _start_state(settings, motion, begin)
    aim = site.above(1e3 * section.aim_height_km)
    departure = depart(motion, before, begin, begin + section.transfer_s, aim)
    path = check_clear(motion, departure, model)
    widest = settings.beams.off_deg + settings.beams.lean_deg
    reach = 1e3 * section.aim_height_km * np.tan(np.radians(widest)) + MARGIN_M
    near = np.linalg.norm(shape.vertices - site.point, axis=1) < reach
    numbers = np.where(near, np.cumsum(near) - 1, -1)
    return LandingTask(
        settings, motion, shape, model, site, departure, before, path,
        shape.vertices[near], numbers[shape.faces],
    )  # fmt: skip


def _start_state(settings: LandingSettings, motion: MoonMotion, begin: float) -> FloatArray:
    given = settings.departure
    if given.position_m is not None and given.velocity_m_s is not None:
        return np.array([*given.position_m, *given.velocity_m_s])
    longitude = np.radians(settings.landing.target_lon_deg + given.lead_deg)
    start = QsoStart(1e3 * given.distance_km, float(longitude), begin)
    return QsoSearch(motion, start, QSO_DAYS).solve().state


def wrong_ground(task: LandingTask, seed: int) -> DigitalSurface:
    """The ground whose model the navigator has, with heights that are wrong alike over a length."""
    shape = task.shape
    length = task.settings.surface.error_length_m
    octaves = error_octaves(seed, length, task.motion.moon.radius_m)
    up = shape.vertices / np.linalg.norm(shape.vertices, axis=1)[:, None]
    sizes = surface_error(task).sigma(shape.vertices)
    vertices = shape.vertices + (sizes * fractal.sum_noise(octaves, up))[:, None] * up
    return DigitalSurface(MeshRays(vertices[shape.faces]), task.motion.moon.radii_m)


def error_octaves(seed: int, length_m: float, radius_m: float) -> fractal.Octaves:
    """Noise of size 1 on a sphere, alike over a length."""
    amplitudes = np.sqrt(SHARES) / fractal.RMS_NOISE
    return fractal.Octaves(seed, length_m * np.array(SPACINGS), amplitudes, radius_m)


def surface_error(task: LandingTask) -> SurfaceError:
    """Return the error of the model that the navigator assumes."""
    surface = task.settings.surface
    x, y, z = task.site.point.tolist()
    near = min(surface.near_error_m, surface.error_m)
    return SurfaceError(surface.error_m, surface.error_length_m, near, (x, y, z))


def start_covariance(settings: LandingSettings) -> FloatArray:
    """(6, 6) of the start: the lengths of [errors] over three components each."""
    errors = settings.errors
    sigma = np.array([1e3 * errors.position_km] * 3 + [errors.velocity_m_s] * 3) / np.sqrt(3.0)
    return np.diag(np.maximum(sigma, 1e-6) ** 2)


def measured_ranges(
    task: LandingTask,
    truth: DigitalSurface,
    states: tuple[FloatArray, FloatArray],
    times: FloatArray,
    rng: np.random.Generator,
) -> BeamRanges:
    """Ranges at times (n,) from the true one of two states (6,); beams stand by the known one."""
    beams = task.settings.beams
    turns = body_from_inertial(task.motion.moon, times)
    true, known = (
        np.einsum("nij,nj->ni", turns, task.motion.propagate(state, times, STEP_S)[:, :3])
        for state in states
    )
    axis = -known / np.linalg.norm(known, axis=1)[:, None]
    turned = np.radians(beams.roll_deg_s * (times - task.departure.tdb_s))
    rays = beams_about(axis, float(np.radians(beams.off_deg)), turned)
    hits = truth.cast(np.repeat(true, 4, axis=0), rays.reshape(-1, 3)).range_m.reshape(-1, 4)
    noise = beams.noise_m * rng.normal(size=hits.shape)
    return BeamRanges(times, rays, np.where(np.isfinite(hits), hits + noise, np.nan), beams.noise_m)


def burnt(
    change: FloatArray, settings: LandingSettings, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A velocity change (3,) as engines make it, as it is measured, and its covariance."""
    size = float(np.linalg.norm(change))
    if size == 0.0:
        return change, change, np.zeros((3, 3))
    unit = change / size
    basis = np.stack([unit, *perpendicular_basis(unit)])
    angle = np.radians(settings.errors.direction_deg)
    sigma = size * np.array([settings.errors.size, angle, angle])
    real: FloatArray = change + (sigma * rng.normal(size=3)) @ basis
    share = settings.errors.accelerometer * size
    measured: FloatArray = real + share * rng.normal(size=3)
    return real, measured, (share**2 + 1e-12) * np.eye(3)


def fly_transfer(task: LandingTask, truth: DigitalSurface, number: int) -> LandingTrial:
    """One transfer with its corrections; a trial without a fix says why."""
    settings, motion = task.settings, task.motion
    section = settings.landing
    rng = np.random.default_rng([section.seed, number])
    trial = LandingTrial(number)
    navigator = RangeNavigator(motion, task.model, surface_error(task))
    covariance = start_covariance(settings)
    known = task.before.copy()
    true = known + np.linalg.cholesky(covariance) @ rng.normal(size=6)
    change, at = task.departure.impulse, task.departure.tdb_s
    ends = [at + s for s in section.corrections_s] + [task.departure.arrival_s]
    aim = task.site.above(1e3 * section.aim_height_km)
    for end in ends:
        real, measured, wrong = burnt(change, settings, rng)
        true[3:] += real
        known[3:] += measured
        covariance[3:, 3:] += wrong
        trial.dv_m_s += float(np.linalg.norm(real))
        times = np.append(np.arange(at, end - 1.0, settings.beams.every_s), end)
        try:
            ranges = measured_ranges(task, truth, (true, known), times, rng)
            fix = navigator.fit(ranges, known, covariance, number)
            both = motion.propagate(fix.state, times[[0, -1]], STEP_S, transition=True)
            states, transitions = split(both)
            known, phi = states[1].copy(), transitions[1]
            covariance = phi @ fix.covariance @ phi.T
            if end == task.departure.arrival_s:
                trial.ground = navigator.ground(ranges, fix, task.nodes).moved(phi)
            true = motion.propagate(true, times[[0, -1]], STEP_S)[1].copy()
            at = end
            if end < task.departure.arrival_s:
                change = depart(motion, known, end, task.departure.arrival_s, aim).impulse
        except NoSolutionError as failed:
            trial.reason = str(failed)
            return trial
        trial.fix, trial.steps = fix, max(trial.steps, fix.steps)
        trial.starts = max(trial.starts, fix.starts)
    trial.state, trial.arrival, trial.covariance = true, known, covariance
    return trial


def fly_descents(task: LandingTask, truth: DigitalSurface, trials: list[LandingTrial]) -> Touchdown:
    """The descents of trials that have arrived."""
    axes, motion = task.site.axes, task.motion
    at = np.array([task.departure.arrival_s])
    turn = axes @ body_from_inertial(motion.moon, at)[0]
    half = body_from_inertial(motion.moon, at + 0.5) - body_from_inertial(motion.moon, at - 0.5)
    local = np.zeros((6, 6))
    local[:3, :3] = local[3:, 3:] = turn
    local[3:, :3] = axes @ half[0]
    origin = np.concatenate([axes @ task.site.point, np.zeros(3)])
    true, known = (
        np.array([getattr(trial, name) for trial in trials]) @ local.T - origin
        for name in ("state", "arrival")
    )
    grounds = [trial.ground for trial in trials if trial.ground is not None]
    known = np.hstack([known, [ground.mean for ground in grounds]])
    covariances = np.empty((len(trials), known.shape[1], known.shape[1]))
    covariances[:, :6, :6] = local @ np.array([trial.covariance for trial in trials]) @ local.T
    covariances[:, :6, 6:] = local @ np.array([ground.with_state for ground in grounds])
    covariances[:, 6:, :6] = covariances[:, :6, 6:].transpose(0, 2, 1)
    covariances[:, 6:, 6:] = [ground.covariance for ground in grounds]
    settings = task.settings
    gm = motion.pair.moon_gm
    descent = VerticalDescent(task.model, truth, task.site, settings, gm, task.corners)
    rng = np.random.default_rng([settings.landing.seed, 1 << 40])
    return descent.fly(true, known, covariances, rng)
