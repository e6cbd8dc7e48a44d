"""Two robots on machines of their own, with a weak link between them, which also breaks."""

import json
import time

import pytest
from support.machines import Cable, Machines, Weakness

from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.other_robots import starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

pytestmark = pytest.mark.live
SIMULATOR = 0
ROBOTS = {'/robot1': 1, '/robot2': 2}
WEAK = Weakness(loss=0.1, delay_s=0.02, seed=7)
CABLES = [Cable((SIMULATOR, 1)), Cable((SIMULATOR, 2)), Cable((1, 2), WEAK)]
BETWEEN_ROBOTS = 2  # number of the cable
RADIUS_M = PRESETS['2dx'].radius_m
RANGE_M = 8.0
RATE = 3.0


@pytest.fixture
def machines(ros_domain, tmp_path):
    three = Machines(tmp_path, CABLES)
    yield three
    three.close()


def start_robot(machines, name, start):
    x, y, yaw = (float(number) for number in start)
    machines.start(
        ROBOTS[name],
        'thinmap',
        remap=(f'__ns:={name}', '/tf:=tf', '/tf_static:=tf_static'),
        label=name.strip('/'),
        use_sim_time=True,
        team=True,
        autostart_exploration=True,
        initial_x_m=x,
        initial_y_m=y,
        initial_yaw_rad=yaw,
        **{'controller.max_speed_m_s': 0.5},
    )


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_two_robots_explore_over_a_link_that_loses_a_tenth_of_the_frames_and_breaks(
    machines, tmp_path
):
    path = package_data.world_path('lab')
    world = World.from_patch(*read_world(path))
    starts = starts_side_by_side(world, world.start, len(ROBOTS), RADIUS_M)
    result = tmp_path / 'result.json'
    watch = machines.start(SIMULATOR, 'team_watch', words=(str(result), *ROBOTS), package='support')
    for name, start in zip(ROBOTS, starts, strict=True):
        start_robot(machines, name, start)
    machines.start(
        ROBOTS['/robot1'],
        'map_joiner',
        use_sim_time=True,
        known_init_poses=True,
        **{f'{name}/map_merge/init_pose_x': 0.0 for name in ROBOTS},
    )
    machines.start(
        SIMULATOR,
        'sim',
        world=str(path),
        robots=len(ROBOTS),
        starts=';'.join(','.join(map(str, start.tolist())) for start in starts),
        real_time_factor=RATE,
        lockstep='local_topology',
        wait_for_subscribers=3,
    )
    time.sleep(20.0)
    machines.unplugged(60.0 / RATE, BETWEEN_ROBOTS)
    machines.wait(lambda: watch.poll() is not None, 'both have finished', 700.0)
    assert watch.poll() == 0, machines.logs()
    ends = json.loads(result.read_text())
    area_m2 = observable_cells(world, world.start, RADIUS_M, RANGE_M).area_m2
    for name in ROBOTS:
        assert ends[name]['is_complete'], ends
        assert ends[name]['contacts'] == 0, ends
        assert ends[name]['known_area_m2'] >= 0.97 * area_m2, ends
    frames = machines.frames()
    assert 0.08 < frames['lost'] / (frames['carried'] + frames['lost']) < 0.12, frames
