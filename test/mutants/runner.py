"""Tests mutants in a copy of the project, each with the tests of its module."""

import contextlib
import enum
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from mutants.mutations import Mutation
from mutants.selection import Selection

_MOST_MEMORY = 8 * 2**30  # bytes: a mutant may allocate any amount
# Exit codes of pytest: no test was found; tests failed, without naming one; wrong usage.
_NO_TESTS = 5
_NO_RESULT = (1, 4)
_FAILED = re.compile(r'^(?:FAILED|ERROR) (\S+)', re.MULTILINE)


class Fate(enum.Enum):
    """Outcome of a mutant."""

    KILLED = 'killed'
    TIMED_OUT = 'timed out'
    SURVIVED = 'survived'


@dataclass(frozen=True)
class Result:
    """Outcome of a mutant, and the test that has found it."""

    mutation: Mutation
    fate: Fate
    test: str = ''


class Workshop:
    """A copy of the project in which one module at a time is mutated."""

    def __init__(self, root: Path, package: str, folder: Path) -> None:
        self._root = root
        self._copy = folder / 'tree'
        self._kernels = folder / 'kernels'
        self._kernels_used = folder / 'kernels_used'
        _copy_project(root, self._copy)
        beside_package = root / package / '__pycache__' / 'kernels'
        if beside_package.is_dir():
            shutil.copytree(beside_package, self._kernels)
        self._kernels.mkdir(exist_ok=True)
        # By content: a mutant of the same size and time must not be taken for the original.
        command = ['-m', 'compileall', '-q', '--invalidation-mode', 'checked-hash', package]
        subprocess.run([sys.executable, *command], cwd=self._copy, check=True)
        self._selection = Selection(self._copy, package)

    def run(self, mutation: Mutation, limit_s: float) -> Result:
        """Test a mutant; its path is relative to the project."""
        module = self._copy / mutation.path
        tests = [str(test) for test in self._selection.tests_of(module)]
        if not tests:
            return Result(mutation, Fate.SURVIVED)
        original = module.read_bytes()
        module.write_bytes(mutation.applied(original))
        try:
            code, output = self._pytest(tests, limit_s)
        finally:
            module.write_bytes(original)
        if code is None:
            return Result(mutation, Fate.TIMED_OUT)
        if code in (0, _NO_TESTS):
            return Result(mutation, Fate.SURVIVED)
        failed = _FAILED.search(output)
        if failed is None and code in _NO_RESULT:
            raise SystemExit(f'mutants: pytest ended with {code}: {output.strip()[-300:]}')
        return Result(mutation, Fate.KILLED, failed[1] if failed else '')

    def failures_without_mutant(self, tests: list[str], limit_s: float) -> list[str]:
        """Tests that fail in the unmodified copy, and so prove nothing."""
        if not tests:
            return []
        _, output = self._pytest(tests, limit_s, '--maxfail=1000000')
        return _FAILED.findall(output)

    def _pytest(self, tests: list[str], limit_s: float, *options: str) -> tuple[int | None, str]:
        """Exit code (None after the time limit) and output."""
        command = [sys.executable, '-m', 'pytest', '-x', '-q', '-rfE', '--tb=no', '--no-header']
        command += ['-p', 'no:cacheprovider', '-m', 'not slow and not live', *options, *tests]
        process = subprocess.Popen(
            command,
            cwd=self._copy,
            env=self._environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=_limit_memory,
        )
        try:
            output, _ = process.communicate(timeout=limit_s)
        except subprocess.TimeoutExpired:
            return None, ''
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        return process.returncode, output

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


def _limit_memory() -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, hard))


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
