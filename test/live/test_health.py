"""/diagnostics of the nodes, their states, and the common services of all nodes."""

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionClient
from sensor_msgs.msg import LaserScan
from std_srvs.srv import SetBool, Trigger
from support.doctor import Doctor
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import LocalGrid, TopologicalMap
from thinmap_msgs.srv import SaveMap
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.files.sessions import EXPLORATION
from thinmap_ros.ros import diagnostics, messages, qos

pytestmark = pytest.mark.live
AT_START = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'initial_yaw_rad': 0.0}
START = '2.0,2.0,0.0'
MAPPING = ('localizer', 'grid_mapper', 'topology_builder')


def test_nodes_report_rates_step_times_and_silence(graph):
    doctor = Doctor(graph)
    graph.start('thinmap', arguments=MAPPING, use_sim_time=True, **AT_START)
    graph.start('sim', start=START, wait_for_subscribers=1)
    nodes = ('localizer', 'grid_mapper', 'topology_builder', 'sim')
    graph.until(
        lambda: all(doctor.level(node) == DiagnosticStatus.OK for node in nodes), 'all is well'
    )
    graph.until(lambda: 3.0 < doctor.number('localizer', 'scan: rate') < 8.0, 'scans at 5 Hz')
    graph.until(lambda: doctor.status('localizer').message == 'tracking', 'it tracks')
    for node, step in (
        ('localizer', 'localizer'),
        ('grid_mapper', 'map update'),
        ('topology_builder', 'graph update'),
    ):
        graph.until(
            lambda n=node, s=step: 'median' in doctor.value(n, f'{s}: step time'),
            f'step times of {node}',
        )
    graph.until(
        lambda: doctor.number('topology_builder', 'local_grid: received') > 0, 'windows are counted'
    )
    graph.until(lambda: doctor.number('localizer', 'scan: received') > 5, 'more than five scans')
    graph.until(lambda: doctor.number('localizer', 'scan: publishers') == 1, 'the simulation')
    graph.until(lambda: doctor.number('localizer', 'localized_scan: subscribers') == 1, 'mapper')
    graph.stop('sim')
    graph.until(
        lambda: 'scan: silent for' in doctor.status('localizer').message, 'silence is reported'
    )
    assert doctor.level('localizer') == DiagnosticStatus.WARN
    assert 's ago' in doctor.value('localizer', 'scan: last')
    assert 'silent for' in graph.log('thinmap')
    assert doctor.number('localizer', 'scan: received') > 5


def test_two_localizers_on_one_graph_are_detected_and_reported(graph):
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0')
    graph.until(
        lambda: doctor.level('localizer') == DiagnosticStatus.WARN,
        'one localizer, which waits for scans',
    )
    rival = graph.node.create_publisher(PoseWithCovarianceStamped, 'pose', qos.STREAM)
    graph.until(
        lambda: doctor.level('localizer') == DiagnosticStatus.ERROR, 'the second publisher of /pose'
    )
    message = doctor.status('localizer').message
    assert (
        '2 nodes publish /pose' in message and '/localizer' in message and '/test_client' in message
    )
    assert '2 nodes publish /pose' in graph.log('localizer')
    graph.node.destroy_publisher(rival)
    graph.until(lambda: doctor.level('localizer') == DiagnosticStatus.WARN, 'the complaint ends')


def test_another_publisher_of_velocity_commands_is_reported(graph):
    doctor = Doctor(graph)
    graph.start('navigator', laser_pose='0,0,0')
    rival = graph.node.create_publisher(Twist, 'cmd_vel', qos.STREAM)
    graph.until(
        lambda: '2 nodes publish /cmd_vel' in doctor.status('navigator').message,
        'the second publisher of /cmd_vel',
    )
    assert doctor.level('navigator') == DiagnosticStatus.WARN
    graph.node.destroy_publisher(rival)
    graph.until(
        lambda: 'publish /cmd_vel' not in doctor.status('navigator').message, 'the complaint ends'
    )


def test_second_sources_of_scans_odometry_and_clock_are_named_and_not_followed(graph):
    doctor = Doctor(graph)
    localizer = {'use_sim_time': True, 'initial_x_m': 2.0, 'initial_y_m': 2.0}
    graph.start('localizer', **localizer)
    graph.start('sim')

    def is_healthy():
        received = doctor.number('localizer', 'scan: received') > 5
        return received and doctor.level('localizer') == DiagnosticStatus.OK

    graph.until(is_healthy, 'one simulation')
    graph.start('sim', label='other', remap=('__node:=other',))
    for topic in ('scan', 'odom', 'clock'):
        line = f'2 nodes publish /{topic}: /other, /sim: stop all but one'
        graph.until(lambda text=line: text in graph.log('localizer'), f'two sources of {topic}')
    for topic in ('scan', 'odom', '/clock'):
        refused = f'dropped: {topic}: from another publisher'
        graph.until(lambda key=refused: doctor.number('localizer', key) > 5, f'{topic} is refused')
    # The clock of the other simulation starts at zero.
    assert 'clock jumped back' not in graph.log('localizer')
    # The log comes before the diagnostics.
    graph.until(lambda: doctor.level('localizer') == DiagnosticStatus.WARN, 'the warning')
    graph.stop('other')
    graph.until(lambda: 'nodes publish' not in doctor.status('localizer').message, 'one again')


def test_a_source_that_is_restarted_is_no_second_one(graph):
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0')
    for _ in range(3):
        graph.start('sim')
        graph.until(lambda: doctor.number('localizer', 'scan: publishers') == 1, 'a source')
        graph.stop('sim')
        graph.until(lambda: doctor.number('localizer', 'scan: publishers') == 0, 'none')
    assert 'nodes publish' not in graph.log('localizer')


@pytest.mark.parametrize('is_static', [False, True])
def test_a_second_source_of_the_pose_on_tf_is_reported_by_name(graph, is_static):
    doctor = Doctor(graph)
    graph.start('localizer', laser_pose='0,0,0', use_sim_time=True)
    graph.start('sim')
    graph.until(lambda: doctor.number('localizer', 'pose: received') >= 0, 'diagnostics')
    graph.until(lambda: doctor.level('localizer') == DiagnosticStatus.OK, 'one source')
    rival = 'map -> odom on /tf_static' if is_static else 'map -> odom on /tf:'
    if is_static:
        topic = graph.node.create_publisher(TFMessage, '/tf_static', qos.STATIC_TRANSFORMS)
        transform = messages.transform_msg(np.zeros(3), 'map', 'odom', 0)
        topic.publish(TFMessage(transforms=[transform]))
    else:
        rules = ('__node:=amcl', 'pose:=amcl_pose', 'slam_status:=amcl_status')
        graph.start('localizer', label='amcl', remap=rules, laser_pose='0,0,0', use_sim_time=True)
    source = '/test_client' if is_static else '/amcl'

    def is_reported():
        message = doctor.status('localizer').message
        return rival in message and source in message

    graph.until(is_reported, 'the second source, by its name')
    message = doctor.status('localizer').message
    assert 'publish_tf: false' in message
    assert doctor.level('localizer') == DiagnosticStatus.WARN
    assert '/localizer' not in message
    if is_static:
        graph.node.destroy_publisher(topic)
    else:
        graph.stop('amcl')
    graph.until(lambda: 'map -> odom' not in doctor.status('localizer').message, 'one again')


def test_past_errors_are_not_reported_first(ros_domain, monkeypatch):
    """An old rejection must not be reported first when something else is dropped."""
    now = [100.0]
    monkeypatch.setattr(diagnostics, 'monotonic', lambda: now[0])
    rclpy.init(domain_id=ros_domain)
    node = rclpy.create_node('patient')
    try:
        told = diagnostics.NodeDiagnostics(node)
        told.message_rejected('odom', 'pose nan: expected finite numbers')
        told.count_drops('scans without odometry at their time', 2)
        now[0] += 1.0
        told.message_rejected('scan', '0 beams: expected 1 to 200000')
        message = told._status(now[0]).message
        assert message.startswith('4 messages rejected or dropped: scan: 0 beams')
        assert 'odom: pose nan' in message and 'without odometry' in message
        told._publish()
        now[0] += 10.5
        told.count_drops('scan: gaps between the stamps', 1)
        message = told._status(now[0]).message
        assert message == '1 message rejected or dropped: scan: gaps between the stamps'
        # The count is reported permanently.
        values = {pair.key: pair.value for pair in told._status(now[0]).values}
        assert values['odom: rejected'] == '1'
    finally:
        node.destroy_node()
        rclpy.shutdown()


def test_a_localizer_walks_through_its_states(graph):
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    scans = graph.heard('scan', LaserScan, qos.SENSOR)
    graph.start('localizer', use_sim_time=True, autostart=False, **AT_START)
    graph.start('sim', start=START, wait_for_subscribers=2, real_time_factor=2.0)

    def state():
        return graph.call(GetState, '/localizer/get_state', GetState.Request()).current_state.id

    def change(transition):
        request = ChangeState.Request(transition=Transition(id=transition))
        return graph.call(ChangeState, '/localizer/change_state', request).success

    def some_scans():
        count = len(scans) + 5
        graph.until(lambda: len(scans) > count, 'scans')

    assert state() == State.PRIMARY_STATE_UNCONFIGURED
    some_scans()
    assert change(Transition.TRANSITION_CONFIGURE) and state() == State.PRIMARY_STATE_INACTIVE
    some_scans()
    assert not poses
    assert change(Transition.TRANSITION_ACTIVATE) and state() == State.PRIMARY_STATE_ACTIVE
    graph.until(lambda: poses, 'poses of an active localizer')
    assert not change(Transition.TRANSITION_CONFIGURE)
    assert change(Transition.TRANSITION_DEACTIVATE) and change(Transition.TRANSITION_CLEANUP)
    some_scans()
    poses.clear()
    some_scans()
    assert not poses
    assert graph.stop('localizer') == 0


def test_a_node_that_becomes_active_has_what_was_latched(graph):
    maps = graph.node.create_publisher(LocalGrid, 'local_grid', qos.LATCHED)
    graphs = graph.heard('local_topology', TopologicalMap, qos.LATCHED)
    graph.start('explorer', autostart=False, laser_pose='0,0,0')
    doctor = Doctor(graph)
    empty = LocalGrid()
    empty.grid.info.resolution = -1.0
    maps.publish(empty)
    graph.until(lambda: doctor.number('explorer', 'local_grid: received') == 1.0, 'the latched map')
    assert doctor.number('explorer', 'local_grid: rejected') == 0.0
    learned = {'ids': [1], 'places': [[1.0, 2.0]], 'visits': [1], 'cell_counts': [0]}
    learned = {name: np.array(values) for name, values in learned.items()}
    learned['cells'] = np.empty((0, 2), dtype=np.int64)
    stem = str(graph.folder / 'floor')
    EXPLORATION.save(stem, Explorer.from_state(learned))
    save = SaveMap.Request(path=stem)
    refused = graph.call(SaveMap, 'save_exploration', save)
    assert not refused.success and 'explorer is not active: expected' in refused.message
    for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert graph.call(ChangeState, '/explorer/change_state', request).success
    graph.until(
        lambda: doctor.number('explorer', 'local_grid: rejected') == 1.0, 'it is taken, and refused'
    )
    assert not graphs
    # It has learned nothing: the other one knows more.
    refused = graph.call(SaveMap, 'save_exploration', save)
    assert not refused.success and 'overwrite: true' in refused.message
    assert len(EXPLORATION.load(stem).state()['ids']) == 1
    save.overwrite = True
    assert graph.call(SaveMap, 'save_exploration', save).success
    assert len(EXPLORATION.load(stem).state()['ids']) == 0


def test_pause_and_reset(graph):
    doctor = Doctor(graph)
    poses = graph.heard('pose', PoseWithCovarianceStamped)
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    graph.start('thinmap', arguments=MAPPING, use_sim_time=True, **AT_START)
    graph.start('sim', start=START, wait_for_subscribers=1, real_time_factor=4.0)
    graph.until(lambda: maps and graphs and graphs[-1].node_ids, 'map and graph')
    assert graph.call(SetBool, '/localizer/pause', SetBool.Request(data=True)).success

    def said_of_a_paused_one():
        statuses = [s for array in doctor.heard for s in array.status if 'localizer' in s.name]
        return [s.message for s in statuses if KeyValue(key='paused', value='True') in s.values]

    # On a busy machine it may report scans that were lost before.
    graph.until(lambda: 'paused' in said_of_a_paused_one(), 'it is told')
    assert 'tracking' not in said_of_a_paused_one()

    def some_scans():
        heard = doctor.number('localizer', 'scan: received')
        graph.until(
            lambda: doctor.number('localizer', 'scan: received') > heard + 10,
            'scans that are not taken',
        )

    some_scans()  # earlier poses may still be in transit
    poses.clear()
    some_scans()
    assert not poses
    for name in ('grid_mapper', 'topology_builder'):
        assert graph.call(Trigger, f'/{name}/reset', Trigger.Request()).success
    graph.until(
        lambda: not graphs[-1].node_ids and (len(maps[-1].data) == 0 or max(maps[-1].data) == -1),
        'emptiness',
    )
    assert graph.call(SetBool, '/localizer/pause', SetBool.Request(data=False)).success
    graph.until(lambda: poses, 'poses')
    graph.until(lambda: doctor.status('localizer').message == 'tracking', 'it tracks')
    graph.until(lambda: graphs[-1].node_ids, 'a graph')
    graph.until(lambda: maps and max(maps[-1].data) == 100, 'a map')


def test_a_deactivated_navigator_takes_no_goal(graph):
    graph.start('navigator', laser_pose='0,0,0')
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    assert graph.call(ChangeState, '/navigator/change_state', request).success
    client = ActionClient(graph.node, NavigateToPose, 'navigate_to_pose')
    assert not graph.send_goal(client, NavigateToPose.Goal()).accepted
