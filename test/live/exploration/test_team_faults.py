"""Robots that explore a world together: one is killed, or the network between them fails."""

import pytest
from support.driving_team import DrivingTeam
from support.niches import write_niches

from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.coverage import observable_cells
from thinmap_ros.sim.other_robots import starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

pytestmark = pytest.mark.live
SPEED = {'controller.max_speed_m_s': 0.5}
RADIUS_M = PRESETS['2dx'].radius_m
RANGE_M = 8.0


class Scene:
    """A world, and robots that start side by side in it."""

    def __init__(self, graph, path, robots, **parameters):
        world = World.from_patch(*read_world(path))
        starts = starts_side_by_side(world, world.start, robots, RADIUS_M)
        seen = observable_cells(world, world.start, RADIUS_M, RANGE_M)
        self.area_m2 = seen.area_m2
        self.team = DrivingTeam(graph, path, starts, **SPEED, **parameters)
        self.team.until_joined()

    def require_complete(self, names):
        """Robots finish, know the world, and nobody has touched anything."""
        self.team.until_finished(names)
        for name in names:
            status = self.team.status(name)
            assert status.known_area_m2 >= 0.97 * self.area_m2
            assert status.reason_code == status.ALL_RESOLVED, status.reason
        assert self.team.contacts() == 0


@pytest.fixture
def niches(tmp_path):
    return write_niches(tmp_path)


def explore_with_one_killed(scene, at_s):
    scene.team.until_time(at_s)
    *others, last = scene.team.names
    scene.team.kill(last)
    scene.require_complete(others)


def explore_with_network_cut(scene, at_s, duration_s):
    team = scene.team
    team.until_time(at_s)
    team.radio.is_on = False
    team.until_time(at_s + duration_s)
    team.radio.is_on = True
    scene.require_complete(team.names)
    assert team.radio.carried['tiles'] > 0


@pytest.mark.cpu_budget(35.0, 'two robots explore, with all of their nodes')
def test_the_other_robot_explores_what_a_killed_one_had_claimed(graph, niches):
    explore_with_one_killed(Scene(graph, niches, 2, claim_timeout_s=3.0), 4.0)


@pytest.mark.cpu_budget(45.0, 'two robots explore, with all of their nodes')
def test_robots_finish_though_messages_are_lost_and_the_network_fails(graph, niches):
    explore_with_network_cut(Scene(graph, niches, 2, loss=0.1, claim_timeout_s=3.0), 4.0, 8.0)


@pytest.mark.slow
@pytest.mark.parametrize('robots', [2, 3])
def test_a_killed_robot_in_a_lab(graph, robots):
    explore_with_one_killed(Scene(graph, package_data.world_path('lab'), robots), 15.0)


@pytest.mark.slow
@pytest.mark.parametrize('robots', [2, 3])
def test_the_network_in_a_lab_fails_for_a_minute(graph, robots):
    scene = Scene(graph, package_data.world_path('lab'), robots, loss=0.1)
    explore_with_network_cut(scene, 15.0, 60.0)
