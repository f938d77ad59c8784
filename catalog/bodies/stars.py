"""The bright stars that ship with optnav: where they stand at a time, as a moving body sees them.

Source: ESA, The Hipparcos and Tycho Catalogues, SP-1200 (1997): places of epoch J1991.25 (TT),
ICRS, and proper motions. Parallaxes are left out: 0.75" of the nearest star, below 0.1" of most.
"""

import csv
from dataclasses import dataclass
from functools import cache

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.body import JULIAN_YEAR_S
from catalog.config import resource

EPOCH_YEAR = 1991.25
DEFAULT_YEAR = 2025.0  # of pictures without a time
J2000_YEAR = 2000.0
MAS = np.radians(1.0 / 3.6e6)
LIGHT_M_S = 299_792_458.0


@dataclass(frozen=True, eq=False)
class BrightStars:
    """Stars, the brightest first.

    directions     (n, 3) unit vectors, ICRS, epoch J1991.25
    motions_rad_yr (n, 3) their proper motions, tangent to the sky
    magnitudes     (n,) V;  hip  (n,) numbers of the Hipparcos catalogue
    names          of the best known ones, else ""
    """

    directions: FloatArray
    motions_rad_yr: FloatArray
    magnitudes: FloatArray
    hip: IntArray
    names: tuple[str, ...]

    def at(self, tdb_s: float | None) -> FloatArray:
        """Directions (n, 3) at a time, TDB s past J2000; at J2025 without one."""
        year = DEFAULT_YEAR if tdb_s is None else J2000_YEAR + tdb_s / JULIAN_YEAR_S
        moved = self.directions + (year - EPOCH_YEAR) * self.motions_rad_yr
        found: FloatArray = moved / np.linalg.norm(moved, axis=1, keepdims=True)
        return found

    def label(self, number: int) -> str:
        """What a star is called: its name, else its number in the catalogue."""
        return self.names[number] or f"HIP {self.hip[number]}"


@cache
def bright_stars() -> BrightStars:
    """The stars of data/bright_stars.csv, down to V 6.5."""
    with resource("data/bright_stars.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = ("ra_deg", "dec_deg", "v_mag", "pm_ra_mas_yr", "pm_dec_mas_yr", "hip")
    table = np.array([[float(row[name]) for name in names] for row in rows])
    ra, dec = np.radians(table[:, :2]).T
    directions = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], 1)
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros(len(ra))], axis=1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], 1)
    # the catalogue's motion in right ascension is along the sky, the cosine in it
    motions = MAS * (table[:, 3:4] * east + table[:, 4:5] * north)
    found = tuple(row["name"] for row in rows)
    return BrightStars(directions, motions, table[:, 2], table[:, 5].astype(np.int64), found)


def aberrated(directions: FloatArray, velocity_m_s: FloatArray) -> FloatArray:
    """Directions (n, 3) as an observer of a velocity (3,) against the Sun sees them.

    To first order in v/c: 20" by the Earth's motion; the next order is 0.002".
    """
    seen = directions + velocity_m_s / LIGHT_M_S
    found: FloatArray = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    return found
