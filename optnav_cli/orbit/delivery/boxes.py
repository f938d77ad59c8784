"""The accuracy of a delivery to a target: a bound by boxes, and trials.

Source: Tuchin, thesis (2010), chapter 5, (21)-(23). The errors f = (xi, eta, tau) of an arrival are
a set, covered by boxes. A correction dv = -W^-1 (f + navigation error) takes f away; what the burn
does wrong, and the navigation's error, make the set that the next one has to correct. All errors
are bounded; so is the set, and all trials whose errors are cut at the same bounds lie inside.

The bound of a box is exact where the errors are linear in f: at its corners. Sums of sets are taken
axis by axis, which is more than the set itself: so the bound is some tenths larger than the trials.
Of the velocity change the boxes' corners are no measure: errors of one arc go together, and what a
correction leaves of them the next one takes away. Its bound is by directions: along each the most
that all errors add up to, each within its ellipsoid.
"""

from dataclasses import dataclass, replace

import numpy as np

from catalog.arrays import BoolArray, FloatArray
from catalog.bodies.body import Body
from catalog.bodies.epochs import DAY_S, utc_to_tdb_s
from catalog.errors import ConfigError, NoSolutionError
from optnav_cli.orbit.delivery.navigation import ArcMeasurements, arc_before
from optnav_cli.orbit.delivery.path import ReferencePath, TargetMotion, reference_path
from optnav_cli.orbit.delivery.settings import DeliverySettings
from optnav_cli.reasons import ReasonCode

CELLS = 24  # along each axis of a set
PIECES = 6  # along each axis of the injection's errors
MAX_CONDITION = 1e10  # of W with xi, eta in m and tau as the distance flown in it
DIRECTIONS = 1000  # of dv, that lie about a sphere so near that none is further off one than this:
NEXT_RAD = 2.8 / np.sqrt(DIRECTIONS)
SIGNS = np.array([[a, b, c] for a in (-1.0, 1.0) for b in (-1.0, 1.0) for c in (-1.0, 1.0)])
CHUNK = 20_000  # boxes at once
THRUST_STEPS = 60


@dataclass(frozen=True, eq=False)
class Correction:
    """A correction of the schedule.

    w          (3, 3) d (xi, eta, tau) by the velocity
    errors     (3, 3) covariance of (xi, eta, tau) by the navigation;  random  without what is
               considered
    unknown    (3, 3) covariance of what thrust adds since the one before, unknown to both
    condition  of w, tau as the distance flown in it
    """

    day: float
    w: FloatArray
    errors: FloatArray
    random: FloatArray
    unknown: FloatArray
    condition: float


@dataclass(frozen=True, eq=False)
class DeliveryTask:
    """Inputs that boxes and trials have in common."""

    settings: DeliverySettings
    path: ReferencePath
    injection: FloatArray
    corrections: tuple[Correction, ...]
    after: FloatArray
    arcs: tuple[ArcMeasurements, ...]

    @property
    def later(self) -> list[FloatArray]:
        """Covariances (3, 3) of the unknown thrust after each correction."""
        return [*(correction.unknown for correction in self.corrections[1:]), self.after]


@dataclass(frozen=True, eq=False)
class BoxStage:
    """The set of errors at one time: boxes of a grid, and the dv that led to each.

    low, step  (3,) m, m, s of the grid;  filled (CELLS, CELLS, CELLS);  spent as large, m/s
    dv_m_s     the largest of the correction that made it (0 for the injection)
    corners    (n, 8, 3) of the pieces that the boxes cover, where the next correction takes these:
               the injection's errors are a sheet, thin where W hardly reaches, of which boxes are a
               multiple
    """

    low: FloatArray
    step: FloatArray
    filled: BoolArray
    spent: FloatArray
    dv_m_s: float
    corners: FloatArray | None = None

    @property
    def middles(self) -> FloatArray:
        """(n, 3) of the boxes."""
        centres: FloatArray = self.low + (np.argwhere(self.filled) + 0.5) * self.step
        return centres

    @property
    def reach(self) -> FloatArray:
        """(3,) the largest xi, eta, tau of the set."""
        off = np.abs(self.middles) + 0.5 * self.step
        extent: FloatArray = off.max(axis=0)
        return extent

    def holds(self, points: FloatArray) -> BoolArray:
        """(n,) whether points (n, 3) lie in boxes."""
        cells = np.floor((points - self.low) / self.step).astype(np.int64)
        inside = ((cells >= 0) & (cells < CELLS)).all(axis=1)
        cells = np.clip(cells, 0, CELLS - 1)
        held: BoolArray = inside & self.filled[cells[:, 0], cells[:, 1], cells[:, 2]]
        return held


@dataclass(frozen=True, eq=False)
class TrialStages:
    """Trials: errors (n, 3) before each correction and at the arrival; dv (n,) of each."""

    errors: list[FloatArray]
    dv_m_s: list[FloatArray]

    @property
    def total(self) -> FloatArray:
        sums: FloatArray = np.sum(self.dv_m_s, axis=0)
        return sums


def delivery_task(settings: DeliverySettings, target: Body, where: str) -> DeliveryTask:
    """The reference path, its partials and the navigation at each correction.

    Raises NoSolutionError without such a path or measurements, ConfigError for a correction after
    the arrival or one at which W is singular.
    """
    section = settings.delivery
    begin = utc_to_tdb_s(section.start)
    aim, end = None, begin + 1.6 * section.corrections_days[-1] * DAY_S + 5.0 * DAY_S
    if settings.aim is not None:
        pericentre = utc_to_tdb_s(settings.aim.pericentre)
        aim = np.array([1e3 * settings.aim.xi_km, 1e3 * settings.aim.eta_km, pericentre])
        end = max(end, pericentre + 5.0 * DAY_S)
    motion = TargetMotion(target, section.centre, begin, end)
    state = 1e3 * np.array([*section.position_km, *section.velocity_km_s])
    times = begin + DAY_S * np.array([0.0, *section.corrections_days])
    path = reference_path(motion, state, np.append(times, end), aim)
    late = [d for d in section.corrections_days if begin + d * DAY_S >= path.pericentre_s]
    if late:
        raise ConfigError(
            f"{where}: [delivery] has a correction after {late[0]:g} days; the arrival at "
            f"{target.name} is after {(path.pericentre_s - begin) / DAY_S:.2f} days"
        )
    corrections, arcs = [], []
    before = 0.0
    for day in section.corrections_days:
        number = path.number_of(begin + day * DAY_S)
        partials = path.partials(number)
        arc = arc_before(path, settings, float(path.tdb_s[number]))
        random, every = arc.covariance()
        condition = _condition(partials[:, 3:], path.plane.speed_m_s)
        if not condition < MAX_CONDITION:
            raise ConfigError(
                f"{where}: [delivery] the correction after {day:g} days cannot change the arrival "
                f"(W has the condition {condition:.1e}); put it elsewhere"
            )
        corrections.append(
            Correction(
                day,
                partials[:, 3:],
                partials @ every @ partials.T,
                partials @ random @ partials.T,
                _thrust(path, settings, before, day),
                condition,
            )
        )
        arcs.append(arc)
        before = day
    entry_day = (float(path.tdb_s[path.entry]) - begin) / DAY_S
    after = _thrust(path, settings, before, entry_day)
    injection = path.partials(0)[:, 3:] @ _injection_axes(path, settings)
    return DeliveryTask(settings, path, injection, tuple(corrections), after, tuple(arcs))


def _condition(w: FloatArray, speed_m_s: float) -> float:
    sizes = np.linalg.svd(w * np.array([1.0, 1.0, speed_m_s])[:, None], compute_uv=False)
    return float(sizes[0] / sizes[-1]) if sizes[-1] > 0.0 else np.inf


def _injection_axes(path: ReferencePath, settings: DeliverySettings) -> FloatArray:
    """(3, 3): columns are 1 sigma of the injection's velocity along and across."""
    position, speed = path.states[0, :3], path.states[0, 3:]
    along = speed / np.linalg.norm(speed)
    across = np.cross(position, speed)
    across /= np.linalg.norm(across)
    injection = settings.injection
    sizes = np.array([injection.along_m_s, injection.across_m_s, injection.across_m_s])
    axes: FloatArray = np.stack([along, across, np.cross(along, across)], axis=1) * sizes
    return axes


def _thrust(
    path: ReferencePath, settings: DeliverySettings, begin_day: float, end_day: float
) -> FloatArray:
    """(3, 3) covariance of (xi, eta, tau) by wrong thrust between two days."""
    thrust = settings.thrust
    if thrust is None:
        return np.zeros((3, 3))
    first, last = max(begin_day, thrust.start_day), min(end_day, thrust.end_day)
    if last <= first:
        return np.zeros((3, 3))
    days = np.linspace(first, last, THRUST_STEPS + 1)
    middles = 0.5 * (days[1:] + days[:-1])
    times = path.tdb_s[0] + DAY_S * np.concatenate([[0.0], middles])
    states, transitions = path.motion.fly(path.states[0], times)
    moved = []
    for state, transition in zip(states[1:], transitions[1:], strict=True):
        ahead = path.from_transition(transition)
        along = state[3:] / np.linalg.norm(state[3:])
        across = np.cross(state[:3], along)
        across /= np.linalg.norm(across)
        angle = np.radians(thrust.direction_deg)
        axes = np.stack([along, across, np.cross(along, across)], axis=1)
        sizes = thrust.acceleration_m_s2 * np.array([thrust.size, angle, angle])
        moved.append(ahead[:, 3:] @ axes * sizes)
    step = (last - first) * DAY_S / THRUST_STEPS
    effects = np.array(moved) * step
    like = np.exp(-np.abs(middles[:, None] - middles) / thrust.correlation_days)
    spread: FloatArray = np.einsum("aik,ab,bjk->ij", effects, like, effects)
    return spread


def cover(task: DeliveryTask) -> list[BoxStage]:
    """Bound the sets of errors before each correction and at the arrival.

    Raises NoSolutionError where corrections make the errors larger than the path.
    """
    bound = task.settings.burns.bound_sigmas
    stages = [_injected(task, bound)]
    each, total = dv_bounds(task)
    for number, most in enumerate(each):
        stages.append(_corrected(task, stages[-1], number, most))
        check_reached(task, stages[-1], number)
    stages[-1] = replace(stages[-1], spent=np.minimum(stages[-1].spent, total))
    return stages


def check_reached(task: DeliveryTask, stage: BoxStage, number: int) -> None:
    """Check that the set that a correction leaves is small beside the path, as W supposes.

    Raises NoSolutionError.
    """
    start_m = float(np.linalg.norm(task.path.states[0, :3] - task.path.states[task.path.entry, :3]))
    reach_m = float(np.linalg.norm(stage.reach[:2]))
    if not reach_m < start_m:
        raise NoSolutionError(
            f"the errors grow without bound: {reach_m / 1e3:.3g} km after the correction of day "
            f"{task.corrections[number].day:g}, on a path of {start_m / 1e3:.3g} km; wanted "
            "measurements or burns that are more exact, or other days",
            ReasonCode.NO_SOLUTION,
        )


def dv_bounds(task: DeliveryTask) -> tuple[list[float], float]:
    """The largest dv of each correction and of all together, m/s.

    The dv of all is the sum along their directions, of which neighbours alone have errors in
    common: the most over all directions is found from the first correction to the last.
    """
    burns, corrections = task.settings.burns, task.corrections
    bound = burns.bound_sigmas
    size, aside = bound * burns.size, float(np.sin(bound * np.radians(burns.direction_deg)))
    ways = _directions()
    pulls = [ways @ np.linalg.inv(correction.w) for correction in corrections]

    def most(covariance: FloatArray, along: FloatArray) -> FloatArray:
        bounds: FloatArray = bound * np.linalg.norm(along @ _root(covariance), axis=-1)
        return bounds

    first, widen = corrections[0], 1.0 / float(np.cos(NEXT_RAD))
    spent = bound * np.abs(pulls[0] @ task.injection).sum(axis=1) + most(first.unknown, pulls[0])
    each = [widen * float((spent + most(first.errors, pulls[0])).max())]
    for before, correction, old, pull in zip(corrections, corrections[1:], pulls, pulls[1:]):
        burnt = pull @ before.w
        length = np.linalg.norm(burnt, axis=1)
        still = most(correction.unknown, pull) + bound * burns.fixed_m_s * length
        alone = still + each[-1] * float(np.hypot(size, aside)) * length
        alone += most(before.errors, pull) + most(correction.errors, pull)
        along = np.abs(burnt @ ways.T)
        across = np.sqrt(np.maximum(length[:, None] ** 2 - along**2, 0.0))
        off = NEXT_RAD * length[:, None]
        wrong = each[-1] * (size * (along + off) + aside * (across + off))
        both = most(before.errors, pull[:, None] - old)
        spent = still + (spent + both + wrong).max(axis=1)
        each.append(widen * float(alone.max()))
    total = widen * float((spent + most(corrections[-1].errors, pulls[-1])).max())
    return each, min(total, sum(each))


def _directions() -> FloatArray:
    """(DIRECTIONS, 3) unit vectors all about, on a spiral."""
    number = np.arange(DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * number / DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * number
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)


def _root(covariance: FloatArray) -> FloatArray:
    """(3, 3) that takes independent numbers of size 1 to errors of this covariance."""
    values, axes = np.linalg.eigh(covariance)
    root: FloatArray = axes * np.sqrt(np.maximum(values, 0.0))
    return root


def _injected(task: DeliveryTask, bound: float) -> BoxStage:
    """The injection's errors: each of three components within its bound."""
    places = (np.arange(PIECES) + 0.5) / PIECES * 2.0 - 1.0
    middles = bound * np.array([[a, b, c] for a in places for b in places for c in places])
    half = bound / PIECES * np.abs(task.injection).sum(axis=1)
    unknown = bound * np.sqrt(np.diag(task.corrections[0].unknown))
    centres = middles @ task.injection.T
    zero = np.zeros(len(centres))
    stage = _filled(centres - half - unknown, centres + half + unknown, zero, 0.0)
    corners = (middles[:, None] + bound / PIECES * SIGNS) @ task.injection.T
    if unknown.any():
        corners = (corners[:, :, None] + SIGNS * unknown).reshape(len(centres), -1, 3)
    return replace(stage, corners=corners)


def _corrected(task: DeliveryTask, stage: BoxStage, number: int, most: float) -> BoxStage:
    """The set that a correction leaves: what its burn does wrong, and the navigation's error.

    most  the largest dv that it can have, m/s
    """
    correction, unknown = task.corrections[number], task.later[number]
    burns = task.settings.burns
    bound = burns.bound_sigmas
    inverse = np.linalg.inv(correction.w)
    navigation = bound * np.sqrt(np.diag(correction.errors))
    angle = float(np.sin(bound * np.radians(burns.direction_deg)))
    fixed = bound * burns.fixed_m_s * np.linalg.norm(correction.w, axis=1)
    still = navigation + fixed + bound * np.sqrt(np.diag(unknown))
    rows = np.linalg.norm(correction.w, axis=1)
    lows, highs, spent = [], [], []
    if stage.corners is None:
        pieces = stage.middles[:, None] + SIGNS * (0.5 * stage.step + navigation)
        before = stage.spent[stage.filled]
    else:
        pieces = (stage.corners[:, :, None] + SIGNS * navigation).reshape(len(stage.corners), -1, 3)
        before = np.zeros(len(pieces))
    for first in range(0, len(pieces), CHUNK):
        corners = pieces[first : first + CHUNK]
        burn = corners @ inverse.T
        sizes = np.linalg.norm(burn, axis=2)
        dv = np.minimum(sizes.max(axis=1), most)
        # the size's error leaves a share of f itself; the direction's lies across the burn
        wrong = bound * burns.size * np.abs(corners).max(axis=1)
        along = np.einsum("nki,ji->nkj", burn, correction.w) / np.maximum(sizes, 1e-12)[..., None]
        any_direction = (np.sign(along.min(axis=1)) != np.sign(along.max(axis=1))) | (
            dv[:, None] > 2.0 * sizes.min(axis=1)[:, None]
        )
        least = np.abs(along).min(axis=1)
        across = np.where(
            any_direction, rows, np.sqrt(np.maximum(rows**2 - (0.9 * least) ** 2, 0.0))
        )
        reach = wrong + angle * dv[:, None] * across + still
        lows.append(-reach)
        highs.append(reach)
        spent.append(before[first : first + CHUNK] + dv)
    return _filled(np.concatenate(lows), np.concatenate(highs), np.concatenate(spent), most)


def _filled(lows: FloatArray, highs: FloatArray, spent: FloatArray, dv_m_s: float) -> BoxStage:
    """The boxes of a grid that sets between lows (n, 3) and highs touch, with the most spent."""
    low, high = lows.min(axis=0), highs.max(axis=0)
    step = np.maximum((high - low) / CELLS, 1e-9)
    filled = np.zeros((CELLS, CELLS, CELLS), bool)
    most = np.zeros((CELLS, CELLS, CELLS))
    begin = np.clip(np.floor((lows - low) / step).astype(np.int64), 0, CELLS - 1)
    end = np.clip(np.floor((highs - low) / step).astype(np.int64), 0, CELLS - 1) + 1
    ranges = np.unique(np.column_stack([begin, end]), axis=0, return_inverse=True)
    worst = np.zeros(len(ranges[0]))
    np.maximum.at(worst, ranges[1].ravel(), spent)
    for (a, b, c, x, y, z), value in zip(ranges[0].tolist(), worst.tolist(), strict=True):
        filled[a:x, b:y, c:z] = True
        part = most[a:x, b:y, c:z]
        np.maximum(part, value, out=part)
    return BoxStage(low, step, filled, most, dv_m_s)


def fly_deliveries(task: DeliveryTask, count: int, seed: int, cut: bool) -> TrialStages:
    """Trials with drawn errors; cut: none larger than the bound that the boxes have."""
    rng = np.random.default_rng(seed)
    burns = task.settings.burns
    bound = burns.bound_sigmas

    def drawn(width: int) -> FloatArray:
        sample: FloatArray = rng.standard_normal((count, width))
        return np.clip(sample, -bound, bound) if cut else sample

    def spread(covariance: FloatArray) -> FloatArray:
        """Errors (count, 3), cut within the ellipsoid of the bound."""
        unit = rng.standard_normal((count, 3))
        if cut:
            unit *= np.minimum(1.0, bound / np.linalg.norm(unit, axis=1))[:, None]
        errors: FloatArray = unit @ _root(covariance).T
        return errors

    f = drawn(3) @ task.injection.T + spread(task.corrections[0].unknown)
    errors, spent = [f], []
    for correction, more in zip(task.corrections, task.later, strict=True):
        inverse = np.linalg.inv(correction.w)
        known = spread(correction.errors)
        burn = -(f + known) @ inverse.T
        size = np.linalg.norm(burn, axis=1)[:, None]
        unit = burn / np.maximum(size, 1e-12)
        u = np.cross(unit, [0.6, 0.64, 0.48])
        u /= np.maximum(np.linalg.norm(u, axis=1), 1e-12)[:, None]
        aside = np.radians(burns.direction_deg) * rng.standard_normal((count, 2))
        length = np.linalg.norm(aside, axis=1)[:, None]
        if cut:
            most = bound * np.radians(burns.direction_deg)
            length, aside = np.minimum(length, most), aside * np.minimum(1.0, most / length)
        side = (aside[:, :1] * u + aside[:, 1:] * np.cross(unit, u)) / np.maximum(length, 1e-12)
        wrong = burns.size * drawn(1) * burn + np.sin(length) * size * side
        fixed = rng.standard_normal((count, 3))
        if cut:
            fixed *= np.minimum(1.0, bound / np.linalg.norm(fixed, axis=1))[:, None]
        wrong = wrong + burns.fixed_m_s * fixed
        f = -known + wrong @ correction.w.T + spread(more)
        errors.append(f)
        spent.append(size[:, 0])
    return TrialStages(errors, spent)


def biased_navigation(arc: ArcMeasurements, count: int, seed: int) -> FloatArray:
    """Errors (count, 6) of states from measurements with drawn noise and drawn shared errors."""
    rng = np.random.default_rng(seed)
    noise = arc.sigmas * rng.standard_normal((count, len(arc.sigmas)))
    wrong = noise + rng.standard_normal((count, arc.shared.shape[1])) @ arc.shared.T
    state_errors: FloatArray = wrong @ arc.gain().T
    return state_errors
