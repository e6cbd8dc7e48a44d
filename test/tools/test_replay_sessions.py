"""The program replay saves sessions and continues in them; errors are one line."""

import json
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.carmen_log import carmen_lines
from support.forks import forked
from support.timeouts import PATIENCE_S

from thinmap_ros.files import sessions
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.sessions import KEYFRAMES, PARTS

pytestmark = pytest.mark.programs


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return forked.run('thinmap_ros.tools.replay', *arguments, '--quiet')


def report_of(out: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((out / 'report.json').read_text())
    return report


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log, its session `scans`, and one of line features, `lines`."""
    folder = tmp_path_factory.mktemp('logs')
    log = folder / 'log.clf'
    log.write_text('\n'.join(carmen_lines()) + '\n')
    for name, slam in (('scans', 'scan_matching'), ('lines', 'ekf_ti')):
        done = run(log, '-o', folder / name, '--session', folder / name, '--slam', slam)
        assert done.returncode == 0, done.stderr
    return folder


def test_a_session_has_the_map_of_the_outputs_and_the_report_names_it(folder: Path) -> None:
    for name, has_keyframes in (('scans', True), ('lines', False)):
        stem = str(folder / name)
        saved = [part.name for part in PARTS if part.exists(stem)]
        expected = ['grid', 'topology', 'regions', 'localizer', 'keyframes']
        assert saved == expected[: 5 if has_keyframes else 4]
        mapped = read_map(folder / name / 'map.yaml', keeps_unknown=True)
        grid = sessions.load_grid(stem).known_area()
        assert np.array_equal(grid.occupied, mapped.occupied)
        report = report_of(folder / name)
        assert (report['session'], report['continued']) == (stem, '')
        assert len(sessions.load_topology(stem).map.nodes) == report['nodes']


@pytest.mark.parametrize(('name', 'slam'), [('scans', 'scan_matching'), ('lines', 'ekf_ti')])
def test_a_session_is_continued_and_replaced(
    folder: Path, tmp_path: Path, name: str, slam: str
) -> None:
    for file in folder.glob(f'{name}.*'):
        shutil.copy(file, tmp_path)
    stem = tmp_path / name
    before = sessions.load_grid(str(stem)).known_area().occupied.sum()
    again = ('--continue', stem, '--session', stem, '--slam', slam)
    done = run(folder / 'log.clf', '-o', tmp_path / 'out', *again)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f'{stem}.pgm, ')
    report = report_of(tmp_path / 'out')
    assert (report['session'], report['continued']) == (str(stem), str(stem))
    after = sessions.load_grid(str(stem)).known_area().occupied.sum()
    assert before <= after < 1.3 * before
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    assert np.abs(trajectory[:, 1] - 0.03 * np.arange(30)).max() < 0.03


def test_without_its_name_a_session_stays_as_it_is(folder: Path, tmp_path: Path) -> None:
    before = {file: file.read_bytes() for file in folder.glob('scans.*')}
    done = run(folder / 'log.clf', '-o', tmp_path, '--continue', folder / 'scans')
    assert done.returncode == 0, done.stderr
    assert report_of(tmp_path)['session'] == ''
    assert {file: file.read_bytes() for file in folder.glob('scans.*')} == before


def test_a_start_is_a_pose_in_the_map_of_the_session(folder: Path, tmp_path: Path) -> None:
    """The session began where it says, and the log is driven there again."""
    words = ('--continue', folder / 'scans', '--start', '0.02,-0.03,0.01')
    assert run(folder / 'log.clf', '-o', tmp_path, *words).returncode == 0
    trajectory = np.loadtxt(tmp_path / 'trajectory.tum')
    assert np.abs(trajectory[1:, 1] - 0.03 * np.arange(1, 30)).max() < 0.03
    assert report_of(tmp_path)['lost'] <= 2


def test_a_lost_replay_names_the_start(folder: Path, tmp_path: Path) -> None:
    words = ('--continue', folder / 'scans', '--start', '40,40,1')
    done = run(folder / 'log.clf', '-o', tmp_path, *words)
    assert done.returncode == 0
    assert f'--start X,Y,YAW: where in {folder / "scans"} it starts' in done.stderr


def test_a_map_of_map_server_is_continued_and_not_corrected(folder: Path, tmp_path: Path) -> None:
    words = ('--continue', folder / 'scans' / 'map.yaml', '--session', tmp_path / 'more')
    done = run(folder / 'log.clf', '-o', tmp_path, *words)
    assert done.returncode == 0, done.stderr
    (line,) = done.stderr.splitlines()
    assert 'no keyframes: the map is extended, and not corrected when a loop closes' in line
    assert not KEYFRAMES.exists(str(tmp_path / 'more'))
    assert sessions.load_topology(str(tmp_path / 'more')).map.nodes


WRONG = {
    'no session': (['--continue', 'nothing'], 'neither nothing.grid.npz nor nothing.yaml exists'),
    'of scans': (['--continue', 'scans', '--slam', 'ekf_full'], 'expected one of slam: ekf_full'),
    'of lines': (['--continue', 'lines'], 'lines.slam.npz: map of another localizer: expected one'),
    'no features': (['--continue', 'scans/map.yaml', '--slam', 'ekf_ti'], 'line features'),
    'several logs': (['log.clf', '--session', 'both'], 'expected one log'),
    'continued by several': (['log.clf', '--continue', 'scans'], 'expected one log'),
    'start of nothing': (['--start', '1,2,0'], '--start 1,2,0: expected --continue'),
    'start of two numbers': (['--continue', 'scans', '--start', '1,2'], 'expected "X,Y,YAW"'),
    'no mapping': (['--session', 'new', '--params-file', 'given.yaml'], 'expected mode: mapping'),
    'foreign file': (['--session', 'foreign'], 'foreign.grid.npz: exists, and was not written by'),
    'below a file': (['--session', 'log.clf/a'], 'log.clf is a file: expected a folder'),
    'no name': (['--session', '/'], "'/': expected the path of a session"),
    'no grid': (['--continue', 'foreign'], 'foreign.grid.npz: File is not a zip file: expected'),
}


@pytest.mark.parametrize('case', WRONG)
def test_wrong_sessions_are_one_line_and_nothing_is_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    words, expected = WRONG[case]
    monkeypatch.chdir(folder)
    Path('foreign.grid.npz').write_text('mine')
    Path('given.yaml').write_text('/**: {ros__parameters: {mode: localization}}')
    before = sorted(folder.rglob('*'))
    done = run('log.clf', *words, '-o', 'wrong')
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith('replay: error: ') and expected in line, line
    assert sorted(folder.rglob('*')) == before


def test_ctrl_c_saves_the_session_of_what_was_mapped(tmp_path: Path) -> None:
    laps = [line for lap in range(100) for line in carmen_lines(80, start_s=20.0 * lap)]
    (tmp_path / 'long.log').write_text('\n'.join(laps) + '\n')
    command = [sys.executable, '-m', 'thinmap_ros.tools.replay', 'long.log', '-o', 'out']
    with subprocess.Popen(
        [*command, '--session', 'half'], stderr=subprocess.PIPE, cwd=tmp_path
    ) as replaying:
        assert replaying.stderr is not None
        shown = b''
        while not re.search(rb'replay: .*[1-9][0-9]+ of [0-9]+ scans\n', shown):
            more = replaying.stderr.read1()  # type: ignore[attr-defined]
            assert more, shown
            shown += more
        replaying.send_signal(signal.SIGINT)
        replaying.communicate(timeout=PATIENCE_S)
    assert replaying.returncode == 130
    report = report_of(tmp_path / 'out')
    assert report['ended_by'] == 'KeyboardInterrupt'
    assert report['session'] == str(tmp_path / 'half')
    mapped = read_map(tmp_path / 'out' / 'map.yaml', keeps_unknown=True)
    grid = sessions.load_grid(report['session']).known_area()
    assert np.array_equal(grid.occupied, mapped.occupied)
