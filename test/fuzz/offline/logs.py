"""Logs as strange drivers and clocks make them, damaged bags of other formats, parameter files."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from support.bag_maker import drive, write
from support.ros1_bag import converted

from fuzz.cases import Source, chosen, damaged_bytes, damaged_text, finite, nothing, tried
from thinmap_ros.core import se2
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.core.sensing.synchronizer import ScanOdometrySynchronizer
from thinmap_ros.core.slam.localizer import default_config
from thinmap_ros.core.stage import StartConfig
from thinmap_ros.logs.log import (
    Event,
    OdometryEvent,
    ScanEvent,
    SkippedRecords,
)
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.logs.reading import ClockJumpError, open_log, recording_events
from thinmap_ros.tools.parameter_file import read_parameter_file

_PRESETS = sorted((Path(__file__).resolve().parents[3] / 'config').glob('*/*.yaml'))
_SIZES_S = (0.0, 0.01, 0.3, 0.9, 1.1, 5.0, 20.0, 1e4, 1e8)


class StrangeLog:
    """A drive whose clocks jump, and whose messages are late, lost, repeated or wrongly stamped."""

    expected_scans: int | None = None

    def __init__(self, rng: np.random.Generator) -> None:
        self.skipped = SkippedRecords()
        self.is_sorted = bool(rng.random() < 0.3)
        self._made = _arrived(rng, list(_drive(rng)))

    def events(self) -> Iterator[Event]:
        """The events in the order of arrival."""
        yield from self._made


def _drive(rng: np.random.Generator) -> Iterator[Event]:
    """Odometry and scans, with steps of the clocks of one or both."""
    shifts = {OdometryEvent: 0, ScanEvent: 0}
    every = int(chosen(rng, (1, 3, 20, 60)))
    count = int(rng.integers(20, 300))
    steps = set(rng.integers(0, count, int(rng.integers(0, 4))).tolist())
    restart = int(rng.integers(count)) if rng.random() < 0.3 else count
    for k in range(count):
        if k in steps:
            step_ns = round(float(chosen(rng, _SIZES_S)) * SECOND_NS) * int(chosen(rng, (-1, 1)))
            for kind in shifts if rng.random() < 0.7 else [chosen(rng, list(shifts))]:
                shifts[kind] += step_ns
        place = k if k < restart else k - restart
        ns = 2 * 10**8 * SECOND_NS + place * SECOND_NS // 20
        pose = se2.pose(0.02 * place, 0.0, 0.01 * place)
        if k % every == 0:
            yield OdometryEvent(max(ns + shifts[OdometryEvent], 0), pose, bool(rng.random() < 0.99))
        if k % 3 == 0:
            scan = Scan.create(max(ns + shifts[ScanEvent], 0), [1.0], 0.0, 0.1, 0.1, 8.0)
            yield ScanEvent(scan)


def _arrived(rng: np.random.Generator, events: list[Event]) -> list[Event]:
    """The events, some of them lost, twice, or later than others."""
    delay = float(chosen(rng, (0.0, 0.0, 3.0, 40.0)))
    share = float(chosen(rng, (0.0, 0.01, 0.3)))
    order = np.arange(len(events)) + delay * (rng.random(len(events)) < share)
    order[rng.random(len(events)) < float(chosen(rng, (0.0, 0.0, 0.2)))] = -1
    arrived = [events[i] for i in np.argsort(order, kind='stable') if order[i] >= 0]
    return [event for event in arrived for _ in range(1 + int(rng.random() < 0.02))]


def order_events(shared: None, rng: np.random.Generator, folder: Path) -> None:
    """No event is lost or comes twice, and each scan is used or has a reason."""
    log = StrangeLog(rng)
    given = list(log.events())
    pairing = ScanOdometrySynchronizer(len(given) + 1)
    scans = used = passed = 0
    is_whole = True
    try:
        for event in recording_events(log):
            passed += 1
            if isinstance(event, ScanEvent):
                scans += 1
                ready = pairing.add_scan(event.scan)
            else:
                ready = pairing.add_odometry(event.stamp_ns, event.T_odom_base)
            for _, T_odom_base in ready:
                finite(T_odom_base)
                used += 1
    except ClockJumpError as error:
        assert str(error).isprintable()
        is_whole = False
    assert passed == len(given) if is_whole else passed < len(given)
    reasons = pairing.reasons()
    assert used + sum(reasons.values()) == scans
    assert all(text.isprintable() for text in [*reasons, *log.skipped.notes])


def _whole_bags(folder: Path) -> dict[str, bytes]:
    """One drive as a bag of ROS 1, and in SQLite."""
    source = write(folder / 'bag.mcap', lambda writer, make: drive(writer, make, 30))
    kinds = {'none': '', 'bz2': 'bz2', 'lz4': 'lz4'}
    bags = {
        f'{name}.bag': converted(source, folder / f'{name}.bag', kind).read_bytes()
        for name, kind in kinds.items()
    }
    typestore = get_typestore(Stores.ROS2_JAZZY)
    shutil.rmtree(folder / 'sq', ignore_errors=True)
    with Writer(folder / 'sq', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for message in Bag(source).messages():
            known = [c for c in writer.connections if c.topic == message.topic]
            connection = (
                known[0]
                if known
                else writer.add_connection(message.topic, message.type_name, typestore=typestore)
            )
            writer.write(connection, message.log_ns, message.data)
    return bags | {'sq.db3': (folder / 'sq' / 'sq.db3').read_bytes()}


def read_other_bags(shared: dict[str, bytes], rng: np.random.Generator, folder: Path) -> None:
    name = str(chosen(rng, list(shared)))
    path = folder / name
    path.write_bytes(damaged_bytes(rng, shared[name]))
    source = str(chosen(rng, ('', 'topic', 'tf', 'none')))
    log = open_log(path, odometry_source=source)
    for event in tried(lambda: list(log.events())) or ():
        if isinstance(event, OdometryEvent):
            finite(event.T_odom_base)
        else:
            finite(event.scan.points_base())


def read_parameters(shared: None, rng: np.random.Generator, folder: Path) -> None:
    path = folder / 'robot.yaml'
    text = damaged_text(rng, chosen(rng, _PRESETS).read_text())
    path.write_bytes(text.encode('utf-8', 'surrogatepass'))

    def read() -> None:
        parameters = read_parameter_file(path, ('localizer', 'grid_mapper'))
        slam = parameters.value('localizer', 'slam', StartConfig.slam)
        parameters.config('localizer', default_config(slam))
        parameters.value('localizer', 'laser_pose', '')

    tried(read)


SOURCES = (
    Source('log_order', nothing, order_events),
    Source('other_bags', _whole_bags, read_other_bags),
    Source('parameter_file', nothing, read_parameters),
)
