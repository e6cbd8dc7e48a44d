"""What a kernel is compiled from, as a hash: neither comments, docstrings nor other code count."""

import hashlib
from collections.abc import Callable, Iterator
from enum import EnumType
from functools import cache
from types import CodeType, ModuleType
from typing import Any

import numpy as np
from numba.core import config
from numba.core.dispatcher import Dispatcher
from numba.core.types.abstract import Type
from numba.core.types.containers import BaseNamedTuple, BaseTuple

# How all kernels are compiled, besides what their decorators say.
OPTIONS = {'nogil': True}
_PACKAGE = __name__.partition('.')[0]
_SCALARS = (bool, int, float, complex, str, bytes, np.generic, np.dtype, type(None))
Function = Callable[..., Any]


@cache
def fingerprint(function: Function) -> str:
    """Hash of the code of a kernel, of all kernels that it calls, and of the values that they name.

    To be called once all modules of the kernels are imported: kernels call some that stand below
    them. What Numba accepts as a global value counts: numbers, texts, tuples, arrays, their types,
    enumerations, named tuples, kernels; of a function of another module its name alone.
    """
    settings = (OPTIONS, config.OPT, config.BOUNDSCHECK)
    together = hashlib.sha256(repr(settings).encode())
    known = {function}
    waiting = [function]
    while waiting:
        current = waiting.pop()
        together.update(repr((current.__qualname__, _code(current), current.__defaults__)).encode())
        for name, value in _named_values(current):
            together.update(repr((name, _value(value))).encode())
            if isinstance(value, Dispatcher) and value.py_func not in known:
                known.add(value.py_func)
                waiting.append(value.py_func)
    return together.hexdigest()


def layouts(arguments: tuple[Type, ...]) -> tuple[Any, ...]:
    """Fields of the named tuples among types of arguments: code accesses them by their position."""
    found: list[Any] = []
    for kind in arguments:
        if isinstance(kind, BaseNamedTuple):
            found.append((kind.instance_class.__qualname__, kind.fields))
        if isinstance(kind, BaseTuple):
            found.extend(layouts(tuple(kind)))
    return tuple(found)


def _code(function: Function) -> tuple[Any, ...]:
    """Code of a function without its docstring and line numbers."""
    code = function.__code__
    # The first constant is the docstring, None where there is none.
    constants = code.co_consts if function.__doc__ is None else (None, *code.co_consts[1:])
    return _parts(code, constants)


def _parts(code: CodeType, constants: tuple[Any, ...]) -> tuple[Any, ...]:
    nested = [
        _parts(constant, constant.co_consts) if isinstance(constant, CodeType) else constant
        for constant in constants
    ]
    return (code.co_code, nested, code.co_names, code.co_varnames, code.co_flags)


def _named_values(function: Function) -> Iterator[tuple[str, Any]]:
    """Global values of a function by name, those in modules of this package among them."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    yield from ((name, cell.cell_contents) for name, cell in cells)
    names = _names(function.__code__)
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType) and value.__name__.startswith(_PACKAGE):
            yield from ((f'{name}.{of}', vars(value)[of]) for of in names if of in vars(value))
        else:
            yield name, value


def _names(code: CodeType) -> list[str]:
    """Names of a function's code, and of the comprehensions in it."""
    found = list(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            found.extend(_names(constant))
    return found


def _value(value: Any) -> Any:
    """What a global value means to compiled code; None for what numba does not accept."""
    if isinstance(value, _SCALARS):
        return type(value).__name__, repr(value)
    if isinstance(value, tuple):
        return [_value(member) for member in value]
    if isinstance(value, np.ndarray):
        return repr(value.dtype), value.shape, value.tobytes()
    if isinstance(value, Dispatcher):
        return sorted(value.targetoptions.items())
    if isinstance(value, ModuleType):
        return value.__name__
    if isinstance(value, EnumType):
        return [(member.name, member.value) for member in value]  # type: ignore[var-annotated]
    return getattr(value, '_fields', None)
