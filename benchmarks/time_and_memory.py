"""Time and memory of a measurement, and the machine that it is made on.

Times are comparable: the best of several alternating runs, or the CPU time of one run.
"""

import os
import resource
import statistics
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

from benchmarks.rows import Row


def machine() -> Iterator[Row]:
    """Load and versions of packages; processor and commit are in `provenance`."""
    yield Row('load average', f'{os.getloadavg()[2]:.0f}')
    for package in ('numpy', 'scipy', 'numba'):
        yield Row(package, version(package))


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
