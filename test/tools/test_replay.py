"""The program replay: its files, its figures, and errors of one line."""

import gzip
import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager

import numpy as np
import pytest
from support.carmen_log import BEAMS, carmen_lines
from support.forks import forked
from support.hidden_library import hide
from support.timeouts import PATIENCE_S

from thinmap_ros.core.errors import one_line_reason
from thinmap_ros.core.grid.mapper import Mapper
from thinmap_ros.files import occupancy_maps
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.log import LaserOptions
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.pipeline import PipelineConfig
from thinmap_ros.replaying import replay
from thinmap_ros.tools.carmen_to_bag import convert
from thinmap_ros.tools.replay import ReplayView, main
from thinmap_ros.view import rerun_sinks
from thinmap_ros.view.interface import NullView

TRAJECTORIES = {'trajectory.tum', 'trajectory_final.tum'}
FILES = TRAJECTORIES | {'map.pgm', 'map.yaml', 'topology.geojson', 'summary.png', 'report.json'}
FILES |= {'report.html'}
needs_rerun = pytest.mark.skipif(
    not rerun_sinks.is_installed(),
    reason='needs rerun, which is not installed (the extra "viewer")',
)


def run(*arguments):
    return forked.run('thinmap_ros.tools.replay', *arguments)


@pytest.fixture
def log(tmp_path):
    path = tmp_path / 'log.clf'
    path.write_text('\n'.join(carmen_lines()) + '\n')
    return path


@pytest.mark.programs
@pytest.mark.parametrize('form', ['plain', 'gzip', 'bag', 'mcap'])
def test_files_and_figures(log, tmp_path, form):
    if form == 'gzip':
        packed = tmp_path / 'log.clf.gz'
        packed.write_bytes(gzip.compress(log.read_bytes()))
        log = packed
    elif form != 'plain':
        bag = tmp_path / ('bag' if form == 'bag' else 'bag.mcap')
        convert(CarmenLog(log, LaserOptions()), bag)
        log = bag
    out = tmp_path / 'out'
    done = run(log, '-o', out)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in out.iterdir()} == FILES
    report = json.loads((out / 'report.json').read_text())
    assert (report['scans'], report['skipped']) == (30, 0)
    assert report['distance'] == pytest.approx(0.87, abs=0.05)
    assert set(report['ms_per_scan']) == {'localizer', 'grid', 'all'}
    assert 0.0 < report['graph_ms'] < 1000.0 * report['cpu_s']
    assert report['cpu_ms_per_scan'] == pytest.approx(1000.0 * report['cpu_s'] / 30, abs=0.1)
    assert f'{report["cpu_ms_per_scan"]:.1f} ms of CPU a scan' in done.stdout
    trajectory = np.loadtxt(out / 'trajectory.tum')
    assert trajectory.shape == (30, 8)
    assert np.abs(trajectory[:, 1] - 0.03 * np.arange(30)).max() < 0.03
    patch = occupancy_maps.read_map(out / 'map.yaml')
    wall = patch.frame.cells_of(np.array([[3.0, 0.0]]))[0]
    assert patch.occupied[wall[0], wall[1] - 1 : wall[1] + 2].any()


@pytest.mark.programs
def test_contradictory_scans_are_mapped_with_a_warning(log, tmp_path):
    whole = tmp_path / 'whole'
    convert(CarmenLog(log, LaserOptions()), whole)
    bag = Bag(whole)
    with BagWriter(tmp_path / 'bag') as writer:
        for message in bag.messages():
            decoded = bag.decode(message)
            if message.topic == '/scan':
                decoded.angle_max *= 2.0
            writer.write(message.topic, message.type_name, message.log_ns, decoded)
    done = run(tmp_path / 'bag', '-o', tmp_path / 'out', '--quiet')
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    (warning,) = report['warnings']
    assert 'fits 271 beams, 181 came' in warning and report['scans'] == 30
    assert f'replay: warning: {warning}' in done.stderr
    assert 'fits 271 beams' in (tmp_path / 'out' / 'report.html').read_text()


@pytest.mark.programs
@pytest.mark.parametrize('slam', ['scan_matching', 'ekf_ti', 'ekf_full'])
def test_each_localizer_replays_it(tmp_path, slam):
    log = tmp_path / 'log.clf'
    log.write_text('\n'.join(carmen_lines(scans=60)) + '\n')
    done = run(log, '-o', tmp_path / 'out', '--slam', slam)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert (report['scans'], report['skipped']) == (60, 0)
    assert (report['features'] == 0) == (slam == 'scan_matching')
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    assert np.abs(trajectory[:, 1] - 0.03 * np.arange(60)).max() < 0.05


@pytest.mark.programs
def test_the_localizer_is_the_scan_matcher_by_default(log, tmp_path):
    for name, options in (
        ('default', []),
        ('scans', ['--slam', 'scan_matching']),
        ('filter', ['--slam', 'ekf_ti']),
    ):
        assert run(log, '-o', tmp_path / name, *options).returncode == 0
    default, scans, by_filter = (
        (tmp_path / name / 'trajectory.tum').read_bytes() for name in ('default', 'scans', 'filter')
    )
    assert default == scans != by_filter


@pytest.mark.programs
@pytest.mark.parametrize('share', [0.5, 0.97])
def test_a_cut_off_bag_is_replayed_as_far_as_bag_repair_reads_it(log, tmp_path, share):
    convert(CarmenLog(log, LaserOptions()), tmp_path / 'bag.mcap')
    whole = (tmp_path / 'bag.mcap').read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(whole[: int(share * len(whole))])  # one chunk and the summary
    good = tmp_path / 'good.mcap'
    repair = [sys.executable, '-m', 'thinmap_ros.tools.bag_repair', cut, '-o', good]
    assert subprocess.run(repair).returncode == 0
    expected = run(good, '-o', tmp_path / 'expected', '--quiet')
    done = run(cut, '-o', tmp_path / 'out', '--quiet')
    assert (expected.returncode, done.returncode) == (0, 0), done.stderr
    assert f'`bag_repair {cut}`' in done.stdout and 'cut off' in done.stdout
    assert 'bag_repair' not in expected.stdout
    for name in TRAJECTORIES | {'map.pgm'}:
        assert (tmp_path / 'out' / name).read_bytes() == (tmp_path / 'expected' / name).read_bytes()
    assert len(np.loadtxt(tmp_path / 'out' / 'trajectory.tum')) > 10


def without_scans():
    return [line for line in carmen_lines() if not line.startswith('FLASER')]


def bag_without_odometry(path):
    with BagWriter(path) as writer:
        types = writer.typestore.types
        time = types['builtin_interfaces/msg/Time'](sec=1, nanosec=0)
        header = types['std_msgs/msg/Header'](stamp=time, frame_id='laser')
        ranges = np.full(BEAMS, 2.0, dtype=np.float32)
        scan = types['sensor_msgs/msg/LaserScan'](
            header=header,
            angle_min=-1.57,
            angle_max=1.57,
            angle_increment=0.01745,
            time_increment=0.0,
            scan_time=0.0,
            range_min=0.0,
            range_max=8.0,
            ranges=ranges,
            intensities=ranges[:0],
        )
        writer.write('/scan', 'sensor_msgs/msg/LaserScan', 1_000_000_000, scan)


BAD = {
    'missing': (lambda path: None, ['No such file']),
    'empty': (lambda path: path.write_text(''), ['scan']),
    'binary': (lambda path: path.write_bytes(bytes(range(256)) * 20), ['log']),
    'without scans': (lambda path: path.write_text('\n'.join(without_scans())), ['scan']),
    'one line without an end': (lambda path: path.write_text(carmen_lines()[2][:300]), ['scan']),
    'folder': (lambda path: path.mkdir(), ['log']),
}


@pytest.mark.programs
@pytest.mark.parametrize('case', BAD)
def test_what_cannot_be_replayed_is_reported_in_one_line(tmp_path, case):
    make, words = BAD[case]
    path = tmp_path / 'some.log'
    make(path)
    done = run(path, '-o', tmp_path / 'out')
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.strip()]
    assert 'some.log' in line
    assert all(word in line for word in words), line
    assert not (tmp_path / 'out').exists(), 'nothing is written of a log that could not be replayed'


@pytest.mark.programs
def test_bag_without_odometry_names_its_topics(tmp_path):
    bag_without_odometry(tmp_path / 'bag')
    done = run(tmp_path / 'bag', '-o', tmp_path / 'out')
    assert done.returncode == 2
    assert 'nav_msgs/msg/Odometry' in done.stderr and '/scan' in done.stderr
    assert 'Traceback' not in done.stderr


@pytest.mark.programs
def test_bad_lines_are_counted_and_the_first_is_named(tmp_path):
    lines = carmen_lines()
    lines[10] = lines[10][: len(lines[10]) // 2]  # cut in the middle
    lines[20] = lines[20].replace('FLASER 181', 'FLASER 95', 1)  # says 95 beams, has 181
    path = tmp_path / 'some.log'
    path.write_text('\n'.join(lines))
    done = run(path, '-o', tmp_path / 'out', '--quiet')
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert (report['scans'], report['skipped']) == (28, 2)
    assert 'some.log:11: ' in report['first_skipped']
    assert '2 skipped' in done.stdout and 'some.log:11: ' in done.stdout


WILD = {
    '1e308': (lambda line: line.replace('ODOM 0.3300', 'ODOM 1e308'), 1),
    '1e17': (lambda line: line.replace('ODOM 0.3300', 'ODOM 1e17'), 1),
    'kilometres': (lambda line: line.replace('0.3300 0 0', '2000.0 2000.0 0'), 0),
}


@pytest.mark.programs
@pytest.mark.parametrize('case', WILD)
def test_one_wild_pose_leaves_the_rest_of_the_log(tmp_path, case):
    alter, skipped = WILD[case]
    # The robot's clock jumps ahead before the wild pose: odometry may have come far since.
    lines = carmen_lines(11) + carmen_lines(start_s=1e4)[23:]
    altered = [alter(line) if k in (23, 24) else line for k, line in enumerate(lines)]
    assert altered != lines
    path = tmp_path / 'some.log'
    path.write_text('\n'.join(altered))
    done = run(path, '-o', tmp_path / 'out', '--quiet')
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert (report['scans'], report['skipped'], report['refused']) == (30, skipped, 0)
    assert report['ended_by'] == ''
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    assert np.abs(trajectory[:, 1] - 0.03 * np.arange(30)).max() < 0.03


@pytest.mark.programs
def test_scans_beyond_the_largest_map_are_counted_and_named(tmp_path):
    # 340 m in three minutes, and back. At cells of 0.02 m that is too far.
    way = [
        f'ODOM {240.0 * k / 180:.3f} {240.0 * k / 180:.3f} 0 0 0 0 {{:.3f}} robot 0'
        for k in range(1, 181)
    ]
    there = [line.format(10.0 + k) for k, line in enumerate(way)]
    back = [line.format(210.0 + k) for k, line in enumerate(reversed(way))]
    away = [line for line in carmen_lines(start_s=200.0) if line.startswith('FLASER')][10]
    away = away.replace('0.3000 0 0', '240.0 240.0 0')
    path = tmp_path / 'some.log'
    path.write_text(
        '\n'.join([*carmen_lines(10), *there, away, *back, *carmen_lines(start_s=400.0)[23:]])
    )
    done = run(path, '-o', tmp_path / 'out', '--quiet', '--resolution-m', '0.02')
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert (report['scans'], report['refused']) == (30, 1)
    assert report['first_refused'].startswith('scan at 202000000000 ns: laser at 2')
    assert '1 not mapped (first: scan at 202000000000 ns' in done.stdout
    assert (tmp_path / 'out' / 'map.pgm').stat().st_size < 1_000_000


@pytest.mark.programs
def test_what_was_mapped_before_an_error_is_written(log, tmp_path):
    log.write_text(log.read_text() + 'ODOM \0\n' + '\n'.join(carmen_lines(start_s=100.0)))
    done = run(log, '-o', tmp_path / 'out', '--quiet')
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f'replay: error: {log}:62: a zero byte')
    assert line.endswith(f'the 30 scans before it are in {tmp_path / "out"}')
    assert {path.name for path in (tmp_path / 'out').iterdir()} == FILES
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert report['scans'] == 30
    assert 'a zero byte' in report['ended_by']


@pytest.mark.programs
@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_what_was_mapped_before_ctrl_c_is_written(tmp_path, number):
    path = tmp_path / 'long.log'
    path.write_text('\n'.join(carmen_lines(80)) + '\n')
    with path.open('a') as stream:
        for lap in range(1, 100):
            stream.write('\n'.join(carmen_lines(80, start_s=20.0 * lap)) + '\n')
    command = [sys.executable, '-m', 'thinmap_ros.tools.replay', path, '-o', tmp_path / 'out']
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE) as replaying:
        shown = b''
        while not re.search(rb'replay: .*[1-9][0-9]+ of [0-9]+ scans\n', shown):
            more = replaying.stderr.read1()
            assert more, shown
            shown += more
        replaying.send_signal(number)
        out, err = replaying.communicate(timeout=PATIENCE_S)
    assert replaying.returncode == 130
    assert err.decode().splitlines()[-1] == 'replay: interrupted'
    assert {path.name for path in (tmp_path / 'out').iterdir()} == FILES
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert 0 < report['scans'] < 8000
    assert report['ended_by'] == 'KeyboardInterrupt'
    assert f'{report["scans"]} scans' in out.decode()


@pytest.mark.programs
def test_beam_counts_may_change(tmp_path):
    path = tmp_path / 'some.log'
    path.write_text('\n'.join(carmen_lines(10) + carmen_lines(10, beams=91, start_s=2.0)))
    done = run(path, '-o', tmp_path / 'out', '--quiet')
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert report['scans'] + report['skipped'] == 20
    assert report['scans'] >= 10


@pytest.mark.programs
def test_another_recording_in_the_same_log_ends_it(tmp_path):
    path = tmp_path / 'some.log'
    lines = carmen_lines()
    path.write_text('\n'.join(lines[:41] + lines[21:]))
    done = run(path, '-o', tmp_path / 'out', '--quiet')
    assert done.returncode == 2
    reason = 'clock jumped back by 1.8 s at scan 20: the rest is another recording'
    assert done.stderr.splitlines()[-1].startswith(f'replay: error: {reason}; the 20 scans before')
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert (report['scans'], report['ended_by']) == (20, reason)
    assert len(np.loadtxt(tmp_path / 'out' / 'trajectory.tum')) == 20


@pytest.mark.programs
def test_a_clock_that_is_set_back_while_the_robot_drives_on_loses_nothing(tmp_path):
    path = tmp_path / 'some.log'
    lines = carmen_lines(start_s=10.0)
    later = [
        re.sub(r'(\S+) robot \S+$', lambda m: f'{float(m[1]) - 7.0:.3f} robot 0', line)
        for line in lines[31:]
    ]
    path.write_text('\n'.join(lines[:31] + later))
    done = run(path, '-o', tmp_path / 'out', '--quiet')
    assert done.returncode == 0, done.stderr
    assert 'clock was set back by 7.0 s at scan 15 while the odometry continues' in done.stderr
    trajectory = np.loadtxt(tmp_path / 'out' / 'trajectory.tum')
    np.testing.assert_allclose(trajectory[:, 0], 10.0 + 0.2 * np.arange(30), atol=1e-6)
    assert np.abs(trajectory[:, 1] - 0.03 * np.arange(30)).max() < 0.03


@pytest.mark.programs
@pytest.mark.parametrize(
    'arguments',
    [
        ['--slam', 'magic'],
        ['--resolution-m', '0'],
        ['--offset-m', 'nan'],
        ['-x'],
        ['--graph-period-s', '-1'],
        ['--graph-period-s', 'nan'],
    ],
)
def test_wrong_options_end_with_two(log, tmp_path, arguments):
    done = run(log, '-o', tmp_path / 'out', *arguments)
    assert done.returncode == 2
    assert 'Traceback' not in done.stderr and done.stderr.strip()


@pytest.mark.programs
def test_an_unwritable_path_is_reported(log):
    done = run(log, '-o', '/proc/nowhere')
    assert done.returncode == 2
    assert '/proc/nowhere' in done.stderr and 'Traceback' not in done.stderr


@pytest.mark.programs
@pytest.mark.slow
def test_real_office_log(shared_data, tmp_path):
    log = shared_data / 'logs' / 'mrpt_office' / 'log.clf'
    angles = ['--start-angle-deg', '-110.0', '--step-deg', '0.352']
    options = [*angles, '--offset-m', '0.16', '--range-max-m', '24.9']
    done = run(log, '-o', tmp_path / 'out', '--quiet', *options)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / 'out' / 'report.json').read_text())
    assert report['scans'] > 400
    assert report['nodes'] > 5


class Diary(NullView):
    """A view that counts its calls by kind, and stores the last map."""

    def __init__(self):
        self.told = Counter()
        self.map_shown = None

    def pose(self, ns, T_map_base, covariance):
        self.told['pose'] += 1

    def scan(self, ns, scan):
        self.told['scan'] += 1

    def grid(self, ns, patch):
        self.told['grid'] += 1
        self.map_shown = patch

    def topology(self, ns, topology):
        self.told['graph'] += 1

    def scalar(self, ns, plot, curve, value):
        self.told[plot, curve] += np.isfinite(value)


def test_a_view_receives_each_scan_and_the_final_map(log):
    diary = Diary()
    result = replay(CarmenLog(log, LaserOptions()), PipelineConfig(), watcher=ReplayView(diary))
    assert len(result.poses) == diary.told['pose'] == diary.told['scan'] == 30
    assert diary.told['grid'] == 7, 'once a second of the log, and at its end'
    assert np.array_equal(diary.map_shown.cells, result.pipeline.grid.known_area().cells)
    for curve in (
        ('step', 'localizer'),
        ('step', 'map update'),
        ('count', 'features'),
    ):
        assert diary.told[curve] == 30


@pytest.mark.parametrize(('period_s', 'graphs'), [(0.0, 1), (2.0, 4)])
def test_a_view_receives_the_graph_at_the_end_or_as_it_grows(log, period_s, graphs):
    diary = Diary()
    watcher = ReplayView(diary, period_s)
    result = replay(CarmenLog(log, LaserOptions()), PipelineConfig(), watcher=watcher)
    assert diary.told['count', 'nodes'] == graphs
    assert diary.told['graph'] == graphs
    taken = result.pipeline.stage_seconds
    assert len(taken['topology']) <= graphs < len(taken['grid'])


@pytest.mark.programs
@pytest.mark.parametrize('option', ['--view', '--recording=run.rrd'])
def test_without_rerun_a_view_is_refused_in_one_line(
    log, tmp_path, tmp_path_factory, monkeypatch, option
):
    hide('rerun', tmp_path_factory.mktemp('hidden'), monkeypatch)
    done = run(log, '-o', tmp_path / 'out', option)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith('replay: error: rerun is not installed')
    assert not (tmp_path / 'out').exists()


@pytest.mark.programs
@needs_rerun
def test_without_a_screen_a_view_is_refused_in_one_line(log, tmp_path, monkeypatch):
    monkeypatch.delenv('DISPLAY', raising=False)
    monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
    done = run(log, '-o', tmp_path / 'out', '--view', '--recording', tmp_path / 'run.rrd')
    assert done.returncode == 2 and done.stderr.splitlines() == [
        'replay: error: no screen for the viewer: neither DISPLAY nor WAYLAND_DISPLAY is set'
    ]
    assert list(tmp_path.iterdir()) == [log]


def rows_of(path, entity):
    from rerun.chunk import RrdReader

    return sum(chunk.num_rows for chunk in RrdReader(path).stream() if chunk.entity_path == entity)


@pytest.mark.programs
@needs_rerun
def test_a_recording_holds_the_whole_replay_or_is_not_written(log, tmp_path):
    done = run(log, '-o', tmp_path / 'out', '--quiet', '--recording', tmp_path / 'run.rrd')
    assert done.returncode == 0, done.stderr
    assert (
        rows_of(tmp_path / 'run.rrd', '/map/robot')
        == rows_of(tmp_path / 'run.rrd', '/map/robot/scan')
        == 30
    )
    assert rows_of(tmp_path / 'run.rrd', '/map/grid') >= 6
    log.write_text('\n'.join(without_scans()))
    done = run(log, '-o', tmp_path / 'out', '--quiet', '--recording', tmp_path / 'other.rrd')
    assert done.returncode == 2 and not (tmp_path / 'other.rrd').exists()


def rows_received(path, entity):
    """Rows so far of a file that is still being written."""
    try:
        return rows_of(path, entity)
    except (RuntimeError, ValueError):
        return 0


@contextmanager
def closed_when(mark, condition):
    """Write a mark when a condition holds, or after a timeout."""
    ended = threading.Event()

    def watch():
        end = time.monotonic() + PATIENCE_S
        try:
            while time.monotonic() < end and not ended.is_set() and not condition():
                ended.wait(0.1)
        finally:
            mark.touch()

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield
    finally:
        ended.set()
        watcher.join()


@needs_rerun
@pytest.mark.programs
def test_the_viewer_shows_the_replay_until_it_is_closed(log, tmp_path, monkeypatch, capsys):
    # The real program, which writes a file of what it receives instead of opening a window; closed
    # when the results are there and it has shown all of it.
    received, stand_in, seen = (tmp_path / name for name in ('received.rrd', 'viewer', 'seen'))
    report = tmp_path / 'out' / 'report.json'
    stand_in.write_text(
        f'#!/bin/sh\n"{rerun_sinks.viewer_program()}" --save "{received}" "$@" &\n'
        f'while [ ! -e "{seen}" ]; do sleep 0.1; done; kill $!; wait $!\n'
    )
    stand_in.chmod(0o755)
    monkeypatch.setattr(rerun_sinks, 'viewer_program', lambda: str(stand_in))
    monkeypatch.setenv('DISPLAY', ':none')
    monkeypatch.setattr(
        sys, 'argv', ['replay', str(log), '-o', str(tmp_path / 'out'), '--quiet', '--view']
    )
    with closed_when(seen, lambda: report.exists() and rows_received(received, '/map/robot') >= 30):
        main()
        assert seen.exists(), 'it waits for the viewer'
    assert 'close the viewer to end' in capsys.readouterr().err
    assert {path.name for path in (tmp_path / 'out').iterdir()} == FILES
    assert rows_of(received, '/map/robot') == 30, 'it was sent all of it'


class FullDisk(Diary):
    """A view that fails at the twentieth scan, and at the end."""

    def pose(self, ns, T_map_base, covariance):
        super().pose(ns, T_map_base, covariance)
        if self.told['pose'] == 20:
            raise OSError('disk full')

    def grid(self, ns, patch):
        if self.told['pose'] == 20:
            raise OSError('disk full again')


def test_an_error_that_nobody_expects_ends_a_replay_with_the_stamp_of_its_scan(log, monkeypatch):
    work = Mapper.add

    def add(mapper, localized):
        if localized.scan.stamp_ns == 2_000_000_000:
            raise ZeroDivisionError('planted')
        return work(mapper, localized)

    monkeypatch.setattr(Mapper, 'add', add)
    carmen = CarmenLog(log, LaserOptions())
    result = replay(carmen, PipelineConfig(), keep_partial=True)
    assert one_line_reason(result.ended_by) == 'scan at 2000000000 ns: planted'
    assert isinstance(result.ended_by, ZeroDivisionError)
    assert result.stamps_ns[-1] < 2_000_000_000


def test_an_error_of_the_view_keeps_what_was_mapped_if_asked(log):
    carmen = CarmenLog(log, LaserOptions())
    watcher = ReplayView(FullDisk())
    result = replay(carmen, PipelineConfig(), watcher=watcher, keep_partial=True)
    assert str(result.ended_by) == 'disk full'
    assert len(result.poses) == 20
    with pytest.raises(OSError, match='disk full'):
        replay(carmen, PipelineConfig(), watcher=ReplayView(FullDisk()))
