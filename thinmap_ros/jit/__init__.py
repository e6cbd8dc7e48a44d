"""Compilation of hot loops with numba."""

import re
from collections.abc import Callable
from functools import cache as once
from typing import Any, TypeVar, cast

import numba

from thinmap_ros.jit import cache
from thinmap_ros.jit.cache import OPTIONS

Function = TypeVar('Function', bound=Callable[..., Any])
# Kernels of all imported modules.
KERNELS: list[Any] = []
_DECLARATION = re.compile(r'^@kernel$', re.MULTILINE)


def kernel(function: Function) -> Function:
    """Compile a hot loop with numba: cached on disk, run without the global interpreter lock."""
    compiled = _compiled(function)
    KERNELS.append(compiled)
    return compiled


def inlined(function: Function) -> Function:
    """Compile a small function that is inlined into each kernel that calls it."""
    return _compiled(function, inline='always')


@once
def declared_kernels() -> int:
    """Number of kernels of the package, also of modules that are not imported; 0 without sources.

    As a module may be imported while others are compiled, their number is known by this alone.
    """
    sources = cache.PACKAGE.rglob('*.py')
    return sum(len(_DECLARATION.findall(source.read_text())) for source in sources)


def _compiled(function: Function, **options: Any) -> Function:
    kept = cache.folder() is not None
    return cast(Function, numba.njit(cache=kept, **OPTIONS, **options)(function))
