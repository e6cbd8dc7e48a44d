"""CARMEN logs: the meaning of each line, and no traceback for any file."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import LATEST_S
from thinmap_ros.logs.log import Event, LaserOptions, OdometryEvent, ScanEvent
from thinmap_ros.logs.readers import carmen
from thinmap_ros.logs.readers.carmen import CarmenLog

FLASER = 'FLASER 3 1.00 2.50 81.83 9 9 9 0.5 -0.25 1.5 976052857.337530 host 0.1\n'
ODOM = 'ODOM 1.5 2.5 -3.0 0.1 0.2 0.0 976052857.437530 host 0.2\n'
ROBOTLASER = (
    'ROBOTLASER1 0 -1.5 3.0 0.75 30.0 0.01 0 5 1 2 3 40 5 2 7 8 '
    '1.2 2.0 0.0 1.0 2.0 0.0 0.1 0.2 0.3 0.4 0.5 12.000000001 host 0.3\n'
)


def write(tmp_path: Path, content: str | bytes) -> Path:
    path = tmp_path / 'log.clf'
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def read(path: Path, **options: float) -> list[Event]:
    return list(CarmenLog(path, LaserOptions(**options)).events())


def test_flaser(tmp_path: Path) -> None:
    odometry, scan_event = read(write(tmp_path, FLASER))
    assert isinstance(odometry, OdometryEvent) and isinstance(scan_event, ScanEvent)
    scan = scan_event.scan
    assert odometry.stamp_ns == scan.stamp_ns == 976052857_337530000
    assert np.array_equal(odometry.T_odom_base, [0.5, -0.25, 1.5])
    assert np.array_equal(scan.ranges_m, np.array([1.0, 2.5, 81.83], dtype=np.float32))
    assert np.degrees(scan.angles_rad) == pytest.approx([-90, 0, 90], abs=1e-5)
    assert scan.no_return.tolist() == [False, False, True]


@pytest.mark.parametrize(('count', 'last_deg'), [(180, 89.0), (181, 90.0), (361, 90.0)])
def test_the_fan_follows_the_number_of_beams(tmp_path: Path, count: int, last_deg: float) -> None:
    line = f'FLASER {count} {"1.0 " * count} 0 0 0 0 0 0 1.5 host 1\n'
    scan_event = read(write(tmp_path, line))[1]
    assert isinstance(scan_event, ScanEvent)
    assert np.degrees(scan_event.scan.angles_rad[[0, -1]]) == pytest.approx(
        [-90.0, last_deg], abs=1e-4
    )


def test_options_say_what_flaser_does_not(tmp_path: Path) -> None:
    event = read(
        write(tmp_path, FLASER),
        start_angle_deg=-110.0,
        step_deg=2.0,
        offset_m=0.16,
        range_max_m=2.0,
    )[1]
    assert isinstance(event, ScanEvent)
    assert np.degrees(event.scan.angles_rad) == pytest.approx([-110, -108, -106], abs=1e-4)
    assert np.array_equal(event.scan.T_base_laser, [0.16, 0.0, 0.0])
    assert event.scan.no_return.tolist() == [False, True, True]


def test_robotlaser_says_it_all(tmp_path: Path) -> None:
    odometry, event = read(write(tmp_path, ROBOTLASER))
    assert isinstance(odometry, OdometryEvent) and isinstance(event, ScanEvent)
    assert odometry.stamp_ns == 12_000000001
    assert np.array_equal(odometry.T_odom_base, [1.0, 2.0, 0.0])
    assert event.scan.angles_rad == pytest.approx([-1.5, -0.75, 0.0, 0.75, 1.5])
    assert event.scan.range_max_m == 30.0
    assert event.scan.no_return.tolist() == [False, False, False, True, False]
    assert event.scan.T_base_laser == pytest.approx([0.2, 0.0, 0.0])
    event = read(write(tmp_path, ROBOTLASER), offset_m=0.4)[1]
    assert isinstance(event, ScanEvent)
    assert event.scan.T_base_laser == pytest.approx([0.4, 0.0, 0.0])


def test_order_is_that_of_the_file_also_where_stamps_step_back(tmp_path: Path) -> None:
    earlier = FLASER.replace('857.337530', '856.000000')
    events = read(
        write(tmp_path, '# a comment\nPARAM robot_width 0.5\n\n' + ODOM + FLASER + earlier + ODOM)
    )
    kinds = ['odometry' if isinstance(e, OdometryEvent) else 'scan' for e in events]
    assert kinds == ['odometry', 'odometry', 'scan', 'odometry', 'scan', 'odometry']
    assert isinstance(events[0], OdometryEvent)
    assert np.array_equal(events[0].T_odom_base, [1.5, 2.5, -3.0])
    stamps = [e.stamp_ns if isinstance(e, OdometryEvent) else e.scan.stamp_ns for e in events]
    assert stamps[4] < stamps[2]


def test_headings_are_wrapped(tmp_path: Path) -> None:
    event = read(write(tmp_path, FLASER.replace(' 1.5 976', ' 7.0 976')))[0]
    assert isinstance(event, OdometryEvent)
    assert event.T_odom_base[2] == pytest.approx(7.0 - 2 * math.pi)


def test_gzip_is_the_same(tmp_path: Path) -> None:
    plain = read(write(tmp_path, FLASER + ODOM))
    zipped = read(write(tmp_path, gzip.compress((FLASER + ODOM).encode())))
    assert len(plain) == len(zipped) == 3


@pytest.mark.parametrize(
    'broken',
    [
        'FLASER 3 1.0 2.0\n',
        'FLASER 3 1.0 x 2.0 0 0 0 0 0 0 1.0 h 1\n',
        'FLASER 2 1.0 2.0 3.0 0 0 0 0 0 0 1.0 h 1\n',
        'FLASER 4 1.0 2.0 3.0 0 0 0 0 0 0 1.0 h\n',
        'FLASER 0 0 0 0 0 0 0 1.0 h 1\n',
        'FLASER -1 1.0 0 0 0 0 0 0 1.0 h 1\n',
        'FLASER\n',
        'FLASER 1 1.0 0 0 0 nan 0 0 1.0 h 1\n',
        'FLASER 1 1.0 0 0 0 1e9 0 0 1.0 h 1\n',
        ODOM.replace('1.5', '1e308'),
        ODOM.replace('2.5', '-1e17'),
        ODOM.replace('-3.0', '1e17'),
        'FLASER 1 1.0 0 0 0 0 0 0 nan h 1\n',
        'FLASER 1 1.0 0 0 0 0 0 0 -1.0 h 1\n',
        'FLASER 1 1.0 0 0 0 0 0 0 99999999999.0 h 1\n',
        'ODOM 1 2\n',
        ROBOTLASER.replace('0.75 30.0', 'nan 30.0'),
        ROBOTLASER.replace('0.75 30.0', '0.75 -30.0'),
        ROBOTLASER.replace(' 2 7 8 ', ' -2 7 8 '),
    ],
)
def test_a_broken_line_is_skipped_counted_and_named(tmp_path: Path, broken: str) -> None:
    path = write(tmp_path, FLASER + broken + FLASER)
    log = CarmenLog(path)
    assert len(list(log.events())) == 4
    assert log.skipped.count == 1
    assert log.skipped.first.startswith(f'{path}:2: ')
    assert '\n' not in log.skipped.first


def test_a_robotlaser_line_with_the_laser_far_away_is_skipped_alone(tmp_path: Path) -> None:
    log = CarmenLog(write(tmp_path, ROBOTLASER.replace(' 1.2 2.0 ', ' 999.0 2.0 ') + ROBOTLASER))
    event = list(log.events())[-1]
    assert isinstance(event, ScanEvent)
    assert event.scan.T_base_laser == pytest.approx([0.2, 0.0, 0.0])
    assert log.skipped.count == 1


def test_a_number_cut_in_half_is_not_taken_for_a_whole_one(tmp_path: Path) -> None:
    whole = FLASER + FLASER
    reference = read(write(tmp_path, whole))
    for end in range(len(FLASER) + 1, len(whole)):
        log = CarmenLog(write(tmp_path, whole[:end]))
        events = list(log.events())
        assert len(events) in (2, 4)
        for event, expected in zip(events, reference, strict=False):
            if isinstance(event, OdometryEvent) and isinstance(expected, OdometryEvent):
                assert event.stamp_ns == expected.stamp_ns
                assert np.array_equal(event.T_odom_base, expected.T_odom_base)
        assert len(events) == 4 or log.skipped.count == 1


def test_beam_counts_that_change_go_on(tmp_path: Path) -> None:
    other = 'FLASER 5 1 2 3 4 5 0 0 0 0 0 0 976052858.0 host 0.1\n'
    events = read(write(tmp_path, FLASER + other))
    assert [e.scan.ranges_m.size for e in events if isinstance(e, ScanEvent)] == [3, 5]


def test_nan_ranges_are_neither_hit_nor_no_return(tmp_path: Path) -> None:
    event = read(write(tmp_path, FLASER.replace('2.50', 'nan').replace('1.00', '1e300')))[1]
    assert isinstance(event, ScanEvent)
    assert event.scan.hit.tolist() == [False, False, False]
    assert event.scan.no_return.tolist() == [True, False, True]


@pytest.mark.parametrize(
    ('content', 'said'),
    [
        (b'', 'no scan'),
        (ODOM.encode(), 'no scan'),
        (b'FLASER 3 1.0', 'no scan.*log.clf:1'),
        (b'\x89PNG\r\n\x00\x00', 'zero byte'),
        (b'hello\nworld\n', 'no scan'),
        # Without the time of day, which would become part of the test name.
        (gzip.compress(FLASER.encode(), mtime=0)[:-12], 'no scan'),
        (b'\x1f\x8bnonsense', 'no scan'),
    ],
)
def test_files_without_scans(tmp_path: Path, content: bytes, said: str) -> None:
    path = write(tmp_path, content)
    with pytest.raises(InputError, match=said) as error:
        read(path)
    assert str(path) in str(error.value)
    assert '\n' not in str(error.value)


def test_a_cut_gzip_gives_what_is_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    lines = [FLASER.replace('2.50', f'{value:.6f}') for value in rng.random(2000)]
    packed = gzip.compress(''.join(lines).encode())
    log = CarmenLog(write(tmp_path, packed[: len(packed) // 2]))
    scans = sum(isinstance(e, ScanEvent) for e in log.events())
    assert 500 < scans < 1500
    assert log.skipped.count >= 1


def test_no_file_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='No such file'):
        read(tmp_path / 'none.clf')
    with pytest.raises(InputError, match='directory'):
        read(tmp_path)


def _is_read_or_refused(path: Path) -> bool:
    """Whether a log gives events, or an InputError of one line.

    Other exceptions are raised.
    """
    try:
        return all(
            isinstance(event, OdometryEvent | ScanEvent) for event in CarmenLog(path).events()
        )
    except InputError as error:
        return '\n' not in str(error)


@settings(
    deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.binary(max_size=300))
def test_arbitrary_bytes(tmp_path: Path, content: bytes) -> None:
    assert _is_read_or_refused(write(tmp_path, content))


WORD = st.one_of(
    st.sampled_from(
        [
            'FLASER',
            'ODOM',
            'ROBOTLASER1',
            '#',
            '1',
            '2',
            '180',
            '-1',
            '0',
            'nan',
            'inf',
            '1e400',
            '976.5',
        ]
    ),
    st.integers(-5, 2**70).map(str),
    st.floats().map(str),
    st.text(max_size=6),
)


@settings(
    deadline=None, max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.lists(
        st.tuples(st.sampled_from(['FLASER', 'ODOM', 'ROBOTLASER1']), st.lists(WORD, max_size=26)),
        max_size=6,
    )
)
def test_arbitrary_words(tmp_path: Path, lines: list[tuple[str, list[str]]]) -> None:
    text = ''.join(' '.join([key, *words]) + '\n' for key, words in lines)
    assert _is_read_or_refused(write(tmp_path, text.encode('utf-8', errors='surrogatepass')))


@settings(
    deadline=None, max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.binary(max_size=20), st.integers(0, 400), st.booleans())
def test_damaged_files(tmp_path: Path, noise: bytes, at: int, zipped: bool) -> None:
    content = (FLASER + ODOM + ROBOTLASER + FLASER).encode()
    content = gzip.compress(content) if zipped else content
    at = min(at, len(content))
    assert _is_read_or_refused(write(tmp_path, content[:at] + noise + content[at + len(noise) :]))


@pytest.mark.parametrize(
    ('word', 'stamp_ns'),
    [('12', 12_000_000_000), ('12.', 12_000_000_000), ('0', 0), ('12.5', 12_500_000_000)],
)
def test_a_stamp_may_be_a_whole_second(tmp_path: Path, word: str, stamp_ns: int) -> None:
    event, *_ = read(write(tmp_path, ODOM.replace('976052857.437530', word) + FLASER))
    assert isinstance(event, OdometryEvent)
    assert event.stamp_ns == stamp_ns


def test_the_latest_stamp_is_that_of_ros_messages(tmp_path: Path) -> None:
    lines = [ODOM.replace('976052857.437530', f'{LATEST_S + k}') for k in (-1, 0)]
    log = CarmenLog(write(tmp_path, ''.join([*lines, FLASER])))
    assert len(list(log.events())) == 3
    assert log.skipped.count == 1


@pytest.mark.parametrize('is_zipped', [False, True])
def test_the_number_of_scans_is_known_of_a_short_log(tmp_path: Path, is_zipped: bool) -> None:
    content = (FLASER + '# comment\n' + FLASER).encode()
    path = tmp_path / 'log.clf'
    path.write_bytes(gzip.compress(content) if is_zipped else content)
    assert CarmenLog(path).expected_scans == 2


def test_the_number_of_scans_of_a_long_log_is_estimated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(carmen, '_SAMPLE_BYTES', 10_000)
    path = tmp_path / 'log.clf'
    path.write_text(1000 * FLASER)
    assert 990 <= CarmenLog(path).expected_scans <= 1010  # type: ignore[operator]


def test_no_number_of_scans_is_expected_of_an_unreadable_log(tmp_path: Path) -> None:
    assert CarmenLog(tmp_path / 'missing').expected_scans is None
    (tmp_path / 'empty').write_text('')
    assert CarmenLog(tmp_path / 'empty').expected_scans is None
