"""Programs over many files: a folder for each, one table, resumed, here or on a Dask cluster."""

import argparse
import csv
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from support.carmen_log import carmen_lines

from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation import batch
from thinmap_ros.evaluation.batch import Batch, jobs_of, run_batch

RESULTS = ('trajectory.tum', 'trajectory_final.tum', 'map.pgm', 'topology.geojson')


def called(program: str, *words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', f'thinmap_ros.tools.{program}', *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300.0, check=False)


def table(out: Path) -> list[dict[str, str]]:
    with (out / 'summary.csv').open(newline='') as file:
        return list(csv.DictReader(file))


@pytest.fixture
def logs(tmp_path: Path) -> list[Path]:
    """Two logs of one name, and a file that is none."""
    paths = [tmp_path / 'monday' / 'log.clf', tmp_path / 'tuesday' / 'log.clf']
    for path, scans in zip(paths, (12, 20), strict=True):
        path.parent.mkdir()
        path.write_text('\n'.join(carmen_lines(scans)))
    broken = tmp_path / 'broken.clf'
    broken.write_text('this is no log')
    return [*paths, broken]


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """A folder with two maps, as map_saver writes them."""
    folder = tmp_path / 'maps'
    folder.mkdir()
    for name, width in (('hall', 60), ('corridor', 12)):
        grey = np.zeros((40 + width, 90), dtype=np.uint8)
        grey[10 : 10 + width, 10:80] = 254
        Image.fromarray(grey).save(folder / f'{name}.pgm')
        described = {'image': f'{name}.pgm', 'resolution': 0.1, 'origin': [0.0, 0.0, 0.0]}
        limits = {'negate': 0, 'occupied_thresh': 0.65, 'free_thresh': 0.25}
        (folder / f'{name}.yaml').write_text(yaml.safe_dump(described | limits))
    return folder


@pytest.mark.programs
def test_many_logs_give_what_each_gives_alone(logs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / 'out'
    result = called('replay', *logs, '-o', out, '--jobs', 2, '--quiet')
    assert result.returncode == 2
    assert result.stdout == f'{out}: 2 of 3 done\n'
    assert result.stderr.splitlines()[-1].startswith('replay: error: 1 failed: broken: ')
    rows = table(out)
    assert [row['file'] for row in rows] == [str(path) for path in logs]
    assert [row['scans'] for row in rows] == ['12', '20', '']
    assert 'no scan: expected FLASER' in rows[2]['reason']
    assert list(rows[0]) == [
        *('file', 'scans', 'distance_m', 'cpu_ms_per_scan', 'loops', 'lost', 'apart', 'reason')
    ]
    page = (out / 'report.html').read_text()
    assert 'href="monday-log/report.html"' in page and 'src="tuesday-log/summary.png"' in page
    assert 'no scan: expected FLASER' in page
    for log in logs[:2]:
        alone = tmp_path / 'alone' / log.parent.name
        assert called('replay', log, '-o', alone, '--quiet').returncode == 0
        for name in RESULTS:
            together = out / f'{log.parent.name}-log' / name
            assert together.read_bytes() == (alone / name).read_bytes(), together


@pytest.mark.programs
def test_what_is_done_is_not_done_again(logs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / 'out'
    words = ('replay', *logs[:2], '-o', out, '--jobs', 1, '--quiet')
    assert called(*words).returncode == 0
    done = out / 'monday-log' / 'job.json'
    report = json.loads(done.read_text())
    report['row']['scans'] = 777
    done.write_text(json.dumps(report))
    shutil.rmtree(out / 'tuesday-log')
    again = called(*words)
    assert again.stdout == f'{out}: 2 of 2 done, 1 of them before\n'
    assert [row['scans'] for row in table(out)] == ['777', '20']
    other = called(*words, '--resolution-m', 0.2)
    assert other.returncode == 2
    assert 'of a run with other options' in other.stderr
    assert table(out)[0]['scans'] == '777'


@pytest.mark.programs
def test_a_cluster_of_two_workers_gives_the_same(maps: Path, tmp_path: Path) -> None:
    distributed = pytest.importorskip('distributed')
    # The images are named by the descriptions, as with maps/*.
    files = sorted(maps.iterdir())
    assert len(files) == 4
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        words = ('-o', tmp_path / 'there', '--dask', cluster.scheduler_address, '--quiet')
        there = called('map_to_graph', *files, *words)
    assert there.returncode == 0, there.stderr
    assert called('map_to_graph', *files, '-o', tmp_path / 'here', '--quiet').returncode == 0
    assert [row['file'] for row in table(tmp_path / 'here')] == [
        str(maps / 'corridor.yaml'),
        str(maps / 'hall.yaml'),
    ]
    for name in ('hall', 'corridor'):
        graphs = [tmp_path / side / name / 'topology.geojson' for side in ('here', 'there')]
        assert graphs[0].read_bytes() == graphs[1].read_bytes()
        assert (tmp_path / 'there' / name / 'summary.png').exists()


@pytest.mark.programs
def test_a_real_map_among_others(maps: Path, tmp_path: Path, shared_data: Path) -> None:
    real = shared_data / 'maps' / 'carmines_floor.yaml'
    words = ('-o', tmp_path / 'out', '--format', 'graphml', '--jobs', 2, '--quiet')
    result = called('map_to_graph', real, maps / 'hall.yaml', *words)
    assert result.returncode == 0, result.stderr
    rows = table(tmp_path / 'out')
    assert int(rows[0]['nodes']) > 50 and int(rows[1]['nodes']) > 0
    assert (tmp_path / 'out' / 'carmines_floor' / 'topology.graphml').exists()


@pytest.mark.programs
def test_a_warning_of_a_map_among_others_is_one_line_with_its_name(
    maps: Path, tmp_path: Path
) -> None:
    for path in maps.glob('*.pgm'):
        grey = np.array(Image.open(path))
        grey[:8] = 205
        Image.fromarray(grey).save(path)
    result = called('map_to_graph', *maps.glob('*.yaml'), '-o', tmp_path / 'out', '--quiet')
    assert result.returncode == 0, result.stderr
    lines = sorted(result.stderr.splitlines())
    assert len(lines) == 2
    for line, name in zip(lines, ('corridor', 'hall'), strict=True):
        assert line.startswith(f'{name}: warning: {maps / name}.yaml: 720 cells of grey 205')


def test_two_files_of_one_name_in_folders_of_one_name_are_refused(tmp_path: Path) -> None:
    paths = [tmp_path / 'a' / 'x' / 'log.clf', tmp_path / 'b' / 'x' / 'log.clf.gz']
    with pytest.raises(InputError, match='x-log: expected files of different names'):
        jobs_of(paths, tmp_path / 'out', {}, {})
    names = [job.name for job in jobs_of([paths[0], tmp_path / '.log'], tmp_path, {}, {})]
    assert names == ['log', '.log']


def test_nothing_is_written_where_a_job_was_done_with_other_options(tmp_path: Path) -> None:
    (job,) = jobs_of([tmp_path / 'a.clf'], tmp_path, {'speed': 1}, {})
    job.folder.mkdir()
    (job.folder / 'job.json').write_text(json.dumps({'options': {'speed': 2}, 'row': {}}))
    arguments = argparse.Namespace(out=tmp_path, quiet=True, jobs=1, dask='', command='')
    with pytest.raises(InputError, match='other options'):
        run_batch(Batch(batch.run_batch, (), 'x'), [job], arguments)  # type: ignore[arg-type]
    assert not (tmp_path / 'summary.csv').exists()
