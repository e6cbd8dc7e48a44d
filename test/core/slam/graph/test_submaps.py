"""Submaps of earlier visits: their keyframes, and when they are rebuilt."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.loop_closure import AGAIN_M, Submaps
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig
from thinmap_ros.core.slam.matching.surface import surface_points

CONFIG = LocalMapConfig()


@pytest.fixture(scope='module')
def frames():
    kept = []
    for k in range(30):
        pose = se2.pose(2.0 + 0.2 * k, 2.0 + 0.1 * k, 0.1 * k)
        scan = scan_in(ROOM, pose, stamp_ns=k)
        points = surface_points(scan)
        kept.append(Keyframe(scan, points, pose, float(k), np.zeros((3, 3)), 0))
    return kept


def expected(frames, base, numbers):
    submap = LocalMap(CONFIG)
    for i in numbers:
        T = se2.between(base, frames[i].T_map_base)
        submap.add_scan(frames[i].points, frames[i].scan.T_base_laser, T)
    return submap.state()


def assert_holds(found, frames, centre, numbers):
    base, submap = found
    np.testing.assert_array_equal(base, frames[centre].T_map_base)
    state = expected(frames, base, numbers)
    for name, array in submap.state().items():
        np.testing.assert_array_equal(array, state[name])


def test_it_holds_the_keyframes_around_one(frames):
    assert_holds(Submaps(CONFIG).around(frames, 10, 29.0), frames, 10, range(6, 15))
    assert_holds(Submaps(CONFIG).around(frames, 8, 29.0), frames, 10, range(6, 15))
    assert_holds(Submaps(CONFIG).around(frames, 0, 29.0), frames, 2, range(7))
    assert_holds(Submaps(CONFIG).around(frames[:10], 9, 9.0), frames, 9, range(5, 10))


def test_it_holds_nothing_of_the_visit_that_is_matched_with_it(frames):
    path_m = 12.0 + AGAIN_M
    assert_holds(Submaps(CONFIG).around(frames, 11, path_m), frames, 10, range(6, 12))
    assert_holds(Submaps(CONFIG).before(frames, 29), frames, 29, range(25, 30))


def test_it_holds_nothing_of_another_local_map(frames):
    mixed = [replace(frame, submap=k // 9) for k, frame in enumerate(frames)]
    assert_holds(Submaps(CONFIG).around(mixed, 10, 29.0), mixed, 10, range(9, 15))
    assert_holds(Submaps(CONFIG).around(mixed, 8, 29.0), mixed, 10, range(6, 9))


def test_neighbours_share_one_until_keyframes_move(frames):
    submaps = Submaps(CONFIG)
    first = submaps.around(frames, 8, 29.0)[1]
    for j in (9, 10, 11):
        assert submaps.around(frames, j, 29.0)[1] is first
    assert submaps.around(frames, 12, 29.0)[1] is not first
    assert submaps.around(frames, 8, 29.0)[1] is first
    submaps.clear()
    assert submaps.around(frames, 8, 29.0)[1] is not first


def test_few_are_kept(frames):
    submaps = Submaps(CONFIG)
    first = submaps.around(frames, 0, 29.0)[1]
    for j in (4, 8, 12):
        submaps.around(frames, j, 29.0)
    assert submaps.around(frames, 0, 29.0)[1] is not first
