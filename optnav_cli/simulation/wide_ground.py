"""The ground around terrain models: the globe, smooth or with seeded relief below its posting.

A navigator's catalog of the globe knows all of a smooth one. With relief below the posting, at half
of it, the pictures show around the terrain models, too, what no catalog has.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from catalog.arrays import Float32Array, FloatArray
from catalog.rendering.rays.ground import Ground, make_ground, whole_sphere
from catalog.terrain.synthetic.relief import SyntheticRelief
from optnav_cli.simulation.globe_heights import GlobeHeights

FINER = 2  # nodes of a ground with relief against the globe's posting
CHUNK = 256  # rows made at once
ALL_ROUND = 2.0 * np.pi


@dataclass(frozen=True)
class Cap:
    """Latitudes and longitudes (rad) that a flight may see; east - west is at most a turn."""

    west: float
    south: float
    east: float
    north: float


WHOLE_BODY = Cap(-np.pi, -0.5 * np.pi, np.pi, 0.5 * np.pi)


def seen_from(positions_m: ArrayLike, lowest_m: float, highest_m: float) -> Cap:
    """What lies within the horizon of a flight, mountains beyond it included.

    positions_m          (n, 3) of the cameras, body frame, m
    lowest_m, highest_m  radii that all ground lies between
    """
    positions = np.asarray(positions_m, dtype=np.float64)
    distance = np.linalg.norm(positions, axis=1)
    reach = np.arccos(np.minimum(lowest_m / distance, 1.0)) + np.arccos(lowest_m / highest_m)
    lat = np.arcsin(positions[:, 2] / distance)
    south, north = float((lat - reach).min()), float((lat + reach).max())
    if max(-south, north) >= 0.5 * np.pi:
        return Cap(-np.pi, max(south, -0.5 * np.pi), np.pi, min(north, 0.5 * np.pi))
    lon = np.arctan2(positions[:, 1], positions[:, 0])
    lon = lon[0] + np.mod(lon - lon[0] + np.pi, ALL_ROUND) - np.pi
    half = np.arcsin(np.sin(reach) / np.cos(lat))
    west, east = float((lon - half).min()), float((lon + half).max())
    if east - west >= ALL_ROUND:
        west, east = -np.pi, np.pi
    return Cap(west, south, east, north)


class WideGround:
    """The globe as grounds all round the body, one a seed.

    heights    of the globe; see `globe_heights.read_globe`
    seam       rad  the longitude where columns begin; away from the scene
    details    relief to add by seed; a seed that is not there sees the globe as it is
    cameras_m  (n, 3) m, body frame, where it is looked at from: what they cannot see stays smooth
    """

    def __init__(
        self, heights: Float32Array, radius_m: float, seam: float,
        details: Mapping[int | None, SyntheticRelief], cameras_m: Sequence[FloatArray] = (),
    ) -> None:  # fmt: skip
        self._heights, self._radius_m, self._seam = heights, radius_m, seam
        self._details, self._seen = details, WHOLE_BODY
        if details and len(cameras_m):
            lowest, highest = radius_m + float(heights.min()), radius_m + float(heights.max())
            self._seen = seen_from(cameras_m, lowest, highest)
        self._bare: Ground | None = None
        self._fine: Ground | None = None
        self._kept: tuple[int | None, Ground] | None = None

    def of(self, seed: int | None) -> Ground:
        """The ground of a seed; the last one is kept."""
        if seed not in self._details:
            if self._bare is None:
                self._bare = whole_sphere(self._heights, self._radius_m, self._seam)
            return self._bare
        if self._kept is None or self._kept[0] != seed:
            self._kept = None  # let go of the old one before the new one is made
            self._kept = seed, self._rough(self._details[seed])
        return self._kept[1]

    def _rough(self, detail: SyntheticRelief) -> Ground:
        fine = self._finer()
        heights, step = fine.heights.copy(), fine.step_lat
        # the rows beyond the poles, a pole's own neighbours twice, stay smooth
        top = max(2, int((fine.north - self._seen.north) / step))
        bottom = min(len(heights) - 2, int(np.ceil((fine.north - self._seen.south) / step)) + 1)
        left, right = self._columns(fine)
        for row in range(top, bottom, CHUNK):
            part = heights[row : min(row + CHUNK, bottom), left:right]
            part += detail.turned_window(
                np.eye(3), fine.north - row * step, fine.west + left * step, step, *part.shape
            )
        return make_ground(heights, fine.north, fine.west, step, step, self._radius_m)

    def _columns(self, fine: Ground) -> tuple[int, int]:
        """First and last + 1 of the columns with relief: all if they would cross the seam."""
        columns = fine.heights.shape[1]
        left = int(np.mod(self._seen.west - fine.west, ALL_ROUND) / fine.step_lon)
        right = left + int(np.ceil((self._seen.east - self._seen.west) / fine.step_lon)) + 2
        return (left, right) if right <= columns - 4 else (0, columns)

    def _finer(self) -> Ground:
        """The smooth globe at a finer posting, laid out as `whole_sphere` does."""
        if self._fine is not None:
            return self._fine
        rows = FINER * self._heights.shape[0]
        step = np.pi / rows
        shift = np.floor(np.mod(self._seam, ALL_ROUND) / step)
        north, west = 0.5 * np.pi + 1.5 * step, float(shift - 1.5) * step
        splines = GlobeHeights(self._heights, self._radius_m)
        heights = np.empty((rows + 4, 2 * rows + 4), np.float32)
        lon = west + step * np.arange(heights.shape[1], dtype=np.float64)
        for top in range(0, len(heights), CHUNK):
            lat = north - step * np.arange(top, min(top + CHUNK, len(heights)), dtype=np.float64)
            places = np.meshgrid(lat, lon, indexing="ij")
            heights[top : top + CHUNK] = splines.sample(0, *places)
        self._fine = make_ground(heights, north, west, step, step, self._radius_m)
        return self._fine
