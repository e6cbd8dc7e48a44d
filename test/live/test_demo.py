"""The demo as documented: the whole live graph, faster than real time."""

import contextlib
import json
import random
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import psutil
import pytest
from support.forks import forked
from support.hidden_library import hide
from support.timeouts import PATIENCE_S, PROGRAM_S

from thinmap_ros.files import occupancy_maps
from thinmap_ros.logs.readers.bag import Bag

pytestmark = pytest.mark.live
REPORT = {
    'finished',
    'reason',
    'coverage',
    'distance',
    'time',
    'distance_at',
    'time_at',
    'collisions',
    'end_nodes_seen',
    'end_nodes_visited',
    'pose_rmse',
    'pose_rmse_aligned',
}
TOPICS = {
    '/scan',
    '/odom',
    '/pose',
    '/map',
    '/grid',
    '/local_grid',
    '/topology',
    '/local_topology',
    '/end_nodes',
    '/cmd_vel',
}


def demo(out, *arguments):
    command = [sys.executable, '-m', 'thinmap_ros.tools.demo', '-o', str(out), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def nodes_of(out):
    """Processes of a demo.

    Each has the folder of results in its arguments, or is a child of such a process.
    """
    found = []
    for process in psutil.process_iter(['cmdline']):
        if any(str(out) in part for part in process.info['cmdline'] or ()):
            found.append(process)
    return found


@pytest.mark.cpu_budget(60.0, 'a whole exploration, by nodes that start as those of a user')
def test_the_robot_explores_the_room_and_stops_by_itself(ros_domain, tmp_path):
    process = demo(tmp_path / 'demo', '--rate', '20', '--seed', '4', '--speed-m-s', '0.5')
    stdout, stderr = process.communicate(timeout=PROGRAM_S)
    assert process.returncode == 0, stderr
    out = tmp_path / 'demo'
    report = json.loads((out / 'report.json').read_text())
    assert set(report) >= REPORT
    assert report['finished'] and 'resolved' in report['reason']
    assert report['coverage'] >= 0.97
    assert report['collisions'] == 0
    assert report['pose_rmse'] < 0.05
    assert report['end_nodes_visited'] < report['end_nodes_seen']
    assert report['reason'] in stdout
    assert occupancy_maps.read_map(out / 'map.yaml').free.sum() > 8000
    assert len(json.loads((out / 'topology.geojson').read_text())['features']) > 5
    assert np.loadtxt(out / 'trajectory.tum').shape[1] == 8
    assert (out / 'summary.png').stat().st_size > 10_000
    page = (out / 'report.html').read_text()
    assert 'room_10x10' in page and 'thinmap demo ' in page
    assert f'pictures and figures: {out / "report.html"}' in stdout
    steps = [shlex.split(line) for line in stdout.partition('try next')[2].splitlines()[1:]]
    assert [step[:2] for step in steps] == [
        ['thinmap', name] for name in ('explore_world', 'replay', 'demo')
    ]
    # The first two are quick, and need no graph.
    for step in steps[:2]:
        done = forked.run('thinmap_ros', *step[1:], timeout=PROGRAM_S)
        assert done.returncode == 0, done.stderr
        assert (Path(step[-1]) / 'report.html').exists()
    bag = Bag(out / 'bag')
    assert set(bag.topics) >= TOPICS
    assert not bag.is_truncated
    assert not nodes_of(out)


@pytest.mark.cpu_budget(30.0, 'eight nodes that start as those of a user')
@pytest.mark.parametrize(('robots', 'nodes'), [pytest.param(1, 9, marks=pytest.mark.slow), (2, 8)])
def test_ctrl_c_ends_everything(ros_domain, tmp_path, robots, nodes):
    out = tmp_path / 'demo'
    # Ports below those that the system gives to others.
    port = random.SystemRandom().randrange(20_000, 30_000)
    pages = ('--web', '--web-port', str(port))
    process = demo(out, '--rate', '5', '--robots', str(robots), *pages)
    tree = until_started(process, out, nodes)
    for number in range(robots):
        until_there_is_a_page(process, port + number)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert 'interrupted' in stderr and 'Traceback' not in stderr
    assert not psutil.wait_procs(tree, timeout=PATIENCE_S)[1]
    assert not (out / 'report.json').exists()


@pytest.mark.cpu_budget(30.0, 'nine nodes that start as those of a user')
def test_a_page_stays_open_when_the_exploration_has_ended(ros_domain, tmp_path):
    out = tmp_path / 'demo'
    port = random.SystemRandom().randrange(20_000, 30_000)
    process = demo(out, '--rate', '2', '--time-limit-s', '1', '--web', '--web-port', str(port))
    until_there_is_a_page(process, port)
    until = time.monotonic() + PATIENCE_S
    while not (out / 'report.html').exists():
        assert time.monotonic() < until and process.poll() is None, process.communicate()
        time.sleep(0.1)
    tree = process_tree(process)
    until_there_is_a_page(process, port)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    assert 'the page stays open' in stderr and 'results in' in stdout
    assert not psutil.wait_procs(tree, timeout=PATIENCE_S)[1]


@pytest.mark.slow
def test_two_robots_join_their_maps_and_nothing_is_left(ros_domain, tmp_path):
    """With real localizers and mappers, which do not know the starts of each other."""
    out = tmp_path / 'demo'
    office = ['--world', 'office', '--speed-m-s', '0.4', '--rate', '20', '--time-limit-s', '25']
    process = demo(out, '--robots', '2', *office)
    stdout, stderr = process.communicate(timeout=PROGRAM_S)
    assert process.returncode == 0, stderr
    report = json.loads((out / 'report.json').read_text())
    assert [robot['name'] for robot in report['robots']] == ['robot1', 'robot2']
    assert not report['finished'] and report['reason']
    assert report['collisions'] == 0
    # Each is rounded to a millimetre.
    driven_m = sum(robot['distance'] for robot in report['robots'])
    assert report['distance'] == pytest.approx(driven_m, abs=0.002)
    for robot in report['robots']:
        assert robot['distance'] > 1.0
        assert robot['pose_rmse'] < 0.1
        assert 0.0 <= robot['joined_at'] < 60.0
        off_m, off_deg = robot['join_error']
        assert off_m < 0.15 and off_deg < 1.5
    assert 'joined: robot2: after ' in stdout
    # The joint map holds what both have seen.
    assert occupancy_maps.read_map(out / 'map.yaml').free.sum() * 0.05**2 > 20.0
    assert len(json.loads((out / 'topology.geojson').read_text())['features']) > 5
    for name in ('robot1', 'robot2'):
        assert np.loadtxt(out / f'trajectory_{name}.tum').shape[1] == 8
    assert (out / 'summary.png').stat().st_size > 10_000
    assert 'Maps joined' in (out / 'report.html').read_text()
    topics = {
        f'/{name}/{topic}' for name in ('robot1', 'robot2') for topic in ('scan', 'map', 'tf')
    }
    bag = Bag(out / 'bag')
    assert set(bag.topics) >= topics | {'/merged_map', '/merged_topology', '/join_status', '/clock'}
    assert not bag.is_truncated
    assert not nodes_of(out)


@pytest.mark.cpu_budget(20.0, 'six nodes that start as those of a user')
def test_a_robot_whose_nodes_die_ends_the_demo_and_leaves_nothing(ros_domain, tmp_path):
    out = tmp_path / 'demo'
    process = demo(out, '--robots', '2', '--rate', '5')
    tree = until_started(process, out, 6)
    (robot,) = [each for each in tree if '__ns:=/robot2' in each.cmdline()]
    robot.kill()
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2
    assert 'robot2 ended early with code -9' in stderr and 'Traceback' not in stderr
    assert not psutil.wait_procs(tree, timeout=PATIENCE_S)[1]
    assert not (out / 'report.json').exists()


def until_started(process, out, count):
    """The processes of a demo that has so many, and a bag."""
    until = time.monotonic() + PATIENCE_S
    while not (out / 'bag').exists() or len(process_tree(process)) < count:
        assert time.monotonic() < until and process.poll() is None, process.communicate()
        time.sleep(0.1)
    return process_tree(process)


def until_there_is_a_page(process, port):
    until = time.monotonic() + PATIENCE_S
    while True:
        assert time.monotonic() < until and process.poll() is None, process.communicate()
        with contextlib.suppress(OSError), urlopen(f'http://127.0.0.1:{port}/') as page:
            assert b'thinmap' in page.read()
            return
        time.sleep(0.1)


def process_tree(process):
    return psutil.Process(process.pid).children(recursive=True)


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (['--world', 'atlantis'], 'atlantis'),
        (['--robot', '4wd'], '4wd'),
        (['--rate', 'fast'], 'fast'),
        (['--robots', '0'], '--robots=0: expected 1 to 9'),
        (['--robots', '2', '--view'], '--view: '),
        (['--web', '--web-port', '65536'], '--web-port=65536: expected 1 to 65535'),
        (['--robots', 'two'], 'two'),
    ],
)
def test_wrong_arguments_end_at_once(tmp_path, arguments, said):
    done = forked.run(
        'thinmap_ros.tools.demo', '-o', tmp_path / 'demo', *arguments, timeout=PATIENCE_S
    )
    assert done.returncode == 2
    assert said in done.stderr and 'Traceback' not in done.stderr


def test_without_rerun_a_view_is_refused_before_anything_is_started(
    tmp_path, tmp_path_factory, monkeypatch
):
    hide('rerun', tmp_path_factory.mktemp('hidden'), monkeypatch)
    process = demo(tmp_path / 'out', '--view')
    said = process.communicate(timeout=PATIENCE_S)[1].splitlines()
    assert process.returncode == 2
    assert said == [
        "demo: error: --view: rerun is not installed: pip install 'rerun-sdk>=0.41,<0.42'"
    ]
    assert not (tmp_path / 'out').exists()
