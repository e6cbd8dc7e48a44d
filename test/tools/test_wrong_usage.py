"""What people type by mistake: one line names what was expected, and nothing is written.

The programs run in this process, as `thinmap SUBCOMMAND`.
"""

import shlex
import sys
import warnings
from pathlib import Path

import pytest

from thinmap_ros.__main__ import main

# FILE: a text file; MAP: a map; LOG: a CARMEN log; DIR: an empty folder.
WRONG = [
    ('repaly LOG', "'repaly': no such subcommand (did you mean replay?)"),
    ('explore room_10x10', "'explore': no such subcommand (did you mean explore_world?)"),
    ('localizer', "'localizer': no such subcommand, but a node: expected thinmap nodes localizer"),
    ('-v', "'-v': no such subcommand"),
    ('Replay LOG', "'Replay': no such subcommand (did you mean replay?)"),
    ('replay', 'the following arguments are required: '),
    ('replay nowhere.bag', 'nowhere.bag: '),
    ('replay DIR', 'DIR: '),
    ('replay FILE', 'FILE: '),
    ('replay LOG --outt x', '--outt (did you mean --out?)'),
    ('replay LOG --slam magic', "invalid choice: 'magic'"),
    ('replay LOG --resolution-m 0', 'resolution_m = 0.0: expected'),
    ('replay LOG --resolution-m five', "invalid float value: 'five'"),
    ('replay LOG --resolution 5cm', "invalid float value: '5cm'"),
    ('replay LOG --laser-pose 1', 'laser_pose'),
    ('replay LOG --laser-pose=-1,x,0', 'laser_pose'),
    ('replay LOG --params-file nothere.yaml', 'nothere.yaml: No such file'),
    ('replay LOG --params-file FILE', 'FILE: '),
    ('replay LOG -o FILE', 'FILE: is a file: expected a folder'),
    ('replay LOG -o FILE/x', 'FILE is a file: expected a folder'),
    ('replay LOG --recording FILE/x.rrd', 'FILE is a file: expected a folder'),
    ('replay LOG LOG', 'expected files of different names, or given once'),
    (
        'replay LOG nowhere.bag --view',
        '--view, --recording, --session, --continue: expected one log',
    ),
    ('replay LOG --jobs many', "argument --jobs: invalid int value: 'many'"),
    ('replay LOG --odom-source gps', "invalid choice: 'gps'"),
    ('explore_world', 'the following arguments are required: world'),
    ('explore_world room_10x1', "world 'room_10x1' (did you mean room_10x10?)"),
    ('explore_world nowhere.yaml', 'nowhere.yaml'),
    ('explore_world FILE', 'FILE'),
    ('explore_world room_10x10 --start 1', '--start=1: expected X,Y or X,Y,THETA'),
    ('explore_world room_10x10 --start a,b', '--start=a,b: expected X,Y or X,Y,THETA'),
    ('explore_world room_10x10 --start -1,-1', 'expected a place where a robot'),
    ('explore_world room_10x10 --start -1,-1,inf', '--start=-1,-1,inf: expected finite numbers'),
    ('explore_world room_10x10 --strategy neerest', "strategy = 'neerest': expected one of"),
    ('explore_world room_10x10 --strategy my.module:make', "No module named 'my'"),
    ('explore_world room_10x10 --speed 0', 'speed_m_s = 0.0: expected'),
    ('explore_world room_10x10 --robots 0', '--robots=0: expected 1 to'),
    ('explore_world room_10x10 --robots two', "invalid int value: 'two'"),
    ('explore_world room_10x10 --kidnap-at-s 5', 'expected --localization=slam'),
    ('explore_world room_10x10 --range-max 0', 'range_max_m = 0.0: expected'),
    ('explore_world room_10x10 --robot turtlebot', "invalid choice: 'turtlebot'"),
    ('explore_world room_10x10 -o FILE', 'FILE: is a file: expected a folder'),
    ('explore_world room_10x10 extra', 'unrecognized arguments: extra'),
    ('compare_exploration', 'the following arguments are required: worlds'),
    ('compare_exploration room_10x10 --strategies fast', "strategy = 'fast': expected one of"),
    ('compare_exploration room_10x10 -o FILE/x', 'FILE is a file: expected a folder'),
    ('compare_exploration room_10x10 --start 3 --starts x', "invalid int value: 'x'"),
    ('map_to_graph', 'the following arguments are required: '),
    ('map_to_graph nowhere.yaml', 'nowhere.yaml: No such file'),
    ('map_to_graph FILE', 'FILE: '),
    ('map_to_graph MAP -o graph.txt', 'graph.txt: expected a name that ends in'),
    ('map_to_graph MAP -o FILE/g.geojson', 'FILE is a file: expected a folder'),
    ('map_to_graph MAP --picture map.bmp', 'map.bmp: expected a name that ends in .png'),
    ('map_to_graph MAP --start 1', '--start=1: expected'),
    ('map_to_graph MAP --robot-radius-m -1', 'robot_radius_m'),
    ('map_to_graph MAP --min-clearance-m 0.1', '--min-clearance-m 0.1: expected at least'),
    ('evaluate', 'the following arguments are required: run, --reference'),
    ('evaluate DIR --reference FILE', 'DIR: no trajectory.tum and no trajectory_final.tum'),
    ('evaluate nowhere.tum --reference also_nowhere.tum', 'nowhere.tum'),
    ('evaluate DIR --reference a.tum --delta 0', 'expected no negative time, and at least 1 pose'),
    ('merge_sessions MAP', 'the following arguments are required: -o/--out'),
    ('merge MAP nowhere -o both', 'nowhere'),
    ('merge MAP MAP -o both --picture both.jpg', 'both.jpg: expected a name that ends in .png'),
    ('carmen_to_bag LOG', 'the following arguments are required: bag'),
    ('carmen_to_bag nowhere.log bag', 'nowhere.log: No such file'),
    ('bag_repair nowhere.mcap', 'nowhere.mcap'),
    ('bag_repair DIR', 'DIR: '),
    ('experiment nothing', "invalid choice: 'nothing'"),
    ('experiment logs', 'expected --logs FOLDER'),
    ('record_bags nothing', "drive 'nothing': expected some of"),
    ('fetch_logs', 'the following arguments are required: folder'),
    ('fetch-logs DIR', 'DIR: no published log in it: expected one of intel, '),
    ('warm_up all', 'unrecognized arguments: all'),
]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """A working directory, and the files in it by the words of the usages."""
    folder = tmp_path / 'here'
    (folder / 'empty').mkdir(parents=True)
    (folder / 'notes.txt').write_text('nothing of use\n')
    (folder / 'log.clf').write_text('ODOM 0 0 0 0 0 0 1.0 robot 1.0\n')
    (folder / 'map.pgm').write_bytes(b'P5\n8 8\n255\n' + bytes([254] * 64))
    (folder / 'map.yaml').write_text(
        'image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\n'
        'occupied_thresh: 0.65\nfree_thresh: 0.25\n'
    )
    monkeypatch.chdir(folder)
    monkeypatch.setattr(warnings, 'showwarning', warnings.showwarning)
    return {'FILE': 'notes.txt', 'MAP': 'map.yaml', 'LOG': 'log.clf', 'DIR': 'empty'}


def with_names(text: str, place: dict[str, str]) -> str:
    for word, name in place.items():
        text = text.replace(word, name)
    return text


@pytest.mark.parametrize(('usage', 'said'), WRONG, ids=[usage for usage, _ in WRONG])
def test_a_wrong_usage_is_one_line_and_leaves_nothing(
    place: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    usage: str,
    said: str,
) -> None:
    before = sorted(Path().rglob('*'))
    monkeypatch.setattr(sys, 'argv', ['thinmap', *shlex.split(with_names(usage, place))])
    with pytest.raises(SystemExit) as end:
        main()
    told = capsys.readouterr()
    assert end.value.code == 2
    assert with_names(said, place) in told.err, told.err
    assert told.err.count('\n') == 1 and told.err.startswith('thinmap'), told.err
    assert told.out == ''
    assert sorted(Path().rglob('*')) == before


@pytest.mark.parametrize('words', [['--help'], ['help'], ['-h']])
def test_help_lists_the_subcommands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    monkeypatch.setattr(sys, 'argv', ['thinmap', *words])
    main()
    assert 'map_to_graph' in capsys.readouterr().out


def test_results_go_below_out_if_no_folder_is_given(
    place: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert place
    monkeypatch.setattr(sys, 'argv', ['thinmap', 'map_to_graph', 'map.yaml', '--quiet'])
    main()
    assert capsys.readouterr().out.startswith('out/map.geojson: ')
    assert Path('out/map.geojson').is_file()
