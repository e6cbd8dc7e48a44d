"""A log converted to a bag: both give identical data."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.forks import forked
from support.timeouts import PROGRAM_S

from thinmap_ros.core import se2
from thinmap_ros.logs.log import Event, LaserOptions, OdometryEvent
from thinmap_ros.logs.readers.bag import Bag, BagLog
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.tools.carmen_to_bag import convert

LOGS = Path(__file__).parents[3] / 'shared' / 'data' / 'logs'


def log_of(tmp_path: Path, lines: list[str], **options: float) -> CarmenLog:
    path = tmp_path / 'log.clf'
    path.write_text(''.join(lines))
    return CarmenLog(path, LaserOptions(**options))


def flaser(stamp: str, seed: int, theta: float = 0.3) -> str:
    ranges = ' '.join(f'{r:.3f}' for r in np.random.default_rng(seed).uniform(0.5, 90.0, 180))
    return f'FLASER 180 {ranges} 0 0 0 {0.1 * seed:.6f} -1.234567 {theta} {stamp} host 1.0\n'


def odom(stamp: str, x: float, theta: float) -> str:
    return f'ODOM {x} 2.345678901 {theta} 0.1 0.2 0 {stamp} host 1.0\n'


def assert_same(ours: list[Event], theirs: list[Event]) -> None:
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        if isinstance(a, OdometryEvent):
            assert isinstance(b, OdometryEvent)
            assert a.stamp_ns == b.stamp_ns
            assert np.array_equal(a.T_odom_base[:2], b.T_odom_base[:2])
            assert abs(se2.wrap(float(a.T_odom_base[2] - b.T_odom_base[2]))) < 1e-12
            continue
        assert not isinstance(b, OdometryEvent)
        assert a.scan.stamp_ns == b.scan.stamp_ns
        assert np.array_equal(a.scan.ranges_m, b.scan.ranges_m, equal_nan=True)
        for name in ('angle_min_rad', 'angle_increment_rad', 'range_min_m', 'range_max_m'):
            assert getattr(a.scan, name) == getattr(b.scan, name), name
        assert np.allclose(a.scan.T_base_laser, b.scan.T_base_laser, rtol=0.0, atol=1e-12)


def test_the_bag_equals_the_log(tmp_path: Path) -> None:
    lines = [
        odom('976052857.000001', 1.25, -3.1415926),
        flaser('976052857.337530', 1, 3.141592653589793),
        odom('976052857.400000', 1.5, 3.0),
        flaser('976052857.237530', 2),
        flaser('976052857.837530', 3, 7.5),
        odom('976052856.900000', 1.6, 0.0),
    ]
    log = log_of(tmp_path, lines, offset_m=0.16, range_max_m=25.0)
    assert convert(log, tmp_path / 'bag') == 3
    assert_same(list(log.events()), list(BagLog(tmp_path / 'bag').events()))


def test_log_time_keeps_the_order_of_the_file(tmp_path: Path) -> None:
    lines = [flaser(f'{100 + stamp}.5', i) for i, stamp in enumerate([0, 1, 0, 3, 2, 5, 1])]
    convert(log_of(tmp_path, lines), tmp_path / 'bag.mcap')
    messages = list(Bag(tmp_path / 'bag.mcap').messages())
    assert (np.diff([m.log_ns for m in messages]) > 0).all()
    topics = [m.topic for m in messages]
    assert topics[:4] == ['/odom', '/tf', '/tf_static', '/scan']
    assert topics[4:7] == ['/odom', '/tf', '/scan']
    assert topics.count('/tf_static') == 1


@pytest.mark.parametrize(
    ('name', 'options'),
    [
        ('sena', {'offset_m': 0.78}),
        (
            'mrpt_office',
            {'start_angle_deg': -110.0, 'step_deg': 0.352, 'offset_m': 0.16, 'range_max_m': 25.0},
        ),
        ('intel_sparse', {}),
    ],
)
def test_real_logs(tmp_path: Path, name: str, options: dict[str, float]) -> None:
    path = LOGS / name / 'log.clf'
    if not path.exists():
        pytest.skip(f'{path} is not here')
    log = CarmenLog(path, LaserOptions(**options))
    convert(log, tmp_path / 'bag.mcap')
    assert_same(list(log.events()), list(BagLog(tmp_path / 'bag.mcap').events()))


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).parents[2]
    module = 'thinmap_ros.tools.carmen_to_bag'
    return forked.run(module, *arguments, folder=root, timeout=PROGRAM_S)


@pytest.mark.programs
def test_the_program(tmp_path: Path) -> None:
    log = log_of(tmp_path, [flaser('5.0', 1), 'FLASER broken\n', flaser('6.0', 2)])
    done = run(log.path, tmp_path / 'bag', '--offset-m', 0.3)
    assert done.returncode == 0, done.stderr
    assert '2 scans, 1 line skipped' in done.stdout and f'{log.path}:2' in done.stdout
    events = list(BagLog(tmp_path / 'bag').events())
    assert [e.scan.T_base_laser[0] for e in events if not isinstance(e, OdometryEvent)] == [
        0.3,
        0.3,
    ]


@pytest.mark.programs
@pytest.mark.parametrize(
    ('content', 'options', 'said'),
    [
        (None, (), 'No such file'),
        ('', (), 'no scan'),
        ('ODOM 1 2 3 0 0 0 1.0 h 1\n', (), 'no scan'),
        ('FLASER 180 1.0 2.0', (), 'no scan'),
        ('x', ('--offset-m', '99'), 'offset_m'),
        ('x', ('--range-max-m', 'nan'), 'range_max_m'),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    tmp_path: Path, content: str | None, options: tuple[str, ...], said: str
) -> None:
    path = tmp_path / 'log.clf'
    if content is not None:
        path.write_text(content)
    done = run(path, tmp_path / 'out' / 'bag', *options)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count('\n') == 1 and 'Traceback' not in done.stderr
    assert not list(tmp_path.glob('out/*')) and not list(tmp_path.glob('out/.*'))
