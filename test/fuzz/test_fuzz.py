"""scripts/fuzz finds failures, stores them, continues, and is reproducible."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fuzz.__main__ import main
from fuzz.cases import Source, damaged_bytes, damaged_text, nothing, tried
from fuzz.runner import Runner, rng_of
from fuzz.sources import SOURCES
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.logs.readers import carmen
from thinmap_ros.nodes import grid_mapper
from thinmap_ros.nodes.parts.mapping import ScanQueue

ROOT = Path(__file__).resolve().parents[2]
HOURS_S = 1e9
LINE = 'FLASER 3 1.00 2.50 3.00 0 0 0 0.5 -0.25 1.5 976052857.337530 host 0.1\n'


def fails(shared: None, rng: np.random.Generator, folder: Path) -> None:
    """Writes a number; every third case fails."""
    number = int(rng.integers(300))
    (folder / 'number').write_text(str(number))
    if number % 3 == 0:
        raise ZeroDivisionError(f'by {number}')


def tried_once(
    tmp_path: Path, run: object, cases: int = 12, **limits: float
) -> tuple[Runner, Path]:
    runner = Runner([Source('s', nothing, run)], 5, tmp_path, **limits)  # type: ignore[arg-type]
    runner.run(time.monotonic() + HOURS_S, cases)
    return runner, tmp_path / '5'


def test_what_fails_is_kept_with_its_input_and_its_traceback(tmp_path: Path) -> None:
    runner, kept = tried_once(tmp_path, fails)
    wanted = {i: int(rng_of(5, 's', i).integers(300)) for i in range(12)}
    wrong = [i for i, number in wanted.items() if number % 3 == 0]
    assert 0 < len(wrong) < 12
    assert runner.outcome.failures == [
        ('s', i, f'ZeroDivisionError: by {wanted[i]}') for i in wrong
    ]
    assert runner.outcome.tried['s'] == 12
    for i in wrong:
        assert (kept / f's-{i}' / 'number').read_text() == str(wanted[i])
        assert 'in fails' in (kept / f's-{i}' / 'why.txt').read_text()
    assert sorted(path.name for path in kept.iterdir()) == sorted(
        ['shared', *(f's-{i}' for i in wrong)]
    )


def dies(shared: None, rng: np.random.Generator, folder: Path) -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def hangs(shared: None, rng: np.random.Generator, folder: Path) -> None:
    while True:
        time.sleep(1.0)


def waits(shared: None, rng: np.random.Generator, folder: Path) -> None:
    time.sleep(0.5)


def burns(shared: None, rng: np.random.Generator, folder: Path) -> None:
    # As in a kernel: Python handles no signal before its end.
    sum(repeat(0))


def takes_memory(shared: None, rng: np.random.Generator, folder: Path) -> None:
    np.ones(1 << 40, dtype=np.uint8)


def says_too_much(shared: None, rng: np.random.Generator, folder: Path) -> None:
    def work() -> None:
        raise InputError('no\n' * 2)

    tried(work)


@pytest.mark.parametrize(
    ('run', 'limits', 'why'),
    [
        (dies, {}, 'the process ends with -11'),
        (burns, {'limit_s': 0.2}, 'takes more than 0.2 s of CPU time'),
        (hangs, {'net_s': 2.0}, 'has not ended after 2 s'),
        (takes_memory, {}, 'Unable to allocate'),
        (says_too_much, {}, 'not one line'),
    ],
)
def test_the_run_continues_whatever_a_case_does(
    tmp_path: Path, run: Callable[..., None], limits: dict[str, float], why: str
) -> None:
    runner, kept = tried_once(tmp_path, run, 2, **limits)
    assert [number for _, number, _ in runner.outcome.failures] == [0, 1]
    assert all(why in said for _, _, said in runner.outcome.failures)
    assert why in (kept / 's-1' / 'why.txt').read_text()
    where = (kept / 's-1' / 'died.txt').read_text()
    assert (f'in {run.__name__}' in where) == (run in (dies, burns))


def test_a_case_that_only_waits_is_within_its_limit(tmp_path: Path) -> None:
    runner, _ = tried_once(tmp_path, waits, 2, limit_s=0.2)
    assert runner.outcome.tried['s'] == 2
    assert not runner.outcome.failures


def test_damages_are_the_same_for_a_seed_and_others_for_another() -> None:
    for damage, whole in ((damaged_text, LINE), (damaged_bytes, LINE.encode())):
        made = [[damage(rng_of(seed, 's', i), whole) for i in range(50)] for seed in (1, 1, 2)]
        assert made[0] == made[1]
        assert made[0] != made[2]
        assert len(set(made[0])) > 25


def test_a_planted_fault_is_found_again_by_its_seed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGINT)
    words = ['--only', 'carmen', '--seed', '8', '--cases', '60', '--out', str(tmp_path)]
    assert main(words) == 0
    assert not list(tmp_path.iterdir())

    real = carmen._stamp

    def planted(word: str) -> int:
        if not word[:1].isdigit():
            raise LookupError('planted')
        return real(word)

    monkeypatch.setattr(carmen, '_stamp', planted)
    capsys.readouterr()
    found = []
    for _ in range(2):
        assert main(words) == 1
        found.append(capsys.readouterr().out)
    signal.signal(signal.SIGINT, before)
    assert found[0] == found[1]
    assert ' of carmen: LookupError: planted\n' in found[0]
    assert '--seed 8 --only carmen --first' in found[0]
    assert list((tmp_path / '8').glob('carmen-*/why.txt'))


def never_ends(self: Any, scan: Any) -> list[Any]:
    """A scan from the future blocks all later ones."""
    self._waiting.append(scan)
    return list(self._ready())


class NoScanTwice(ScanQueue):
    """Does not expect a stamp twice."""

    def __init__(self) -> None:
        super().__init__()
        self._stamps: set[int] = set()

    def add_scan(self, localized: Any) -> None:
        if localized.scan.stamp_ns in self._stamps:
            raise LookupError('planted')
        self._stamps.add(localized.scan.stamp_ns)
        super().add_scan(localized)


# By source: object, attribute and its planted value.
PLANTED: dict[str, tuple[Any, str, Any]] = {
    'stream_odometry': (ScanOdometrySynchronizer, 'add_scan', never_ends),
    'stream_mapper': (grid_mapper, 'ScanQueue', NoScanTwice),
}


def failures_of(names: list[str], seed: int, cases: int, planted: str, out: Path) -> list[str]:
    """Failures of some cases of sources; planted: source of the planted fault."""
    if planted:
        setattr(*PLANTED[planted])
    runner = Runner([SOURCES[name] for name in names], seed, out)
    outcome = runner.run(time.monotonic() + HOURS_S, cases)
    assert planted or outcome.tried == dict.fromkeys(names, cases)
    return [text for _, _, text in outcome.failures]


def in_new_process(*arguments: Any) -> list[str]:
    """`failures_of` in a new process: one that has used rclpy cannot be forked."""
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(failures_of, *arguments).result()


@pytest.mark.live
@pytest.mark.cpu_budget(25.0, 'a case of each source, in a fresh process')
def test_each_source_makes_and_tests_a_case(tmp_path: Path) -> None:
    assert in_new_process(list(SOURCES), 1, 1, '', tmp_path) == []


@pytest.mark.live
@pytest.mark.cpu_budget(25.0, 'two fresh processes')
@pytest.mark.parametrize(
    ('source', 'cases', 'why'),
    [
        ('stream_odometry', 40, 'not used after the fault'),
        ('stream_mapper', 20, 'LookupError: planted'),
    ],
)
def test_streams_find_a_planted_fault(tmp_path: Path, source: str, cases: int, why: str) -> None:
    assert in_new_process([source], 7, 3, '', tmp_path) == []
    found = in_new_process([source], 7, cases, source, tmp_path)
    assert any(why in text for text in found)


@pytest.mark.live
def test_ctrl_c_ends_it_with_a_summary(tmp_path: Path) -> None:
    places = [ROOT / 'test', ROOT]
    environment = os.environ | {
        'PYTHONPATH': ':'.join([*map(str, places), os.environ.get('PYTHONPATH', '')])
    }
    process = subprocess.Popen(
        [sys.executable, '-m', 'fuzz', '--only', 'trajectory', '--out', str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=ROOT,
        start_new_session=True,
    )
    assert process.stdout is not None
    seed = process.stdout.readline().split()[1]
    # From here on SIGINT is handled at any time.
    os.killpg(process.pid, signal.SIGINT)
    said = process.communicate(timeout=120.0)[0]
    assert process.returncode == 0
    assert said.splitlines()[-1].startswith(f'interrupted: seed {seed}: ')
