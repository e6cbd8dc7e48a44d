"""Logs of all formats: opened, and read as scans with the odometry at their stamps."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import se2
from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import InputError, pose_of, quoted, quoted_name
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import CLOCK_JUMP_NS, SECOND_NS, Array
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.files.safe import path_of
from thinmap_ros.logs.log import (
    Event,
    LaserOptions,
    Log,
    LogOptions,
    OdometryEvent,
    ScanEvent,
    format_of,
)

# Odometry continues where it moves at most so many steps as before: two samples may be lost.
_STEPS = 3
_REST_M = 0.02
_REST_RAD = 0.02
_SILENT_PERIODS = 3.0  # of a laser: a message or two may be lost


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


def by_stamp(events: Iterable[Event]) -> Iterator[Event]:
    """Put events in the order of their stamps, within `CLOCK_JUMP_NS`.

    Where the stamps of the odometry step back, too, either it came late as well, or the clock
    stepped back: the order in which the odometry is the shorter path is right.
    """
    waiting = _Waiting()
    try:
        for event in events:
            yield from waiting.add(event)
    except ClockJumpError:
        yield from waiting.rest()
        raise
    yield from waiting.rest()


class _Waiting:
    """Events that an earlier one may still follow, in the order of their arrival."""

    def __init__(self) -> None:
        self._events: list[Event] = []
        self._last: list[OdometryEvent] = []  # the one that was passed on last, if any

    def add(self, event: Event) -> Iterator[Event]:
        """Add an event; yields those that none can precede any more."""
        self._events.append(event)
        while stamp_of(event) - min(map(stamp_of, self._events)) > CLOCK_JUMP_NS:
            yield self._pop()

    def rest(self) -> Iterator[Event]:
        """The events that are left, at the end."""
        while self._events:
            yield self._pop()

    def _pop(self) -> Event:
        stamps = [stamp_of(event) for event in self._events]
        index = stamps.index(min(stamps))
        event = self._events.pop(index if index and self._stamps_are_right() else 0)
        if isinstance(event, OdometryEvent):
            self._last = [event]
        return event

    def _stamps_are_right(self) -> bool:
        """Whether the odometry is the shorter path in the order of its stamps, not of arrival."""
        waiting = [event for event in self._events if isinstance(event, OdometryEvent)]
        arrived = [*self._last, *waiting]
        ordered = sorted(arrived, key=stamp_of)
        return ordered == arrived or _path(ordered) < _path(arrived)


def _path(samples: list[OdometryEvent]) -> float:
    """Length of a path with its turns, m + rad."""
    total = 0.0
    for before, after in pairwise(samples):
        x, y, yaw = se2.between(before.T_odom_base, after.T_odom_base).tolist()
        total += math.hypot(x, y) + abs(yaw)
    return total


# Scans of a log that may wait for odometry: those of a fast laser between two samples.
WAITING_SCANS = 200


def open_log(
    path: Path | str,
    laser: LaserOptions | None = None,
    scan_topic: str | Sequence[str] = '',
    odometry_topic: str = '',
    T_base_laser: Array | None = None,
    base_frame: str = '',
    *,
    odometry_source: str = '',
    odom_frame: str = '',
    laser_config: LaserConfig | None = None,
) -> Log:
    """Return the log of a path, by the first of the formats in `logs.readers` that opens it.

    laser describes the laser of a CARMEN log; T_base_laser (3,): the laser on the robot, None for
    that of the log; laser_config: parameters of the laser. For a bag: scan_topic and
    odometry_topic, empty for the only topic of their type; several scan topics for several lasers;
    base_frame and odom_frame, empty for those of the bag; odometry_source: topic, tf or none, empty
    for topic, or tf without one. The log is read when its events are. Raises InputError for a path
    of no known format, and for a source that a CARMEN log does not have.
    """
    options = LogOptions(
        config_or_default(laser, LaserOptions),
        scan_topic if isinstance(scan_topic, str) else tuple(scan_topic),
        odometry_topic,
        None if T_base_laser is None else pose_of('T_base_laser', T_base_laser),
        base_frame,
        odometry_source,
        odom_frame,
        config_or_default(laser_config, LaserConfig),
    )
    path = path_of(path)
    return format_of(path).log(path, options)


def recording_events(log: Log) -> Iterator[Event]:
    """Odometry and scans of one recording; late messages of a bag are put in the order of stamps.

    Raises ClockJumpError, an InputError, after the last event before another recording begins: the
    clock jumped back, and the odometry does not continue.
    """
    events = ClockJumps(lambda text: log.skipped.note(text)).events(log.events())
    return events if log.is_sorted else by_stamp(events)


def paired_scans(log: Log) -> Iterator[tuple[Scan, Array]]:
    """Scans of a log in their order, each with the odometry pose T_odom_base (3,) at its stamp.

    A scan without odometry around its stamp is left out. Another recording in the same log is left
    out with a warning (see `recording_events`). Raises InputError where the log cannot be read.
    """
    if not hasattr(log, 'events'):
        raise InputError(f'log = {quoted(log)}: expected a log, as of open_log')
    pairing = ScanOdometrySynchronizer(WAITING_SCANS)
    try:
        for event in recording_events(log):
            yield from complete_scans(pairing, event)
        yield from pairing.finish()
    except ClockJumpError as error:
        warnings.warn(str(error), stacklevel=2)


def complete_scans(pairing: ScanOdometrySynchronizer, event: Event) -> list[tuple[Scan, Array]]:
    """Scans that are complete with an event, each with its odometry pose T_odom_base (3,)."""
    if isinstance(event, OdometryEvent):
        return pairing.add_odometry(event.stamp_ns, event.T_odom_base, event.tilt_rad)
    return pairing.add_scan(event.scan)


class SilentLasers:
    """Which of several lasers of a log was silent while another one measured."""

    def __init__(self) -> None:
        self._stamps: dict[str, list[int]] = {}

    def add(self, event: Event) -> None:
        """Add an event of the log."""
        if isinstance(event, ScanEvent):
            self._stamps.setdefault(event.scan.frame, []).append(event.scan.stamp_ns)

    def warnings(self) -> list[str]:
        """A line on the longest silence of each laser that had one."""
        return [text for frame in self._stamps if (text := self._silence(frame))]

    def _silence(self, frame: str) -> str:
        own = np.sort(self._stamps[frame])
        others = np.sort([ns for f, stamps in self._stamps.items() if f != frame for ns in stamps])
        if not others.size:
            return ''
        steps = np.diff(others, prepend=others[0])
        steps[steps > _longest_ns(others)] = 0  # the others were silent, too
        before = np.searchsorted(own, others)  # own scans before each of the others
        steps[np.diff(before, prepend=before[0]) > 0] = 0
        silent_ns = np.bincount(before, steps)
        most = int(silent_ns.argmax())
        if silent_ns[most] <= _longest_ns(own):
            return ''
        since_s = (others[before == most][0] - min(own[0], others[0])) / SECOND_NS
        return (
            f'{quoted_name(frame)}: no scan for {silent_ns[most] / SECOND_NS:.1f} s, from '
            f'{since_s:.1f} s on, while another laser measured'
        )


def _longest_ns(stamps: NDArray[np.int64]) -> float:
    """Longest time between two scans of a laser that measures, by its sorted stamps (N,), ns."""
    usual_ns = float(np.median(np.diff(stamps))) if stamps.size > 1 else 0.0
    return max(SECOND_NS, _SILENT_PERIODS * usual_ns)
