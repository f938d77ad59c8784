"""What all tests share."""

import gc
import os
import signal
from collections.abc import Callable, Generator
from pathlib import Path

import pytest

from catalog.jobs.workers import count_cores

CHECKOUT = Path(__file__).resolve().parents[1]
KERNELS = (
    "pck00011.tpc",
    "moon_080317.tf",
    "moon_assoc_me.tf",
    "moon_pa_de421_1900-2050.bpc",
    "de405s_littleendian.bsp",
)

# A shell's background job ignores ctrl-c, and so would the commands that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


# Thousands of tests and compiled kernels live to the end, and to look through them for garbage each
# time that 700 things are new takes half of the collection and a fifth of compilation.
gc.set_threshold(100_000, 50, 50)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Run one process more than cores, as many tests wait for commands that they start."""
    return count_cores() + 1


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let each process begin with other files of a folder: all keep byte code for the others."""
    report = yield
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0")
    if isinstance(collector, pytest.Directory) and worker != "gw0":
        count = int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
        start = int(worker.removeprefix("gw")) * len(report.result) // count
        report.result = [*report.result[start:], *report.result[:start]]
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the commands run as a whole last: by then most kernels have been compiled.

    The installed wheel has kernels of its own; last, it would keep one process busy alone.
    """

    def key(item: pytest.Item) -> tuple[bool, tuple[str, ...]]:
        whole = "end_to_end" in item.path.parts and item.path.name != "test_wheel.py"
        return whole, item.path.parts

    items.sort(key=key)


def pytest_collection_finish() -> None:
    """Leave what has been collected out of every search for garbage."""
    gc.freeze()


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


@pytest.fixture
def kernels(shared_data: Callable[[str], Path]) -> list[Path]:
    """SPICE kernels of the Moon's frame 1900-2050 and of planets 1997-2009."""
    pytest.importorskip("spiceypy", reason="needs spiceypy")
    return [shared_data(f"spice/{name}") for name in KERNELS]
