"""What errors of near fixes have in common: the same ground, seen from nearly the same side.

A map, a shape or a limb that is wrong moves all fixes by it alike, until other ground comes into
view. So a share of each fix's covariance belongs to three numbers of its method that fade with the
way over the body, a Gauss-Markov sequence: white errors alone would be averaged, and their mean
would be called exact. Cameras that look at one time see the same ground by the same attitude: what
the best of their fixes has in common the others have, too, and besides it errors of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import msgspec
import numpy as np
from scipy.linalg import eigh, sqrtm

from catalog.arrays import FloatArray
from catalog.config import load_toml, resource
from catalog.geometry.vectors import angle_between

FILE = "configs/models/orbit_fixes.toml"
TOGETHER = 0.1  # lengths of fading between fixes that have the error of the best of them in common
# Such fixes before and after one: more cameras than a craft has, few of a dense arc.
MAX_TOGETHER = 8
LEAST = 0.05  # correlation of neighbours below which errors are taken as independent


class SharedErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fitted numbers of FILE, which says what each is."""

    share: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
    fade_deg: Annotated[float, msgspec.Meta(gt=0.0, le=180.0)]


@cache
def shared_error_sizes() -> SharedErrorSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), SharedErrorSizes)


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """The common errors of fixes, three numbers of unit variance a group.

    group  (fixes,) of each fix, -1: it errs for itself
    size   (fixes, 3, 3) covariance of which a share is common, a fix's own or that of a better one
           seen together with it
    share  of that variance;  way (fixes,) over the body since the first, in lengths of fading
    times  (fixes,) TDB s
    """

    group: list[int]
    size: FloatArray
    share: float
    way: FloatArray
    times: FloatArray

    @property
    def width(self) -> int:
        """Number of components."""
        return 3 * (max(self.group, default=-1) + 1)

    def fading(self, times: FloatArray) -> FloatArray:
        """(N-1,) what stays of the errors between neighbouring times (N,)."""
        if not self.width:
            return np.ones(max(len(times) - 1, 0))
        kept: FloatArray = np.exp(-np.diff(np.interp(times, self.times, self.way)))
        return kept

    def split(self, number: int, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(3, width) by which a fix moves with the numbers, and what it has of its own (3, 3)."""
        moved = np.zeros((3, self.width))
        group = self.group[number]
        if group < 0:
            return moved, covariance
        size = self.size[number]
        moved[:, 3 * group : 3 * group + 3] = np.sqrt(self.share) * sqrtm(size).real
        return moved, covariance - self.share * size


def shared_errors(
    places: FloatArray,
    covariances: FloatArray,
    times: FloatArray,
    methods: Sequence[str],
    radius_m: float,
    sizes: SharedErrorSizes | None = None,
) -> SharedErrors:
    """Group fixes in the order of time by method, where some see the same ground.

    places       (n, 3) body-fixed, m;  covariances (n, 3, 3), m^2;  times (n,) TDB s
    methods      what made each, by any camera; empty where a fix errs for itself

    A picture from a low place shows little ground, and the next one other ground: the length of
    fading grows with the height up to a radius of the body.
    """
    sizes = sizes or shared_error_sizes()
    height = np.linalg.norm(places, axis=1) - radius_m
    seen = np.radians(sizes.fade_deg) * np.clip(height / radius_m, 1e-3, 1.0)
    turned = angle_between(places[:-1], places[1:])
    way = np.concatenate([[0.0], np.cumsum(turned / np.minimum(seen[:-1], seen[1:]))])
    way, size = way[: len(places)], np.array(covariances)
    group = np.full(len(places), -1)
    for method in dict.fromkeys(methods):
        members = np.flatnonzero([name == method for name in methods])
        near = len(members) > 1 and float(np.diff(way[members]).min()) < -np.log(LEAST)
        if not (near and method and sizes.share > 0.0):
            continue
        group[members] = group.max() + 1
        ends = np.searchsorted(way[members], [way[members] - TOGETHER, way[members] + TOGETHER])
        for number, (k, first, last) in enumerate(zip(members, *ends, strict=True)):
            first, last = max(first, number - MAX_TOGETHER), min(last, number + MAX_TOGETHER + 1)
            for other in members[first:last]:
                if other != k:
                    size[k] = _within_both(size[k], covariances[other])
    return SharedErrors(group.tolist(), size, sizes.share, way, times)


def _within_both(a: FloatArray, b: FloatArray) -> FloatArray:
    """The smaller of two covariances (3, 3) along each of the axes on which both are diagonal."""
    ratios, axes = eigh(a, b)
    back = np.linalg.inv(axes)
    smaller: FloatArray = back.T @ (np.minimum(ratios, 1.0)[:, None] * back)
    return smaller
