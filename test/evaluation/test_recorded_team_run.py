"""Results of several robots, from a bag of known poses and maps."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from support import bag_maker

from thinmap_ros.core import se2
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.evaluation import recorded_run
from thinmap_ros.files import occupancy_maps, package_data
from thinmap_ros.files.worlds import read_world

WORLD = package_data.world_path('room_10x10')
SECOND = 10**9
# Of the frame of the map of robot2 in the world, and of its place as map_joiner publishes it.
TRUE_PLACE = se2.pose(2.0, 0.0, 0.0)
PLACE = se2.pose(2.03, 0.04, np.radians(0.5))
RESULT = {
    'robots': [
        {'name': f'robot{n}', 'finished': True, 'reason': why, 'start_ns': SECOND, 'end_ns': end}
        for n, why, end in ((1, 'all seen', 9 * SECOND), (2, 'nothing left', 7 * SECOND))
    ]
}
CONTACTS = {'robot1': 1, 'robot2': 2}


def half_of_the_world(is_right):
    """The map of one half of the world, world frame."""
    _, patch, _ = read_world(WORLD)
    cells = patch.cells.copy()
    middle = cells.shape[1] // 2
    unknown = slice(None, middle) if is_right else slice(middle, None)
    cells[:, unknown] = -1
    return GridPatch(patch.frame, cells)


def moved(patch, x):
    """A map in a frame that lies at x, m."""
    frame = patch.frame
    return GridPatch(GridFrame(frame.origin_x - x, frame.origin_y, frame.resolution), patch.cells)


class Robots:
    """Writes what two robots and map_joiner publish: one metre each second along x."""

    def __init__(self, writer, make, is_joined):
        writer.add_definitions(package_data.message_definitions('thinmap_msgs'))
        self.writer = writer
        self.make = make
        maps = {'robot1': half_of_the_world(False), 'robot2': moved(half_of_the_world(True), 2.0)}
        for name, T_world_map in (('robot1', np.zeros(3)), ('robot2', TRUE_PLACE)):
            for second in range(1, 10):
                true = se2.pose(1.0 + 0.5 * second, 3.0, 0.0)
                self.poses(name, second * SECOND, true, se2.between(T_world_map, true))
            self.grid(f'/{name}/map', 5 * SECOND, maps[name])
            contacts = make('std_msgs/msg/UInt32', data=CONTACTS[name])
            writer.write(f'/{name}/collisions', 'std_msgs/msg/UInt32', 9 * SECOND, contacts)
        self.status(3 * SECOND, {})
        if is_joined:
            self.status(6 * SECOND, {'robot1': np.zeros(3), 'robot2': PLACE})
            self.grid('/merged_map', 8 * SECOND, read_world(WORLD)[1])

    def pose(self, T):
        x, y, yaw = T.tolist()
        w = np.cos(yaw / 2.0)
        z = np.sin(yaw / 2.0)
        return self.make(
            'geometry_msgs/msg/Pose',
            position=self.make('geometry_msgs/msg/Point', x=x, y=y, z=0.0),
            orientation=self.make('geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=z, w=w),
        )

    def poses(self, name, ns, true, estimated):
        make = self.make
        kind = 'geometry_msgs/msg/PoseStamped'
        stamped = make(kind, header=make.header('world', ns), pose=self.pose(true))
        self.writer.write(f'/{name}/ground_truth', kind, ns, stamped)
        kind = 'geometry_msgs/msg/PoseWithCovariance'
        pose = make(kind, pose=self.pose(estimated), covariance=np.zeros(36))
        kind = f'{kind}Stamped'
        message = make(kind, header=make.header('map', ns), pose=pose)
        self.writer.write(f'/{name}/pose', kind, ns, message)

    def grid(self, topic, ns, patch):
        make = self.make
        rows, cols = patch.shape
        header = make.header('map', ns)
        info = make(
            'nav_msgs/msg/MapMetaData',
            map_load_time=header.stamp,
            resolution=patch.frame.resolution,
            width=cols,
            height=rows,
            origin=self.pose(se2.pose(patch.frame.origin_x, patch.frame.origin_y, 0.0)),
        )
        kind = 'nav_msgs/msg/OccupancyGrid'
        data = np.ascontiguousarray(patch.cells, dtype=np.int8).ravel()
        self.writer.write(topic, kind, ns, make(kind, header=header, info=info, data=data))

    def status(self, ns, places):
        make = self.make
        maps = [
            make(
                'thinmap_msgs/msg/RobotMap',
                name=f'/{name}',
                is_joined=name in places,
                pose=self.pose(places.get(name, np.zeros(3))),
                other='',
                join_odds=1.0,
                matches=3,
            )
            for name in ('robot1', 'robot2')
        ]
        kind = 'thinmap_msgs/msg/JoinStatus'
        message = make(kind, header=make.header('world', ns), maps=maps)
        self.writer.write('/join_status', kind, ns, message)


def results(out: Path, is_joined: bool):
    bag_maker.write(out / 'bag', partial(Robots, is_joined=is_joined))
    return recorded_run.write(out, WORLD, '2dx', RESULT, [np.zeros(3), TRUE_PLACE])


def test_the_report_has_way_contacts_and_errors_of_each_robot_and_of_the_joins(tmp_path):
    report = results(tmp_path, is_joined=True)
    assert report == json.loads((tmp_path / 'report.json').read_text())
    assert report['finished'] and report['reason'] == 'all seen; nothing left'
    assert report['time'] == 8.0
    assert report['collisions'] == 3
    # Half of the area each: together all of it.
    assert report['coverage'] > 0.99
    assert 0.4 < report['curve'][0][1] < 0.6
    one, two = report['robots']
    assert (one['distance'], two['distance'], report['distance']) == (4.0, 3.0, 7.0)
    assert (one['time'], two['time']) == (8.0, 6.0)
    assert (one['pose_rmse'], two['pose_rmse']) == (0.0, 0.0)
    assert (one['joined_at'], one['join_error']) == (5.0, [0.0, 0.0])
    assert (two['joined_at'], two['join_error']) == (5.0, [0.05, 0.5])
    assert report['joins'][1] == 'robot2: after 5 s, off by 0.05 m, 0.5 deg'
    _, world, _ = read_world(WORLD)
    assert occupancy_maps.read_map(tmp_path / 'map.yaml').free.sum() == world.free.sum()
    assert (tmp_path / 'summary.png').stat().st_size > 10_000
    assert np.loadtxt(tmp_path / 'trajectory_robot2.tum')[0, 1:3].tolist() == [-0.5, 3.0]


def test_without_a_join_the_map_is_that_of_the_first_robot(tmp_path):
    report = results(tmp_path, is_joined=False)
    assert report['joins'] == ['robot1: not joined', 'robot2: not joined']
    assert report['robots'][1]['joined_at'] is None
    free = half_of_the_world(False).free.sum()
    assert occupancy_maps.read_map(tmp_path / 'map.yaml').free.sum() == free


def test_a_bag_of_fewer_robots_is_refused(tmp_path):
    results(tmp_path, is_joined=False)
    third = {**RESULT['robots'][0], 'name': 'robot3'}
    with pytest.raises(InputError, match='expected /robot3/ground_truth, /robot3/pose and'):
        recorded_run.write(tmp_path, WORLD, '2dx', {'robots': [third]}, [np.zeros(3)])
