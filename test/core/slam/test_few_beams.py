"""Lasers with too few beams, or none side by side: they confirm no pose, and report why."""

import numpy as np
import pytest
from support.slam_room import ROOM, ranges_in

from thinmap_ros.core import se2
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.places.global_localizer import GlobalLocalization
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.slam.localizer import Localizer, config_with, localizer_class
from thinmap_ros.core.slam.track import LocalizerConfig
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build

START = np.array([2.0, 2.0, 0.0])
PERIOD_NS = 200_000_000
CIRCLE = 2.0 * np.pi


def scan_of(beams, T_world_base=START, spoil=None, k=0, segments=ROOM):
    """A scan of 360 degrees; spoil: changes the ranges."""
    angles = -np.pi + CIRCLE / beams * np.arange(beams)
    ranges = ranges_in(segments, np.asarray(T_world_base), angles)
    ranges[ranges >= 12.0] = np.inf
    if spoil is not None:
        spoil(ranges)
    return Scan.create(k * PERIOD_NS, ranges, -np.pi, CIRCLE / beams, 0.05, 12.0)


def all_but(value, kept):
    """Spoil all ranges but the first ones."""

    def spoil(ranges):
        ranges[kept:] = value

    return spoil


def every_second(ranges):
    ranges[::2] = np.inf


def posts(ranges):
    """Every tenth beam hits something, and no other."""
    ranges[np.arange(len(ranges)) % 10 > 0] = np.nan


def reasons(scans, localizer=None):
    localizer = localizer or Localizer(LocalizerConfig(initial_x_m=2.0, initial_y_m=2.0))
    return [localizer.step(scan, scan_pose(k)).blind_reason for k, scan in enumerate(scans)]


def scan_pose(k):
    return se2.pose(0.1 * k, 0.0, 0.0)


def driven(beams, count=10, spoil=None, first=0):
    steps = range(first, first + count)
    return [scan_of(beams, se2.compose(START, scan_pose(k)), spoil, k) for k in steps]


@pytest.mark.parametrize('slam', ['scan_matching', 'ekf_ti'])
@pytest.mark.parametrize(
    ('beams', 'spoil', 'said'),
    [
        (8, None, '8 valid beams of 8'),
        (1, None, '1 valid beams of 1'),
        (36, all_but(np.nan, 6), '6 valid beams of 36'),
        (36, all_but(0.0, 9), '9 valid beams of 36'),
        (9, all_but(np.inf, 0), '9 valid beams of 9'),
    ],
)
def test_a_laser_that_cannot_give_enough_points_is_blind(slam, beams, spoil, said):
    config = config_with({'slam': slam, 'initial_x_m': 2.0, 'initial_y_m': 2.0})
    found = reasons(driven(beams, spoil=spoil), localizer_class(config)(config))
    assert all(reason == f'{said}: expected at least 10' for reason in found)


def test_returns_of_which_no_two_are_side_by_side_are_no_surface():
    scans = driven(360, 10, every_second)
    assert all(np.count_nonzero(scan.hit) > 100 for scan in scans)
    found = reasons(scans)
    assert all(' 0 of them side by side on a surface' in reason for reason in found)


def test_after_a_scan_with_enough_points_sparse_returns_are_a_hall():
    """Isolated posts do not confirm the pose, but nothing is wrong with the laser."""
    assert reasons(driven(360, 5) + driven(360, 5, posts, first=5)) == [''] * 10


@pytest.mark.parametrize('kept', [0, 6, 9])
def test_too_few_walls_in_range_are_no_fault_of_the_laser(kept):
    assert reasons(driven(36, 5, all_but(np.inf, kept))) == [''] * 5


def test_in_a_given_map_such_a_laser_is_blind_and_not_only_lost():
    cells = np.zeros((100, 100), dtype=np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    config = LocalizerConfig(mode='localization', initial_x_m=2.0, initial_y_m=2.0)
    for beams, spoil in ((8, None), (360, every_second)):
        localizer = Localizer.in_occupancy_map(patch, config)
        assert all(reasons(driven(beams, 5, spoil), localizer))


def test_the_global_localization_waits_for_a_better_laser():
    cells = np.zeros((100, 100), dtype=np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    patch = GridPatch(GridFrame(0.0, 0.0, 0.1), cells)
    search = GlobalLocalization(patch, build(patch, None, TopologyConfig()))
    result = search.step(scan_of(8), START)
    assert '8 valid beams of 8: expected at least 10' in result.reason
