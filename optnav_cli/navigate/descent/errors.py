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
from optnav_cli.navigate.descent.windows import SIDE, Window, WindowKey, compute_overlap

FILE = "configs/models/descent.toml"
Share = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
# Scales that a descent may have, and how far from 1 one is before anything is known: the logarithm
# of its sigma. The windows of a single frame say more.
SCALES: FloatArray = np.geomspace(0.5, 64.0, 29)
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
def load_descent_sizes() -> DescentErrorSizes:
    """Load the sizes that ship with optnav. Raises ConfigError for a wrong file."""
    return load_toml(resource(FILE), DescentErrorSizes)


@dataclass(frozen=True, eq=False)
class WindowError:
    """Error of a window's ground as (3, 3) symmetric roots of covariances, m, body frame.

    common_m  of the covariance of what it has in common with all others of its level
    own_m     of that of the rest, which it shares as far as it shares ground
    """

    key: WindowKey
    common_m: FloatArray
    own_m: FloatArray


@dataclass(frozen=True, eq=False)
class WindowGround:
    """Quantities that the error of a window's ground is computed from.

    axes      (3, 3) east, north, up as columns, body frame
    left_m2   (2, 2) what its first match leaves over, as ground east and north
    pixel_m2  (2, 2) of a pixel's sigma along both axes there, the same way
    """

    key: WindowKey
    axes: FloatArray
    posting_m: float
    left_m2: FloatArray
    pixel_m2: FloatArray

    def compute_error(self, sizes: DescentErrorSizes, scale: float = 1.0) -> WindowError:
        """Compute its error; scale multiplies the match's remainder: see `WindowSpread`."""
        sigma_m = sizes.own_postings * SIDE / self.key.side * self.posting_m
        high = sizes.height_postings * self.posting_m
        common = sizes.common * np.diag([sigma_m**2, sigma_m**2, high**2])
        ground_m2 = (1.0 - sizes.common) * np.diag([sigma_m**2, sigma_m**2, high**2])
        ground_m2[:2, :2] += scale * sizes.remainder * self.left_m2
        values, vectors = np.linalg.eigh(ground_m2)
        roots = np.sqrt(common), vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        return WindowError(self.key, *(self.axes @ root @ self.axes.T for root in roots))

    def compute_level_m2(self, sizes: DescentErrorSizes) -> tuple[FloatArray, FloatArray]:
        """Compute (2, 2) of a match's error, east and north: constant and scaled part."""
        sigma_m = sizes.own_postings * SIDE / self.key.side * self.posting_m
        stays = sigma_m**2 * np.eye(2) + sizes.fresh_px**2 * self.pixel_m2
        return stays, (sizes.remainder + sizes.fresh_share) * self.left_m2


def make_window_ground(window: Window, match: PointMatch, by_position: FloatArray) -> WindowGround:
    """Describe a window's ground when it is first matched.

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
    """Scale of the windows' errors over their matches' remainders, learned during a descent.

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
        # Before anything is known the logarithm of the scale has a sigma of log 4; the windows of a
        # single frame say more.
        chance = self.likelihood - 0.5 * (logs / np.log(4.0)) ** 2
        weights = np.exp(chance - chance.max())
        return float(np.exp(weights @ logs / weights.sum()))

    def add_windows(
        self,
        grounds: Sequence[WindowGround],
        squares: FloatArray,
        scale: float,
        sizes: DescentErrorSizes,
    ) -> "WindowSpread":
        """Add windows whose squares (n,), of two degrees, were taken with a scale."""
        if not grounds:
            return self
        stays, scaled = (
            np.array(parts)
            for parts in zip(*(ground.compute_level_m2(sizes) for ground in grounds), strict=True)
        )
        taken = stays + scale * scaled
        others = stays[:, None] + SCALES[:, None, None] * scaled[:, None]
        # a miss of any direction, on the mean
        shares = np.einsum("nsij,nji->ns", np.linalg.inv(others), taken) / 2.0
        wide = np.minimum(squares, MAX_SQUARE)[:, None] * shares
        each = 0.5 * np.log(np.linalg.det(others))
        each += 0.5 * (TAIL_DEGREES + 2.0) * np.log1p(wide / TAIL_DEGREES)
        return WindowSpread(self.likelihood - each.sum(axis=0), self.count + len(grounds))


def make_common_key(level: int) -> WindowKey:
    """Make the key of the error that all windows of a level share, in units of their sigmas."""
    return WindowKey(-1 - level, SIDE, 0, 0)


def is_common(key: WindowKey) -> bool:
    """Whether a key is one of `common_key`."""
    return key.level < 0


def make_common_error(level: int) -> WindowError:
    """Make the error that all windows of a level share."""
    return WindowError(make_common_key(level), np.eye(3), np.zeros((3, 3)))


def match_levels(some: Sequence[WindowKey], others: Sequence[WindowKey]) -> FloatArray:
    """Return (k, n) 1 where windows share the common error of a level, else 0."""
    levels, other_levels = (
        [-1 - k.level if is_common(k) else k.level for k in keys] for keys in (some, others)
    )
    return np.equal.outer(levels, other_levels).astype(np.float64)


def correlate_errors(some: Sequence[WindowError], others: Sequence[WindowError]) -> FloatArray:
    """Compute the covariance (3 k, 3 n) of windows' errors with those of others, m^2."""
    ties = np.empty((len(some), len(others)))
    for i, error in enumerate(some):
        for j, other in enumerate(others):
            ties[i, j] = (
                1.0 + 1e-6 if error.key == other.key else compute_overlap(error.key, other.key)
            )
    common = (np.array([error.common_m for error in errors]) for errors in (some, others))
    level = match_levels([error.key for error in some], [other.key for other in others])
    blocks = np.einsum("ij,iab,jcb->iajc", level, *common)
    left, right = (np.array([error.own_m for error in errors]) for errors in (some, others))
    blocks = blocks + np.einsum("ij,iab,jcb->iajc", ties, left, right)
    tied: FloatArray = blocks.reshape(3 * len(some), 3 * len(others))
    return tied
