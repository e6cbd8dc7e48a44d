"""Cases one after the other, each in a process that may hang or die, until the time is over."""

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
    """How many cases of each source were tried, and which of them failed: (source, number, why)."""

    seed: int
    tried: Counter[str] = field(default_factory=Counter)
    failures: list[tuple[str, int, str]] = field(default_factory=list)
    interrupted: bool = False


def rng_of(seed: int, source: str, number: int) -> np.random.Generator:
    """Randomness of one case: it depends on nothing that was tried before."""
    return np.random.default_rng([seed, zlib.crc32(source.encode()), number])


class Runner:
    """Tries cases of all sources in turn, a batch at a time, and keeps those that fail.

    Each batch runs in a child process with a limit of memory. A case that takes more CPU time than
    limit_s is ended with its process, and so is one that has not ended after net_s by the clock.
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
        # Another run of the same seed may go on beside.
        self._work = self._out / f'work-{os.getpid()}'
        self._failed = self._out / f'failed-{os.getpid()}'
        self._limit_s = limit_s
        self._net_s = net_s
        self._shared: dict[str, Any] = {}
        self._spent = Counter[str]()

    def run(self, end_s: float, most: int, first: int = 0) -> Outcome:
        """Try until time.monotonic() is end_s, or `most` cases of each source from number first."""
        following = {source.name: first for source in self._sources}
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            while time.monotonic() < end_s:
                left = [s for s in self._sources if following[s.name] < first + most]
                if not left:
                    break
                # The one that has had the least time so far.
                source = min(left, key=lambda s: self._spent[s.name])
                # What all cases share may take longer than many of them: it does not count.
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
        """Try cases until one ends its process; the number to go on with."""
        read, write = os.pipe()
        # What is waiting to be written would be written twice.
        sys.stdout.flush()
        sys.stderr.flush()
        # Ctrl-C amidst a fork may be lost in what libraries do there.
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
        """Follow what a child says: a byte when a case has gone well, another when it has not."""
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
        """Keep the files of a failed case; returns why it failed, in a line."""
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
        """Try cases, and end the process."""
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
        # What was going on when the process died.
        died = (self._work / 'died.txt').open('w')
        faulthandler.enable(died)
        # It ends the process when the time is over, also amidst a kernel that never comes back to
        # the interpreter, and says before where that was.
        faulthandler.register(signal.SIGPROF, died, chain=True)
        signal.setitimer(signal.ITIMER_PROF, self._limit_s)
        rng = rng_of(self.outcome.seed, source.name, number)
        try:
            source.run(self._shared[source.name], rng, self._work)
        except Exception:
            # The folder is taken over at once: the next case has one of its own.
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
    """Let this process take up so much more than it has."""
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
