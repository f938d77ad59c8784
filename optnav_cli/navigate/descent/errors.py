"""What the ground of a descent's windows is off by, and how wrong the model is besides.

A window's error is that of its ground: a part that all ground of a level of the catalog has in
common, by the low Sun and as heights of a level lie off the raster's, and the mean of a random
field over its square. So two windows err alike as far as they share ground. Its size is that of a
right model and of what the first match leaves over. Where the model is wrong at its posting,
windows of smooth ground are matched with its errors: what the matches leave over tells which ones
are, not by how much. That is learned from how windows scatter as they join, `WindowSpread`. The
sizes are fitted numbers, in FILE (`make study-fit`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Annotated

import msgspec
import numpy as np

from catalog.arrays import FloatArray
from catalog.config import Positive, load_toml, resource
from catalog.geometry.latlon import body_from_local, latlon_from_xyz
from optnav_cli.control_points.point_match import PointMatch
from optnav_cli.navigate.descent.windows import SIDE, Window, WindowKey, overlap

FILE = "configs/models/descent.toml"
Share = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
# Scales that a descent may have, and how far from 1 one is before anything is known: the logarithm
# of its sigma. The windows of a single frame say more.
SCALES: FloatArray = np.geomspace(0.5, 64.0, 29)
SCALE_SIGMA = float(np.log(4.0))
# Windows scatter with longer tails than a Gaussian: as Student's distribution of so many degrees.
# What is matched wrongly is farther off than MAX_SQUARE, and counts as if it were so far.
TAIL_DEGREES, MAX_SQUARE = 8.0, 16.0


class DescentErrorSizes(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All fitted numbers of FILE, which says what each is."""

    own_postings: Positive
    remainder: Positive
    common: Share
    sunward_postings: Positive
    height_postings: Positive
    fresh_px: Positive
    fresh_share: Share
    landmark_px: Positive
    landmark_shift: Positive
    landmark_height_postings: Positive


@cache
def shipped_sizes() -> DescentErrorSizes:
    """The sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), DescentErrorSizes)


@dataclass(frozen=True, eq=False)
class WindowError:
    """What a window's ground may be off by: (3, 3) symmetric roots, m, body frame.

    common_m  of the covariance of what it has in common with all others of its level
    own_m     of that of the rest, which it shares as far as it shares ground
    """

    key: WindowKey
    common_m: FloatArray
    own_m: FloatArray


@dataclass(frozen=True, eq=False)
class WindowGround:
    """What the error of a window's ground follows from.

    axes      (3, 3) east, north, up as columns, body frame
    left_m2   (2, 2) what its first match leaves over, as ground east and north
    pixel_m2  (2, 2) of a pixel's sigma along both axes there, the same way
    """

    key: WindowKey
    axes: FloatArray
    posting_m: float
    left_m2: FloatArray
    pixel_m2: FloatArray

    def error(self, sizes: DescentErrorSizes, scale: float = 1.0) -> WindowError:
        """Its error by some sizes; scale multiplies what the match left over: `WindowSpread`."""
        own = sizes.own_postings * SIDE / self.key.side * self.posting_m
        high = sizes.height_postings * self.posting_m
        common = sizes.common * np.diag([own**2, own**2, high**2])
        rest = (1.0 - sizes.common) * np.diag([own**2, own**2, high**2])
        rest[:2, :2] += scale * sizes.remainder * self.left_m2
        values, vectors = np.linalg.eigh(rest)
        roots = np.sqrt(common), vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        return WindowError(self.key, *(self.axes @ root @ self.axes.T for root in roots))

    def level_m2(self, sizes: DescentErrorSizes) -> tuple[FloatArray, FloatArray]:
        """Covariances (2, 2) of a match's error, east and north: what stays, and what is scaled."""
        own = sizes.own_postings * SIDE / self.key.side * self.posting_m
        stays = own**2 * np.eye(2) + sizes.fresh_px**2 * self.pixel_m2
        return stays, (sizes.remainder + sizes.fresh_share) * self.left_m2


def window_ground(window: Window, match: PointMatch, by_position: FloatArray) -> WindowGround:
    """What is known of a window's ground when it is first matched.

    by_position (2, 3) derivative of its pixel by the camera's position
    """
    axes = body_from_local(*(float(v) for v in latlon_from_xyz(window.place_m)[:2]))
    inverse = np.linalg.pinv(by_position @ axes[:, :2])
    left = np.zeros((2, 2))
    if match.covariance_px2 is not None:
        left = inverse @ match.covariance_px2 @ inverse.T
    return WindowGround(window.key, axes, window.posting_m, left, inverse @ inverse.T)


@dataclass(frozen=True, eq=False)
class WindowSpread:
    """How far windows are off, over what their matches leave over: a number of a descent.

    A model may be worse than those that the sizes were fitted with, and nobody says so. Its
    windows then contradict each other, and the track, by more than they should.

    likelihood  (n,) logarithm of that of the windows that joined, by SCALES
    count       of these windows
    """

    likelihood: FloatArray = field(default_factory=lambda: np.zeros(len(SCALES)))
    count: int = 0

    @property
    def scale(self) -> float:
        """The mean scale, in the logarithm."""
        logs = np.log(SCALES)
        chance = self.likelihood - 0.5 * (logs / SCALE_SIGMA) ** 2
        weights = np.exp(chance - chance.max())
        return float(np.exp(weights @ logs / weights.sum()))

    def with_windows(
        self,
        grounds: Sequence[WindowGround],
        squares: FloatArray,
        scale: float,
        sizes: DescentErrorSizes,
    ) -> "WindowSpread":
        """With more windows, whose squares (n,), of two degrees, were taken with a scale."""
        if not grounds:
            return self
        stays, scaled = (
            np.array(parts)
            for parts in zip(*(ground.level_m2(sizes) for ground in grounds), strict=True)
        )
        taken = stays + scale * scaled
        others = stays[:, None] + SCALES[:, None, None] * scaled[:, None]
        # a miss of any direction, on the mean
        shares = np.einsum("nsij,nji->ns", np.linalg.inv(others), taken) / 2.0
        wide = np.minimum(squares, MAX_SQUARE)[:, None] * shares
        each = 0.5 * np.log(np.linalg.det(others))
        each += 0.5 * (TAIL_DEGREES + 2.0) * np.log1p(wide / TAIL_DEGREES)
        return WindowSpread(self.likelihood - each.sum(axis=0), self.count + len(grounds))


def common_key(level: int) -> WindowKey:
    """Of no window: what all windows of a level have in common, in units of their own sigmas."""
    return WindowKey(-1 - level, SIDE, 0, 0)


def is_common(key: WindowKey) -> bool:
    """Whether a key is one of `common_key`."""
    return key.level < 0


def common_error(level: int) -> WindowError:
    """Of what all windows of a level have in common."""
    return WindowError(common_key(level), np.eye(3), np.zeros((3, 3)))


def same_level(some: Sequence[WindowKey], others: Sequence[WindowKey]) -> FloatArray:
    """(k, n) 1 where windows have the common error of one level, else 0."""
    one, other = (
        [-1 - k.level if is_common(k) else k.level for k in own] for own in (some, others)
    )
    return np.equal.outer(one, other).astype(np.float64)


def tied_errors(some: Sequence[WindowError], others: Sequence[WindowError]) -> FloatArray:
    """Covariance (3 k, 3 n) of the errors of windows with those of others, m^2."""
    ties = np.empty((len(some), len(others)))
    for i, one in enumerate(some):
        for j, other in enumerate(others):
            ties[i, j] = 1.0 + 1e-6 if one.key == other.key else overlap(one.key, other.key)
    common = (np.array([each.common_m for each in own]) for own in (some, others))
    level = same_level([one.key for one in some], [other.key for other in others])
    blocks = np.einsum("ij,iab,jcb->iajc", level, *common)
    left, right = (np.array([each.own_m for each in own]) for own in (some, others))
    blocks = blocks + np.einsum("ij,iab,jcb->iajc", ties, left, right)
    tied: FloatArray = blocks.reshape(3 * len(some), 3 * len(others))
    return tied
