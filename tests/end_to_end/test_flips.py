"""Single flipped bits in a catalog that was built from real terrain, as a user builds it."""

from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from catalog.errors import DataError
from catalog.store.verify import verify
from optnav_cli.main import run

FLIPS = 1000
CONFIG = '[body]\nname = "moon"\n[[dem]]\npath = "bundled:tycho_gld100_256ppd.tif"\n'


def _put(file: BinaryIO, place: int, byte: int) -> None:
    file.seek(place)
    file.write(bytes([byte]))
    file.flush()


@pytest.mark.slow
def test_each_of_1000_flipped_bits_of_a_real_catalog_is_reported(tmp_path: Path) -> None:
    """Anywhere in the file; a fifth of the flips aim at the first 600 bytes of a page, where SQLite
    keeps its own structure."""
    (tmp_path / "tycho.toml").write_text(CONFIG)
    path = tmp_path / "tycho.gpkg"
    assert run(["-q", "build", str(tmp_path / "tycho.toml"), "-o", str(path)]) == 0
    size = path.stat().st_size
    assert size > 3_000_000
    rng = np.random.default_rng(33)
    outcomes = {"reported": 0, "refused": 0}
    with path.open("r+b") as file:
        for number in range(FLIPS):
            place = int(rng.integers(size))
            if number % 5 == 0:
                place = place // 65536 * 65536 + int(rng.integers(600))
            file.seek(place)
            old = file.read(1)[0]
            flipped = old ^ (1 << int(rng.integers(8)))
            _put(file, place, flipped)
            try:
                sound = verify(path).sound
                outcomes["reported"] += 1
            except DataError:
                sound = False
                outcomes["refused"] += 1
            assert not sound, f"byte {place}: {old} -> {flipped}"
            _put(file, place, old)
    assert verify(path).sound
    assert min(outcomes.values()) > 0, outcomes
