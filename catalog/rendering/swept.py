"""One sweep over a map grid away from the Sun: cast shadows, and the brightness of what is lit.

All rays to the Sun are parallel straight lines in the frame of the grid's centre. There the body
falls away below the tangent plane, so a node stands at z = (R + h) cos(angle from the centre) - R
and a ray that rises by tan(elevation) a metre of map is the edge of a shadow. Parallel lines one
node apart follow the Sun's azimuth across the grid; each carries the highest ray that the ground
behind it has thrown, and a node is compared with the two lines that it lies between. Only that one
interpolation is made, so a shadow's edge does not blur with its length.

Map x and y are taken for the tangent plane's: wrong by (rho / 2R)^2 of a shadow's length (a five
thousandth at the rim of a 100 km tile on the Moon). The Sun is a point (its disc is 0.5 deg wide).

A row's shadow and brightness are made together, while it is in the processor's nearest cache. A
sweep along rows goes over strips of columns that are turned into rows, and back.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.geometry.kernel import inplace_kernel, kernel
from catalog.photometry.laws import SurfaceLaw
from catalog.photometry.sets import HapkeParameters
from catalog.rendering.hapke_table import shade_hapke
from catalog.rendering.shading import (
    LIMIT,
    LIT,
    NEAR_LUNAR,
    ONE,
    TABLE,
    TWO_TERMS,
    UNKNOWN,
    ZERO,
    Lighting,
    MapGrid,
    Rows,
    fill_slopes,
    shade_near,
    shade_nodes,
    shade_two_terms,
)

NO_LIMITS: Float32Array = np.empty((0, 0), np.float32)
NOTHING = np.float32(-1e30)  # height of no ground
NODE_TOLERANCE_M = 1e-3  # float32 heights of 1e4 m are good to this
# Heights are counted from the ray to the Sun through the grid's middle, so that lines need no
# lowering as they go. Rays rise by many kilometres over a large grid: so much of that is rounding.
RAY_TOLERANCE = 5e-7
STRIP = 64  # columns that are turned into rows at once: those of 2048 nodes stay in a cache of 1 MB
TOGETHER = 8192  # nodes of rows that are worked on together: 100 kB
PAD = 16  # nodes between the rows of a strip, so that they do not share one place in the cache


class Sweep(NamedTuple):
    """The order in which a grid is swept under a Sun.

    swap    rows and columns change places: the sweep follows the columns
    flip_t  rows are swept against their order
    flip_c  lines run to lower columns
    casts   whether ground throws shadows
    shear   columns that a line moves a row, 0..1
    climb   climb of a ray to the Sun a metre along the rows' order
    """

    swap: bool
    flip_t: bool
    flip_c: bool
    casts: bool
    shear: float
    climb: float


class ShadowField(NamedTuple):
    """Shadows of coarser grids over a point, for one Sun; see `shadow.make_shadow_field`.

    limits     (m, m)  height that ground must pass to see the Sun; (0, 0) when nothing throws
               shadows
    posting_m  m between its nodes
    """

    limits: Float32Array
    posting_m: float


class _Work(NamedTuple):
    """Arrays that one sweep works in.

    lines    heights of rays by line; a row's columns lie beside lines from `_find_first_line` on
    z        (n + 2,) heights of a row above the plane that its rays share, the ends twice
    mask     (rows, n), slopes (rows, 2, n): of rows that are worked on together
    uu       (n,) squares of x / 2R of columns
    """

    lines: Float32Array
    span: int
    z: Float32Array
    mask: Float32Array
    slopes: Float32Array
    uu: Float32Array


@inplace_kernel
def _find_first_line(sweep: Sweep, span: int, t: int) -> tuple[int, float]:
    """The lowest line that a node of row t lies beside, and how far lines are past nodes, 0..1."""
    # a line that rounding leaves a hair before a column is on it
    shift = int(np.floor(sweep.shear * t + 1e-9))
    part = max(sweep.shear * t - shift, 0.0)
    return (shift if sweep.flip_c else span - shift), part


@inplace_kernel
def _sample(limits: Float32Array, row: float, col: float) -> float:
    """The limit between the nodes of a coarser grid; NOTHING outside it."""
    size = limits.shape[0]
    if not (0.0 <= row <= size - 1 and 0.0 <= col <= size - 1):
        return float(NOTHING)
    i, j = min(int(row), size - 2), min(int(col), size - 2)
    down, along = row - i, col - j
    value: float = (1.0 - down) * ((1.0 - along) * limits[i, j] + along * limits[i, j + 1])
    value += down * ((1.0 - along) * limits[i + 1, j] + along * limits[i + 1, j + 1])
    return value


@inplace_kernel
def _start_lines(
    grid: MapGrid, sweep: Sweep, outer: ShadowField, work: _Work, t: int, row: int, lift: float
) -> None:
    """Lines that enter the grid at row t carry the rays that ground about it has thrown."""
    size = grid.heights.shape[0]
    first, part = _find_first_line(sweep, work.span, t)
    begin, end = first, first + size + 1
    if t > 0 and sweep.flip_c:
        begin = _find_first_line(sweep, work.span, t - 1)[0] + size + 1
    elif t > 0:
        end = _find_first_line(sweep, work.span, t - 1)[0]
    middle, outer_middle = (size - 1) / 2.0, (outer.limits.shape[0] - 1) / 2.0
    ratio = grid.posting / outer.posting_m
    down = outer_middle + (row - middle) * ratio
    for line in range(begin, end):
        col = line - first + (-part if sweep.flip_c else part - 1.0)
        along = outer_middle + (col - middle) * ratio
        limit = (
            _sample(outer.limits, along, down) if sweep.swap else _sample(outer.limits, down, along)
        )
        work.lines[line] = limit + lift


@inplace_kernel
def _fill_z(here: Float32Array, work: _Work, row_q: np.float32, radius: float, lift: float) -> None:
    """Heights of a row's nodes in the tangent frame, above the plane of its rays."""
    z, uu = work.z[1 : here.size + 1], work.uu
    raised, diameter = np.float32(lift), np.float32(2.0 * radius)
    for c in range(here.size):
        h = here[c]
        q = row_q + uu[c]
        # (R + h)(1 - q)/(1 + q) - R without the loss of digits
        value = (h - q * (h + diameter)) / (ONE + q) + raised
        z[c] = value if value == value else NOTHING
    work.z[0], work.z[here.size + 1] = z[0], z[here.size - 1]


@inplace_kernel
def _cast_shadows(
    grid: MapGrid,
    sweep: Sweep,
    outer: ShadowField,
    made: int,
    work: _Work,
    rows: Rows,
    target: Float32Array,
) -> None:
    """Fill the mask of rows, or the target with their limits; their ground is added to the lines.

    The mask is 1 where a node sees the Sun, else 0, NaN for no data.
    """
    size = rows.u.size
    rise = sweep.climb * grid.posting
    tolerance = np.float32(max(NODE_TOLERANCE_M, RAY_TOLERANCE * abs(rise) * size / 2.0))
    for i in range(rows.together):
        k = rows.together - 1 - i if sweep.flip_t else i
        number = rows.first + k
        here = rows.heights[number - rows.low][:size]
        t = size - 1 - number if sweep.flip_t else number
        lift = rise * (t - (size - 1) / 2.0)
        if outer.limits.shape[0] > 0:
            _start_lines(grid, sweep, outer, work, t, number, lift)
        _fill_z(here, work, work.uu[number], grid.radius, lift)
        first, far = _find_first_line(sweep, work.span, t)
        part, share = np.float32(far), np.float32(1.0 - far)
        # a node lies between the line a part of a column past it and the one before that
        ahead, shift = (0, 0) if sweep.flip_c else (1, 2)
        line = work.lines[first + ahead : first + ahead + size]
        near = work.lines[first + 1 - ahead : first + 1 - ahead + size]
        z, beside = work.z[1 : size + 1], work.z[shift : shift + size]
        if made == LIMIT:
            limits, raised = target[k][:size], np.float32(lift)
            for c in range(size):
                limits[c] = (part * near[c] + share * line[c]) - raised
        else:
            mask = work.mask[k]
            for c in range(size):
                limit = (part * near[c] + share * line[c]) - tolerance
                lit = ONE if z[c] >= limit else ZERO
                mask[c] = lit if here[c] == here[c] else UNKNOWN
        # a plain comparison: max() keeps the compiler from using vector registers
        for c in range(size):
            ground = share * z[c] + part * beside[c]
            height = line[c]
            line[c] = height if height > ground else ground


@inplace_kernel
def _make_rows(
    grid: MapGrid,
    sweep: Sweep,
    outer: ShadowField,
    light: Lighting,
    work: _Work,
    rows: Rows,
    target: Float32Array,
) -> None:
    """Compute the wanted quantity for rows that follow those already swept."""
    size = rows.u.size
    if sweep.casts:
        _cast_shadows(grid, sweep, outer, light.made, work, rows, target)
    else:
        for k in range(rows.together):
            for c in range(size):
                h = rows.heights[rows.first - rows.low + k, c]
                work.mask[k, c] = ONE if h == h else UNKNOWN
    if light.made == LIT:
        for k in range(rows.together):
            for c in range(size):
                target[k, c] = work.mask[k, c]
    if light.made <= LIT:
        return
    fill_slopes(rows, grid, work.slopes)
    if light.made == TWO_TERMS:
        shade_two_terms(rows, grid, work.slopes, work.mask, light, target)
    elif light.made == TABLE:
        shade_hapke(rows, grid, work.slopes, work.mask, light, target)
    elif light.made == NEAR_LUNAR:
        shade_near(rows, grid, work.slopes, work.mask, light, target)
    else:
        shade_nodes(rows, grid, work.slopes, work.mask, light, target)


@inplace_kernel
def _copy_transposed(heights: Float32Array, strip: Float32Array) -> None:
    """Copy columns (n, k) into rows (k, n)."""
    size, count = heights.shape
    fours = size - size % 4
    # four at once: one store in place of four
    for r in range(0, fours, 4):
        a, b, c, d = heights[r], heights[r + 1], heights[r + 2], heights[r + 3]
        for k in range(count):
            target = strip[k, r : r + 4]
            target[0], target[1], target[2], target[3] = a[k], b[k], c[k], d[k]
    for r in range(fours, size):
        for k in range(count):
            strip[k, r] = heights[r, k]


@inplace_kernel
def _copy_back(made: Float32Array, out: Float32Array) -> None:
    for r in range(out.shape[0]):
        line = out[r]
        for k in range(line.size):
            line[k] = made[k, r]


@kernel
def _run_sweep(
    heights: Float32Array,
    limits: Float32Array,
    table: Float32Array,
    numbers: FloatArray,
    out: Float32Array,
) -> None:
    """Sweep as `sweep_grid` does; numbers: all its arguments but 2-D arrays, in its order."""
    grid = MapGrid(heights, numbers[0], numbers[1])
    swap, flip_t, flip_c, casts = numbers[2] > 0, numbers[3] > 0, numbers[4] > 0, numbers[5] > 0
    sweep = Sweep(swap, flip_t, flip_c, casts, numbers[6], numbers[7])
    outer = ShadowField(limits, numbers[8])
    surface = HapkeParameters(
        numbers[18], numbers[19], numbers[20], numbers[21], numbers[22], numbers[23]
    )
    law = SurfaceLaw(int(numbers[16]), surface, numbers[17])
    light = Lighting(int(numbers[9]), numbers[10:13], numbers[13:16], numbers[24], law, table)
    size = heights.shape[0]
    u = np.empty(size, np.float32)
    for c in range(size):
        u[c] = (c - (size - 1) / 2.0) * (grid.posting / (2.0 * grid.radius))
    together = max(1, min(TOGETHER // size, STRIP))
    span = int(np.ceil(sweep.shear * (size - 1))) + 1
    work = _Work(
        np.full(size + span + 2, NOTHING), span, np.empty(size + 2, np.float32),
        np.empty((together, size), np.float32), np.empty((together, 2, size), np.float32), u * u,
    )  # fmt: skip
    wide = STRIP if swap else size
    strip = np.empty((STRIP + 2, size + PAD) if swap else (1, 1), np.float32)
    made = np.empty((STRIP, size + PAD) if swap else (1, 1), np.float32)
    for done in range(0, size, wide):
        begin = max(size - done - wide, 0) if flip_t else done
        end = size - done if flip_t else min(done + wide, size)
        low = max(begin - 1, 0) if swap else 0
        if swap:
            _copy_transposed(heights[:, low : min(end + 1, size)], strip)
        ground, target = (strip, made) if swap else (heights, out)
        for ready in range(0, end - begin, together):
            count = min(together, end - begin - ready)
            first = end - ready - count if flip_t else begin + ready
            rows = Rows(ground, low, first, count, u)
            _make_rows(grid, sweep, outer, light, work, rows, target[first - begin :])
        if swap:
            _copy_back(made, out[:, begin:end])


@kernel
def _run_sweep_levels(
    grids: tuple[Float32Array, ...],
    postings: FloatArray,
    numbers: FloatArray,
    made: int,
    table: Float32Array,
    limits: tuple[Float32Array, ...],
    pictures: tuple[Float32Array, ...],
) -> None:
    """Sweep as `sweep_levels` does; fill limits, of grids from the second on and an empty one."""
    for k in range(len(grids) - 1, -1, -1):
        numbers[0], numbers[8] = postings[k], postings[min(k + 1, postings.size - 1)]
        if k < len(pictures):
            numbers[9] = made
            _run_sweep(grids[k], limits[k], table, numbers, pictures[k])
        if k > 0:
            numbers[9] = LIMIT
            _run_sweep(grids[k], limits[k], table, numbers, limits[k - 1])


def sweep_levels(
    grids: Sequence[MapGrid], sweep: Sweep, light: Lighting, count: int
) -> tuple[list[Float32Array], list[ShadowField]]:
    """`sweep_grid` of the first `count` of some grids about one centre, under all coarser ones.

    grids  finer first
    Returns also what the coarser ones throw over each grid.
    """
    pictures = [np.empty_like(grid.heights) for grid in grids[:count]]
    limits = [*(np.empty_like(grid.heights) for grid in grids[1:]), NO_LIMITS]
    postings = [grid.posting for grid in grids]
    numbers = _pack_numbers(grids[0], sweep, 1.0, light)
    _run_sweep_levels(
        tuple(grid.heights for grid in grids), np.array(postings), numbers, light.made,
        light.table, tuple(limits), tuple(pictures),
    )  # fmt: skip
    return pictures, [ShadowField(*field) for field in zip(limits, [*postings[1:], 1.0])]


def _pack_numbers(grid: MapGrid, sweep: Sweep, outer_m: float, light: Lighting) -> FloatArray:
    """All that `_run_sweep` takes but for arrays; outer_m: posting of what lies beyond the grid.

    One array: a kernel takes 40 us to be handed them as the tuples they are in.
    """
    law = light.law
    return np.array(
        [
            *grid[1:], *sweep, outer_m,
            light.made, *light.sun.tolist(), *light.camera.tolist(), law.number,
            law.albedo, *law.surface, light.weight,
        ]
    )  # fmt: skip


def sweep_grid(grid: MapGrid, sweep: Sweep, outer: ShadowField, light: Lighting) -> Float32Array:
    """Compute what `light` asks for at every node of a grid (n, n).

    With swap, vectors in `light` have x against rows and y against columns.
    """
    numbers = _pack_numbers(grid, sweep, outer.posting_m, light)
    # of the library, which takes large arrays in large pages; the kernel's own would not be
    out = np.empty(grid.heights.shape, np.float32)
    _run_sweep(grid.heights, outer.limits, light.table, numbers, out)
    return out
