"""What errors of near fixes have in common: the same ground, seen from nearly the same side.

A map, a shape or a limb that is wrong moves all fixes by it alike, until other ground comes into
view. So a share of each fix's covariance belongs to three numbers of its method that fade with the
way over the body, a Gauss-Markov sequence: white errors alone would be averaged, and their mean
would be called exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import msgspec
import numpy as np
from scipy.linalg import sqrtm

from catalog.arrays import FloatArray
from catalog.config import load_toml, resource
from catalog.geometry.vectors import angle_between

FILE = "configs/models/orbit_fixes.toml"
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
    share  of a fix's variance;  way (fixes,) over the body since the first, in lengths of fading
    times  (fixes,) TDB s
    """

    group: list[int]
    share: float
    way: FloatArray
    times: FloatArray

    @property
    def width(self) -> int:
        """How many numbers there are."""
        return 3 * (max(self.group, default=-1) + 1)

    def fading(self, times: FloatArray) -> FloatArray:
        """(N-1,) what stays of the errors between neighbouring times (N,)."""
        if not self.width:
            return np.ones(max(len(times) - 1, 0))
        found: FloatArray = np.exp(-np.diff(np.interp(times, self.times, self.way)))
        return found

    def split(self, number: int, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(3, width) by which a fix moves with the numbers, and what it has of its own (3, 3)."""
        moved = np.zeros((3, self.width))
        group = self.group[number]
        if group < 0:
            return moved, covariance
        moved[:, 3 * group : 3 * group + 3] = np.sqrt(self.share) * sqrtm(covariance).real
        return moved, (1.0 - self.share) * covariance


def shared_errors(
    places: FloatArray,
    times: FloatArray,
    names: Sequence[tuple[str, ...]],
    radius_m: float,
    sizes: SharedErrorSizes | None = None,
) -> SharedErrors:
    """Of fixes in the order of time: groups of one name whose neighbours see the same ground.

    places  (n, 3) body-fixed, m;  times (n,) TDB s
    names   what made each: its last word is the method, and empty where a fix errs for itself

    A picture from a low place shows little ground, and the next one other ground: the length of
    fading grows with the height up to a radius of the body.
    """
    sizes = sizes or shared_error_sizes()
    height = np.linalg.norm(places, axis=1) - radius_m
    seen = np.radians(sizes.fade_deg) * np.clip(height / radius_m, 1e-3, 1.0)
    turned = angle_between(places[:-1], places[1:])
    way = np.concatenate([[0.0], np.cumsum(turned / np.minimum(seen[:-1], seen[1:]))])
    kept: list[tuple[str, ...]] = []
    for name in dict.fromkeys(names):
        own = way[[k for k, one in enumerate(names) if one == name]]
        near = len(own) > 1 and float(np.diff(own).min()) < -np.log(LEAST)
        if near and name[-1] and sizes.share > 0.0:
            kept.append(name)
    group = [kept.index(name) if name in kept else -1 for name in names]
    return SharedErrors(group, sizes.share, way[: len(places)], times)
