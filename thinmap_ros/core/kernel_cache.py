"""Where compiled kernels are kept, and when they are compiled anew.

numba keeps a kernel beside its module, or in the home folder, and compiles it anew when that module
changes. That is not enough here: an install may be read-only and a service have no home, where
numba refuses to compile at all; and a kernel holds code and constants of the modules that it
imports. So this package's kernels are kept in one folder (`folder`), each with a fingerprint of its
module and all modules of this package that it depends on (`fingerprint`).
"""

import hashlib
import os
import re
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import caching

from thinmap_ros.core.errors import InputError, one_line_reason
from thinmap_ros.core.private_folder import private_folder, temporary_folder

PACKAGE = Path(__file__).resolve().parents[1]
BESIDE_PACKAGE = PACKAGE / '__pycache__' / 'kernels'
_IMPORT = re.compile(
    rf'^\s*(?:from ({PACKAGE.name}[\w.]*) import (\([^)]*\)|[^\n]*)|import ({PACKAGE.name}[\w.]*))',
    re.MULTILINE,
)


@cache
def folder() -> Path | None:
    """The folder for kernels, or None, with a warning, where there is none to write to.

    The first that can be written to of: NUMBA_CACHE_DIR, where it is set; beside the package; the
    user's cache folder; a private one among the temporary files. What an administrator compiled
    beside a package that this user may not write to is taken over.
    """
    refusals = []
    named = [_named] if numba.config.CACHE_DIR else []
    for make in (*named, _beside_package, _of_user, _temporary):
        try:
            return make()
        except (OSError, InputError, RuntimeError) as error:
            refusals.append(one_line_reason(error))
    warnings.warn(
        'kernels are compiled at each start, as there is nowhere to keep them: set '
        f'NUMBA_CACHE_DIR to a folder that can be written to ({"; ".join(refusals)})',
        RuntimeWarning,
        stacklevel=2,
    )
    return None


@cache
def fingerprint(path: Path) -> str:
    """One word for the contents of a module and of all of this package that it depends on."""
    known: set[Path] = set()
    waiting = [path]
    while waiting:
        module = waiting.pop()
        if module not in known:
            known.add(module)
            waiting.extend(_imported(module))
    together = hashlib.sha256()
    for module in sorted(known):
        together.update(_digest(module))
    return together.hexdigest()


class KernelLocator:
    """What numba asks where a function of this package is kept: it takes any class that answers."""

    def __init__(self, function: Callable[..., Any], path: Path, cache_folder: Path) -> None:
        self._py_file = str(path)
        self._line = function.__code__.co_firstlineno
        self._folder = cache_folder.joinpath(*path.relative_to(PACKAGE).parent.parts)

    @classmethod
    def from_function(cls, function: Callable[..., Any], py_file: str) -> 'KernelLocator | None':
        """Locator of a function, or None where it is not of this package: others have theirs."""
        path = Path(py_file).resolve()
        cache_folder = folder()
        if PACKAGE not in path.parents or cache_folder is None:
            return None
        return cls(function, path, cache_folder)

    def ensure_cache_path(self) -> None:
        """Make the folder."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """Folder of the module's kernels."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """What a kernel that was kept has to agree with."""
        return fingerprint(Path(self._py_file))

    def get_disambiguator(self) -> str:
        """Tell functions of one name apart."""
        return str(self._line)


class _KernelIndex(caching.IndexDataCacheFile):
    """The kernels of a function by the types of their arguments."""

    def _load_index(self) -> dict[Any, str]:
        """Read the index; empty where it names types of modules that have been moved or renamed."""
        try:
            index: dict[Any, str] = super()._load_index()
        except (ImportError, AttributeError):
            return {}
        return index


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
    """A folder of its own for each install, which begins with what lies beside the package."""
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
    """Return the folder, made where it is missing; raises OSError where it takes no file."""
    chosen.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=chosen).close()
    return chosen


@cache
def _digest(module: Path) -> bytes:
    return hashlib.sha256(module.read_bytes()).digest()


@cache
def _imported(module: Path) -> frozenset[Path]:
    """Files of this package that a module imports, anywhere in it."""
    files: set[Path] = set()
    for package, names, whole in _IMPORT.findall(module.read_text()):
        files.update(_files_of(package or whole))
        for name in re.findall(r'\w+', names):
            files.update(_files_of(f'{package}.{name}'))
    return frozenset(files)


def _files_of(dotted: str) -> Iterator[Path]:
    path = PACKAGE.parent.joinpath(*dotted.split('.'))
    for file in (path.with_suffix('.py'), path / '__init__.py'):
        if file.is_file():
            yield file
