"""Progress on terminals and in files."""

import io

import pytest

from thinmap_ros.view import progress_bar
from thinmap_ros.view.progress_bar import ProgressBar


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress_bar.time, 'monotonic', lambda: now[0])
    return now


def test_a_terminal_has_one_line_with_share_and_text():
    terminal = Terminal()
    with ProgressBar('replay', stream=terminal) as bar:
        for k in range(100):
            bar.show(k / 100.0, f'{k} of 100 scans')
        bar._bar.refresh()
    shown = terminal.getvalue()
    assert shown.count('\n') == 1 and '\r' in shown
    assert 'replay:  99%' in shown and '99 of 100 scans' in shown


@pytest.mark.parametrize('stream', [Terminal(), io.StringIO()])
def test_lines_that_stay(stream):
    with ProgressBar('runs', stream=stream) as bar:
        bar.show(0.5, '1 of 2')
        bar.write('office: no such world')
    lines = [line.rsplit('\r')[-1] for line in stream.getvalue().splitlines()]
    assert 'office: no such world' in lines


def test_a_terminal_shows_counts_without_a_total():
    terminal = Terminal()
    with ProgressBar('replay', stream=terminal) as bar:
        bar.show(None, '7 scans')
        bar._bar.refresh()
    assert '7 scans' in terminal.getvalue() and '%' not in terminal.getvalue().split('\r')[-1]


def test_a_file_has_a_line_now_and_then(clock):
    file = io.StringIO()
    with ProgressBar('explore_world', stream=file) as bar:
        for k in range(400):
            clock[0] = 100.0 + 0.1 * k
            bar.show(None if k > 300 else k / 400.0, f'{k} s')
    assert file.getvalue().splitlines() == [
        'explore_world: 5 %, 20 s',
        'explore_world: 42 %, 170 s',
        'explore_world: 320 s',
    ]


def test_a_short_run_writes_nothing_to_a_file(clock):
    file = io.StringIO()
    with ProgressBar('replay', stream=file) as bar:
        bar.show(1.0, 'all')
    assert file.getvalue() == ''


@pytest.mark.parametrize('stream', [Terminal(), io.StringIO()])
def test_quiet_is_quiet(clock, stream):
    with ProgressBar('replay', quiet=True, stream=stream) as bar:
        clock[0] += 100.0
        bar.show(0.5, 'half')
    assert stream.getvalue() == ''
