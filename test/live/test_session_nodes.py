"""Sessions on a live graph.

Saved sessions are restored after a restart, and mapping continues.
"""

import os

import numpy as np
import pytest
from geometry_msgs.msg import Point, PoseStamped, Twist
from nav_msgs.msg import OccupancyGrid as OccupancyGridMsg
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.task import Future
from support.timeouts import PATIENCE_S

from thinmap_msgs.msg import RegionArray, TopologicalMap
from thinmap_msgs.srv import LoadMap, NameRegion, SaveMap
from thinmap_ros.core.grid.occupancy import PAPER_GRID, OccupancyConfig, OccupancyGrid
from thinmap_ros.core.se2 import pose
from thinmap_ros.core.topology.graph import topology_from_msg
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files import occupancy_maps, sessions
from thinmap_ros.ros import messages, qos
from thinmap_ros.sim.laser import LaserScanner, LaserScannerConfig
from thinmap_ros.sim.world import World

pytestmark = pytest.mark.live
MAPPERS = ('grid_mapper', 'topology_builder')


def places(topology):
    """Kind and position by id."""
    return {n.id: (n.kind, n.x, n.y) for n in topology_from_msg(topology).nodes.values()}


def heard_maps(graph):
    return (
        graph.heard('map', OccupancyGridMsg, qos.LATCHED),
        graph.heard('topology', TopologicalMap, qos.LATCHED),
        graph.heard('local_topology', TopologicalMap, qos.LATCHED),
    )


def drive(graph, x, y, yaw, metres, **localizer):
    """Nodes of a robot that has driven along a path and stands still.

    Then only the robot is stopped. localizer: more of its parameters.
    """
    truth = graph.heard('ground_truth', PoseStamped)
    start = {'initial_x_m': x, 'initial_y_m': y, 'initial_yaw_rad': yaw}
    graph.start('localizer', use_sim_time=True, **start, **localizer)
    graph.start(
        'sim',
        remap=graph.paced(),
        start=f'{x},{y},{yaw}',
        real_time_factor=4.0,
        lockstep='local_topology',
        wait_for_subscribers=1,
    )
    commands = graph.node.create_publisher(Twist, 'cmd_vel', 10)
    forward = Twist()
    forward.linear.x = 0.3

    def far_enough():
        commands.publish(forward)
        return (
            truth
            and np.hypot(truth[-1].pose.position.x - x, truth[-1].pose.position.y - y) > metres
        )

    graph.until(far_enough, 'the robot makes its way')
    T = messages.pose_from_msg(truth[-1].pose)
    assert graph.stop('sim') == graph.stop('localizer') == 0
    return T


def names_of(regions):
    """Names by id, of the newest message."""
    newest = regions[-1].regions if regions else []
    return {region.id: region.name for region in newest if region.name}


def refuse_names(graph):
    """What is no region, or no name, gets a line and changes nothing."""
    for request, said in (
        (NameRegion.Request(id=99, name='x'), 'region 99: expected the id of a region'),
        (NameRegion.Request(point=Point(x=500.0), name='x'), 'point 500, 0: expected a point'),
        (NameRegion.Request(point=Point(x=np.nan), name='x'), 'point'),
        (NameRegion.Request(point=Point(x=2.0, y=2.0), name='x' * 65), 'at most 64 characters'),
    ):
        response = graph.call(NameRegion, 'name_region', request)
        assert not response.success and said in response.message


def give_name(graph, regions, name):
    """Name the region around the way by its place, then by its id; returns the id."""
    # Ahead of the start, which the laser sees from the first poses alone: their scans may be lost.
    by_place = NameRegion.Request(point=Point(x=3.2, y=3.6), name='first')
    graph.until(
        lambda: graph.call(NameRegion, 'name_region', by_place).success, 'a region on the way'
    )
    graph.until(lambda: names_of(regions), 'the first name')
    ((number, first),) = names_of(regions).items()
    assert first == 'first'
    assert graph.call(NameRegion, 'name_region', NameRegion.Request(id=number, name=name)).success
    graph.until(lambda: names_of(regions) == {number: name}, 'the other name')
    return number


def test_ids_and_cells_survive_a_restart_and_mapping_continues(graph, tmp_path):
    maps, graphs, local = heard_maps(graph)
    regions = graph.heard('regions', RegionArray, qos.LATCHED)
    often = {'grid_mapper': {}, 'topology_builder': {'region_update_period_s': 0.5}}
    for name in MAPPERS:
        graph.start(name, use_sim_time=True, **often[name])
    T = drive(graph, 2.0, 2.0, 0.9, 3.2)
    graph.until(lambda: regions and regions[-1].regions, 'regions')
    refuse_names(graph)
    named = give_name(graph, regions, 'the laboratory')
    stem = tmp_path / 'today' / 'room'

    def save_all():
        return graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(stem)))

    # The mapper may not have detected the end of the localizer yet, and asks it for its part.
    graph.until(lambda: 'no answer' not in save_all().message, 'an answer of all that are there')
    response = save_all()
    assert response.success, response.message
    assert all(word in response.message for word in ('.pgm', '.yaml', '.grid.npz', '.topology.npz'))
    ends = ['.grid.npz', '.pgm', '.regions.npz', '.topology.npz', '.yaml']
    assert sorted(file.name for file in stem.parent.iterdir()) == [f'room{end}' for end in ends]
    for name in MAPPERS:
        assert graph.stop(name) == 0
    graph.drain()
    before = places(graphs[-1])
    edges = set(graphs[-1].edge_ids)
    known = sessions.load_grid(str(stem)).known_area()
    assert len(before) > 3
    maps.clear(), graphs.clear(), local.clear(), regions.clear()
    for name in MAPPERS:
        graph.start(name, use_sim_time=True, session_path=str(stem), **often[name])
    graph.until(lambda: names_of(regions) == {named: 'the laboratory'}, 'the name of the region')
    graph.until(lambda: maps and graphs, 'the saved map and graph, without a scan')
    assert not local
    assert places(graphs[-1]) == before and set(graphs[-1].edge_ids) == edges
    assert np.array_equal(messages.grid_from_msg(maps[-1]).cells, known.trinary())
    drive(graph, *T.tolist(), 0.3)
    # Mapping has continued: more is known, remaining nodes have their ids, and no id is used twice.
    now_known = (messages.grid_from_msg(maps[-1]).cells >= 0).sum()
    assert now_known >= (known.trinary() >= 0).sum()
    after = places(graphs[-1])
    stayed = [
        k
        for k in before.keys() & after.keys()
        if np.hypot(*np.subtract(before[k], after[k])[1:]) < 0.5
    ]
    assert len(stayed) >= len(before) / 2
    assert all(k > max(before.keys() | edges) for k in after.keys() - before.keys())


def test_a_session_is_saved_when_the_nodes_end_and_not_by_those_without_a_map(graph):
    stem = graph.folder / 'maps' / 'room'
    own = {'save_on_exit': 'maps/room', 'use_sim_time': True}
    graph.start('grid_mapper', **own, autosave_period_s=0.5)
    graph.start('topology_builder', **own)
    drive(graph, 2.0, 2.0, 0.9, 0.3, save_on_exit='maps/room')
    saved = f'saved {stem}.pgm'
    graph.until(lambda: graph.log('grid_mapper').count(saved) > 1, 'maps, while the node runs')
    for name in MAPPERS:
        assert graph.stop(name) == 0
    ends = ['.grid.npz', '.keyframes.npz', '.pgm', '.regions.npz', '.slam.npz', '.topology.npz']
    files = sorted(file.name for file in stem.parent.iterdir())
    assert files == [f'room{end}' for end in (*ends, '.yaml')]
    assert sessions.load_grid(str(stem)).known_area().free.sum() > 500
    before = {file.name: file.read_bytes() for file in stem.parent.iterdir()}
    for name in ('localizer', *MAPPERS):
        graph.start(name, **own)
        graph.until(lambda name=name: 'ready' in graph.log(name), 'the node')
        assert graph.stop(name) == 0
    assert {file.name: file.read_bytes() for file in stem.parent.iterdir()} == before
    refused = graph.start('localizer', save_on_exit='../elsewhere')
    assert refused.wait(PATIENCE_S) == 2
    graph.processes.pop('localizer')
    assert 'expected a file below' in graph.log('localizer')


def room_of(resolution=0.1):
    """Grid and graph of a room of 6 x 6 m as observed from its centre."""
    occupied = np.zeros((60, 60), dtype=np.uint8)
    occupied[[0, -1]] = 1
    occupied[:, [0, -1]] = 1
    occupied[20:25, 35:40] = 1
    grid = OccupancyGrid(OccupancyConfig(resolution_m=resolution))
    builder = TopologyBuilder()
    world = World('room', occupied, OccupancyGrid(PAPER_GRID).frame, pose(2.0, 2.0, 0.0))
    laser = LaserScanner(LaserScannerConfig(), 1)
    for k in range(12):
        T = pose(2.0 + 0.1 * k, 3.0, 0.4 * k)
        grid.add_scan(laser.scan(world, T, k), T)
        builder.update(grid.window(T[0], T[1], 10.0), T)
    return grid, builder


def save(stem, grid, builder=None):
    sessions.save_grid(str(stem), grid)
    if builder is not None:
        sessions.TOPOLOGY.save(str(stem), builder)


def write_bad_sessions(folder, grid, builder):
    """Sessions that cannot be loaded, with the expected error of each by its name."""
    save(folder / 'cut', grid, builder)
    save(folder / 'half', grid, builder)
    (folder / 'cut.grid.npz').write_bytes((folder / 'cut.grid.npz').read_bytes()[:-200])
    (folder / 'half.topology.npz').write_bytes((folder / 'half.topology.npz').read_bytes()[:300])
    save(folder / 'mixed', grid, room_of(0.05)[1])
    return {
        'cut': 'cut.grid.npz',
        'half': 'half.topology.npz',
        'mixed': 'mixed.topology.npz',
        'nowhere': 'nowhere.yaml',
        'nowhere.grid.npz': 'nowhere.grid.npz',
        '': 'expected the path',
    }


def test_sessions_are_loaded_into_running_nodes_or_refused_in_words(graph, tmp_path):
    grid, builder = room_of()
    save(tmp_path / 'room', grid, builder)
    maps, graphs, _ = heard_maps(graph)
    graph.start('grid_mapper')
    response = graph.call(
        LoadMap, 'load_map', LoadMap.Request(path=str(tmp_path / 'room.grid.npz'))
    )
    assert response.success and 'topology_builder is not running' in response.message
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(tmp_path / 'alone')))
    assert response.success and 'topology_builder is not running' in response.message
    assert not (tmp_path / 'alone.topology.npz').exists()
    # The graph of an earlier grid must not be loaded with the new one.
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(tmp_path / 'room')))
    assert response.success and 'room.topology.npz.old' in response.message
    assert (tmp_path / 'room.topology.npz.old').exists() and not (
        tmp_path / 'room.topology.npz'
    ).exists()
    save(tmp_path / 'room', grid, builder)
    graph.start('topology_builder')

    def load(name):
        path = str(tmp_path / name) if name else ''
        return graph.call(LoadMap, 'load_map', LoadMap.Request(path=path))

    graph.until(
        lambda: 'topology_builder is not running' not in load('room').message,
        'the mapper sees the builder',
    )
    graph.until(lambda: maps and graphs and graphs[-1].node_ids, 'map and graph, published at once')
    expected = places(messages.topology_msg(builder.map, 'map', 0))
    assert places(graphs[-1]) == expected
    for name, said in write_bad_sessions(tmp_path, grid, builder).items():
        response = load(name)
        assert not response.success and said in response.message, (name, response.message)
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(tmp_path / 'again')))
    assert response.success, response.message
    assert places(graphs[-1]) == expected
    again = sessions.load_grid(str(tmp_path / 'again'))
    assert np.array_equal(again.state()['log_odds'], grid.state()['log_odds'])
    assert sessions.TOPOLOGY.load(str(tmp_path / 'again')).map.nodes == builder.map.nodes
    # Any map_server map will do; no graph belongs to it.
    occupancy_maps.write_map(tmp_path / 'map', grid.known_area())
    response = load('map.yaml')
    assert response.success and 'graph reset' in response.message
    graph.until(lambda: not graphs[-1].node_ids, 'an empty graph')
    known = messages.grid_from_msg(maps[-1])
    assert np.array_equal(known.occupied, grid.known_area().occupied)
    # The mapper adopts the resolution of a map.
    occupancy_maps.write_map(tmp_path / 'coarse', room_of(0.2)[0].known_area())
    assert load('coarse.yaml').success
    graph.until(lambda: maps[-1].info.resolution > 0.15, 'the map with its own cells')
    for name in MAPPERS:
        assert graph.stop(name) == 0


def files_below(folder):
    """Contents of all files below a folder, except logs and checkpoints of nodes."""
    files = [p for p in folder.rglob('*') if p.is_file() and p.suffix != '.log']
    return {p: p.read_bytes() for p in files if 'state' not in p.parts}


def test_services_touch_nothing_outside_of_their_folder(graph, tmp_path):
    folder = tmp_path / 'maps'
    outside = tmp_path / 'outside'
    folder.mkdir(), outside.mkdir()
    save(outside / 'room', *room_of())
    occupancy_maps.write_map(outside / 'drawn', room_of()[0].known_area())
    (folder / 'link').symlink_to(outside)
    (folder / 'circle').symlink_to(folder / 'circle')
    for end in ('.grid.npz', '.topology.npz'):
        (folder / f'linked{end}').symlink_to(outside / f'room{end}')
    described = (outside / 'drawn.yaml').read_text()
    (folder / 'seen.yaml').write_text(described.replace('drawn.pgm', '../outside/drawn.pgm'))
    for name in ('grid_mapper', 'topology_builder', 'localizer', 'explorer'):
        graph.start(
            name,
            save_directory='maps',
            **({} if name == 'explorer' else {'recovery_timeout_s': 0.0}),
        )
    before = files_below(tmp_path)
    wrong = [
        str(outside / 'room'),
        '../outside/room',
        'link/room',
        'linked',
        'linked.grid.npz',
        'circle/room',
        '/etc/passwd',
        '/proc/self/fd/1',
        10_000 * 'x',
        'a/../../outside/room',
        'a\nb',
    ]
    calls = [
        (kind, name)
        for kind, names in (
            (SaveMap, ('save_map', 'save_topology', 'save_localizer', 'save_exploration')),
            (
                LoadMap,
                (
                    'load_map',
                    'load_topology',
                    'check_topology',
                    'load_localizer',
                    'check_localizer',
                ),
            ),
        )
        for name in names
    ]
    for kind, name in calls:
        for path in wrong:
            response = graph.call(kind, name, kind.Request(path=path))
            said = response.message
            assert not response.success and said.startswith('path '), (name, path, said)
            assert 'expected a file below' in said, (name, path, said)
            assert len(said) < 600 and said.isprintable()
    response = graph.call(LoadMap, 'load_map', LoadMap.Request(path='seen.yaml'))
    assert not response.success and 'image' in response.message and 'below' in response.message
    assert files_below(tmp_path) == before
    response = graph.call(SaveMap, 'save_map', SaveMap.Request(path='new/room'))
    assert response.success, response.message
    assert (folder / 'new' / 'room.grid.npz').exists()
    new = files_below(tmp_path).keys() - before.keys()
    assert new and all(file.is_relative_to(folder / 'new') for file in new)
    absolute = str(folder / 'new' / 'room.yaml')
    response = graph.call(LoadMap, 'load_map', LoadMap.Request(path=absolute))
    assert response.success, response.message
    # Paths given at the start are not confined.
    assert graph.stop('grid_mapper') == 0
    maps = graph.heard('map', OccupancyGridMsg, qos.LATCHED)
    graph.start('grid_mapper', save_directory='maps', session_path=str(outside / 'room'))
    graph.until(lambda: maps and max(maps[-1].data) > 50, 'the session from elsewhere')


def test_a_session_with_one_broken_part_is_not_loaded_in_parts(graph, tmp_path):
    grid, builder = room_of()
    save(tmp_path / 'room', grid, builder)
    save(tmp_path / 'other', room_of(0.2)[0], room_of(0.2)[1])
    (tmp_path / 'other.slam.npz').write_bytes(b'no archive')
    os.mkfifo(tmp_path / 'pipe.yaml')
    maps, graphs, _ = heard_maps(graph)
    for name in MAPPERS:
        graph.start(name, session_path=str(tmp_path / 'room'))
    graph.start('localizer', label='localizer')
    graph.until(lambda: maps and graphs, 'map and graph')
    before = places(graphs[-1])

    def load(name):
        return graph.call(LoadMap, 'load_map', LoadMap.Request(path=name))

    # The mapper may not have detected the others yet, but with them it loads nothing.
    graph.until(lambda: 'not running' not in load('room').message, 'the mapper sees the others')
    maps.clear(), graphs.clear()
    response = load('other')
    assert not response.success and 'other.slam.npz' in response.message, response.message
    response = load('pipe')
    assert not response.success and 'a named pipe' in response.message, response.message
    assert load('room').success
    graph.until(lambda: maps and graphs, 'the map and graph of the last request')
    # Nothing of the broken session was published in between.
    assert all(abs(found.info.resolution - 0.1) < 1e-6 for found in maps)
    assert all(places(found) == before for found in graphs)


def test_no_file_of_another_program_is_overwritten(graph, tmp_path):
    (tmp_path / 'navigator.yaml').write_text('navigator:\n  ros__parameters: {}\n')
    (tmp_path / 'photo.pgm').write_bytes(b'P5\n1 1\n255\n\0')
    occupancy_maps.write_map(tmp_path / 'house', room_of()[0].known_area())
    described = (tmp_path / 'house.yaml').read_text()
    (tmp_path / 'house.yaml').write_text(described.split('\n', 1)[1])  # as another program has it
    for part in sessions.PARTS:
        (tmp_path / f'data{part.ending}').write_bytes(b'PK numbers of somebody else')
    before = files_below(tmp_path)
    for name in ('grid_mapper', 'topology_builder', 'localizer', 'explorer'):
        graph.start(name)

    def save(service, path):
        return graph.call(SaveMap, service, SaveMap.Request(path=path))

    for name in ('navigator', 'photo', 'house', 'data'):
        response = save('save_map', name)
        assert not response.success and 'expected another name' in response.message, response
    for service in ('save_topology', 'save_localizer', 'save_exploration'):
        response = save(service, 'data')
        assert not response.success and 'expected another name' in response.message, response
    assert files_below(tmp_path) == before
    # Its own files are replaced, but not more often than a user would have it.
    answers = [save('save_topology', 'room') for _ in range(21)]
    assert [answer.success for answer in answers] == [True] * 20 + [False]
    assert '20 saves within 60 s' in answers[-1].message
    response = save('save_map', 'mine')
    assert (tmp_path / 'mine.yaml').exists(), response.message
    (tmp_path / 'mine.grid.npz').unlink()
    assert 'another name' not in save('save_map', 'mine').message
    assert (tmp_path / 'mine.grid.npz').exists()


def test_a_session_of_nonsense_leaves_the_running_map_as_it_was(graph, tmp_path):
    grid, builder = room_of()
    save(tmp_path / 'room', grid, builder)
    save(tmp_path / 'bad', grid, builder)
    with np.load(tmp_path / 'bad.topology.npz') as archive:
        arrays = dict(archive)
    arrays['tiles'][0, 0] = 10**9
    np.savez(tmp_path / 'bad.topology.npz', **arrays)
    maps, graphs, _ = heard_maps(graph)
    for name in MAPPERS:
        graph.start(name, session_path=str(tmp_path / 'room'))
    graph.until(lambda: maps and graphs, 'map and graph')
    before = places(graphs[-1])

    def refused():
        response = graph.call(LoadMap, 'load_map', LoadMap.Request(path='bad'))
        return (
            not response.success and 'bad.topology.npz: saved topology: tiles' in response.message
        )

    graph.until(refused, 'the reason')
    again = graph.heard('topology', TopologicalMap, qos.LATCHED)
    graph.until(lambda: again, 'the graph as it is')
    assert places(again[-1]) == before
    for name in MAPPERS:
        assert graph.stop(name) == 0


def test_a_builder_that_does_not_answer_is_reported_and_the_mapper_continues(graph, tmp_path):
    async def never(request, response):
        await Future()

    asked = graph.node.create_service(
        SaveMap, 'save_topology', never, callback_group=ReentrantCallbackGroup()
    )
    graph.start('grid_mapper')
    # Before discovery the mapper finds no builder.
    answers = []

    def save_again():
        answers.append(
            graph.call(SaveMap, 'save_map', SaveMap.Request(path=str(tmp_path / 'room')))
        )
        return not answers[-1].success

    graph.until(save_again, 'the mapper asks')
    assert 'save_topology: no answer' in answers[-1].message
    assert (tmp_path / 'room.grid.npz').exists()
    graph.node.destroy_service(asked)
    assert graph.stop('grid_mapper') == 0


@pytest.mark.parametrize(
    ('name', 'values'),
    [('grid_mapper', {}), ('topology_builder', {}), ('explorer', {})]
    + [('localizer', {'slam': slam}) for slam in ('scan_matching', 'ekf_ti')],
)
def test_a_session_that_is_not_there_ends_the_start_with_one_clear_line(graph, name, values):
    process = graph.start(name, session_path='/nowhere/room', **values)
    assert graph.ended(process) == 2
    lines = graph.log(name).strip().splitlines()
    assert '/nowhere/room' in lines[-1] and 'Traceback' not in graph.log(name)
