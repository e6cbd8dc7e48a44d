"""Runs jobs in separate processes, on local cores or a Dask cluster; resumable."""

import argparse
import ctypes
import json
import os
import platform
import signal
import subprocess
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from threading import Thread
from typing import Any, Protocol, TypeVar

from thinmap_ros.core.errors import InputError, ThinmapError, one_line_reason
from thinmap_ros.files.safe import read_text, write_text
from thinmap_ros.startup import print_warnings
from thinmap_ros.view.progress_bar import ProgressBar

Report = dict[str, Any]


class Job(Protocol):
    """Input of a run; pickled for another process."""

    @property
    def name(self) -> str:
        """Name in messages."""


AnyJob = TypeVar('AnyJob', bound=Job)


@dataclass(frozen=True)
class Failure:
    """A failed job: reason in one line, and the traceback of program errors."""

    reason: str
    trace: str = ''


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where jobs run."""
    parser.add_argument(
        '--jobs',
        type=int,
        default=os.cpu_count() or 1,
        metavar='N',
        help='how many run at a time, each in a process of its own (default: cores)',
    )
    parser.add_argument(
        '--dask',
        default='',
        metavar='ADDRESS',
        help='address of a Dask scheduler, such as tcp://host:8786, whose workers have thinmap and '
        'see the same files under the same paths',
    )


def run_pending(
    work: Callable[[AnyJob], Report],
    jobs: Sequence[AnyJob],
    file_of: Callable[[AnyJob], Path],
    arguments: argparse.Namespace,
    quiet: bool = False,
) -> dict[str, Failure]:
    """Run each job without a report file, and write its report when it is finished.

    work: a function of a module, because other processes import it. arguments: those of
    `add_run_options`. Returns the failed jobs, by name; the others run nevertheless.
    """
    missing = [job for job in jobs if not file_of(job).exists()]
    done = len(jobs) - len(missing)
    failures: dict[str, Failure] = {}
    with ProgressBar('runs', quiet) as bar:
        for job, outcome in _outcomes(work, missing, arguments) if missing else ():
            if isinstance(outcome, Failure):
                failures[job.name] = outcome
                bar.write(f'{job.name}: {outcome.reason}\n{outcome.trace}'.rstrip())
            else:
                write_text(file_of(job), json.dumps(outcome) + '\n')
            done += 1
            bar.show(done / len(jobs), f'{done} of {len(jobs)}')
    return failures


def read_report(path: Path, options: Any) -> Report:
    """Report of a finished job. Raises InputError if its entry `options` differs from options."""
    report: Report = json.loads(read_text(path))
    if report.get('options') != options:
        raise InputError(f'{path}: of a run with other options: expected another folder for these')
    return report


def failure_summary(failures: dict[str, Failure]) -> InputError:
    """One error for all failed jobs, each with its name and reason."""
    reasons = [f'{name}: {failure.reason}' for name, failure in sorted(failures.items())]
    return InputError(f'{len(failures)} failed: {"; ".join(reasons)}')


def _outcomes(
    work: Callable[[AnyJob], Report], jobs: Sequence[AnyJob], arguments: argparse.Namespace
) -> Iterator[tuple[AnyJob, Report | Failure]]:
    if arguments.dask:
        return _on_cluster(work, jobs, arguments.dask)
    return _on_cores(work, jobs, arguments.jobs)


def _on_cores(
    work: Callable[[AnyJob], Report], jobs: Sequence[AnyJob], processes: int
) -> Iterator[tuple[AnyJob, Report | Failure]]:
    # No pool, as joblib's: one process that the system kills ends all jobs of a pool, and jobs of
    # joblib outlive a program that is killed. Also, the peak memory of a process is of one job.
    waiting = list(reversed(jobs))
    running: dict[Connection, tuple[AnyJob, ForkServerProcess]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < max(processes, 1):
                job = waiting.pop()
                connection, process = _started(work, job)
                running[connection] = (job, process)
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                job, process = running.pop(ready)
                yield job, _received(ready, process)
    finally:
        for _, process in running.values():
            process.terminate()
            process.join()


def _started(work: Callable[[AnyJob], Report], job: AnyJob) -> tuple[Connection, ForkServerProcess]:
    context = get_context('forkserver')
    context.set_forkserver_preload([work.__module__])  # imported once, not by each job
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(there, work, job), daemon=True)
    process.start()
    there.close()  # so that the end of the process is the end of the pipe
    return here, process


def _send(connection: Connection, work: Callable[[AnyJob], Report], job: AnyJob) -> None:
    Thread(target=_end_with_program, daemon=True).start()
    # Ctrl-C goes to all processes of a terminal; the parent ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection.send(_attempted(work, job))


def _end_with_program() -> None:
    """End this process when the program does: its parent, the fork server, waits for its jobs."""
    program = parent_process()
    assert program is not None
    program.join()
    os.kill(os.getpid(), signal.SIGTERM)


def _received(connection: Connection, process: ForkServerProcess) -> Report | Failure:
    outcome: Report | Failure | None = None
    with suppress(EOFError):  # of a process that was killed
        outcome = connection.recv()
    process.join()
    connection.close()
    return outcome or Failure(f'its process ended with exit code {process.exitcode}')


def _on_cluster(
    work: Callable[[AnyJob], Report], jobs: Sequence[AnyJob], address: str
) -> Iterator[tuple[AnyJob, Report | Failure]]:
    from dask.distributed import Client
    from dask.distributed import as_completed as as_completed_there

    with Client(address) as client:
        running = {client.submit(_attempted, work, job, pure=False): job for job in jobs}
        for future in as_completed_there(list(running)):
            try:
                outcome = future.result()
            except Exception as error:  # of the cluster: a worker that was killed, a lost module
                outcome = Failure(_named(error))
            yield running[future], outcome


def _attempted(work: Callable[[AnyJob], Report], job: AnyJob) -> Report | Failure:
    try:
        with warnings.catch_warnings():
            print_warnings(job.name)
            return work(job)
    except (ThinmapError, OSError) as error:
        return Failure(one_line_reason(error))
    except Exception as error:
        return Failure(_named(error), traceback.format_exc())


def _named(error: Exception) -> str:
    return f'{type(error).__name__}: {one_line_reason(error)}'


_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG


def end_with_parent() -> None:
    """Send SIGTERM to this process when its parent ends (Linux)."""
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGTERM)


_ROOT = Path(__file__).resolve().parents[2]
_PROVENANCE = 'provenance.txt'
_GIT_S = 10.0


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
