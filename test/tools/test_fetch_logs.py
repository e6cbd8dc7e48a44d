"""Published logs in a folder: checked by their hash, and converted for the benchmarks."""

import gzip
import re
import shutil
import sys
from pathlib import Path

import pytest
from support.carmen_log import carmen_lines

from thinmap_ros.__main__ import main
from thinmap_ros.tools.fetch_logs import PUBLISHED

ROOT = Path(__file__).resolve().parents[2]
TEXT = '\n'.join(carmen_lines(scans=4)) + '\n'


@pytest.fixture
def fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Runs fetch-logs on a folder; returns what it says about each log."""

    def fetch() -> dict[str, str]:
        monkeypatch.setattr(sys, 'argv', ['thinmap', 'fetch-logs', str(tmp_path)])
        main()
        lines = capsys.readouterr().out.splitlines()
        return dict(line.split(': ', 1) for line in lines)

    return fetch


def test_a_log_is_converted_and_what_is_there_stays(tmp_path: Path, fetched) -> None:
    (tmp_path / 'intel.log.gz').write_bytes(gzip.compress(TEXT.encode()))
    (tmp_path / 'intel.relations').write_text('0.0 0.2 0.03 0 0 0 0 0\n')
    (tmp_path / 'fhw').mkdir()
    (tmp_path / 'fhw' / 'log.clf').write_text(TEXT + 'FLASER 3 1\n')
    (tmp_path / 'fhw' / 'odom.txt').write_text('mine\n')
    said = fetched()
    assert list(said) == [log.name for log in PUBLISHED]
    assert said['intel'] == 'another file than that of the results, 4 scans'
    assert said['fhw'].startswith(
        'another file than that of the results, 4 scans, 1 line skipped ('
    )
    assert said['fhw'].endswith(', no relations')
    assert said['sena'] == 'missing'
    own = tmp_path / 'intel'
    assert gzip.decompress((own / 'log.clf.gz').read_bytes()).decode() == TEXT
    assert (own / 'relations').exists()
    odometry = (own / 'odom.txt').read_text().splitlines()
    assert len(odometry) == 8  # of a line each of odometry and scan
    assert odometry[-1] == '0.600000 0.090000 0.000000 0.000000'
    assert (tmp_path / 'fhw' / 'odom.txt').read_text() == 'mine\n'
    assert fetched() == said


def test_the_log_of_the_results_is_known(tmp_path: Path, fetched, shared_data: Path) -> None:
    there = shared_data / 'logs' / 'sena'
    shutil.copy(there / 'log.clf', tmp_path / 'sena.clf')
    assert fetched()['sena'] == 'the file of the results, 225 scans, no relations'
    assert (tmp_path / 'sena' / 'odom.txt').read_text() == (there / 'odom.txt').read_text()


def test_a_damaged_log_is_an_error(tmp_path: Path, fetched, capsys) -> None:
    packed = gzip.compress(TEXT.encode())
    (tmp_path / 'intel.clf.gz').write_bytes(packed[: len(packed) // 2])
    with pytest.raises(SystemExit) as end:
        fetched()
    assert end.value.code == 2
    assert 'intel.clf.gz: ' in (said := capsys.readouterr().err) and 'expected a whole file' in said
    assert not (tmp_path / 'intel').exists()


def test_the_page_names_each_log_with_its_hash() -> None:
    page = (ROOT / 'benchmarks' / 'data.md').read_text()
    named = dict(re.findall(r'^\| `(\w+)` \|.+\| `([0-9a-f]{64})` \|$', page, re.MULTILINE))
    assert named.items() >= {log.name: log.sha256 for log in PUBLISHED}.items()
