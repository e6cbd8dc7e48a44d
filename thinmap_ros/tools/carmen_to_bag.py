"""Converts a CARMEN log to a bag: scan, odom, tf and tf_static."""

import argparse
from pathlib import Path

from thinmap_ros.core.errors import counted
from thinmap_ros.logs.bag_writer import BagObjects, BagWriter
from thinmap_ros.logs.log import Event, LaserOptions, OdometryEvent
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser


def convert(log: CarmenLog, bag: Path) -> int:
    """Write a bag of a log; returns the number of scans.

    Header stamps are those of the log, even if they step back. The log time of the bag is
    monotonic: the largest stamp so far plus a nanosecond per message, so that playback keeps the
    order of the file.
    """
    scans = 0
    with BagWriter(bag) as writer:
        messages = BagObjects(writer.typestore.types)
        log_ns = 0
        for event in log.events():
            stamp_ns = event.stamp_ns if isinstance(event, OdometryEvent) else event.scan.stamp_ns
            log_ns = max(stamp_ns, log_ns + 1)
            if scans == 0 and not isinstance(event, OdometryEvent):
                mount = messages.transform(
                    stamp_ns, ('base_link', 'laser'), event.scan.T_base_laser
                )
                writer.write('/tf_static', 'tf2_msgs/msg/TFMessage', log_ns, mount)
                log_ns += 1
            log_ns = _write(writer, messages, event, log_ns)
            scans += not isinstance(event, OdometryEvent)
    return scans


def _write(writer: BagWriter, messages: BagObjects, event: Event, log_ns: int) -> int:
    """Write an event; returns the log time of its last message."""
    if not isinstance(event, OdometryEvent):
        writer.write('/scan', 'sensor_msgs/msg/LaserScan', log_ns, messages.scan(event.scan))
        return log_ns
    odometry = messages.odometry(event.stamp_ns, event.T_odom_base)
    writer.write('/odom', 'nav_msgs/msg/Odometry', log_ns, odometry)
    transform = messages.transform(event.stamp_ns, ('odom', 'base_link'), event.T_odom_base)
    writer.write('/tf', 'tf2_msgs/msg/TFMessage', log_ns + 1, transform)
    return log_ns + 1


def _work(arguments: argparse.Namespace) -> None:
    log = CarmenLog(arguments.log, cli.config_from(arguments, LaserOptions))
    scans = convert(log, arguments.bag)
    skipped = (
        f', {counted(log.skipped.count, "line")} skipped (first: {log.skipped.first})'
        if log.skipped.count
        else ''
    )
    print(f'{arguments.bag}: {counted(scans, "scan")}{skipped}')


def main() -> None:
    """Run the program."""
    parser = Parser('carmen_to_bag', __doc__)
    parser.add_argument('log', type=Path, help='CARMEN log, plain or gzip')
    parser.add_argument(
        'bag', type=Path, help='rosbag2 folder to write, or a file that ends in .mcap'
    )
    cli.add_config(parser, LaserOptions)
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
