"""What a calibration does not tell apart: numbers of a camera that only their combination shows.

A number's sigma beside that for known others is the square root of its variance inflation. From a
low orbit at one height and one roll an offset of the clock, a shift of the principal point along
the flight and a pitch of the mounting all move the picture along the flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from catalog.arrays import FloatArray
from optnav_cli.estimation.models.common import Common, CommonNumber

# A variance that is so many times that for known others: the number is not told from them.
MAX_INFLATION = 100.0
JOINS_INFLATION, JOINS_CORRELATION = 10.0, 0.4  # what belongs to the same direction
TIED_CORRELATION = 0.95


@dataclass(frozen=True)
class Direction:
    """Numbers (their places) that move the picture in the same way; a pair has a correlation.

    moves_px  1 sigma of what they do to the picture together; None where that is not one shift
    """

    places: tuple[int, ...]
    labels: tuple[str, ...]
    correlation: float | None = None
    moves_px: float | None = None

    def describe(self) -> str:
        """Describe for people."""
        names = f"{', '.join(self.labels[:-1])} and {self.labels[-1]}"
        if self.correlation is None:
            return (
                f"{names} cannot be told apart: fly at several heights, or turn the camera about "
                "its boresight"
            )
        moved = (
            "" if self.moves_px is None else f"; together they move it by {self.moves_px:.2g} px"
        )
        return f"{names} move the picture alike (correlation {self.correlation:.3f}){moved}"


def find_inseparable(numbers: Sequence[CommonNumber], covariance: FloatArray) -> list[Direction]:
    """Find directions in which the frames observe only a combination of several numbers."""
    inflation, correlation = _compute_inflation(covariance)
    left = [k for k in range(len(numbers)) if inflation[k] > MAX_INFLATION]
    directions = []
    while left:
        group = {left[0]}
        for k in range(len(numbers)):
            if numbers[k].camera != numbers[left[0]].camera or inflation[k] < JOINS_INFLATION:
                continue
            if any(abs(correlation[k, j]) > JOINS_CORRELATION for j in [*group]):
                group.add(k)
        left = [k for k in left if k not in group]
        if len(group) > 1:
            places = tuple(sorted(group))
            directions.append(Direction(places, tuple(numbers[k].label for k in places)))
    return directions


def find_tied_pairs(
    numbers: Sequence[CommonNumber], covariance: FloatArray, focal_px: dict[str, float]
) -> list[Direction]:
    """Find pairs of numbers whose errors nearly cancel in the picture."""
    _, correlation = _compute_inflation(covariance)
    pairs = []
    for i in range(len(numbers)):
        for j in range(i + 1, len(numbers)):
            if abs(correlation[i, j]) < TIED_CORRELATION:
                continue
            labels = numbers[i].label, numbers[j].label
            moved = _propagate_to_picture(
                numbers[i], numbers[j], covariance[np.ix_([i, j], [i, j])], focal_px
            )
            pairs.append(Direction((i, j), labels, float(correlation[i, j]), moved))
    return pairs


def _compute_inflation(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute the inflation of each variance by the other numbers, and the correlations (k, k)."""
    sigmas = np.sqrt(np.diag(covariance))
    correlation: FloatArray = covariance / np.outer(sigmas, sigmas)
    return np.diag(np.linalg.inv(correlation)), correlation


def _propagate_to_picture(
    first: CommonNumber, second: CommonNumber, covariance: FloatArray, focal_px: dict[str, float]
) -> float | None:
    """Propagate a shift of the principal point and a turn of the mounting to the picture, px."""
    if (first.kind, second.kind) != (
        Common.CENTRE,
        Common.MOUNTING,
    ) or first.camera != second.camera:
        return None
    # a turn about y moves what is seen along x by f, one about x along y by -f
    sides = {("x", "y"): 1.0, ("y", "x"): -1.0}
    if (first.axis, second.axis) not in sides:
        return None
    effect = np.array([1.0, sides[first.axis, second.axis] * focal_px[first.camera]])
    return float(np.sqrt(effect @ covariance @ effect))
