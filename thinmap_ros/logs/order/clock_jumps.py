"""Clocks that jump back in the middle of a log: it ends there, or continues on one time line."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import CLOCK_JUMP_NS, SECOND_NS, Array
from thinmap_ros.logs.log import Event, OdometryEvent, ScanEvent

# Odometry continues where it moves at most so many steps as before: two samples may be lost.
_STEPS = 3
_REST_M = 0.02
_REST_RAD = 0.02


class ClockJumpError(InputError):
    """The clock of a log jumped back, and the odometry does not continue."""


def stamp_of(event: Event) -> int:
    """Stamp of an event, ns."""
    return event.stamp_ns if isinstance(event, OdometryEvent) else event.scan.stamp_ns


@dataclasses.dataclass
class _Stream:
    """Stamps of one kind of events.

    before_ns: the last one before it stepped back; None: it goes on. begun_ns: the last one when
    events began to be held back. shift_ns: what is added to its stamps.
    """

    last_ns: int
    before_ns: int | None = None
    begun_ns: int = 0
    shift_ns: int = 0

    def add(self, ns: int) -> None:
        """Take the next stamp."""
        if self.before_ns is None and self.last_ns - ns > CLOCK_JUMP_NS:
            self.before_ns = self.last_ns
        elif self.before_ns is not None and not self.is_after_step(ns):
            self.before_ns = None  # a single stamp was wrong
        self.last_ns = ns

    def is_after_step(self, ns: int) -> bool:
        """Whether a stamp belongs to the time after the step back."""
        return self.before_ns is not None and ns < self.before_ns - CLOCK_JUMP_NS


class ClockJumps:
    """Filters the events of a log, in the order of their arrival.

    Stamps of real robots step back a little now and then, and single ones are wrong. The clock has
    jumped back where odometry and scans both go on from more than `CLOCK_JUMP_NS` earlier, as
    for the clock of live nodes. Where the odometry continues, the clock was
    set back while the robot drove on: later stamps are moved on by the jump. Where it does not,
    another recording begins.
    """

    def __init__(self, note: Callable[[str], None]) -> None:
        """note: receives a line on a clock that was set back."""
        self._note = note
        self._streams: dict[type, _Stream] = {}
        self._held: list[Event] = []  # while one of the streams has stepped back
        self._last: list[OdometryEvent] = []  # the last two that were passed on
        self._scans = 0

    def events(self, events: Iterable[Event]) -> Iterator[Event]:
        """Events on one time line. Raises ClockJumpError where another recording begins."""
        for event in events:
            stream = self._streams.setdefault(type(event), _Stream(stamp_of(event)))
            moved = _moved(event, stream.shift_ns)
            stream.add(stamp_of(moved))
            yield from self._filtered(moved)
        yield from self._passed_on(self._held)

    def _filtered(self, event: Event) -> Iterator[Event]:
        streams = self._streams.values()
        stepped = [stream for stream in streams if stream.before_ns is not None]
        if not (stepped or self._held):
            yield from self._passed_on([event])
            return
        if not self._held:
            for stream in streams:
                stream.begun_ns = stream.last_ns
        self._held.append(event)
        others = [stream for stream in streams if stream.before_ns is None]
        if not others:
            yield from self._jumped()
        elif not stepped or any(s.last_ns - s.begun_ns > CLOCK_JUMP_NS for s in others):
            # A single stamp was wrong, or that of one stream alone.
            yield from self._released(self._held)

    def _jumped(self) -> Iterator[Event]:
        held = self._held
        before = [event for event in held if not self._is_after(event)]
        first = next((e for e in held if isinstance(e, OdometryEvent) and self._is_after(e)), None)
        yield from self._passed_on(before)
        if first is None or not self._continues(first):
            raise ClockJumpError(
                f'clock jumped back by {self._back_ns() / SECOND_NS:.1f} s at scan {self._scans}: '
                'the rest is another recording'
            )
        shift_ns = self._last[-1].stamp_ns + self._period_ns() - first.stamp_ns
        self._note(
            f'clock was set back by {shift_ns / SECOND_NS:.1f} s at scan {self._scans} while the '
            'odometry continues: later stamps are moved on by that'
        )
        after = [_moved(event, shift_ns) for event in held if self._is_after(event)]
        for stream in self._streams.values():
            stream.shift_ns += shift_ns
            stream.last_ns += shift_ns
        yield from self._released(after)

    def _back_ns(self) -> int:
        """Step of the scans, or of the odometry in a log that begins with it."""
        scans = [event for event in self._held if isinstance(event, ScanEvent)]
        first = next(event for event in scans or self._held if self._is_after(event))
        return (self._streams[type(first)].before_ns or 0) - stamp_of(first)

    def _released(self, events: list[Event]) -> Iterator[Event]:
        self._held = []
        for stream in self._streams.values():
            stream.before_ns = None
        yield from self._passed_on(events)

    def _passed_on(self, events: list[Event]) -> Iterator[Event]:
        for event in events:
            if isinstance(event, OdometryEvent):
                earlier = [last for last in self._last if last.stamp_ns < event.stamp_ns]
                self._last = [*earlier[-1:], event]
            else:
                self._scans += 1
            yield event

    def _is_after(self, event: Event) -> bool:
        return self._streams[type(event)].is_after_step(stamp_of(event))

    def _period_ns(self) -> int:
        """Time between the last two samples of the odometry."""
        return self._last[-1].stamp_ns - self._last[0].stamp_ns

    def _continues(self, first: OdometryEvent) -> bool:
        """Whether the odometry continues to this sample as it did to the last one.

        A log without odometry cannot tell.
        """
        if not (self._last and first.is_measured):
            return False
        before = self._last[0].T_odom_base
        last = self._last[-1].T_odom_base
        moved_m, turned_rad = _motion(before, last)
        found_m, found_rad = _motion(last, first.T_odom_base)
        is_near = found_m <= _STEPS * moved_m + _REST_M
        return is_near and found_rad <= _STEPS * turned_rad + _REST_RAD


def _motion(before: Array, after: Array) -> tuple[float, float]:
    """Distance (m) and turn (rad) between two poses (3,)."""
    x, y, yaw = se2.between(before, after).tolist()
    return math.hypot(x, y), abs(yaw)


def _moved(event: Event, shift_ns: int) -> Event:
    """The event, later by a time."""
    if shift_ns == 0:
        return event
    if isinstance(event, OdometryEvent):
        return dataclasses.replace(event, stamp_ns=event.stamp_ns + shift_ns)
    scan = dataclasses.replace(event.scan, stamp_ns=event.scan.stamp_ns + shift_ns)
    return dataclasses.replace(event, scan=scan)
