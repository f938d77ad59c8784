"""The list of kernels that are compiled before the tests."""

import pytest

from tests.kernels import LIST, compile_line, find_kernels, read_types, write_types


def test_every_line_names_a_kernel_and_its_types() -> None:
    known = {name for name, _ in find_kernels()}
    lines = LIST.read_text().splitlines()
    assert len(lines) > 100
    for line in lines:
        name, _, written = line.partition(" ")
        assert name in known, f"{name}: `python -m tests.kernels --list` writes {LIST.name} again"
        assert write_types(read_types(written)) == written


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("catalog.geometry.kernel.absent (float64,)", "no attribute 'absent'"),
        ("catalog.absent.kernel (float64,)", "No module named 'catalog.absent'"),
        ("catalog.geometry.grid.sample_rows (Matrix(2),)", "name 'Matrix' is not defined"),
    ],
)
def test_a_line_that_fits_no_kernel_is_reported(line: str, reason: str) -> None:
    message = compile_line(line)
    assert reason in message
    assert "--list" in message
