"""The program merge_sessions: a session of maps of one place, or one line and nothing written."""

import re
import shutil

import pytest
from PIL import Image
from support.driven_pieces import driven_piece, true_transform

from thinmap_ros.files import sessions
from thinmap_ros.files.occupancy_maps import write_map
from thinmap_ros.tools import merge_sessions


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('maps')
    for name, drive in (('a', (2, 1)), ('b', (2, 2)), ('foreign', (12, 1))):
        write_map(folder / name, driven_piece(*drive).piece.patch)
    return folder


def run(monkeypatch, *words):
    monkeypatch.setattr('sys.argv', ['merge_sessions', *map(str, words)])
    try:
        merge_sessions.main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_transform_odds_and_ids_are_printed(folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / 'both'
    options = ('--picture', tmp_path / 'both.png', '--ids', tmp_path / 'ids.csv', '--quiet')
    assert run(monkeypatch, folder / 'a.yaml', folder / 'b.yaml', '-o', out, *options) == 0
    written, joined, kept = capsys.readouterr().out.splitlines()
    assert written == f'{out}.pgm, .yaml and .grid.npz, .topology.npz and .regions.npz'
    number = r'-?\d+\.\d+'
    assert re.fullmatch(
        rf'{re.escape(str(folder))}/b.yaml: at {number}, {number} m, {number} deg '
        rf'\(sigma {number}, {number} m, {number} deg\), log odds {number}, \d+ matches; '
        r'\d+ of \d+ nodes in the map',
        joined,
    )
    assert re.fullmatch(rf'{re.escape(str(folder))}/a.yaml: \d+ of \d+ nodes keep their ids', kept)
    assert Image.open(tmp_path / 'both.png').width > 1000
    assert (tmp_path / 'ids.csv').read_text().startswith('map,id,merged_id\n')
    sessions.require_session(str(out))


def test_all_maps_of_a_folder_are_merged(folder, tmp_path, monkeypatch, capsys):
    for name in ('a', 'b'):
        for ending in ('.yaml', '.pgm'):
            shutil.copy(folder / f'{name}{ending}', tmp_path)
    out = tmp_path / 'c'
    for _ in range(2):  # the second time, the result is in the folder
        assert run(monkeypatch, tmp_path, '-o', out, '--quiet') == 0
        assert capsys.readouterr().out.splitlines()[1].startswith(f'{tmp_path}/b.yaml: at ')
    assert sessions.maps_in(tmp_path) == [
        f'{tmp_path}/{name}' for name in ('a.yaml', 'b.yaml', 'c')
    ]


def test_a_folder_without_maps_is_refused(tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, tmp_path, '-o', tmp_path / 'out', '--quiet') == 2
    assert 'no map: expected sessions or map_server YAML files' in capsys.readouterr().err


def test_another_place_ends_with_1_and_one_line(folder, tmp_path, monkeypatch, capsys):
    words = (folder / 'a.yaml', folder / 'foreign.yaml', '-o', tmp_path / 'out', '--quiet')
    assert run(monkeypatch, *words) == 1
    printed = capsys.readouterr()
    assert printed.out == ''
    (line,) = printed.err.splitlines()
    assert re.fullmatch(r'.*/foreign\.yaml: not the same place \(log odds -(\d+\.\d|inf)\)', line)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ('words', 'expected'),
    [
        (('a.yaml', 'missing.yaml', '-o', 'out'), 'missing.yaml: No such file or directory'),
        (('a.yaml', '-o', 'out'), 'expected two different maps or more'),
        (('a.yaml', 'b.yaml', '-o', 'out', '--picture', 'x.jpg'), 'x.jpg: expected a name that'),
        (('a.yaml', 'b.yaml', '-o', 'out', '--at', '1,2'), '--at = \'1,2\': expected "X,Y,YAW"'),
        (('a.yaml', 'b.yaml', '-o', 'out', '--join-odds', '0'), 'join odds 0: expected more'),
    ],
)
def test_wrong_arguments_are_one_line(folder, monkeypatch, capsys, words, expected):
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    assert run(monkeypatch, *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('merge_sessions: error: ')
    assert expected in line
    assert sorted(folder.iterdir()) == before


def test_odds_that_are_too_small_end_with_3_and_a_pose_joins(folder, tmp_path, monkeypatch, capsys):
    words = (folder / 'a.yaml', folder / 'b.yaml', '-o', tmp_path / 'out', '--quiet')
    assert run(monkeypatch, *words, '--join-odds', '1e200') == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(r'/b\.yaml: cannot tell \(odds .*, asked 1e200\): lower --join-odds, ', line)
    assert list(tmp_path.iterdir()) == []
    T = true_transform(driven_piece(2, 1), driven_piece(2, 2))
    pose = ','.join(f'{value:.1f}' for value in T)
    assert run(monkeypatch, *words, f'--at={pose}') == 0
    assert re.search(r'pose given, \d+ % of the walls agree, \d+ matches', capsys.readouterr().out)
