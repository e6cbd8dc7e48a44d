"""Nodes that get too little of the processor.

What they cannot take is dropped and counted, and nothing queues up.

A slow machine is made of any other by halting a process again and again; how fast this one is makes
no difference.
"""

import signal
import threading

import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import LaserScan
from test_health import Doctor

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.adapters import messages, qos

pytestmark = pytest.mark.live
MAPPING = ('localizer', 'grid_mapper', 'topology_builder')
RATE, SCANS_A_S = 8.0, 40.0
HALTED_S, AT_WORK_S = 0.45, 0.05
# What may lie between the newest scan and the one that a pose is of: the queue of the subscription,
# the scans that wait for their odometry, and what came while the process was halted with a pose in
# hand.
QUEUE, WAITING = qos.SENSOR.depth, 20
DROPS = ('scan: lost on the way or in a full queue', 'scans without odometry at their time')


class Slowed:
    """A process that has a tenth of the time."""

    def __init__(self, process):
        self._process, self._over = process, threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *error):
        self._over.set()
        self._thread.join()

    def _run(self):
        while not self._over.is_set():
            self._process.send_signal(signal.SIGSTOP)
            self._over.wait(HALTED_S)
            self._process.send_signal(signal.SIGCONT)
            self._over.wait(AT_WORK_S)


def stamps(heard):
    return [messages.stamp_ns(message.header.stamp) for message in heard]


def test_old_scans_are_dropped_and_counted_and_the_delay_does_not_grow(graph):
    doctor, scans = Doctor(graph), graph.heard('scan', LaserScan)
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    graphs = graph.heard('local_topology', TopologicalMap)
    start = {'start_x_m': 2.0, 'start_y_m': 2.0, 'start_yaw_rad': 0.9}
    process = graph.start('thinmap', arguments=MAPPING, use_sim_time=True, **start)
    graph.start('sim', start='2.0,2.0,0.9', hold_for_subscribers=3, rate=RATE)
    graph.until(lambda: len(poses) > 20 and graphs, 'poses and graphs, before it becomes slow')
    behind = {}

    def lags():
        """Scans between the newest one and that of a pose, as each pose comes."""
        for ns in stamps(poses[len(behind) :]):
            behind.setdefault(ns, (stamps(scans[-1:])[0] - ns) / 2e8)
        return list(behind.values())

    enough = len(scans) + 500
    with Slowed(process):
        graph.until(lambda: lags() and len(scans) > enough, 'scans, more than it can take')
        at_most = QUEUE + WAITING + SCANS_A_S * HALTED_S
        assert max(lags()[-20:]) <= at_most, 'what waits is bounded'
        assert len(lags()) < 0.8 * len(scans), 'or the machine was not slow'
    enough = len(poses) + 20
    graph.until(lambda: len(poses) > enough and len(graphs) > 20, 'it goes on as before')
    assert graph.stop('sim') == 0
    graph.hear_out()
    sent, located = {ns for ns in stamps(scans) if ns >= stamps(poses)[0]}, set(stamps(poses))
    missing = len(sent - located)

    def counted():
        return sum(doctor.number('localizer', f'dropped: {cause}') for cause in DROPS)

    assert missing > 100
    graph.until(lambda: counted() >= missing, f'{missing} scans, each counted')
    assert graph.stop('thinmap') == 0
