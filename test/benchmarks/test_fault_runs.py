"""scripts/endurance --faults: sequence of faults, what they do to messages, and the judgement."""

import json
import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import Trigger

from benchmarks.faults import judge
from benchmarks.faults.causes import place_apart, reset_faults, sim_time_faults
from benchmarks.faults.judge import Counts, Passed, PoseWatch, Record, uncounted
from benchmarks.faults.kinds import KINDS, Fault, random_faults
from benchmarks.faults.stream_faults import StreamFaults
from benchmarks.faults.track import Drawn, Located, MapWatch, Track
from benchmarks.node_processes import NODES, Processes
from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import messages
from thinmap_ros.sim.world import World

SCAN_NS = SECOND_NS // 5


def test_faults_are_the_same_for_a_seed_and_all_kinds_come_before_any_again() -> None:
    one, again, other = (list(islice(random_faults(seed), 60)) for seed in (1, 1, 2))
    assert one == again != other
    assert {fault.kind.name for fault in one[: len(KINDS)]} == KINDS.keys()
    assert all(10.0 <= f.gap_s <= 30.0 for f in one)
    assert all(f.kind.shortest_s <= f.duration_s <= f.kind.longest_s for f in one)
    only = islice(random_faults(3, ['drop_scan', 'kill_explorer']), 4)
    assert sorted(f.kind.name for f in only) == 2 * ['drop_scan'] + 2 * ['kill_explorer']


def test_kinds_are_as_their_file_has_them() -> None:
    assert {kind.node for kind in KINDS.values()} == {'', *NODES}
    killed = KINDS['kill_navigator']
    odometry = KINDS['odom_jump']
    assert (killed.signal, killed.stop_m, killed.shortest_s) == ('kill', 0.75, 0.5)
    assert killed.is_killed and not killed.forgets and KINDS['forget_localizer'].is_killed
    assert (odometry.stop_m, odometry.resets) == (math.inf, False)
    assert KINDS['clock_back'].resets and KINDS['carried_off'].wrong_s == 5.0


def scan_msg(k, nearest_m=2.0):
    ranges = nearest_m + 0.001 * np.arange(5.0)
    scan = Scan.create(k * SCAN_NS, ranges, -1.0, 0.5, 0.05, 8.0)
    return messages.scan_msg(scan, 'laser', 0.2)


def odometry_msg(k):
    T_odom_base = np.array([0.1 * k, 0.0, 0.0])
    return messages.odometry_msg(T_odom_base, (0.5, 0.0), ('odom', 'base_link'), k * SCAN_NS)


def stamp_s(message):
    return messages.stamp_ns(message.header.stamp) / SECOND_NS


@pytest.mark.parametrize(
    ('kind', 'value'),
    [('laser_nan', math.nan), ('laser_zero', 0.0), ('laser_inf', math.inf), ('laser_max', 8.0)],
)
def test_a_blind_laser_gives_one_value_until_the_end_of_the_fault(kind: str, value: float) -> None:
    faults = StreamFaults(0)
    faults.begin(kind, 1)
    (blind,) = faults.scan(scan_msg(1))
    assert np.array_equal(blind.ranges, np.full(5, value, dtype=np.float32), equal_nan=True)
    assert faults.odometry(odometry_msg(1)) == [odometry_msg(1)]
    faults.end()
    assert faults.scan(scan_msg(2)) == [scan_msg(2)]


def test_a_frozen_laser_repeats_ranges_with_new_stamps() -> None:
    faults = StreamFaults(0)
    for seed in (1, 2):
        faults.begin('laser_frozen', seed)
        scans = [faults.scan(scan_msg(k, float(seed + k)))[0] for k in range(3)]
        assert all(scan.ranges == scan_msg(0, float(seed)).ranges for scan in scans)
        assert [stamp_s(scan) for scan in scans] == pytest.approx([0.0, 0.2, 0.4])


def test_messages_are_dropped_repeated_and_silenced() -> None:
    for stream in ('scan', 'odom'):
        counts = {}
        for kind in ('drop', 'repeat', 'silent'):
            faults = StreamFaults(0)
            faults.begin(f'{kind}_{stream}', 1)
            change = faults.scan if stream == 'scan' else faults.odometry
            make = scan_msg if stream == 'scan' else odometry_msg
            counts[kind] = sum(len(change(make(k))) for k in range(100))
            assert faults.is_silent == (kind == 'silent')
        assert 20 < counts['drop'] < 80
        assert 150 < counts['repeat'] < 350
        assert counts['silent'] == 0


def test_stamps_of_scans_and_odometry_are_ahead_for_a_while_or_once() -> None:
    faults = StreamFaults(0)
    for kind, expected in (
        ('scan_stamps', [5.2, 5.4, 0.2, 0.4]),
        ('odom_one_stamp', [0.2, 0.4, 9.2, 0.4]),
    ):
        faults.begin(kind, 1)
        sent = [faults.scan(scan_msg(k))[0] for k in (1, 2)]
        sent += [faults.odometry(odometry_msg(k))[0] for k in (1, 2)]
        assert [stamp_s(message) for message in sent] == pytest.approx(expected)


def test_stamps_of_odometry_are_ahead_or_late_for_a_while() -> None:
    faults = StreamFaults(100 * SECOND_NS)
    shifts = []
    for seed in range(20):
        faults.begin('odom_stamps', seed)
        sent = [stamp_s(faults.odometry(odometry_msg(k))[0]) for k in (1, 2)]
        assert sent[1] - sent[0] == pytest.approx(0.2)
        shifts.append(sent[0] - 100.2)
        faults.end()
        assert stamp_s(faults.odometry(odometry_msg(1))[0]) == pytest.approx(100.2)
    assert min(shifts) < 0.0 < max(shifts)
    assert all(0.1 <= abs(shift) <= 10.0 for shift in shifts)


def test_clock_and_odometry_keep_their_jumps() -> None:
    faults = StreamFaults(100 * SECOND_NS)
    for kind in ('clock_ahead', 'clock_back'):
        before_ns = faults.clock(0)
        faults.begin(kind, 1)
        faults.end()
        shift_ns = faults.clock(0) - before_ns
        assert 1.0 <= abs(shift_ns) / SECOND_NS <= 20.0
        assert (shift_ns > 0) == (kind == 'clock_ahead')
        (scan,) = faults.scan(scan_msg(1))
        assert stamp_s(scan) == pytest.approx(faults.clock(SCAN_NS) / SECOND_NS)
    faults.begin('odom_jump', 1)
    faults.end()
    poses = [messages.pose_from_msg(faults.odometry(odometry_msg(k))[0].pose.pose) for k in (0, 1)]
    assert math.hypot(*poses[0][:2]) >= 0.1
    assert se2.between(*poses) == pytest.approx([0.1, 0.0, 0.0])


def test_errors_are_those_at_the_true_time_of_a_scan() -> None:
    track = Track()
    for k in range(20):
        track.add_truth(k * SCAN_NS, np.array([0.1 * k, 0.0, 0.0]))
    assert track.travelled_m == pytest.approx(1.9)
    track.add_scan(10**12, 5 * SCAN_NS)
    track.add_pose(10**12, np.array([0.5, 0.3, 0.0]))
    assert track.located() == []
    track.add_state(10**12, True)
    assert track.located() == [Located(1.0, pytest.approx(0.3), True, 10**12)]
    track.align(np.array([1.0, 1.0, 1.0]), 10**12)
    assert se2.compose(track.T_world_map, np.array([1.0, 1.0, 1.0])) == pytest.approx([0.5, 0, 0])


@pytest.mark.parametrize(
    ('error_m', 'is_tracking', 'is_reported', 'seconds', 'violated'),
    [
        (0.2, True, False, 4.0, True),
        (0.2, True, False, 2.0, False),
        (0.05, True, False, 60.0, False),
        (2.0, False, False, 60.0, False),
        (2.0, True, True, 60.0, False),
    ],
)
def test_an_error_that_lasts_and_is_not_reported_is_a_violation(
    error_m: float, is_tracking: bool, is_reported: bool, seconds: float, violated: bool
) -> None:
    watch = PoseWatch()
    for k in range(round(5.0 * seconds)):
        watch.add(Located(0.2 * k, error_m, is_tracking, k), is_reported)
    assert watch.is_violated == violated


@pytest.mark.parametrize(
    ('kind', 'seconds', 'violated'),
    [('carried_off', 3.4, False), ('carried_off', 5.4, True), ('odom_jump', 3.4, True)],
)
def test_a_kidnapping_may_be_noticed_later_than_other_faults(
    kind: str, seconds: float, violated: bool
) -> None:
    watch = PoseWatch(KINDS[kind].wrong_s)
    for time_s in (0.0, seconds):
        watch.add(Located(time_s, 2.0, True, 0), is_reported=False)
    assert watch.is_violated == violated


def test_late_data_keep_their_stamps_and_order_and_come_at_once_in_the_end() -> None:
    faults = StreamFaults(100 * SECOND_NS)
    faults.begin('late_data', 1)
    delays = []
    for k in range(1, 51):
        delays += [100.0 + 0.2 * k - stamp_s(scan) for scan in faults.scan(scan_msg(k))]
        faults.odometry(odometry_msg(k))
    assert len(set(np.round(delays, 6))) == 1
    assert 1.0 <= delays[0] <= 5.2
    assert faults.is_silent
    faults.end()
    for change, make in ((faults.scan, scan_msg), (faults.odometry, odometry_msg)):
        flood = [stamp_s(message) for message in change(make(51))]
        assert flood[-1] == pytest.approx(110.2)
        assert np.diff(flood) == pytest.approx(0.2)
        assert 110.2 - flood[0] == pytest.approx(delays[0], abs=0.21)
        assert len(change(make(52))) == 1


def test_the_clock_goes_ahead_by_more_than_a_minute() -> None:
    faults = StreamFaults(100 * SECOND_NS)
    faults.begin('clock_minute', 1)
    faults.end()
    assert faults.clock(0) == 161 * SECOND_NS


def test_wheels_are_blocked_until_the_end_of_the_fault() -> None:
    faults = StreamFaults(0)
    assert not faults.blocks_wheels
    faults.begin('wheels_blocked', 1)
    assert faults.blocks_wheels
    assert faults.odometry(odometry_msg(1)) == [odometry_msg(1)]
    faults.end()
    assert not faults.blocks_wheels


def test_a_change_of_use_sim_time_must_be_answered_and_refused() -> None:
    def response(successful: bool) -> SetParameters.Response:
        return SetParameters.Response(results=[SetParametersResult(successful=successful)])

    assert sim_time_faults('navigator', response(False)) == []
    assert sim_time_faults('navigator', response(True)) == ['navigator: accepted use_sim_time']
    assert sim_time_faults('navigator', None) == ['navigator: no answer to use_sim_time']


def test_a_reset_must_be_answered_and_done() -> None:
    assert reset_faults(Trigger.Response(success=True)) == []
    refused = reset_faults(Trigger.Response(success=False, message='busy'))
    assert refused == ['localizer: not reset: busy']
    assert reset_faults(None) == ['localizer: no answer to a reset']


def room(size_m: float = 6.0) -> World:
    """An empty room with walls of 0.1 m."""
    cells = np.full((round(10 * size_m),) * 2, 0, dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    return World.from_patch('room', patch, np.array([3.0, 3.0, 0.0]))


def test_a_robot_is_carried_to_a_clear_place_some_metres_away() -> None:
    world = room()
    place = np.array([1.0, 1.0, 0.0])
    for seed in range(10):
        x, y, _ = place_apart(world, place, np.random.default_rng(seed))
        assert math.hypot(x - 1.0, y - 1.0) >= 1.5
        assert world.is_clear(x, y, 0.2)


def test_a_checkpoint_is_forgotten(tmp_path: Path) -> None:
    (tmp_path / 'state').mkdir()
    for name in ('63.localizer.npz', '63.localizer.dear', '63.grid_mapper.npz'):
        (tmp_path / 'state' / name).touch()
    processes = Processes(tmp_path, 0.5)
    processes.forget('localizer')
    assert [path.name for path in (tmp_path / 'state').iterdir()] == ['63.grid_mapper.npz']
    processes.close()
    assert not list(tmp_path.iterdir())


def drawn_map(*points: tuple[float, float]) -> GridPatch:
    """A map of the room with free space, and an occupied row of three cells at each point."""
    cells = np.zeros((60, 60), dtype=np.int8)
    for x, y in points:
        cells[int(10 * y), int(10 * x) : int(10 * x) + 3] = 100
    return GridPatch(GridFrame(0.0, 0.0, 0.1), cells)


WALL = (2.0, 0.05)
WRONG = (3.0, 3.05)


@pytest.mark.parametrize(
    ('error_m', 'is_lost', 'expected'),
    [
        (0.0, False, Drawn(0, 3)),
        (0.6, False, Drawn(0, 3, while_wrong=3)),
        (0.0, True, Drawn(0, 3, while_lost=3)),
    ],
)
def test_walls_drawn_in_the_open_are_judged_by_the_pose_and_state(
    error_m: float, is_lost: bool, expected: Drawn
) -> None:
    watch = MapWatch(room(), Track())
    drawn = watch.begin()
    watch.add_map(SCAN_NS, drawn_map(WALL))
    for k in (2, 3):
        watch.add_error(k * SCAN_NS, error_m)
        watch.add_state(k * SCAN_NS, is_lost)
    for k in (3, 4):
        watch.add_map(k * SCAN_NS, drawn_map(WALL, WRONG))
    assert drawn == expected
    assert len(drawn.violations()) == 1 + bool(error_m or is_lost)
    assert watch.begin() == Drawn(3, 3)


def test_cells_by_themselves_and_walls_at_their_place_are_right() -> None:
    track = Track()
    watch = MapWatch(room(), track)
    drawn = watch.begin()
    patch = drawn_map(WALL)
    patch.cells[30, 30] = 100
    watch.add_map(0, patch)
    assert drawn.wrong == 0
    # The same map, elsewhere in the world: outside of it, too, walls are wrong.
    for shift_m in (1.0, -9.0):
        track.T_world_map = np.array([0.0, shift_m, 0.0])
        watch.add_map(0, patch)
        assert drawn.wrong == 3


def test_a_map_that_was_begun_anew_is_not_compared_with_the_one_before() -> None:
    watch = MapWatch(room(), Track())
    drawn = watch.begin()
    watch.add_map(9 * SCAN_NS, drawn_map(WALL))
    for k in range(1, 4):
        watch.add_state(k * SCAN_NS, True)
        watch.add_map(k * SCAN_NS, drawn_map(WALL, WRONG))
    assert drawn == Drawn(0, 3)


def test_messages_that_a_node_neither_received_nor_counted_are_found() -> None:
    before = Passed({'scan': 10, 'odom': 40}, 2)
    now = Passed({'scan': 30, 'odom': 120}, 5)
    first = Counts(8, 2, 0)
    assert uncounted('scan', first, Counts(26, 4, 3), now, before) == ''
    assert '2 of 20' in uncounted('scan', first, Counts(26, 2, 3), now, before)
    assert '3 were never sent, 2 counted' in uncounted('scan', first, Counts(28, 2, 2), now, before)
    assert uncounted('odom', first, Counts(88, 2, 0), now, before) == ''


def test_table_and_file_name_what_must_not_happen(tmp_path: Path) -> None:
    fault = Fault(0, KINDS['laser_inf'], 10.0, 20.0, 5)
    records = [
        Record(None, 0.0, driven_m=9.0),
        Record(fault, 12.0, driven_m=1.9, recovered_s=6.0),
        Record(fault, 50.0, driven_m=7.5, collisions=1),
    ]
    lines = judge.table(records).splitlines()
    assert lines[2:4] == [
        '| laser_inf | 2 | 1 | 0.00 | 7.50 | 6 |',
        '| none | 1 | 0 | 0.00 | 9.00 | - |',
    ]
    assert lines[4:] == [
        'laser_inf at 50.0 s: 1 collisions',
        'laser_inf at 50.0 s: drove 7.50 m, expected 2.0 m',
    ]
    judge.write_json(tmp_path / 'faults.json', records, {'seed': 4})
    found = json.loads((tmp_path / 'faults.json').read_text())
    assert found['seed'] == 4
    assert [len(record['violations']) for record in found['records']] == [0, 0, 2]
    assert found['records'][1]['seed'] == 5
