"""Late messages are put in the order of their stamps; where the clock stepped back, they stay."""

from collections.abc import Iterator

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.logs.log import Event, OdometryEvent, ScanEvent
from thinmap_ros.logs.reading import ClockJumpError, by_stamp, stamp_of


def drive() -> list[Event]:
    events: list[Event] = []
    for k in range(200):
        ns = 10 * SECOND_NS + k * SECOND_NS // 20
        events.append(OdometryEvent(ns, se2.pose(0.02 * k, 0.0, 0.0)))
        if k % 3 == 0:
            events.append(ScanEvent(Scan.create(ns, [1.0, 2.0], 0.0, 0.1, 0.1, 8.0)))
    return events


@pytest.mark.parametrize('late', [(ScanEvent,), (ScanEvent, OdometryEvent)])
@pytest.mark.parametrize('delay_s', [0.1, 0.3, 0.9])
def test_late_messages_are_put_in_order(late: tuple[type, ...], delay_s: float) -> None:
    rng = np.random.default_rng(2)
    log = drive()
    arrival = [
        stamp_of(event)
        + (isinstance(event, late) and rng.random() < 0.3) * round(delay_s * SECOND_NS)
        for event in log
    ]
    arrived = [log[index] for index in np.argsort(arrival, kind='stable')]
    stamps = [stamp_of(event) for event in by_stamp(arrived)]
    assert stamps == sorted(stamps) != [stamp_of(event) for event in arrived]
    assert len(stamps) == len(log)


def test_the_order_stays_where_the_clock_steps_back() -> None:
    log: list[Event] = []
    for k in range(200):
        ns = 10 * SECOND_NS + k * SECOND_NS // 20 - (k // 50) * SECOND_NS // 2
        log.append(OdometryEvent(ns, se2.pose(0.02 * k, 0.0, 0.0)))
        log.append(ScanEvent(Scan.create(ns, [1.0, 2.0], 0.0, 0.1, 0.1, 8.0)))
    assert list(by_stamp(log)) == log


@pytest.mark.parametrize('shift_s', [3600, -9])
def test_a_single_wrong_stamp_holds_up_nothing(shift_s: int) -> None:
    log = drive()
    scan = ScanEvent(Scan.create((12 + shift_s) * SECOND_NS, [1.0, 2.0], 0.0, 0.1, 0.1, 8.0))
    log.insert(50, scan)
    read: list[Event] = []
    passed: list[Event] = []

    def arriving() -> Iterator[Event]:
        for event in log:
            read.append(event)
            yield event

    longest = 0
    for event in by_stamp(arriving()):
        passed.append(event)
        longest = max(longest, len(read) - len(passed))
    assert len(passed) == len(log)
    assert longest < 60, 'about two seconds of messages wait at most'


def test_what_waits_before_another_recording_is_passed_on() -> None:
    log = drive()

    def ends() -> Iterator[Event]:
        yield from log
        raise ClockJumpError('jump')

    passed = []
    with pytest.raises(ClockJumpError):
        for event in by_stamp(ends()):
            passed.append(event)
    assert passed == log
