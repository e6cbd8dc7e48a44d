"""A motion that no command follows is ended, also while the node is busy."""

from threading import Event

import pytest

from thinmap_ros.ros.velocity import CommandTimeout, CommandWatchdog


@pytest.mark.parametrize(('is_simulated', 'limit_s'), [(False, 0.5), (True, 2.0)])
def test_a_motion_expires_once_after_its_time(is_simulated, limit_s):
    timeout = CommandTimeout(is_simulated)
    timeout.add(True, 10.0)
    assert not timeout.expires(10.0 + limit_s)
    assert timeout.expires(10.01 + limit_s)
    assert not timeout.expires(20.0)
    timeout.add(True, 30.0)
    assert timeout.expires(31.0) or is_simulated


def test_each_command_starts_the_time_anew_and_a_stop_never_expires():
    timeout = CommandTimeout(False)
    for k in range(20):
        timeout.add(True, 0.4 * k)
        assert not timeout.expires(0.4 * k + 0.4)
    timeout.add(False, 8.0)
    assert not timeout.expires(1000.0)


def test_before_any_command_nothing_expires():
    assert not CommandTimeout(False).expires(1e9)


def test_a_robot_in_real_time_is_stopped_after_the_same_time_however_slow_its_commands_were():
    timeout = CommandTimeout(False)
    for k in range(20):
        timeout.add(True, 2.0 * k)
    assert timeout.expires(38.6)


def test_in_a_slow_simulation_commands_may_be_as_far_apart_as_usual():
    timeout = CommandTimeout(True)
    for k in range(20):
        timeout.add(True, 2.0 * k)
        assert k == 0 or not timeout.expires(2.0 * k + 1.9)
    assert timeout.limit_s == pytest.approx(10.0)
    assert timeout.expires(48.1), 'it is paused'


def test_a_stop_is_published_once_and_told_while_nobody_calls():
    commands = []
    told = Event()
    seconds = []

    def on_stop(limit_s):
        seconds.append(limit_s)
        told.set()

    watchdog = CommandWatchdog(lambda v, w: commands.append((v, w)), on_stop, CommandTimeout(False))
    watchdog.send(0.4, 0.1)
    assert told.wait(60.0)
    watchdog.close()
    assert commands == [(0.4, 0.1), (0.0, 0.0)]
    assert seconds == [0.5]


def test_a_closed_one_publishes_nothing_by_itself():
    commands = []
    watchdog = CommandWatchdog(lambda v, w: commands.append((v, w)), print, CommandTimeout(False))
    watchdog.close()
    watchdog.send(0.0, 0.3)
    watchdog._thread.join()
    assert commands == [(0.0, 0.3)]
