"""Tests mutants in a copy of the project, each with the tests of its module."""

import contextlib
import enum
import functools
import math
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mutants.mutations import Mutation
from mutants.selection import Selection
from thinmap_ros.jit import cache

_MAX_MEMORY = 8 * 2**30  # bytes: a mutant may allocate any amount
# CPU time of the tests with a mutant over that without it. A busy machine hardly matters:
# the same tests took 4.04 to 4.24 s of it with 5 to 12 processes on two cores. The rest is for
# mutants that make the tests slower, and end.
_CPU_FACTOR = 4.0
# Compiles the kernels of the module again, as a mutant does, and changes nothing else.
_NEUTRAL = b'\n# without a mutant\n'
# Exit codes of pytest: no test was found; tests failed, without naming one; wrong usage.
_NO_TESTS = 5
_NO_RESULT = (1, 4)
_FAILED = re.compile(r'^(?:FAILED|ERROR) (\S+)', re.MULTILINE)


class Fate(enum.Enum):
    """Outcome of a mutant."""

    KILLED = 'killed'
    KILLED_BY_LIMIT = 'killed by its CPU limit'
    TIMED_OUT = 'timed out'
    SURVIVED = 'survived'

    @property
    def is_killed(self) -> bool:
        """Whether the tests have found the mutant; a busy machine may be why it timed out."""
        return self in (Fate.KILLED, Fate.KILLED_BY_LIMIT)


def fate_of(code: int | None, has_failed: bool) -> Fate:
    """Outcome by the exit code of pytest, None after the time limit.

    has_failed: whether a failed test is named.

    Raises ValueError if pytest itself failed.
    """
    if code is None:
        return Fate.TIMED_OUT
    if code == -signal.SIGXCPU:
        return Fate.KILLED_BY_LIMIT
    if code in (0, _NO_TESTS):
        return Fate.SURVIVED
    if code in _NO_RESULT and not has_failed:
        raise ValueError(f'pytest ended with {code}, and no test has failed')
    return Fate.KILLED


@dataclass(frozen=True)
class Result:
    """Outcome of a mutant, and the test that has found it."""

    mutation: Mutation
    fate: Fate
    test: str = ''


@dataclass(frozen=True)
class _Run:
    """Exit code of pytest (None after the time limit), its output, and its CPU time, s."""

    code: int | None
    output: str
    cpu_s: float


class Workshop:
    """A copy of the project in which one module at a time is mutated."""

    def __init__(self, root: Path, package: str, folder: Path) -> None:
        self._root = root
        self._copy = folder / 'tree'
        self._kernels = folder / 'kernels'
        self._kernels_used = folder / 'kernels_used'
        _copy_project(root, self._copy)
        if (cached := cache.folder()) is not None:
            shutil.copytree(cached, self._kernels)
        self._kernels.mkdir(exist_ok=True)
        # By content: a mutant of the same size and time must not be taken for the original.
        command = ['-m', 'compileall', '-q', '--invalidation-mode', 'checked-hash', package]
        subprocess.run([sys.executable, *command], cwd=self._copy, check=True)
        self._selection = Selection(self._copy, package)
        self._cpu_s: dict[Path, float] = {}

    def run(self, mutation: Mutation, limit_s: float) -> Result:
        """Test a mutant; its path is relative to the project.

        limit_s: for what waits and does not compute. The limit of its CPU time is derived from that
        of the same tests without a mutant.

        Raises SystemExit if those fail.
        """
        module = self._copy / mutation.path
        tests = [str(test) for test in self._selection.tests_of(module)]
        if not tests:
            return Result(mutation, Fate.SURVIVED)
        cpu_s = math.ceil(_CPU_FACTOR * self._cpu_without_mutant(module, tests, limit_s))
        with _changed(module, mutation.applied(module.read_bytes())):
            run = self._pytest(tests, limit_s, ['-x'], cpu_s)
        failed = _FAILED.search(run.output)
        try:
            fate = fate_of(run.code, failed is not None)
        except ValueError as error:
            raise SystemExit(f'mutants: {error}: {run.output.strip()[-300:]}') from error
        return Result(mutation, fate, failed[1] if failed else '')

    def _cpu_without_mutant(self, module: Path, tests: list[str], limit_s: float) -> float:
        """CPU time of the tests of a module, s, measured once; those that fail prove nothing."""
        if module not in self._cpu_s:
            with _changed(module, module.read_bytes() + _NEUTRAL):
                run = self._pytest(tests, limit_s, [])
            if run.code is None:
                names = ', '.join(tests)
                raise SystemExit(f'mutants: without a mutant, not done in {limit_s:g} s: {names}')
            if run.code not in (0, _NO_TESTS):
                broken = ', '.join(_FAILED.findall(run.output)) or run.output.strip()[-300:]
                raise SystemExit(f'mutants: these tests fail without a mutant: {broken}')
            self._cpu_s[module] = run.cpu_s
        return self._cpu_s[module]

    def _pytest(
        self, tests: list[str], limit_s: float, options: list[str], cpu_s: int | None = None
    ) -> _Run:
        """Run tests, with a limit of time and one of CPU time."""
        command = [sys.executable, '-m', 'pytest', '-q', '-rfE', '--tb=no', '--no-header']
        # A mutant is limited as a whole, and what it compiles is not what its tests take.
        command += ['-p', 'no:cacheprovider', '-p', 'no:support.cpu_time']
        command += ['-m', 'not slow and not live', *options, *tests]
        before_s = _cpu_of_children_s()
        process = subprocess.Popen(
            command,
            cwd=self._copy,
            env=self._environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=functools.partial(_set_limits, cpu_s),
        )
        try:
            output, _ = process.communicate(timeout=limit_s)
            code: int | None = process.returncode
        except subprocess.TimeoutExpired:
            code = None
            output = ''
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return _Run(code, output, _cpu_of_children_s() - before_s)

    def _environment(self) -> dict[str, str]:
        """Environment of a run; its kernel cache is a copy of the project's."""
        shutil.rmtree(self._kernels_used, ignore_errors=True)
        shutil.copytree(self._kernels, self._kernels_used)
        given = os.environ.get('PYTHONPATH', '').split(os.pathsep)
        others = [folder for folder in given if Path(folder).resolve() != self._root]
        return {
            **os.environ,
            'PYTHONPATH': os.pathsep.join([str(self._copy), *others]),
            'PYTHONDONTWRITEBYTECODE': '1',
            'NUMBA_CACHE_DIR': str(self._kernels_used),
            'THINMAP_ENV': str(self._copy),
        }


@contextlib.contextmanager
def _changed(module: Path, text: bytes) -> Iterator[None]:
    """Another text of a module for a while."""
    original = module.read_bytes()
    module.write_bytes(text)
    try:
        yield
    finally:
        module.write_bytes(original)


def _set_limits(cpu_s: int | None) -> None:
    for kind, limit in ((resource.RLIMIT_AS, _MAX_MEMORY), (resource.RLIMIT_CPU, cpu_s)):
        if limit is not None:
            _, hard = resource.getrlimit(kind)
            resource.setrlimit(kind, (limit, hard))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _cpu_of_children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _copy_project(root: Path, copy: Path) -> None:
    """Copy the files that git knows or would add."""
    listed = subprocess.run(
        ['git', 'ls-files', '-z', '--cached', '--others', '--exclude-standard'],
        cwd=root,
        capture_output=True,
        check=True,
    )
    for name in listed.stdout.decode().split('\0'):
        source = root / name
        if not name or not source.is_file():
            continue
        target = copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
