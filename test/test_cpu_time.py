"""`support.cpu_time`: budgets of CPU time for tests and stages."""

import os

import pytest
from support import cpu_time
from support.forks import forked

pytest_plugins = ['pytester']
CONFTEST = f"""
import sys
sys.path.insert(0, {str(forked.TESTS)!r})
pytest_plugins = ['support.cpu_time']
"""
HOME = os.environ['HOME']
TESTS = """
import os, subprocess, sys, time
from pathlib import Path

import numba
import pytest
from support.forks import forked

SPINS = 'import time\\nend = time.process_time() + 0.3\\nwhile time.process_time() < end: pass'

JOBS = (
    'from multiprocessing import get_context\\n'
    f'def spin():\\n exec({SPINS!r})\\n'
    'if __name__ == "__main__":\\n'
    ' job = get_context("forkserver").Process(target=spin)\\n job.start()\\n job.join()\\n'
)

def spin(seconds):
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass

@pytest.fixture
def costly_end():
    yield
    spin(0.3)

@pytest.mark.cpu_budget(0.05, 'planted')
def test_computes():
    spin(0.3)

@pytest.mark.cpu_budget(0.05, 'planted')
def test_ends(costly_end):
    pass

@pytest.mark.cpu_budget(0.05, 'planted')
def test_starts():
    subprocess.run([sys.executable, '-c', SPINS], check=True)

@pytest.mark.cpu_budget(0.05, 'planted')
def test_forks(tmp_path):
    assert forked.server().can_start(os.environ)
    (tmp_path / 'spins.py').write_text(SPINS)
    assert forked.run('spins', folder=tmp_path).returncode == 0

@pytest.mark.cpu_budget(0.05, 'planted')
def test_jobs(tmp_path):
    (tmp_path / 'jobs.py').write_text(JOBS)
    assert forked.run('jobs', folder=tmp_path).returncode == 0

@pytest.mark.cpu_budget(0.2, 'planted')
def test_waits():
    time.sleep(0.3)

@pytest.mark.slow
@pytest.mark.cpu_budget(0.2, 'planted')
def test_slow():
    spin(0.3)

@pytest.mark.cpu_budget(0.2, 'planted')
def test_compiles():
    @numba.njit
    def kernel(values):
        return sorted(values)
    began = time.process_time()
    kernel([3.0, 1.0])
    assert time.process_time() - began > 0.2

@pytest.mark.cpu_budget(0.05, 'planted')
def test_fails():
    spin(0.3)
    raise LookupError('planted')

def test_default():
    spin(0.3)
"""


@pytest.fixture
def run(pytester, monkeypatch):
    """Run tests by name in a run of their own; returns its lines and its exit code."""
    monkeypatch.delenv(cpu_time.STAGE, raising=False)
    # Which pytester has changed, and for which there would be no forks.
    monkeypatch.setenv('HOME', HOME)
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(TESTS)
    pytester.makeini('[pytest]\nmarkers = slow: of the project')

    def run_tests(names, *options):
        done = pytester.runpytest_inprocess('-k', names, *options)
        return done.outlines, done.ret

    return run_tests


@pytest.mark.parametrize('name', ['test_computes', 'test_ends'])
def test_a_test_above_its_budget_fails_with_one_line(run, name):
    lines, code = run(name)
    assert code == pytest.ExitCode.TESTS_FAILED
    # The summary repeats it, as far as the terminal is wide or on a machine for tests.
    (line,) = [each for each in lines if 'CPU time' in each and not each.startswith('ERROR ')]
    assert f'.py::{name}: 0.' in line
    assert line.endswith(' s of CPU time: expected at most 0.05 s')


def test_one_that_fails_has_its_own_reason(run):
    lines, code = run('test_fails')
    assert code == pytest.ExitCode.TESTS_FAILED
    assert not [line for line in lines if 'CPU time' in line]
    assert any('LookupError: planted' in line for line in lines)


@pytest.mark.programs
@pytest.mark.parametrize(
    ('name', 'options'),
    [
        ('test_starts', ()),
        ('test_forks', ()),
        ('test_jobs', ()),
        ('test_computes', ('-n', '1')),
    ],
)
def test_processes_of_a_test_count_and_so_do_workers(run, name, options):
    lines, code = run(name, *options)
    assert code == pytest.ExitCode.TESTS_FAILED
    assert any(f'{name}: ' in line and 'at most 0.05 s' in line for line in lines), lines


@pytest.mark.parametrize('name', ['test_waits', 'test_slow', 'test_compiles', 'test_default'])
def test_neither_waiting_nor_compiling_counts_nor_what_is_slow(run, name):
    lines, code = run(name)
    assert code == pytest.ExitCode.OK, lines


def test_a_stage_above_its_budget_fails_and_shows_the_most_expensive_tests(run, monkeypatch):
    monkeypatch.setenv(cpu_time.STAGE, '0.05')
    lines, code = run('test_default or test_waits')
    assert code == pytest.ExitCode.TESTS_FAILED
    costly, cheap, total, machine = lines[-5:-1]
    assert costly.endswith('.py::test_default')
    assert cheap.endswith('test_waits')
    assert total.endswith(' s of CPU time: expected at most 0.05 s')
    assert machine.startswith('this machine takes ')


def test_on_a_slower_machine_a_test_may_take_longer_and_on_a_faster_one_no_less(run, monkeypatch):
    monkeypatch.setattr(cpu_time, '_REFERENCE_S', 1e-6)
    _, code = run('test_computes')
    assert code == pytest.ExitCode.OK
    monkeypatch.setattr(cpu_time, '_REFERENCE_S', 10.0)
    _, code = run('test_computes')
    assert code == pytest.ExitCode.TESTS_FAILED
    _, code = run('test_default')
    assert code == pytest.ExitCode.OK
