"""The experiments with option --quick.

Their output is complete and reproducible, and the same from a bag as from live data.
"""

import csv
import json
import re
import sys
from itertools import islice
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest

from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.outcome import Outcome, Table
from thinmap_ros.evaluation.pages import read_about, write_markdown, write_page
from thinmap_ros.evaluation.slam_run import run_drive
from thinmap_ros.evaluation.trajectory_errors import relation_errors
from thinmap_ros.experiments import drives
from thinmap_ros.experiments.drives import RECIPES, Source, samples_of_bag
from thinmap_ros.experiments.exploration.thinning_stages import stages
from thinmap_ros.experiments.slam import logs, office
from thinmap_ros.logs.log import LaserOptions
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.tools.experiment import EXPERIMENTS, main, write_outcome
from thinmap_ros.tools.record_bags import record

ROOT = Path(__file__).resolve().parents[2]
QUICK = Source(quick=True)
# Bag and live differ by the rounding of float32 ranges and quaternions.
POSE_TOLERANCE_M = 1e-3
# Too long for a second run.
SLOW = ('strategies', 'exploration', 'long_floor')


def called(*arguments: str) -> None:
    """Run the program in this process."""
    with patch.object(sys, 'argv', ['experiment', *arguments]):
        main()


@pytest.mark.programs
@pytest.mark.parametrize('name', EXPERIMENTS)
def test_an_experiment_writes_what_it_promises_twice_the_same(name: str, tmp_path: Path) -> None:
    outcome = EXPERIMENTS[name](QUICK)
    check_what_is_written(outcome, name, tmp_path)
    if name not in SLOW:
        check_same_numbers(outcome, EXPERIMENTS[name](QUICK))


def check_what_is_written(outcome: Outcome, name: str, tmp_path: Path) -> None:
    write_outcome(outcome, tmp_path / name)
    assert outcome.plots
    assert outcome.comparisons
    for plot in outcome.plots:
        assert (tmp_path / name / f'{plot.name}.png').stat().st_size > 5000
        assert '<svg' in (tmp_path / name / f'{plot.name}.svg').read_text(encoding='utf-8')[:1000]
        assert plot.caption.startswith('Paper ')
        assert all(panel.x_label or panel.y_label for panel in plot.panels)
    for table in outcome.tables:
        rows = list(csv.reader((tmp_path / name / f'{table.name}.csv').open(encoding='utf-8')))
        assert rows[0] == list(table.columns)
        assert len(rows) == len(table.rows) + 1
        assert all(len(row) == len(rows[0]) for row in rows)
        assert not any(cell in ('nan', 'inf') for row in rows for cell in row)
    assert read_about(tmp_path, name)['title'] == outcome.title
    page = write_page(tmp_path, [name]).read_text(encoding='utf-8')
    assert all(f'{name}/{plot.name}.png' in page for plot in outcome.plots)
    text = write_markdown(tmp_path, [name], tmp_path / 'docs').read_text(encoding='utf-8')
    assert all(
        (tmp_path / 'docs' / 'images' / 'papers' / f'{name}_{plot.name}.png').exists()
        for plot in outcome.plots
    )
    assert all(comparison.what in text for comparison in outcome.comparisons)


def check_same_numbers(first: Outcome, second: Outcome) -> None:
    """The same seed gives the same numbers, but for times."""
    for before, after in zip(first.tables, second.tables, strict=True):
        assert before.timed or before.csv() == after.csv(), before.name
    told, again = (
        [comparison for comparison in outcome.comparisons if not comparison.timed]
        for outcome in (first, second)
    )
    assert told == again


def test_the_script_runs_every_experiment(capsys: pytest.CaptureFixture[str]) -> None:
    text = (ROOT / 'scripts' / 'experiment').read_text()
    assert 'thinmap_ros.tools.experiment "${1:---help}"' in text
    (listed,) = re.findall(r'^# .*scripts/experiment NAME\|(\S+)', text, re.MULTILINE)
    words = ['experiment', 'nothing', '-o', 'out']
    with patch.object(sys, 'argv', words), pytest.raises(SystemExit):
        main()
    refused = capsys.readouterr().err
    assert all(name in refused for name in (*EXPERIMENTS, *listed.split('|')))


def test_the_plain_stages_end_where_nothing_changes() -> None:
    free = np.zeros((20, 30), dtype=np.bool_)
    free[3:17, 3:27] = True
    found = stages(free)
    assert [int(cells.sum()) for cells in found] == sorted(
        (int(cells.sum()) for cells in found), reverse=True
    )
    assert (found[-1] <= free).all()


@pytest.fixture(scope='module')
def office_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('bags')
    assert (
        record(folder / 'office.mcap', islice(Source().samples('office'), 150), localized=True)
        == 150
    )
    return folder


def test_a_bag_holds_sensors_truth_and_outputs(office_bag: Path) -> None:
    bag = Bag(office_bag / 'office.mcap')
    assert set(bag.topics) == {
        '/scan',
        '/odom',
        '/tf',
        '/tf_static',
        '/ground_truth',
        '/pose',
        '/map',
        '/topology',
    }
    live = list(islice(Source().samples('office'), 150))
    for one, other in zip(live, samples_of_bag(office_bag / 'office.mcap'), strict=True):
        assert one.scan.stamp_ns == other.scan.stamp_ns
        assert np.allclose(one.scan.ranges_m, other.scan.ranges_m, atol=1e-6)
        assert np.allclose(one.T_odom_base, other.T_odom_base, atol=1e-12)
        assert np.allclose(one.T_world_base, other.T_world_base, atol=1e-12)


def test_from_the_bag_as_from_live(office_bag: Path) -> None:
    live = run_drive(islice(Source().samples('office'), 150))
    replayed = run_drive(Source(bags=office_bag).samples('office'))
    assert np.abs(np.array(live.estimate) - np.array(replayed.estimate)).max() < POSE_TOLERANCE_M
    assert live.features == replayed.features
    one, other = (
        office.run(Source(bags=bags, quick=True)).tables[0] for bags in (None, office_bag)
    )
    for mine, theirs in zip(one.rows[0][1:], other.rows[0][1:], strict=True):
        assert mine == pytest.approx(theirs, rel=0.02, abs=1e-3)


def test_a_bag_without_truth_is_refused(tmp_path: Path, office_bag: Path) -> None:
    with pytest.raises(InputError, match='no such file'):
        list(Source(bags=tmp_path).samples('office'))


def test_every_drive_begins_where_its_world_says() -> None:
    for name, recipe in RECIPES.items():
        if name not in ('lab_stops', 'room_10x10'):
            first = next(Source().samples(name))
            assert first.T_world_base == pytest.approx(drives.world_of(recipe.world).start)


def test_numbers_in_a_table_are_short_and_plain() -> None:
    table = Table(
        't',
        ['a', 'b', 'c', 'd'],
        [[0.1 + 0.2, None, True, np.float64(-0.0)], [1e-9, 'x', 3, np.int64(4)]],
    )
    assert table.csv() == 'a,b,c,d\n0.3,,True,0\n0,x,3,4\n'


def test_relation_errors_of_a_known_path(tmp_path: Path) -> None:
    times = np.arange(0.0, 10.0, 1.0)
    poses = np.column_stack([times, np.zeros(10), np.zeros(10)])
    (tmp_path / 'odom').write_text(''.join(f'{t} {t} 0 0\n' for t in times))
    (tmp_path / 'relations').write_text(
        '1 3 2.0 0 0 0 0 0\n2 5 3.3 0.4 0 0 0 0.1\n4.5 6 1.5 0 0 0 0 0\n'
    )
    errors = relation_errors(times, poses, tmp_path / 'relations', tmp_path / 'odom')
    assert errors.metres == pytest.approx([0.0, 0.5, 0.5], abs=1e-9)
    assert errors.degrees == pytest.approx([0.0, np.degrees(0.1), 0.0])


@pytest.mark.parametrize('log', sorted(logs._LASERS))
def test_lasers_of_known_logs_are_valid(tmp_path: Path, log: str) -> None:
    assert logs.laser_of(tmp_path, log) != LaserOptions()


@pytest.mark.programs
def test_logs_of_the_users_own(tmp_path: Path) -> None:
    (tmp_path / 'logs' / 'mine').mkdir(parents=True)
    samples = islice(Source().samples('dead_end'), 60)
    lines = []
    for sample in samples:
        ranges = ' '.join(f'{r if np.isfinite(r) else 81.0:.3f}' for r in sample.scan.ranges_m)
        x, y, theta = sample.T_odom_base
        pose = f'{x:.6f} {y:.6f} {theta:.6f}'
        t = sample.scan.stamp_ns / 1e9
        lines.append(f'FLASER 181 {ranges} {pose} {pose} {t:.6f} host {t:.6f}\n')
    (tmp_path / 'logs' / 'mine' / 'log.clf').write_text(''.join(lines))
    (tmp_path / 'logs' / 'mine' / 'odom.txt').write_text('0 0 0 0\n20 0 0 0\n')
    (tmp_path / 'logs' / 'mine' / 'relations').write_text('1.0 1.0 0 0 0 0 0 0\n')
    called('logs', '-o', str(tmp_path / 'out'), '--logs', str(tmp_path / 'logs'))
    about = json.loads((tmp_path / 'out' / 'logs' / 'about.json').read_text())
    assert [plot['name'] for plot in about['plots']] == ['mine']
    (row,) = csv.DictReader((tmp_path / 'out' / 'logs' / 'logs.csv').open())
    assert row['log'] == 'mine'
    assert float(row['scans']) == 60
    assert float(row['live_m']) == pytest.approx(0.0)
    assert (tmp_path / 'out' / 'logs' / 'mine' / 'trajectory.tum').exists()


def test_a_wrong_laser_file_is_reported(tmp_path: Path) -> None:
    (tmp_path / 'laser.yaml').write_text('ofset_m: 0.1\n')
    with pytest.raises(InputError, match=r'laser\.yaml.*ofset_m'):
        logs.laser_of(tmp_path, tmp_path.name)
    with pytest.raises(InputError, match=r'no NAME/log\.clf'):
        logs.run(tmp_path, tmp_path / 'out')


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (['office', '--from-bag', 'nowhere'], 'nowhere: no such folder'),
        (['logs'], 'expected --logs FOLDER'),
        (['page'], 'no results'),
    ],
)
def test_errors_are_reported_in_one_line(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        called(*arguments, '-o', str(tmp_path))
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
