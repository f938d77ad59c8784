"""Stars: those that ship with optnav, where they stand at a time, as a moving body sees them.

Source: ESA, The Hipparcos and Tycho Catalogues, SP-1200 (1997): places of epoch J1991.25 (TT),
ICRS, and proper motions. Parallaxes are left out: 0.75" of the nearest star, below 0.1" of most.

Star catalogues that people bring: a CSV of places, proper motions and magnitudes.

Columns carry their units in their names, or are those of the Gaia archive (Gaia Collaboration,
Gaia DR3 documentation, `gaia_source`), whose units are fixed: ra, dec (deg), pmra, pmdec (mas/yr),
phot_g_mean_mag, ref_epoch. Places are ICRS; motions in right ascension are along the sky.
"""

import csv
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from catalog.arrays import BoolArray, FloatArray, IntArray
from catalog.bodies.body import JULIAN_YEAR_S
from catalog.config import resource
from catalog.errors import DataError
from catalog.inputs import MEGABYTE, read_input
from catalog.keywords import Keyword, check_keywords

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


@dataclass(frozen=True, eq=False)
class StarPairs:
    """Pairs of stars by their angle: angles (m,) rising, first and second (m,)."""

    angles: FloatArray
    first: IntArray
    second: IntArray

    def select_near(self, angle: float, tolerance: float) -> tuple[IntArray, IntArray]:
        """Select both ends, in both orders, of pairs of an angle."""
        low, high = np.searchsorted(self.angles, (angle - tolerance, angle + tolerance))
        a, b = self.first[low:high], self.second[low:high]
        return np.concatenate([a, b]), np.concatenate([b, a])


@lru_cache(maxsize=4)
def list_star_pairs(catalog: BrightStars, count: int, widest: float) -> StarPairs:
    """List pairs of the brightest stars: a century of proper motion changes no angle by a pixel."""
    directions = catalog.propagate(None)[:count]
    reach = 2.0 * np.sin(widest / 2.0)
    ends = cKDTree(directions).query_pairs(reach, output_type="ndarray")
    chords = np.linalg.norm(directions[ends[:, 0]] - directions[ends[:, 1]], axis=1)
    angles = 2.0 * np.arcsin(chords / 2.0)
    order = np.argsort(angles, kind="stable")
    return StarPairs(angles[order], ends[order, 0], ends[order, 1])


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


MAX_CATALOG_BYTES = 512 * MEGABYTE  # some four million stars
MIN_EPOCH, MAX_EPOCH = 1800.0, 2200.0
# Barnard's star moves by 10,400 mas/yr; larger values are other units.
MAX_MOTION_MAS_YR = 12_000.0
MIN_MAGNITUDE, MAX_MAGNITUDE = -2.0, 25.0
NO_VALUE = ("", "null", "nan", "--")
EPOCHS = ("epoch", "epoch_year", "ref_epoch")
RA, DEC, PM_RA, PM_DEC, MAGNITUDE = "ra_deg", "dec_deg", "pm_ra_mas_yr", "pm_dec_mas_yr", "mag"
# Names of each quantity; a name without a unit counts in a table of the Gaia archive alone.
NAMES: dict[str, tuple[str, ...]] = {
    RA: (RA,),
    DEC: (DEC,),
    PM_RA: (PM_RA, "pm_ra_cosdec_mas_yr"),
    PM_DEC: (PM_DEC,),
    MAGNITUDE: (MAGNITUDE, "v_mag", "g_mag"),
}
GAIA = {RA: "ra", DEC: "dec", PM_RA: "pmra", PM_DEC: "pmdec", MAGNITUDE: "phot_g_mean_mag"}
_FRAME = "wanted places in ICRS (J2000 axes); precess them first"
_UNIT = "wanted ra_deg and dec_deg in degrees: convert the column and rename it"
KEYWORDS = {
    **{
        name: Keyword("used", "place, motion or magnitude")
        for names in NAMES.values()
        for name in names
    },
    **{name: Keyword("used", "of the Gaia archive, in its units") for name in GAIA.values()},
    **{name: Keyword("used", "the year that places are stated for") for name in EPOCHS},
    "name": Keyword("used", "what overlays call the star"),
    "hip": Keyword("used", "number of the star in the Hipparcos catalogue"),
    "source_id": Keyword("used", "number of the star in Gaia's catalogue"),
    "parallax": Keyword("harmless", "moves a star by less than 1 arc second"),
    "equinox": Keyword("refused", _FRAME, ("", "J2000", "J2000.0", "2000", "2000.0")),
    "frame": Keyword("refused", _FRAME, ("", "ICRS", "ICRF", "J2000", "FK5")),
    "ra_hours": Keyword("refused", _UNIT),
    "ra_hms": Keyword("refused", _UNIT),
    "dec_dms": Keyword("refused", _UNIT),
    "ra_rad": Keyword("refused", _UNIT),
    "dec_rad": Keyword("refused", _UNIT),
}  # fmt: skip

_log = logging.getLogger(__name__)


def read_star_catalog(path: Path, epoch: float | None = None) -> BrightStars:
    """Read stars from a CSV, the brightest first.

    epoch  Julian year that the places hold for, such as 2016.0 (Gaia DR3) or 1991.25 (Hipparcos);
           None where the table has a column of it

    Raises DataError for a table that lacks a column or the epoch, and for values that no star has.
    """
    raw = read_input(path, "star catalogue", "make it, or check the path", limit=MAX_CATALOG_BYTES)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(f"{path}: is not UTF-8 text; save it as CSV in UTF-8") from None
    try:
        lines = [line for line in csv.reader(_strip_comments(text), skipinitialspace=True) if line]
    except csv.Error as error:
        raise DataError(f"{path}: is not a CSV file: {error}") from None
    if len(lines) < 2:
        raise DataError(f"{path}: has no stars; wanted a header and a row of each star")
    table = _Table(path, [name.strip() for name in lines[0]], lines[1:])
    return table.read_stars(epoch)


def _strip_comments(text: str) -> list[str]:
    return [line for line in text.splitlines() if line.strip() and not line.startswith("#")]


class _Table:
    """Rows of a catalogue under their names."""

    def __init__(self, path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        self.path, self.header, self.rows = path, list(header), rows
        for number, row in enumerate(rows, start=2):
            if len(row) != len(header):
                raise DataError(
                    f"{path}: row {number} has {len(row)} cells, the header {len(header)}; "
                    "fetch or save the table again"
                )
        twice = sorted({name for name in self.header if self.header.count(name) > 1})
        if twice:
            raise DataError(f"{path}: has the column '{twice[0]}' twice; remove one")
        first = dict(zip(self.header, rows[0], strict=True))
        check_keywords(path, first.items(), KEYWORDS)
        for name in ("equinox", "frame"):
            # of a later row as of the first
            values = set(self._read_cells(name)) if name in self.header else set()
            check_keywords(path, ((name, value) for value in sorted(values)), KEYWORDS)

    def _read_cells(self, name: str) -> list[str]:
        column = self.header.index(name)
        return [row[column].strip() for row in self.rows]

    def _find_column(self, quantity: str) -> str:
        gaia = GAIA[MAGNITUDE] in self.header
        names = [*NAMES[quantity], *([GAIA[quantity]] if gaia else [])]
        stated = [name for name in names if name in self.header]
        if len(stated) == 1:
            return stated[0]
        if stated:
            raise DataError(
                f"{self.path}: has both '{stated[0]}' and '{stated[1]}'; remove one of them"
            )
        bare = next((name for name in self.header if name.lower() == GAIA[quantity]), None)
        hint = f"; its column '{bare}' names no unit: rename it" if bare else ""
        raise DataError(
            f"{self.path}: has no column '{quantity}'{hint}; wanted {', '.join(NAMES)} "
            "(motions may be empty), or the columns of the Gaia archive"
        )

    def _read_numbers(self, name: str) -> FloatArray:
        """A column (n,); NaN where a cell is empty."""
        values = np.empty(len(self.rows))
        for number, cell in enumerate(self._read_cells(name)):
            try:
                values[number] = np.nan if cell.lower() in NO_VALUE else float(cell)
            except ValueError:
                raise DataError(
                    f"{self.path}: row {number + 2}, {name}: '{cell[:40]}' is no number; wanted "
                    "decimal numbers"
                ) from None
        return values

    def _refuse(self, wrong: BoolArray, name: str, values: FloatArray, wanted: str) -> None:
        if wrong.any():
            row = int(np.argmax(wrong))
            raise DataError(
                f"{self.path}: row {row + 2}, {name}: {values[row]:.10g}; wanted {wanted}"
            )

    def _read_epochs(self, epoch: float | None) -> FloatArray:
        """The year (n,) of each star's place."""
        stated = [name for name in EPOCHS if name in self.header]
        if not stated:
            if epoch is None:
                raise DataError(
                    f"{self.path}: states no epoch, and stars move; give --epoch (in a config "
                    "`epoch`), 2016.0 for Gaia DR3, 1991.25 for Hipparcos, or a column 'epoch'"
                )
            years = np.full(len(self.rows), epoch)
        else:
            years = self._read_numbers(stated[0])
            if epoch is not None and not np.all(np.abs(years - epoch) < 1e-6):
                raise DataError(
                    f"{self.path}: its column '{stated[0]}' has {years[0]:g}, and {epoch:g} is "
                    "stated beside it; leave one of them out"
                )
        wrong = ~((years >= MIN_EPOCH) & (years <= MAX_EPOCH))
        self._refuse(wrong, stated[0] if stated else "epoch", years, "a Julian year, as 2016.0")
        return years

    def read_stars(self, epoch: float | None) -> BrightStars:
        names = {quantity: self._find_column(quantity) for quantity in NAMES}
        ra, dec, pm_ra, pm_dec, mag = (self._read_numbers(names[quantity]) for quantity in NAMES)
        self._refuse(~((ra >= -180.0) & (ra <= 360.0)), names[RA], ra, "degrees, 0 to 360")
        self._refuse(~(np.abs(dec) <= 90.0), names[DEC], dec, "degrees, -90 to 90")
        for name, motion in ((names[PM_RA], pm_ra), (names[PM_DEC], pm_dec)):
            wrong = np.abs(motion) > MAX_MOTION_MAS_YR
            self._refuse(wrong, name, motion, f"mas/yr, at most {MAX_MOTION_MAS_YR:g} either way")
        wrong = (mag < MIN_MAGNITUDE) | (mag > MAX_MAGNITUDE)
        self._refuse(wrong, names[MAGNITUDE], mag, f"{MIN_MAGNITUDE:g} to {MAX_MAGNITUDE:g}")
        self._check_units(ra, dec)
        years = self._read_epochs(epoch)
        known = ~np.isnan(mag)
        still = np.isnan(pm_ra) | np.isnan(pm_dec)
        if not known.any():
            raise DataError(f"{self.path}: no star has a magnitude; fill in '{names[MAGNITUDE]}'")
        if not known.all():
            _log.warning("%s: %d stars without a magnitude are left out", self.path, (~known).sum())
        if still.any():
            _log.warning("%s: %d stars without a proper motion stand still", self.path, still.sum())
        motions = np.nan_to_num(np.stack([pm_ra, pm_dec], axis=1))
        order = np.argsort(mag, kind="stable")
        order = order[known[order]]
        labels = self._make_labels()
        return make_stars(
            np.stack([ra, dec], axis=1)[order], motions[order], mag[order], years[order],
            tuple(labels[number] for number in order),
        )  # fmt: skip

    def _check_units(self, ra: FloatArray, dec: FloatArray) -> None:
        """Refuse a whole sky in hours or radians under the name of degrees."""
        covers_sky = len(ra) >= 50 and float(np.ptp(dec)) > 1.2 * max(float(np.ptp(ra)), 1e-9)
        if covers_sky and 20.0 < float(ra.max()) <= 24.0 and float(ra.min()) >= 0.0:
            raise DataError(f"{self.path}: {RA} ends at {ra.max():.4g}, as hours; multiply by 15")
        if float(np.abs(dec).max()) <= 1.5708 and 5.5 < float(ra.max()) <= 6.2832:
            raise DataError(
                f"{self.path}: {RA} ends at {ra.max():.4g} and {DEC} at {np.abs(dec).max():.4g}, "
                "as radians; convert them to degrees"
            )

    def _make_labels(self) -> list[str]:
        """Label each star by its name, its number in a catalogue, or its row."""
        labels = [f"row {number}" for number in range(2, len(self.rows) + 2)]
        for column, prefix in (("source_id", "Gaia "), ("hip", "HIP "), ("name", "")):
            if column in self.header:
                cells = self._read_cells(column)
                labels = [prefix + a if a else b for a, b in zip(cells, labels, strict=True)]
        return labels
