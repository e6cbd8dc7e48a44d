"""Release: real steps are run, skipped, limited, interrupted and continued."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.catalogue import BENCHMARKS
from benchmarks.kidnapped.cases import ROWS
from benchmarks.release import (
    MAX_MINUTES,
    Folders,
    State,
    Step,
    listing,
    matching,
    read_state,
    run_steps,
    steps,
)
from thinmap_ros.core.errors import ConfigError, InputError

ROOT = Path(__file__).resolve().parents[2]
ALL = steps(Folders(Path('out'), Path('docs'), Path('shared/data')))
HOUR_S = 3600.0
# A release of two steps in a program of its own, which a test interrupts.
PROGRAM = """
import sys
from pathlib import Path
from benchmarks.release import run_steps
from benchmarks.release import read_state
from benchmarks.release import Step
folder = Path(sys.argv[1])
pid = str(folder / 'pid')
child = f"import os, time; open({pid!r}, 'w').write(str(os.getpid())); time.sleep(600)"
wait = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
chosen = [
    Step('first', (sys.executable, '-c', 'print(1)'), 1),
    Step('second', (sys.executable, '-c', wait), 1),
]
run_steps(chosen, folder, read_state(folder, 'abc', 'a machine'), 3600.0)
"""


def python(name: str, code: str, needs: tuple[str, ...] = ()) -> Step:
    return Step(name, (sys.executable, '-c', code), 1, needs)


def new(folder: Path) -> State:
    return read_state(folder, 'abc', 'a machine')


def test_all_steps_fit_into_the_time_and_come_after_what_they_need():
    names = [step.name for step in ALL]
    assert len(set(names)) == len(names)
    assert sum(step.minutes for step in ALL) <= MAX_MINUTES
    for number, step in enumerate(ALL):
        assert set(step.needs) <= set(names[:number])
        assert step.needs or not step.name.startswith('page.')


def test_all_that_the_pages_show_is_measured():
    names = {step.name for step in ALL}
    assert {f'localization.{row}' for row in ROWS} <= names
    assert {f'speed.{each.name}' for each in BENCHMARKS.values() if each.title} <= names


@pytest.mark.programs
def test_a_finished_step_is_not_run_again_and_a_failed_one_is(tmp_path):
    note = tmp_path / 'note'
    code = f"print('hello'); open({str(note)!r}, 'a').write('x')"
    chosen = [
        python('first', code),
        python('second', f'import sys; sys.exit(0 if len(open({str(note)!r}).read()) > 1 else 3)'),
        python('third', '', needs=('first', 'second')),
    ]
    failed = run_steps(chosen, tmp_path, new(tmp_path), HOUR_S)
    assert failed == {'second': 'exit code 3: no output', 'third': 'needs second'}
    assert (tmp_path / 'logs' / 'first.txt').read_text() == 'hello\n'
    note.write_text('xx')
    assert run_steps(chosen, tmp_path, new(tmp_path), HOUR_S) == {}
    assert note.read_text() == 'xx'
    words = json.loads((tmp_path / 'state.json').read_text())
    assert (words['commit'], words['machine']) == ('abc', 'a machine')
    assert list(words['steps']) == ['first', 'second', 'third']
    assert words['steps']['first']['command'] == list(chosen[0].command)


@pytest.mark.programs
def test_a_step_ends_at_its_limit_and_none_starts_after_the_last(tmp_path):
    slow = python('slow', 'import time; time.sleep(600)')
    assert run_steps([slow], tmp_path, new(tmp_path), 1.0) == {'slow': 'not finished after 1 s'}
    failed = run_steps([python('late', '')], tmp_path, new(tmp_path), 0.0)
    assert failed == {'late': 'no time is left: the same command continues'}


@pytest.mark.programs
def test_an_interrupted_release_continues(tmp_path):
    shell = {**os.environ, 'PYTHONPATH': f'{ROOT}:{os.environ.get("PYTHONPATH", "")}'}
    process = subprocess.Popen([sys.executable, '-c', PROGRAM, str(tmp_path)], env=shell)
    pid = tmp_path / 'pid'
    while not (pid.exists() and pid.read_text()):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait() != 0
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)  # what the step has started has ended with it
    state = new(tmp_path)
    assert list(state.steps) == ['first']
    chosen = [python('first', 'import sys; sys.exit(1)'), python('second', 'print(2)')]
    assert run_steps(chosen, tmp_path, state, HOUR_S) == {}


@pytest.mark.programs
def test_results_of_commits_or_machines_are_not_mixed(tmp_path):
    run_steps([python('first', '')], tmp_path, new(tmp_path), HOUR_S)
    with pytest.raises(InputError, match='commit abc: expected def'):
        read_state(tmp_path, 'def', 'a machine')
    with pytest.raises(InputError, match='machine a machine: expected another'):
        read_state(tmp_path, 'abc', 'another')
    (tmp_path / 'state.json').write_text('{"commit": "abc"}')
    with pytest.raises(InputError, match='damaged'):
        new(tmp_path)


def test_steps_are_listed_and_chosen(tmp_path):
    chosen = matching(ALL, ['page.*', 'speed.mapping'])
    assert {step.name.partition('.')[0] for step in chosen} == {'page', 'speed'}
    lines = listing(chosen, new(tmp_path)).splitlines()
    assert len(lines) == len(chosen) + 2
    assert lines[-1].split() == ['sum', str(sum(step.minutes for step in chosen))]
    with pytest.raises(ConfigError, match=r'--only speed\.maps: expected some of slam\.board'):
        matching(ALL, ['speed.maps'])
