"""The lines of a signal over time: frequencies found one by one, amplitudes solved together.

Frequency analysis after Laskar (Icarus 88, 1990): the spectrum's strongest line is found and its
frequency refined, all lines so far are solved by least squares, and the rest gives the next one.
Lines nearer to each other than one turn in the span are separated poorly.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from catalog.arrays import ComplexArray, FloatArray

Name = tuple[int, ...]

NEAR = 0.15  # of the resolution (one turn in the span): a line so near is the named one
PADDING = 4


@dataclass(frozen=True)
class Line:
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
        found = minimize_scalar(
            power,
            bounds=(lowest, rate + reach),
            method="bounded",
            options={"xatol": 1e-3 * self._resolution},
        )
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
