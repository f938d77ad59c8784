"""Round numbers along an axis, and how they are written."""

import math

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
PLAIN = (1e-3, 1e4)  # powers of ten outside are written as such


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers from low to high: steps of 1, 2 or 5 times a power of ten."""
    raw = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(f * power for f in (1.0, 2.0, 5.0, 10.0) if f * power >= 0.75 * raw)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(n * step, 12) for n in range(first, last + 1)]


def log_ticks(low: float, high: float) -> list[tuple[float, float]]:
    """Places, which are common logarithms, and numbers of ticks: 1, 2 and 5 of every power of ten.

    Over more than two powers the powers alone.
    """
    digits = (1.0, 2.0, 5.0) if high - low <= 2.0 else (1.0,)
    powers = range(math.floor(low), math.ceil(high) + 1)
    found = [(power + math.log10(d), float(f"{d:g}e{power}")) for power in powers for d in digits]
    return [(place, number) for place, number in found if low - 1e-9 <= place <= high + 1e-9]


def number_text(value: float) -> str:
    """A tick's number, short, with a true minus sign."""
    return f"{value:.10g}".replace("-", "\N{MINUS SIGN}")


def log_text(value: float) -> str:
    """A number on a logarithmic axis: 0.01, 200, 10⁶."""
    power = round(math.log10(value))
    if PLAIN[0] <= value <= PLAIN[1] or not math.isclose(value, 10.0**power):
        return number_text(value)
    return "10" + str(power).translate(SUPERSCRIPTS)
