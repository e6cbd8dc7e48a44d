"""Cache of compiled kernels: its folder, and when a kernel is recompiled.

numba caches a kernel beside its module, or in the home folder, and recompiles it when the file of
that module is written. That is too rarely, as a kernel also contains code and constants of other
modules, and too often, as the file may differ in a comment alone. Besides, an install may be
read-only and a service may have no home: numba then refuses to compile at all. This package
therefore keeps its kernels in one folder (`folder`), each with a fingerprint of what it is compiled
from.
"""

import hashlib
import os
import shutil
import tempfile
import warnings
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

from thinmap_ros.jit.fingerprint import fingerprint, layouts
from thinmap_ros.jit.private_folder import private_folder, temporary_folder

PACKAGE = Path(__file__).resolve().parents[1]
BESIDE_PACKAGE = PACKAGE / '__pycache__' / 'kernels'


@cache
def folder() -> Path | None:
    """The cache folder; None, with a warning, if no folder is writable.

    The first writable one of: NUMBA_CACHE_DIR, if set; beside the package; the user's cache folder;
    a private folder among the temporary files. Kernels that an administrator compiled beside a
    read-only package are copied from there.
    """
    refusals = []
    named = [_named] if numba.config.CACHE_DIR else []
    for make in (*named, _beside_package, _of_user, _temporary):
        try:
            return make()
        except (OSError, RuntimeError) as error:
            refusals.append(str(error))
    warnings.warn(
        'kernels are compiled at each start, because no cache folder is writable: set '
        f'NUMBA_CACHE_DIR to a writable folder ({"; ".join(refusals)})',
        RuntimeWarning,
        stacklevel=2,
    )
    return None


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

    def load(self, key: tuple[Any, ...]) -> Any:
        """Load the kernel of a key."""
        return super().load(_with_layouts(key))

    def save(self, key: tuple[Any, ...], data: Any) -> None:
        """Save the kernel of a key."""
        super().save(_with_layouts(key), data)

    def _load_index(self) -> dict[Any, str]:
        """Read the index; empty if it names types of modules that were moved or renamed."""
        # Now that all kernels are imported that this one calls.
        if isinstance(self._source_stamp, partial):
            self._source_stamp: Any = self._source_stamp()
        try:
            index: dict[Any, str] = super()._load_index()
        except (ImportError, AttributeError):
            return {}
        return index


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
    return _seeded(Path(base) if base else Path.home() / '.cache')


def _temporary() -> Path:
    return _seeded(private_folder(temporary_folder()))


def _seeded(base: Path) -> Path:
    """Cache folder of this install; it starts with a copy of the kernels beside the package."""
    given = BESIDE_PACKAGE.stat().st_mtime_ns if BESIDE_PACKAGE.is_dir() else 0
    word = hashlib.sha256(f'{PACKAGE} {given}'.encode()).hexdigest()[:16]
    chosen = base / 'thinmap' / f'kernels-{word}'
    if given and not chosen.exists():
        aside = Path(tempfile.mkdtemp(dir=_writable(chosen.parent)))
        for file in BESIDE_PACKAGE.rglob('*.nb[ic]'):
            copy = aside / file.relative_to(BESIDE_PACKAGE)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copy)  # without its mode: it may be read-only
        try:
            aside.rename(chosen)
        except OSError:  # another process was faster
            shutil.rmtree(aside)
    return _writable(chosen)


def _writable(chosen: Path) -> Path:
    """Return the folder, created if missing. Raises OSError if no file can be written there."""
    chosen.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=chosen).close()
    return chosen
