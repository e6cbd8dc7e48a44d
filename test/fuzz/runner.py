"""Runs cases in processes that may hang or die, until the time is over."""

import faulthandler
import os
import resource
import select
import shutil
import signal
import sys
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fuzz.cases import Source

LIMIT_S = 60.0
"""CPU time: a case takes milliseconds to a second of it, however busy the machine is."""
NET = 20
"""A case that sleeps or waits for itself takes none: it is ended after so many limits."""
MEMORY_BYTES = 3 << 30
_BATCH = 200
_KEPT_OF_A_KIND = 20


@dataclass
class Outcome:
    """Number of tested cases by source, and the failures (source, number, reason)."""

    seed: int
    tried: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[str, int, str]] = field(default_factory=list)
    interrupted: bool = False


def rng_of(seed: int, source: str, number: int) -> np.random.Generator:
    """Random generator of one case, independent of earlier cases."""
    return np.random.default_rng([seed, zlib.crc32(source.encode()), number])


class Runner:
    """Tests cases of all sources in turn, in batches, and stores those that fail.

    Each batch runs in a child process with limited memory. A case that needs more than limit_s of
    CPU time or net_s of wall time is ended with its process.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        seed: int,
        out: Path,
        limit_s: float = LIMIT_S,
        net_s: float = NET * LIMIT_S,
    ) -> None:
        self.outcome = Outcome(seed)
        self._sources = sources
        self._out = out / str(seed)
        # Another run with the same seed may be active.
        self._work = self._out / f'work-{os.getpid()}'
        self._failed = self._out / f'failed-{os.getpid()}'
        self._limit_s = limit_s
        self._net_s = net_s
        self._shared: dict[str, Any] = {}
        self._spent = Counter[str]()

    def run(self, end_s: float, most: int, first: int = 0) -> Outcome:
        """Test until time.monotonic() is end_s, or `most` cases of each source from `first` on."""
        following = {source.name: first for source in self._sources}
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            while time.monotonic() < end_s:
                left = [s for s in self._sources if following[s.name] < first + most]
                if not left:
                    break
                # The source with the least time so far.
                source = min(left, key=lambda s: self._spent[s.name])
                # The time for shared data does not count.
                self._prepare(source)
                began = time.monotonic()
                stop = min(following[source.name] + _BATCH, first + most)
                following[source.name] = self._batch(
                    source, range(following[source.name], stop), min(end_s, began + 5.0)
                )
                self._spent[source.name] += time.monotonic() - began
        except KeyboardInterrupt:
            self.outcome.interrupted = True
        for folder in (self._work, self._failed):
            shutil.rmtree(folder, ignore_errors=True)
        return self.outcome

    def _prepare(self, source: Source) -> None:
        if source.name not in self._shared:
            folder = self._out / 'shared' / source.name
            folder.mkdir(parents=True, exist_ok=True)
            self._shared[source.name] = source.prepare(folder)

    def _batch(self, source: Source, numbers: range, end_s: float) -> int:
        """Test cases until one ends its process; returns the number of the next case."""
        read, write = os.pipe()
        # Buffered output would be written twice.
        sys.stdout.flush()
        sys.stderr.flush()
        # SIGINT during a fork may be lost in fork handlers of libraries.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        child = os.fork()
        if child == 0:
            os.close(read)
            self._child(source, numbers, end_s, write)
        os.close(write)
        try:
            return self._watch(source, numbers, child, read)
        finally:
            os.close(read)

    def _watch(self, source: Source, numbers: range, child: int, pipe: int) -> int:
        """Read the child's pipe: one byte per case, for success or failure."""
        number = numbers.start
        ended = ''
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            while not ended:
                ready, _, _ = select.select([pipe], [], [], self._net_s)
                said = os.read(pipe, 1) if ready else b''
                if said in (b'+', b'-'):
                    self._count(source, number, said == b'-')
                    number += 1
                elif not ready:
                    ended = f'has not ended after {self._net_s:g} s'
                else:
                    break
        finally:
            if ended or sys.exc_info()[0] is not None:
                os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
        if not ended and status != 0:
            ended = self._why(os.waitstatus_to_exitcode(status))
        if ended:
            (self._work / 'why.txt').write_text(ended + '\n')
            self._count(source, number, True)
            number += 1
        return number

    def _why(self, code: int) -> str:
        if code == -signal.SIGPROF:
            return f'takes more than {self._limit_s:g} s of CPU time'
        return f'the process ends with {code}'

    def _count(self, source: Source, number: int, failed: bool) -> None:
        self.outcome.tried[source.name] += 1
        if not failed:
            return
        why = self._keep(source, number)
        self.outcome.failures.append((source.name, number, why))
        print(f'{source.name} {number}: {why}', file=sys.stderr)

    def _keep(self, source: Source, number: int) -> str:
        """Store the files of a failed case; returns the reason in one line."""
        kept = self._out / f'{source.name}-{number}'
        waiting = self._failed / str(number)
        made = waiting if waiting.exists() else self._work
        lines = (made / 'why.txt').read_text().strip().splitlines()
        if sum(name == source.name for name, _, _ in self.outcome.failures) < _KEPT_OF_A_KIND:
            shutil.rmtree(kept, ignore_errors=True)
            made.rename(kept)
        shutil.rmtree(made, ignore_errors=True)
        return lines[-1] if lines else 'no reason'

    def _child(self, source: Source, numbers: range, end_s: float, pipe: int) -> None:
        """Test cases, and end the process."""
        try:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            _limit_memory()
            for number in numbers:
                if number > numbers.start and time.monotonic() > end_s:
                    break
                os.write(pipe, b'+' if self._tried(source, number) else b'-')
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)

    def _tried(self, source: Source, number: int) -> bool:
        shutil.rmtree(self._work, ignore_errors=True)
        self._work.mkdir(parents=True)
        # State of the process when it died.
        died = (self._work / 'died.txt').open('w')
        faulthandler.enable(died)
        # It prints the stack and ends the process after the time limit, also within a kernel that
        # never returns to the interpreter.
        faulthandler.register(signal.SIGPROF, died, chain=True)
        signal.setitimer(signal.ITIMER_PROF, self._limit_s)
        rng = rng_of(self.outcome.seed, source.name, number)
        try:
            source.run(self._shared[source.name], rng, self._work)
        except Exception:
            # The folder is moved at once: the next case has its own.
            (self._work / 'why.txt').write_text(traceback.format_exc())
            self._failed.mkdir(exist_ok=True)
            self._work.rename(self._failed / str(number))
            return False
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            faulthandler.unregister(signal.SIGPROF)
            faulthandler.disable()
            died.close()
        return True


def _limit_memory() -> None:
    """Limit the memory of this process to this amount above its current use."""
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
