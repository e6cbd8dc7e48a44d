"""Releases memory pages that are no longer needed."""

import ctypes
import gc
import mmap
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic


def compiler_memory_releaser(
    period_s: float = 3.0, threshold_bytes: float = 4e6
) -> Callable[[], None]:
    """Return a function that releases the pages of the compiler, to be called repeatedly.

    Kernels that are loaded later, with the first message, load the compiler again.
    """
    looked_at = monotonic()
    least = _shared_bytes()

    def look() -> None:
        nonlocal looked_at, least
        if monotonic() - looked_at > period_s:
            if _shared_bytes() > least + threshold_bytes:
                release_compiler_pages()
                least = _shared_bytes()
            looked_at = monotonic()

    return look


def _shared_bytes() -> int:
    """File-backed memory of the process, such as libraries; 0 without /proc."""
    try:
        return int(Path('/proc/self/statm').read_text().split()[2]) * mmap.PAGESIZE
    except OSError:  # no /proc, or no further file may be opened now
        return 0


def release_free_pages() -> None:
    """Return what was freed to the system, which the allocator would keep; where it can."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, 'malloc_trim'):
        libc.malloc_trim(0)


def release_compiler_pages() -> None:
    """Release the memory pages of the kernel compiler.

    Its library, some 100 MB, is idle once all kernels are loaded. Only unmodified mappings are
    released: the system reads them again from the library when needed. Without /proc, nothing
    happens.
    """
    gc.collect()
    try:
        smaps = Path('/proc/self/smaps').read_text()
    except OSError:
        return
    release_free_pages()
    libc = ctypes.CDLL(None)
    for first, last in _clean_mappings(smaps, 'llvmlite'):
        libc.madvise(ctypes.c_void_p(first), ctypes.c_size_t(last - first), mmap.MADV_DONTNEED)


def _clean_mappings(smaps: str, name: str) -> Iterator[tuple[int, int]]:
    """Address ranges of the unmodified mappings of a file."""
    header = ''
    for line in smaps.splitlines():
        key = line.split(maxsplit=1)[0]
        if not key.endswith(':'):
            header = line
        elif key == 'Anonymous:' and name in header and int(line.split()[1]) == 0:
            first, last = header.split(maxsplit=1)[0].split('-')
            yield int(first, 16), int(last, 16)
