"""Cache of compiled kernels: its folder, and when a kernel is recompiled.

numba caches a kernel beside its module, or in the home folder, and recompiles it when the file of
that module is written. That is too rarely, as a kernel also contains code and constants of other
modules, and too often, as the file may differ in a comment alone, or lie elsewhere. Besides, an
install may be read-only and a service may have no home: numba then refuses to compile at all. This
package therefore keeps its kernels in one folder of the user (`folder`), in files named by a
fingerprint of what each is compiled from. Installs and clones with equal code share them, and those
with other code do not touch them, whichever processes run at the same time.
"""

import glob
import hashlib
import os
import shutil
import stat
import tempfile
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from enum import EnumType
from functools import cache, partial
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numba
import numpy as np
from numba.core import caching, config
from numba.core.dispatcher import Dispatcher
from numba.core.types.abstract import Type
from numba.core.types.containers import BaseNamedTuple, BaseTuple

# How all kernels are compiled, besides what their decorators say.
OPTIONS = {'nogil': True}

PACKAGE = Path(__file__).resolve().parents[1]
BESIDE_PACKAGE = PACKAGE / '__pycache__' / 'kernels'
_PACKAGE = __name__.partition('.')[0]
_SCALARS = (bool, int, float, complex, str, bytes, np.generic, np.dtype, type(None))
_WORD = 16  # characters of a fingerprint in the names of files
_KEPT = 8  # fingerprints of a function: its code in so many versions or clones

# Of folders that only this user can read and write.
_MODE = stat.S_IRWXU
_OF_OTHERS = stat.S_IRWXG | stat.S_IRWXO

Function = Callable[..., Any]


@cache
def fingerprint(function: Function) -> str:
    """Hash of the code of a kernel, of all kernels that it calls, and of the values that they name.

    Neither comments, docstrings nor other code count.
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


def private_folder(folder: Path) -> Path:
    """Return the folder, created if missing.

    Raises OSError if it is a link, belongs to another user, or is accessible to others.
    """
    try:
        folder.mkdir(mode=_MODE, parents=True, exist_ok=True)
        status = folder.lstat()
    except OSError as error:
        raise OSError(f'{folder}: {error.strerror}: expected a folder') from error
    if not stat.S_ISDIR(status.st_mode):
        raise OSError(f'{folder}: expected a folder, not a link or a file')
    if status.st_uid != os.getuid():
        raise OSError(f'{folder}: owned by user {status.st_uid}: expected a folder of this user')
    if status.st_mode & _OF_OTHERS:
        mode = stat.S_IMODE(status.st_mode)
        raise OSError(f'{folder}: mode {mode:o}: expected {_MODE:o}, closed to other users')
    return folder


def temporary_folder() -> Path:
    """Path of this user's folder among the temporary files; it may not exist yet."""
    return Path(tempfile.gettempdir()) / f'thinmap-{os.getuid()}'


@cache
def folder() -> Path | None:
    """The cache folder; None, with a warning, if no folder is writable.

    The first writable one of: NUMBA_CACHE_DIR, if set; the user's cache folder; beside the package;
    a private folder among the temporary files. Kernels that it lacks and that an administrator left
    beside the package (`leave_beside_package`) are copied from there.
    """
    refusals = []
    named = [_named] if numba.config.CACHE_DIR else []
    for make in (*named, _of_user, _beside_package, _temporary):
        try:
            return make()
        except (OSError, RuntimeError) as error:
            refusals.append(str(error))
    warnings.warn(
        'kernels are compiled at each start, because no cache folder is writable: set '
        f'NUMBA_CACHE_DIR to a writable folder ({"; ".join(refusals)})',
        stacklevel=2,
    )
    return None


def leave_beside_package() -> Path:
    """Copy all kernels into the package, for users of other accounts; returns the folder there.

    Raises OSError where the package is read-only.
    """
    root = folder()
    if root is not None and root != BESIDE_PACKAGE:
        for file in sorted(root.rglob('*.nb[ic]'), key=_is_index):
            _copy(file, BESIDE_PACKAGE / file.relative_to(root))
    return BESIDE_PACKAGE


class KernelLocator:
    """Tells numba where the functions of this package are cached (numba's locator interface)."""

    def __init__(self, function: Callable[..., Any], path: Path, cache_folder: Path) -> None:
        self._function = function
        self._folder = cache_folder.joinpath(*path.relative_to(PACKAGE).parent.parts)

    @classmethod
    def from_function(cls, function: Callable[..., Any], py_file: str) -> 'KernelLocator | None':
        """Locator of a function; None for functions of other packages."""
        path = Path(py_file).resolve()
        cache_folder = folder()
        if PACKAGE not in path.parents or cache_folder is None:
            return None
        return cls(function, path, cache_folder)

    def ensure_cache_path(self) -> None:
        """Create the folder."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """Folder of the kernels of the module."""
        return str(self._folder)

    def get_source_stamp(self) -> Callable[[], str]:
        """What returns the fingerprint that a cached kernel must have, once all are imported."""
        return partial(fingerprint, self._function)

    def get_disambiguator(self) -> str:
        """Nothing but its module and name tells a kernel from others: no line, which changes."""
        return 'kernel'


class _KernelIndex(caching.IndexDataCacheFile):
    """Index of a function's kernels by the types of their arguments."""

    def __init__(self, cache_path: str, filename_base: str, source_stamp: Any) -> None:
        super().__init__(cache_path, filename_base, source_stamp)
        self._base = filename_base

    def load(self, key: tuple[Any, ...]) -> Any:
        """Load the kernel of a key."""
        return super().load(_with_layouts(key))

    def save(self, key: tuple[Any, ...], data: Any) -> None:
        """Save the kernel of a key, in a file of its own whatever other processes save."""
        full = _with_layouts(key)
        overloads = self._load_index()
        number = int(hashlib.sha256(repr(full).encode()).hexdigest()[:12], 16)
        name = overloads.setdefault(full, self._data_name(number))
        self._save_data(name, data)
        self._save_index(overloads)
        _forget_old(Path(self._cache_path), self._base)

    def _load_index(self) -> dict[Any, str]:
        """Read the index; empty if it names types of modules that were moved or renamed."""
        # Now that all kernels are imported that this one calls.
        if isinstance(self._source_stamp, partial):
            self._use_files_of(self._source_stamp())
        try:
            index: dict[Any, str] = super()._load_index()
        except (ImportError, AttributeError):
            return {}
        return index

    def _use_files_of(self, word: str) -> None:
        """Use the files of a fingerprint, which may lie beside the package."""
        name = f'{self._base}.{word[:_WORD]}'
        self._source_stamp: Any = word
        self._index_path: str = str(Path(self._cache_path) / f'{name}.nbi')
        self._data_name_pattern: str = f'{name}.{{number:x}}.nbc'
        if not Path(self._index_path).exists():
            _fetch(Path(self._cache_path), name)


def _with_layouts(key: tuple[Any, ...]) -> tuple[Any, ...]:
    """Key of an index, with the fields of named tuples among the types of the arguments."""
    arguments = getattr(key[0], 'args', key[0])
    return (*key, *layouts(arguments))


caching.CacheImpl._locator_classes.insert(0, KernelLocator)

caching.IndexDataCacheFile = _KernelIndex


def _named() -> Path:
    return _writable(Path(numba.config.CACHE_DIR))


def _beside_package() -> Path:
    return _writable(BESIDE_PACKAGE)


def _of_user() -> Path:
    base = os.environ.get('XDG_CACHE_HOME')
    return _shared(Path(base) if base else Path.home() / '.cache')


def _temporary() -> Path:
    return _shared(private_folder(temporary_folder()))


def _shared(base: Path) -> Path:
    """Cache folder of all installs with these versions, whose compiled code fits together."""
    versions = f'numba-{numba.__version__}-numpy-{np.__version__}'
    return _writable(base / 'thinmap' / f'kernels-{versions}')


def _fetch(chosen: Path, name: str) -> None:
    """Copy the files of a kernel from beside the package, if there are any: the index at last."""
    root = folder()
    beside = BESIDE_PACKAGE if root is None else BESIDE_PACKAGE / chosen.relative_to(root)
    with suppress(OSError):
        for file in sorted(beside.glob(f'{glob.escape(name)}.*'), key=_is_index):
            _copy(file, chosen / file.name)


def _copy(file: Path, target: Path) -> None:
    """Copy a file, without its mode, which may be read-only, and at once for other processes."""
    target.parent.mkdir(parents=True, exist_ok=True)
    aside = target.with_name(f'{target.name}.tmp.{uuid.uuid4().hex}')
    shutil.copyfile(file, aside)
    aside.replace(target)


def _is_index(file: Path) -> bool:
    return file.suffix == '.nbi'


def _forget_old(chosen: Path, base: str) -> None:
    """Delete the kernels of all but the newest fingerprints of a function."""
    with suppress(OSError):
        indexes = list(chosen.glob(f'{glob.escape(base)}.*.nbi'))
        indexes.sort(key=lambda path: path.stat().st_mtime_ns)
        for index in indexes[:-_KEPT]:
            for file in chosen.glob(f'{glob.escape(index.stem)}.*'):
                file.unlink()


def _writable(chosen: Path) -> Path:
    """Return the folder, created if missing. Raises OSError if no file can be written there."""
    chosen.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=chosen).close()
    return chosen
