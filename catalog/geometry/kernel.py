"""Typed decorators for compiled kernels.

Kernels are cached on disk, so that only the first run on a machine compiles. Floating-point
reordering stays off: results must not depend on how a loop happened to be vectorised.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a single-threaded kernel; it releases the interpreter's lock."""
    return cast(Callable[P, R], numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def parallel_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a kernel whose `numba.prange` loops run on all threads that the process allows."""
    return cast(
        Callable[P, R],
        numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")(function),
    )
