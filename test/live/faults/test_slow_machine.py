"""Nodes with too little CPU time.

Messages that they cannot process are dropped and counted, and no queue grows.

Halting a process repeatedly simulates a slow machine, for a number of scans per halt; the speed of
this machine makes no difference.
"""

import signal
import time

import pytest
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor

from thinmap_msgs.msg import LocalizedScan, TopologicalMap
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
MAPPING = ('localizer', 'grid_mapper', 'topology_builder')
HALTED_S = 2.0
RATE = 8.0
SCANS_WHILE_HALTED = 18
SCANS_IN_ALL = 500
SCAN_PERIOD_NS = 200_000_000
# Scans that may wait between the newest one and that of a pose: the queue of the subscription, and
# the scans that wait for their odometry.
QUEUE = qos.SENSOR.depth
WAITING = 20
DROPS = ('scan: lost in transport or in a full queue', 'scans without odometry at their time')


def stamps(heard):
    return [messages.stamp_ns(message.header.stamp) for message in heard]


@pytest.fixture
def no_shared_memory(monkeypatch):
    """Disable shared memory of Fast DDS for all participants created from now on.

    A process that opens the shared memory of one that has not responded for a second assumes a
    crash and creates another segment (healthy_check_timeout_ms). A process that was only halted may
    then keep the old segment, and receive nothing any more. This is not the subject of this test.
    """
    monkeypatch.setenv('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')


def test_a_simulation_in_real_time_makes_up_what_it_has_missed(graph):
    """Its stamps keep their distance from the clock: other nodes judge by it what is late."""
    odometry = graph.heard('odom', Odometry)
    process = graph.start('sim', start='2.0,2.0,0.9')

    def behind_s():
        return time.monotonic() - stamps(odometry)[-1] / SECOND_NS

    graph.until(lambda: len(odometry) > 20, 'odometry')
    usual_s = behind_s()
    process.send_signal(signal.SIGSTOP)
    graph.until(lambda: behind_s() > usual_s + HALTED_S, 'stamps that are behind')
    process.send_signal(signal.SIGCONT)
    graph.until(lambda: behind_s() < usual_s + 0.5 * HALTED_S, 'stamps that have caught up')


def test_old_scans_are_dropped_and_counted_and_the_delay_does_not_grow(no_shared_memory, graph):
    doctor = Doctor(graph)
    scans = graph.heard('scan', LaserScan)
    # Not the topic pose, whose publisher keeps the last one alone: a busy test would miss some.
    poses = graph.heard('localized_scan', LocalizedScan)
    graphs = graph.heard('local_topology', TopologicalMap)
    start = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.9}
    process = graph.start('thinmap', arguments=MAPPING, use_sim_time=True, **start)
    graph.start('sim', start='2.0,2.0,0.9', wait_for_subscribers=2, real_time_factor=RATE)
    # Discovery of the scans' publisher may take longer than that of the poses'.
    graph.until(
        lambda: len(poses) > 20 and graphs and scans, 'poses and graphs, before it becomes slow'
    )
    behind = {}
    begun = [len(scans), len(scans)]

    def look():
        """Record at each pose by how many scans the newest one is ahead.

        This exceeds the number of waiting scans by those that were published since the process was
        resumed the time before.
        """
        for ns in stamps(poses[len(behind) :]):
            ahead = (stamps(scans[-1:])[0] - ns) / SCAN_PERIOD_NS
            behind.setdefault(ns, ahead - (len(scans) - begun[-2]))
        return len(behind)

    look()
    already = len(behind)
    first = len(scans)
    while len(scans) < first + SCANS_IN_ALL:
        process.send_signal(signal.SIGSTOP)
        halted = len(scans) + SCANS_WHILE_HALTED
        graph.until(lambda n=halted: look() and len(scans) > n, 'scans that nobody takes')
        begun.append(len(scans))
        newest_ns = stamps(scans[-1:])[0]
        process.send_signal(signal.SIGCONT)
        # Otherwise messages stay in the transport, which the process empties only while it runs.
        graph.until(lambda ns=newest_ns: look() and max(behind) >= ns, 'a pose of the newest')
    assert max(list(behind.values())[already:]) <= QUEUE + WAITING, 'what waits is bounded'
    assert len(behind) - already < 0.8 * (len(scans) - first), 'or the machine was not slow'
    enough = len(poses) + 20
    graph.until(lambda: len(poses) > enough and len(graphs) > 20, 'it continues as before')
    assert graph.stop('sim') == 0
    graph.drain()
    # What is lost is noticed with the next scan: not at the end.
    sent = {ns for ns in stamps(scans) if stamps(poses)[0] <= ns <= max(stamps(poses))}
    located = set(stamps(poses))
    missing = len(sent - located)

    def counted():
        return sum(doctor.number('localizer', f'dropped: {cause}') for cause in DROPS)

    assert missing > 100
    graph.until(lambda: counted() >= missing, f'{missing} scans, each counted')
    assert graph.stop('thinmap') == 0
