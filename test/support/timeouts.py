"""Timeouts of tests."""

import faulthandler
import os
import signal
from collections.abc import Iterator
from typing import TextIO

import pytest

# Generous, so that a busy machine does not fail a test; a test that succeeds does not wait longer.
# Shorter than pytest's own timeout.
PATIENCE_S = 300.0
# Time limit of a program from its start to its end.
PROGRAM_S = 800.0
# Of each test, s: limits it by its CPU time, however busy the machine is.
CPU_LIMIT = 'THINMAP_TEST_CPU_S'


@pytest.fixture(autouse=True)
def limited_cpu_time(request: pytest.FixtureRequest) -> Iterator[None]:
    """End the run with the stack of the test once it exceeds the limit.

    Also within a compiled kernel, which Python does not interrupt. Without the variable: no limit.
    """
    limit_s = float(os.environ.get(CPU_LIMIT, '0'))
    if not limit_s:
        yield
        return
    with _screen(request) as screen:
        faulthandler.register(signal.SIGPROF, screen, chain=True)
        signal.setitimer(signal.ITIMER_PROF, limit_s)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            faulthandler.unregister(signal.SIGPROF)


def _screen(request: pytest.FixtureRequest) -> TextIO:
    """Standard error, past the capture of pytest, whose files are lost with the process."""
    capture = request.config.pluginmanager.getplugin('capturemanager')
    with capture.global_and_fixture_disabled():
        return os.fdopen(os.dup(2), 'w', encoding='utf-8')
