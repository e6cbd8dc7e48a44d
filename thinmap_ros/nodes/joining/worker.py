"""A thread for long work, which uses a share of a core at most."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

Result = Callable[[], None]
"""Takes what work has found, in the thread of the node."""


def _fail(error: Exception) -> None:
    raise error


class Turns:
    """Kinds of work that take turns: none waits for ever because another one is always ready."""

    def __init__(self) -> None:
        self._last = ''

    def take(self, ready: Sequence[str]) -> str:
        """One of the kinds that are ready, the first that was not the last; '' without any."""
        others = [kind for kind in ready if kind != self._last]
        self._last = next(iter(others or ready), '')
        return self._last


class Worker:
    """Does one thing after another in a thread, and rests between them."""

    def __init__(self, share: float) -> None:
        """share: of the time of a core that the work may take, 0 to 1."""
        self._share = share
        self._thread = ThreadPoolExecutor(1, thread_name_prefix='worker')
        self._job: Future[tuple[Result, float]] | None = None
        self._free_from_s = 0.0  # time of the machine

    @property
    def is_free(self) -> bool:
        """Whether other work may begin."""
        return self._job is None and time.monotonic() >= self._free_from_s

    def begin(self, work: Callable[[], Result]) -> None:
        """Begin work."""

        def timed() -> tuple[Result, float]:
            began_s = time.thread_time()
            try:
                result = work()
            except Exception as error:  # raised once, when the result is taken
                result = partial(_fail, error)
            return result, time.thread_time() - began_s

        self._job = self._thread.submit(timed)

    def take_result(self) -> None:
        """Take what the work has found, if it is done; raises what it has raised."""
        if self._job is None or not self._job.done():
            return
        result, used_s = self._job.result()
        self._job = None
        self._free_from_s = time.monotonic() + used_s * (1.0 / self._share - 1.0)
        result()

    def drop(self) -> None:
        """Do not take what the present work finds."""
        self._job = None
