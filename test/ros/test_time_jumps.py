"""Time for time-outs: it follows a simulation, stands while that is paused, and does not jump."""

from threading import Thread
from time import monotonic_ns

import pytest
import rclpy
from rclpy.clock import ClockType, JumpThreshold, ROSClock
from rclpy.duration import Duration
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from thinmap_ros.ros.executor import NodeExecutor
from thinmap_ros.ros.time_jumps import ElapsedTime, shared_clocks

S = 1_000_000_000


class Simulation:
    """A clock that a simulation sets."""

    def __init__(self, start_ns=100 * S):
        self.clock = ROSClock()
        self.clock._set_ros_time_is_active(True)
        self.now_ns = start_ns
        self.advance(0)

    def advance(self, ns):
        self.now_ns += ns
        self.clock.set_ros_time_override(
            Time(nanoseconds=self.now_ns, clock_type=self.clock.clock_type)
        )


def test_simulated_time_elapses_as_it_is_published():
    simulation = Simulation()
    time = ElapsedTime(simulation.clock)
    before = time.now_ns()
    for _ in range(40):
        simulation.advance(S // 4)
    assert time.is_simulated
    assert time.timer_clock is simulation.clock
    assert time.now_ns() - before == 10 * S
    assert time.now_s() == pytest.approx(time.now_ns() / 1e9)


@pytest.mark.parametrize('jump_s', [-300, -2, 2, 61, 100, 86400])
def test_a_jump_is_no_time(jump_s):
    simulation = Simulation(1_000_000 * S)
    time = ElapsedTime(simulation.clock)
    before = time.now_ns()
    simulation.advance(jump_s * S)
    assert time.now_ns() == before
    simulation.advance(S // 10)
    assert time.now_ns() - before == S // 10


def test_another_thread_does_not_see_half_of_a_jump():
    simulation = Simulation()
    seen = []
    reader = Thread(target=lambda: seen.append(time.now_ns()))

    def read(jump):
        reader.start()
        reader.join(timeout=0.1)

    threshold = JumpThreshold(
        min_forward=Duration(seconds=50), min_backward=None, on_clock_change=False
    )
    earlier = simulation.clock.create_jump_callback(threshold, post_callback=read)
    time = ElapsedTime(simulation.clock)
    before = time.now_ns()
    simulation.advance(100 * S)
    reader.join()
    assert seen == [before]
    earlier.unregister()


def test_nodes_of_a_process_follow_the_clock_by_one_subscription(ros_domain):
    rclpy.init(args=['--ros-args', '-p', 'use_sim_time:=true'])
    nodes = [rclpy.create_node(name) for name in ('one', 'other')]
    assert not list(shared_clocks(nodes[:1]))
    (shared,) = shared_clocks(nodes)
    executor = NodeExecutor(shared)
    publisher = nodes[0].create_publisher(Clock, '/clock', 1)
    try:
        assert nodes[0].count_subscribers('/clock') == 1
        for _ in range(1000):
            publisher.publish(Clock(clock=Time(seconds=5).to_msg()))
            ready = executor.next_callback(timeout_s=0.01)
            if ready is not None:
                ready.call()
                break
        assert [node.get_clock().now().nanoseconds for node in nodes] == [5 * S, 5 * S]
    finally:
        executor.shutdown()
        shared.close()
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()


def test_the_first_time_of_a_simulation_is_the_beginning():
    simulation = Simulation(0)
    time = ElapsedTime(simulation.clock)
    simulation.advance(1_800_000_000 * S)
    assert time.now_ns() == 0


def test_the_age_of_a_simulated_stamp_is_exact_and_never_negative():
    simulation = Simulation()
    time = ElapsedTime(simulation.clock)
    simulation.advance(100 * S)
    assert time.age_ns(simulation.now_ns - S) == S
    assert time.age_ns(simulation.now_ns + S) == 0


def test_without_simulation_it_is_the_steady_clock_of_the_machine():
    time = ElapsedTime(ROSClock())
    assert not time.is_simulated
    assert time.timer_clock.clock_type == ClockType.STEADY_TIME
    first = monotonic_ns()
    assert first <= time.now_ns() <= monotonic_ns()
    assert time.age_ns(7) <= monotonic_ns() - 7
    assert time.age_ns(7) - time.age_ns(1007) == pytest.approx(1000, abs=S)
