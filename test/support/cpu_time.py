"""A plugin of pytest: the CPU time of each test, and how much it and its stage may take.

Not the time of the clock, which depends on what else the machine does. The time of a test is that
of its fixtures, too (what several tests share counts for the first of them), and of all processes
that it starts and waits for. Kernels that are compiled, as on a machine that is new, do not count,
and tests that are marked as slow may take what they need.

CPU time depends on the machine, and on what else its cores and caches do: the same tests have
taken 170 s and 370 s. So a computation that is always the same is timed around each test, and on a
machine that is slower than the one of the budgets, times are divided by how much longer it takes.
"""

import math
import os
import resource
import statistics
import time
from collections import deque
from collections.abc import Generator

import numpy as np
import pytest
from numba.core import event

# Of a test. One that needs more says why: @pytest.mark.cpu_budget(seconds, 'the reason').
TEST_S = 10.0
# Variable with the budget of all tests of a run that are not slow, s; without it there is none.
STAGE = 'THINMAP_STAGE_CPU_S'
_SHOWN = 10
# CPU time of _reference() where the budgets were set, s. Where it took 0.42 to 0.53 ms, the stages
# took 1.7 to 2.3 times as long as then.
_REFERENCE_S = 0.00025
_MEDIAN_OF = 15
_BEGAN = pytest.StashKey[float]()
_FAILED = pytest.StashKey[bool]()


class _Compilation(event.Listener):
    """CPU time of compiling kernels in this process."""

    def __init__(self) -> None:
        self.spent_s = 0.0
        self._depth = 0

    def on_start(self, _: event.Event) -> None:
        # A kernel is compiled within another one that calls it.
        if not self._depth:
            self.spent_s -= time.process_time()
        self._depth += 1

    def on_end(self, _: event.Event) -> None:
        self._depth -= 1
        if not self._depth:
            self.spent_s += time.process_time()


_compilation = _Compilation()
event.register('numba:compile', _compilation)


def _reference() -> float:
    """CPU time of a computation that is always the same, of calls, dicts and arrays, s."""
    began = time.thread_time()
    counts: dict[int, float] = {}
    row = np.arange(64.0)
    for i in range(1200):
        counts[i % 97] = counts.get(i % 97, 0.0) + math.hypot(i, 1.0)
        if i % 12 == 0:
            row = np.sqrt(row * row + 1.0)
    return time.thread_time() - began


_references: deque[float] = deque(maxlen=_MEDIAN_OF)


def _slowness() -> float:
    """How much longer this machine takes now than the one of the budgets, at least 1."""
    return max(statistics.median(_references) / _REFERENCE_S, 1.0)


def _cpu_s() -> float:
    """CPU time of this process and of those that it has waited for, without compilation."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used) - _compilation.spent_s


def _budget_s(seconds: float, reason: str) -> float:
    """Budget by a mark: both have to be there."""
    assert reason
    return seconds


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption('--cpu', type=int, default=0, metavar='N', help='show N tests by CPU time')


def pytest_configure(config: pytest.Config) -> None:
    mark = 'cpu_budget(seconds, reason): CPU time that the test may take'
    config.addinivalue_line('markers', mark)
    if not hasattr(config, 'workerinput'):
        config.pluginmanager.register(_Stage(config.option.cpu))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    _references.append(_reference())
    item.stash[_BEGAN] = _cpu_s()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """At the end of a test: note its time, and let it fail above its budget.

    One that has failed has its own reason, and may have waited for what never came.
    """
    report = yield
    item.stash[_FAILED] = item.stash.get(_FAILED, False) or report.failed
    if call.when != 'teardown' or item.get_closest_marker('slow'):
        return report
    used_s = _cpu_s() - item.stash[_BEGAN]
    _references.append(_reference())
    report.slowness = _slowness()
    spent_s = report.cpu_s = used_s / report.slowness
    mark = item.get_closest_marker('cpu_budget')
    budget_s = _budget_s(*mark.args) if mark else TEST_S
    if not item.stash[_FAILED] and spent_s > budget_s:
        report.outcome = 'failed'
        report.longrepr = f'{item.nodeid}: {_above(spent_s, budget_s)}'
    return report


def _above(spent_s: float, budget_s: float) -> str:
    return f'{spent_s:.1f} s of CPU time: expected at most {budget_s:g} s'


class _Stage:
    """The CPU time of all tests of a run. shown: of how many to show it in any case."""

    def __init__(self, shown: int) -> None:
        self._shown = shown
        self._budget_s = float(os.environ.get(STAGE) or 'inf')
        self._spent_s: dict[str, float] = {}
        self._slowness: list[float] = []

    @property
    def _sum_s(self) -> float:
        return sum(self._spent_s.values())

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        # Workers send what their reports hold.
        if hasattr(report, 'cpu_s'):
            self._spent_s[report.nodeid] = report.cpu_s
            self._slowness.append(report.slowness)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self._sum_s > self._budget_s and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        is_above = self._sum_s > self._budget_s
        costly = sorted(self._spent_s.items(), key=lambda test: -test[1])
        for name, spent_s in costly[: max(self._shown, _SHOWN if is_above else 0)]:
            terminalreporter.write_line(f'{spent_s:6.1f} s  {name}')
        if is_above:
            terminalreporter.write_line(f'all tests: {_above(self._sum_s, self._budget_s)}')
        elif STAGE in os.environ or self._shown:
            terminalreporter.write_line(f'all tests: {self._sum_s:.0f} s of CPU time')
        if self._slowness and (is_above or STAGE in os.environ or self._shown):
            times = f'{statistics.median(self._slowness):.2f} times the time of its budgets'
            terminalreporter.write_line(f'this machine takes {times}')
