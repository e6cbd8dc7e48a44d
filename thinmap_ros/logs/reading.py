"""Logs of all formats: opened, and read as scans with the odometry at their stamps."""

import warnings
from collections.abc import Iterator
from pathlib import Path

from thinmap_ros.core.config import config_or_default
from thinmap_ros.core.errors import InputError, pose_of, quoted
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.files.safe import path_of
from thinmap_ros.logs.log import Event, LaserOptions, Log, LogOptions, OdometryEvent, format_of
from thinmap_ros.logs.order.clock_jumps import ClockJumpError, ClockJumps
from thinmap_ros.logs.order.stamp_order import by_stamp

# Scans of a log that may wait for odometry: those of a fast laser between two samples.
WAITING_SCANS = 200


def open_log(
    path: Path | str,
    laser: LaserOptions | None = None,
    scan_topic: str = '',
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
    odometry_topic, empty for the only topic of their type; base_frame and odom_frame, empty for
    those of the bag; odometry_source: topic, tf or none, empty for topic, or tf without one. The
    log is read when its events are. Raises InputError for a path of no known format, and for a
    source that a CARMEN log does not have.
    """
    options = LogOptions(
        config_or_default(laser, LaserOptions),
        scan_topic,
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
        return pairing.add_odometry(event.stamp_ns, event.T_odom_base)
    return pairing.add_scan(event.scan)
