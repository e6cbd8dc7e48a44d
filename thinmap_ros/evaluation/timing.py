"""Times that can be compared.

The best of several runs, taken in turns, or what a run takes of the processor.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from thinmap_ros.pipeline import Pipeline


class CpuTimedPipeline(Pipeline):
    """A pipeline whose stages are timed in processor time: a busy machine changes it little."""

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        started = time.process_time()
        yield
        self.stage_seconds.setdefault(stage, []).append(time.process_time() - started)


def best_seconds(works: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Shortest time of each work over some rounds.

    All take turns, so that a busy machine is busy for all.
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
    """Median time of the processor that a work takes over some rounds.

    A busy machine changes it little.
    """
    work()  # compile, fill caches
    taken = []
    for _ in range(rounds):
        started = time.process_time()
        work()
        taken.append(time.process_time() - started)
    return statistics.median(taken)
