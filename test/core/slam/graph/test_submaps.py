"""Submaps of earlier visits: their keyframes, and when they are rebuilt."""

from dataclasses import replace

import numpy as np
import pytest
from support.slam_room import ROOM, scan_in

from thinmap_ros.core import se2
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.loop_closure import AGAIN_M, Submaps
from thinmap_ros.core.slam.matching.local_map import LocalMap, LocalMapConfig
from thinmap_ros.core.slam.matching.scan_matcher import Matcher
from thinmap_ros.core.slam.matching.surface import surface_points

CONFIG = LocalMapConfig()


def there_in(segments, pose, k):
    scan = scan_in(segments, pose, stamp_ns=k)
    return Keyframe(scan, surface_points(scan), pose, float(k), np.zeros((3, 3)), 0)


@pytest.fixture(scope='module')
def frames():
    return [there_in(ROOM, se2.pose(2.0 + 0.2 * k, 2.0 + 0.1 * k, 0.1 * k), k) for k in range(30)]


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


def test_a_scan_of_the_way_back_stays_where_it_is():
    """In a smooth corridor, seen by a laser that looks ahead: the other way, it sees other walls.

    Where too little of what it sees is known, it slides to known walls, past the niches.
    """
    ends = [[0.0, 26.0], [28.5, 60.0]]
    walls = [[a, y, b, y] for y in (0.0, 2.0) for a, b in ends]
    niches = [[26.0, y, 28.5, y] for y in (-0.4, 2.4)]
    corridor = np.array(walls + niches)
    frames = [there_in(corridor, se2.pose(5.0 + 0.7 * k, 1.0, 0.0), k) for k in range(60)]
    here = se2.pose(frames[36].T_map_base[0], 1.0, np.pi)
    scan = scan_in(corridor, here)
    base, submap = Submaps(CONFIG).around(frames, 36, 100.0, looks_back=True)
    prior = se2.between(base, here)
    sure_of_line = np.diag([4.0, 0.01, 1e-3])
    found = (
        Matcher().match(surface_points(scan), scan.T_base_laser, submap, prior, sure_of_line).pose
    )
    assert np.hypot(*(found - prior)[:2]) < 0.1
