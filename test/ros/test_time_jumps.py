"""Time for time-outs: it follows a simulation, stands while that is paused, and does not jump."""

from time import monotonic_ns

import pytest
from rclpy.clock import ClockType, ROSClock
from rclpy.time import Time

from thinmap_ros.ros.time_jumps import ElapsedTime

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
