"""The line that tells how a robot is: the worst of its nodes, and what it explores."""

from diagnostic_msgs.msg import DiagnosticStatus

from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.nodes.parts.progress import line_of


def state(level, message):
    return DiagnosticStatus(level=level, message=message)


def test_the_worst_node_is_named_and_a_well_robot_says_how_it_is_localized():
    well = {'localizer': state(DiagnosticStatus.OK, 'tracking')}
    assert line_of({}, None) == 'waiting for the nodes'
    assert line_of(well, None) == 'tracking'
    ill = {**well, 'navigator': state(DiagnosticStatus.WARN, 'standing still')}
    assert line_of(ill, None) == 'navigator: standing still'
    worse = {**ill, 'grid_mapper': state(DiagnosticStatus.ERROR, 'silent')}
    assert line_of(worse, None) == 'grid_mapper: silent'


def test_an_exploration_is_told_while_it_lasts_and_its_end_after_it():
    status = ExplorationStatus(state=ExplorationStatus.EXPLORING, has_target=True)
    status.known_area_m2 = 12.4
    status.distance_m = 3.26
    status.elapsed.sec = 41
    status.target_position.x = 1.5
    line = line_of({'localizer': state(DiagnosticStatus.OK, 'tracking')}, status)
    assert line == 'tracking; 12 m2, 3.3 m, 41 s: to the end node at 1.5, 0.0'
    status.state = ExplorationStatus.FINISHED
    status.reason = 'all end nodes resolved'
    assert line_of({}, status).endswith('41 s: all end nodes resolved')
    idle = ExplorationStatus(state=ExplorationStatus.IDLE)
    assert line_of({}, idle) == 'waiting for the nodes'
