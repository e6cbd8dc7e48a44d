"""Measurements that come too rarely or too late are named, whatever the clocks show."""

import pytest

from thinmap_ros.core.sensing.synchronizer import InputStream

S = 1_000_000_000
PERIOD_NS = S // 10
TIMEOUT_NS = 4 * S // 10
LIMIT_NS = S // 2
OTHER_CLOCK_NS = 1_800_000_000 * S  # of the stamps, against that of the receiver


class Source:
    """A source whose measurements are received `late_s` after their stamps, in their order."""

    def __init__(self, clock_ns=OTHER_CLOCK_NS):
        self.stream = InputStream('laser', TIMEOUT_NS, LIMIT_NS)
        self.now_ns = 5 * S
        self.clock_ns = clock_ns
        self._late_s = 0.0

    def send(self, count=10, late_s=0.0, period_ns=PERIOD_NS):
        """Send measurements; the fault after the last one."""
        self.now_ns += round(max(late_s - self._late_s, 0.0) * S)  # nothing is received meanwhile
        self._late_s = late_s
        for _ in range(count):
            self.now_ns += period_ns
            stamp_ns = self.clock_ns + self.now_ns - round(late_s * S)
            self.stream.add(stamp_ns, self.now_ns, self.now_ns - stamp_ns)
        return self.stream.fault(self.now_ns)


@pytest.mark.parametrize('clock_ns', [OTHER_CLOCK_NS, 0, -3 * S])
def test_regular_measurements_are_no_fault_whatever_the_offset_of_their_clock(clock_ns):
    assert Source(clock_ns).send(100, late_s=0.2) == ''


def test_before_the_first_measurement_there_is_no_fault():
    assert Source().stream.fault(100 * S) == ''


def test_silence_is_told_with_its_length_and_ends_with_the_next_measurement():
    source = Source()
    source.send()
    assert source.stream.fault(source.now_ns + TIMEOUT_NS) == ''
    assert source.stream.fault(source.now_ns + 3 * S) == 'laser silent for 3.0 s'
    source.now_ns += 3 * S
    assert source.send(1) == ''


@pytest.mark.parametrize('late_s', [0.6, 1.0, 5.0])
def test_late_measurements_are_a_fault_as_long_as_they_are_late(late_s):
    source = Source()
    source.send(late_s=0.1)
    expected = f'laser {late_s - 0.1:.1f} s late: expected at most 0.5 s'
    for minutes in range(30):
        source.send(600, late_s)
        if late_s > 0.6:
            assert source.stream.fault(source.now_ns) == expected, f'{minutes} min'
    assert source.send(late_s=0.1) == ''


def test_a_delay_at_the_limit_is_allowed():
    source = Source()
    source.send(late_s=0.0)
    assert source.send(late_s=0.5) == ''
    assert 'late' in source.send(late_s=0.51)


@pytest.mark.parametrize('step_s', [-86400.0, -100.0, -0.5, 0.5, 100.0, 86400.0])
def test_a_clock_that_is_set_stops_nobody(step_s):
    source = Source()
    source.send(late_s=0.1)
    source.clock_ns += round(step_s * S)
    assert source.send(2, late_s=0.1) == ''
    assert source.send(late_s=0.1) == ''
    assert 'late' in source.send(late_s=0.8)


@pytest.mark.parametrize('drift', [-1e-4, 1e-4])
def test_clocks_that_drift_apart_for_a_day_stop_nobody(drift):
    source = Source()
    source.send()
    for _ in range(86400):
        source.clock_ns += round(drift * S)
        assert source.send(1, period_ns=S // 4 * 4) in (
            '',
            'laser at 1.0 Hz: expected at least 2.5 Hz',
        )
    source.send(late_s=0.0)
    assert 'late' in source.send(late_s=0.8)


def test_stamps_in_the_wrong_order_hide_no_delay():
    source = Source()
    source.send()
    source.send(late_s=1.4)
    for _ in range(20):
        source.send(1, late_s=1.0)
        source.now_ns -= 4 * S // 10  # the next one was overtaken, and comes right after it
        assert 'late' in source.send(1, late_s=1.4)


def test_a_low_rate_is_told_with_the_rate_that_is_needed_also_just_after_a_measurement():
    source = Source()
    expected = 'laser at 1.0 Hz: expected at least 2.5 Hz'
    assert source.send(6, period_ns=S) == expected
    assert source.stream.fault(source.now_ns + S) == expected
    assert source.stream.fault(source.now_ns + 4 * S) == 'laser silent for 4.0 s'
    assert source.send(6) == ''
