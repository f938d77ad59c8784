"""Stars: those that ship with optnav, where they stand at a time, as a moving body sees them.

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

    directions     (n, 3) unit vectors, ICRS, at the epoch
    motions_rad_yr (n, 3) their proper motions, tangent to the sky
    magnitudes     (n,) V, or another band of a catalogue of the user's
    hip            (n,) numbers of the Hipparcos catalogue; 0 where there is none
    names          of the best known ones, else ""
    epoch_years    the Julian year of the places, or (n,) of each star's
    """

    directions: FloatArray
    motions_rad_yr: FloatArray
    magnitudes: FloatArray
    hip: IntArray
    names: tuple[str, ...]
    epoch_years: float | FloatArray = EPOCH_YEAR

    def propagate(self, tdb_s: float | None) -> FloatArray:
        """Directions (n, 3) at a time, TDB s past J2000; at J2025 without one."""
        year = DEFAULT_YEAR if tdb_s is None else J2000_YEAR + tdb_s / JULIAN_YEAR_S
        years = np.reshape(year - np.asarray(self.epoch_years, dtype=np.float64), (-1, 1))
        moved = self.directions + years * self.motions_rad_yr
        directions: FloatArray = moved / np.linalg.norm(moved, axis=1, keepdims=True)
        return directions

    def label(self, number: int) -> str:
        """Return the name of a star, else its number in the catalogue."""
        return self.names[number] or f"HIP {self.hip[number]}"


def make_stars(
    places_deg: FloatArray,
    motions_mas_yr: FloatArray,
    magnitudes: FloatArray,
    epoch_years: float | FloatArray,
    names: tuple[str, ...],
    hip: IntArray | None = None,
) -> BrightStars:
    """Make stars of a catalogue's columns, sorted by magnitude before.

    places_deg      (n, 2) right ascension and declination, ICRS
    motions_mas_yr  (n, 2) along both, the former with the cosine of the declination in it
    """
    ra, dec = np.radians(places_deg).T
    directions = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], 1)
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros(len(ra))], axis=1)
    north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], 1)
    motions = MAS * (motions_mas_yr[:, :1] * east + motions_mas_yr[:, 1:] * north)
    numbers = np.zeros(len(ra), np.int64) if hip is None else hip
    return BrightStars(directions, motions, magnitudes, numbers, names, epoch_years)


@cache
def load_bright_stars() -> BrightStars:
    """The stars of data/bright_stars.csv: all down to V 6.5, and a thousand fainter ones."""
    with resource("data/bright_stars.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = ("ra_deg", "dec_deg", "v_mag", "pm_ra_mas_yr", "pm_dec_mas_yr", "hip")
    table = np.array([[float(row[name]) for name in names] for row in rows])
    labels = tuple(row["name"] for row in rows)
    hip = table[:, 5].astype(np.int64)
    return make_stars(table[:, :2], table[:, 3:5], table[:, 2], EPOCH_YEAR, labels, hip)


def apply_aberration(directions: FloatArray, velocity_m_s: FloatArray) -> FloatArray:
    """Directions (n, 3) as an observer of a velocity (3,) against the Sun sees them.

    To first order in v/c: 20" by the Earth's motion; the next order is 0.002".
    """
    seen = directions + velocity_m_s / LIGHT_M_S
    apparent: FloatArray = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    return apparent
