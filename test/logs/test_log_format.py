"""A format of logs is one file, and a file of no format is refused with the list of all."""

from pathlib import Path

import numpy as np
import pytest
from support.bag_maker import drive, write

from thinmap_ros.core.errors import InputError
from thinmap_ros.logs import readers
from thinmap_ros.logs.log import known_formats
from thinmap_ros.logs.readers.bag import BagLog
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.logs.reading import open_log, paired_scans

NEW_FORMAT = '''
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import pose
from thinmap_ros.logs.log import OdometryEvent, ScanEvent, SkippedRecords
from thinmap_ros.logs.log import LogFormat


class CsvLog:
    """Lines of a stamp, x and ranges."""

    expected_scans = None
    is_sorted = True

    def __init__(self, path, options):
        self.path = path
        self.skipped = SkippedRecords()

    def events(self):
        for line in self.path.read_text().splitlines():
            stamp, x, *ranges = line.split(',')
            yield OdometryEvent(int(stamp), pose(float(x), 0.0, 0.0))
            values = [float(value) for value in ranges]
            yield ScanEvent(Scan.create(int(stamp), values, -0.5, 0.5, 0.1, 20.0))


FORMAT = LogFormat('a CSV log', lambda path: path.suffix == '.csv', CsvLog)
'''


def test_a_new_format_is_one_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = tmp_path / 'drive.csv'
    log.write_text('1000,0.0,2,3,4\n2000,0.5,2,3,3.5\n')
    with pytest.raises(InputError, match=r'drive\.csv: unknown format'):
        open_log(log)
    folder = tmp_path / 'more'
    folder.mkdir()
    (folder / 'csv_lines.py').write_text(NEW_FORMAT)
    monkeypatch.setattr(readers, '__path__', [*readers.__path__, str(folder)])
    pairs = list(paired_scans(open_log(log)))
    assert [scan.stamp_ns for scan, _ in pairs] == [1000, 2000]
    assert np.array_equal(pairs[1][1], [0.5, 0.0, 0.0])
    assert pairs[1][0].ranges_m.tolist() == [2.0, 3.0, 3.5]
    assert 'a CSV log' in known_formats()


@pytest.mark.parametrize('name', ['no.log', 'no.mcap', 'no.txt'])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=f'{name}: [Nn]o such file'):
        list(open_log(tmp_path / name).events())


def test_a_file_of_no_format_is_refused_with_all_formats(tmp_path: Path) -> None:
    (tmp_path / 'photo.png').write_bytes(b'\x89PNG\r\n\0\0\0')
    with pytest.raises(InputError) as refused:
        open_log(tmp_path / 'photo.png')
    line = str(refused.value)
    assert line.startswith(f'{tmp_path}/photo.png: unknown format of a log: expected ')
    for name in ('rosbag2', 'MCAP', 'SQLite', 'ROS 1', 'CARMEN'):
        assert name in line
    assert '\n' not in line


def test_a_format_is_recognized_by_content(tmp_path: Path) -> None:
    """Whatever the name; a bag with the name of a CARMEN log is a bag."""
    bag = write(tmp_path / 'bag.mcap', drive)
    bag.rename(tmp_path / 'bag.log')
    assert isinstance(open_log(tmp_path / 'bag.log'), BagLog)
    (tmp_path / 'lines').write_text('# a comment\nFLASER 1 2.0 0 0 0 0 0 0 1.0 host 1.0\n')
    assert isinstance(open_log(tmp_path / 'lines'), CarmenLog)
