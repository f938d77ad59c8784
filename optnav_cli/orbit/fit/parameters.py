"""Numbers common to measurements: parameters of a fit, and errors that near fixes share.

A map, a shape or a limb that is wrong moves all fixes by it alike, until other ground comes into
view. So a share of each fix's covariance belongs to three numbers of its method that fade with the
way over the body, a Gauss-Markov sequence: white errors alone would be averaged, and their mean
would be called exact. Cameras that look at one time see the same ground by the same attitude: what
the best of their fixes has in common the others have, too, and besides it errors of their own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated

import msgspec
import numpy as np
from scipy.linalg import eigh, sqrtm

from catalog.arrays import FloatArray
from catalog.config import load_toml, resource
from catalog.geometry.vectors import angle_between
from optnav_cli.dynamics.forces import THRUST
from optnav_cli.orbit.fit.settings import (
    OF_FIXES,
    OF_MEASUREMENTS,
    PRIOR_SIGMAS,
    ParameterSettings,
)

# Numbers of a parameter; others have one.
SIZES = {"map_offset": 3, "acceleration": 3, "vertical": 2}
UNOBSERVED = 0.9  # of the prior's sigma
AXES_OF = {"vertical": "NB"}  # of parameters of which one axis may be open and another not


@dataclass(frozen=True, eq=False)
class FitParameter:
    """A number, or three, common to fixes or to the arc.

    name        of the settings; of an arc of thrust thrust_1 and so on
    first       place of its first number among those estimated, or among those considered
    covariance  (size, size) before the measurements are used
    """

    name: str
    settings: ParameterSettings
    first: int
    covariance: FloatArray

    @property
    def size(self) -> int:
        return len(self.covariance)

    @property
    def span(self) -> slice:
        return slice(self.first, self.first + self.size)

    def applies(self, camera: str, run: str) -> bool:
        """Whether fixes of a camera in a run depend on it directly."""
        wanted = self.settings
        return wanted.name in OF_FIXES and wanted.camera in ("", camera) and wanted.run in ("", run)

    @property
    def moves_craft(self) -> bool:
        """Whether it belongs to the forces, and not to measurements."""
        return self.name not in OF_MEASUREMENTS


def _count_components(setting: ParameterSettings, sizes: Mapping[str, int]) -> int:
    by_pass = "/pass" if setting.per == "pass" else ""
    return sizes.get(f"{setting.name}{by_pass}", 1)


def parameters_of(
    settings: Sequence[ParameterSettings],
    thrusts: Sequence[FloatArray],
    sizes: Mapping[str, int] = SIZES,
) -> tuple[list[FitParameter], list[FitParameter]]:
    """Those estimated and those considered, each with its place.

    thrusts  covariances (3, 3) of the arcs of thrust, which are estimated too
    sizes    how many numbers a parameter has; 1 where not named; NAME/pass: one for each pass
    """
    by_mode: dict[str, list[FitParameter]] = {"estimate": [], "consider": []}
    ends = dict.fromkeys(by_mode, 0)
    every: list[tuple[str, ParameterSettings, FloatArray]] = [
        (setting.name, setting, np.eye(_count_components(setting, sizes)) * setting.sigma**2)
        for setting in settings
    ]
    for number, covariance in enumerate(thrusts, start=1):
        every.append((f"{THRUST}{number}", ParameterSettings("acceleration"), covariance))
    for name, setting, covariance in every:
        parameter = FitParameter(name, setting, ends[setting.mode], covariance)
        ends[setting.mode] += parameter.size
        by_mode[setting.mode].append(parameter)
    return by_mode["estimate"], by_mode["consider"]


def unobserved_remarks(estimated: Sequence[FitParameter], covariance: FloatArray) -> list[str]:
    """Name the parameters that the measurements leave open.

    covariance  (p, p) of the parameters after the fit
    """
    remarks = []
    for parameter in estimated:
        sigmas = np.sqrt(np.diag(covariance)[parameter.span])
        left = sigmas / np.sqrt(np.diag(parameter.covariance))
        axes = AXES_OF.get(parameter.name, "")
        whose = parameter.settings.label
        # an arc of thrust is known before: there is nothing to say where the fixes add nothing
        if parameter.name not in PRIOR_SIGMAS or not (left > UNOBSERVED).any():
            continue
        if not (left > UNOBSERVED).all():
            if not axes:
                continue
            hidden = (axis for axis, share in zip(axes, left, strict=True) if share > UNOBSERVED)
            whose += f" along {', '.join(hidden)}"
        share = float(left[left > UNOBSERVED].min())
        remarks.append(
            f"{whose} is not observed: the measurements leave {100.0 * share:.0f} % of its prior "
            "sigma"
        )
    return remarks


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
