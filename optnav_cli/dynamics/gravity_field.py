"""Gravity fields in spherical harmonics: SHADR, ICGEM and .cof files, and the ones that ship.

V = GM/r (1 + sum (R/r)^n P_nm(sin lat) (C_nm cos m lon + S_nm sin m lon)), fully normalised.
Formats: SHADR, ASCII spherical harmonics of NASA's Planetary Data System, whose Moon files also
come with a first line of GM and R in metres alone; ICGEM's .gfc (Ince et al., Earth Syst. Sci. Data
11, 2019); .cof, as GMAT and STK read it.
"""

import logging
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.body import Body, GravityField
from catalog.config import resource
from catalog.errors import DataError
from catalog.inputs import MEGABYTE, read_input
from optnav_cli.dynamics.orbit_settings import MAX_DEGREE, ForcesSettings

EARTH_GRAVITY_M_S2 = 9.8

# Kaula's rule on the Earth, where it was found; elsewhere rock carries hills by the weight that
# they have there (the same source), but a body of rubble is no more uneven than Eros.
EARTH_KAULA = 1e-5
MAX_KAULA = 0.1

SHIPPED = {"moon": ("data/moon_glgm3_50.tab", 50)}  # and its degree
MAX_FIELD_BYTES = 128 * MEGABYTE  # of degree 1200, with errors
# A header's GM farther off is a slip of the pen or an old value: it is said and not used.
MAX_GM_SHARE = 1e-4
OTHER_BODY_GM, OTHER_BODY_RADIUS = 0.01, 0.1  # farther off it is not this body's field
MAX_SHIFT = 1e-7  # of the centre of mass, in radii: 0.2 m on the Moon, as C10, C11, S11
# Fully normalised coefficients of one degree are of one size; others fall as 1 / (n + m)!.
MAX_FALL, MIN_DEGREE_JUDGED = 1e-3, 4
# Principal axes leave S22 and C21, S21 zero; the Moon's mean-Earth axes do not: 2e-8.
MAX_PRINCIPAL_S22 = 5e-9

_log = logging.getLogger(__name__)
_SPLIT = re.compile(r"[,\s]+")
_TOUCHING = re.compile(r"(?<=\d)(?=[+-]\d*\.)")  # between 1.0E-06-2.0E-06


@dataclass(frozen=True, eq=False)
class HarmonicField:
    """Fully normalised coefficients of a body's field.

    radius_m  the radius that they are stated for
    c, s      (N + 1, N + 1) by degree and order; degrees 0 and 1 are not used
    errors    (N + 1,) rms of a degree's stated errors, all its orders; None where none are stated
    source    a name for a log
    """

    radius_m: float
    c: FloatArray
    s: FloatArray
    errors: FloatArray | None
    source: str

    @property
    def degree(self) -> int:
        """The highest degree."""
        return len(self.c) - 1

    def cut(self, degree: int) -> "HarmonicField":
        """The field up to a degree that it has."""
        end = degree + 1
        errors = None if self.errors is None else self.errors[:end]
        return HarmonicField(
            self.radius_m, self.c[:end, :end], self.s[:end, :end], errors, self.source
        )


def oblate_field(gravity: GravityField, source: str) -> HarmonicField:
    """Normalise the terms of a body's file: a field of the highest degree that it states."""
    degree = max(n for n, zonal in enumerate(gravity.zonals, start=2) if zonal or n == 2)
    c, s = np.zeros((2, degree + 1, degree + 1))
    for n, zonal in enumerate(gravity.zonals[: degree - 1], start=2):
        c[n, 0] = -zonal / math.sqrt(2.0 * n + 1.0)
    c[2, 2] = gravity.c22 * math.sqrt(12.0 / 5.0)
    s[2, 2] = gravity.s22 * math.sqrt(12.0 / 5.0)
    return HarmonicField(gravity.radius_km * 1e3, c, s, None, source)


def named_field(body: Body, settings: ForcesSettings, beside: Path) -> HarmonicField | None:
    """The field that [forces] names, of its degree; None for the terms of the body's file.

    Raises DataError for a file that is no whole, normalised field of this body up to the degree.
    """
    if settings.field is not None:
        # here, because what needs no field need not wait for the terrain readers
        from catalog.terrain.dem.file import resolve_path

        field = read_field(resolve_path(settings.field, beside), body)
        _check_frame(field, body, settings)
    elif body.name in SHIPPED and settings.degree != 2:
        field = read_field(resource(SHIPPED[body.name][0]), body)
    elif settings.degree in (None, 2):
        return None
    else:
        raise DataError(
            f"[forces] degree is {settings.degree}, and optnav ships no gravity field of "
            f"{body.name}; name a file as `field`, or set degree = 2"
        )
    degree = settings.degree or field.degree
    if degree > field.degree:
        raise DataError(
            f"[forces] degree is {degree}; {field.source} ends at degree {field.degree}: set a "
            "lower degree or name another file as `field`"
        )
    return field.cut(degree)


def read_field(path: Path, body: Body) -> HarmonicField:
    """A gravity field of a body from a file, to its last degree or MAX_DEGREE.

    Raises DataError for a file that is cut, not normalised or of another body, and for numbers
    that no field has. A GM of the header that is not the body's is said, and the body's is used.
    """
    raw = read_input(path, "gravity field", "check `field` in [forces]", limit=MAX_FIELD_BYTES)
    if b"\0" in raw:
        raise DataError(f"{path}: is not text; wanted a gravity field as SHADR, ICGEM .gfc or .cof")
    lines = raw.decode("utf-8", "replace").splitlines()
    table = _Table(path)
    if any(line.lstrip().lower().startswith("end_of_head") for line in lines):
        _read_icgem(lines, table)
    elif any(line.startswith("POTFIELD") for line in lines):
        _read_cof(lines, table)
    else:
        _read_shadr(lines, table)
    return table.field(body)


class _Table:
    """Rows of coefficients as they are read, and what a header says."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.gm = self.radius_m = math.nan
        self.stated_degree: int | None = None
        self.rows: dict[tuple[int, int], tuple[float, float, float]] = {}

    def head(self, gm: float, radius_m: float, degree: int | None, *, normalised: bool) -> None:
        self.gm, self.radius_m, self.stated_degree = gm, radius_m, degree
        if not normalised:
            raise DataError(
                f"{self.path}: the header says that its coefficients are not normalised; wanted "
                "fully normalised ones: divide C_nm by sqrt((2 - d_0m)(2n + 1)(n - m)!/(n + m)!)"
            )
        if not (math.isfinite(gm) and math.isfinite(radius_m) and gm > 0.0 and radius_m > 0.0):
            raise self.error(1, f"GM is {gm:g} and R {radius_m:g}; wanted numbers above 0")

    def add(self, line: int, words: list[str]) -> None:
        """A row: degree, order, C, S and, where they are stated, errors of both."""
        try:
            n, m = int(words[0]), int(words[1])
            # S of order 0 is often left out
            values = [_number(word) for word in words[2:6]] + ([] if len(words) > 3 else [0.0])
        except (ValueError, IndexError):
            raise self.error(line, "wanted degree, order, C and S") from None
        if len(values) < 2 or not 0 <= m <= n or n > 100_000:
            raise self.error(line, "wanted degree, order up to it, C and S")
        if not all(math.isfinite(value) and abs(value) <= 2.0 for value in values):
            raise self.error(line, "a coefficient is no number between -1 and 1")
        if (n, m) in self.rows:
            raise self.error(line, f"degree {n}, order {m} is there a second time")
        if n <= MAX_DEGREE:
            error = math.nan if len(values) < 4 else math.hypot(values[2], values[3])
            self.rows[n, m] = (values[0], values[1], error)
        self.stated_degree = max(n, self.stated_degree or 0)

    def error(self, line: int, found: str) -> DataError:
        return DataError(
            f"{self.path}: line {line}: {found}; wanted a gravity field as SHADR, ICGEM .gfc or "
            ".cof: fetch the file again"
        )

    def field(self, body: Body) -> HarmonicField:
        degree = min(self.stated_degree or 0, MAX_DEGREE)
        if degree < 2:
            raise DataError(f"{self.path}: has no coefficients of degree 2; fetch the file again")
        for n in range(2, degree + 1):
            for m in range(n + 1):
                if (n, m) not in self.rows:
                    raise DataError(
                        f"{self.path}: is cut or lacks rows: degree {n}, order {m} is not there, "
                        f"of {self.stated_degree} degrees; fetch the file again"
                    )
        share = self._check_body(body)
        c, s, errors = (np.zeros((degree + 1, degree + 1)) for _ in range(3))
        for (n, m), (cosine, sine, sigma) in self.rows.items():
            c[n, m], s[n, m], errors[n, m] = share * cosine, share * sine, sigma
        if max(abs(c[1, 0]), abs(c[1, 1]), abs(s[1, 1])) > MAX_SHIFT:
            raise DataError(
                f"{self.path}: its terms of degree 1 put the centre of mass beside the origin; "
                "wanted a field about the centre of mass"
            )
        self._check_norm(c, s, degree)
        by_degree = np.sqrt(np.sum(errors**2, axis=1) / (2.0 * np.arange(degree + 1) + 1.0))
        stated = None if np.isnan(by_degree[2:]).any() else np.nan_to_num(by_degree)
        return HarmonicField(self.radius_m, c, s, stated, self.path.name)

    def _check_body(self, body: Body) -> float:
        """Return the factor of the coefficients, because the body's GM is used with them."""
        gm_share = self.gm / body.gm_m3_s2
        off = abs(gm_share - 1.0)
        if off > OTHER_BODY_GM or abs(self.radius_m / body.radius_m - 1.0) > OTHER_BODY_RADIUS:
            raise DataError(
                f"{self.path}: GM is {self.gm / 1e9:.9g} km3/s2 and R {self.radius_m / 1e3:.6g} km;"
                f" {body.name} has {body.gm_m3_s2 / 1e9:.9g} and {body.radius_m / 1e3:.6g}: name "
                "a field of this body"
            )
        if off > MAX_GM_SHARE:
            _log.warning(
                "%s: the header's GM is %.9g km3/s2, %.1e off %s's %.9g; the latter is used",
                self.path, self.gm / 1e9, off, body.name, body.gm_m3_s2 / 1e9,
            )  # fmt: skip
            return 1.0
        return gm_share

    def _check_norm(self, c: FloatArray, s: FloatArray, degree: int) -> None:
        if degree < MIN_DEGREE_JUDGED:
            return
        sizes = np.hypot(c, s)[MIN_DEGREE_JUDGED:]
        n = np.arange(MIN_DEGREE_JUDGED, degree + 1)
        low = float(np.sqrt(np.mean(sizes[:, :2] ** 2)))
        high = float(np.sqrt(np.mean(sizes[np.arange(len(n)), n] ** 2)))
        if high < MAX_FALL * low:
            raise DataError(
                f"{self.path}: terms of full order are {high / low:.0e} of those of order 0 and "
                "1, as coefficients that are not normalised; wanted fully normalised ones"
            )


def _check_frame(field: HarmonicField, body: Body, settings: ForcesSettings) -> None:
    if body.name != "moon":
        if settings.field_frame != "body":
            raise DataError(
                f'[forces] field_frame is "{settings.field_frame}", which is known of the Moon '
                f"alone; wanted a field of {body.name} in its body frame"
            )
        return
    principal = abs(field.s[2, 2]) < MAX_PRINCIPAL_S22
    if principal != (settings.field_frame == "principal_axes"):
        _log.warning(
            "%s: S22 is %.1e, as of a field in %s; [forces] field_frame says \"%s\", 0.9 km "
            "aside at the surface",
            field.source, field.s[2, 2],
            "principal axes" if principal else "mean-Earth axes", settings.field_frame,
        )  # fmt: skip


def _number(word: str) -> float:
    return float(word.lower().replace("d", "e"))


def _words(line: str) -> list[str]:
    return _SPLIT.split(line.strip().strip(","))


def _read_shadr(lines: list[str], table: _Table) -> None:
    words = _words(lines[0]) if lines else []
    numbers: list[float] = []
    try:
        for word in words:
            numbers.append(_number(word))
    except ValueError:  # the address of the file, after GM and R
        pass
    if len(numbers) >= 6:
        normalised = numbers[5] == 1
        degree = numbers[3] if math.isfinite(numbers[3]) else 0.0
        table.head(numbers[1] * 1e9, numbers[0] * 1e3, int(degree), normalised=normalised)
    elif len(numbers) == 2:
        table.head(numbers[0], numbers[1], None, normalised=True)
    else:
        raise table.error(1, "no header with R and GM")
    for number, line in enumerate(lines[1:], start=2):
        if line.strip():
            table.add(number, _words(line))


def _read_icgem(lines: list[str], table: _Table) -> None:
    head: dict[str, str] = {}
    rows = iter(enumerate(lines, start=1))
    for _, line in rows:
        words = line.split()
        if words and words[0].lower() == "end_of_head":
            break
        if len(words) > 1:
            head.setdefault(words[0].lower(), words[1])
    try:
        gm = _number(head.get("earth_gravity_constant") or head["gravity_constant"])
        radius, degree = _number(head["radius"]), int(head["max_degree"])
    except (KeyError, ValueError):
        wanted = "earth_gravity_constant, radius and max_degree"
        raise table.error(1, f"the header lacks {wanted}") from None
    norm = head.get("norm", "fully_normalized").lower()
    table.head(gm, radius, degree, normalised=norm == "fully_normalized")
    for number, line in rows:
        words = line.split()
        # the constant part of a coefficient that changes with time comes as gfct
        if words and words[0].lower() in ("gfc", "gfct"):
            table.add(number, words[1:])


def _read_cof(lines: list[str], table: _Table) -> None:
    for number, line in enumerate(lines, start=1):
        if line.startswith("POTFIELD"):
            # numbers of three digits touch: POTFIELD100100
            words = [line[8:11], line[11:14], *line[14:].split()]
            try:
                degree, gm, radius = int(words[0]), _number(words[3]), _number(words[4])
                kind = _number(words[5]) if len(words) > 5 else 1.0
            except (ValueError, IndexError):
                raise table.error(number, "the line POTFIELD lacks degree, GM or R") from None
            table.head(gm, radius, degree, normalised=kind == 1.0)
        elif line.startswith("RECOEF"):
            numbers = _TOUCHING.sub(" ", line[14:]).split()
            table.add(number, [line[6:11].strip(), line[11:14].strip(), *numbers])
    if math.isnan(table.gm):
        raise table.error(1, "no line POTFIELD")


def even_field(body: Body) -> GravityField:
    """Return the field of a body's ellipsoid at even density."""
    x, y, z = body.radii_m
    radius = body.radius_m
    return GravityField(
        j2=(x**2 + y**2 - 2.0 * z**2) / (10.0 * radius**2),
        c22=(x**2 - y**2) / (20.0 * radius**2),
        radius_km=radius / 1e3,
    )


def kaula_by_gravity(body: Body) -> float:
    """Return the constant of Kaula's rule for a body of such gravity at its surface."""
    gravity = body.gm_m3_s2 / body.radius_m**2
    return min(EARTH_KAULA * (EARTH_GRAVITY_M_S2 / gravity) ** 2, MAX_KAULA)
