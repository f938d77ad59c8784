"""Which two stars' zenith distances tell an orbit best: one near its pole, one near its plane.

Source: Kuznetsov, Danilova, Kosulin and Arkhipova, Izv. vuzov. Priborostroenie 61 (2018), 844-854:
the navigation stars are those of V 1.25 or brighter and Polaris, 21 in all.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.stars import load_bright_stars
from catalog.geometry.vectors import unit

FAINTEST, POLARIS = 1.25, "Polaris"
# Between a star and the body's edge, the Sun, and another body: what their light spoils.
LIMB_DEG, SUN_DEG, NEIGHBOUR_DEG = 5.0, 30.0, 5.0
VERTICAL_DEG = 5.0  # a star in the zenith says little: the distance has no sign there


@cache
def list_navigation_stars() -> IntArray:
    """List the numbers of the 21 stars in `load_bright_stars`."""
    stars = load_bright_stars()
    bright = stars.magnitudes <= FAINTEST
    return np.flatnonzero(bright | (np.array(stars.names) == POLARIS)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class SightPlace:
    """Observer of stars, inertial axes.

    place_m     (3,) of the craft from the body's centre, whose radius is radius_m
    sun         (3,) towards the Sun;  neighbours_m  (n, 3) places of other bright bodies
    """

    place_m: FloatArray
    radius_m: float
    sun: FloatArray
    neighbours_m: FloatArray

    def find_visible(self, directions: FloatArray) -> BoolArray:
        """Find which stars (n, 3) may be looked at."""
        up, distance = unit(self.place_m), float(np.linalg.norm(self.place_m))
        edge = np.arcsin(min(self.radius_m / distance, 1.0)) + np.radians(LIMB_DEG)
        height = directions @ up
        seen: BoolArray = (height > -np.cos(edge)) & (height < np.cos(np.radians(VERTICAL_DEG)))
        seen &= directions @ unit(self.sun) < np.cos(np.radians(SUN_DEG))
        for neighbour in self.neighbours_m:
            there = unit(neighbour - self.place_m)
            seen &= directions @ there < np.cos(np.radians(NEIGHBOUR_DEG))
        return seen


def choose_zenith_pair(place: SightPlace, pole: FloatArray, directions: FloatArray) -> list[int]:
    """Choose the star nearest to an orbit's pole and that nearest to its plane, by number.

    pole        (3,) of the orbit, either way
    directions  (n, 3) of the stars to choose from

    Fewer than two where fewer are visible.
    """
    from_pole = np.abs(directions @ unit(pole))
    seen = np.flatnonzero(place.find_visible(directions))
    if not len(seen):
        return []
    chosen = [int(seen[np.argmax(from_pole[seen])])]
    others = seen[seen != chosen[0]]
    if len(others):
        chosen.append(int(others[np.argmin(from_pole[others])]))
    return chosen
