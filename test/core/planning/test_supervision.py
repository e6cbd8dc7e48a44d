"""Bases that move more than they are commanded, and what is no such case."""

from collections import deque

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from thinmap_ros.core.planning.navigator import NavigatorConfig
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.core.planning.supervision import BaseSupervisor
from thinmap_ros.core.se2 import pose
from thinmap_ros.sim.robot import after_arc

CONTROLLER = PathFollowerConfig(max_speed_m_s=0.5)
CONFIG = NavigatorConfig(controller=CONTROLLER)
TICK_S = 0.01


class Base:
    """A supervised base with a dead time that follows its commands within its acceleration."""

    def __init__(self, rate_hz=20.0, dead_s=0.1, acceleration=0.5, noise_m=0.0, lever_m=0.0):
        self.supervisor = BaseSupervisor(CONFIG)
        self.executed = lambda v, w: (v, w)  # a fault of the base
        self.seen = lambda T, stamp_s: T  # a fault of the odometry
        self.now_s = 0.0
        self.T = np.zeros(3)
        self.v = self.w = 0.0
        self._period = round(1.0 / rate_hz / TICK_S)
        self._underway = deque([(0.0, 0.0)] * (round(dead_s / TICK_S) + 1))
        self._acceleration = acceleration
        self._noise_m = noise_m
        self._lever_m = lever_m
        self._rng = np.random.default_rng(7)
        self._ticks = 0

    def drive(self, seconds, v=0.0, w=0.0):
        """Command v, w at 10 Hz; returns the first fault, and when it was named, s."""
        begun_s = self.now_s
        named = ('', None)
        for tick in range(round(seconds / TICK_S)):
            if tick % 10 == 0:
                self.supervisor.add_command(self.now_s, v, w)
            self._step(v, w)
            if self.supervisor.fault and not named[0]:
                named = (self.supervisor.fault, self.now_s - begun_s)
        return named

    def _step(self, v, w):
        self.now_s += TICK_S
        self._ticks += 1
        self._underway.append((v, w))
        v, w = self.executed(*self._underway.popleft())
        most = self._acceleration * TICK_S
        self.v += min(max(v - self.v, -most), most)
        self.w += min(max(w - self.w, -6 * most), 6 * most)
        self.T = after_arc(self.T, self.v * TICK_S, self.w * TICK_S)
        if self._ticks % self._period == 0:
            T = after_arc(self.T, self._lever_m, 0.0)
            T = T + self._noise_m * self._rng.standard_normal(3)
            self.supervisor.add_odometry(
                self.now_s, round(1e9 * self.now_s), self.seen(pose(*T), self.now_s)
            )


RATES = [2.5, 5.0, 10.0, 20.0, 50.0, 100.0]


@pytest.mark.parametrize('rate_hz', RATES)
def test_a_base_at_twice_the_speed_is_named_within_its_first_metre(rate_hz):
    base = Base(rate_hz, acceleration=2.0)
    base.executed = lambda v, w: (2.0 * v, w)
    fault, after_s = base.drive(3.0, 0.5)
    assert fault.startswith('the base moves at ') and fault.endswith('commanded at most 0.50 m/s')
    assert after_s < 1.4 + 1.0 / rate_hz


def test_a_fast_base_is_faulty_until_somebody_has_seen_to_it():
    base = Base()
    base.executed = lambda v, w: (2.0 * v, w)
    assert base.drive(4.0, 0.5)[0]
    base.executed = lambda v, w: (v, w)
    base.drive(10.0)
    assert base.supervisor.fault and not base.supervisor.is_creeping
    base.supervisor.release()
    assert base.drive(10.0, 0.5) == ('', None)


@pytest.mark.parametrize('rate_hz', RATES)
@pytest.mark.parametrize(
    ('creep', 'words', 'most_s'),
    [((0.15, 0.0), 'moves at 0.1', 1.6), ((0.05, 0.0), 'moves at 0.0', 3.6)]
    + [((-0.15, 0.0), 'moves at 0.1', 1.6), ((0.0, 0.3), 'turns at 0.', 3.6)],
)
def test_a_base_that_creeps_is_named_until_it_stands(rate_hz, creep, words, most_s):
    base = Base(rate_hz)
    base.drive(3.0, 0.3)
    assert base.drive(4.0) == ('', None)
    base.executed = lambda v, w: creep
    fault, after_s = base.drive(6.0)
    assert words in fault and fault.endswith('and is commanded to stand')
    assert after_s < most_s + 3.0 / rate_hz
    assert base.supervisor.is_creeping
    base.executed = lambda v, w: (v, w)
    base.drive(6.0)
    assert not base.supervisor.fault and not base.supervisor.is_creeping


def test_a_base_that_does_not_stop_is_named():
    base = Base()
    base.drive(4.0, 0.5)
    base.executed = lambda v, w: (0.5, 0.0)
    fault, after_s = base.drive(5.0)
    assert fault.endswith('and is commanded to stand')
    assert after_s < 4.0


def test_a_turn_at_twice_the_rate_is_named():
    base = Base()
    base.executed = lambda v, w: (v, 2.0 * w)
    assert base.drive(4.0, 0.0, 1.0)[0].startswith('the base turns at ')


@pytest.mark.parametrize('rate_hz', RATES)
@pytest.mark.parametrize(
    'base',
    [
        {},
        {'dead_s': 0.8},
        {'dead_s': 0.8, 'acceleration': 0.25},
        {'acceleration': 10.0},
        {'noise_m': 0.005},
        {'noise_m': 0.01, 'dead_s': 0.8},
        {'lever_m': -0.2},
    ],
    ids=str,
)
def test_a_base_that_obeys_is_never_named(rate_hz, base):
    base = Base(rate_hz, **base)
    for v, w, seconds in [
        (0.5, 0.0, 4.0),
        (0.0, 0.0, 5.0),
        (0.0, 1.0, 6.0),
        (0.0, 0.0, 3.0),
        (0.3, 0.8, 3.0),
        (0.1, -0.2, 3.0),
        (0.5, -0.3, 2.0),
        (0.0, -1.0, 2.0),
        (0.0, 0.0, 20.0),
    ]:
        assert base.drive(seconds, v, w) == ('', None), (v, w)


COMMANDS = st.lists(
    st.tuples(st.floats(0.0, 0.5), st.floats(-1.0, 1.0), st.floats(0.1, 3.0), st.booleans()),
    min_size=1,
    max_size=8,
)


@given(COMMANDS, st.sampled_from(RATES), st.floats(0.0, 0.8), st.floats(0.25, 5.0))
def test_no_commands_make_an_obedient_base_faulty(commands, rate_hz, dead_s, acceleration):
    base = Base(rate_hz, dead_s, acceleration)
    for v, w, seconds, stands in commands:
        told = (0.0, 0.0) if stands else (v, w)
        assert base.drive(seconds, *told) == ('', None)


@pytest.mark.parametrize('rate_hz', RATES[2:])
@pytest.mark.parametrize('v', [0.0, 0.5])
def test_odometry_that_jumps_is_no_motion(rate_hz, v):
    base = Base(rate_hz)
    jumps = np.random.default_rng(3).uniform(-3.0, 3.0, (100, 3))
    base.seen = lambda T, stamp_s: T + jumps[int(stamp_s)]  # one in each second
    assert base.drive(40.0, v, 0.1) == ('', None)


@pytest.mark.parametrize('rate_hz', RATES)
def test_late_and_repeated_stamps_are_no_motion(rate_hz):
    base = Base(rate_hz)
    shift = np.random.default_rng(4).normal(0.0, 0.02, 10_000)
    add = base.supervisor.add_odometry
    base.supervisor.add_odometry = lambda now_s, ns, T: add(
        now_s + 0.4, ns - 10**11 + round(1e9 * shift[base._ticks % 10_000]), T
    )
    for _ in range(4):
        assert base.drive(3.0, 0.5, 0.2) == ('', None)
        assert base.drive(5.0) == ('', None)


def test_wheels_that_slip_or_are_blocked_are_no_overspeed():
    base = Base()
    base.executed = lambda v, w: (0.5 * v, 0.25 / 0.2)  # one wheel stands: it turns about it
    assert base.drive(0.5, 0.5) == ('', None)
    base.executed = lambda v, w: (0.0, 0.0)
    assert base.drive(10.0, 0.5, 0.5) == ('', None)


def test_what_somebody_else_commands_is_no_creeping():
    base = Base()
    base.drive(3.0)
    base.executed = lambda v, w: (0.8, 0.5)
    base.supervisor.set_unheard(base.now_s, True)
    assert base.drive(10.0) == ('', None)
    base.supervisor.set_unheard(base.now_s, False)
    base.executed = lambda v, w: (v, w)
    assert base.drive(10.0) == ('', None)
    base.executed = lambda v, w: (0.15, 0.0)
    assert base.drive(5.0)[0]


def test_a_command_that_somebody_left_standing_is_creeping():
    base = Base()
    base.drive(3.0)
    base.supervisor.set_unheard(base.now_s, True)
    base.executed = lambda v, w: (0.1, 0.0)
    assert base.drive(2.0) == ('', None)
    base.supervisor.set_unheard(base.now_s, False)
    fault, after_s = base.drive(8.0)
    assert fault.endswith('and is commanded to stand') and after_s < 5.0


def test_before_the_first_command_nothing_is_known():
    supervisor = BaseSupervisor(CONFIG)
    for k in range(100):
        supervisor.add_odometry(0.1 * k, 10**8 * k, np.array([0.1 * k, 0.0, 0.0]))
    assert not supervisor.fault
