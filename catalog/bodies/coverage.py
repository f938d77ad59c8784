"""Coverage of loaded SPICE kernels, and the reason where they have no data.

Coverage is kept as windows, so that a gap inside a kernel is a gap. For a frame without data the
chain of frames is followed (NAIF, "Frames Required Reading"): fixed frames (TK) to the one that
they are relative to, attitudes (CK) to their spacecraft's clock and to their reference frame, until
the missing kernel is known. Each function takes the toolkit with its kernels in place.
"""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Literal

from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import DataError

Span = tuple[float, float]  # TDB s
Windows = tuple[Span, ...]  # in order, without overlap
Quality = Literal["reconstructed", "predicted", ""]
Missing = tuple[str, str]  # why there are no data, and the remedy

REACH = "name kernels that reach further, or leave [spice] out"
ADD = "add the kernel that has it"

INERTIAL_CLASS, PCK_CLASS, CK_CLASS, TK_CLASS = 1, 2, 3, 4
MAX_SPANS_SHOWN = 3
MAX_COMMENT_LINES = 2000
MAX_FRAMES = 20  # of a chain; the toolkit follows as many
_MAX_OBJECTS = 10_000
_MAX_INTERVALS = 100_000


def read_windows(spice: ModuleType, kind: Literal["SPK", "PCK"]) -> dict[int, Windows]:
    """Windows of each body's orbit or of each binary rotation in the loaded kernels of a kind."""
    cells: dict[int, object] = {}
    for path in _list_loaded(spice, kind):
        numbers = spice.cell_int(_MAX_OBJECTS)
        try:
            (spice.spkobj if kind == "SPK" else spice.pckfrm)(path, numbers)
            for number in numbers:
                cell = cells.setdefault(number, spice.cell_double(2 * _MAX_INTERVALS))
                (spice.spkcov if kind == "SPK" else spice.pckcov)(path, number, cell)
        except spice.exceptions.SpiceyError as error:
            text = getattr(error, "long", "") or str(error)
            raise DataError(f"{path}: SPICE cannot read it: {text}; fetch it again") from None
    return {number: _read_spans(spice, cell) for number, cell in cells.items()}


def intersect_spans(spans: Iterable[Span]) -> Span | None:
    """Return the time that all spans share; None without spans."""
    listed = list(spans)
    if not listed:
        return None
    return max(span[0] for span in listed), min(span[1] for span in listed)


def is_covered(windows: Windows, tdb_s: float) -> bool:
    """Whether a time lies in one of the windows."""
    return any(first <= tdb_s <= last for first, last in windows)


def describe_windows(windows: Windows, tdb_s: float) -> str:
    """Describe the covered spans in words, and the gap that holds a time."""
    shown = windows
    if len(windows) > MAX_SPANS_SHOWN:  # those beside the time
        after = sum(last < tdb_s for _, last in windows)
        shown = windows[max(after - 1, 0) : after + 1]
    text = "they cover " + " and ".join(f"{_format_utc(a)} to {_format_utc(b)}" for a, b in shown)
    if len(shown) < len(windows):
        first, last = _format_utc(windows[0][0]), _format_utc(windows[-1][1])
        text += f" of {len(windows)} spans from {first} to {last}"
    for (_, begin), (end, _) in itertools.pairwise(windows):
        if begin < tdb_s < end:
            text += (
                f"; the gap from {_format_utc(begin)} to {_format_utc(end)} holds the time asked"
            )
    return text


def explain_orbits(orbits: Mapping[int, Windows], numbers: Sequence[int], tdb_s: float) -> Missing:
    """Say why no position of these bodies against each other is known.

    numbers  NAIF numbers of both bodies
    """
    lacking = [str(number) for number in numbers if number not in orbits]
    if lacking:
        return f"none has the orbit of body {' or '.join(lacking)}", ADD
    outside = [number for number in numbers if not is_covered(orbits[number], tdb_s)]
    if not outside:
        return "both are covered then, but no chain of centres joins them", (
            "add the orbit kernel (.bsp) of the planet or barycentre between them"
        )
    if common := intersect_windows([orbits[number] for number in numbers]):
        return describe_windows(common, tdb_s), REACH
    each = ", body ".join(
        f"{number}: {describe_windows(orbits[number], tdb_s)}" for number in numbers
    )
    return f"their orbits have no time in common; body {each}", REACH


def intersect_windows(several: Sequence[Windows]) -> Windows:
    """Times that lie in a window of each list."""
    common = several[0]
    for windows in several[1:]:
        pairs = ((max(a, c), min(b, d)) for a, b in common for c, d in windows)
        common = tuple(sorted((first, last) for first, last in pairs if first < last))
    return common


def explain_frame(
    spice: ModuleType, frame: str, turns: Mapping[int, Windows], tdb_s: float
) -> Missing:
    """Say why the orientation of a frame is not known at a time.

    turns  windows of the binary rotations, by the number of their frame class
    """
    for _ in range(MAX_FRAMES):
        number = spice.namfrm(frame)
        class_, class_id = _find_class(spice, number)
        if class_ == 0:
            return f"none defines the frame {frame}", "add its frame kernel (.tf)"
        if class_ == TK_CLASS:
            relative = _read_text(spice, f"TKFRAME_{class_id}_RELATIVE")
            relative = relative or _read_text(spice, f"TKFRAME_{frame}_RELATIVE")
            if not relative:
                return f"the frame {frame} is relative to nothing", "name its full frame kernel"
            frame = relative
        elif class_ == CK_CLASS:
            missing, frame = _explain_attitude(spice, frame, class_id, tdb_s)
            if missing is not None:
                return missing
        elif class_ == PCK_CLASS and class_id in turns:
            if not is_covered(turns[class_id], tdb_s):
                return describe_windows(turns[class_id], tdb_s), REACH
            return f"the rotation of {frame} is relative to a frame without data", ADD
        else:
            return f"none has the rotation of {frame} (.bpc or .tpc)", ADD
    return "its frames are relative to each other in a circle", "fetch the frame kernel again"


def _explain_attitude(
    spice: ModuleType, frame: str, number: int, tdb_s: float
) -> tuple[Missing | None, str]:
    """Say why a CK frame has no attitude; else name the frame that its attitude is relative to."""
    paths = [path for path in _list_loaded(spice, "CK") if number in spice.ckobj(path)]
    if not paths:
        return (f"none has attitudes of {frame} (number {number})", "add its C-kernel (.bc)"), ""
    clock = spice.ckmeta(number, "SCLK")
    if not _has(spice, f"SCLK_DATA_TYPE_{-clock}"):
        lacking = f"none has the clock of spacecraft {clock}"
        return (lacking, "add its clock kernel (SCLK, .tsc)"), ""
    if not _has(spice, "DELTET/K"):
        return ("none has leap seconds", "add their kernel (LSK, such as naif0012.tls)"), ""
    windows = read_attitude_windows(spice, number)
    if not is_covered(windows, tdb_s):
        return (f"attitudes of {frame}: {describe_windows(windows, tdb_s)}", REACH), ""
    below = next(_iterate_references(spice, paths[-1], number), 0)
    return None, str(spice.frmnam(below)) or str(below)


def read_attitude_windows(spice: ModuleType, number: int) -> Windows:
    """Windows, TDB s, of the attitudes of a CK number; needs its clock and leap seconds."""
    cell = spice.cell_double(2 * _MAX_INTERVALS)
    for path in _list_loaded(spice, "CK"):
        if number in spice.ckobj(path):
            spice.ckcov(path, number, False, "INTERVAL", 0.0, "TDB", cell)
    return _read_spans(spice, cell)


def judge_quality(spice: ModuleType, paths: Iterable[str]) -> Quality:
    """Whether the names and comments of kernels call them predicted or reconstructed; "" else."""
    said = {_read_quality(spice, path) for path in paths}
    if "predicted" in said:
        return "predicted"
    return "reconstructed" if said == {"reconstructed"} else ""


def _read_quality(spice: ModuleType, path: str) -> Quality:
    text = Path(path).name
    handle = spice.dafopr(path)
    try:
        _, lines, _ = spice.dafec(handle, MAX_COMMENT_LINES, 255)
        text += " ".join(map(str, lines))
    except spice.exceptions.SpiceyError:  # comments that are damaged, or of another system
        text += ""
    finally:
        spice.dafcls(handle)
    predicted, reconstructed = "predict" in text.lower(), "reconstruct" in text.lower()
    if predicted == reconstructed:
        return ""
    return "predicted" if predicted else "reconstructed"


def find_orbit_files(spice: ModuleType, number: int, tdb_s: float) -> list[str]:
    """The last loaded kernel with the orbit of a body at a time, which wins; none without one."""
    paths = []
    for path in _list_loaded(spice, "SPK"):
        if number in spice.spkobj(path):
            cell = spice.cell_double(2 * _MAX_INTERVALS)
            spice.spkcov(path, number, cell)
            if is_covered(_read_spans(spice, cell), tdb_s):
                paths.append(path)
    return paths[-1:]


def list_attitude_files(spice: ModuleType) -> list[str]:
    """All loaded kernels of attitudes."""
    return _list_loaded(spice, "CK")


def _iterate_references(spice: ModuleType, path: str, number: int) -> Iterator[int]:
    """Frames that the attitudes of a CK number in a file are relative to."""
    handle = spice.dafopr(path)
    try:
        spice.dafbfs(handle)
        while spice.daffna():
            _, words = spice.dafus(spice.dafgs(), 2, 6)
            if words[0] == number:
                yield int(words[1])
    finally:
        spice.dafcls(handle)


def _find_class(spice: ModuleType, number: int) -> tuple[int, int]:
    """Class of a frame and its number in the class; zeros for a frame that is not defined."""
    try:
        _, class_, class_id = spice.frinfo(number)
    except spice.exceptions.SpiceyError:
        return 0, 0
    return int(class_), int(class_id)


def _read_text(spice: ModuleType, variable: str) -> str:
    try:
        return str(spice.gcpool(variable, 0, 1)[0])
    except (spice.exceptions.SpiceyError, IndexError):
        return ""


def _has(spice: ModuleType, variable: str) -> bool:
    try:
        spice.dtpool(variable)
    except spice.exceptions.SpiceyError:
        return False
    return True


def _list_loaded(spice: ModuleType, kind: str) -> list[str]:
    return [str(spice.kdata(index, kind)[0]) for index in range(spice.ktotal(kind))]


def _read_spans(spice: ModuleType, cell: object) -> Windows:
    spans = (spice.wnfetd(cell, number) for number in range(spice.wncard(cell)))
    return tuple((float(first), float(last)) for first, last in spans)


def _format_utc(tdb_s: float) -> str:
    return utc_from_tdb_s(tdb_s, 0)
