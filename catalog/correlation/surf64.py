"""Upright SURF-64: how a small square of brightness looks, in 64 numbers.

Source: H. Bay, T. Tuytelaars, L. Van Gool, "SURF: Speeded Up Robust Features", ECCV 2006; the
upright form, because map grids share their orientation. A square is split into cells; each gives
the sums of dx, dy, |dx|, |dy| of Haar responses, and the whole is brought to unit length.

Ours: the Gaussian weight is taken once a cell, at its middle, and not at every sample. Then the
sums over a cell are box sums that all positions share, and a descriptor costs a gather.
Cells larger than 8 nodes blur the peak: a 64-node square wants 8 x 8 cells (256 numbers).
"""

from functools import cache

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.correlation.ncc import match_ncc
from catalog.correlation.peak import RIVAL_DISTANCE, Match
from catalog.geometry.kernel import inplace_kernel, kernel

CELLS = 4  # a side: 4 x 4 cells of four sums are the 64 numbers
# Bay et al. weight with sigma = 3.3 s on a square of 20 s: 3.3 / 20 of the side
WEIGHT_SIGMA = 0.165
# matching: cells of at most this many nodes over the whole reference
MATCH_CELL_PX = 8
# wavelets of two nodes carry every node's noise; SURF's own wavelet spans two samples of ~1.6
MATCH_SMOOTHING_NODES = 1.0
MIN_SIDE = 17  # nodes of a square that is described
# correlation looks this far around the descriptor's peak, which is good to about a node
REFINE_NODES = 3
# distance to the best place over distance to the best rival; above it the two are not distinct
# (Lowe's ratio, 0.8 in his paper; rivals here are relief of the same kind, so more is allowed)
MAX_DISTANCE_RATIO = 0.9


def _sum_cells(image: Float32Array, cell_px: int) -> Float32Array:
    """Sums of dx, dy, |dx|, |dy| over the cell whose first node is (row, col): (rows, 4, cols).

    The Haar wavelet spans 2 x 2 nodes: its response belongs to the corner shared by them. The
    last rows and columns, where a cell does not fit, stay zero. NaN counts as no response.
    """
    rows, cols = image.shape
    haar, out = np.zeros((cell_px, 4, cols), np.float32), np.empty((rows, 4, cols), np.float32)
    room = np.zeros(4 * cols), np.empty(cols - cell_px, np.float32)
    _fill_cell_sums(image, cell_px, haar, *room, out)
    return out


@inplace_kernel
def _fill_cell_sums(
    image: Float32Array,
    cell_px: int,
    haar: Float32Array,
    columns: FloatArray,
    total: Float32Array,
    out: Float32Array,
) -> None:
    """Fill `_sum_cells`.

    haar     (cell_px, 4, cols)  responses of the rows that a cell spans; zeros on entry
    columns  (4 cols,)  their sums; zeros on entry
    """
    rows, cols = image.shape
    half, none = np.float32(0.5), np.float32(0.0)
    # single loops over slices, so that each is compiled to vector instructions
    for row in range(rows - 1):
        a, b = image[row, : cols - 1], image[row, 1:]
        d, e = image[row + 1, : cols - 1], image[row + 1, 1:]
        slot = haar[row % cell_px]
        dx, dy, size_x, size_y = slot[0], slot[1], slot[2], slot[3]
        for c in range(cols - 1):
            value = half * ((b[c] + e[c]) - (a[c] + d[c]))
            dx[c] = value if value == value else none
        for c in range(cols - 1):
            value = half * ((d[c] + e[c]) - (a[c] + b[c]))
            dy[c] = value if value == value else none
        for c in range(cols - 1):
            size_x[c] = abs(dx[c])
            size_y[c] = abs(dy[c])
        entering = slot.reshape(-1)
        for c in range(columns.size):
            columns[c] += entering[c]
        first = row - cell_px + 1
        if first < 0:
            continue
        for k in range(4):
            # so many additions side by side beat a running sum, in which each waits for the last
            total[:] = none
            for shift in range(cell_px):
                column = columns[k * cols + shift : k * cols + shift + total.size]
                for c in range(total.size):
                    total[c] += np.float32(column[c])
            into = out[first, k]
            for c in range(total.size):
                into[c] = total[c]
            into[total.size :] = none
        leaving = haar[first % cell_px].reshape(-1)
        for c in range(columns.size):
            columns[c] -= leaving[c]
    out[rows - cell_px :] = none


@kernel
def _gather(
    sums: Float32Array, rows: IntArray, cols: IntArray, cell_px: int, weights: Float32Array
) -> Float32Array:
    """Weighted cell sums of each square, normalised; zeros for a square without contrast."""
    cells = weights.shape[0]
    out = np.empty((rows.size, 4 * cells * cells), np.float32)
    half = cells * cell_px // 2
    for n in range(rows.size):
        k = 0
        squared = np.float32(0.0)
        for i in range(cells):
            r = rows[n] - half + i * cell_px
            for j in range(cells):
                c = cols[n] - half + j * cell_px
                weight = weights[i, j]
                for channel in range(4):
                    value = weight * sums[r, channel, c]
                    out[n, k] = value
                    squared += value * value
                    k += 1
        scale = np.float32(1.0 / np.sqrt(squared)) if squared > 1e-20 else np.float32(0.0)
        for k in range(out.shape[1]):
            out[n, k] *= scale
    return out


def _compute_similarities(
    sums: Float32Array,
    own: Float32Array,
    first: int,
    positions: int,
    cell_px: int,
    weights: Float32Array,
) -> Float32Array:
    """Cosines (positions, positions) of `own` and the descriptors that `_gather` would give.

    sums   (m, 4, m) cell sums; first: row and column of the first cell at the first position
    own    (4 cells²,) of unit length
    """
    room = np.empty((2, positions), np.float32)
    out = np.empty((positions, positions), np.float32)
    _fill_similarities(sums, own, first, cell_px, weights, room, out)
    return out


@inplace_kernel
def _fill_similarities(
    sums: Float32Array,
    own: Float32Array,
    first: int,
    cell_px: int,
    weights: Float32Array,
    room: Float32Array,
    out: Float32Array,
) -> None:
    """Fill `_compute_similarities` (positions, positions); room (2, positions) to work in."""
    cells, positions = weights.shape[0], out.shape[0]
    products, squares = room[0], room[1]
    for p in range(positions):
        products[:] = 0.0
        squares[:] = 0.0
        at = 0
        for i in range(cells):
            row = sums[first + p + i * cell_px]
            for j in range(cells):
                weight = weights[i, j]
                start = first + j * cell_px
                for channel in range(4):
                    mine = own[at]
                    at += 1
                    line = row[channel, start : start + positions]
                    for q in range(positions):
                        value = weight * line[q]
                        products[q] += mine * value
                        squares[q] += value * value
        for q in range(positions):
            squared = squares[q]
            out[p, q] = products[q] / np.sqrt(squared) if squared > 1e-20 else 0.0


@cache
def make_cell_weights(cells: int) -> Float32Array:
    """(cells, cells) Gaussian weights at the middles of the cells, largest near one."""
    middles = (np.arange(cells) + 0.5) / cells - 0.5
    line = np.exp(-0.5 * (middles / WEIGHT_SIGMA) ** 2)
    return np.outer(line, line).astype(np.float32)


def compute_descriptors(
    image: Float32Array, rows: IntArray, cols: IntArray, cell_px: int, cells: int = CELLS
) -> Float32Array:
    """Descriptors of the squares of cells x cells cells of cell_px nodes about given nodes.

    image       (rows, cols)  brightness, any unit; NaN for no data
    rows, cols  (n,)          nodes; the square's middle is the corner before them when its side
                              is even, alike for all, so differences of positions are exact
    Returns (n, 4 cells²) float32 of unit length (zeros where there is no contrast).
    Raises ValueError when a square leaves the image.
    """
    image = np.ascontiguousarray(image, dtype=np.float32)
    rows = np.ascontiguousarray(rows, dtype=np.int64).ravel()
    cols = np.ascontiguousarray(cols, dtype=np.int64).ravel()
    before = cells * cell_px // 2
    behind = cells * cell_px - before
    height, width = image.shape
    if rows.size and (
        min(rows.min(), cols.min()) < before
        or rows.max() + behind > height - 1
        or cols.max() + behind > width - 1
    ):
        raise ValueError(f"a square of {cells * cell_px} nodes leaves the {height} x {width} image")
    return _gather(_sum_cells(image, cell_px), rows, cols, cell_px, make_cell_weights(cells))


def compute_similarity_surface(reference: Float32Array, search: Float32Array) -> Float32Array:
    """Cosine of the descriptors of a reference and of every place where it fits into a search grid.

    reference (n, n), search (m, m) with m - n even, n >= MIN_SIDE.
    Returns (m - n + 1, m - n + 1) in -1..1; the middle element is the centred place.
    Raises ValueError for sizes that cannot be centred on each other or a reference too small.
    """
    n, m = reference.shape[0], search.shape[0]
    if reference.shape != (n, n) or search.shape != (m, m) or m < n or (m - n) % 2 or n < MIN_SIDE:
        raise ValueError(f"reference {reference.shape} cannot be centred in search {search.shape}")
    cells, cell_px, margin = _plan_cells(n)
    at = np.array([margin + cells * cell_px // 2])
    descriptor = compute_descriptors(_smooth(reference), at, at, cell_px, cells)[0]
    sums = _sum_cells(_smooth(search), cell_px)
    return _compute_similarities(
        sums, descriptor, margin, m - n + 1, cell_px, make_cell_weights(cells)
    )


def compute_self_similarity_surface(search: Float32Array, side: int) -> Float32Array:
    """Compute the similarity surface of a grid's middle square of `side` nodes; 1 in its middle.

    Raises ValueError as `compute_similarity_surface` does.
    """
    m = search.shape[0]
    if search.shape != (m, m) or m < side or (m - side) % 2 or side < MIN_SIDE:
        raise ValueError(f"a square of {side} cannot be centred in search {search.shape}")
    cells, cell_px, margin = _plan_cells(side)
    sums, weights = _sum_cells(_smooth(search), cell_px), make_cell_weights(cells)
    at = np.array([(m - side) // 2 + margin + cells * cell_px // 2])
    descriptor = _gather(sums, at, at, cell_px, weights)[0]
    return _compute_similarities(sums, descriptor, margin, m - side + 1, cell_px, weights)


def _plan_cells(side: int) -> tuple[int, int, int]:
    """Cells a side, their nodes, and the nodes left over before the first, of a matched square."""
    cells = max(CELLS, round((side - 1) / MATCH_CELL_PX))
    cell_px = (side - 1) // cells
    return cells, cell_px, (side - 1 - cells * cell_px) // 2


def _smooth(grid: Float32Array) -> Float32Array:
    single = grid.astype(np.float32, copy=False)
    return np.asarray(cv2.GaussianBlur(single, (0, 0), MATCH_SMOOTHING_NODES), dtype=np.float32)


def match_surf(reference: Float32Array, search: Float32Array, margin_nodes: int = 0) -> Match:
    """Find a reference in a search grid by SURF; its place and score are then correlation's.

    Arguments as `compute_similarity_surface`; margin_nodes as `match_ncc`, without descriptors.
    The descriptor's own value discriminates little (right 0.98, wrong up to 0.95), so the score is
    the correlation at the refined peak and the runner-up the correlation at the descriptor's best
    rival: both compare with those of `match_ncc`.
    A peak whose rival is almost as near in descriptor space has an infinite covariance.
    """
    inner = slice(margin_nodes, reference.shape[0] - margin_nodes)
    outer = slice(margin_nodes, search.shape[0] - margin_nodes)
    surface = compute_similarity_surface(reference[inner, inner], search[outer, outer])
    row, col = (int(i) for i in np.unravel_index(int(np.argmax(surface)), surface.shape))
    refined = _refine_match(reference, search, row, col, margin_nodes)
    rivals = surface.copy()
    near = RIVAL_DISTANCE
    rivals[max(row - near, 0) : row + near + 1, max(col - near, 0) : col + near + 1] = -2.0
    if rivals.max() <= -2.0:
        return refined._replace(runner_up=-1.0)
    rival_row, rival_col = (int(i) for i in np.unravel_index(int(np.argmax(rivals)), rivals.shape))
    rival = _refine_match(reference, search, rival_row, rival_col, margin_nodes)
    # unit vectors: squared distance is 2 - 2 cosine
    ratio = np.sqrt(max(1.0 - surface[row, col], 0.0) / max(1.0 - rivals.max(), 1e-9))
    match = refined._replace(runner_up=min(rival.score, refined.score))
    if ratio > MAX_DISTANCE_RATIO:
        return match._replace(covariance=np.diag([np.inf, np.inf]))
    return match


def _refine_match(
    reference: Float32Array, search: Float32Array, row: int, col: int, margin_nodes: int
) -> Match:
    """Correlation within REFINE_NODES of an offset of the surface."""
    last = search.shape[0] - reference.shape[0]
    reach = min(REFINE_NODES, last // 2)
    row, col = (min(max(i, reach), last - reach) for i in (row, col))
    side = reference.shape[0] + 2 * reach
    window = search[row - reach : row - reach + side, col - reach : col - reach + side]
    match = match_ncc(reference, window, margin_nodes)
    half = last // 2
    return match._replace(dx=match.dx + col - half, dy=match.dy + row - half)
