"""Which way the camera moved: the axes R, N, B of true positions."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from catalog.geometry.rotations import rnb_axes
from optnav_cli.imagery.truth import Truth

FloatArray = NDArray[np.float64]
Forward = Literal["motion", "north"]
# Frames further apart than this in time or on the ground are not neighbours of one pass: the
# chord between them would no longer tell the direction of motion to a few degrees.
LARGEST_GAP_S = 1200.0
LARGEST_GAP_DEG = 60.0
SPEEDS_M_S = (1.0, 20e3)  # slower is standing still, faster is another pass
LEAST_ACROSS = 0.02  # share of the motion across the vertical that still gives a direction


def directions_of_motion(truths: Sequence[Truth]) -> list[tuple[FloatArray, Forward]]:
    """Axes R, N, B as rows (3, 3) for each true position, and what N rests on.

    N points along the chord between the neighbours in time that belong to the same pass, as the
    body sees it; where there is none, or the motion is vertical, N is local north ("north").
    """
    order = sorted(range(len(truths)), key=lambda index: truths[index].tdb_s)
    axes: list[tuple[FloatArray, Forward]] = [(np.eye(3), "north")] * len(truths)
    for place, index in enumerate(order):
        here = truths[index]
        before = truths[order[place - 1]] if place else None
        after = truths[order[place + 1]] if place + 1 < len(order) else None
        start = before if before is not None and _same_pass(before, here) else here
        end = after if after is not None and _same_pass(here, after) else here
        axes[index] = _axes(here.position_m, end.position_m - start.position_m)
    return axes


def _same_pass(one: Truth, later: Truth) -> bool:
    gap_s = later.tdb_s - one.tdb_s
    if not 0.0 < gap_s <= LARGEST_GAP_S:
        return False
    speed = float(np.linalg.norm(later.position_m - one.position_m)) / gap_s
    cosine = one.position_m @ later.position_m
    cosine = cosine / np.linalg.norm(one.position_m) / np.linalg.norm(later.position_m)
    near = bool(cosine >= np.cos(np.radians(LARGEST_GAP_DEG)))
    return near and SPEEDS_M_S[0] <= speed <= SPEEDS_M_S[1]


def _axes(position: FloatArray, motion: FloatArray) -> tuple[FloatArray, Forward]:
    length = float(np.linalg.norm(motion))
    up = position / np.linalg.norm(position)
    if length > 0.0 and np.linalg.norm(np.cross(up, motion)) >= LEAST_ACROSS * length:
        return rnb_axes(position, motion), "motion"
    north = np.array([0.0, 0.0, 1.0])
    if np.linalg.norm(np.cross(up, north)) < 1e-9:  # at a pole any direction does
        north = np.array([1.0, 0.0, 0.0])
    return rnb_axes(position, north), "north"
