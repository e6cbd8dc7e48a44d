"""The small `ros2` for machines without ROS, each verb on a live graph.

Lists depend on discovery by the middleware: they are repeated until an entry is found.
"""

import signal
import subprocess
import sys
import time

import pytest
import yaml
from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from lifecycle_msgs.srv import GetState
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.duration import Duration
from std_msgs.msg import String
from support.live_graph import Graph
from support.ros2 import ROS2, output, run, start
from support.timeouts import PATIENCE_S

from thinmap_ros.evaluation.ros_domains import free_domain
from thinmap_ros.ros import qos

# The nodes that all share count for the test that ends them. They take CPU time for as long as they
# run: tests that do not use them are in a file of their own.
pytestmark = [pytest.mark.live, pytest.mark.cpu_budget(25.0, 'one of them ends the nodes')]
WAIT = ('--spin-time', str(PATIENCE_S))
NODES = ('explorer', 'grid_mapper', 'localizer', 'navigator', 'sim')


@pytest.fixture(scope='module')
def robot(tmp_path_factory):
    """Running nodes of a simulated robot; tests do not change them."""
    with pytest.MonkeyPatch.context() as patch, free_domain() as domain:
        folder = tmp_path_factory.mktemp('robot')
        patch.setenv('THINMAP_STATE_DIR', str(folder / 'state'))
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        graph = Graph(domain, folder)
        maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
        graph.start(
            'thinmap',
            arguments=(*NODES, 'topology_builder'),
            use_sim_time=True,
            start='2.0,2.0,0.0',
            initial_x_m=2.0,
            initial_y_m=2.0,
            # Each worker has one, for as long as its tests take.
            real_time_factor=0.4,
        )
        graph.until(lambda: maps, 'a map')
        yield graph
        graph.close()


def listed(wanted, *words):
    """Lines of a list, once the wanted ones are among them."""
    end = time.monotonic() + PATIENCE_S
    while True:
        lines = output(*words).splitlines()
        if set(wanted) <= set(lines):
            return lines
        assert time.monotonic() < end, (wanted, lines)


def test_lists_show_what_there_is(robot):
    topics = listed(['/scan [sensor_msgs/msg/LaserScan]'], 'topic', 'list', '-t')
    assert not [line for line in topics if '/_action/' in line]
    listed(['/explore/_action/status'], 'topic', 'list', '--include-hidden-topics')


def test_a_message_is_echoed_as_yaml(robot):
    text = output('topic', 'echo', '--once', '/odom', *WAIT)
    assert text.endswith('\n---\n')
    message = yaml.safe_load(text.removesuffix('---\n'))
    assert list(message) == ['header', 'child_frame_id', 'pose', 'twist']
    assert message['header']['frame_id'] == 'odom'
    assert len(message['pose']['covariance']) == 36
    scan = yaml.safe_load(output('topic', 'echo', '--once', '/scan', *WAIT)[:-4])
    assert len(scan['ranges']) == 129 and scan['ranges'][-1] == '...'
    flow = output('topic', 'echo', '--once', '--no-arr', '--flow-style', '/scan', *WAIT)
    assert "ranges: '<sequence type: float, length: 181>'" in flow and flow.count('\n') == 2
    part = output('topic', 'echo', '--once', '--field', 'header.frame_id', '/scan', *WAIT)
    assert part == 'laser\n---\n'
    done = run('topic', 'echo', '--once', '--field', 'pose.nix', '/odom', *WAIT)
    assert done.returncode == 1
    assert done.stderr == "Invalid field 'pose.nix': no 'nix', there is pose, covariance\n"


def test_latched_messages_are_received_later(robot):
    text = output('topic', 'echo', '--once', '--no-arr', '/tf_static', *WAIT)
    assert 'transforms: ' in text
    kept = output('topic', 'echo', '--once', '--field', 'info.resolution', '/map', *WAIT)
    assert kept == '0.05000000074505806\n---\n'


def test_a_topic_may_come_later_and_of_both_kinds(robot):
    listener = start('topic', 'echo', '--once', '--field', 'data', '/later', *WAIT)
    publisher = robot.node.create_publisher(String, '/later', qos.SENSOR)

    def heard():
        publisher.publish(String(data='at last'))
        return listener.poll() is not None

    robot.until(heard, 'echo of a topic that came later')
    assert listener.communicate()[0] == 'at last\n---\n'
    robot.node.destroy_publisher(publisher)


def test_a_closed_pipe_and_ctrl_c_end_it_quietly(robot):
    command = f'{sys.executable} {ROS2} topic echo /odom --spin-time {PATIENCE_S} | head -n 1'
    done = subprocess.run(
        ['bash', '-c', command], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert (done.stdout, done.stderr) == ('header:\n', '')
    rate = start('topic', 'hz', '/scan', *WAIT)
    line = rate.stdout.readline()
    assert line.startswith('average rate: ')
    assert rate.stdout.readline().startswith('\tmin: ')
    rate.send_signal(signal.SIGINT)
    assert rate.communicate(timeout=PATIENCE_S)[1] == ''
    assert rate.returncode == signal.SIGINT


def test_a_service_is_called(robot):
    said = output('service', 'call', '/save_map', 'thinmap_msgs/srv/SaveMap', '{path: maps/room}')
    request = "thinmap_msgs.srv.SaveMap_Request(path='maps/room', overwrite=False)"
    assert f'requester: making request: {request}' in said
    assert '\nresponse:\nthinmap_msgs.srv.SaveMap_Response(success=True' in said
    assert (robot.folder / 'maps' / 'room.yaml').exists()
    said = output('service', 'call', '/localizer/pause', 'std_srvs/srv/SetBool')
    assert 'SetBool_Request(data=False)' in said and 'success=True' in said


def test_parameters_are_read_and_set(robot):
    before = output(
        'param', 'get', '--hide-type', 'navigator', 'controller.max_speed_m_s', *WAIT
    ).strip()
    value = ('/navigator', 'controller.max_speed_m_s')
    assert output('param', 'set', *value, '0.15', *WAIT) == 'Set parameter successful\n'
    assert output('param', 'get', *value, *WAIT) == 'Double value is: 0.15\n'
    refused = run('param', 'set', *value, '-0.2', *WAIT)
    assert refused.returncode == 0 and not refused.stdout
    assert refused.stderr.startswith('Setting parameter failed: ')
    assert 'max_speed_m_s' in refused.stderr and len(refused.stderr.splitlines()) == 1
    assert output('param', 'get', *value, *WAIT) == 'Double value is: 0.15\n'
    output('param', 'set', *value, before, *WAIT)
    unknown = run('param', 'get', '/navigator', 'nix', *WAIT)
    assert unknown.returncode == 1
    assert unknown.stderr == "Parameter not set: 'nix' of /navigator\n"


def test_a_node_makes_transitions(robot):
    node = '/grid_mapper'

    def state():
        name = f'{node}/get_state'
        return robot.call(GetState, name, GetState.Request()).current_state.label

    assert state() == 'active'
    done = 'Transitioning successful\n'
    assert output('lifecycle', 'set', node, 'deactivate', *WAIT) == done
    assert state() == 'inactive'
    assert output('lifecycle', 'set', node, 'activate', *WAIT) == done
    assert state() == 'active'
    wrong = run('lifecycle', 'set', node, 'fly', *WAIT)
    assert wrong.returncode == 1 and not wrong.stdout
    assert wrong.stderr.startswith("Unknown transition requested: 'fly', available ones are: ")


GO = '{pose: {header: {frame_id: map}, pose: {position: {x: 2.6, y: 2.0}, orientation: {w: 1}}}}'


def test_a_goal_is_followed_to_its_end(robot):
    kind = 'nav2_msgs/action/NavigateToPose'
    said = output('action', 'send_goal', '--feedback', '/navigate_to_pose', kind, GO)
    wanted = [
        'Waiting for an action server to become available...\n',
        'Sending goal:\n     pose:\n  header:\n',
        'Goal accepted with ID: ',
        'Feedback:\n    ',
        'Result:\n    error_code: 0\n',
        'Goal finished with status: SUCCEEDED\n',
    ]
    are_in_order(said, wanted)


def are_in_order(said, texts):
    places = [said.find(text) for text in texts]
    assert -1 not in places and places == sorted(places), said


def serve_feedback_first(node, name):
    """Serve an action by hand: a goal's feedback has arrived before its acceptance is sent."""
    parts = NavigateToPose.Impl
    told = node.create_publisher(parts.FeedbackMessage, f'{name}/_action/feedback', 10)
    node.create_publisher(GoalStatusArray, f'{name}/_action/status', qos.LATCHED)

    def accept(request, response):
        wait_for(lambda: told.get_subscription_count() > 0, 'the client hears feedback')
        told.publish(parts.FeedbackMessage(goal_id=request.goal_id))
        assert told.wait_for_all_acked(Duration(seconds=PATIENCE_S))
        response.accepted = True
        return response

    def end(_, response):
        response.status = GoalStatus.STATUS_SUCCEEDED
        return response

    node.create_service(parts.SendGoalService, f'{name}/_action/send_goal', accept)
    node.create_service(parts.GetResultService, f'{name}/_action/get_result', end)
    node.create_service(CancelGoal, f'{name}/_action/cancel_goal', lambda _, response: response)


def wait_for(condition, what):
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, f'never came: {what}'
        time.sleep(0.01)


def test_the_acceptance_of_a_goal_is_shown_before_its_feedback(graph):
    serve_feedback_first(graph.node, '/hasty')
    kind = 'nav2_msgs/action/NavigateToPose'
    goal = start('action', 'send_goal', '--feedback', '/hasty', kind, GO)
    graph.until(lambda: goal.poll() is not None, 'the goal ends')
    said, complaints = goal.communicate()
    assert not complaints and said.count('Feedback:') == 1
    are_in_order(
        said, ['Goal accepted with ID: ', 'Feedback:\n    ', 'Goal finished with status: ']
    )


def test_ctrl_c_cancels_the_goal(robot):
    statuses = robot.heard('/explore/_action/status', GoalStatusArray, qos.LATCHED)
    goal = start('action', 'send_goal', '-f', '/explore', 'thinmap_msgs/action/Explore', '{}')
    while 'Feedback:' not in goal.stdout.readline():
        assert goal.poll() is None, goal.communicate()
    goal.send_signal(signal.SIGINT)
    stdout, stderr = goal.communicate(timeout=PATIENCE_S)
    assert stdout.endswith('Canceling goal...\nGoal canceled.\n')
    assert stderr == '' and goal.returncode == signal.SIGINT

    def ended():
        lists = [message.status_list for message in statuses if message.status_list]
        return lists and lists[-1][-1].status == GoalStatus.STATUS_CANCELED

    robot.until(ended, 'goal is canceled')
