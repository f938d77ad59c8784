"""What a published rotation series lacks against SPICE kernels, fitted as trigonometric terms.

The difference is a small turn, three angles over time, whose strongest lines are found and fitted.
A line near a combination of the Moon's arguments takes that combination's angle; the others
(planets, free librations) keep the frequency that was found. The fit is checked at times that it
has not seen. Such terms describe the span they were fitted on; beyond it they fail: fitted to 2020
they are off by 38 m in 2030 and by 115 m in 2050.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from catalog.arrays import ComplexArray, FloatArray
from catalog.bodies.body import Body, CorrectionTerm, RotationCorrection, load_body
from catalog.bodies.ephemeris import SpiceEphemeris
from catalog.bodies.epochs import DAY_S
from catalog.bodies.rotation import CENTURY_S, body_from_inertial
from catalog.errors import UsageError
from catalog.geometry.rotations import ARCSEC
from catalog.progress import Progress
from tests.studies.tables import Cell, StudyReport, StudyTable, columns

Name = tuple[int, ...]

NEAR = 0.15  # of the resolution (one turn in the span): a line so near is the named one
PADDING = 4


class Line(NamedTuple):
    """One line: its angle (3,), deg by powers of time, and that angle's name, if it has one."""

    angle: FloatArray
    name: Name | None


class LineFit:
    """Lines, with a slow part quadratic in time, of evenly spaced values.

    times   (n,)    any unit
    values  (n, k)  series that share the lines
    known   angles (3,), deg by powers of time, that lines near them take, by name
    """

    def __init__(self, times: FloatArray, values: FloatArray, known: Mapping[Name, FloatArray]):
        self.lines: list[Line] = []
        self._t, self._values = times, values
        self._columns = np.stack([times**power for power in range(3)], axis=1)
        self._resolution = 360.0 / float(times[-1] - times[0])
        self._names, self._angles = list(known), np.reshape(list(known.values()), (-1, 3))
        self._solve()

    @property
    def slow(self) -> FloatArray:
        """Coefficients (3, k) of the slow part by powers of time."""
        return self._solved[:3]

    @property
    def waves(self) -> FloatArray:
        """Amplitudes (line, 2, k) of each line's sine and cosine."""
        return self._solved[3:].reshape(len(self.lines), 2, -1)

    def add_line(self) -> None:
        """Find the strongest line of what is left and solve all lines anew."""
        count = len(self._t)
        spectrum = (np.abs(np.fft.rfft(self._left, PADDING * count, axis=0)) ** 2).sum(axis=1)
        spectrum[: PADDING // 2] = 0.0  # slower than the span: the polynomial's
        rate = float(np.argmax(spectrum)) * self._resolution * (count - 1) / count / PADDING
        rate = self._sharpen(rate, self._resolution / 3.0, self._left)
        self.lines.append(self._named(rate))
        self._columns = np.hstack([self._columns, _waves(self.lines[-1].angle, self._t)])
        self._solve()

    def refine(self) -> None:
        """Find each free line's frequency again with all the others taken away."""
        for number, line in enumerate(self.lines):
            if line.name is not None:
                continue
            place = slice(3 + 2 * number, 5 + 2 * number)
            alone = self._left + self._columns[:, place] @ self._solved[place]
            rate = self._sharpen(float(line.angle[1]), self._resolution / 2.0, alone)
            self.lines[number] = Line(np.array([0.0, rate, 0.0]), None)
            self._columns[:, place] = _waves(self.lines[number].angle, self._t)
        self._solve()

    def _solve(self) -> None:
        columns = self._columns
        normal = columns.T @ columns
        self._solved: FloatArray = np.linalg.solve(normal, columns.T @ self._values).astype(float)
        self._left = self._values - columns @ self._solved

    def _sharpen(self, rate: float, reach: float, left: FloatArray) -> float:
        """The frequency, deg a century, with the largest power near one."""

        def power(trial: float) -> float:
            wave: ComplexArray = np.exp(-1j * np.radians(trial) * self._t)
            return -float(np.sum(np.abs(wave @ left) ** 2))

        lowest = max(rate - reach, 0.05 * self._resolution)
        ends, options = (lowest, rate + reach), {"xatol": 1e-3 * self._resolution}
        found = minimize_scalar(power, bounds=ends, method="bounded", options=options)
        return float(found.x)

    def _named(self, rate: float) -> Line:
        apart = np.abs(self._angles[:, 1] - rate) / self._resolution
        taken = {line.name for line in self.lines}
        near = [int(i) for i in np.flatnonzero(apart < NEAR) if self._names[i] not in taken]
        if not near:
            return Line(np.array([0.0, rate, 0.0]), None)
        # of several the simplest combination
        best = min(near, key=lambda i: (sum(map(abs, self._names[i])), apart[i]))
        return Line(self._angles[best], self._names[best])


def _waves(angle: FloatArray, t: FloatArray) -> FloatArray:
    argument = np.radians(angle[0] + t * (angle[1] + t * angle[2]))
    return np.stack([np.sin(argument), np.cos(argument)], axis=1)


# The Moon's fundamental arguments l, l', F, D, Omega, arcsec by centuries (IERS Conventions 2010,
# 5.43, whose higher terms are left out: 0.1" in a century).
DELAUNAY_NAMES = ("l", "l'", "F", "D", "Om")
DELAUNAY_ARCSEC = np.array(
    [
        [485868.249036, 1717915923.2178, 31.8792],
        [1287104.79305, 129596581.0481, -0.5532],
        [335779.526232, 1739527262.8478, -12.7512],
        [1072260.70369, 1602961601.2090, -6.3706],
        [450160.398036, -6962890.5431, 7.4722],
    ]
)
MAX_MULTIPLE, MAX_ORDER = 4, 6
STEP_DAYS = 2.0  # the shortest periods that matter are 9 days
EDGE_S = DAY_S  # kernels end a little inside their own nominal years
SWEEPS = 2
CHECKS = 6000


@dataclass(frozen=True)
class RotationFit:
    """A correction, and what it leaves at times between those of the fit.

    lines       of its terms, in the same order
    before_m    (rms, largest) shift of the surface by the published series
    axes_m      (3,) rms of what remains, by body axis
    after_m     (rms, largest) of what remains
    by_decade   (first year, rms, largest)
    """

    body: Body
    kernels: str
    correction: RotationCorrection
    lines: list[Line]
    before_m: tuple[float, float]
    axes_m: FloatArray
    after_m: tuple[float, float]
    by_decade: list[tuple[int, float, float]]


def run(
    progress: Progress, body: str, kernels: Sequence[Path], years: tuple[float, float], terms: int
) -> RotationFit:
    """Fit `terms` lines to the kernels' rotation over a span of years and check the result.

    Raises UsageError for less than a year, ConfigError for an unknown body, DataError for kernels
    that do not cover the span.
    """
    if not years[1] - years[0] >= 1.0:
        raise UsageError(f"--years {years[0]:g} {years[1]:g}: wanted a first and a later last year")
    turning = load_body(body)
    spice = SpiceEphemeris(turning, kernels)
    published = replace(turning, rotation_correction=None)
    first, last = ((year - 2000.0) * 365.25 * DAY_S for year in years)
    first, last = first + EDGE_S, last - EDGE_S
    times = np.linspace(first, last, int((last - first) / (STEP_DAYS * DAY_S)))
    with progress.stage("rotation", terms, "term") as bar:
        turned = turns(spice, published, times) / ARCSEC
        fit = LineFit(times / CENTURY_S, turned, _lunar_combinations())
        for _ in range(terms):
            fit.add_line()
            bar.advance()
        for _ in range(SWEEPS):
            fit.refine()
    checks = np.random.default_rng(1).uniform(first, last, CHECKS)
    correction = _correction(fit, years)
    corrected = replace(turning, rotation_correction=correction)
    left_m = turns(spice, corrected, checks) * turning.radius_m
    axes_m = np.sqrt(np.mean(left_m**2, axis=0))
    shift = np.linalg.norm(left_m, axis=1)
    decades = 10 * np.floor((2000.0 + checks / (365.25 * DAY_S)) / 10.0).astype(int)
    worst_m = float(np.ceil(axes_m.max() * 10.0) / 10.0)  # of an axis, rounded up
    correction = msgspec.structs.replace(correction, error_m=worst_m)
    before = _rms_and_largest(
        np.linalg.norm(turns(spice, published, checks), axis=1) * turning.radius_m
    )
    after = _rms_and_largest(shift)
    by_decade = [(int(d), *_rms_and_largest(shift[decades == d])) for d in np.unique(decades)]
    return RotationFit(turning, spice.name, correction, fit.lines, before, axes_m, after, by_decade)


def turns(spice: SpiceEphemeris, body: Body, times: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3), rad, that take the analytic body frame on to the kernels'."""
    truth = np.array([spice.body_from_inertial(float(t)) for t in times])
    pieces = np.array_split(times, max(1, len(times) // 4000))
    ours = np.concatenate([body_from_inertial(body, piece) for piece in pieces])
    turned: FloatArray = Rotation.from_matrix(truth @ ours.swapaxes(1, 2)).as_rotvec()
    return turned


def _correction(fit: LineFit, years: tuple[float, float]) -> RotationCorrection:
    """The terms, in the digits that a file holds; their error is not yet known."""
    slow, waves = fit.slow.T, fit.waves
    return RotationCorrection(
        years=years,
        error_m=0.0,
        x_arcsec_by_century=_rounded(slow[0], 5),
        y_arcsec_by_century=_rounded(slow[1], 5),
        z_arcsec_by_century=_rounded(slow[2], 5),
        terms=tuple(
            CorrectionTerm(_rounded(line.angle, 6), _rounded(sine, 4), _rounded(cosine, 4))
            for line, (sine, cosine) in zip(fit.lines, waves, strict=True)
        ),
    )


def _lunar_combinations() -> dict[tuple[int, ...], FloatArray]:
    """Angles (3,), deg by powers of centuries, of the combinations that lines are named after."""
    multiples = product(range(-MAX_MULTIPLE, MAX_MULTIPLE + 1), repeat=5)
    chosen = (m for m in multiples if 0 < sum(map(abs, m)) <= MAX_ORDER)
    angles = {m: np.array(m) @ DELAUNAY_ARCSEC / 3600.0 for m in chosen}
    return {m: angle for m, angle in angles.items() if angle[1] > 0.0}


def format_toml(fit: RotationFit) -> str:
    """The section [rotation_correction] of a body file."""
    correction = fit.correction
    lines = [
        "[rotation_correction]",
        f"years = {_list(correction.years)}",
        f"error_m = {correction.error_m}",
    ]
    for axis in "xyz":
        values = getattr(correction, f"{axis}_arcsec_by_century")
        lines.append(f"{axis}_arcsec_by_century = {_list(values)}")
    lines.append("terms = [")
    for term, line in zip(correction.terms, fit.lines, strict=True):
        days = 360.0 * 36525.0 / term.angle_deg_by_century[1]
        name = f"{_name(line.name)}, " if line.name else ""
        lines.append(
            f"    {{ angle_deg_by_century = {_list(term.angle_deg_by_century)}, "
            f"sin_arcsec = {_list(term.sin_arcsec)}, "
            f"cos_arcsec = {_list(term.cos_arcsec)} }},  # {name}{days:.2f} d"
        )
    return "\n".join([*lines, "]"])


COLUMNS = columns(
    "series; shift, rms [m] .2f; largest [m] .2f; about x, rms [m] .2f; about y, rms [m] .2f; "
    "about z, rms [m] .2f"
)


def report(fit: RotationFit) -> StudyReport:
    """What the fit has reached, at times that it has not seen."""
    rows: list[tuple[Cell, ...]] = [
        ("published", *fit.before_m, None, None, None),
        ("with the correction", *fit.after_m, *(float(value) for value in fit.axes_m)),
    ]
    rows += [(f"  from {year}", rms, most, None, None, None) for year, rms, most in fit.by_decade]
    title = (
        f"rotation of {fit.body.name}, {len(fit.lines)} terms, against {fit.kernels}: shift of the "
        f"surface at {CHECKS} times between those of the fit"
    )
    return StudyReport((StudyTable(title, COLUMNS, tuple(rows)),))


def _rms_and_largest(shift: FloatArray) -> tuple[float, float]:
    return float(np.sqrt(np.mean(shift**2))), float(shift.max())


def _rounded(values: Sequence[float] | FloatArray, digits: int) -> tuple[float, float, float]:
    x, y, z = (round(float(value), digits) for value in values)
    return x, y, z


def _list(values: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _name(multiples: tuple[int, ...]) -> str:
    """A combination as people write it: 2F - 2D."""
    parts = [
        f"{'-' if m < 0 else '+'} {abs(m) if abs(m) > 1 else ''}{name}"
        for m, name in zip(multiples, DELAUNAY_NAMES, strict=True)
        if m
    ]
    text = " ".join(parts)
    return text.removeprefix("+ ") if text.startswith("+") else "-" + text[2:]
