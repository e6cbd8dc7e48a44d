"""scripts/test: its stages by name, and every test in one of them."""

import ast
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from support.timeouts import CPU_LIMIT

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.programs
def test_a_wrong_stage_is_one_line_and_exit_code_2() -> None:
    command = [str(ROOT / 'scripts' / 'test'), 'units']
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ''
    assert done.stderr.startswith('scripts/test: units: expected')
    assert done.stderr.endswith('a stage: lint unit without-ros live browser bounds\n')
    assert done.stderr.count('\n') == 1


def test_every_test_is_in_one_stage(request: pytest.FixtureRequest) -> None:
    for item in request.session.items:
        marks = {mark.name for mark in item.iter_markers()}
        assert len(marks & {'programs', 'live', 'browser'}) <= 1, item.nodeid


def test_what_test_modules_share_is_in_support() -> None:
    tests = {path.stem: path for path in (ROOT / 'test').rglob('test_*.py')}
    for path in tests.values():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                assert node.module.split('.')[-1] not in tests, f'{path}: {node.module}'


SPINS_AND_WAITS = """
import itertools
import time

from support.timeouts import limited_cpu_time

def test_waits():
    time.sleep(1.0)

def test_spins():
    sum(itertools.repeat(0))
"""


@pytest.mark.programs
@pytest.mark.parametrize('name', ['test_waits', 'test_spins'])
def test_a_test_is_limited_by_its_cpu_time(tmp_path: Path, name: str) -> None:
    (tmp_path / 'test_both.py').write_text(SPINS_AND_WAITS)
    done = subprocess.run(
        [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', '-k', name, str(tmp_path)],
        cwd=tmp_path,
        env={**os.environ, CPU_LIMIT: '0.5', 'PYTHONPATH': str(ROOT / 'test')},
        capture_output=True,
        text=True,
    )
    assert done.returncode == (0 if name == 'test_waits' else -signal.SIGPROF), done.stdout
    assert ('in test_spins' in done.stderr) == (name == 'test_spins')
