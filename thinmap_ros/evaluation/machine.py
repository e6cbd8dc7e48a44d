"""Machine and commit of a measurement, and its time and memory.

Times are comparable: the best of several alternating runs, or the CPU time of one run.
"""

import os
import platform
import resource
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

from thinmap_ros.evaluation.outcome import Row
from thinmap_ros.files.atomic import read_text, write_text
from thinmap_ros.pipeline import Pipeline

_ROOT = Path(__file__).resolve().parents[2]
_PROVENANCE = 'provenance.txt'
_GIT_S = 10.0


def machine() -> Iterator[Row]:
    """Load and versions of packages; processor and commit are in `provenance`."""
    yield Row('load average', f'{os.getloadavg()[2]:.0f}')
    for package in ('numpy', 'scipy', 'numba'):
        yield Row(package, version(package))


def provenance(folder: Path | None = None) -> str:
    """One line of commit, processor, cores and Python: of a folder of results, else of this run."""
    if folder is not None and (folder / _PROVENANCE).exists():
        return read_text(folder / _PROVENANCE).strip()
    known = commit(_ROOT)
    words = [
        *([f'Commit {known}'] if known else []),
        _processor(),
        f'{os.cpu_count()} cores',
        f'Python {platform.python_version()}',
    ]
    return ', '.join(words)


def write_provenance(folder: Path) -> None:
    """Write the line of this run to a folder of results, for pages that are made of it later."""
    write_text(folder / _PROVENANCE, f'{provenance()}\n')


def commit(root: Path) -> str:
    """Short hash of the commit of a source tree; empty outside of git.

    Changes that are not committed are marked, but for those of docs, to which pages are written.
    """
    try:
        # The tree may be installed inside the repository of another project.
        if not _git(root, 'ls-files', 'thinmap_ros/evaluation'):
            return ''
        changes = _git(root, 'status', '--porcelain', '-uno', '--', '.', ':(exclude)docs')
        return _git(root, 'rev-parse', '--short', 'HEAD') + (
            ' with local changes' if changes else ''
        )
    except (OSError, subprocess.SubprocessError):
        return ''


def _git(root: Path, *words: str) -> str:
    command = ['git', '-C', str(root), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=_GIT_S, check=True)
    return done.stdout.strip()


def _processor() -> str:
    lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
    names = [line.partition(':')[2].strip() for line in lines if line.startswith('model name')]
    return names[0] if names else platform.processor()


class CpuTimedPipeline(Pipeline):
    """A pipeline that measures its stages in CPU time, which depends little on other load."""

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = time.process_time()
        yield
        self.stage_seconds.setdefault(stage, []).append(time.process_time() - started)


def best_seconds(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Shortest time of each function over some rounds.

    All functions alternate, so that other load affects all of them.
    """
    for work in works.values():
        work()  # compile, fill caches
    best = dict.fromkeys(works, float('inf'))
    for _ in range(rounds):
        for name, work in works.items():
            started = time.perf_counter()
            work()
            best[name] = min(best[name], time.perf_counter() - started)
    return best


def median_seconds(work: Callable[[], object], rounds: int) -> float:
    """Median CPU time of a function over some rounds, which depends little on other load."""
    work()  # compile, fill caches
    taken = []
    for _ in range(rounds):
        started = time.process_time()
        work()
        taken.append(time.process_time() - started)
    return statistics.median(taken)


def resident_mb() -> float:
    """Resident memory now, MB."""
    pages = int(Path('/proc/self/statm').read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def peak_mb() -> float:
    """Highest resident memory since the start of the process or `forget_peak`, MB."""
    # Not ru_maxrss: after a fork it includes the memory of the parent.
    status = Path('/proc/self/status').read_text()
    return int(status.split('VmHWM:')[1].split()[0]) * 1024 / 1e6


def forget_peak() -> None:
    """Reset the peak of resident memory."""
    Path('/proc/self/clear_refs').write_text('5')
