"""Typed decorators for compiled kernels.

Kernels are cached on disk, so that only the first run on a machine compiles. Where neither the
package's folder nor the home can be written, as in many containers, a temporary folder serves, or
there is no cache. Floating-point reordering stays off: results must not depend on how a loop
happened to be vectorised.
"""

import fcntl
import hashlib
import logging
import multiprocessing
import os
import pickle
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

CACHE_DIR = "NUMBA_CACHE_DIR"
PACKAGES = "catalog", "optnav_cli"
MAX_WAIT_S, LOOK_S = 60.0, 0.02  # for a kernel that another process compiles

_log = logging.getLogger(__name__)
_warned: set[str] = set()


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a single-threaded kernel; it releases the interpreter's lock."""
    return _compile(function, _nrt=True)


def inplace_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel that makes no array and returns none: it works on those of its caller.

    It counts no references. Numba counts them for every array that is handed on or sliced, by
    atomic instructions that take longer than the work on a row of a small grid. What owns no array
    has none to free. Numba refuses to compile one that makes an array.
    Raises TypeError for one that is annotated to return an array.
    """
    if "ndarray" in str(function.__annotations__.get("return")):
        raise TypeError(f"{function.__qualname__} returns an array: its references are counted")
    return _compile(function, _nrt=False)


def parallel_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel whose `numba.prange` loops run on all threads that the process allows."""
    return _compile(function, _nrt=True, parallel=True)


def _compile(function: Callable[P, R], **options: bool) -> Callable[P, R]:
    njit: Any = numba.njit  # its types differ from version to version
    compiled = njit(nogil=True, error_model="numpy", **options)(function)
    if not _is_cached(compiled):
        _use_temporary_cache()
        _is_cached(compiled)
    return cast(Callable[P, R], compiled)


def _is_cached(compiled: Any) -> bool:
    try:
        compiled.enable_caching()
    except RuntimeError:  # numba finds no folder that it may write to
        return False
    # numba's own guard against the faults of a folder is for Windows alone
    compiled._cache._guard_against_spurious_io_errors = _handle_cache_faults
    # and its key knows the kernel's own file alone, not those of the kernels that it calls
    own_key = compiled._cache._index_key
    compiled._cache._index_key = lambda *of: (*own_key(*of), _hash_called_code(compiled.py_func))
    _skip_moved_types(compiled._cache._cache_file)
    _compile_in_turn(compiled._cache, compiled.py_func.__qualname__)
    return True


def _skip_moved_types(file: Any) -> None:
    """Take a cache of a former version that names types of modules gone since for an empty one."""
    load_index = file._load_index

    def load_or_forget() -> Any:
        try:
            return load_index()
        except (ImportError, AttributeError):
            return {}

    file._load_index = load_or_forget


def _compile_in_turn(cache: Any, name: str) -> None:
    """Let one of the processes that need a kernel compile it, while the others wait to load it.

    Kernels call each other in no circle, so that processes do not wait for each other in one.
    """
    load, save = cache.load_overload, cache.save_overload
    slot = int.from_bytes(hashlib.sha256(name.encode()).digest()[:6])

    def load_or_wait(*of: Any) -> Any:
        overload = load(*of)
        if overload is None:
            _take_turn(cache.cache_path, slot)
            overload = load(*of)  # which another process may have saved meanwhile
            if overload is not None:
                _end_turn(cache.cache_path, slot)
        return overload

    def save_for_all(*of: Any) -> None:
        save(*of)
        _end_turn(cache.cache_path, slot)

    cache.load_overload, cache.save_overload = load_or_wait, save_for_all


def _take_turn(folder: str, place: int) -> None:
    """Lock a place in a folder's lock file.

    A process that dies lets go of its locks; one that takes longer than any kernel is not waited
    for, and no folder or file system without locks stands in the way.
    """
    ends = time.monotonic() + MAX_WAIT_S
    while time.monotonic() < ends:
        try:
            fcntl.lockf(_lock_file(folder), fcntl.LOCK_EX | fcntl.LOCK_NB, 1, place)
            return
        except (BlockingIOError, PermissionError):
            time.sleep(LOOK_S)
        except OSError:
            return


def _end_turn(folder: str, place: int) -> None:
    with suppress(OSError):
        fcntl.lockf(_lock_file(folder), fcntl.LOCK_UN, 1, place)


@cache
def _lock_file(folder: str) -> int:
    """Open for as long as the process lives: closing it would let go of all locks."""
    return os.open(Path(folder) / "kernels.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)


@cache
def _hash_called_code(function: FunctionType) -> str:
    """Hash of all code and constants of ours that a kernel is compiled from."""
    digest, waiting, seen = hashlib.sha256(), [function], {function}
    while waiting:
        current = waiting.pop()
        code = current.__code__
        constants = [value for value in code.co_consts if not isinstance(value, CodeType)]
        digest.update(f"{current.__qualname__} {constants}".encode())
        digest.update(code.co_code)
        for name, value in _iterate_globals(current):
            called = getattr(value, "py_func", None)
            if isinstance(called, FunctionType):
                if called not in seen:
                    seen.add(called)
                    waiting.append(called)
            elif isinstance(value, np.ndarray):
                digest.update(value.tobytes())
            elif isinstance(value, int | float | str | tuple | np.generic):
                digest.update(f"{name} {value!r}".encode())
            elif isinstance(value, type):
                digest.update(f"{name} {getattr(value, '_fields', '')}".encode())
    return digest.hexdigest()


def _iterate_globals(function: FunctionType) -> Iterator[tuple[str, object]]:
    """The global names of a function and, of modules of ours among them, what it takes of them."""
    names = function.__code__.co_names
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType) and value.__name__.partition(".")[0] in PACKAGES:
            yield from ((part, getattr(value, part)) for part in names if hasattr(value, part))
        else:
            yield name, value


@contextmanager
def _handle_cache_faults() -> Iterator[None]:
    """Compile anew what the cache cannot give, and keep what it does not take in memory alone."""
    try:
        yield
    except (OSError, EOFError, pickle.UnpicklingError) as error:
        _warn("the cache of compiled kernels fails (%s); going on without it", error)


@cache
def _use_temporary_cache() -> None:
    """Let numba cache in a temporary folder from here on, in worker processes, too."""
    folder = _make_temporary_folder()
    if folder is None:
        kept = "they are compiled anew in each process"
    else:
        kept = f"they are kept in {folder}"
        os.environ[CACHE_DIR] = str(folder)
        config: Any = numba.config  # which knows its settings at run time only
        config.CACHE_DIR = str(folder)
    _warn(f"no folder to cache compiled kernels can be written: %s; {CACHE_DIR} names one", kept)


def _warn(message: str, detail: object) -> None:
    """Warn once; workers need not say it again."""
    if message not in _warned and multiprocessing.parent_process() is None:
        _log.warning(message, detail)
    _warned.add(message)


def _make_temporary_folder() -> Path | None:
    """A folder of this user alone: code is loaded from it, which nobody else may put there."""
    try:
        folder = Path(tempfile.gettempdir()) / f"optnav-numba-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.lstat()
    except OSError:
        return None
    private = stat.S_ISDIR(state.st_mode) and not state.st_mode & 0o077
    return folder if private and state.st_uid == os.getuid() else None
