"""Checks published logs that you have put into a folder, and converts them for the benchmarks.

Nothing is downloaded: benchmarks/data.md says where each log is published. A log NAME is found as
NAME.clf, NAME.log, or NAME/log.clf, plain or gzip, and its relations as NAME.relations. The
benchmarks then find NAME/log.clf, NAME/odom.txt and NAME/relations. What is there stays as it is.
"""

import argparse
import shutil
import zlib
from pathlib import Path

from thinmap_ros.core.errors import InputError, counted
from thinmap_ros.core.se2 import SECOND_NS
from thinmap_ros.files.safe import atomic_write, write_text
from thinmap_ros.logs.log import OdometryEvent
from thinmap_ros.logs.published_logs import PUBLISHED, PublishedLog, unpacked_sha256
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser

_PLACES = ('{0}/log.clf', '{0}.clf', '{0}.log')
_RELATIONS = '{0}.relations'


def main() -> None:
    """Run the command line."""
    parser = Parser('fetch_logs', __doc__)
    parser.add_argument('folder', type=Path, help='folder of the logs')
    cli.run(_work, parser)


def _work(arguments: argparse.Namespace) -> None:
    folder: Path = arguments.folder
    found = {log: path for log in PUBLISHED if (path := _file_of(folder, log))}
    if not found:
        raise InputError(
            f'{folder}: no published log in it: expected one of '
            f'{", ".join(log.name for log in PUBLISHED)}, as NAME.clf or NAME/log.clf'
        )
    for log in PUBLISHED:
        print(f'{log.name}: {_converted(folder, log, found[log]) if log in found else "missing"}')


def _file_of(folder: Path, log: PublishedLog) -> Path | None:
    """The file of a log, where it is; a converted one first."""
    places = [place.format(log.name) + packed for place in _PLACES for packed in ('', '.gz')]
    return next((folder / place for place in places if (folder / place).is_file()), None)


def _converted(folder: Path, log: PublishedLog, path: Path) -> str:
    """Convert a log; returns what is to be said about it."""
    try:
        is_known = unpacked_sha256(path) == log.sha256
    except (EOFError, zlib.error) as error:
        raise InputError(f'{path}: {error}: expected a whole file') from error
    lines = CarmenLog(path)
    odometry = []
    scans = 0
    for event in lines.events():
        if isinstance(event, OdometryEvent):
            odometry.append(_odometry_line(event))
        else:
            scans += 1
    own = folder / log.name
    _copy(path, own / ('log.clf.gz' if path.suffix == '.gz' else 'log.clf'))
    _copy(folder / _RELATIONS.format(log.name), own / 'relations')
    if not (own / 'odom.txt').exists():
        write_text(own / 'odom.txt', ''.join(odometry))
    words = ['the file of the results' if is_known else 'another file than that of the results']
    words.append(counted(scans, 'scan'))
    if lines.skipped.count:
        words.append(f'{counted(lines.skipped.count, "line")} skipped ({lines.skipped.first})')
    if not (own / 'relations').exists():
        words.append('no relations')
    return ', '.join(words)


def _odometry_line(event: OdometryEvent) -> str:
    """A line of odom.txt: t x y theta."""
    x, y, theta = event.T_odom_base
    seconds, ns = divmod(event.stamp_ns, SECOND_NS)
    return f'{seconds}.{ns // 1000:06d} {x:.6f} {y:.6f} {theta:.6f}\n'


def _copy(source: Path, target: Path) -> None:
    """Copy a file that exists to where none is."""
    if source.exists() and not target.exists():
        with atomic_write(target) as aside:
            shutil.copyfile(source, aside)


if __name__ == '__main__':
    main()
