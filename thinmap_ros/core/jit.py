"""The one way in which hot loops are compiled."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from thinmap_ros.core import kernel_cache

Function = TypeVar('Function', bound=Callable[..., Any])
# Those of all modules that were imported.
KERNELS: list[Any] = []


def kernel(function: Function) -> Function:
    """Compile a hot loop with numba: kept on disk, and without holding Python's global lock."""
    compiled = _compiled(function)
    KERNELS.append(compiled)
    return compiled


def inlined(function: Function) -> Function:
    """Compile a small step that is shared by several kernels and inlined into each of them."""
    return _compiled(function, inline='always')


def _compiled(function: Function, **options: Any) -> Function:
    kept = kernel_cache.folder() is not None
    return cast(Function, numba.njit(cache=kept, nogil=True, **options)(function))
