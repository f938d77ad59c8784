"""C-kernels: each type against the spin that it was made of; forms, gaps and lacking parts."""

import struct
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.daf import KEYWORDS
from catalog.bodies.kernels import KernelSet
from catalog.errors import DataError
from tests.catalog.bodies.made_kernels import (
    RATE,
    STEP_S,
    TIMES_S,
    attitude_segment,
    daf,
    orbit_segment,
    write_kernels,
)

pytest.importorskip("spiceypy", reason="needs spiceypy")

TYPES = [(1, 1), (2, 1), (3, 1), *((5, n) for n in range(4)), *((6, n) for n in range(4))]
CASES = [(type_, subtype, order) for type_, subtype in TYPES for order in "<>"]


def spin(time_s: float) -> np.ndarray:
    """Rotation taking inertial vectors to the craft's axes."""
    angle = RATE * time_s
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(("type_", "subtype", "order"), CASES)
def test_attitudes_of_each_type_and_byte_order_are_read(
    type_: int, subtype: int, order: str, tmp_path: Path
) -> None:
    """Between the epochs too, but for type 1, which has attitudes at its epochs alone."""
    data = daf([attitude_segment(type_, subtype)], order=order)
    kernels = KernelSet(write_kernels(tmp_path, data))
    time_s = 20.0 * STEP_S if type_ == 1 else 20.3 * STEP_S
    np.testing.assert_allclose(kernels.rotation("MADE_BUS", time_s), spin(time_s), atol=1e-7)
    turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) @ spin(time_s)
    # the frame kernel's matrix takes vectors of the camera to the craft's axes, by columns
    np.testing.assert_allclose(kernels.rotation("MADE_CAMERA", time_s), turned, atol=1e-7)


@pytest.mark.parametrize("order", "<>")
def test_the_form_of_former_days_is_read(order: str, tmp_path: Path) -> None:
    """NAIF/DAF does not say what it holds; orbits and attitudes are told apart."""
    attitude = daf([attitude_segment(3)], b"NAIF/DAF", order)
    orbit = daf([orbit_segment()], b"NAIF/DAF", order)
    kernels = KernelSet(write_kernels(tmp_path, attitude, orbit))
    np.testing.assert_allclose(kernels.rotation("MADE_BUS", 101.0), spin(101.0), atol=1e-9)
    position = kernels.position_m(-999, 301, 101.0, apparent=False)
    np.testing.assert_allclose(position, [3e6, 101e3, 0.0], rtol=1e-12)


def test_a_gap_inside_a_kernel_is_named(tmp_path: Path) -> None:
    early, late = TIMES_S[:20], TIMES_S[40:]
    attitude = daf([attitude_segment(3, times_s=early), attitude_segment(3, times_s=late)])
    orbit = daf([orbit_segment(early), orbit_segment(late)], b"DAF/SPK ")
    base = daf([(*orbit_segment()[:2], (301, 0, 1, 13), orbit_segment()[3])], b"DAF/SPK ")
    paths = write_kernels(tmp_path, attitude, orbit)
    (tmp_path / "base.bsp").write_bytes(base)
    kernels = KernelSet([*paths, tmp_path / "base.bsp"])
    cover = (
        "they cover 2000-01-01T11:58:56Z to 2000-01-01T12:02:06Z and "
        "2000-01-01T12:05:36Z to 2000-01-01T12:08:46Z; "
        "the gap from 2000-01-01T12:02:06Z to 2000-01-01T12:05:36Z holds the time asked"
    )
    with pytest.raises(DataError, match=f"attitudes of MADE_BUS: {cover}"):
        kernels.rotation("MADE_CAMERA", 300.0)
    with pytest.raises(DataError, match=cover):
        kernels.position_m(-999, 301, 300.0, apparent=False)
    kernels.rotation("MADE_CAMERA", 450.0)


def test_kernels_that_do_not_overlap_are_told(tmp_path: Path) -> None:
    orbit = daf([orbit_segment(TIMES_S[:20])], b"DAF/SPK ")
    later = orbit_segment(TIMES_S[40:])
    base = daf([(later[0], later[1], (301, 0, 1, 13), later[3])], b"DAF/SPK ")
    (tmp_path / "base.bsp").write_bytes(base)
    paths = write_kernels(tmp_path, daf([attitude_segment(3)]), orbit)
    kernels = KernelSet([*paths, tmp_path / "base.bsp"])
    words = r"no time in common; body -999: they cover \S+ to \S+12:02:06Z, body 301: they cover"
    with pytest.raises(DataError, match=words):
        kernels.position_m(-999, 301, 600.0, apparent=False)


def test_many_gaps_are_counted_and_the_spans_beside_the_time_shown(tmp_path: Path) -> None:
    spans = [TIMES_S[n : n + 5] for n in range(0, 60, 10)]
    paths = write_kernels(tmp_path, daf([attitude_segment(3, times_s=span) for span in spans]))
    words = (
        "they cover 2000-01-01T12:00:36Z to 2000-01-01T12:01:16Z and 2000-01-01T12:02:16Z to "
        "2000-01-01T12:02:56Z of 6 spans from 2000-01-01T11:58:56Z to 2000-01-01T12:07:56Z; the gap"
    )
    with pytest.raises(DataError, match=words):
        KernelSet(paths).rotation("MADE_BUS", 160.0)


@pytest.mark.parametrize(
    ("lacking", "words"),
    [
        ("made.tf", r"none defines the frame MADE_CAMERA; add its frame kernel \(\.tf\)"),
        ("made.tsc", r"none has the clock of spacecraft -999; add its clock kernel \(SCLK"),
        ("made.bc", r"none has attitudes of MADE_BUS \(number -999000\); add its C-kernel"),
        ("made.tls", r"none has leap seconds; add their kernel \(LSK"),
    ],
)
def test_the_kernel_that_is_lacking_is_named(lacking: str, words: str, tmp_path: Path) -> None:
    paths = write_kernels(tmp_path, daf([attitude_segment(3)]))
    if lacking == "made.tls":  # needed where the clock counts dynamical time on Earth
        clock = (tmp_path / "made.tsc").read_text()
        clock = clock.replace("SYSTEM_999 = ( 1 )", "SYSTEM_999 = ( 2 )")
        (tmp_path / "made.tsc").write_text(clock)
    with pytest.raises(DataError, match=words):
        KernelSet([path for path in paths if path.name != lacking]).rotation("MADE_CAMERA", 100.0)


def test_a_missing_link_between_two_bodies_is_told(tmp_path: Path) -> None:
    paths = write_kernels(tmp_path, daf([attitude_segment(3)]))
    segment = orbit_segment()
    base = daf([(*segment[:2], (10, 0, 1, 13), segment[3])], b"DAF/SPK ")
    (tmp_path / "base.bsp").write_bytes(base)
    with pytest.raises(DataError, match="no chain of centres joins them; add the orbit kernel"):
        KernelSet([*paths, tmp_path / "base.bsp"]).position_m(-999, 10, 100.0, apparent=False)


@pytest.mark.parametrize("name", [n for n, k in KEYWORDS.items() if k.fate == "refused"])
def test_kinds_that_are_not_read_are_refused_by_name(name: str, tmp_path: Path) -> None:
    kind, _, type_ = name.partition(" type ")
    if type_:
        segment = attitude_segment(3) if kind == "CK" else orbit_segment()
        at = 2 if kind == "CK" else 3
        words = (*segment[2][:at], int(type_), *segment[2][at + 1 :])
        data = daf([(*segment[:2], words, segment[3])], f"DAF/{kind}".ljust(8).encode())
    elif name.startswith("VAX"):
        data = daf([attitude_segment(3)])
        data = data[:88] + name.encode() + data[96:]
    else:
        data = daf([attitude_segment(3)], name.ljust(8).encode())
    (tmp_path / "a.bin").write_bytes(data)
    with pytest.raises(DataError, match=rf"a\.bin: .*{name}.*; .*{KEYWORDS[name].why[:20]}"):
        KernelSet([tmp_path / "a.bin"])


@pytest.mark.parametrize("value", [float("nan"), -1.0, 0.0, 1.5, 25.0, 1e9, 1e300])
@pytest.mark.parametrize("word", range(1, 7))
@pytest.mark.parametrize(("type_", "subtype"), [(1, 1), (3, 1), (5, 1), (6, 1)])
def test_a_damaged_count_of_attitudes_is_refused_before_the_toolkit_sees_it(
    type_: int, subtype: int, word: int, value: float, tmp_path: Path
) -> None:
    """A word that counts nothing (a rate, a start of an interval) gives a rotation or an error."""
    begin, end, words, values = attitude_segment(type_, subtype)
    changed = list(values)
    changed[-word] = value
    paths = write_kernels(tmp_path, daf([(begin, end, words, changed)]))
    counts = {1: (1,), 3: (1, 2), 5: (1, 2, 3, 4), 6: (1, 3, 4)}[type_]
    if word in counts and value != values[-word]:
        with pytest.raises(DataError, match=r"is damaged .* is impossible"):
            KernelSet(paths)
        return
    try:
        matrix = KernelSet(paths).rotation("MADE_BUS", 100.0)
    except DataError:
        return
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-6)


def test_a_length_that_no_type_2_has_is_refused(tmp_path: Path) -> None:
    begin, end, words, values = attitude_segment(2)
    paths = write_kernels(tmp_path, daf([(begin, end, words, list(values)[:-3])]))
    with pytest.raises(DataError, match="number of records"):
        KernelSet(paths)


def test_attitudes_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    data = daf([attitude_segment(3)])
    at = data.index(struct.pack("<d", RATE))
    nans = struct.pack("<d", float("nan")) * 50
    paths = write_kernels(tmp_path, data[:at] + nans + data[at + 400 :])
    with pytest.raises(DataError, match=r"impossible numbers|nothing about"):
        KernelSet(paths).rotation("MADE_BUS", 5.0)


def test_orbits_of_packets_are_read(tmp_path: Path) -> None:
    """SPK type 18, as ESA's orbits are, by the toolkit's own writer; type 19 is of such pieces."""
    import spiceypy

    path = tmp_path / "packets.bsp"
    handle = spiceypy.spkopn(str(path), "made", 0)
    states = np.column_stack([TIMES_S, TIMES_S * 0 + 2000.0, TIMES_S * 0] + [TIMES_S * 0 + 1.0]
                             + [TIMES_S * 0] * 2)  # fmt: skip
    spiceypy.spkw18(handle, 1, -999, 301, "J2000", 0.0, 590.0, "made", 7, states, TIMES_S)
    spiceypy.spkcls(handle)
    position = KernelSet([path]).position_m(-999, 301, 123.4, apparent=False)
    np.testing.assert_allclose(position, [123.4e3, 2e6, 0.0], rtol=1e-9, atol=1e-3)
    data = bytearray(path.read_bytes())
    at = data.rindex(struct.pack("<d", 60.0))
    data[at : at + 8] = struct.pack("<d", 61.0)
    path.write_bytes(data)
    with pytest.raises(DataError, match="is damaged"):
        KernelSet([path])
