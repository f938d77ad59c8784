"""A plane grid of round dots in a picture: which dot is which, and where its middle is.

OpenCV finds round spots; from one in the middle on each is looked for where its neighbours lead, so
that a lens with distortion, a tilted grid, spots that are none of it and dots that are lost do no
harm. Middles are then centres of brightness of windows, which a blurred edge leaves where they are.
"""

from dataclasses import dataclass

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
TRIMMED = 0.15  # of the contrast: fainter is paper and noise
REFINEMENTS = 3
STEPS = ((1, 0), (-1, 0), (0, 1), (0, -1))


@dataclass(frozen=True, eq=False)
class GridDots:
    """Dots of a picture: pixels (n, 2), and which column and row each is of, (n, 2).

    size  columns and rows of the grid
    """

    pixels: FloatArray
    places: IntArray
    size: tuple[int, int]


def find_dots(values: Float32Array, size: tuple[int, int] | None) -> GridDots:
    """The dots of a grid, dark on light or light on dark, in a picture (rows, columns).

    size  columns and rows of dots; found if None
    Raises NoSolutionError where there is no whole grid.
    """
    factor = min(1.0, DETECTED_PX / max(values.shape))
    low, high = np.percentile(values, STRETCH)
    if not high > low:
        raise NoSolutionError("no grid of dots: the picture is flat", ReasonCode.NO_BODY)
    scaled = np.clip((values - low) * (255.0 / (high - low)), 0.0, 255.0).astype(np.uint8)
    if factor < 1.0:
        scaled = cv2.resize(scaled, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    words = []
    for colour, name in ((0, "dark"), (255, "light")):
        spots = _spots(scaled, colour)
        pixels, places = _followed(spots)
        columns, rows = (int(n) for n in places.max(axis=0) + 1) if len(places) else (0, 0)
        if size is not None and (rows, columns) == size != (columns, rows):
            places, (columns, rows) = places[:, ::-1], size
        words.append(f"{len(pixels)} of {len(spots)} {name} spots lie on {columns} x {rows} places")
        whole = len(pixels) >= (1.0 - MAX_LOST) * columns * rows
        if min(columns, rows) < MIN_SIDE or not whole or size not in (None, (columns, rows)):
            continue
        # of a picture that was made smaller: middles of its pixels
        pixels = (pixels + 0.5) / factor - 0.5
        return GridDots(_centred(values, pixels, dark=colour == 0), places, (columns, rows))
    wanted = "" if size is None else f" of {size[0]} x {size[1]} dots"
    raise NoSolutionError(
        f"no grid{wanted}: {' and '.join(words)}; show the whole grid of at least {MIN_SIDE} x "
        f"{MIN_SIDE} round dots, sharp and evenly lit",
        ReasonCode.NO_BODY,
    )


def _spots(picture: NDArray[np.uint8], colour: int) -> FloatArray:
    """Places (n, 2) of round spots, dark ones for colour 0, light ones for 255."""
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


def _followed(spots: FloatArray) -> tuple[FloatArray, IntArray]:
    """The spots of a grid (n, 2) and their columns and rows (n, 2), from 0 on; empty for none."""
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
    found = {(0, 0): first}
    # the steps to the next column and row as they are about each spot
    bases = {(0, 0): np.array([along, beside[0]])}
    taken, queue = {first}, [(0, 0)]
    while queue:
        here = queue.pop(0)
        base = bases[here]
        for step in STEPS:
            there = here[0] + step[0], here[1] + step[1]
            move = np.array(step, np.float64) @ base
            away, number = tree.query(spots[found[here]] + move)
            if there in found or number in taken or away > NEAR * float(np.linalg.norm(move)):
                continue
            found[there] = int(number)
            taken.add(int(number))
            changed = base.copy()
            # halfway: a step's own error would be handed on
            own = (spots[number] - spots[found[here]]) * float(sum(step))
            changed[0 if step[0] else 1] = 0.5 * (own + changed[0 if step[0] else 1])
            bases[there] = changed
            queue.append(there)
    places = np.array(list(found), np.int64)
    return spots[list(found.values())], places - places.min(axis=0)


def _centred(values: Float32Array, dots: FloatArray, dark: bool) -> FloatArray:
    """Middles of dots (n, 2) by the brightness about them."""
    nearest = cKDTree(dots).query(dots, 2)[0][:, 1]
    found = dots.copy()
    for number, reach in enumerate(WINDOW * nearest):
        for _ in range(REFINEMENTS):
            found[number] = _centroid(values, found[number], float(reach), dark)
    return found


def _centroid(values: Float32Array, at: FloatArray, reach: float, dark: bool) -> FloatArray:
    """Centre of what is darker, or lighter, than the paper, within a circle."""
    x0, y0 = (int(np.floor(place - reach)) for place in at)
    x1, y1 = (int(np.ceil(place + reach)) + 1 for place in at)
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
