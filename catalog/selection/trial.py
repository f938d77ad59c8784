"""Recognition trials: is a place found again in pictures that differ from its reference?

The picture's side is another ground and another law than the reference's: the DEM with relief
below its posting added, rendered by Hapke on a grid twice as fine, seen from off nadir through a
point-spread function, with noise and 8 bits, and resampled with a wrong scale, roll and place.
The reference is the catalog's patch rendered by Lommel-Seeliger. Both cast shadows. The search
goes as the navigator's does: roll and scale over a small grid at a coarse level (from half as many
nodes a side: as good, and a third of the work), then tracked to the finest.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np

from catalog.arrays import Float32Array, FloatArray
from catalog.correlation.filters import choose_thinning, downsample_blurred, measure_edges
from catalog.correlation.ncc import match_ncc
from catalog.correlation.similarity import match_similarity
from catalog.geometry.kernel import kernel
from catalog.photometry.laws import LUNAR_HAPKE, SurfaceLaw, find_law
from catalog.rendering.map_view import render_levels, render_map_quickly

MAX_TONE = 1.6  # exponent of the picture's tone against an image's, or one over it
FINER = 2  # the picture's ground has this many nodes to one of the finest reference
PSF_SIGMA_PX = 0.7
COUNTS = 255.0
# the brightest percent of a picture may saturate: exposure is set by what is seen
EXPOSURE_PERCENTILE = 99.5
# Ground beyond the window that its outermost pixels depend on, truth nodes: four sigma of the blur,
# one for sampling, one for the slope.
PICTURE_MARGIN = 8
# Noise is drawn once, with so many nodes more a side than a picture: each begins anywhere in it.
NOISE_ROOM, NOISE_SEED = 176, 1


class Level(NamedTuple):
    """The ground of a trial at one pyramid level; both grids are centred on the point.

    reference     (n, n)  the catalog's heights, m
    truth         (t, t)  heights of the ground that is seen, m; sub-posting relief included
    posting_m             of the reference
    blur_nodes            sigma of a blur on both sides, where the reference is finer than the
                          terrain model
    finer                 nodes of the truth to one of the reference, along a side
    """

    reference: Float32Array
    truth: Float32Array
    posting_m: float
    blur_nodes: float = 0.0
    finer: int = FINER


class Circumstances(NamedTuple):
    """The conditions of one trial.

    sun_local, view_local  (3,)  unit vectors east, north, up
    roll, scale            residual turn (rad) and stretch of the resampled picture
    stretch_azimuth        direction (rad east of north) in which the ground is foreshortened
    stretch                its factor, cos(off nadir), 1 when the resampling has taken it out
    shift_m        (2,)    where the point really lies, east and north of where it is expected
    snr                    mean brightness over the noise of one picture pixel
    """

    sun_local: FloatArray
    view_local: FloatArray
    roll: float
    scale: float
    stretch_azimuth: float
    stretch: float
    shift_m: FloatArray
    snr: float


class TrialOutcome(NamedTuple):
    """The result of a trial: error of the place (finest nodes), and whether it was accepted."""

    error: tuple[float, float]
    score: float
    runner_up: float
    accepted: bool

    @property
    def distance(self) -> float:
        """Length of the error, finest nodes."""
        return float(np.hypot(*self.error))


class Gate(NamedTuple):
    """Limits of an accepted match, as in navigation: score, and rival's score over it."""

    min_score: float = 0.5
    rival_ratio: float = 0.9


class Search(NamedTuple):
    """Settings of the search for the reference.

    template_nodes           side of the reference, the same at every level
    coarse_nodes             room on every side at the coarsest level of the trial
    fine_nodes               room at finer levels: what the level before leaves
    rolls, scales            tried at the coarsest level
    """

    template_nodes: int = 64
    coarse_nodes: int = 8
    fine_nodes: int = 5
    rolls: tuple[float, ...] = tuple(np.radians((-5.0, 0.0, 5.0)).tolist())
    scales: tuple[float, ...] = (0.92, 1.0, 1.08)


# A window turned by 6 deg and shrunk by 10 % reaches over this much more ground.
WINDOW_REACH = 1.25
MAX_SHIFT_NODES = 5.0  # of a point from its predicted place


def compute_truth_size(search: Search, finer: int = FINER) -> int:
    """Nodes a side of the truth grid that covers a search window whatever its distortion."""
    window = search.template_nodes + 2 * max(search.coarse_nodes, search.fine_nodes)
    return 2 * math.ceil(finer * window * WINDOW_REACH / 2.0)


def draw_circumstances(
    rng: np.random.Generator,
    suns: FloatArray,
    posting_m: float,
    *,
    max_roll_deg: float = 6.0,
    max_scale: float = 0.1,
    max_off_nadir_deg: float = 25.0,
    snr: tuple[float, float] = (10.0, 50.0),
) -> Circumstances:
    """One trial's circumstances; errors uniform within limits, noise uniform in its logarithm.

    suns  (n, 3)  Sun directions to choose from
    """
    # in plain numbers: the library takes several times as long to scale so few
    roll, scale, off_nadir, turn = rng.random(4).tolist()
    sun_local = np.asarray(suns[rng.integers(len(suns))], dtype=np.float64)
    east, north, loud = rng.random(3).tolist()
    azimuth = 2.0 * math.pi * turn
    angle = abs(2.0 * off_nadir - 1.0) * math.radians(max_off_nadir_deg)
    across = math.sin(angle)
    view = np.array([across * math.sin(azimuth), across * math.cos(azimuth), math.cos(angle)])
    shift = [MAX_SHIFT_NODES * (2.0 * share - 1.0) * posting_m for share in (east, north)]
    return Circumstances(
        sun_local=sun_local,
        view_local=view,
        roll=math.radians((2.0 * roll - 1.0) * max_roll_deg),
        scale=1.0 + (2.0 * scale - 1.0) * max_scale,
        stretch_azimuth=azimuth,
        stretch=math.cos(angle),
        shift_m=np.array(shift),
        snr=snr[0] * (snr[1] / snr[0]) ** loud,
    )


def compute_distortion(circumstances: Circumstances) -> FloatArray:
    """(2, 2): map offsets of the ground (x east, y north) to offsets in the resampled picture."""
    azimuth, short = circumstances.stretch_azimuth, 1.0 - circumstances.stretch
    east, north = math.sin(azimuth), math.cos(azimuth)
    squeeze = [
        [1.0 - short * east * east, -short * east * north],
        [-short * east * north, 1.0 - short * north * north],
    ]
    turned: FloatArray = _make_similarity(circumstances.roll, circumstances.scale) @ np.array(
        squeeze
    )
    return turned


def run_trial(
    levels: Sequence[Level],
    circumstances: Circumstances,
    seed: Sequence[int],
    radius_m: float,
    search: Search = Search(),
    gate: Gate = Gate(),
    outer: Sequence[tuple[Float32Array, float]] = (),
    law: SurfaceLaw | None = LUNAR_HAPKE,
) -> TrialOutcome:
    """Look for a point once.

    levels  finest first; the search starts at the last
    law     that the picture is drawn by; None: both grids of the levels are brightness, that of
            the picture of another tone
    seed    of the noise
    outer   coarser grids (heights, posting_m) that throw shadows in from beyond the last level
    Raises ValueError without a level.
    """
    if not levels:
        raise ValueError("a trial needs at least one level")
    rng = np.random.default_rng(list(seed))
    (a, b), (c, d) = compute_distortion(circumstances).tolist()
    # written out: the library takes ten times as long for so small a matrix
    ground_from_picture = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
    picture_from_ground = np.eye(2)  # as estimated so far
    position = np.zeros(2)  # the point's estimated place in the picture, m east and north
    sun, view = circumstances.sun_local, circumstances.view_local
    grids = [*((level.reference, level.posting_m) for level in levels), *outer]
    tone = 1.0 if law is not None else MAX_TONE ** rng.uniform(-1.0, 1.0)
    around: Sequence[Any] = ()
    if law is None:
        templates = [measure_edges(level.reference) for level in levels]
    else:
        templates, around = render_levels(
            grids, len(levels), sun, radius_m=radius_m, law=find_law("lommel_seeliger")
        )
    for number in range(len(levels) - 1, -1, -1):
        level, posting_m = levels[number], levels[number].posting_m
        coarsest = number == len(levels) - 1
        template = _cut_centre(templates[number], search.template_nodes)
        room = search.coarse_nodes if coarsest else search.fine_nodes
        window = search.template_nodes + 2 * room
        offset = ground_from_picture @ (position - circumstances.shift_m) / posting_m
        truth_from_ground = level.finer * _FLIP
        offset = truth_from_ground @ offset
        truth_from_picture = truth_from_ground @ ground_from_picture @ picture_from_ground @ _FLIP
        side = compute_side(truth_from_picture, offset, window, level.truth.shape[0])
        truth, finer_m = _cut_centre(level.truth, side), posting_m / level.finer
        if law is None:
            seen = np.maximum(truth, np.float32(0.0)) ** np.float32(tone)
        else:
            seen = render_map_quickly(
                truth,
                finer_m,
                sun,
                view_local=view,
                radius_m=radius_m,
                law=law,
                outer=around[number],
            )
        origin, averaging = offset + (side - 1) / 2.0, round(posting_m / levels[0].posting_m)
        picture = simulate_picture(
            seen, truth_from_picture, origin, window, averaging, circumstances.snr, rng, level.finer
        )
        if law is None:
            picture = measure_edges(picture)
        step_m = posting_m
        if level.blur_nodes:
            even = search.template_nodes % 2 == 0
            template = downsample_blurred(template, level.blur_nodes, even)
            picture = downsample_blurred(picture, level.blur_nodes, even)
            step_m *= choose_thinning(level.blur_nodes)
        if coarsest:
            match, roll, scale = match_similarity(
                template, picture, search.rolls, search.scales, halved=True
            )
            picture_from_ground = _make_similarity(roll, scale)
            step = np.array([match.dx, -match.dy])
        else:
            match = match_ncc(template, picture)
            step = picture_from_ground @ np.array([match.dx, -match.dy])
        position = position + step * step_m
        is_peak = bool(np.isfinite(match.covariance).all())
        if not is_peak:
            break
    error = (position - circumstances.shift_m) / levels[0].posting_m
    accepted = (
        is_peak
        and match.score >= gate.min_score
        and match.runner_up <= gate.rival_ratio * match.score
    )
    return TrialOutcome((float(error[0]), float(error[1])), match.score, match.runner_up, accepted)


# between map axes (x east, y north) and grid axes (x along columns, y along rows)
_FLIP = np.diag([1.0, -1.0])


def _make_similarity(roll: float, scale: float) -> FloatArray:
    cosine, sine = scale * math.cos(roll), scale * math.sin(roll)
    return np.array([[cosine, -sine], [sine, cosine]])


def _cut_centre(grid: Float32Array, size: int) -> Float32Array:
    first = (grid.shape[0] - size) // 2
    return grid[first : first + size, first : first + size]


def simulate_picture(
    brightness: Float32Array,
    ground_from_picture: FloatArray,
    origin: FloatArray,
    size: int,
    averaging: int,
    snr: float,
    rng: np.random.Generator,
    finer: int = FINER,
) -> Float32Array:
    """The resampled picture (size, size): blurred, sampled, noisy, in 8 bits.

    brightness           (t, t)  on the truth grid
    ground_from_picture  (2, 2)  offsets in the picture to offsets on the truth grid, node to node,
                                 x along columns, y along rows
    origin               (2,)    truth column and row under the picture's centre
    averaging                    picture pixels averaged into one node, each way: lowers the noise
    finer                        nodes of the truth to one of the picture, along a side
    """
    # a pixel integrates over its own area: a box of one node has sigma 1/sqrt(12)
    sigma = finer * math.hypot(PSF_SIGMA_PX / averaging, 1.0 / math.sqrt(12.0))
    blurred = cv2.GaussianBlur(brightness, (0, 0), sigma)
    (a, b), (c, d) = ground_from_picture.tolist()
    (x, y), half = origin.tolist(), (size - 1) / 2.0
    matrix = np.array([[a, b, x - (a + b) * half], [c, d, y - (c + d) * half]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    sampled = cv2.warpAffine(blurred, matrix, (size, size), flags=flags, borderValue=float("nan"))
    noise = _draw_noise(size, rng)
    return scale_to_counts(np.asarray(sampled, dtype=np.float32), noise, 1.0 / (snr * averaging))


def _draw_noise(size: int, rng: np.random.Generator) -> Float32Array:
    """Noise of unit variance (size, size): what one trial has says nothing of another's.

    Drawing it anew takes ten times as long.
    """
    row, col = rng.integers(0, NOISE_ROOM, 2, endpoint=True).tolist()
    return np.ascontiguousarray(_draw_wide_noise(size)[row : row + size, col : col + size])


@lru_cache(maxsize=8)
def _draw_wide_noise(size: int) -> Float32Array:
    shape = size + NOISE_ROOM, size + NOISE_ROOM
    return np.random.default_rng(NOISE_SEED).standard_normal(shape, dtype=np.float32)


@kernel
def _sum_of_valid(sampled: Float32Array) -> tuple[float, int]:
    """Sum and number of the values that are not NaN."""
    total, valid = 0.0, 0
    for r in range(sampled.shape[0]):
        for c in range(sampled.shape[1]):
            if sampled[r, c] == sampled[r, c]:
                total += sampled[r, c]
                valid += 1
    return total, valid


@kernel
def _insert(top: Float32Array, value: np.float32) -> None:
    """Put a value into a rising array in the place of its first element."""
    k = 1
    while k < top.size and top[k] < value:
        top[k - 1] = top[k]
        k += 1
    top[k - 1] = value


@kernel
def scale_to_counts(
    sampled: Float32Array, noise: Float32Array, relative_noise: float
) -> Float32Array:
    """Whole counts (rows, cols) of brightness with noise, NaN where the brightness is.

    noise           (rows, cols)  of unit variance
    relative_noise  its share of the mean brightness
    """
    rows, cols = sampled.shape
    total, valid = _sum_of_valid(sampled)
    out = np.empty_like(sampled)
    if valid == 0:
        out[:] = np.nan
        return out
    # the percentile lies between two of the brightest, the first two of `top`, which rises
    rank = (valid - 1) * EXPOSURE_PERCENTILE / 100.0
    below = int(rank)
    top = np.full(valid - below, -np.inf, np.float32)
    sigma = np.float32(total / valid * relative_noise)
    for r in range(rows):
        for c in range(cols):
            value = sampled[r, c] + noise[r, c] * sigma
            out[r, c] = value
            if value > top[0]:
                _insert(top, value)
    white = float(top[0])
    if top.size > 1:
        white += (rank - below) * (float(top[1]) - white)
    gain = np.float32(COUNTS / max(white, 1e-6))
    for r in range(rows):
        line = out[r]
        for c in range(cols):
            line[c] = min(max(np.rint(line[c] * gain), np.float32(0.0)), np.float32(COUNTS))
    for r in range(rows):
        for c in range(cols):
            if sampled[r, c] != sampled[r, c]:
                out[r, c] = np.nan
    return out


def compute_side(
    ground_from_picture: FloatArray, offset: FloatArray, size: int, largest: int
) -> int:
    """Nodes a side, even, of the centred part of the truth grid that a picture needs.

    ground_from_picture, size  as `simulate_picture` takes them
    offset   (2,)  truth nodes from the grid's centre to the picture's
    largest  side of the whole, even
    """
    half = (size - 1) / 2.0
    reach: float = max(
        abs(middle) + (abs(a) + abs(b)) * half
        for middle, (a, b) in zip(offset.tolist(), ground_from_picture.tolist())
    )
    return min(2 * math.ceil(reach + PICTURE_MARGIN + 0.5), largest)
