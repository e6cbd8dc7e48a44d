"""Saved maps of one place merged into one session."""

import math

import numpy as np
import pytest
from support.driven_pieces import driven_piece, true_transform
from support.rooms import KITCHEN, room, turned
from support.storeys import storey

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import Erasures, KeepOut, KeepOutArea, MapEdits
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.slam.graph.keyframes import SavedKeyframes
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files import sessions
from thinmap_ros.files.merging import (
    CannotTellError,
    NotTheSamePlaceError,
    merge_maps,
    read_piece,
    write_ids,
)
from thinmap_ros.files.occupancy_maps import write_map
from thinmap_ros.files.sessions import GRID, LOCALIZER, REGIONS, TOPOLOGY

FIRST = (1, 1)
SECOND = (1, 2)
THIRD = (1, 3)
FOREIGN = (11, 1)


def save_session(path, drive):
    piece = driven_piece(*drive).piece
    sessions.save_grid(str(path), OccupancyGrid.from_patch(piece.patch))
    builder = TopologyBuilder.continued(piece.patch, piece.graph, 5000)
    TOPOLOGY.save(str(path), builder)
    regions = RegionTracker()
    regions.update(piece.patch)
    REGIONS.save(str(path), regions)
    return str(path)


def save_keyframes(path, drive):
    driven = driven_piece(*drive)
    frames = list(driven.piece.keyframes)
    sessions.KEYFRAMES.save(path, SavedKeyframes(frames, driven.edges, []))


def save_yaml(path, drive):
    return str(write_map(path, driven_piece(*drive).piece.patch))


def require_right(join, drive):
    off = se2.between(true_transform(driven_piece(*FIRST), driven_piece(*drive)), join.T_merged_map)
    assert np.hypot(off[0], off[1]) < 0.1
    assert abs(off[2]) < 0.01


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp('maps')
    save_session(folder / 'first', FIRST)
    save_session(folder / 'second', SECOND)
    save_yaml(folder / 'third', THIRD)
    save_yaml(folder / 'foreign', FOREIGN)
    return folder


def test_two_sessions_become_one_with_the_ids_of_the_first(folder, tmp_path):
    paths = [str(folder / 'first'), str(folder / 'second')]
    merged = merge_maps(paths)
    out = str(tmp_path / 'both')
    merged.save(out)
    (join,) = merged.joins
    require_right(join, SECOND)
    assert join.log_odds > math.log(1e5)
    grid = sessions.load_grid(out)
    assert grid.known_area().free.sum() > GRID.load(paths[0]).known_area().free.sum()
    graph = sessions.load_topology(out).map
    before = TOPOLOGY.load(paths[0]).map
    assert len(graph.nodes.keys() & before.nodes.keys()) >= 0.7 * len(before.nodes)
    fresh = graph.nodes.keys() - before.nodes.keys()
    assert min(fresh) >= 5000
    assert set(join.ids.values()) <= set(graph.nodes)
    regions = REGIONS.load(out)
    regions.update(grid.known_area())
    earlier = REGIONS.load(paths[0]).update(GRID.load(paths[0]).known_area())
    assert earlier.regions.keys() & regions.regions.regions.keys()


def test_sessions_and_maps_of_other_programs_are_mixed(folder, tmp_path):
    paths = [str(folder / name) for name in ('first', 'third.yaml', 'second')]
    merged = merge_maps(paths)
    for join in merged.joins:
        require_right(join, THIRD if join.path.endswith('third.yaml') else SECOND)
    assert {join.path for join in merged.joins} == set(paths[1:])
    write_ids(tmp_path / 'ids.csv', merged)
    lines = (tmp_path / 'ids.csv').read_text().splitlines()
    assert lines[0] == 'map,id,merged_id'
    assert len(lines) == 1 + sum(len(join.ids) for join in merged.joins)


def test_sessions_with_keyframes_are_bent_until_they_agree(tmp_path):
    paths = [save_session(tmp_path / f'{drive}', drive) for drive in (FIRST, SECOND)]
    for path, drive in zip(paths, (FIRST, SECOND), strict=True):
        assert read_piece(path).is_rigid
        save_keyframes(path, drive)
        assert not read_piece(path).is_rigid
    merged = merge_maps(paths)
    require_right(merged.joins[0], SECOND)
    merged.save(str(tmp_path / 'both'))
    assert sessions.KEYFRAMES.exists(str(tmp_path / 'both'))
    assert not read_piece(str(tmp_path / 'both')).is_rigid


CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def driven_place(drive, step):
    """A place (2,) on the path of a drive, in the frame of its map."""
    return driven_piece(*drive).piece.keyframes[step].T_map_base[:2]


def draw(path, place, name, stamp_ns=-1):
    """A keep-out area at a place (2,), the name of the region there, and an erased part."""
    corners = place + CORNERS
    erasures = Erasures()
    if stamp_ns >= 0:
        erasures.add(corners - 0.5, stamp_ns)
    edits = MapEdits(KeepOut().with_area(corners, is_wall=False), erasures)
    sessions.save_grid(path, GRID.load(path), edits=edits)
    tracker = REGIONS.load(path)
    regions = tracker.update(GRID.load(path).known_area())
    number = int(regions.ids_at(place[None])[0])
    assert number
    tracker.names.put(regions, number, place, name)
    REGIONS.save(path, tracker)


@pytest.mark.parametrize('has_keyframes', [False, True])
def test_what_people_have_drawn_on_the_maps_stays_at_its_place(tmp_path, has_keyframes):
    paths = []
    for drive, step in ((FIRST, 0), (SECOND, 20)):
        path = save_session(tmp_path / f'{drive}', drive)
        draw(path, driven_place(drive, step), f'room of {drive}')
        if has_keyframes:
            save_keyframes(path, drive)
        paths.append(path)
    out = str(tmp_path / 'both')
    merge_maps(paths).save(out)
    areas = sessions.load_edits(out).keep_out.areas
    assert [area.id for area in areas] == [1, 2]
    T = true_transform(driven_piece(*FIRST), driven_piece(*SECOND))
    there = se2.transform_points(T, driven_place(SECOND, 20) + CORNERS)
    np.testing.assert_allclose(areas[0].corners, driven_place(FIRST, 0) + CORNERS, atol=0.1)
    np.testing.assert_allclose(areas[1].corners, there, atol=0.15)
    tracker = REGIONS.load(out)
    regions = tracker.names.named(tracker.update(GRID.load(out).known_area()))
    ids = regions.ids_at(np.array([driven_place(FIRST, 0), there[0]])).tolist()
    names = [regions.regions[number].name for number in ids]
    assert names == [f'room of {FIRST}', f'room of {SECOND}']


def test_what_was_erased_is_not_drawn_again_from_earlier_scans(tmp_path):
    paths = [save_session(tmp_path / f'{drive}', drive) for drive in (FIRST, SECOND)]
    place = driven_place(FIRST, 0)
    known = {}
    for stamp_ns in (0, 2**60):
        draw(paths[0], place, 'hall', stamp_ns)
        for path, drive in zip(paths, (FIRST, SECOND), strict=True):
            save_keyframes(path, drive)
        patch = merge_maps(paths).grid.known_area()
        rows, cols = patch.frame.cells_of(place + np.array([[-0.3, -0.3], [0.3, 0.3]])).T
        known[stamp_ns] = (~patch.unknown)[rows[0] : rows[1], cols[0] : cols[1]].mean()
    assert known[0] > 0.9  # erased before any scan
    assert known[2**60] == 0.0


def test_too_many_keep_out_areas_of_all_maps_are_refused_before_the_work(tmp_path):
    paths = [save_session(tmp_path / f'{drive}', drive) for drive in (FIRST, SECOND)]
    for path in paths:
        areas = [KeepOutArea(number, CORNERS) for number in range(1, 60)]
        sessions.save_grid(path, GRID.load(path), edits=MapEdits(KeepOut(areas)))
    began = []
    with pytest.raises(InputError, match='118 keep-out areas: expected at most 100'):
        merge_maps(paths, progress=lambda share, text: began.append(text))
    assert not began


def test_a_foreign_map_is_refused(folder):
    foreign = str(folder / 'foreign.yaml')
    with pytest.raises(
        NotTheSamePlaceError, match=r'foreign.yaml: not the same place \(log odds -'
    ):
        merge_maps([str(folder / 'first'), foreign])
    with pytest.raises(NotTheSamePlaceError, match='foreign'):
        merge_maps([str(folder / 'first'), foreign, str(folder / 'second')])


def test_join_odds_that_no_map_reaches_join_none(folder):
    paths = [str(folder / 'first'), str(folder / 'second')]
    with pytest.raises(NotTheSamePlaceError) as error:
        merge_maps(paths, join_odds=1e300)
    assert error.value.log_odds > math.log(1e5)


@pytest.mark.parametrize(
    ('paths', 'match'),
    [
        (['first'], 'expected two different maps or more'),
        (['first', 'first'], 'expected two different maps or more'),
        (['first', 'missing'], 'missing.yaml: No such file'),
    ],
)
def test_wrong_paths_are_one_line(folder, paths, match):
    with pytest.raises(InputError, match=match) as error:
        merge_maps([str(folder / path) for path in paths])
    assert '\n' not in str(error.value)


def test_wrong_odds_are_one_line(folder):
    with pytest.raises(InputError, match=r'join odds 0\.5: expected more than 1'):
        merge_maps([str(folder / 'first'), str(folder / 'second')], join_odds=0.5)


def test_files_of_other_programs_stay(folder, tmp_path):
    merged = merge_maps([str(folder / 'first'), str(folder / 'second')])
    (tmp_path / 'both.yaml').write_text('of another program')
    with pytest.raises(InputError, match=r'both\.yaml: exists'):
        merged.save(str(tmp_path / 'both'))
    assert [path.name for path in tmp_path.iterdir()] == ['both.yaml']


def test_parts_of_an_earlier_session_are_renamed(folder, tmp_path):
    """They belong to another map: a localizer would be lost with its old local map."""
    from thinmap_ros.core.slam.localizer import Localizer

    merged = merge_maps([str(folder / 'first'), str(folder / 'second')])
    out = str(tmp_path / 'both')
    LOCALIZER.save(out, Localizer())
    lines = merged.save(out)
    assert not LOCALIZER.exists(out)
    assert any('renamed' in line for line in lines)


def test_progress_is_reported(folder):
    shown = []
    merge_maps(
        [str(folder / 'first'), str(folder / 'second')],
        progress=lambda share, text: shown.append((share, text)),
    )
    assert [share for share, _ in shown] == [0.0, 0.0]
    assert 'joining' in shown[-1][1]


def test_a_piece_of_a_session_continues_its_ids(folder):
    piece = read_piece(str(folder / 'first'))
    assert piece.next_id == TOPOLOGY.load(str(folder / 'first')).next_id
    assert piece.is_rigid
    assert len(piece.frames) > 50


T_ROOM = np.array([1.3, -0.7, 0.65])


def save_rooms(folder, boxes):
    """A room, and the same in a frame that lies at T_ROOM in its own."""
    known = room(boxes)
    return [
        str(write_map(folder / 'today', known)),
        str(write_map(folder / 'yesterday', turned(known, se2.invert(T_ROOM)))),
    ]


def test_a_room_too_small_for_views_is_joined_as_a_whole(tmp_path):
    (join,) = merge_maps(save_rooms(tmp_path, KITCHEN)).joins
    np.testing.assert_allclose(join.T_merged_map, T_ROOM, atol=0.05)
    assert math.log(1e5) < join.log_odds < math.inf
    assert join.found > 0.9


def test_a_given_pose_joins_a_symmetric_room_and_is_refined(tmp_path):
    paths = save_rooms(tmp_path, [])
    with pytest.raises(NotTheSamePlaceError):
        merge_maps(paths)
    (join,) = merge_maps(paths, at=[T_ROOM + (0.3, -0.2, 0.08)]).joins
    np.testing.assert_allclose(join.T_merged_map, T_ROOM, atol=0.05)
    assert math.isinf(join.log_odds)


def test_odds_for_a_join_that_are_too_small_name_the_places(tmp_path):
    paths = save_rooms(tmp_path, KITCHEN)
    with pytest.raises(
        CannotTellError, match=r'cannot tell \(odds [\d,]+, asked 1e50\): '
    ) as error:
        merge_maps(paths, join_odds=1e50)
    np.testing.assert_allclose(error.value.places[0], T_ROOM, atol=0.05)
    best = ','.join(f'{number:.2f}' for number in error.value.places[0])
    assert f'--at X,Y,YAW; it fits best at {best}, then at ' in str(error.value)


@pytest.mark.parametrize(
    ('at', 'match'),
    [
        ([T_ROOM + (0.3, 1.5, 0.8)], r'contradict the given pose .* % of the walls agree near it'),
        ([T_ROOM, T_ROOM], '2 given poses: expected one for each map after the first: 1'),
        ([np.array([0.0, np.nan, 0.0])], 'expected x, y and yaw'),
    ],
)
def test_a_wrong_given_pose_is_one_line(tmp_path, at, match):
    with pytest.raises(InputError, match=match) as error:
        merge_maps(save_rooms(tmp_path, KITCHEN), at=at)
    assert '\n' not in str(error.value)


def test_given_poses_join_maps_of_a_chain_in_any_order(tmp_path):
    whole = room(KITCHEN)
    paths = []
    for name, begin, end in (('left', 0, 50), ('right', 60, 112), ('middle', 20, 90)):
        cells = np.full_like(whole.cells, -1)
        cells[:, begin:end] = whole.cells[:, begin:end]
        paths.append(str(write_map(tmp_path / name, GridPatch(whole.frame, cells))))
    joins = merge_maps(paths, at=[np.zeros(3), np.zeros(3)]).joins
    assert [join.path for join in joins] == [paths[2], paths[1]]


def save_storey(path, moved_m=0.0, tag=''):
    return str(write_map(path, storey(moved_m), tag))


def test_storeys_are_joined_where_their_tags_are_equal_and_only_there(tmp_path):
    first = save_storey(tmp_path / 'first', 0.0)
    above = save_storey(tmp_path / 'above', 1.6)
    with pytest.raises(NotTheSamePlaceError, match=r'above.yaml: not the same place \(log odds -'):
        merge_maps([first, above])
    merged = merge_maps([first, above], tag='hall')
    assert merged.joins[0].log_odds > 50.0
    merged.save(str(tmp_path / 'both'))
    assert sessions.load_tag(str(tmp_path / 'both')) == 'hall'
    assert read_piece(str(tmp_path / 'both')).tag == 'hall'


@pytest.mark.parametrize('at', [(), (np.zeros(3),)])
def test_maps_with_different_tags_are_never_joined(tmp_path, at):
    first = save_storey(tmp_path / 'first', 0.0, 'floor 1')
    second = save_storey(tmp_path / 'second', 0.0, 'floor 2')
    reason = "second.yaml: another storey: map_tag = 'floor 2': expected 'floor 1', the storey of "
    with pytest.raises(NotTheSamePlaceError, match=reason) as refused:
        merge_maps([first, second], at=at)
    assert refused.value.log_odds == -math.inf
    with pytest.raises(NotTheSamePlaceError, match="'floor 1': expected 'hall', the storey of --t"):
        merge_maps([first, second], at=at, tag='hall')


def test_a_tag_that_is_none_is_refused(tmp_path):
    first = save_storey(tmp_path / 'first')
    second = save_storey(tmp_path / 'second', 0.0, 'x' * 65)
    with pytest.raises(InputError, match=r'second\.yaml: map_tag = .*at most 64 printable char'):
        merge_maps([first, second])
    with pytest.raises(InputError, match=r"tag = 'a\\n': expected at most 64 printable"):
        merge_maps([first, first.replace('first', 'other')], tag='a\n')
