"""Localized scans wait for the trajectory that their pose follows, however the two arrive."""

import numpy as np
import pytest
from support.localized import localized

from thinmap_ros.core.scan import Scan
from thinmap_ros.nodes.parts.mapping import ScanQueue
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.localized_scan import localized_scan_from_msg


def scan(stamp_ns, corrected_ns=0):
    made = Scan.create(stamp_ns, np.full(181, 2.0), -1.5, 0.0166, 0.05, 8.0)
    return localized_scan_from_msg(localized(made, np.zeros(3), corrected_ns))


def trajectory(stamp_ns):
    return messages.trajectory_msg([1], np.zeros((1, 3)), 'map', stamp_ns)


def taken(queue):
    """Stamp of each scan that is ready, and of the trajectory that comes before it."""
    return [
        (each.scan.stamp_ns, each.trajectory and each.trajectory.since_ns) for each in queue.ready()
    ]


@pytest.mark.parametrize('first', ['scan', 'trajectory'])
def test_a_scan_and_its_trajectory_may_come_in_any_order(first):
    queue = ScanQueue()
    queue.add_scan(scan(1))
    assert taken(queue) == [(1, None)]
    if first == 'trajectory':
        queue.add_trajectory(trajectory(3))
    queue.add_scan(scan(2))
    queue.add_scan(scan(3, 3))
    queue.add_scan(scan(4, 3))
    if first == 'scan':
        assert taken(queue) == [(2, None)]
        queue.add_trajectory(trajectory(3))
    assert taken(queue)[-2:] == [(3, 3), (4, None)]
    assert queue.dropped == 0


def test_a_trajectory_that_a_newer_one_has_replaced_is_not_waited_for():
    queue = ScanQueue()
    queue.add_trajectory(trajectory(2))
    queue.add_trajectory(trajectory(4))
    for stamp_ns, corrected_ns in ((1, 0), (2, 2), (3, 2), (4, 4)):
        queue.add_scan(scan(stamp_ns, corrected_ns))
    assert taken(queue) == [(1, None), (2, None), (3, None), (4, 4)]


def test_a_trajectory_that_could_not_be_followed_comes_again_with_the_next_scan():
    queue = ScanQueue()
    queue.add_trajectory(trajectory(2))
    queue.add_scan(scan(2, 2))
    queue.add_scan(scan(3, 2))
    assert next(queue.ready()).trajectory.since_ns == 2  # an error ends the loop over them
    assert taken(queue) == [(3, 2)]


def test_a_localizer_that_begins_anew_is_followed():
    queue = ScanQueue()
    queue.add_trajectory(trajectory(1))
    for stamp_ns, corrected_ns in ((1, 1), (2, 0), (3, 3)):
        queue.add_scan(scan(stamp_ns, corrected_ns))
    assert taken(queue) == [(1, 1), (2, None)]
    queue.add_trajectory(trajectory(3))
    assert taken(queue) == [(3, 3)]


def test_scans_whose_trajectory_does_not_come_are_dropped_and_counted():
    queue = ScanQueue()
    for stamp_ns in range(1, qos.STREAM.depth + 4):
        queue.add_scan(scan(stamp_ns, 1))
    assert taken(queue) == [] and queue.dropped == 3
