"""SPICE kernels of the big test data."""

from collections.abc import Callable
from pathlib import Path

import pytest

KERNELS = (
    "pck00011.tpc",
    "moon_080317.tf",
    "moon_assoc_me.tf",
    "moon_pa_de421_1900-2050.bpc",
    "de405s_littleendian.bsp",
)


@pytest.fixture
def kernels(shared_data: Callable[[str], Path]) -> list[Path]:
    """Kernels of the Moon's frame 1900-2050 and of planets 1997-2009."""
    pytest.importorskip("spiceypy", reason="needs spiceypy")
    return [shared_data(f"spice/{name}") for name in KERNELS]
