"""CARMEN logs: FLASER, ROBOTLASER1 and ODOM lines, plain or gzip.

Lines are played in the order of the file; their stamps are those of the robot and step back now and
then. Invalid lines are skipped and counted, because some logs are truncated or concatenated. A file
without scans is an error.

An interlaced laser writes partial scans that are shifted by fractions of the angle between beams:
181 beams from -90 degrees, and 180 from -89.75, -89.5 or -89.25. A line does not say which; so in a
log with both counts, the smaller one is centred between the ends of the greater one.
"""

import gzip
import math
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.scan import LaserConfig, Scan
from thinmap_ros.core.se2 import LATEST_S, SECOND_NS, Array
from thinmap_ros.files.safe import LOGS, open_regular_file
from thinmap_ros.logs.log import (
    Event,
    LaserOptions,
    Log,
    LogFormat,
    LogOptions,
    OdometryEvent,
    ScanEvent,
    SkippedRecords,
)
from thinmap_ros.logs.storage import kind_of, refuse_foreign

_SCAN_KEYWORDS = (b'FLASER', b'ROBOTLASER1')
_KEYWORDS = (b'ODOM', *_SCAN_KEYWORDS)  # other lines are not read
_SUFFIXES = ('.log', '.clf', '.log.gz', '.clf.gz')
_SAMPLE_BYTES = 1 << 22
_TOO_LONG = (
    f'expected at most {LOGS.lines} lines, and {LOGS.file_ratio} times the bytes of a gzip file: '
    'only the lines before are read'
)


@dataclass
class CarmenLog:
    """A CARMEN log file. `events()` plays it in file order; `skipped` counts invalid lines.

    T_base_laser (3,): pose of the laser on the robot; None: by the options, or the lines.
    laser: its parameters for all logs.
    """

    path: Path
    options: LaserOptions = field(default_factory=LaserOptions)
    T_base_laser: Array | None = None
    laser: LaserConfig = field(default_factory=LaserConfig)
    skipped: SkippedRecords = field(default_factory=SkippedRecords)
    is_sorted: bool = field(default=True, init=False)
    _measured: Array | None = field(default=None, init=False)  # T_base_laser of the lines
    _counts: set[bytes] = field(default_factory=set, init=False)  # of beams, of FLASER lines

    def events(self) -> Iterator[Event]:
        """Odometry and scans in file order; the odometry of a scan line precedes its scan.

        That odometry has the stamp of the scan. Raises InputError if the file is missing, is not
        text, or has no scan.
        """
        self.skipped = SkippedRecords()
        self._measured = None
        self._counts = _beam_counts(self._beginning()[0])
        scans = 0
        for number, line in self._lines():
            try:
                events = self._parse(line)
            except (ValueError, IndexError, InputError, OverflowError) as error:
                reason = (
                    'too few words'
                    if isinstance(error, IndexError)
                    else ' '.join(str(error).split())[:120]
                )
                self.skipped.add(f'{self.path}:{number}: {reason}')
                continue
            scans += any(isinstance(event, ScanEvent) for event in events)
            yield from events
        if scans == 0:
            reason = f'; first skipped line: {self.skipped.first}' if self.skipped.first else ''
            raise InputError(f'{self.path}: no scan: expected FLASER or ROBOTLASER1 lines{reason}')

    @property
    def expected_scans(self) -> int | None:
        """Number of scan lines, estimated from the beginning of the file; None without any."""
        lines, read = self._beginning()
        if not read:
            return None
        return round(len(lines) * self.path.stat().st_size / read) or None

    def _beginning(self) -> tuple[list[bytes], int]:
        """Scan lines at the beginning of the file, and the bytes of the file that were read.

        Of a compressed file, the compressed bytes. 0 if the file cannot be read so far.
        """
        lines = []
        left = _SAMPLE_BYTES
        try:
            with open_regular_file(self.path) as file, _unpacked(file) as stream:
                while left > 0 and (line := stream.readline(LOGS.line_bytes)):
                    left -= len(line)
                    if line.lstrip().startswith(_SCAN_KEYWORDS):
                        lines.append(line)
                return lines, file.tell()
        except (OSError, EOFError, zlib.error, InputError):
            return lines, 0

    def _lines(self) -> Iterator[tuple[int, str]]:
        refuse_foreign(self.path, 'a CARMEN log')
        if kind_of(self.path) == 'mcap':
            raise InputError(f'{self.path}: an MCAP file, which is a bag: expected a CARMEN log')
        try:
            with open_unpacked(self.path) as stream:
                # One byte more than the limit: no more of a longer line is ever read.
                lines = iter(lambda: stream.readline(LOGS.line_bytes + 1), b'')
                unread = LOGS.line_bytes * LOGS.lines
                if isinstance(stream, gzip.GzipFile):
                    unread = LOGS.unpacked_bytes(self.path.stat().st_size)
                for number, line in enumerate(lines, start=1):
                    unread -= len(line)
                    if number > LOGS.lines or unread < 0:
                        self.skipped.add_first(f'{self.path}:{number}: {_TOO_LONG}')
                        return
                    if len(line) > LOGS.line_bytes:
                        raise InputError(
                            f'{self.path}:{number}: a line of more than {LOGS.line_bytes} bytes: '
                            'expected a CARMEN log'
                        )
                    if b'\0' in line:
                        raise InputError(
                            f'{self.path}:{number}: a zero byte: expected a text file (CARMEN log)'
                        )
                    if line.endswith(b'\n') and not line.lstrip().startswith(_KEYWORDS):
                        continue
                    text = line.decode('utf-8', errors='replace')
                    yield (
                        number,
                        text if text.endswith('\n') else self._complete_words(number, text),
                    )
        except (OSError, EOFError, zlib.error) as error:
            if isinstance(error, EOFError | gzip.BadGzipFile | zlib.error):
                self.skipped.add(f'{self.path}: {error}')
                return
            raise InputError(f'{self.path}: {error.strerror or error}') from error

    def _complete_words(self, number: int, text: str) -> str:
        """Return a truncated line without its last word, which may be part of a number."""
        whole = text.rstrip().rpartition(' ')[0]
        if text.strip() and not whole:
            self.skipped.add(f'{self.path}:{number}: {quoted(text.strip()[:20])}: truncated line')
        return whole

    def _parse(self, line: str) -> list[Event]:
        words = line.split()
        if not words:
            return []
        if words[0] == 'ODOM':
            _check_length(words, 7 + 1, 'a pose, three numbers and a stamp')
            return [OdometryEvent(_stamp(words[7]), _pose(words[1:4]))]
        if words[0] == 'FLASER':
            return self._flaser(words)
        if words[0] == 'ROBOTLASER1':
            return self._robotlaser(words)
        return []

    def _flaser(self, words: list[str]) -> list[Event]:
        """FLASER n range... x y theta odom_x odom_y odom_theta stamp host logger_stamp."""
        count = int(words[1])
        rest = words[2 + count :]
        _check_length(rest, 7, f'{count} ranges, two poses and a stamp')
        is_partial = b'%d' % (count + 1) in self._counts
        whole = count + is_partial
        step = self.options.step_deg or (1.0 if whole == 180 else 180.0 / max(whole - 1, 1))
        start = self.options.start_angle_deg + 0.5 * step * is_partial
        fan = (math.radians(start), math.radians(step))
        scan = self._scan(
            _stamp(rest[6]), words[2 : 2 + count], fan, self.options.range_max_m, self._offset()
        )
        return [OdometryEvent(scan.stamp_ns, _pose(rest[3:6])), ScanEvent(scan)]

    def _robotlaser(self, words: list[str]) -> list[Event]:
        """Events of a line with these words.

        ROBOTLASER1 type start fov step max_range accuracy mode n range...
        m remission... lx ly lt x y t ...
        """
        start, _, step, max_range = (float(word) for word in words[2:6])
        count = int(words[8])
        after = 9 + count
        remissions = int(words[after])
        if remissions < 0:
            raise ValueError(f'{remissions} remissions: expected none or more')
        rest = words[after + 1 + remissions :]
        _check_length(
            rest,
            12,
            f'{count} ranges, {remissions} remissions, two poses, five numbers and a stamp',
        )
        T_odom_laser = _pose(rest[0:3])
        T_odom_base = _pose(rest[3:6])
        # The laser is mounted rigidly: the offset of the first valid line is used for all, without
        # its rounding errors.
        measured = self._measured
        if measured is None:
            measured = np.round(se2.between(T_odom_base, T_odom_laser), 3)
        is_given = self.T_base_laser is not None or self.options.offset_m
        mount = self._offset() if is_given else measured
        limit = min(max_range, self.options.range_max_m)
        scan = self._scan(_stamp(rest[11]), words[9 : 9 + count], (start, step), limit, mount)
        self._measured = measured
        return [OdometryEvent(scan.stamp_ns, T_odom_base), ScanEvent(scan)]

    def _offset(self) -> Array:
        if self.T_base_laser is not None:
            return self.T_base_laser
        return np.array([self.options.offset_m, 0.0, 0.0])

    def _scan(
        self,
        stamp_ns: int,
        ranges: list[str],
        fan: tuple[float, float],
        limit: float,
        T_base_laser: Array,
    ) -> Scan:
        if not ranges:
            raise ValueError('no range: expected one or more')
        values = np.array(ranges, dtype=np.float64)
        with np.errstate(over='ignore'):  # a range beyond float32 is a "no return", as inf
            return Scan.create(
                stamp_ns,
                values,
                *fan,
                self.options.range_min_m,
                limit,
                T_base_laser,
                self.laser,
            )


def _is_carmen(path: Path) -> bool:
    """Whether a path has the name of a CARMEN log, or scan lines at its beginning."""
    return path.name.lower().endswith(_SUFFIXES) or bool(CarmenLog(path)._beginning()[0])


def _beam_counts(lines: list[bytes]) -> set[bytes]:
    """Numbers of beams, as written, of the FLASER lines among scan lines."""
    beginnings = [line.split(maxsplit=2) for line in lines]
    return {words[1] for words in beginnings if words[0] == b'FLASER' and len(words) > 1}


def _check_length(words: list[str], count: int, expected: str) -> None:
    """Raise ValueError if the number of words is wrong; host and logger stamp may follow."""
    if not count <= len(words) <= count + 2:
        raise ValueError(
            f'{len(words)} words instead of {count} to {count + 2}: expected {expected}'
        )


@contextmanager
def open_unpacked(path: Path) -> Iterator[IO[bytes] | gzip.GzipFile]:
    """Open a log, plain or gzip, as the bytes of its text."""
    with open_regular_file(path) as stream, _unpacked(stream) as unpacked:
        yield unpacked


@contextmanager
def _unpacked(stream: IO[bytes]) -> Iterator[IO[bytes] | gzip.GzipFile]:
    is_zipped = stream.read(2) == b'\x1f\x8b'
    stream.seek(0)
    yield gzip.GzipFile(fileobj=stream) if is_zipped else stream


def _stamp(word: str) -> int:
    """Seconds as written, exact to the nanosecond."""
    seconds, _, fraction = word.partition('.')
    if not (
        seconds.isdigit() and (fraction == '' or fraction.isdigit()) and int(seconds) < LATEST_S
    ):
        raise ValueError(f'stamp {quoted(word)}: expected seconds from 0 to {LATEST_S}')
    return int(seconds) * SECOND_NS + int(f'{fraction:0<9.9}')


def _pose(words: list[str]) -> Array:
    pose = np.array(words, dtype=np.float64)
    # Written so that NaN is refused, too. A heading of so many turns has no meaning either.
    if pose.shape != (3,) or not np.abs(pose).max() <= se2.MAX_COORDINATE_M:
        raise ValueError(f'pose {words}: expected three numbers, at most {se2.MAX_COORDINATE_M:g}')
    return se2.pose(*pose)


def _log(path: Path, options: LogOptions) -> Log:
    source = options.odometry_source
    if source not in ('', 'topic'):
        raise InputError(f'{path}: odometry source {source}: a CARMEN log has its own odometry')
    return CarmenLog(path, options.carmen, options.T_base_laser, options.laser)


FORMAT = LogFormat('a CARMEN log (plain or gzip)', _is_carmen, _log)
