"""Messages become items in words and numbers that the page draws; invalid ones are refused."""

import json
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.scan import Scan
from thinmap_ros.ros import diagnostics
from thinmap_ros.web.pages import Board
from thinmap_ros.web.picture import (
    ENDED,
    DiagnosticsTable,
    DrivenPath,
    Picture,
    exploration_words,
    slam_words,
)


def items_of(board):
    return dict(json.loads(board.since(0)[1]))


def slam_status(**fields):
    values = {'apart_m': 0.0, 'join_odds': 0.0, 'is_contradicted': False}
    values |= {'inlier_ratio': 0.9, 'step_time_ms': 4.0}
    return SimpleNamespace(**(values | fields))


def test_the_state_in_words():
    assert slam_words(slam_status(state=0)) == {
        'state': 'TRACKING',
        'detail': 'the laser confirms the pose',
        'is_well': True,
    }
    assert 'odometry alone' in slam_words(slam_status(state=2))['detail']
    apart = slam_words(slam_status(state=5, apart_m=3.25, join_odds=1234.0))
    assert apart['state'] == 'MAPPING APART' and not apart['is_well']
    assert '3.2 m so far; best place at odds of 1.23e+03 to 1' in apart['detail']
    assert 'no place is found yet' in slam_words(slam_status(state=5))['detail']
    assert 'contradict' in slam_words(slam_status(state=0, is_contradicted=True))['detail']


def test_an_exploration_in_words():
    status = SimpleNamespace(
        state=1,
        distance_m=12.34,
        has_target=True,
        target_id=7,
        target_position=SimpleNamespace(x=1.0, y=-2.0),
        missing_area_m2=30.4,
        missing_area_bound_m2=55.5,
        reason='',
        coverage_estimate=float('nan'),
    )
    words = exploration_words(status)
    assert words['state'] == 'exploring' and words['coverage'] == 0.0
    assert words['detail'] == (
        '12.3 m, to end node 7 at 1.0, -2.0, 30 m2 missing, with 95 % no more than 56 m2'
    )
    status.target_id = 2_000_000_030
    assert 'm, to a frontier at 1.0, -2.0,' in exploration_words(status)['detail']
    status.missing_area_m2 = -1.0
    assert 'missing' not in exploration_words(status)['detail']


@pytest.mark.parametrize(
    ('code', 'reason', 'state', 'words'),
    [
        (1, 'all end nodes resolved', 'finished', '3.0 m, all end nodes resolved'),
        (3, 'cancelled', 'cancelled', '3.0 m'),
        (4, '2 end nodes unreachable', 'ended', '3.0 m, 2 end nodes unreachable'),
    ],
)
def test_an_exploration_that_is_cancelled_has_not_finished(code, reason, state, words):
    status = SimpleNamespace(
        state=3,
        reason_code=code,
        reason=reason,
        distance_m=3.0,
        has_target=False,
        missing_area_m2=-1.0,
        missing_area_bound_m2=-1.0,
        coverage_estimate=1.0,
    )
    shown = exploration_words(status)
    assert (shown['state'], shown['detail']) == (state, words)


def test_a_scan_is_drawn_at_the_pose_of_its_stamp():
    board = Board()
    picture = Picture(board)
    ranges = np.array([1.0, 2.0, np.inf])
    mount = np.array([0.1, 0.0, 0.0])
    scan = Scan.create(5, ranges, 0.0, np.pi / 2, 0.05, 8.0, mount)
    picture.scan(scan)
    picture.pose(4, np.zeros(3), np.eye(3))
    assert 'laser' not in items_of(board)
    picture.pose(5, np.array([1.0, 2.0, 0.5]), np.diag([0.01, 0.04, 0.001]))
    laser = items_of(board)['laser']
    assert laser == {'pose': [1.0, 2.0, 0.5], 'points_cm': [110, 0, 10, 200]}
    assert items_of(board)['robot']['covariance'] == [0.01, 0.0, 0.04, 0.001]


def test_the_newest_scans_of_two_lasers_are_drawn_together():
    board = Board()
    picture = Picture(board)

    def see(ns, frame, x):
        scan = Scan.create(ns, np.array([1.0]), 0.0, 1.0, 0.05, 8.0)
        picture.scan(replace(scan, frame=frame))
        picture.pose(ns, np.array([x, 0.0, 0.0]), np.eye(3))
        return items_of(board)['laser']['points_cm']

    assert see(0, 'front', 0.0) == [100, 0]
    assert see(10**8, 'rear', 0.5) == [50, 0, 100, 0]
    assert see(2 * 10**8, 'front', 0.5) == [100, 0, 100, 0]
    assert see(2 * 10**9, 'front', 0.5) == [100, 0], 'the other one is silent'


def test_a_scan_with_a_delay_is_drawn_at_its_pose_which_has_another_stamp():
    board = Board()
    picture = Picture(board)
    scan = Scan.create(5 * 10**8, np.array([1.0]), 0.0, 1.0, 0.05, 8.0)
    picture.pose(3 * 10**8, np.array([2.0, 0.0, 0.0]), np.eye(3))
    picture.scan(scan)
    assert 'laser' not in items_of(board)
    upright = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    place = SimpleNamespace(position=SimpleNamespace(x=2.0, y=0.0, z=0.0), orientation=upright)
    origin = SimpleNamespace(position=SimpleNamespace(x=0.0, y=0.0, z=0.0), orientation=upright)
    beams = SimpleNamespace(
        header=SimpleNamespace(frame_id='laser'),
        ranges=[1.0],
        angle_min=0.0,
        angle_max=0.0,
        angle_increment=1.0,
        range_min=0.05,
        range_max=8.0,
        time_increment=0.0,
        scan_time=0.0,
    )
    picture.localized_scan(
        SimpleNamespace(
            header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=5 * 10**8)),
            scan=beams,
            laser_pose=origin,
            pose=SimpleNamespace(pose=place),
            status=SimpleNamespace(state=0, MAPPING_APART=5),
        )
    )
    assert items_of(board)['laser'] == {'pose': [2.0, 0.0, 0.0], 'points_cm': [100, 0]}


def region(number, **fields):
    place = SimpleNamespace(x=1.0, y=2.0)
    outline = SimpleNamespace(points=[SimpleNamespace(x=float(x), y=0.0) for x in range(3)])
    values = {'id': number, 'kind': 0, 'center': place, 'area_m2': 12.34, 'outline': outline}
    return SimpleNamespace(**({'name': ''} | values | fields))


def test_regions_have_names_areas_and_a_place_to_go_to():
    board = Board()
    picture = Picture(board)
    regions = [region(3), region(4, kind=1, name='hall\nway')]
    picture.regions(SimpleNamespace(regions=regions))
    assert [each['name'] for each in items_of(board)['regions']] == ['room 3', 'hall way']
    assert items_of(board)['regions'][0]['area'] == 12.3
    assert picture.centres == {3: (1.0, 2.0), 4: (1.0, 2.0)}
    for wrong in ({'kind': 9}, {'center': SimpleNamespace(x=np.nan, y=0.0)}, {'area_m2': np.inf}):
        with pytest.raises(InputError, match='region 5'):
            picture.regions(SimpleNamespace(regions=[region(5, **wrong)]))


def test_keep_out_areas_have_names_and_corners():
    board = Board()
    picture = Picture(board)
    corners = [SimpleNamespace(x=float(k), y=float(k * k)) for k in range(3)]

    def area(number, count, is_wall):
        polygon = SimpleNamespace(points=corners[:count])
        return SimpleNamespace(id=number, corners=polygon, is_wall=is_wall)

    picture.keep_out(SimpleNamespace(areas=[area(2, 3, False), area(5, 2, True)]))
    shown = items_of(board)['keep_out']
    assert [each['name'] for each in shown] == ['keep-out area 2', 'virtual wall 5']
    assert shown[1] == {
        'id': 5,
        'name': 'virtual wall 5',
        'is_wall': True,
        'corners': [0.0, 0.0, 1.0, 1.0],
    }
    corners[1].x = np.inf
    with pytest.raises(InputError, match='corner of a virtual wall: inf'):
        picture.keep_out(SimpleNamespace(areas=[area(5, 2, True)]))
    picture.keep_out(SimpleNamespace(areas=[]))
    assert items_of(board)['keep_out'] == []


TENTH_NS = 10**8


def shown_path(board):
    items = items_of(board)
    pieces = [items[f'path/{i}'] for i in range(items['path'])]
    assert all(a[-2:] == b[:2] for a, b in pairwise(pieces))
    flat = pieces[0] + [number for piece in pieces[1:] for number in piece[2:]]
    return np.reshape(flat, (-1, 2))


def test_a_path_in_pieces_is_the_path_and_a_correction_keeps_what_is_newer():
    board = Board()
    path = DrivenPath(board)
    for i in range(250):
        path.add(i * TENTH_NS, 0.25 * i, 0.0)
        path.add(i * TENTH_NS, 0.25 * i + 0.01, 0.0)  # hardly moved
    np.testing.assert_allclose(shown_path(board), [(0.25 * i, 0.0) for i in range(250)], atol=0.006)
    assert path.start == (0.0, 0.0)
    stamps = np.arange(0, 240, 20)
    poses = np.column_stack([stamps * 0.25, np.ones(len(stamps)), np.zeros(len(stamps))])
    path.correct(stamps * TENTH_NS, poses)
    shown = shown_path(board)
    assert len(shown) == 12 + 29 and shown[0].tolist() == [0.0, 1.0]
    assert shown[12].tolist() == [pytest.approx(55.25, abs=0.006), 0.0]
    path.add(247 * TENTH_NS, 80.0, 0.0)  # of a scan with a delay
    assert len(shown_path(board)) == len(shown) + 1
    path.add(0, 500.0, 0.0)  # time was set back
    assert shown_path(board).tolist() == [[500.0, 0.0]]


def test_the_worst_diagnostics_come_first_and_a_silent_node_is_stale():
    table = DiagnosticsTable()

    def status(name, level, message):
        return SimpleNamespace(name=name, level=level, message=message)

    table.update([status('b', b'\x00', 'fine'), status('a', b'\x01', 'slow')], now_s=0.0)
    table.update([status('c', b'\x02', 'broken\nlaser'), status('b', 0, 'fine')], now_s=4.0)
    assert table.rows(now_s=4.5) == [
        ['ERROR', 'c', 'broken laser'],
        ['WARN', 'a', 'slow'],
        ['OK', 'b', 'fine'],
    ]
    assert table.rows(now_s=5.5)[0] == ['STALE', 'a', 'silent']
    table.update([status('a', b'\x00', diagnostics.ENDED)], now_s=6.0)
    assert ENDED == diagnostics.ENDED
    assert ['OK', 'a', 'ended'] in table.rows(now_s=60.0)
    table.update((status(f'n{i}', 0, '') for i in range(1000)), now_s=6.0)
    assert len(table.rows(now_s=6.0)) == 100
