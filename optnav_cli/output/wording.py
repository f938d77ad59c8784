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


def format_duration(seconds: float) -> str:
    """Format seconds in words: 0.4 s, 12 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    rounded = round(seconds)
    if rounded < 60:
        return f"{rounded} s"
    if rounded < 3600:
        return f"{rounded // 60} min {rounded % 60:02d} s"
    return f"{rounded // 3600} h {rounded % 3600 // 60:02d} min"


def format_speed(rate: float, unit: str) -> str:
    """Format a rate in words: 12.3 cells/s, or 4.0 s a cell when it is slow."""
    if rate <= 0.0:
        return f"no {unit} done yet"
    return (
        f"{rate:.1f} {format_plural(unit, 2)}/s" if rate >= 1.0 else f"{1.0 / rate:.1f} s a {unit}"
    )


def format_plural(unit: str, count: int) -> str:
    """Format the English plural of a unit of work: cells, geometries, pictures; MB stays."""
    if count == 1 or unit.isupper():
        return unit
    return f"{unit[:-1]}ies" if unit.endswith("y") else f"{unit}s"


def format_bytes(count: float) -> str:
    """Format bytes in words: 870 B, 12.3 MB, 1.04 GB."""
    for limit, unit, decimals in ((1e3, "B", 0), (1e6, "kB", 1), (1e9, "MB", 1)):
        if count < 0.9995 * limit:
            return f"{count / (limit / 1e3):.{decimals}f} {unit}"
    return f"{count / 1e9:.2f} GB"


class LengthUnit(NamedTuple):
    """Unit of the lengths of one row or sentence."""

    name: str
    metres: float
    decimals: int

    def text(self, metres: float, sign: Literal["", "+"] = "") -> str:
        """Format a length's number, never "-0"; a dash for one that is no number."""
        if not math.isfinite(metres):
            return "-"
        return f"{metres / self.metres:{sign}z.{self.decimals}f}"


def choose_length_unit(largest_m: float) -> LengthUnit:
    """Choose metres, km or thousands of km, for lengths of which this is the largest."""
    size = abs(largest_m) if math.isfinite(largest_m) else 0.0
    name, metres = next((name, metres) for limit, name, metres in LENGTHS if size < limit)
    number = size / metres
    # four digits, of whole metres one decimal
    if number >= 100.0 or (number >= 1.0 and metres == 1.0):
        return LengthUnit(name, metres, 1)
    return LengthUnit(name, metres, 2 if number >= 10.0 else 3)


def format_length(metres: float) -> str:
    """Format a length in words: 0.042 m, 812.3 m, 12.35 km, 384.4 thousand km."""
    unit = choose_length_unit(metres)
    return f"{unit.text(metres)} {unit.name}"


def format_angle(radians: float) -> str:
    """Format an angle in words: 12.3", or degrees where it is large."""
    arcsec = 3600.0 * math.degrees(radians)
    return f'{arcsec:.1f}"' if abs(arcsec) < 36_000.0 else f"{arcsec / 3600.0:.1f} deg"


def align_table(rows: Sequence[Sequence[str]], left: Container[int] = (0,)) -> list[str]:
    """Format rows as lines, each column as wide as its widest cell, so that none run together.

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


def format_account(account: "Account") -> list[str]:
    """Format cells, points and reasons as far as they are known, then a row per stage."""
    lines = _describe_outcome(account)
    rows = [
        COLUMNS,
        *(_format_stage(stage, str(stage.done), str(stage.kept)) for stage in account.stages),
    ]
    if len(account.stages) > 1:
        rows.append(_format_stage(account.total(), "", ""))
    lines += align_table(rows)
    if any("≤" in cell for row in rows for cell in row):
        lines.append("≤: reached before, in the process's life; the stage itself took no more")
    return lines


def _describe_outcome(account: "Account") -> list[str]:
    cells = f"{account.cells} {format_plural('cell', account.cells)}"
    if account.points is None or account.usable is None:
        return [cells]
    share = _format_share(account.usable, account.points)
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
        share = f"{_format_share(count, account.points):>7} of all"
        lines.append(f"  {reason:{name}}  {count:{number}d}  {share}")
    return lines


def _format_stage(stage: "StageAccount", done: str, kept: str) -> tuple[str, ...]:
    times = (format_duration(stage.seconds), format_duration(stage.cpu_s))
    peaks = (_format_peak(stage.peak), _format_peak(stage.worker_peak))
    sizes = ("" if n is None else format_bytes(n) for n in (stage.read_bytes, stage.written_bytes))
    return (stage.name, done, kept, *times, *peaks, *sizes)


def _format_peak(peak: "Peak | None") -> str:
    return "-" if peak is None else f"{'' if peak.is_own else '≤ '}{format_bytes(peak.bytes)}"


def _format_share(count: int, of: int) -> str:
    return f"{100.0 * count / of:.1f} %" if of else "-"


def format_json(document: Mapping[str, object]) -> str:
    """Format a document as JSON, indented, keys in their order.

    Numbers that do not exist (NaN, infinities) are null. The text is ASCII, so that it can be
    printed in any locale, whatever the names of files in it.
    """
    return json.dumps(_convert_plain(document), indent=2, allow_nan=False)


def _convert_plain(value: object) -> object:
    """Convert a value to what JSON knows. Raises TypeError for what has no place in a document."""
    if hasattr(value, "tolist"):  # numpy's arrays and numbers
        value = value.tolist()
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): _convert_plain(inner) for key, inner in value.items()}
    if isinstance(value, Iterable):
        return [_convert_plain(inner) for inner in value]
    raise TypeError(f"{value!r} has no place in a document")
