"""Compilation of hot loops with numba."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from thinmap_ros.jit import cache
from thinmap_ros.jit.cache import OPTIONS

Function = TypeVar('Function', bound=Callable[..., Any])
# Kernels of all imported modules.
KERNELS: list[Any] = []


def kernel(function: Function) -> Function:
    """Compile a hot loop with numba: cached on disk, run without the global interpreter lock."""
    compiled = _compiled(function)
    KERNELS.append(compiled)
    return compiled


def inlined(function: Function) -> Function:
    """Compile a small function that is inlined into each kernel that calls it."""
    return _compiled(function, inline='always')


def _compiled(function: Function, **options: Any) -> Function:
    kept = cache.folder() is not None
    return cast(Function, numba.njit(cache=kept, **OPTIONS, **options)(function))
