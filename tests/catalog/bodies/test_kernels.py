"""SPICE kernels that are missing, cut short or none."""

import math
import os
import struct
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from catalog.bodies.kernels import KernelSet
from catalog.errors import DataError


def test_what_an_instrument_kernel_states_of_a_camera_is_kept(
    kernels: list[Path], tmp_path: Path
) -> None:
    text = "KPL/IK\nINS-1_FOCAL_LENGTH = 7 in a comment\n\\begindata\n"
    text += "INS-82360_FOCAL_LENGTH  = ( 2003.44 )\nINS-82360_BORESIGHT = (\n 0.0\n 0.0 1.0 )\n"
    text += "INS-82360_FOV_SHAPE = 'RECTANGLE'\n\\begintext\nINS-2_PIXEL_SIZE = 3\n"
    (tmp_path / "nac.ti").write_text(text)
    found = KernelSet([*kernels[:3], tmp_path / "nac.ti"]).cameras
    wanted = "INS-82360_FOCAL_LENGTH = ( 2003.44 ), INS-82360_BORESIGHT = ( 0.0 0.0 1.0 )"
    assert found == (f"nac.ti: {wanted}",)
    assert KernelSet(kernels[:3]).cameras == ()


@pytest.mark.parametrize("share", [0.0, 0.0002, 0.5, 0.999])
@pytest.mark.parametrize("index", [3, 4])
def test_a_binary_kernel_cut_short_is_refused(
    share: float, index: int, kernels: list[Path], tmp_path: Path
) -> None:
    cut = tmp_path / "cut.bsp"
    content = kernels[index].read_bytes()
    cut.write_bytes(content[: int(share * len(content))])
    with pytest.raises(DataError, match=r"cut\.bsp: .*(cut short|is no SPICE kernel)"):
        KernelSet([*kernels[:3], cut])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"# A text\nwithout data\n", "is no SPICE kernel"),
        (b"\x89PNG\r\n" + bytes(range(256)) * 8, "is no SPICE kernel"),
        (b"KPL/FK\n\\begindata\nFRAME_X = ( 1, 2,\n", "the SPICE kernel is cut short"),
        (b"KPL/FK\n\\begindata\nFRAME_X\n\\begintext\n", "SPICE cannot load this kernel"),
    ],
)
def test_what_is_no_kernel_is_refused_and_leaves_nothing_behind(
    content: bytes, message: str, kernels: list[Path], tmp_path: Path
) -> None:
    wrong = tmp_path / "wrong.tf"
    wrong.write_bytes(content)
    with pytest.raises(DataError, match=rf"wrong\.tf: {message}"):
        KernelSet([*kernels, wrong])
    assert KernelSet(kernels).has_orbit(301)


def test_a_missing_kernel_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.bsp: there is no such SPICE kernel"):
        KernelSet([tmp_path / "none.bsp"])
    for place, words in ((tmp_path, "is a folder"), (Path("/dev/zero"), "is a pipe or a device")):
        with pytest.raises(DataError, match=words):
            KernelSet([place])
    with pytest.raises(DataError, match="is not a name"):
        KernelSet([tmp_path / "a\0b"])


def test_without_the_toolkit_the_message_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    kernel = tmp_path / "a.tf"
    kernel.write_text("KPL/FK\n\\begindata\n")
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    with pytest.raises(DataError, match=r"pip install 'optnav\[spice\]'"):
        KernelSet([kernel])


def end_of_first_segment(data: bytes) -> int:
    """Byte behind the last double of the first segment of a little-endian DAF."""
    integers, first = struct.unpack_from("<i", data, 12)[0], struct.unpack_from("<i", data, 76)[0]
    summary = (first - 1) * 1024 + 24
    return 8 * int(struct.unpack_from("<i", data, summary + 16 + 4 * (integers - 1))[0])


@pytest.mark.parametrize("value", [math.nan, 0.0, -1.0, 1.5, 131.0, 1e9, 1e308])
@pytest.mark.parametrize("word", [1, 2])
@pytest.mark.parametrize("index", [3, 4])
def test_a_damaged_count_of_a_segment_is_refused_before_the_toolkit_sees_it(
    index: int, word: int, value: float, kernels: list[Path], tmp_path: Path
) -> None:
    """The toolkit would overrun its buffers and end the process."""
    data = bytearray(kernels[index].read_bytes())
    struct.pack_into("<d", data, end_of_first_segment(data) - 8 * word, value)
    wrong = tmp_path / f"wrong{kernels[index].suffix}"
    wrong.write_bytes(data)
    with pytest.raises(DataError, match=r"is damaged .* is impossible"):
        KernelSet([*kernels[:3], wrong])


@pytest.mark.parametrize("place", [8, 12, 76, 84])
@pytest.mark.parametrize("value", [-1, 0, 1, 2**31 - 1])
def test_a_damaged_file_record_is_refused_or_read(
    place: int, value: int, kernels: list[Path], tmp_path: Path
) -> None:
    data = bytearray(kernels[3].read_bytes())
    struct.pack_into("<i", data, place, value)
    wrong = tmp_path / f"wrong{kernels[3].suffix}"
    wrong.write_bytes(data)
    with suppress(DataError):  # no summaries: no orbits
        assert KernelSet([*kernels[:3], wrong]).orbits == {}


def test_a_text_kernel_loads_no_others(kernels: list[Path], tmp_path: Path) -> None:
    meta = tmp_path / "meta.tm"
    meta.write_text(f"KPL/MK\n\\begindata\nKERNELS_TO_LOAD = ( '{kernels[0]}' )\n\\begintext\n")
    with pytest.raises(DataError, match="names other kernels"):
        KernelSet([meta])
    # in its comments it may speak of them
    meta.write_text("KPL/FK\nKERNELS_TO_LOAD = ( 'a' )\n\\begindata\nA = 1\n\\begintext\n")
    assert KernelSet([meta]).orbits == {}
    meta.unlink()
    os.mkfifo(meta)
    with pytest.raises(DataError, match="pipe or a device"):
        KernelSet([meta])


def test_numbers_that_no_rotation_has_are_told(kernels: list[Path], tmp_path: Path) -> None:
    wrong = next(path for path in kernels if path.suffix == ".bpc")
    data = bytearray(wrong.read_bytes())
    end = end_of_first_segment(data)
    data[end - 80_000 : end - 32] = struct.pack("<d", math.nan) * ((80_000 - 32) // 8)
    damaged = tmp_path / "damaged.bpc"
    damaged.write_bytes(data)
    found = KernelSet([damaged if path == wrong else path for path in kernels])
    last = max(span[1] for span in found.turns.values())
    with pytest.raises(DataError, match=r"impossible numbers|nothing about"):
        found.rotation("MOON_ME", last - 86400.0)
