"""A robot that is carried away in the closed loop finds its place again, and explores on."""

from thinmap_ros.closed_loop.robot import Options
from thinmap_ros.evaluation.exploration_run import explore
from thinmap_ros.files import package_data
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.world import World


def test_a_kidnapped_robot_drives_until_it_knows_its_place():
    """From where it is put it sees all around, so that its own surroundings need no exploring."""
    world = World.from_patch(*read_world(package_data.world_path('office')))
    options = Options(
        localization='slam', speed_m_s=0.5, kidnap_at_s=20.0, seed=1, time_limit_s=120.0
    )
    robot, report = explore(world, world.start, options)
    assert report['found_right'] and report['found_after_s'] < 30.0
    assert report['finished'] and report['coverage'] > 0.97
    assert report['collisions'] == 0
    assert robot.is_finished
