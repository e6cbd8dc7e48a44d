"""All nodes in one process, and two robots on one graph.

Each node behaves as in its own process.
"""

import signal

import numpy as np
import psutil
import pytest
from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from support.forks import forked
from support.timeouts import PATIENCE_S
from tf2_msgs.msg import TFMessage

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.logs import decode
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
FIVE = ('localizer', 'grid_mapper', 'topology_builder', 'navigator', 'explorer')


def free_at(map_message, x, y):
    patch = messages.grid_from_msg(map_message)
    row, col = patch.frame.cells_of(np.array([[x, y]]))[0]
    return bool(patch.contains(np.array([[x, y]]))[0]) and bool(patch.free[row, col])


def test_one_process_locates_maps_and_drives(graph):
    maps = graph.heard('map', OccupancyGrid, qos.LATCHED)
    graphs = graph.heard('topology', TopologicalMap, qos.LATCHED)
    truth = graph.heard('ground_truth', PoseStamped)
    health = graph.heard('/diagnostics', DiagnosticArray)
    start = {'initial_x_m': 2.0, 'initial_y_m': 2.0, 'use_sim_time': True}
    graph.forks = False  # the memory is that of a process as users start it
    process = graph.start('thinmap', **start)
    # Paced: otherwise the result could arrive before the true poses of the path.
    graph.start(
        'sim',
        remap=graph.paced(),
        start='2.0,2.0,0.0',
        real_time_factor=8.0,
        lockstep='local_topology',
        wait_for_subscribers=3,
    )
    graph.until(
        lambda: maps and free_at(maps[-1], 3.0, 2.0) and graphs and graphs[-1].node_ids,
        'a map and a graph',
    )
    goal = NavigateToPose.Goal()
    goal.pose.header.frame_id = 'map'
    goal.pose.pose.position.x = 3.0
    goal.pose.pose.position.y = 2.0
    goal.pose.pose.orientation.w = 1.0
    ended = graph.act(NavigateToPose, 'navigate_to_pose', goal)
    assert ended.status == GoalStatus.STATUS_SUCCEEDED, ended.result
    graph.until(lambda: truth, 'where it is')
    assert np.hypot(truth[-1].pose.position.x - 3.0, truth[-1].pose.position.y - 2.0) < 0.3

    def well():
        return {
            s.name.split(':')[0]
            for array in health
            for s in array.status
            if s.level == DiagnosticStatus.OK
        }

    graph.until(lambda: well() >= set(FIVE), 'each says that it is well')
    # The kernels' compiler and the libraries are loaded once, not five times.
    assert psutil.Process(process.pid).memory_info().rss < 400e6
    assert graph.stop('thinmap', signal.SIGTERM) == 0, graph.log('thinmap')


ROBOT = ('/tf:=tf', '/tf_static:=tf_static', '/clock:=clock')


def start_robot(graph, name, start, seed):
    """A robot with its simulation in a namespace."""
    x, y, _ = start.split(',')
    graph.start(
        'thinmap',
        label=name,
        remap=(f'__ns:=/{name}', *ROBOT),
        start=start,
        seed=seed,
        use_sim_time=True,
        initial_x_m=float(x),
        initial_y_m=float(y),
        initial_yaw_rad=0.0,
        wait_for_subscribers=1,
        real_time_factor=2.0,
        arguments=('sim', 'localizer', 'grid_mapper', 'topology_builder'),
    )


def test_two_robots_in_namespaces_keep_to_themselves(graph):
    starts = {'robot1': '2.0,2.0,0.0', 'robot2': '8.0,3.0,0.0'}
    heard = {name: graph.heard(f'/{name}/pose', PoseWithCovarianceStamped) for name in starts}
    frames = {name: graph.heard(f'/{name}/tf', TFMessage) for name in starts}
    nobody = graph.heard('/tf', TFMessage)
    health = graph.heard('/diagnostics', DiagnosticArray)
    for seed, (name, start) in enumerate(starts.items()):
        start_robot(graph, name, start, seed)
    commands = graph.node.create_publisher(Twist, '/robot1/cmd_vel', 10)
    graph.until(lambda: all(len(poses) > 10 for poses in heard.values()), 'poses of both')

    def drives():
        commands.publish(messages.twist_msg(0.1, 0.3))
        last = heard['robot1'][-1].pose.pose
        return abs(decode.yaw(last.orientation)) > 0.5

    graph.until(drives, 'the first one turns')
    last = {name: messages.pose_from_msg(poses[-1].pose.pose) for name, poses in heard.items()}
    assert np.abs(last['robot2'] - [8.0, 3.0, 0.0]).max() < 0.1
    assert np.hypot(last['robot1'][0] - 2.0, last['robot1'][1] - 2.0) < 1.0
    assert all(frames.values()) and not nobody
    names = {'robot1/localizer: thinmap', 'robot2/localizer: thinmap'}
    graph.until(
        lambda: names <= {s.name for array in health for s in array.status},
        'both tell how they are',
    )
    assert not [s.message for array in health for s in array.status if 'nodes publish' in s.message]
    for name in starts:
        assert graph.stop(name) == 0, graph.log(name)


def run(*arguments):
    return forked.run('thinmap_ros.nodes.thinmap', *arguments, timeout=PATIENCE_S)


def test_what_cannot_be_run_is_reported_in_one_line(ros_domain):
    assert 'usage: thinmap' in run('--help').stdout
    done = run('localizer', 'pilot')
    assert done.returncode == 2 and done.stderr.startswith("error: 'pilot': no such node")
    done = run('loclizer')
    assert done.returncode == 2 and done.stderr.count('\n') == 1
    assert "'loclizer': no such node (did you mean localizer?)" in done.stderr
    assert 'a name twice: expected each node once' in run('localizer', 'localizer').stderr
    strict = ('-p', 'gaet:=1.0', '-p', 'strict_parameters:=true')
    done = run('localizer', 'grid_mapper', '--ros-args', *strict)
    unknown = 'nodes localizer, grid_mapper have no parameter gaet'
    assert done.returncode == 2 and unknown in done.stderr
    assert len(done.stderr.splitlines()) == 1
    strict = ('-p', 'association.gate:=4.0', '-p', 'strict_parameters:=true')
    done = run('localizer', 'grid_mapper', '--ros-args', *strict)
    meant = 'have no parameter association.gate (only with slam: ekf_ti or ekf_full)'
    assert done.returncode == 2 and meant in done.stderr
    wrong = ('-p', 'slam:=ekf_ti', '-p', 'association.gate:=-1.0')
    done = run('localizer', 'grid_mapper', '--ros-args', *wrong)
    assert (
        done.returncode == 2
        and 'association.gate' in done.stderr
        and 'Traceback' not in done.stderr
    )
