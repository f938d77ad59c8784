"""Compile the kernels that tests use before they run, on all cores: `python -m tests.kernels`.

The processes that run tests need the same kernels at the same time, and wait for the one of them
that compiles. What to compile stands in kernels.txt, a kernel and its types a line, the longest
first; `python -m tests.kernels --list` after a run of all tests writes it again. A kernel that is
not listed is compiled where it is first called; a line that fits no kernel is reported.
"""

import gc
import multiprocessing
import os
import pkgutil
import sys
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from numba import types
from numba.core.caching import NullCache
from numba.core.dispatcher import Dispatcher

import catalog
import optnav_cli

LIST = Path(__file__).with_suffix(".txt")
MIN_S = 0.1  # shorter ones are left to their first call
NAMES = ("Array", "Tuple", "boolean", "literal", *(str(each) for each in types.number_domain))


def main() -> None:
    """Compile what is listed, or list what has been compiled."""
    # the objects of compiled code live to the end: to search them for garbage takes a fifth
    gc.set_threshold(100_000, 50, 50)
    if sys.argv[1:] == ["--list"]:
        LIST.write_text("\n".join(list_lines()) + "\n")
        return
    with multiprocessing.get_context("fork").Pool(os.cpu_count()) as pool:
        for message in pool.imap_unordered(compile_line, LIST.read_text().splitlines()):
            if message:
                sys.stderr.write(f"{message}\n")


def compile_line(line: str) -> str:
    """Compile a kernel for the types of a line. Returns what is wrong with the line."""
    name, _, written = line.partition(" ")
    module, _, function = name.rpartition(".")
    try:
        getattr(import_module(module), function).compile(read_types(written))
    except (ImportError, AttributeError, TypeError, NameError) as error:
        return f"{LIST.name}: {name}: {error}; `python -m tests.kernels --list` writes it again"
    return ""


def write_types(signature: tuple[Any, ...]) -> str:
    """Write types of arguments as Python that `read_types` evaluates."""
    return f"({' '.join(f'{_write_type(each)},' for each in signature)})"


def read_types(written: str) -> tuple[Any, ...]:
    """Read types as `write_types` writes them."""
    space = {name: getattr(types, name) for name in NAMES} | {"named": _make_named_tuple}
    signature: tuple[Any, ...] = eval(written, {"__builtins__": {}}, space)
    return signature


def _write_type(kind: Any) -> str:
    if isinstance(kind, types.Array):
        return f"Array({_write_type(kind.dtype)}, {kind.ndim}, {kind.layout!r}, {not kind.mutable})"
    if isinstance(kind, types.NamedTuple | types.NamedUniTuple):
        owner = f"{kind.instance_class.__module__}.{kind.instance_class.__qualname__}"
        return f"named({owner!r}, {write_types(tuple(kind.types))})"
    if isinstance(kind, types.BaseTuple):
        return f"Tuple({write_types(tuple(kind.types))})"
    if isinstance(kind, types.IntegerLiteral):
        return f"literal({kind.literal_value})"
    return "boolean" if kind == types.boolean else str(kind)


def _make_named_tuple(name: str, parts: tuple[Any, ...]) -> Any:
    module, _, owner = name.rpartition(".")
    return types.BaseTuple.from_types(parts, getattr(import_module(module), owner))


def find_kernels() -> Iterator[tuple[str, Any]]:
    """Find all kernels of the packages, by their full names."""
    for package in (catalog, optnav_cli):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if info.name.endswith("__main__"):
                continue
            for name, value in vars(import_module(info.name)).items():
                if isinstance(value, Dispatcher) and value.py_func.__module__ == info.name:
                    yield f"{info.name}.{name}", value


def list_lines() -> Iterator[str]:
    """List what the checkout's caches hold and the compilation of no other kernel covers."""
    kernels = dict(find_kernels())
    signatures = [
        (name, key[0])
        for name, kernel in kernels.items()
        for key in kernel._cache._cache_file._load_index()
    ]
    for kernel in kernels.values():
        kernel._cache = NullCache()
    times: dict[str, float] = {}
    # a kernel that calls others compiles them, too, and so comes before them
    depth = {name: _count_called(kernel, {kernel}) for name, kernel in kernels.items()}
    for name, signature in sorted(signatures, key=lambda pair: (-depth[pair[0]], str(pair))):
        if signature not in kernels[name].overloads:
            began = time.process_time()
            kernels[name].compile(signature)
            times[f"{name} {write_types(signature)}"] = time.process_time() - began
    yield from (line for line in sorted(times, key=lambda k: -times[k]) if times[line] > MIN_S)


def _count_called(kernel: Any, seen: set[Any]) -> int:
    """Count the kernels that one calls, and these call; adds them to `seen`."""
    for name in kernel.py_func.__code__.co_names:
        value = kernel.py_func.__globals__.get(name)
        if isinstance(value, Dispatcher) and value not in seen:
            seen.add(value)
            _count_called(value, seen)
    return len(seen)


if __name__ == "__main__":
    main()
