"""SPICE kernels that a user names: loaded, checked to be whole, and read.

The toolkit (NAIF; through the optional package spiceypy) holds its kernels once a process, so one
set is in use at a time and each question first puts its own set in place. Binary kernels are
checked by `daf.py` before it reads them. What kernels of orbits (SPK), attitudes (CK) and rotations
(PCK) cover is kept as windows, lists of spans, so that a question into a gap is answered as such.
"""

import re
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Literal

import numpy as np

from catalog.arrays import FloatArray
from catalog.bodies.coverage import (
    Missing,
    Quality,
    Span,
    explain_frame,
    explain_orbits,
    find_orbit_files,
    intersect_spans,
    judge_quality,
    list_attitude_files,
    read_windows,
)
from catalog.bodies.daf import RECORD_BYTES, check_daf
from catalog.bodies.epochs import utc_from_tdb_s
from catalog.errors import DataError
from catalog.inputs import MAX_TEXT_BYTES, check_input

Correction = Literal["LT+S", "LT", "NONE"]

INERTIAL = "J2000"  # SPICE's name of the ICRF axes
_MAX_PATH = 255  # of the toolkit
ORTHOGONAL = 1e-6  # of rotations
MAX_KM = 1e12
_DATA = re.compile(rb"^[ \t]*\\begindata[ \t\r]*$(.*?)(?:^[ \t]*\\begintext|\Z)", re.M | re.S)
_QUOTED = re.compile(rb"'[^'\n]*'")
_OTHER_KERNELS = re.compile(rb"KERNELS_TO_LOAD\s*\+?=", re.I)
# What an instrument kernel (IK) states of a camera: NAIF's and ISIS's names.
_INSTRUMENT = re.compile(
    rb"^[ \t]*(INS-?[0-9]+_(?:FOCAL_LENGTH|BORESIGHT|PIXEL_SIZE|PIXEL_PITCH|CCD_CENTER))"
    rb"[ \t]*=[ \t]*(\([^)]*\)|[^\s]+)",
    re.M,
)
_LOCK = threading.RLock()  # the toolkit is not safe to call from two threads


class KernelSet:
    """The kernels of one run, in the order given; later ones win over earlier ones.

    orbits  first and last time, TDB s, of the orbits of bodies, by NAIF number
    turns   the same of the binary orientation kernels
    cameras  what instrument kernels state of cameras, a line each: nothing here uses it
    Raises DataError for a kernel that is missing, cut short or no kernel, and where spiceypy is
    not installed.
    """

    _in_use: ClassVar[tuple[str, ...]] = ()  # files that the toolkit holds

    def __init__(self, paths: Sequence[Path]) -> None:
        texts = [_check_file(path.absolute()) for path in paths]
        self.cameras = tuple(
            f"{path.name}: {', '.join(stated)}"
            for path, text in zip(paths, texts, strict=True)
            if (stated := _extract_camera_constants(text))
        )
        self.paths = tuple(str(path.resolve()) for path in paths)
        with self._load_toolkit() as spice:
            self._orbits, self._turns = read_windows(spice, "SPK"), read_windows(spice, "PCK")
        self.orbits = {number: (w[0][0], w[-1][1]) for number, w in self._orbits.items()}
        self.turns = {number: (w[0][0], w[-1][1]) for number, w in self._turns.items()}

    @property
    def names(self) -> str:
        """The file names, for a log."""
        return ", ".join(Path(path).name for path in self.paths)

    def has_orbit(self, number: int) -> bool:
        """Whether a kernel has the orbit of the body with this NAIF number."""
        return number in self.orbits

    def has_frame(self, frame: str) -> bool:
        """Whether the kernels define a frame of this name, with data or without."""
        with self._load_toolkit() as spice:
            number = spice.namfrm(frame)
            try:
                return bool(number) and spice.frinfo(number) is not None
            except spice.exceptions.SpiceyError:
                return False

    def find_body_frame(self, body: str) -> str:
        """The frame that the kernels tie to a body; IAU_NAME by default."""
        with self._load_toolkit() as spice:
            return str(spice.cnmfrm(body.upper())[1])

    def rotation(self, frame: str, tdb_s: float) -> FloatArray:
        """Rotation (3, 3) taking inertial vectors to a frame. Raises DataError without data."""
        with self._load_toolkit() as spice:
            try:
                matrix: FloatArray = spice.pxform(INERTIAL, frame, tdb_s)
            except spice.exceptions.SpiceyError as error:
                missing = explain_frame(spice, frame, self._turns, tdb_s)
                raise self._make_coverage_error(
                    f"the frame {frame}", tdb_s, missing, error
                ) from None
        if not np.abs(matrix @ matrix.T - np.eye(3)).max() < ORTHOGONAL:
            raise self._make_damage_error(f"the frame {frame}", tdb_s)
        return matrix

    def position_m(self, of: int, seen_from: int, tdb_s: float, *, apparent: bool) -> FloatArray:
        """Position (3,) of a body from another one, inertial, m.

        of, seen_from  NAIF numbers
        apparent       with light time and stellar aberration; else at the very time
        Raises DataError where the kernels do not reach.
        """
        correction: Correction = "LT+S" if apparent else "NONE"
        return self.compute_apparent_m(of, seen_from, tdb_s, correction)[0]

    def compute_apparent_m(
        self, of: int, seen_from: int, tdb_s: float, correction: Correction
    ) -> tuple[FloatArray, float]:
        """Position (3,) of a body from another one, inertial, m, and the light time applied, s.

        of, seen_from  NAIF numbers
        correction     light time ("LT"), stellar aberration with it ("LT+S"), or "NONE"
        Raises DataError where the kernels do not reach.
        """
        with self._load_toolkit() as spice:
            try:
                km, light_s = spice.spkpos(str(of), tdb_s, INERTIAL, correction, str(seen_from))
            except spice.exceptions.SpiceyError as error:
                missing = explain_orbits(self._orbits, (of, seen_from), tdb_s)
                what = f"body {of} seen from {seen_from}"
                raise self._make_coverage_error(what, tdb_s, missing, error) from None
        if not np.abs(km).max() < MAX_KM:
            raise self._make_damage_error(f"body {of} seen from {seen_from}", tdb_s)
        return np.asarray(km) * 1e3, 0.0 if correction == "NONE" else float(light_s)

    def judge_qualities(self, number: int, tdb_s: float) -> tuple[Quality, Quality]:
        """Return the stated quality of a body's orbit at a time, and that of all attitudes."""
        with self._load_toolkit() as spice:
            orbit = judge_quality(spice, find_orbit_files(spice, number, tdb_s))
            return orbit, judge_quality(spice, list_attitude_files(spice))

    def has_barycentre_link(self, number: int, tdb_s: float) -> bool:
        """Whether the solar system's barycentre is reached from a body, as light time needs."""
        with self._load_toolkit() as spice:
            try:
                spice.spkpos("0", tdb_s, INERTIAL, "NONE", str(number))
            except spice.exceptions.SpiceyError:
                return False
        return True

    def find_orbit_span(self, numbers: Sequence[int]) -> Span | None:
        """First and last time, TDB s, of the orbits of all these bodies."""
        return intersect_spans(self.orbits[n] for n in numbers if n in self.orbits)

    def _make_damage_error(self, what: str, tdb_s: float) -> DataError:
        return DataError(
            f"SPICE kernels ({self.names}): impossible numbers about {what} at "
            f"{utc_from_tdb_s(tdb_s, 0)}; a kernel is damaged: fetch it again"
        )

    def _make_coverage_error(
        self, what: str, tdb_s: float, missing: Missing, error: Exception
    ) -> DataError:
        at = utc_from_tdb_s(tdb_s, 0)
        short = str(getattr(error, "short", "")) or type(error).__name__
        return DataError(
            f"SPICE kernels ({self.names}): nothing about {what} at {at} ({short}); "
            f"{'; '.join(missing)}"
        )

    @contextmanager
    def _load_toolkit(self) -> Iterator[ModuleType]:
        """The toolkit with this set in place, for one thread at a time."""
        try:
            spice = import_module("spiceypy")
        except ImportError:
            raise DataError(
                "SPICE kernels are named, but the package spiceypy is not installed; "
                "install it with `pip install 'optnav[spice]'`, or leave [spice] out"
            ) from None
        with _LOCK:
            if KernelSet._in_use != self.paths:
                for path in KernelSet._in_use:
                    spice.unload(path)
                KernelSet._in_use = ()
                for number, path in enumerate(self.paths):
                    try:
                        spice.furnsh(path)
                    except spice.exceptions.SpiceyError as error:
                        for loaded in self.paths[:number]:
                            spice.unload(loaded)
                        text = getattr(error, "long", "") or str(error)
                        raise DataError(
                            f"{path}: SPICE cannot load this kernel: {text}; fetch it again"
                        ) from None
                KernelSet._in_use = self.paths
            try:
                yield spice
            except spice.exceptions.SpiceyError as error:
                text = getattr(error, "long", "") or str(error)
                raise DataError(f"SPICE kernels ({self.names}): {text}; fetch them again") from None


def _extract_camera_constants(text: bytes) -> list[str]:
    """Extract the camera constants that a kernel's text states, as NAME = VALUE."""
    statements = []
    for data in _DATA.findall(text):
        for name, value in _INSTRUMENT.findall(data):
            statements.append(f"{name.decode()} = {' '.join(value.decode('latin-1').split())}")
    return statements


def _check_file(path: Path) -> bytes:
    """Refuse what is no kernel or cut short: the toolkit itself loads both without a word.

    Returns the text, empty of a binary kernel.
    """
    if len(str(path)) > _MAX_PATH:
        raise DataError(f"{path}: the path is longer than the {_MAX_PATH} letters of SPICE")
    size = check_input(path, "SPICE kernel")
    try:
        with path.open("rb") as file:
            head = file.read(RECORD_BYTES)
            binary = head.startswith((b"DAF/", b"DAS/", b"NAIF/DAF", b"DAFETF", b"DASETF"))
            # orbits of a century are hundreds of megabytes
            content = b"" if binary else head + file.read(MAX_TEXT_BYTES)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from None
    if binary:
        check_daf(path, head, size)
    elif any(map(_OTHER_KERNELS.search, _DATA.findall(content))):
        raise DataError(f"{path}: names other kernels (KERNELS_TO_LOAD); name these in its place")
    elif b"\\begindata" not in content:
        raise DataError(
            f"{path}: is no SPICE kernel (neither binary nor text with \\begindata); "
            "name .bsp, .bc, .bpc, .tpc, .tf, .tsc or .tls files"
        )
    else:
        last = content.rpartition(b"\\begindata")[2].partition(b"\\begintext")[0]
        last = _QUOTED.sub(b"", last)
        if last.count(b"(") != last.count(b")"):
            raise DataError(
                f"{path}: the SPICE kernel is cut short: a parenthesis of its last data section "
                "is not closed; fetch it again"
            )
    return content
