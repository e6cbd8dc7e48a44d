"""The one way in which hot loops are compiled."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar('Function', bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a hot loop with numba: cached on disk, and without holding Python's global lock."""
    return cast(Function, numba.njit(cache=True, nogil=True)(function))


def inlined(function: Function) -> Function:
    """Compile a small step shared by several kernels and inlined into each by the compiler."""
    return cast(Function, numba.njit(cache=True, nogil=True, inline='always')(function))
