"""Motion about a body, integrated in one compiled loop: state, transition and force parameters.

DOP853, the Runge-Kutta method of order 8 of Hairer, Norsett and Wanner ("Solving Ordinary
Differential Equations I", 2nd ed., II.5), coefficients and step control as in scipy. The step is
chosen by the six components of the state alone; every time that is asked for is stepped on.
Derivatives are carried over a step whose path is known: two slopes of the forces for twelve stages.
"""

import math

import numpy as np
from scipy.integrate import DOP853

from catalog.arrays import FloatArray, IntArray
from catalog.geometry.kernel import kernel
from optnav_cli.dynamics.gravity_kernel import gradient, pull
from optnav_cli.dynamics.orbit_tables import ArcWorld, interval_of, neighbour, turned

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
DERIVED_RAD = 0.03  # of a circular orbit: 1e-7 of a transition after two hours
# First steps, in radians of a circular orbit: about those that low orbits then have.
SMOOTH_STEP_RAD, ROUGH_STEP_RAD = 0.15, 0.045
OBLATE_ROWS = 4  # factors of a table of degree 2
MIN_RADII = 0.5  # below it a series of high degree runs away
SUNLIGHT_N_M2 = 4.5398e-6  # pressure at 1 AU: 1361 W/m2 over the speed of light
AU_M = 149597870700.0
SUN_RADIUS_M = 6.957e8
FOLLOWED, TOO_DEEP, TOO_LONG = 0, 1, 2


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
    if thrust[0] == 0.0 and thrust[1] == 0.0 and thrust[2] == 0.0:
        return
    position, speed = state[:3], state[3:6]
    r = math.sqrt(position[0] ** 2 + position[1] ** 2 + position[2] ** 2)
    hx, hy, hz = _cross(position, speed)
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
            dx, dy, dz = _cross(position, step)
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
    t: float, state: FloatArray, thrust: FloatArray, world: ArcWorld, out: FloatArray
) -> None:
    """Write the acceleration (3,) of a state (6,) at a time.

    thrust  (3,) constant along R, N, B
    """
    interval, share = interval_of(t, world)
    work = np.empty((8, 3))  # one for all below: each array costs as much as a degree of the field
    x, y, z = state[0], state[1], state[2]
    square = x * x + y * y + z * z
    factor = -world.gm / (square * math.sqrt(square))
    turn, local, field_pull = work[0:3], work[3], work[4]
    turned(state, share, interval, world, turn, local)
    pull(local, (world.gm, world.radius_m), world.pull_table, field_pull)
    for i in range(3):
        out[i] = factor * state[i]
        for j in range(3):
            out[i] += turn[j, i] * field_pull[j]
    offset, centre = work[3], work[4]
    for n in range(world.gms.shape[0]):
        far_cube, near_cube = neighbour(state, share, interval, n, world, centre, offset)
        for i in range(3):
            # the body falls to its neighbour too: only the difference moves the craft about it
            out[i] -= world.gms[n] * (offset[i] / near_cube + centre[i] / far_cube)
    # the Sun is the last of the neighbours
    if world.sunlight != 0.0:
        _press(state, share, interval, world, offset, work[5:8])
        for i in range(3):
            out[i] += world.sunlight * work[7, i]
    if thrust[0] != 0.0 or thrust[1] != 0.0 or thrust[2] != 0.0:
        path_axes(state, work[5:8])
        for axis in range(3):
            for i in range(3):
                out[i] += thrust[axis] * work[5 + axis, i]


@kernel
def slopes(
    t: float, state: FloatArray, thrust: FloatArray, world: ArcWorld, out: FloatArray
) -> None:
    """Write (3, 10) of a state (6,) at a time: what its acceleration depends on.

    thrust  (3,) constant along R, N, B
    out     columns: derivative by the state, 6; axes R, N, B, 3; sunlight's pressure for a strength
            of 1
    """
    interval, share = interval_of(t, world)
    work = np.empty((8, 3))
    x, y, z = state[0], state[1], state[2]
    square = x * x + y * y + z * z
    factor = -world.gm / (square * math.sqrt(square))
    turn, local, slope = work[0:3], work[3], work[4:7]
    turned(state, share, interval, world, turn, local)
    gradient(local, (world.gm, world.radius_m), world.gradient_table, slope)
    out[:] = 0.0
    for i in range(3):
        out[i, i] += factor
        for j in range(3):
            total = -3.0 * factor * state[i] * state[j] / square
            for a in range(3):
                for b in range(3):
                    total += turn[a, i] * slope[a, b] * turn[b, j]
            out[i, j] += total
    offset, centre = work[3], work[4]
    for n in range(world.gms.shape[0]):
        _, near_cube = neighbour(state, share, interval, n, world, centre, offset)
        near = offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2
        for i in range(3):
            out[i, i] -= world.gms[n] / near_cube
            for j in range(3):
                out[i, j] += 3.0 * world.gms[n] * offset[i] * offset[j] / (near * near_cube)
    if world.sees_sunlight:
        _press(state, share, interval, world, offset, work[5:8])
        out[:, 9] = work[7]
    path_axes(state, work[5:8])
    out[:, 6:9] = work[5:8].T
    _turning(state, work[5:8], thrust, out[:, :6])


@kernel
def _press(
    state: FloatArray,
    share: float,
    interval: int,
    world: ArcWorld,
    from_sun: FloatArray,
    work: FloatArray,
) -> None:
    """Write sunlight's pressure into work[2]; from_sun (3,) the craft's place from the Sun."""
    count = world.gms.shape[0]
    lit = lit_share(from_sun, state[:3], SUN_RADIUS_M, world.body_radius_m)
    for n in range(count - 1):
        if lit > 0.0 and world.radii_m[n] > 0.0:
            neighbour(state, share, interval, n, world, work[0], work[1])
            lit *= lit_share(from_sun, work[1], SUN_RADIUS_M, world.radii_m[n])
    square = from_sun[0] ** 2 + from_sun[1] ** 2 + from_sun[2] ** 2
    pressure = lit * SUNLIGHT_N_M2 * AU_M * AU_M / (square * math.sqrt(square))
    for i in range(3):
        work[2, i] = pressure * from_sun[i]


@kernel
def _advance(
    t: float,
    h: float,
    now: FloatArray,
    thrust: FloatArray,
    world: ArcWorld,
    stages: FloatArray,
    trial: FloatArray,
) -> None:
    """Write where a step leads from a state `now` (6,), and its stages (13, 6) after the first."""
    for s in range(1, STAGES + 1):
        # the last row is the step itself
        trial[:] = 0.0
        for j in range(s):
            weight = _A[s, j]
            if weight != 0.0:
                for i in range(6):
                    trial[i] += weight * stages[j, i]
        for i in range(6):
            trial[i] = now[i] + h * trial[i]
        stages[s, :3] = trial[3:]
        acceleration(t + _C[s] * h, trial, thrust, world, stages[s, 3:])


@kernel
def _between(
    h: float,
    share: float,
    ends: tuple[FloatArray, FloatArray],
    rates: tuple[FloatArray, FloatArray],
    out: FloatArray,
) -> None:
    """Write the state (6,) at a share of a step by Hermite's polynomials of its ends."""
    (now, then), (first, last) = ends, rates
    s, s2 = share, share * share
    s3, s4, s5 = s2 * s, s2 * s2, s2 * s2 * s
    begin, end = 1.0 - 10.0 * s3 + 15.0 * s4 - 6.0 * s5, 10.0 * s3 - 15.0 * s4 + 6.0 * s5
    leave, come = h * (s - 6.0 * s3 + 8.0 * s4 - 3.0 * s5), h * (-4.0 * s3 + 7.0 * s4 - 3.0 * s5)
    bend, bent = 0.5 * h * h * (s2 - 3.0 * s3 + 3.0 * s4 - s5), 0.5 * h * h * (s3 - 2.0 * s4 + s5)
    for i in range(3):
        out[i] = begin * now[i] + leave * now[3 + i] + bend * first[3 + i]
        out[i] += end * then[i] + come * then[3 + i] + bent * last[3 + i]
        out[3 + i] = (1.0 - 3.0 * s2 + 2.0 * s3) * now[3 + i] + (3.0 * s2 - 2.0 * s3) * then[3 + i]
        out[3 + i] += h * ((s - 2.0 * s2 + s3) * first[3 + i] + (s3 - s2) * last[3 + i])


@kernel
def _grow(
    slope: FloatArray,
    moved: FloatArray,
    forces: tuple[FloatArray, IntArray],
    out: FloatArray,
) -> None:
    """Write the rates of derivatives (6, c) of a path.

    slope   (3, 10) as of `slopes`
    forces  (3,) acceleration along R, N, B and (p,) what each of the last p columns is a derivative
            by: 0, 1, 2 that along R, N, B; 3 the strength of sunlight; -1 nothing here
    """
    thrust, kinds = forces
    columns = moved.shape[1]
    first = columns - kinds.shape[0]
    turns = thrust[0] != 0.0 or thrust[1] != 0.0 or thrust[2] != 0.0
    for i in range(3):
        for c in range(columns):
            out[i, c] = moved[3 + i, c]
            total = slope[i, 0] * moved[0, c] + slope[i, 1] * moved[1, c]
            out[3 + i, c] = total + slope[i, 2] * moved[2, c]
        if turns:
            for c in range(columns):
                total = slope[i, 3] * moved[3, c] + slope[i, 4] * moved[4, c]
                out[3 + i, c] += total + slope[i, 5] * moved[5, c]
        for p in range(kinds.shape[0]):
            if kinds[p] >= 0:
                out[3 + i, first + p] += slope[i, 6 + kinds[p]]


@kernel
def _derive(
    t: float,
    h: float,
    ends: tuple[FloatArray, FloatArray],
    rates: tuple[FloatArray, FloatArray],
    forces: tuple[FloatArray, IntArray],
    world: ArcWorld,
    room: tuple[FloatArray, FloatArray],
    derivatives: FloatArray,
) -> None:
    """Carry derivatives (6, c) over a step whose path is known.

    They are linear and need fewer digits than the path: Runge and Kutta's fourth order in parts of
    at most DERIVED_RAD, with the slopes at the ends and in the middle of each.

    room  (3, 3, 10) and (5, 6, c) to work in; of the former the first is the slope of the step's
          start, and becomes that of its end
    """
    slope, work = room
    now = ends[0]
    square = now[0] ** 2 + now[1] ** 2 + now[2] ** 2
    rate = math.sqrt(world.gm / (square * math.sqrt(square)))
    parts = max(1, math.ceil(abs(h) * rate / DERIVED_RAD))
    size, state = h / parts, np.empty(6)
    for part in range(parts):
        for half in range(1, 3):
            share = (part + 0.5 * half) / parts
            _between(h, share, ends, rates, state)
            slopes(t + share * h, state, forces[0], world, slope[half])
        _grow(slope[0], derivatives, forces, work[0])
        work[4] = derivatives + 0.5 * size * work[0]
        _grow(slope[1], work[4], forces, work[1])
        work[4] = derivatives + 0.5 * size * work[1]
        _grow(slope[1], work[4], forces, work[2])
        work[4] = derivatives + size * work[2]
        _grow(slope[2], work[4], forces, work[3])
        derivatives += size / 6.0 * (work[0] + 2.0 * (work[1] + work[2]) + work[3])
        slope[0] = slope[2]


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
    begin: float,
    times: FloatArray,
    forces: tuple[FloatArray, IntArray],
    world: ArcWorld,
    out: FloatArray,
) -> int:
    """Write the path (n, k) from y (k,) at a time to others (n,), ever farther to one side.

    y       a state (6,), and its derivatives (6, c) where there are any
    forces  (n, 3) and (n, p) of the way to each time, as `_grow` takes them
    Returns FOLLOWED, or why not.
    """
    size, count = y.shape[0], times.shape[0]
    thrusts, kinds = forces
    stages, trial, now = np.empty((STAGES + 1, 6)), np.empty(6), y[:6].copy()
    derivatives = y[6:].copy().reshape((6, (size - 6) // 6))
    room = np.empty((3, 3, 10)), np.empty((5, 6, (size - 6) // 6))
    square = now[0] ** 2 + now[1] ** 2 + now[2] ** 2
    is_rough = world.pull_table[1].shape[0] > OBLATE_ROWS
    step = ROUGH_STEP_RAD if is_rough else SMOOTH_STEP_RAD
    step *= math.sqrt(square * math.sqrt(square) / world.gm)
    least = (MIN_RADII * world.radius_m) ** 2 if is_rough else 0.0
    t, steps = begin, 0
    for n in range(count):
        here = thrusts[n], kinds[n]
        stages[0, :3] = now[3:]
        acceleration(t, now, here[0], world, stages[0, 3:])
        if size > 6:
            slopes(t, now, here[0], world, room[0][0])
        while t != times[n]:
            left = abs(times[n] - t)
            last = step >= left
            # two even steps rather than a long and a short one
            size_s = left if last else min(step, max(0.5 * left, 0.6 * step))
            h = math.copysign(size_s, times[n] - t)
            _advance(t, h, now, here[0], world, stages, trial)
            error = _error(h, now, trial, stages)
            steps += 1
            if steps > MAX_STEPS or not step > MIN_STEP_S or math.isnan(error):
                return TOO_LONG
            factor = MAX_FACTOR if error == 0.0 else SAFETY * error**-0.125
            grown = size_s * max(MIN_FACTOR, min(MAX_FACTOR, factor))
            if error >= 1.0:
                step = grown
                continue
            if size > 6:
                rates = stages[0], stages[STAGES]
                _derive(t, h, (now, trial), rates, here, world, room, derivatives)
            # a step that was cut to land on a time says little of how long one may be
            step = max(step, grown) if size_s < step else grown
            t = times[n] if last else t + h
            now[:] = trial
            stages[0] = stages[STAGES]
            if now[0] ** 2 + now[1] ** 2 + now[2] ** 2 < least:
                return TOO_DEEP
        out[n, :6] = now
        out[n, 6:] = derivatives.ravel()
    return FOLLOWED


@kernel
def follow_legs(
    starts: FloatArray,
    begins: FloatArray,
    times: tuple[FloatArray, IntArray],
    forces: tuple[FloatArray, IntArray],
    world: ArcWorld,
    out: FloatArray,
) -> int:
    """Write the paths (m, k) from each of starts (n, k) at times (n,), as `follow` does.

    times  (m,) one leg after the other, and (n,) how many each has
    """
    first = 0
    for leg in range(starts.shape[0]):
        last = first + times[1][leg]
        here = forces[0][first:last], forces[1][first:last]
        to = times[0][first:last]
        outcome = follow(starts[leg], begins[leg], to, here, world, out[first:last])
        if outcome != FOLLOWED:
            return outcome
        first = last
    return FOLLOWED
