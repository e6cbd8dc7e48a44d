"""Nodes that get too little of the processor.

What they cannot take is dropped and counted, and nothing queues up.

A slow machine is made of any other by halting a process again and again, while so many scans come;
how fast this one is makes no difference.
"""

import signal

import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import LaserScan
from support.doctor import Doctor

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
MAPPING = ('localizer', 'grid_mapper', 'topology_builder')
RATE = 8.0
SCANS_WHILE_HALTED = 18
SCANS_IN_ALL = 500
SCAN_PERIOD_NS = 200_000_000
# What may wait between the newest scan and the one that a pose is of: the queue of the
# subscription, and the scans that wait for their odometry.
QUEUE = qos.SENSOR.depth
WAITING = 20
DROPS = ('scan: lost in transport or in a full queue', 'scans without odometry at their time')


def stamps(heard):
    return [messages.stamp_ns(message.header.stamp) for message in heard]


@pytest.fixture
def no_shared_memory(monkeypatch):
    """Fast DDS without its shared memory, of all participants made from now on.

    Whoever opens the shared memory of a process that has not answered for a second takes it for
    crashed and makes another one (healthy_check_timeout_ms); a process that was only halted may
    then go on to listen to the old one, and hear nothing any more. That is not what is asked here.
    """
    monkeypatch.setenv('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')


def test_old_scans_are_dropped_and_counted_and_the_delay_does_not_grow(no_shared_memory, graph):
    doctor = Doctor(graph)
    scans = graph.heard('scan', LaserScan)
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    graphs = graph.heard('local_topology', TopologicalMap)
    start = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.9}
    process = graph.start('thinmap', arguments=MAPPING, use_sim_time=True, **start)
    graph.start('sim', start='2.0,2.0,0.9', wait_for_subscribers=3, real_time_factor=RATE)
    # The scans are heard by another connection than the poses: it may be made later.
    graph.until(
        lambda: len(poses) > 20 and graphs and scans, 'poses and graphs, before it becomes slow'
    )
    behind = {}
    begun = [len(scans), len(scans)]

    def look():
        """Note how many scans the newest is ahead of a pose, as each pose comes.

        That is more than waits by as many as came since it may have been taken: since the process
        was set to work the time before.
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
        # Else what waits in the transport, which it empties only while it runs, goes on to wait.
        graph.until(lambda ns=newest_ns: look() and max(behind) >= ns, 'a pose of the newest')
    assert max(list(behind.values())[already:]) <= QUEUE + WAITING, 'what waits is bounded'
    assert len(behind) - already < 0.8 * (len(scans) - first), 'or the machine was not slow'
    enough = len(poses) + 20
    graph.until(lambda: len(poses) > enough and len(graphs) > 20, 'it goes on as before')
    assert graph.stop('sim') == 0
    graph.hear_out()
    sent = {ns for ns in stamps(scans) if ns >= stamps(poses)[0]}
    located = set(stamps(poses))
    missing = len(sent - located)

    def counted():
        return sum(doctor.number('localizer', f'dropped: {cause}') for cause in DROPS)

    assert missing > 100
    graph.until(lambda: counted() >= missing, f'{missing} scans, each counted')
    assert graph.stop('thinmap') == 0
