"""Clusters for the tests, with a module of functions that their workers can load."""

import os
import sys

import pytest

from tests.catalog.jobs.dask_cluster import cluster_of

WORK = """
import os, time
from pathlib import Path
from catalog.errors import DataError

def double(context, chunk):
    return [context["factor"] * value for value in chunk]

def process(context, chunk):
    time.sleep(0.05)
    return os.getpid()

def threads(context, chunk):
    import cv2, numba
    return cv2.getNumThreads(), numba.get_num_threads()

def alone(context, chunk):
    mark = Path(context["folder"]) / f"busy-{os.getpid()}"
    mark.touch(exist_ok=False)
    time.sleep(0.05)
    mark.unlink()

def refuse(context, chunk):
    raise DataError(f"chunk {chunk}: is bad")

def wait_for(context, chunk):
    folder = Path(context["folder"])
    (folder / f"begun-{chunk}-{os.getpid()}").touch()
    while chunk > 1 and not (folder / "go").exists():
        time.sleep(0.02)
    return chunk

def die(context, chunk):
    if chunk == 0:
        os.kill(os.getpid(), 9)
    return chunk
"""


@pytest.fixture(scope="module")
def modules(tmp_path_factory: pytest.TempPathFactory) -> str:
    """PYTHONPATH of workers, with a module of functions for them."""
    folder = tmp_path_factory.mktemp("modules")
    (folder / "work_for_cluster.py").write_text(WORK)
    return os.pathsep.join([str(folder), *sys.path])


@pytest.fixture(scope="module")
def work(modules):
    sys.path.insert(0, modules.split(os.pathsep)[0])
    import work_for_cluster

    yield work_for_cluster
    sys.path.remove(modules.split(os.pathsep)[0])
    del sys.modules["work_for_cluster"]


@pytest.fixture(scope="module")
def two(tmp_path_factory, modules):
    """A cluster of two workers that tests leave alive."""
    with cluster_of(tmp_path_factory.mktemp("two"), modules, 2) as found:
        yield found


@pytest.fixture
def own(tmp_path, modules):
    """A scheduler of the test's own, to which it adds workers."""
    with cluster_of(tmp_path, modules, 0) as found:
        yield found
