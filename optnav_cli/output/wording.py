"""Numbers in words, tables, the account of a build as plain lines, and documents for programs."""

import json
import math
from collections.abc import Container, Iterable, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

if TYPE_CHECKING:  # no library is loaded before messages have a place to go
    from catalog.jobs.usage import Account, Peak, StageAccount

# Up to which length, m, a unit is used, and how many metres it has.
LENGTHS = ((1e3, "m", 1.0), (1e8, "km", 1e3), (math.inf, "thousand km", 1e6))
COLUMNS = ("stage", "done", "kept", "time", "CPU", "memory", "a worker", "read", "written")


def duration(seconds: float) -> str:
    """Seconds in words: 0.4 s, 12 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def speed(rate: float, unit: str) -> str:
    """A rate in words: 12.3 cells/s, or 4.0 s a cell when it is slow."""
    if rate <= 0.0:
        return f"no {unit} done yet"
    return f"{rate:.1f} {plural(unit, 2)}/s" if rate >= 1.0 else f"{1.0 / rate:.1f} s a {unit}"


def plural(unit: str, count: int) -> str:
    """The English plural of a unit of work: cells, geometries, pictures; MB stays."""
    if count == 1 or unit.isupper():
        return unit
    return f"{unit[:-1]}ies" if unit.endswith("y") else f"{unit}s"


def amount(count: float) -> str:
    """Bytes in words: 870 B, 12.3 MB, 1.04 GB."""
    for limit, unit, decimals in ((1e3, "B", 0), (1e6, "kB", 1), (1e9, "MB", 1)):
        if count < 0.9995 * limit:
            return f"{count / (limit / 1e3):.{decimals}f} {unit}"
    return f"{count / 1e9:.2f} GB"


class LengthUnit(NamedTuple):
    """What lengths of one row or sentence are written in."""

    name: str
    metres: float
    decimals: int

    def text(self, metres: float, sign: Literal["", "+"] = "") -> str:
        """A length's number, never "-0"; a dash for one that is no number."""
        if not math.isfinite(metres):
            return "-"
        return f"{metres / self.metres:{sign}z.{self.decimals}f}"


def length_unit(largest_m: float) -> LengthUnit:
    """Metres, km or thousands of km, for lengths of which this is the largest."""
    size = abs(largest_m) if math.isfinite(largest_m) else 0.0
    name, metres = next((name, metres) for limit, name, metres in LENGTHS if size < limit)
    number = size / metres
    # four digits, of whole metres one decimal
    if number >= 100.0 or (number >= 1.0 and metres == 1.0):
        return LengthUnit(name, metres, 1)
    return LengthUnit(name, metres, 2 if number >= 10.0 else 3)


def length(metres: float) -> str:
    """A length in words: 0.042 m, 812.3 m, 12.35 km, 384.4 thousand km."""
    unit = length_unit(metres)
    return f"{unit.text(metres)} {unit.name}"


def angle(radians: float) -> str:
    """An angle in words: 12.3", or degrees where it is large."""
    arcsec = 3600.0 * math.degrees(radians)
    return f'{arcsec:.1f}"' if abs(arcsec) < 36_000.0 else f"{arcsec / 3600.0:.1f} deg"


def table_lines(rows: Sequence[Sequence[str]], left: Container[int] = (0,)) -> list[str]:
    """Rows as lines, each column as wide as its widest cell, so that none run together.

    left  columns that begin at their left; the others, of numbers, end at their right
    Rows may be shorter than others.
    """
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    return [
        "  ".join(
            cell.ljust(width) if number in left else cell.rjust(width)
            for number, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in rows
    ]


def account_lines(account: "Account") -> list[str]:
    """Cells, points and reasons as far as they are known, then a row a stage."""
    lines = _outcome(account)
    rows = [COLUMNS, *(_row(stage, str(stage.done), str(stage.kept)) for stage in account.stages)]
    if len(account.stages) > 1:
        rows.append(_row(account.total(), "", ""))
    lines += table_lines(rows)
    if any("≤" in cell for row in rows for cell in row):
        lines.append("≤: reached before, in the process's life; the stage itself took no more")
    return lines


def _outcome(account: "Account") -> list[str]:
    cells = f"{account.cells} {plural('cell', account.cells)}"
    if account.points is None or account.usable is None:
        return [cells]
    share = _share(account.usable, account.points)
    lines = [f"{cells}, {account.points} control points, {account.usable} usable ({share})"]
    without = account.cells - account.points
    if without > 0:
        lines.append(f"without a point, for lack of ground: {without}")
    if account.reasons:
        unusable = account.points - account.usable
        lines.append(f"not usable: {unusable}, for these reasons (a point can have several):")
    name = max(map(len, account.reasons), default=0)
    number = max((len(str(count)) for count in account.reasons.values()), default=0)
    for reason, count in account.reasons.items():
        share = f"{_share(count, account.points):>7} of all"
        lines.append(f"  {reason:{name}}  {count:{number}d}  {share}")
    return lines


def _row(stage: "StageAccount", done: str, kept: str) -> tuple[str, ...]:
    times = (duration(stage.seconds), duration(stage.cpu_s))
    peaks = (_peak(stage.peak), _peak(stage.worker_peak))
    sizes = ("" if n is None else amount(n) for n in (stage.read_bytes, stage.written_bytes))
    return (stage.name, done, kept, *times, *peaks, *sizes)


def _peak(peak: "Peak | None") -> str:
    return "-" if peak is None else f"{'' if peak.is_own else '≤ '}{amount(peak.bytes)}"


def _share(count: int, of: int) -> str:
    return f"{100.0 * count / of:.1f} %" if of else "-"


def json_text(document: Mapping[str, object]) -> str:
    """A document as JSON, indented, keys in their order.

    Numbers that do not exist (NaN, infinities) are null. The text is ASCII, so that it can be
    printed in any locale, whatever the names of files in it.
    """
    return json.dumps(_plain(document), indent=2, allow_nan=False)


def _plain(value: object) -> object:
    """A value as JSON knows it. Raises TypeError for what has no place in a document."""
    if hasattr(value, "tolist"):  # numpy's arrays and numbers
        value = value.tolist()
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, Iterable):
        return [_plain(inner) for inner in value]
    raise TypeError(f"{value!r} has no place in a document")
