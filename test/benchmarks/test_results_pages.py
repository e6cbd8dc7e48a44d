"""Pages of results: other programs beside thinmap, targets apart, charts, commit and machine."""

import json
import re

import numpy as np
import pytest

from benchmarks import peers_page, targets
from benchmarks.charts import OURS, Mark, Panel, draw, span
from benchmarks.exploration import page as exploration_page
from benchmarks.scoreboard import results_page, stamps
from benchmarks.speed import page as speed_page
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.slam_run import INTEL, PEERS, Origin, runs, shown
from thinmap_ros.evaluation.strategy_comparison import half_interval_95

MADE = 'Commit 1234567, a processor, 2 cores, Python 3.12.3'
LOGS = {INTEL: 0.04, 'intel_raw': 0.02, 'aces_raw': 0.05, 'csail_raw': 0.03}


@pytest.fixture
def results(tmp_path):
    """A folder as a release makes it, with results of logs and of one benchmark."""
    board = tmp_path / 'slam' / 'board'
    board.mkdir(parents=True)
    for name, metres in LOGS.items():
        costs = {'ms_mean': 2.0, 'ms_99': 9.0, 'step_ms': 30.0, 'mb': 280.0}
        report = {'name': name, 'scans': 10, 'live_m': metres, 'final_m': metres, **costs}
        (board / f'{name}.json').write_text(json.dumps({**report, 'made': MADE}))
    (tmp_path / 'slam' / 'provenance.txt').write_text(f'{MADE}\n')
    (tmp_path / 'speed').mkdir()
    rows = '1000 x 1000 cells,3.68 ms,,\n  times faster than skimage,42.75,at least 50,MISSED\n'
    (tmp_path / 'speed' / 'thinning.csv').write_text(f'what,value,target,verdict\n{rows}')
    (tmp_path / 'speed' / 'machine.csv').write_text('what,value,target,verdict\nnumpy,2.4.6,,\n')
    (tmp_path / 'speed' / 'provenance.txt').write_text(f'{MADE}\n')
    return tmp_path


def cells(text, first):
    """Cells of the table rows that begin with a cell, without it."""
    found = [line.strip('| ').split('|') for line in text.splitlines() if line.startswith('| ')]
    return [[cell.strip() for cell in row[1:]] for row in found if row[0].strip() == first]


def chart_of(page):
    """Text of the chart that a page opens with."""
    text = page.read_text()
    first = re.search(r'!\[[^\]]+\]\(([^)]+)\)', text)
    assert text.index(first[0]) < text.index('\n## ')
    return (page.parent / first[1]).read_text()


def test_slam_is_beside_all_programs_that_were_run(results):
    path = results_page.write(results / 'slam', results / 'docs')
    text = path.read_text()
    assert f'\n{MADE}\n' in text
    for run in runs(INTEL):
        (row,) = cells(text, run.system + (f', {run.note}' if run.note else ''))
        assert row[:2] == [shown(run.live_m), shown(run.final_m)]
    (row,) = cells(text, 'ACES, Austin (`aces_raw`)')
    assert row == ['0.050', '0.050', '0.0375', '0.044', '0.64 to 0.95']
    assert '**missed**' not in text
    chart = chart_of(path)
    assert all(name in chart for name in ('thinmap', 'IRIS LaMa slam2d', 'MIT CSAIL, complete'))


def test_cases_of_other_commits_are_named():
    reports = [{'name': name, 'made': MADE} for name in LOGS]
    assert results_page.made_lines(reports) == MADE
    reports[1]['made'] = 'Commit 7654321'
    assert results_page.made_lines(reports).splitlines() == [
        '- `intel_raw`: Commit 7654321',
        f'- all other cases: {MADE}',
    ]


def test_peers_are_complete_and_name_where_they_were_run(results):
    path = peers_page.write(results, results / 'docs')
    text = path.read_text()
    table = [line for line in text.splitlines() if re.match(r'\| [^|]+ \| `\w+` \|', line)]
    assert len(table) == len(PEERS)
    for run, line in zip(PEERS, table, strict=True):
        source = run.note if run.origin is Origin.PUBLISHED else run.origin.value
        assert line.endswith(f'| {source} |')
        assert all(part in line for part in (run.system, shown(run.live_m), shown(run.final_m)))
    lost = text.split('Runs with smaller errors than thinmap:')[1].split('On `intel`')[0]
    assert '- Karto, `intel`: final 0.038 against 0.040\n' in lost
    assert '- graph mapping, `csail_raw`: final 0.004 against 0.030\n' in lost
    assert 'second build' not in lost
    assert 'CPU time per scan' in chart_of(path)


def test_targets_are_on_their_own_page(results):
    path = speed_page.write(results / 'speed', results / 'docs')
    text = path.read_text()
    assert '| &nbsp;&nbsp;&nbsp;&nbsp;times faster than skimage | 42.75 |\n' in text
    assert 'MISSED' not in text and 'at least' not in text
    chart = chart_of(path)
    assert all(f'SLAM by {name}' in chart for name in ('IRIS LaMa slam2d', 'slam_toolbox'))
    text = targets.write(results, results / 'docs').read_text()
    assert '| 1000 x 1000 cells: times faster than skimage | at least 50 | 42.75 |' in text
    assert '| intel_raw, live, m | 0.022 | 0.020 | met |' in text
    assert text.count('**missed**') >= 2
    with pytest.raises(InputError, match='no results'):
        targets.write(results / 'docs', results / 'docs')


def exploration(world, strategy, start, distance):
    laser = {'beams': 181, 'field_of_view_deg': 180.0, 'range_max_m': 8.0}
    options = {'laser': laser, 'localization': 'truth', 'speed_m_s': 0.5}
    costs = {'time': 2.0 * distance, 'turned_rad': 1.0, 'cpu_s': 1.0, 'decision_ms': {'median': 1}}
    return {
        'world': world,
        'strategy': strategy,
        'start_number': start,
        'options': options,
        'coverage': 1.0,
        'collisions': 0,
        'finished': True,
        'reason': 'all end nodes resolved',
        'reversals': 0,
        'distance': distance,
        'curve': [[0.0, 0.0, 0.0], [1.0, distance, 1.0]],
        **costs,
    }


def test_explorations_show_their_intervals(results):
    folder = results / 'exploration' / 'random_worlds'
    folder.mkdir(parents=True)
    reports = [
        exploration('dungeon-d1', strategy, start, metres)
        for start in range(3)
        for strategy, metres in (('position_probability', 90.0), ('nearest_frontier', 100.0))
    ]
    (folder / 'reports.json').write_text(json.dumps(reports))
    (folder / 'provenance.txt').write_text(MADE)
    path = exploration_page.write([folder, results / 'belief'], results / 'docs')
    text = path.read_text()
    assert '## Random worlds of 50 x 50 m (1): 181 beams' in text
    assert f'\n{MADE}.\n' in text
    (row,) = [row for row in cells(text, 'nearest_frontier') if len(row) == 5]
    assert row[:2] == ['3', '-10.0% ± 0.0%']
    assert 'nearest_frontier' in chart_of(path)
    with pytest.raises(InputError, match=r'no reports\.json'):
        exploration_page.write([results / 'belief'], results / 'docs')


def test_an_interval_of_few_values_is_wide():
    assert half_interval_95(np.array([0.0, 1.0])) == pytest.approx(12.706 * 0.5, rel=1e-4)
    assert half_interval_95(np.array([0.0, 1.0, 2.0])) == pytest.approx(
        4.3027 / np.sqrt(3.0), rel=1e-4
    )


def test_a_chart_has_one_row_for_each_name(tmp_path):
    marks = [Mark('a', 1.0), Mark('a', 2.0, is_filled=False), span('b', (3.0, 5.0), OURS)]
    assert (marks[2].low, marks[2].value, marks[2].high) == (3.0, 4.0, 5.0)
    assert span('b', (3.0, 3.0), OURS).low is None
    panels = [Panel('one', 'm', marks, is_log=True), Panel('two', 'm', marks, limit=2.0)]
    draw(tmp_path / 'first.svg', panels, [('a colour', OURS, True)])
    text = (tmp_path / 'first.svg').read_text()
    assert (text.count('>a</text>'), text.count('>b</text>'), text.count('a colour')) == (1, 1, 1)
    draw(tmp_path / 'second.svg', panels, [('a colour', OURS, True)])
    assert (tmp_path / 'second.svg').read_text() == text
    draw(tmp_path / 'third.svg', [panels[0], Panel('three', 'm', [marks[0]])])
    text = (tmp_path / 'third.svg').read_text()
    assert (text.count('>a</text>'), text.count('>b</text>')) == (2, 1)


def test_the_error_of_a_thinned_log_is_that_of_its_stamps(tmp_path):
    times = np.arange(0.0, 10.0, 0.05)
    poses = np.column_stack([times, 0.0 * times, 0.0 * times])  # 1 m/s
    pairs = [(1.05, 5.1), (2.1, 8.1), (3.05, 6.05)]
    lines = [f'{a} {b} {b - a} 0 0 0 0 0' for a, b in pairs]
    (tmp_path / 'relations').write_text('\n'.join(lines))
    odometry = [f'{t} {x} {y} {yaw}' for t, (x, y, yaw) in zip(times, poses, strict=True)]
    (tmp_path / 'odom.txt').write_text('\n'.join(odometry))
    thinned = (times[::2], poses[::2])
    rows = {row.what: row.value for row in stamps.compare((times, poses), thinned, tmp_path)}
    near = ': pose of the scan within 0.1 s'
    assert rows[f'complete log{near}'] == '0.0000 m, 3 relations'
    assert float(rows[f'thinned log{near}'].split()[0]) > 0.01
    assert (
        rows[f'complete log, only at the scans of the thinned one{near}']
        == rows[f'thinned log{near}']
    )
    moved = 'thinned log: pose moved to the stamp with odometry'
    assert rows[moved] == '0.0000 m, 3 relations'
    assert rows['thinned log: relations with a scan at both stamps'] == '0.0000 m, 1 relations'


def test_stamps_are_a_table_of_paths_and_ways_of_judging(results):
    rows = 'what,value,target,verdict\na: near,1 m,,\na: moved,2 m,,\nb: near,3 m,,\n'
    (results / 'slam' / 'stamps.csv').write_text(rows)
    text = results_page.write(results / 'slam', results / 'docs').read_text()
    assert '## Why the same laboratory has 0.020 m and 0.040 m\n' in text
    assert '| | a | b |\n|---|---|---|\n| near | 1 m | 3 m |\n| moved | 2 m |  |\n' in text
