"""A plane grid in a picture: which dot or corner is which, and where it is.

Patterns are those of OpenCV's calibration: circles, acircles (CALIB_CB_ASYMMETRIC_GRID) and
chessboard. For dots OpenCV finds round spots; from one in the middle on each is looked for where
its neighbours lead, so that a lens with distortion, a tilted grid, spots that are none of it and
dots that are lost do no harm. Middles are then centres of brightness of windows, which a blurred
edge leaves where they are.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from catalog.arrays import Float32Array, FloatArray, IntArray
from catalog.errors import NoSolutionError
from optnav_cli.reasons import ReasonCode

DETECTED_PX = 2000  # longer side of the picture that dots are sought in
MIN_SIDE, MAX_SPOTS = 3, 10_000  # dots in a row, spots in a picture
MIN_AREA_PX, MAX_AREA_SHARE = 12.0, 0.02  # of a dot, of the picture
MAX_LOST = 0.1  # of the grid's dots
STRETCH = (0.5, 99.5)  # percentiles of the picture that become black and white
SQUARE = 0.5  # cosine between the two directions to neighbours, at most: a tilted grid is no square
NEAR = 0.3  # of a step: as far from where it is looked for a neighbour may be
WINDOW = 0.42  # of the distance of neighbours: half the window about a dot
CORNER_WINDOW = 0.35  # of the distance of corners: half the window about one
TRIMMED = 0.15  # of the contrast: fainter is paper and noise
REFINEMENTS = 3
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


Pattern = Literal["circles", "acircles", "chessboard"]


@dataclass(frozen=True, eq=False)
class GridDots:
    """Dots or corners of a picture: pixels (n, 2), and where on the sheet each is, (n, 2).

    places  along both sides, in steps; dots of an asymmetric grid are at (2 column + row % 2, row)
    size    columns and rows of the grid, as OpenCV counts them
    """

    pixels: FloatArray
    places: IntArray
    size: tuple[int, int]


def find_grid(
    values: Float32Array, size: tuple[int, int] | None, pattern: Pattern | None = None
) -> GridDots:
    """Find the grid in a picture (rows, columns): dots of either kind, or corners if so stated.

    size     columns and rows of dots, or of inner corners; found if None, but for a chessboard
    pattern  by OpenCV's name; None for dots of either kind
    Raises NoSolutionError where there is no whole grid.
    """
    if pattern == "chessboard":
        return _find_corners(values, size)
    return find_dots(values, size, pattern)


def _find_corners(values: Float32Array, size: tuple[int, int] | None) -> GridDots:
    """Find the inner corners of a chessboard."""
    if size is None or min(size) < MIN_SIDE:
        raise NoSolutionError(
            f"a chessboard's size is not stated; give its inner corners, at least {MIN_SIDE} x "
            f"{MIN_SIDE}",
            ReasonCode.NO_BODY,
        )
    scaled = _stretch(values)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    seen, corners = cv2.findChessboardCornersSB(scaled, size, flags=flags)
    if not seen:
        raise NoSolutionError(
            f"no chessboard of {size[0]} x {size[1]} inner corners; show the whole board with a "
            "light border, and count inner corners, not squares",
            ReasonCode.NO_BODY,
        )
    # a copy: views of another layout are refused as an output array
    pixels = np.array(corners, np.float32).reshape(-1, 2)
    apart = float(cKDTree(pixels).query(pixels, 2)[0][:, 1].min())
    reach = max(int(CORNER_WINDOW * apart), 2)
    ending = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    refined = cv2.cornerSubPix(
        scaled, pixels.reshape(-1, 1, 2).copy(), (reach, reach), (-1, -1), ending
    )
    number = np.arange(size[0] * size[1])
    places = np.stack([number % size[0], number // size[0]], axis=1)
    return GridDots(np.asarray(refined, np.float64).reshape(-1, 2), places, size)


def _stretch(values: Float32Array) -> NDArray[np.uint8]:
    """Stretch to eight bits between black and white. Raises NoSolutionError for a flat picture."""
    low, high = np.percentile(values, STRETCH)
    if not high > low:
        raise NoSolutionError("no grid of dots: the picture is flat", ReasonCode.NO_BODY)
    scaled: NDArray[np.uint8] = np.clip((values - low) * (255.0 / (high - low)), 0.0, 255.0).astype(
        np.uint8
    )
    return scaled


def find_dots(
    values: Float32Array, size: tuple[int, int] | None, pattern: Pattern | None = None
) -> GridDots:
    """Find the dots of a grid, dark on light or light on dark, in a picture (rows, columns).

    size     columns and rows of dots; found if None
    pattern  circles or acircles; None for the one that there is
    Raises NoSolutionError where there is no whole grid.
    """
    factor = min(1.0, DETECTED_PX / max(values.shape))
    scaled = _stretch(values)
    if factor < 1.0:
        small = cv2.resize(scaled, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        scaled = np.asarray(small, np.uint8)
    words = []
    for colour, name in ((0, "dark"), (255, "light")):
        spots = _detect_spots(scaled, colour)
        pixels, places = _track_grid(spots)
        columns, rows = (int(n) for n in places.max(axis=0) + 1) if len(places) else (0, 0)
        words.append(f"{len(pixels)} of {len(spots)} {name} spots lie on {columns} x {rows} places")
        for named, kind in (("circles", _match_rectangle), ("acircles", _match_asymmetric)):
            grid = kind(places, size) if pattern in (None, named) else None
            if grid is not None:
                # of a picture that was made smaller: middles of its pixels
                middles = (pixels + 0.5) / factor - 0.5
                return GridDots(_refine_centres(values, middles, dark=colour == 0), *grid)
    wanted = "" if size is None else f" of {size[0]} x {size[1]} dots"
    wanted = f" ({pattern})" + wanted if pattern else wanted
    raise NoSolutionError(
        f"no grid{wanted}: {' and '.join(words)}; show the whole grid of at least {MIN_SIDE} x "
        f"{MIN_SIDE} round dots, sharp and evenly lit",
        ReasonCode.NO_BODY,
    )


Numbered = tuple[IntArray, tuple[int, int]]


def _match_rectangle(places: IntArray, size: tuple[int, int] | None) -> Numbered | None:
    """Match places (n, 2) to a whole rectangle of dots; None where they are none."""
    if not len(places):
        return None
    columns, rows = (int(n) for n in places.max(axis=0) + 1)
    if size is not None and (rows, columns) == size != (columns, rows):
        places, (columns, rows) = places[:, ::-1], size
    is_complete = len(places) >= (1.0 - MAX_LOST) * columns * rows
    if min(columns, rows) < MIN_SIDE or not is_complete or size not in (None, (columns, rows)):
        return None
    return places, (columns, rows)


def _match_asymmetric(places: IntArray, size: tuple[int, int] | None) -> Numbered | None:
    """Match places to OpenCV's asymmetric grid; None where dots are none.

    Its dots stand on a square lattice that is turned by 45 deg: dot j of row i at (2 j + i % 2, i).
    """
    if not len(places):
        return None
    turned = np.stack([places[:, 0] + places[:, 1], places[:, 0] - places[:, 1]], axis=1)
    turned = turned - turned.min(axis=0)
    across, along = (int(n) for n in turned.max(axis=0) + 1)
    for steps, (wide, rows) in ((turned, (across, along)), (turned[:, ::-1], (along, across))):
        grid_size = wide // 2, rows
        # each row has the same number of dots, so the sheet is an even number of steps wide
        if wide % 2 or min(grid_size) < MIN_SIDE or size not in (None, grid_size):
            continue
        if len(steps) >= (1.0 - MAX_LOST) * grid_size[0] * rows:
            # the first row begins at the border, as OpenCV's does: else it is seen from its end
            first = steps.sum(axis=1) % 2
            if first.mean() > 0.5:
                steps = steps * [1, -1] + [0, rows - 1]
            if (steps.sum(axis=1) % 2).mean() > 0.5:
                steps = steps * [-1, 1] + [wide - 1, 0]
            return steps, grid_size
    return None


def _detect_spots(picture: NDArray[np.uint8], colour: int) -> FloatArray:
    """Detect round spots (n, 2), dark ones for colour 0, light ones for 255."""
    wanted = cv2.SimpleBlobDetector.Params()
    wanted.blobColor, wanted.filterByColor = colour, True
    wanted.minThreshold, wanted.maxThreshold, wanted.thresholdStep = 20.0, 240.0, 20.0
    wanted.minArea, wanted.maxArea = MIN_AREA_PX, MAX_AREA_SHARE * picture.size
    wanted.filterByArea, wanted.minDistBetweenBlobs = True, 3.0
    wanted.filterByCircularity, wanted.minCircularity = True, 0.5
    wanted.filterByInertia, wanted.minInertiaRatio = True, 0.1
    wanted.filterByConvexity, wanted.minConvexity = True, 0.85
    spots = cv2.SimpleBlobDetector.create(wanted).detect(picture)
    return np.array([spot.pt for spot in spots], np.float64).reshape(-1, 2)


def _track_grid(spots: FloatArray) -> tuple[FloatArray, IntArray]:
    """Track the grid from spot to spot: spots (n, 2), their columns and rows (n, 2), from 0 on."""
    nothing = np.empty((0, 2)), np.empty((0, 2), np.int64)
    if not 2 * MIN_SIDE <= len(spots) <= MAX_SPOTS:
        return nothing
    tree = cKDTree(spots)
    first = int(tree.query(np.median(spots, axis=0))[1])
    near = (
        spots[tree.query(spots[first], 9 if len(spots) > 8 else len(spots))[1][1:]] - spots[first]
    )
    along = near[0]
    cosines = near @ along / (np.linalg.norm(near, axis=1) * np.linalg.norm(along))
    beside = near[np.abs(cosines) < SQUARE]
    if not len(beside):
        return nothing
    numbers = {(0, 0): first}
    # the steps to the next column and row as they are about each spot
    bases = {(0, 0): np.array([along, beside[0]])}
    taken, queue = {first}, [(0, 0)]
    while queue:
        here = queue.pop(0)
        base = bases[here]
        for step in STEPS:
            there = here[0] + step[0], here[1] + step[1]
            move = np.array(step, np.float64) @ base
            distance, number = tree.query(spots[numbers[here]] + move)
            if there in numbers or number in taken or distance > NEAR * float(np.linalg.norm(move)):
                continue
            numbers[there] = int(number)
            taken.add(int(number))
            changed = base.copy()
            # halfway: a step's own error would be handed on
            measured_step = (spots[number] - spots[numbers[here]]) * float(sum(step))
            changed[0 if step[0] else 1] = 0.5 * (measured_step + changed[0 if step[0] else 1])
            bases[there] = changed
            queue.append(there)
    places = np.array(list(numbers), np.int64)
    return spots[list(numbers.values())], places - places.min(axis=0)


def _refine_centres(values: Float32Array, dots: FloatArray, dark: bool) -> FloatArray:
    """Refine the middles of dots (n, 2) by the brightness about them."""
    nearest = cKDTree(dots).query(dots, 2)[0][:, 1]
    centres = dots.copy()
    for number, reach in enumerate(WINDOW * nearest):
        for _ in range(REFINEMENTS):
            centres[number] = _locate_centroid(values, centres[number], float(reach), dark)
    return centres


def _locate_centroid(values: Float32Array, at: FloatArray, reach: float, dark: bool) -> FloatArray:
    """Locate the centre of what is darker, or lighter, than the paper, within a circle."""
    x0, y0 = (int(np.floor(coordinate - reach)) for coordinate in at)
    x1, y1 = (int(np.ceil(coordinate + reach)) + 1 for coordinate in at)
    x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, values.shape[1]), min(y1, values.shape[0])
    part = values[y0:y1, x0:x1].astype(np.float64) * (-1.0 if dark else 1.0)
    y, x = np.mgrid[y0:y1, x0:x1]
    inside = (x - at[0]) ** 2 + (y - at[1]) ** 2 <= reach**2
    if not inside.any():
        return at
    paper, ink = np.quantile(part[inside], (0.1, 0.95))
    weights = np.where(inside, np.clip(part - paper - TRIMMED * (ink - paper), 0.0, None), 0.0)
    total = float(weights.sum())
    if not total > 0.0:
        return at
    return np.array([(weights * x).sum(), (weights * y).sum()]) / total
