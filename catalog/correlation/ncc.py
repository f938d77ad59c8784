"""Normalised cross-correlation of a reference against a larger grid, both high-passed.

The high-pass takes out albedo, slope trends and the slow change of illumination, which a
rendered reference does not have (Zhukov 2025, ch. 3, uses plain correlation).

`match_masked` takes grids with holes: at every place it correlates the nodes that both have.
Source: D. Padfield, "Masked object registration in the Fourier domain", IEEE Trans. Image Process.
21 (2012). A frame that shows a part of a template's ground is compared in that part.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from catalog.arrays import BoolArray, Float32Array, FloatArray
from catalog.correlation.filters import (
    MIN_CONTRAST,
    Filtered,
    Number,
    crop,
    filter_grid,
    filter_grid_quickly,
    filter_high_pass_quickly,
    find_max_size,
)
from catalog.correlation.peak import Match, locate_peak
from catalog.correlation.remainder import Remainder, place_patterns, refine_by_remainder
from catalog.geometry.kernel import inplace_kernel, kernel

# By what a match leaves over its place moves by no more than this.
MAX_STEP_NODES = 0.7
# Scores of so few places a side are summed one by one: quicker than by transforms of the grids.
MAX_DIRECT_PLACES = 15
# A place where both have less than this share of the nodes that they have at the best is none:
# a few nodes correlate by chance.
MIN_COMMON_SHARE = 0.7


def correlate_grids(template: Filtered, image: Filtered) -> Float32Array:
    """Scores of a reference at every place where it fits whole into the search grid.

    template (n, n), image (m, m) with m - n even, both of `filter_grid`.
    Returns (m - n + 1, m - n + 1); the middle element is the centred place.
    Raises ValueError for sizes that cannot be centred on each other.
    """
    (height, width), (rows, cols) = template.values.shape, image.values.shape
    room = (rows - height, cols - width)
    if min(room) < 0 or room[0] % 2 or room[1] % 2:
        raise ValueError(
            f"reference ({height}, {width}) cannot be centred in search {(rows, cols)}"
        )
    surface = np.asarray(
        cv2.matchTemplate(image.values, template.values, cv2.TM_CCOEFF_NORMED), dtype=np.float32
    )
    # A side without contrast has no correlation; OpenCV then returns ones, rounding noise decides.
    if float(cv2.meanStdDev(template.values)[1][0, 0]) <= template.floor:
        return np.full_like(surface, -1.0)
    _reject_flat_windows(image.values, height, width, image.floor, surface)
    return surface


def _correlate_quickly(template: Filtered, image: Filtered) -> Float32Array:
    """Correlate as `correlate_grids` does, to rounding, in a third of its time for few places.

    Not in its place: catalogs' trials go by that, and their digests by its last bits.
    """
    room = image.values.shape[0] - template.values.shape[0]
    if not 0 <= room < MAX_DIRECT_PLACES or room % 2:
        return correlate_grids(template, image)
    surface = np.empty((room + 1, room + 1), np.float32)
    _fill_few_scores(template.values, image.values, template.floor, image.floor, surface)
    return surface


@kernel
def _fill_few_scores(
    template: Float32Array,
    image: Float32Array,
    least_rms: float,
    least_window_rms: float,
    surface: Float32Array,
) -> None:
    """Fill in the scores of a few places, one by one; -1 where a side has no contrast.

    least_rms, least_window_rms  contrast of the template and of a window that is rounding
    """
    height, width = template.shape
    nodes = height * width
    columns, squares = np.empty(image.shape[1]), np.empty(image.shape[1])
    columns[:width] = 0.0
    for r in range(height):
        for c in range(width):
            columns[c] += template[r, c]
    mean = columns[:width].sum() / nodes
    centred = np.empty((height, width), np.float32)
    columns[:width] = 0.0
    for r in range(height):
        for c in range(width):
            off = template[r, c] - mean
            centred[r, c] = np.float32(off)
            columns[c] += off * off
    length2 = columns[:width].sum()
    if not np.sqrt(length2 / nodes) > least_rms:
        surface[:] = np.float32(-1.0)
        return
    products = np.empty(width)
    for i in range(surface.shape[0]):
        columns[:], squares[:] = 0.0, 0.0
        for r in range(i, i + height):
            for c in range(image.shape[1]):
                value = float(image[r, c])
                columns[c] += value
                squares[c] += value * value
        for j in range(surface.shape[1]):
            total, square = columns[j : j + width].sum(), squares[j : j + width].sum()
            if square <= least_window_rms * least_window_rms * nodes:
                surface[i, j] = np.float32(-1.0)
                continue
            _add_products(centred, image, i, j, products)
            deviation = square - total * total / nodes
            # of a window without contrast about its mean rounding alone is left
            score = (
                products.sum() / np.sqrt(length2 * deviation) if deviation > 1e-9 * square else 0.0
            )
            surface[i, j] = np.float32(min(max(score, -1.0), 1.0))


@inplace_kernel
def _add_products(
    centred: Float32Array, image: Float32Array, top: int, left: int, products: FloatArray
) -> None:
    """Fill sums (width,) down the columns of a template (height, width) times what lies under it.

    A sum a column, so that products are not added one after the other.
    """
    height, width = centred.shape
    for c in range(width):
        products[c] = 0.0
    fours = height - height % 4
    for r in range(0, fours, 4):
        a, b, d, e = centred[r], centred[r + 1], centred[r + 2], centred[r + 3]
        f, g = image[top + r, left : left + width], image[top + r + 1, left : left + width]
        h, k = image[top + r + 2, left : left + width], image[top + r + 3, left : left + width]
        for c in range(width):
            products[c] += float(a[c] * f[c] + b[c] * g[c] + (d[c] * h[c] + e[c] * k[c]))
    for r in range(fours, height):
        a, f = centred[r], image[top + r, left : left + width]
        for c in range(width):
            products[c] += float(a[c] * f[c])


@kernel
def _reject_flat_windows(
    image: Float32Array, height: int, width: int, least_rms: float, surface: Float32Array
) -> None:
    """Put -1 where the rms of the (height, width) window under a score is least_rms or less."""
    rows, cols = image.shape
    columns = np.zeros(cols)
    for row in range(rows):
        for c in range(cols):
            columns[c] += image[row, c] * image[row, c]
        first = row - height + 1
        if first < 0:
            continue
        total = 0.0
        for c in range(cols):
            total += columns[c]
            if c >= width - 1:
                # running sums leave rounding of the largest term behind: far below a floor of
                # 1e-10 of the brightness squared in double precision
                if total <= least_rms * least_rms * height * width:
                    surface[first, c - width + 1] = -1.0
                total -= columns[c - width + 1]
        for c in range(cols):
            columns[c] -= image[first, c] * image[first, c]


def match_ncc(reference: Float32Array, search: Float32Array, margin_nodes: int = 0) -> Match:
    """Find a reference (n, n) in a search grid (m, m), m - n even, by correlation.

    Both are float32 with NaN for no data, and carry `margin_nodes` that only the high-pass sees.
    """
    return match_in(reference, filter_grid(search, margin_nodes=margin_nodes), margin_nodes)


def match_in(reference: Float32Array, image: Filtered, margin_nodes: int = 0) -> Match:
    """`match_ncc` in a search grid that is filtered already."""
    nodes = int(np.count_nonzero(np.isfinite(crop(reference, margin_nodes))))
    return locate_peak(
        correlate_grids(filter_grid(reference, margin_nodes=margin_nodes), image), nodes
    )


def match_masked(
    reference: Float32Array,
    search: Float32Array,
    margin_nodes: int = 0,
    image: Filtered | None = None,
) -> Match:
    """Find a reference (n, n) in a search grid (m, m), m - n even; NaN of either takes no part.

    image  of the search grid, where it is `filter_grid` already
    Both are float32 and carry `margin_nodes` that only the high-pass sees. The reference is cut as
    the search grid is about its middle before the high-pass, so that both bend at the same edges.
    """
    room = (search.shape[0] - reference.shape[0]) // 2
    reference = np.where(np.isfinite(crop(search, room)), reference, np.float32(np.nan))
    both = reference, search
    has, shows = (np.isfinite(crop(grid, margin_nodes)).astype(np.float32) for grid in both)
    template = filter_grid_quickly(reference, margin_nodes)
    surface, common = _correlate_masked(
        template, has, image or filter_grid_quickly(search, margin_nodes), shows
    )
    return locate_peak(surface, round(float(common.flat[surface.argmax()])))


def _correlate_masked(
    template: Filtered, has: Float32Array, image: Filtered, shows: Float32Array
) -> tuple[Float32Array, FloatArray]:
    """Scores at every place where the template fits, -1 with too few nodes; and common nodes."""
    part, full = template.values, image.values
    places, side = full.shape[0] - part.shape[0] + 1, cv2.getOptimalDFTSize(full.shape[0])
    images = [_transform_padded(grid, side) for grid in (shows, full, full * full)]
    parts = [_transform_padded(grid, side) for grid in (has, part, part * part)]

    def sums(i: int, k: int) -> FloatArray:
        """Sum products of an image and a template at every place where the latter fits."""
        both = cv2.mulSpectrums(images[i], parts[k], 0, conjB=True)
        flags = cv2.DFT_INVERSE | cv2.DFT_SCALE | cv2.DFT_REAL_OUTPUT
        # rows beyond those wanted are left out of the transform
        made = cv2.dft(both, flags=flags, nonzeroRows=places)
        return made[:places, :places].astype(np.float64)

    common = sums(0, 0)
    n = np.maximum(common, 1.0)
    of_part, of_whole = sums(0, 1), sums(1, 0)
    product = sums(1, 1) - of_part * of_whole / n
    part_square = sums(0, 2) - of_part**2 / n
    whole_square = sums(2, 0) - of_whole**2 / n
    enough = common >= max(MIN_COMMON_SHARE * common.max(), 1.0)
    # a side without contrast has no correlation: rounding noise would decide
    enough &= (part_square > n * template.floor**2) & (whole_square > n * image.floor**2)
    square = np.where(enough, part_square * whole_square, 1.0)
    surface = np.where(enough, product / np.sqrt(square), -1.0)
    return np.clip(surface, -1.0, 1.0).astype(np.float32), common


def _transform_padded(grid: Float32Array, side: int) -> Float32Array:
    """Transform of a square grid with zeros behind it to a side."""
    padded = np.zeros((side, side), np.float32)
    padded[: grid.shape[0], : grid.shape[1]] = grid
    return np.asarray(cv2.dft(padded, nonzeroRows=grid.shape[0]))


def match_cut(
    reference: Float32Array,
    search: Float32Array,
    image: Filtered,
    margin_nodes: int,
    remainder: bool,
) -> Match:
    """Match by `match_ncc`, or by `match_masked` where the search grid lacks some of its nodes.

    image      of the search grid, `filter_grid`
    remainder  whether the covariance is that of `add_remainder_covariance`
    """
    has, shows = np.isfinite(reference), np.isfinite(search)
    known = crop(has, margin_nodes)
    # what the reference covers wherever it is laid
    covered = margin_nodes + search.shape[0] - reference.shape[0]
    cut = known.all() and not crop(shows, covered).all()
    if not cut:
        soft = filter_high_pass_quickly((reference,), has)[0]
        template = Filtered(crop(soft, margin_nodes), MIN_CONTRAST * find_max_size(reference))
        match = locate_peak(_correlate_quickly(template, image), int(np.count_nonzero(known)))
        cut = not shows.all() and (known & ~cut_match(shows, known, match)).any()
    if cut:
        # zeros for what the grid lacks would pull the reference inward
        match = match_masked(reference, search, margin_nodes, image)
    elif remainder and np.isfinite(match.covariance).all():
        both = has & cut_match(shows, has, match)
        if both.all():
            patch = cut_match(image.values, template.values, match)
            return _refine_match(match, soft, patch, both, margin_nodes)
    return add_remainder_covariance(match, reference, search, margin_nodes) if remainder else match


def add_remainder_covariance(
    match: Match, reference: Float32Array, search: Float32Array, margin_nodes: int
) -> Match:
    """A match with the covariance that its remainder gives; see `refine_by_remainder`.

    reference, search, margin_nodes  as `match_masked` took them. A peak that is none stays so.
    """
    if not np.isfinite(match.covariance).all():
        return match
    seen = cut_match(search, reference, match)
    both = np.isfinite(reference) & np.isfinite(seen)
    template, patch = filter_high_pass_quickly((reference, seen), both)
    return _refine_match(match, template, crop(patch, margin_nodes), both, margin_nodes)


def _refine_match(
    match: Match, template: Float32Array, patch: Float32Array, both: BoolArray, margin_nodes: int
) -> Match:
    """With high-passed grids; the patch and what both have: about the nearest node of the match."""
    patterns = place_patterns(match, template, margin_nodes)
    compared = crop(both, margin_nodes)
    nodes = int(np.count_nonzero(compared))
    if nodes < compared.size:
        patterns, patch = patterns * compared, patch * compared
    return apply_remainder(match, refine_by_remainder(patterns, patch, nodes))


def apply_remainder(match: Match, found: Remainder) -> Match:
    """A match with the place and covariance that its remainder gives."""
    if not np.isfinite(found.covariance).all():
        return match._replace(covariance=found.covariance)
    # a step of more than a node is beyond what slopes can tell
    x, y = found.shift * min(1.0, MAX_STEP_NODES / max(float(np.hypot(*found.shift)), 1e-9))
    return match._replace(dx=match.dx + x, dy=match.dy + y, covariance=found.covariance)


def cut_match(search: NDArray[Number], reference: NDArray[Any], match: Match) -> NDArray[Number]:
    """The nodes (n, n) of a search grid on which a reference lies where it was found."""
    side = reference.shape[0]
    room = (search.shape[0] - side) // 2
    row, col = room + int(np.rint(match.dy)), room + int(np.rint(match.dx))
    return search[row : row + side, col : col + side]
