"""Motion about a body, integrated in one compiled loop: state, transition and force parameters.

DOP853, the Runge-Kutta method of order 8 of Hairer, Norsett and Wanner ("Solving Ordinary
Differential Equations I", 2nd ed., II.5), coefficients and step control as in scipy. The step is
chosen by the six components of the state alone; every time that is asked for is stepped on.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.integrate import DOP853

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.kernel import kernel
from optnav_cli.dynamics.gravity_kernel import gradient, pull

STAGES = len(DOP853.B)
_A = np.zeros((STAGES + 1, STAGES))  # the step itself as the last stage
_A[:STAGES], _A[STAGES] = DOP853.A, DOP853.B
_C = np.append(DOP853.C, 1.0)
_E3 = np.ascontiguousarray(DOP853.E3)
_E5 = np.ascontiguousarray(DOP853.E5)
# 0.1 mm and 0.1 um/s a step, far below any fix.
RELATIVE = 1e-11
PLACE_M, SPEED_M_S = 1e-4, 1e-7
SAFETY, MIN_FACTOR, MAX_FACTOR = 0.9, 0.2, 10.0
MAX_STEPS = 2_000_000
MIN_STEP_S = 1e-9
# First steps, in radians of a circular orbit: about those that low orbits then have.
SMOOTH_STEP_RAD, ROUGH_STEP_RAD = 0.15, 0.045
OBLATE_ROWS = 4  # factors of a table of degree 2
MIN_RADII = 0.5  # below it a series of high degree runs away
SUNLIGHT_N_M2 = 4.5398e-6  # pressure at 1 AU: 1361 W/m2 over the speed of light
AU_M = 149597870700.0
SUN_RADIUS_M = 6.957e8
FOLLOWED, TOO_DEEP, TOO_LONG = 0, 1, 2


class ArcWorld(NamedTuple):
    """All that moves a craft over an arc, as the kernels take it; times are seconds past its start.

    gm, radius_m                of the field
    pull_table, gradient_table  as `harmonic_tables` gives them
    start_s, spacing_s          of the tables below
    rotations, turns, places    as `ArcTables` gives them; the Sun is the last of the neighbours
    gms, radii_m                (n,) of the neighbours
    body_radius_m               of the shadow
    sunlight                    area over mass times reflectivity, m^2/kg
    sees_sunlight               whether its pressure is needed: it, or a derivative by it
    """

    gm: float
    radius_m: float
    pull_table: tuple[FloatArray, FloatArray]
    gradient_table: tuple[FloatArray, FloatArray]
    start_s: float
    spacing_s: float
    rotations: FloatArray
    turns: FloatArray
    places: FloatArray
    gms: FloatArray
    radii_m: FloatArray
    body_radius_m: float
    sunlight: float
    sees_sunlight: bool


@kernel
def _interpolated(coefficients: FloatArray, share: float, out: FloatArray) -> None:
    """Write a polynomial (6, n) at a share of its interval into `out` (n,)."""
    for i in range(out.shape[0]):
        total = coefficients[5, i]
        for power in range(4, -1, -1):
            total = total * share + coefficients[power, i]
        out[i] = total


@kernel
def _rotation(first: FloatArray, vector: FloatArray, out: FloatArray) -> None:
    """Write the rotation (3, 3) that a rotation vector (3,) makes of another (3, 3)."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle > 1e-4:
        one, two = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    else:
        one, two = 1.0 - square / 6.0, 0.5 - square / 24.0
    for column in range(3):
        a, b, c = first[0, column], first[1, column], first[2, column]
        p, q, r = y * c - z * b, z * a - x * c, x * b - y * a
        out[0, column] = a + one * p + two * (y * r - z * q)
        out[1, column] = b + one * q + two * (z * p - x * r)
        out[2, column] = c + one * r + two * (x * q - y * p)


@kernel
def lit_share(from_sun: FloatArray, from_body: FloatArray, sun_m: float, body_m: float) -> float:
    """Share of the Sun's disc that a sphere leaves in view.

    from_sun, from_body  (3,) of the craft from both centres, m;  sun_m, body_m  radii
    Source: Montenbruck and Gill, "Satellite Orbits", 3.4.2.
    """
    to_sun = math.sqrt(from_sun[0] ** 2 + from_sun[1] ** 2 + from_sun[2] ** 2)
    to_body = math.sqrt(from_body[0] ** 2 + from_body[1] ** 2 + from_body[2] ** 2)
    if to_body <= body_m or to_sun <= sun_m:
        return 0.0
    along = from_sun[0] * from_body[0] + from_sun[1] * from_body[1] + from_sun[2] * from_body[2]
    apart = math.acos(max(-1.0, min(1.0, along / (to_sun * to_body))))
    a, b = math.asin(sun_m / to_sun), math.asin(body_m / to_body)
    if apart >= a + b:
        return 1.0
    if apart <= b - a:
        return 0.0
    if apart <= a - b:
        return 1.0 - (b / a) ** 2
    x = (apart * apart + a * a - b * b) / (2.0 * apart)
    y = math.sqrt(max(a * a - x * x, 0.0))
    covered = a * a * math.acos(max(-1.0, min(1.0, x / a)))
    covered += b * b * math.acos(max(-1.0, min(1.0, (apart - x) / b))) - apart * y
    return 1.0 - covered / (math.pi * a * a)


@kernel
def path_axes(state: FloatArray, out: FloatArray) -> None:
    """Write R, N, B (3, 3), a row each, of a state (6,); N and B zero on a straight fall."""
    x, y, z, u, v, w = state[0], state[1], state[2], state[3], state[4], state[5]
    r = math.sqrt(x * x + y * y + z * z)
    hx, hy, hz = y * w - z * v, z * u - x * w, x * v - y * u
    h = math.sqrt(hx * hx + hy * hy + hz * hz)
    out[0, 0], out[0, 1], out[0, 2] = x / r, y / r, z / r
    if h == 0.0:
        out[1:] = 0.0
        return
    out[2, 0], out[2, 1], out[2, 2] = hx / h, hy / h, hz / h
    out[1, 0] = out[2, 1] * out[0, 2] - out[2, 2] * out[0, 1]
    out[1, 1] = out[2, 2] * out[0, 0] - out[2, 0] * out[0, 2]
    out[1, 2] = out[2, 0] * out[0, 1] - out[2, 1] * out[0, 0]


@kernel
def _cross(a: FloatArray, b: FloatArray) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def _turning(state: FloatArray, axes: FloatArray, thrust: FloatArray, out: FloatArray) -> None:
    """Add to `out` (3, 6) how an acceleration along R, N, B turns with the state."""
    place, speed = state[:3], state[3:6]
    r = math.sqrt(place[0] ** 2 + place[1] ** 2 + place[2] ** 2)
    hx, hy, hz = _cross(place, speed)
    h = math.sqrt(hx * hx + hy * hy + hz * hz)
    up, cross = axes[0], axes[2]
    step, d_up, d_cross = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(6):
        step[:] = 0.0
        step[k % 3] = 1.0
        if k < 3:
            for i in range(3):
                d_up[i] = (step[i] - up[i] * up[k]) / r
            dx, dy, dz = _cross(step, speed)
        else:
            d_up[:] = 0.0
            dx, dy, dz = _cross(place, step)
        d_cross[:] = 0.0
        if h > 0.0:
            along = dx * cross[0] + dy * cross[1] + dz * cross[2]
            d_cross[0], d_cross[1] = (dx - along * cross[0]) / h, (dy - along * cross[1]) / h
            d_cross[2] = (dz - along * cross[2]) / h
        ax, ay, az = _cross(d_cross, up)
        bx, by, bz = _cross(cross, d_up)
        forward = thrust[1] if h > 0.0 else 0.0
        out[0, k] += thrust[0] * d_up[0] + forward * (ax + bx) + thrust[2] * d_cross[0]
        out[1, k] += thrust[0] * d_up[1] + forward * (ay + by) + thrust[2] * d_cross[1]
        out[2, k] += thrust[0] * d_up[2] + forward * (az + bz) + thrust[2] * d_cross[2]


@kernel
def acceleration(
    t: float,
    state: FloatArray,
    thrust: FloatArray,
    world: ArcWorld,
    wants_slope: bool,
    out: FloatArray,
) -> None:
    """Write (3, 11) of a state (6,) at a time: its acceleration and what it depends on.

    thrust  (3,) constant along R, N, B
    out     columns: acceleration; derivative by the state, 6; axes R, N, B, 3; sunlight's pressure
            for a strength of 1
    """
    share = (t - world.start_s) / world.spacing_s
    interval = max(0, min(math.floor(share), world.rotations.shape[0] - 1))
    share -= interval
    work = np.empty((9, 3))  # one for all below: each array costs as much as a degree of the field
    out[:] = 0.0
    _attract(state, share, interval, world, wants_slope, out, work)
    _tides(state, share, interval, world, wants_slope, out, work)
    # the Sun is the last of the neighbours: work[3] is the craft's place from it
    if world.sees_sunlight:
        _press(state, share, interval, world, work, out)
    path_axes(state, work[5:8])
    for axis in range(3):
        for i in range(3):
            out[i, 7 + axis] = work[5 + axis, i]
            out[i, 0] += thrust[axis] * work[5 + axis, i]
    if wants_slope and (thrust[0] != 0.0 or thrust[1] != 0.0 or thrust[2] != 0.0):
        _turning(state, work[5:8], thrust, out[:, 1:7])


@kernel
def _attract(
    state: FloatArray,
    share: float,
    interval: int,
    world: ArcWorld,
    wants_slope: bool,
    out: FloatArray,
    work: FloatArray,
) -> None:
    """Add the body's own pull, and its slope."""
    x, y, z = state[0], state[1], state[2]
    square = x * x + y * y + z * z
    factor = -world.gm / (square * math.sqrt(square))
    vector, local, found = work[0], work[1], work[2]
    turn, slope = work[3:6], work[6:9]
    _interpolated(world.turns[interval], share, vector)
    _rotation(world.rotations[interval], vector, turn)
    for i in range(3):
        local[i] = turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z
    pull(local, (world.gm, world.radius_m), world.pull_table, found)
    for i in range(3):
        out[i, 0] += factor * state[i]
        for j in range(3):
            out[i, 0] += turn[j, i] * found[j]
    if not wants_slope:
        return
    gradient(local, (world.gm, world.radius_m), world.gradient_table, slope)
    for i in range(3):
        out[i, 1 + i] += factor
        for j in range(3):
            total = -3.0 * factor * state[i] * state[j] / square
            for a in range(3):
                for b in range(3):
                    total += turn[a, i] * slope[a, b] * turn[b, j]
            out[i, 1 + j] += total


@kernel
def _tides(
    state: FloatArray,
    share: float,
    interval: int,
    world: ArcWorld,
    wants_slope: bool,
    out: FloatArray,
    work: FloatArray,
) -> None:
    """Add the tides; work[3] becomes the craft's place from the last neighbour."""
    for n in range(world.gms.shape[0]):
        _interpolated(world.places[interval][:, n], share, work[2])
        for i in range(3):
            work[3, i] = state[i] - work[2, i]
        far = work[2, 0] ** 2 + work[2, 1] ** 2 + work[2, 2] ** 2
        near = work[3, 0] ** 2 + work[3, 1] ** 2 + work[3, 2] ** 2
        far_cube, near_cube = far * math.sqrt(far), near * math.sqrt(near)
        for i in range(3):
            # the body falls to its neighbour too: only the difference moves the craft about it
            out[i, 0] -= world.gms[n] * (work[3, i] / near_cube + work[2, i] / far_cube)
            if wants_slope:
                out[i, 1 + i] -= world.gms[n] / near_cube
                for j in range(3):
                    curl = work[3, i] * work[3, j] / (near * near_cube)
                    out[i, 1 + j] += 3.0 * world.gms[n] * curl


@kernel
def _press(
    state: FloatArray,
    share: float,
    interval: int,
    world: ArcWorld,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Add sunlight's pressure; work[3] is the craft's place from the Sun."""
    count = world.gms.shape[0]
    lit = lit_share(work[3], state[:3], SUN_RADIUS_M, world.body_radius_m)
    for n in range(count - 1):
        if lit > 0.0 and world.radii_m[n] > 0.0:
            _interpolated(world.places[interval][:, n], share, work[2])
            for i in range(3):
                work[4, i] = state[i] - work[2, i]
            lit *= lit_share(work[3], work[4], SUN_RADIUS_M, world.radii_m[n])
    square = work[3, 0] ** 2 + work[3, 1] ** 2 + work[3, 2] ** 2
    pressure = lit * SUNLIGHT_N_M2 * AU_M * AU_M / (square * math.sqrt(square))
    for i in range(3):
        out[i, 10] = pressure * work[3, i]
        out[i, 0] += world.sunlight * out[i, 10]


@kernel
def _rates(
    t: float,
    y: FloatArray,
    forces: tuple[FloatArray, IntArray],
    world: ArcWorld,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Write the rates of a state and its derivatives (6 + 6 c,).

    forces  (3,) acceleration along R, N, B and (p,) what each of the last p columns is a derivative
            by: 0, 1, 2 that along R, N, B; 3 the strength of sunlight; -1 nothing here
    """
    thrust, kinds = forces
    columns = (y.shape[0] - 6) // 6
    acceleration(t, y[:6], thrust, world, columns > 0, work)
    for i in range(3):
        out[i] = y[3 + i]
        out[3 + i] = work[i, 0]
    if columns == 0:
        return
    s, ds = y[6:].reshape((6, columns)), out[6:].reshape((6, columns))
    first = columns - kinds.shape[0]
    for i in range(3):
        for c in range(columns):
            ds[i, c] = s[3 + i, c]
            total = work[i, 1] * s[0, c] + work[i, 2] * s[1, c] + work[i, 3] * s[2, c]
            ds[3 + i, c] = total
        if thrust[0] != 0.0 or thrust[1] != 0.0 or thrust[2] != 0.0:
            for c in range(columns):
                ds[3 + i, c] += work[i, 4] * s[3, c] + work[i, 5] * s[4, c] + work[i, 6] * s[5, c]
        for p in range(kinds.shape[0]):
            if kinds[p] >= 0:
                ds[3 + i, first + p] += work[i, 7 + kinds[p]]


@kernel
def _advance(
    t: float,
    h: float,
    now: FloatArray,
    forces: tuple[FloatArray, IntArray],
    world: ArcWorld,
    stages: FloatArray,
    trial: FloatArray,
) -> None:
    """Write where a step leads from `now` (k,), and its stages (13, k) after the first."""
    size, work = now.shape[0], np.empty((3, 11))
    for s in range(1, STAGES + 1):
        # the last row is the step itself
        trial[:] = 0.0
        for j in range(s):
            weight = _A[s, j]
            if weight != 0.0:
                for i in range(size):
                    trial[i] += weight * stages[j, i]
        for i in range(size):
            trial[i] = now[i] + h * trial[i]
        _rates(t + _C[s] * h, trial, forces, world, work, stages[s])


@kernel
def _error(h: float, now: FloatArray, trial: FloatArray, stages: FloatArray) -> float:
    """Estimated error of a step's state, over what is allowed."""
    five = three = 0.0
    for i in range(6):
        bound = PLACE_M if i < 3 else SPEED_M_S
        scale = bound + RELATIVE * max(abs(now[i]), abs(trial[i]))
        fifth = third = 0.0
        for j in range(STAGES + 1):
            fifth += _E5[j] * stages[j, i]
            third += _E3[j] * stages[j, i]
        five += (fifth / scale) ** 2
        three += (third / scale) ** 2
    if five == 0.0 and three == 0.0:
        return 0.0
    return abs(h) * five / math.sqrt((five + 0.01 * three) * 6.0)


@kernel
def follow(
    y: FloatArray,
    times: FloatArray,
    forces: tuple[FloatArray, IntArray],
    world: ArcWorld,
    out: FloatArray,
) -> int:
    """Write the path (n, k) from y (k,) at time 0 to times (n,), ever farther to one side.

    forces  (n, 3) and (n, p) of the way to each time, as `_rates` takes them
    Returns FOLLOWED, or why not.
    """
    size, count = y.shape[0], times.shape[0]
    thrusts, kinds = forces
    stages, trial, now = np.empty((STAGES + 1, size)), np.empty(size), y.copy()
    work = np.empty((3, 11))
    square = now[0] ** 2 + now[1] ** 2 + now[2] ** 2
    is_rough = world.pull_table[1].shape[0] > OBLATE_ROWS
    step = ROUGH_STEP_RAD if is_rough else SMOOTH_STEP_RAD
    step *= math.sqrt(square * math.sqrt(square) / world.gm)
    least = (MIN_RADII * world.radius_m) ** 2 if is_rough else 0.0
    t, steps = 0.0, 0
    for n in range(count):
        here = thrusts[n], kinds[n]
        _rates(t, now, here, world, work, stages[0])
        while t != times[n]:
            left = abs(times[n] - t)
            last = step >= left
            # two even steps rather than a long and a short one
            size_s = left if last else min(step, max(0.5 * left, 0.6 * step))
            h = math.copysign(size_s, times[n] - t)
            _advance(t, h, now, here, world, stages, trial)
            error = _error(h, now, trial, stages)
            steps += 1
            if steps > MAX_STEPS or not step > MIN_STEP_S or math.isnan(error):
                return TOO_LONG
            factor = MAX_FACTOR if error == 0.0 else SAFETY * error**-0.125
            grown = size_s * max(MIN_FACTOR, min(MAX_FACTOR, factor))
            if error >= 1.0:
                step = grown
                continue
            # a step that was cut to land on a time says little of how long one may be
            step = max(step, grown) if size_s < step else grown
            t = times[n] if last else t + h
            now[:] = trial
            stages[0] = stages[STAGES]
            if now[0] ** 2 + now[1] ** 2 + now[2] ** 2 < least:
                return TOO_DEEP
        out[n] = now
    return FOLLOWED
