"""Zenith distances of stars as measurements of an orbit, and zenith.csv, which holds them.

A zenith distance is the angle between a craft's place, seen from the body's centre, and a star:
phi = angle(r, s), d phi/d r = -(s - cos(phi) r/|r|) / (|r| sin(phi)). Source: Kuznetsov, Danilova,
Kosulin and Arkhipova, Izv. vuzov. Priborostroenie 61 (2018), 844-854. It needs the direction of the
vertical: an instrument sees stars alone, so a constant error of the vertical along the motion turns
the orbit by as much, and no residual shows it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray, IntArray
from catalog.bodies.epochs import utc_to_tdb_s
from catalog.bodies.stars import load_bright_stars
from catalog.errors import DataError
from catalog.geometry.rotations import ARCSEC
from catalog.tables import CsvRow
from optnav_cli.frames.orbit_tables import ZENITH
from optnav_cli.orbit.fit.motion import rnb_of
from optnav_cli.orbit.fit.parameters import FitParameter
from optnav_cli.orbit.fit.scalars import ScalarSet

ZENITH_CSV, STAR_ZENITH = "zenith.csv", "star_zenith"
# A catalogue of another epoch has stars elsewhere: the quickest of the bright ones moves by 3.9" a
# year. What is farther from all stars is a slip.
SAME_STAR_RAD = np.radians(0.05)
# Nearer to the vertical or its opposite a zenith distance says little, and not on which side.
NEAREST_RAD = np.radians(0.1)
MAX_SIGHTS = 100_000
MAX_SIGMA_ARCSEC = 3.6e5


@dataclass(frozen=True, eq=False)
class ZenithSights(ScalarSet):
    """Zenith distances in the order of time.

    tdb_s       (n,) TDB s past J2000
    directions  (n, 3) unit vectors to their stars, ICRS, with proper motion, without aberration
    values_rad  (n,) and sigmas_rad (n,), 1 sigma
    star_of     (n,) number of its star in `names`
    """

    tdb_s: FloatArray
    directions: FloatArray
    values_rad: FloatArray
    sigmas_rad: FloatArray
    star_of: IntArray
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.tdb_s)

    @property
    def measured(self) -> str:
        """Name of the measurements."""
        return "zenith distances"

    @property
    def values(self) -> FloatArray:
        """(n,) rad."""
        return self.values_rad

    @property
    def sigmas(self) -> FloatArray:
        """(n,) rad."""
        return self.sigmas_rad

    @property
    def epochs(self) -> FloatArray:
        """(n, 1) TDB s."""
        return self.tdb_s[:, None]

    @property
    def series(self) -> IntArray:
        """(n,) number of the star of each."""
        return self.star_of

    @property
    def sizes(self) -> Mapping[str, int]:
        """Two numbers for each star, along east and north."""
        return {"star_catalog": 2 * len(self.names)}

    def compute(self, states: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the angles (n,), rad, of states (n, 1, 6), and derivatives (n, 1, 6)."""
        angles, by_place, _ = zenith_distances(states[:, 0, :3], self.directions)
        by_states = np.zeros((len(angles), 1, 6))
        by_states[:, 0, :3] = by_place
        return angles, by_states

    def differentiate(
        self, parameter: FitParameter, states: FloatArray, by_states: FloatArray
    ) -> FloatArray | None:
        """Differentiate by the vertical forward and across, or by stars' places, per arc second."""
        if parameter.name == "vertical":
            axes = np.stack([rnb_of(state) for state in states[:, 0]])
            size = np.linalg.norm(states[:, 0, :3], axis=1)[:, None] * ARCSEC
            turned: FloatArray = (axes[:, 1:] @ by_states[:, 0, :3, None])[:, :, 0] * size
            return turned
        if parameter.name == "star_catalog":
            by_star = zenith_distances(states[:, 0, :3], self.directions)[2]
            along = (self.star_axes @ by_star[:, :, None])[:, :, 0] * ARCSEC
            derivative = np.zeros((len(along), len(self.names), 2))
            derivative[np.arange(len(along)), self.star_of] = along
            return derivative.reshape(len(along), -1)
        return None

    @property
    def stars_used(self) -> tuple[str, ...]:
        """Names of the stars that there are sights of."""
        return tuple(self.names[number] for number in np.unique(self.star_of))

    @property
    def star_axes(self) -> FloatArray:
        """(n, 2, 3) unit vectors east and north of each star, along which a catalogue errs."""
        east = np.stack([-self.directions[:, 1], self.directions[:, 0], 0.0 * self.tdb_s], axis=1)
        # at the pole itself any two axes serve
        east[np.linalg.norm(east, axis=1) < 1e-9] = (1.0, 0.0, 0.0)
        east /= np.linalg.norm(east, axis=1, keepdims=True)
        return np.stack([east, np.cross(self.directions, east)], axis=1)


def zenith_distances(
    places_m: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Angles (n,), rad, of places (n, 3) and stars (n, 3), and their derivatives.

    By place (n, 3), rad/m, and by the star's direction (n, 3), rad, for changes across it.
    """
    size = np.linalg.norm(places_m, axis=1)
    up = places_m / size[:, None]
    cosine = (up * directions).sum(axis=1)
    sine = np.linalg.norm(np.cross(up, directions), axis=1)
    safe = np.maximum(sine, 1e-12)[:, None]
    by_place = (cosine[:, None] * up - directions) / (safe * size[:, None])
    by_star = (cosine[:, None] * directions - up) / safe
    return np.arctan2(sine, cosine), by_place, by_star


def read_zenith(path: Path) -> ZenithSights:
    """The sights of a zenith.csv.

    Raises DataError, with line and column, for a file that cannot be read, a type that is not
    star_zenith, a star that is in no catalogue, times out of order, a star twice at a time, and
    numbers that are missing or cannot be.
    """
    catalog = load_bright_stars()
    rows = ZENITH.read(path, lambda row: (row, *_numbers(row)))
    if not rows:
        raise DataError(f"{path}: has a header but no rows; add a row for each zenith distance")
    if len(rows) > MAX_SIGHTS:
        raise DataError(f"{path}: has {len(rows)} rows, more than {MAX_SIGHTS}; fit parts of it")
    stars: dict[int, int] = {}
    star_of, before, here = [], -np.inf, set[int]()
    for row, time, direction, _, _ in rows:
        if time < before:
            raise DataError(
                f"{row.where}: utc {row['utc']} is before that of the row above; put the rows in "
                "the order of time"
            )
        here = here if time == before else set()
        seen = catalog.propagate(time)
        near = int(np.argmax(seen @ direction))
        if float(np.linalg.norm(seen[near] - direction)) > SAME_STAR_RAD:
            raise DataError(
                f"{row.where}: ra_deg {row['ra_deg']}, dec_deg {row['dec_deg']}: no star brighter "
                f"than V 6.5 stands there, the nearest is {catalog.label(near)}; mend them (ICRS, "
                "degrees, proper motion to the time)"
            )
        if near in here:
            raise DataError(
                f"{row.where}: {catalog.label(near)} stands twice at utc {row['utc']}; remove one "
                "row, or mend the time"
            )
        here.add(near)
        before = time
        star_of.append(stars.setdefault(near, len(stars)))
    return ZenithSights(
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
        np.array([row[4] for row in rows]),
        np.array(star_of, np.int64),
        tuple(catalog.label(number) for number in stars),
    )


def zenith_row(
    utc: str, direction: FloatArray, value_rad: float, sigma_rad: float
) -> dict[str, object]:
    """A row of zenith.csv."""
    ra = float(np.degrees(np.arctan2(direction[1], direction[0]))) % 360.0
    return {
        "utc": utc,
        "type": STAR_ZENITH,
        "ra_deg": ra,
        "dec_deg": float(np.degrees(np.arcsin(direction[2]))),
        "value_deg": float(np.degrees(value_rad)),
        "sigma_arcsec": sigma_rad / ARCSEC,
    }


def _numbers(row: CsvRow) -> tuple[float, FloatArray, float, float]:
    """Time, direction, value and sigma of a row."""
    if row["type"] != STAR_ZENITH:
        raise DataError(f"type is '{row['type']}'; wanted {STAR_ZENITH}")
    values = []
    for name, least, most in (
        ("ra_deg", -360.0, 360.0),
        ("dec_deg", -90.0, 90.0),
        ("value_deg", 0.0, 180.0),
        ("sigma_arcsec", 0.0, MAX_SIGMA_ARCSEC),
    ):
        value = row.number(name)
        if value is None or not least <= value <= most:
            raise DataError(f"{name} is '{row[name]}'; wanted {least:g} to {most:g}")
        values.append(value)
    if values[3] == 0.0:
        raise DataError("sigma_arcsec is 0; wanted the 1 sigma of the zenith distance, above 0")
    ra, dec, value = np.radians(values[:3])
    if not NEAREST_RAD < value < np.pi - NEAREST_RAD:
        raise DataError(
            f"value_deg is {row['value_deg']}: so near to the vertical a zenith distance says "
            "little; wanted 0.1 to 179.9"
        )
    direction = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    return utc_to_tdb_s(row["utc"], "utc"), direction, float(value), values[3] * ARCSEC
