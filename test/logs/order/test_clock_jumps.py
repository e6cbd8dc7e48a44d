"""Clocks that jump back in a log: another recording, a clock that was set, or wrong stamps."""

from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.logs.log import Event, OdometryEvent, ScanEvent, SkippedRecords
from thinmap_ros.logs.reading import ClockJumpError, ClockJumps, paired_scans, stamp_of

PERIOD_NS = SECOND_NS // 20
SCANS_EVERY = 3
START_NS = 100 * SECOND_NS


def scan_at(ns: int) -> ScanEvent:
    return ScanEvent(Scan.create(ns, [1.0, 2.0], 0.0, 0.1, 0.1, 8.0))


def drive(samples: int, is_measured: bool = True) -> list[Event]:
    """A robot at 0.4 m/s: odometry at 20 Hz, every third time with a scan."""
    events: list[Event] = []
    for k in range(samples):
        ns = START_NS + k * PERIOD_NS
        events.append(OdometryEvent(ns, se2.pose(0.02 * k, 0.0, 0.001 * k), is_measured))
        if k % SCANS_EVERY == 0:
            events.append(scan_at(ns))
    return events


def shifted(events: Iterable[Event], shift_ns: int) -> list[Event]:
    return [
        OdometryEvent(event.stamp_ns + shift_ns, event.T_odom_base, event.is_measured)
        if isinstance(event, OdometryEvent)
        else scan_at(event.scan.stamp_ns + shift_ns)
        for event in events
    ]


def filtered(events: Iterable[Event]) -> tuple[list[Event], list[str], str]:
    """Events that pass, notes, and the error that ends them."""
    notes: list[str] = []
    passed: list[Event] = []
    try:
        for event in ClockJumps(notes.append).events(events):
            passed.append(event)
    except ClockJumpError as error:
        return passed, notes, str(error)
    return passed, notes, ''


@pytest.mark.parametrize('samples', [40, 400])
@pytest.mark.parametrize('is_measured', [True, False])
def test_a_recording_that_begins_again_ends_the_first_one(samples: int, is_measured: bool) -> None:
    first = drive(samples, is_measured)
    passed, notes, error = filtered(first + drive(samples, is_measured))
    scans = [event for event in first if isinstance(event, ScanEvent)]
    back_s = (scans[-1].scan.stamp_ns - START_NS) / SECOND_NS
    assert error == (
        f'clock jumped back by {back_s:.1f} s at scan {len(scans)}: the rest is another recording'
    )
    assert passed == first
    assert notes == []


@pytest.mark.parametrize('back_s', [1.5, 20.0, 1e6])
def test_a_clock_that_is_set_back_while_the_robot_drives_on(back_s: float) -> None:
    whole = shifted(drive(200), 2 * 10**6 * SECOND_NS)
    cut = 131
    log = whole[:cut] + shifted(whole[cut:], -round(back_s * SECOND_NS))
    passed, notes, error = filtered(log)
    assert error == ''
    assert [stamp_of(event) for event in passed] == [stamp_of(event) for event in whole]
    assert [type(event) for event in passed] == [type(event) for event in whole]
    (note,) = notes
    assert f'clock was set back by {back_s:.1f} s at scan' in note


def test_a_clock_is_set_back_twice() -> None:
    whole = drive(300)
    log = [*whole[:150], *shifted(whole[150:250], -3 * SECOND_NS)]
    log += shifted(whole[250:], -6 * SECOND_NS)
    passed, notes, error = filtered(log)
    assert (error, len(notes)) == ('', 2)
    assert [stamp_of(event) for event in passed] == [stamp_of(event) for event in whole]


@pytest.mark.parametrize('shift_s', [-0.9, -5.0, 3600.0])
@pytest.mark.parametrize('index', [0, 60, 61, 64, 199])
def test_a_single_wrong_stamp_is_no_jump(shift_s: float, index: int) -> None:
    log = drive(200)
    log[index : index + 1] = shifted(log[index : index + 1], round(shift_s * SECOND_NS))
    passed, notes, error = filtered(log)
    assert (passed, notes, error) == (log, [], '')


@pytest.mark.parametrize('kind', [OdometryEvent, ScanEvent])
def test_one_stream_whose_clock_is_set_alone_is_no_jump(kind: type) -> None:
    whole = drive(200)
    log = whole[:100]
    for event in whole[100:]:
        log += shifted([event], -50 * SECOND_NS) if isinstance(event, kind) else [event]
    passed, notes, error = filtered(log)
    assert (passed, notes, error) == (log, [], '')


def test_small_steps_back_stay_as_they_are() -> None:
    rng = np.random.default_rng(1)
    log = [
        moved
        for event in drive(300)
        for moved in shifted([event], -int(rng.integers(0, 9 * SECOND_NS // 10)))
    ]
    assert filtered(log) == (log, [], '')


class TwoLaps:
    """The same drive twice."""

    is_sorted = False
    expected_scans = None

    def __init__(self) -> None:
        self.skipped = SkippedRecords()

    def events(self) -> Iterator[Event]:
        yield from drive(100)
        yield from drive(100)


def test_scans_with_odometry_are_those_of_the_first_recording() -> None:
    with pytest.warns(UserWarning, match='the rest is another recording'):
        scans = [scan.stamp_ns for scan, _ in paired_scans(TwoLaps())]
    assert scans == [event.scan.stamp_ns for event in drive(100) if isinstance(event, ScanEvent)]
