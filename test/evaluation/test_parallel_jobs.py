"""Jobs in separate processes: failed ones are reported by name, the others continue."""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import Failure, failure_summary, read_report, run_pending

LONG = """
import argparse, os, time
from dataclasses import dataclass
from pathlib import Path
from thinmap_ros.evaluation.parallel_jobs import run_pending

@dataclass(frozen=True)
class Rest:
    name: str

def rest(job):
    print(os.getpid(), flush=True)
    time.sleep(600.0)

if __name__ == '__main__':
    where = argparse.Namespace(jobs=1, dask='')
    run_pending(rest, [Rest('a')], lambda job: Path(job.name), where, quiet=True)
"""
ONE_CORE = argparse.Namespace(jobs=1, dask='')


@dataclass(frozen=True)
class Sum:
    """Numbers to be summed."""

    name: str
    numbers: tuple[float, ...]


def add(job):
    if job.name == 'rejected':
        raise InputError('refused: no numbers')
    if job.name == 'killed':
        os.kill(os.getpid(), signal.SIGKILL)
    return {'options': list(job.numbers), 'sum': sum(job.numbers), 'process': os.getpid()}


def is_alive(pid):
    """Whether a process runs; a zombie does not."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0] != 'Z'
    except FileNotFoundError:
        return False


def run(folder, jobs, where=ONE_CORE):
    return run_pending(add, jobs, lambda job: folder / f'{job.name}.json', where, quiet=True)


@pytest.mark.programs
@pytest.mark.parametrize('processes', [1, 2])
def test_one_that_fails_is_named_and_the_others_run(
    tmp_path: Path, processes: int, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [
        Sum('a', (1.0, 2.0)),
        Sum('rejected', ()),
        Sum('killed', ()),
        Sum('wrong', ('x',)),
        Sum('b', (4.0,)),
    ]
    failures = run(tmp_path, jobs, argparse.Namespace(jobs=processes, dask=''))
    assert failures['rejected'] == Failure('refused: no numbers')
    assert failures['killed'].reason == 'its process ended with exit code -9'
    assert failures['wrong'].reason.startswith('TypeError: ')
    assert 'in add' in failures['wrong'].trace
    assert 'wrong: TypeError' in capsys.readouterr().err
    assert str(failure_summary(failures)).startswith('3 failed: killed: its process ended')
    reports = [json.loads((tmp_path / f'{name}.json').read_text()) for name in 'ab']
    assert [report['sum'] for report in reports] == [3.0, 4.0]
    assert len({report['process'] for report in reports} | {os.getpid()}) == 3
    assert sorted(path.stem for path in tmp_path.iterdir()) == ['a', 'b']


@pytest.mark.programs
def test_what_is_finished_is_not_run_again(tmp_path: Path) -> None:
    jobs = [Sum('a', (1.0,)), Sum('b', (2.0,))]
    (tmp_path / 'a.json').write_text(json.dumps({'options': [1.0], 'sum': 77.0}))
    assert run(tmp_path, jobs) == {}
    assert read_report(tmp_path / 'a.json', [1.0])['sum'] == 77.0
    assert read_report(tmp_path / 'b.json', [2.0])['sum'] == 2.0
    with pytest.raises(InputError, match='other options'):
        read_report(tmp_path / 'b.json', [3.0])


@pytest.mark.programs
def test_a_cluster_tells_what_fails_as_well(tmp_path: Path) -> None:
    distributed = pytest.importorskip('distributed')
    jobs = [Sum('a', (1.0,)), Sum('rejected', ())]
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        where = argparse.Namespace(jobs=1, dask=cluster.scheduler_address)
        failures = run(tmp_path, jobs, where)
    assert failures == {'rejected': Failure('refused: no numbers')}
    assert read_report(tmp_path / 'a.json', [1.0])['sum'] == 1.0


@pytest.mark.programs
@pytest.mark.parametrize('end', [signal.SIGTERM, signal.SIGKILL])
def test_a_job_ends_with_the_program_that_runs_it(tmp_path: Path, end: signal.Signals) -> None:
    program = tmp_path / 'long.py'
    program.write_text(LONG)
    with subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE) as running:
        assert running.stdout is not None
        job = int(running.stdout.readline())
        running.send_signal(end)
    deadline = time.monotonic() + 60.0
    while is_alive(job) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_alive(job)
