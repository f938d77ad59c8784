"""Landings on Phobos: impulse, rays, navigation, descent and touchdown, with drawn errors."""

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import load_body
from catalog.errors import NoSolutionError
from catalog.geometry.ellipsoid import compute_normals, project_to_surface
from catalog.geometry.vectors import perpendicular_basis
from catalog.progress import Progress, SilentProgress
from optnav_cli.orbit.landing.descent import Site, depart
from optnav_cli.orbit.landing.job import LandingResult, fly_trials
from optnav_cli.orbit.landing.navigation import MAX_STEPS, RangeNavigator
from optnav_cli.orbit.landing.rays import DigitalSurface
from optnav_cli.orbit.landing.settings import (
    LandingSettings,
    SurfaceSettings,
    load_landing_settings,
)
from optnav_cli.orbit.landing.trials import (
    STEP_S,
    LandingTask,
    landing_task,
    measured_ranges,
    start_covariance,
    surface_error,
    wrong_ground,
)
from optnav_cli.orbit.qso.motion import split
from optnav_cli.orbit.qso.search import QsoSearch, QsoStart
from tests.studies.landing_models import OnboardMotion, turning_state
from tests.studies.tables import Cell, StudyReport, StudyTable, columns, rms

RAYS = 3000
RIGHT_M = 1.0  # of exact casting: further off a ray has met other ground
DEPARTURES = 60
GROUNDS = 40  # of each row: trials over one ground err alike
MEASURED_S = 1500.0  # of the transfer of 30 min
WRONG = 28.0  # squared error over its covariance, 6 components: one in 10 000
IMPULSE = columns(
    "step; left = left to find, worst [m/s] .3g; median = median [m/s] .3g; asked = asked [m/s] .3g"
)
RAY = columns(
    "sample = rays; count = rays met .0f; settled = settled, right [%] .2f; "
    "steps = steps, mean .2f; most; median = off, median [m] .4f; p95 = 95 % [m] .3f; "
    "worst [m] .3f"
)
ARRIVAL = columns(
    "surface = start and error of the ground; trials; right = right in ≤ 5 steps [%] .1f; "
    "all = right [%] .1f; refused; wrong; error = arrival, rms [m] .1f; stated [m] .1f; "
    "p95 = 95 % [m] .1f; speed = velocity, rms [mm/s] .1f; nees = NEES .2f"
)
DESCENT = columns(
    "surface = error of the ground; trials; height = end: height, rms [m] .2f; "
    "stated_height = stated [m] .2f; side = side, rms [m] .2f; stated_side = stated [m] .2f; "
    "down = down, rms [mm/s] .2f; across = across, rms [mm/s] .1f; nees = NEES .2f"
)
TOUCHDOWN = columns(
    "surface = error of the ground; trials; landed; slowest = down, least [m/s] .2f; "
    "quickest = most [m/s] .2f; across = across, most [m/s] .2f; rms = from the target, rms [m] "
    ".1f; most = most [m] .1f; dv = burns, mean [m/s] .1f"
)
MODEL = columns(
    "distance = from the surface [km] g; place = place off [m] .1f; speed = velocity off [cm/s] .1f"
)


@dataclass(frozen=True, eq=False)
class LandingFigures:
    """Rows of the study's tables."""

    impulse: list[tuple[Cell, ...]]
    rays: list[tuple[Cell, ...]]
    arrival: list[tuple[Cell, ...]]
    descent: list[tuple[Cell, ...]]
    touchdown: list[tuple[Cell, ...]]
    model: list[tuple[Cell, ...]]


def run(progress: Progress, trials: int = 200, fits: int = 40, seed: int = 1) -> LandingFigures:
    """All tables; `fits` transfers a row of the arrival, `trials` landings a row of the rest."""
    shipped = load_landing_settings(Path("bundled:landing_phobos"))
    moon = load_body(shipped.landing.body)
    section = msgspec.structs.replace(shipped.landing, trials=trials, seed=seed)
    settings = msgspec.structs.replace(shipped, landing=section)
    task = landing_task(settings, moon, Path())
    with progress.stage("study landing", 11, "part") as bar:
        impulse = _impulse_rows(task, seed)
        bar.advance()
        rays = _ray_rows(task.model, seed)
        bar.advance()
        arrival = []
        for row in _arrival_settings(settings):
            arrival.append(_arrival_row(*row, fits))
            bar.advance()
        descent: list[tuple[Cell, ...]] = []
        touchdown: list[tuple[Cell, ...]] = []
        for name, other in _descent_settings(settings):
            flown = fly_trials(landing_task(other, moon, Path()), SilentProgress(), GROUNDS)
            descent.append(_descent_row(name, flown))
            touchdown.append(_touchdown_row(name, flown))
            bar.advance()
        model = _model_rows(task)
        bar.advance()
    return LandingFigures(impulse, rays, arrival, descent, touchdown, model)


def _with_surface(
    settings: LandingSettings, error_m: float, length_m: float, near_m: float, noise_m: float
) -> LandingSettings:
    surface = SurfaceSettings(error_m=error_m, error_length_m=length_m, near_error_m=near_m)
    beams = msgspec.structs.replace(settings.beams, noise_m=noise_m)
    return msgspec.structs.replace(settings, surface=surface, beams=beams)


def _arrival_settings(settings: LandingSettings) -> list[tuple[str, LandingSettings]]:
    near = msgspec.structs.replace(settings.errors, position_km=1.0)
    alike = _with_surface(settings, 20.0, 200.0, 20.0, 3.0)
    steady = msgspec.structs.replace(alike.beams, roll_deg_s=0.0, every_s=30.0)
    return [
        ("3 km, 1 m/s; none", _with_surface(settings, 1e-3, 200.0, 1e-3, 3.0)),
        (
            "3 km, 1 m/s; 20 m, independent a ray",
            _with_surface(settings, 1e-3, 200.0, 1e-3, float(np.hypot(20.0, 3.0))),
        ),
        ("3 km, 1 m/s; 20 m, alike over 200 m", alike),
        (
            "1 km, 1 m/s; 20 m, alike over 200 m",
            msgspec.structs.replace(alike, errors=near),
        ),
        ("3 km, 1 m/s; 20 m, alike over 1 km", _with_surface(settings, 20.0, 1000.0, 20.0, 3.0)),
        (
            "the same over 200 m, beams that do not turn, every 30 s",
            msgspec.structs.replace(alike, beams=steady),
        ),
    ]


def _descent_settings(settings: LandingSettings) -> list[tuple[str, LandingSettings]]:
    return [
        ("5 m, alike over 200 m", settings),
        (
            "5 m, independent a ray",
            _with_surface(settings, 1e-3, 200.0, 1e-3, float(np.hypot(5.0, 3.0))),
        ),
    ]


def _impulse_rows(task: LandingTask, seed: int) -> list[tuple[Cell, ...]]:
    """Departures from 50-61 km, 1-60 deg before the target, to 5-10 km over it in 30 min."""
    rng = np.random.default_rng(seed)
    motion = task.motion
    left: list[FloatArray] = []
    begin = task.departure.tdb_s
    while len(left) < DEPARTURES:
        lon = float(rng.uniform(0.0, 2.0 * np.pi))
        lead = np.radians(rng.uniform(1.0, 60.0))
        start = QsoStart(1e3 * float(rng.uniform(50.0, 61.0)), lon + float(lead), begin)
        site = Site.at(float(np.radians(rng.uniform(-20.0, 20.0))), lon, task.model)
        aim = site.above(1e3 * float(rng.uniform(5.0, 10.0)))
        try:
            state = QsoSearch(motion, start, 0.5).solve().state
            left.append(depart(motion, state, begin, begin + 1800.0, aim).errors_m_s())
        except NoSolutionError:
            continue
    found = np.array(left)
    asked = (0.2, 1e-3, 1e-4)
    return [
        (step + 1, float(found[:, step].max()), float(np.median(found[:, step])), asked[step])
        for step in range(3)
    ]


def _ray_rows(ground: DigitalSurface, seed: int) -> list[tuple[Cell, ...]]:
    """Rays from 0.5 to 60 km, by their angle to the ellipsoid's normal or to the centre."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(RAYS, 3))
    foot = project_to_surface(directions, ground.radii)
    up = compute_normals(foot, ground.radii)
    foot = foot - ground.height(foot)[:, None] * up
    height = 10.0 ** rng.uniform(np.log10(500.0), np.log10(6e4), RAYS)
    off = np.radians(rng.uniform(0.0, 45.0, RAYS))
    rays = _turned(-up, off, rng)
    steep = foot - (height / np.cos(off))[:, None] * rays
    out = foot / np.linalg.norm(foot, axis=1)[:, None]
    over = foot + height[:, None] * out
    rows: list[tuple[Cell, ...]] = []
    for name, origins, way in (
        ("≤ 45° to the ellipsoid's normal", steep, rays),
        ("≤ 45° off nadir, where they meet Phobos", over, _turned(-out, off, rng)),
    ):
        exact = ground.cast(origins, way)
        met = np.isfinite(exact.range_m)
        found = ground.settle(origins[met], way[met])
        off_m = np.abs(found.range_m - exact.range_m[met])
        right = found.settled & (off_m < RIGHT_M)
        every = np.abs(ground.ranges(origins[met], way[met]).range_m - exact.range_m[met])
        steps, wrong = found.steps[right], off_m[right]
        sizes = (float(np.median(wrong)), float(np.percentile(wrong, 95)), float(every.max()))
        shares = (100.0 * float(right.mean()), float(steps.mean()), int(steps.max()))
        rows.append((name, int(met.sum()), *shares, *sizes))
    return rows


def _turned(axes: FloatArray, angles: FloatArray, rng: np.random.Generator) -> FloatArray:
    around = rng.uniform(0.0, 2.0 * np.pi, len(axes))
    found = []
    for axis, angle, turn in zip(axes, angles, around, strict=True):
        u, v = perpendicular_basis(axis)
        side = np.cos(turn) * u + np.sin(turn) * v
        found.append(np.cos(angle) * axis + np.sin(angle) * side)
    return np.array(found)


def _arrival_row(name: str, settings: LandingSettings, fits: int) -> tuple[Cell, ...]:
    """Fits of one transfer each, every one over a ground of its own."""
    task = landing_task(settings, load_body(settings.landing.body), Path())
    navigator = RangeNavigator(task.motion, task.model, surface_error(task))
    covariance = start_covariance(settings)
    departure = task.departure
    times = departure.tdb_s + np.arange(0.0, MEASURED_S + 1.0, settings.beams.every_s)
    ends = np.array([departure.tdb_s, departure.arrival_s])
    errors, nees, steps, stated, refused = [], [], [], [], 0
    for number in range(fits):
        rng = np.random.default_rng([settings.landing.seed, number])
        truth = wrong_ground(task, 1000 * settings.landing.seed + number)
        true = departure.state + np.linalg.cholesky(covariance) @ rng.normal(size=6)
        ranges = measured_ranges(task, truth, (true, departure.state), times, rng)
        try:
            fix = navigator.fit(ranges, departure.state, covariance, number)
        except NoSolutionError:
            refused += 1
            continue
        states, transitions = split(task.motion.propagate(fix.state, ends, STEP_S, True))
        error = states[1] - task.motion.propagate(true, ends, STEP_S)[1]
        spread = transitions[1] @ fix.covariance @ transitions[1].T
        errors.append(error)
        nees.append(float(error @ np.linalg.solve(spread, error)))
        stated.append(float(np.trace(spread[:3, :3])))
        steps.append(fix.steps)
    off = np.array(errors).reshape(-1, 6)
    right = np.array(nees) < WRONG
    quick = right & (np.array(steps) <= 5)
    place = np.linalg.norm(off[right, :3], axis=1)
    shares = (100.0 * float(quick.sum()) / fits, 100.0 * float(right.sum()) / fits)
    says = float(np.sqrt(np.mean(np.array(stated)[right]))) if len(place) else None
    sizes = (rms(place), says, float(np.percentile(place, 95)) if len(place) else None)
    speed = 1e3 * rms(np.linalg.norm(off[right, 3:], axis=1))
    mean = float(np.mean(np.array(nees)[right])) / 6.0
    return (name, fits, *shares, refused, int((~right).sum()), *sizes, speed, mean)


def _descent_row(name: str, flown: LandingResult) -> tuple[Cell, ...]:
    ends = [down.end for _, down in flown.groups]

    def one(column: str) -> FloatArray:
        return np.concatenate([getattr(end, column) for end in ends])

    stated = np.sqrt(np.mean(one("stated_m") ** 2, axis=0)).tolist()
    lengths = (rms(one("height_m")), stated[0], rms(one("side_m")), stated[1])
    speeds = (1e3 * rms(one("rate_m_s")), 1e3 * rms(one("side_m_s")))
    return (name, len(one("nees")), *lengths, *speeds, float(one("nees").mean()))


def _touchdown_row(name: str, flown: LandingResult) -> tuple[Cell, ...]:
    rows = [row for row in flown.cells() if "east_m" in row]

    def one(column: str) -> FloatArray:
        return np.array([row[column] for row in rows], dtype=np.float64)

    away, down = np.hypot(one("east_m"), one("north_m")), one("down_m_s")
    speeds = (float(down.min()), float(down.max()), float(one("side_m_s").max()))
    places = (rms(away), float(away.max()), float(one("dv_m_s").mean()))
    return (name, len(flown.trials), len(rows), *speeds, *places)


def _model_rows(task: LandingTask) -> list[tuple[Cell, ...]]:
    """The on-board model against the difference of two paths after 30 min."""
    motion, begin = task.motion, task.departure.tdb_s
    onboard = OnboardMotion(motion)
    times = np.array([begin, begin + 1800.0])
    rows: list[tuple[Cell, ...]] = []
    for distance in (50.0, 55.0, 61.0):
        state = QsoSearch(motion, QsoStart(1e3 * distance, np.pi / 2.0, begin), 1.0).solve().state
        found, _ = onboard.propagate(turning_state(motion, begin, state), times)
        end = motion.propagate(state, times, STEP_S)[1]
        off = found[1] - turning_state(motion, float(times[1]), end)
        place, speed = float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:]))
        rows.append((distance, place, 100.0 * speed))
    return rows


def report(result: LandingFigures) -> StudyReport:
    """The tables."""
    return StudyReport(
        (
            StudyTable("Departure impulse: Newton's steps", IMPULSE, tuple(result.impulse)),
            StudyTable("Rays: iteration against exact casting", RAY, tuple(result.rays)),
            StudyTable("Navigation of a transfer", ARRIVAL, tuple(result.arrival)),
            StudyTable("The filter at 500 m", DESCENT, tuple(result.descent)),
            StudyTable("Touchdown", TOUCHDOWN, tuple(result.touchdown)),
            StudyTable("The on-board model (5) after 30 min", MODEL, tuple(result.model)),
        ),
        (
            "rays: settled within 1 m of casting, with their steps and errors; the worst is that "
            "of all, cast against the mesh where they do not settle or are flat",
            "asked: arrival ≤ 30 m, NEES 0.7-1.4, ≥ 95 % right in ≤ 5 steps and the rest refused; "
            "end of the descent ≤ 1 m of height, ≤ 8 m of side, ≤ 30 mm/s; touchdown 1.5-2 m/s "
            "down, < 1 m/s across, ≤ 100 m from the target",
            f"a fit may take {MAX_STEPS} steps from one start; {GROUNDS} grounds a row of "
            "landings, one a fit of a transfer; burns off by 1 % and 0.5°, accelerometers by 0.1 %",
        ),
    )
