"""SPICE kernels that are missing, cut short or none."""

import sys
from pathlib import Path

import pytest

from catalog.bodies.kernels import KernelSet
from catalog.errors import DataError


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
    with pytest.raises(DataError, match="cannot be read"):
        KernelSet([tmp_path])


def test_without_the_toolkit_the_message_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    kernel = tmp_path / "a.tf"
    kernel.write_text("KPL/FK\n\\begindata\n")
    monkeypatch.setitem(sys.modules, "spiceypy", None)
    with pytest.raises(DataError, match=r"pip install 'optnav\[spice\]'"):
        KernelSet([kernel])
