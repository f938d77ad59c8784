"""Where compiled kernels are kept: also where no usual folder can be written, as in containers."""

import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import NumbaError

from catalog.arrays import FloatArray
from catalog.geometry.kernel import inplace_kernel

CHECKOUT = Path(__file__).resolve().parents[3]
KERNEL = "from catalog.geometry.kernel import kernel\n@kernel\ndef twice(x):\n    return 2.0 * x\n"
WARNING = "no folder to cache compiled kernels can be written"
Run = Callable[..., str]


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Runs a script that uses a kernel, where numba may not write; gives stderr.

    Permissions do not bind root: the cache folder is named below a file, and numba told to try no
    other.
    """
    (tmp_path / "file").touch()
    (tmp_path / "temporary").mkdir()
    (tmp_path / "some_kernel.py").write_text(KERNEL)

    def called(script: str, **env: str) -> str:
        (tmp_path / "script.py").write_text(script)
        given = {
            "PYTHONPATH": f"{CHECKOUT}{os.pathsep}{tmp_path}",
            "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator",
            "NUMBA_CACHE_DIR": str(tmp_path / "file" / "cache"),
            "TMPDIR": str(tmp_path / "temporary"),
        } | env
        done = subprocess.run(
            [sys.executable, "script.py"],
            cwd=tmp_path, capture_output=True, text=True, env=os.environ | given,
        )  # fmt: skip
        assert (done.returncode, done.stdout) == (0, "4.0\n"), done.stderr
        return done.stderr

    return called


ONE = "from some_kernel import twice\nprint(twice(2.0))\n"


def test_kernels_are_kept_in_a_temporary_folder_where_no_other_can_be_written(
    run: Run, tmp_path: Path
) -> None:
    for _ in range(2):
        (line,) = run(ONE).splitlines()
        place = tmp_path / "temporary" / f"optnav-numba-{os.getuid()}"
        assert line == f"{WARNING}: they are kept in {place}; NUMBA_CACHE_DIR names one"
    assert place.stat().st_mode & 0o777 == 0o700
    assert len([*place.rglob("*.nbc")]) == 1  # made once, and found again


def test_a_temporary_folder_that_others_may_write_is_not_trusted(run: Run, tmp_path: Path) -> None:
    place = tmp_path / "temporary" / f"optnav-numba-{os.getuid()}"
    place.mkdir()
    place.chmod(0o777)
    (line,) = run(ONE).splitlines()
    assert f"{WARNING}: they are compiled anew in each process" in line
    assert not [*place.iterdir()]


def test_no_folder_at_all_is_a_warning(run: Run, tmp_path: Path) -> None:
    script = f"import tempfile\ntempfile.tempdir = {str(tmp_path / 'file')!r}\n{ONE}"
    (line,) = run(script).splitlines()
    assert f"{WARNING}: they are compiled anew in each process" in line


def test_workers_follow_and_do_not_warn_again(run: Run) -> None:
    script = """
import some_kernel
from catalog.jobs.workers import make_workers

def work(context, x):
    import os
    return some_kernel.twice(x), os.environ["NUMBA_CACHE_DIR"]

if __name__ == "__main__":
    workers = make_workers(2)
    results = dict(workers.run(work, None, [1.0, 2.0]))
    workers.close()
    assert all("optnav-numba" in folder for _, folder in results.values())
    print(results[1][0])
"""
    (line,) = run(script).splitlines()
    assert WARNING in line


@pytest.mark.parametrize("fault", ["damaged", "unwritable"])
def test_a_cache_that_fails_later_costs_time_alone(fault: str, run: Run, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    run(ONE, NUMBA_CACHE_DIR=str(cache))
    script = ONE
    if fault == "damaged":  # as after a loss of power
        for kept in cache.rglob("*.nb?"):
            os.truncate(kept, 0)
    else:
        shutil.rmtree(cache)
        script = (
            "import shutil\nfrom some_kernel import twice\n"
            f"shutil.rmtree({str(cache)!r})\nopen({str(cache)!r}, 'w').close()\nprint(twice(2.0))\n"
        )
    (line,) = run(script, NUMBA_CACHE_DIR=str(cache)).splitlines()
    assert "the cache of compiled kernels fails (" in line
    assert line.endswith("); going on without it")


def test_a_read_only_package_and_home_are_a_warning(tmp_path: Path) -> None:
    """As in a container: the checkout and the home mounted so that nobody may write to them."""
    unshare = shutil.which("unshare")
    if unshare is None or sys.platform != "linux":
        pytest.skip("needs Linux with unshare to mount a folder read-only")
    alone = [unshare, "--mount"] if os.geteuid() == 0 else [unshare, "-r", "--mount"]
    place = shlex.quote(str(CHECKOUT))
    mount = f"mount --bind {place} {place} && mount -o remount,ro,bind {place}"
    if subprocess.run([*alone, "bash", "-c", mount], capture_output=True).returncode != 0:
        pytest.skip("may not mount a folder here")
    use = "import catalog.rendering.map_view"
    done = subprocess.run(
        [*alone, "bash", "-c", f"{mount}; {shlex.quote(sys.executable)} -c '{use}'"],
        capture_output=True, text=True,
        env=os.environ | {
            "PYTHONPATH": str(CHECKOUT), "HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/none",
            "NUMBA_CACHE_DIR": "", "TMPDIR": str(tmp_path),
        },
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert f"{WARNING}: they are kept in {tmp_path}" in line


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(tmp_path: Path) -> None:
    """In a number that it knows, and in what it does."""
    called = (
        "from catalog.geometry.kernel import kernel\nFACTOR = 3.0\n"
        "@kernel\ndef inner(x):\n    return FACTOR * x\n"
    )
    (tmp_path / "outer.py").write_text(
        "from catalog.geometry.kernel import kernel\nfrom called import inner\n"
        "@kernel\ndef outer(x):\n    return inner(x)\n"
        "print(outer(4.0), sum(outer.stats.cache_hits.values()))\n"
    )
    env = os.environ | {"PYTHONPATH": f"{CHECKOUT}{os.pathsep}{tmp_path}"}
    env |= {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    number = called.replace("FACTOR = 3.0", "FACTOR = 5.0")
    formula = called.replace("FACTOR * x", "FACTOR * x + 1.0")
    printed = []
    for text in (called, called, number, formula):
        (tmp_path / "called.py").write_text(text)
        done = subprocess.run(
            [sys.executable, "-c", "import outer"],
            cwd=tmp_path, capture_output=True, text=True, env=env, check=True,
        )  # fmt: skip
        printed.append(done.stdout.split())
    values = [value for value, _ in printed]
    assert values == ["12.0", "12.0", "20.0", "13.0"]
    assert [hits for _, hits in printed] == ["0", "1", "0", "0"]


def test_a_kernel_of_a_type_whose_module_was_renamed_is_compiled_anew(tmp_path: Path) -> None:
    pair = "from typing import NamedTuple\nclass Pair(NamedTuple):\n    a: float\n    b: float\n"
    env = os.environ | {"PYTHONPATH": f"{CHECKOUT}{os.pathsep}{tmp_path}"}
    env |= {"NUMBA_CACHE_DIR": str(tmp_path / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    printed = []
    for name in ("former", "later", "later"):
        (tmp_path / f"{name}.py").write_text(pair)
        (tmp_path / "outer.py").write_text(
            f"from {name} import Pair\nfrom catalog.geometry.kernel import kernel\n"
            "@kernel\ndef outer(pair):\n    return pair.a + pair.b\n"
            "print(outer(Pair(1.0, 2.0)), sum(outer.stats.cache_hits.values()))\n"
        )
        done = subprocess.run(
            [sys.executable, "-c", "import outer"],
            cwd=tmp_path, capture_output=True, text=True, env=env, check=True,
        )  # fmt: skip
        printed.append(done.stdout.split() + done.stderr.splitlines())
        (tmp_path / "former.py").unlink(missing_ok=True)
    assert printed == [["3.0", "0"], ["3.0", "0"], ["3.0", "1"]]


def test_a_kernel_that_another_process_compiles_is_waited_for(tmp_path: Path) -> None:
    """The first to come takes its time and says so; the second begins after that word."""
    (tmp_path / "some_kernel.py").write_text(KERNEL)
    slow = (
        "import time\nfrom some_kernel import twice\nmake = twice._compiler.compile\n"
        "def compile(*of):\n    print('compiling', flush=True)\n    time.sleep(2.0)\n"
        "    return make(*of)\ntwice._compiler.compile = compile\nprint(twice(2.0))\n"
    )
    counts = "sum(twice.stats.cache_hits.values()), sum(twice.stats.cache_misses.values())"
    hits = f"{ONE}print({counts})"
    env = os.environ | {
        "PYTHONPATH": f"{CHECKOUT}{os.pathsep}{tmp_path}",
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
    }
    with subprocess.Popen(
        [sys.executable, "-c", slow], stdout=subprocess.PIPE, text=True, env=env
    ) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "compiling\n"
        second = subprocess.run(
            [sys.executable, "-c", hits], capture_output=True, text=True, env=env, check=True
        )
        assert first.communicate()[0] == "4.0\n"
    assert second.stdout.split() == ["4.0", "1", "0"]


def test_a_bare_kernel_works_on_slices_and_leaves_their_references_as_they_were() -> None:
    grid = np.arange(12.0).reshape(3, 4)
    before = sys.getrefcount(grid)
    for _ in range(100):
        assert _sum_of_rows(grid) == 66.0
    assert sys.getrefcount(grid) == before


def test_a_bare_kernel_that_makes_or_returns_an_array_is_refused() -> None:
    def makes(size: int) -> float:
        return float(np.ones(size).sum())

    with pytest.raises(NumbaError):
        inplace_kernel(makes)(3)

    def gives(grid: FloatArray) -> FloatArray:
        return grid[1:]

    with pytest.raises(TypeError, match="gives returns an array"):
        inplace_kernel(gives)


@inplace_kernel
def _sum_of_rows(grid: FloatArray) -> float:
    total = 0.0
    for i in range(grid.shape[0]):
        line = grid[i]
        for value in line:
            total += value
    return total
