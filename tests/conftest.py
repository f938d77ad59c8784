"""What all tests share."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]

# A shell's background job ignores ctrl-c, and so would the commands that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """Path of a file of the big test data, which does not travel with the project.

    It is looked for in the folder that OPTNAV_SHARED_DATA names, or in ../shared/data.
    """

    def find(name: str) -> Path:
        folder = os.environ.get("OPTNAV_SHARED_DATA")
        path = (Path(folder) if folder else CHECKOUT.parent / "shared" / "data") / name
        if not path.exists():
            pytest.skip(f"needs the shared data file {name}; OPTNAV_SHARED_DATA names its folder")
        return path

    return find
