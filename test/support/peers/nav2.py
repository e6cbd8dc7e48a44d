"""A substitute for Nav2's bt_navigator, by its documented rules: it drives the robot on map and TF.

A lifecycle node with the action navigate_to_pose. Unconfigured there is no server; an inactive one
rejects goals. A newer goal preempts the running one, which is aborted with an empty result. On
nav2_mode (std_msgs/String) it is told how to behave from the next goal on: drive, refuse, abort,
abort_once: abort one goal, then drive; stall: accept, and neither drive nor report; or mute: from
now on, do nothing and answer nothing, but stay on the graph.
"""

import math
import time
from contextlib import suppress

import rclpy
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import OccupancyGrid
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from thinmap_msgs.msg import TopologicalMap
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.planning.navigator import Navigator, NavigatorConfig
from thinmap_ros.core.planning.obstacles import StuckDetector
from thinmap_ros.core.planning.path_follower import PathFollowerConfig
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.laser_transform import LaserTransform
from thinmap_ros.ros.tf import TransformListener

PACED = 'paced'
FAILED = 9000
_POLL_S = 0.002


class BtNavigator(LifecycleNode):
    """Parameters: autostart; mode: at the start; paced_by: see `spin_once`; max_speed_m_s."""

    def __init__(self):
        super().__init__('bt_navigator')
        self._autostart = self.declare_parameter('autostart', True).value
        paced_by = self.declare_parameter('paced_by', '').value
        self._transforms = TransformListener(self)
        self._laser = LaserTransform(self)
        speed_m_s = self.declare_parameter(
            'max_speed_m_s', PathFollowerConfig().max_speed_m_s
        ).value
        controller = PathFollowerConfig(max_speed_m_s=speed_m_s)
        self._navigator = Navigator(NavigatorConfig(controller=controller))
        self._mode = self.declare_parameter('mode', 'drive').value
        self._patch = None
        self._is_active = False
        self._server = None
        self._handle = None
        self._results = {}
        self._scans = []
        self._last_ns = 0
        self._command = self.create_publisher(Twist, 'cmd_vel', 10)
        self._paced = self.create_publisher(
            TopologicalMap if paced_by else PoseWithCovarianceStamped, PACED, qos.STREAM
        )
        if paced_by:
            self.create_subscription(TopologicalMap, paced_by, self._on_pace, qos.STREAM)
        self._is_paced = bool(paced_by)
        self._paced_ns = -1
        self.create_subscription(OccupancyGrid, 'map', self._on_map, qos.LATCHED)
        self.create_subscription(LaserScan, 'scan', self._scans.append, qos.STREAM)
        self.create_subscription(String, 'nav2_mode', self._on_mode, qos.LATCHED)

    def start(self):
        if self._autostart:
            self.trigger_configure()
            self.trigger_activate()

    def on_configure(self, state):
        self._server = ActionServer(
            self,
            NavigateToPose,
            'navigate_to_pose',
            execute_callback=self._finished,
            goal_callback=self._on_request,
            cancel_callback=lambda handle: CancelResponse.ACCEPT,
            handle_accepted_callback=self._accept,
        )
        return super().on_configure(state)

    def on_activate(self, state):
        self._is_active = True
        return super().on_activate(state)

    def on_deactivate(self, state):
        self._is_active = False
        self._end(GoalStatus.STATUS_ABORTED, 0, '')
        return super().on_deactivate(state)

    # The action.

    def _on_request(self, request):
        takes = self._is_active and self._mode != 'refuse'
        return GoalResponse.ACCEPT if takes else GoalResponse.REJECT

    def _accept(self, handle):
        handle._update_state(rclpy_implementation.GoalEvent.EXECUTE)
        self._end(GoalStatus.STATUS_ABORTED, 0, '')
        self._handle = handle
        self._began_ns = self.get_clock().now().nanoseconds
        self._goal = messages.pose_from_msg(handle.request.pose.pose)
        self._navigator.set_goal(*self._goal.tolist())
        if self._mode in ('abort', 'abort_once'):
            self._mode = self._mode.replace('abort_once', 'drive')
            self._end(GoalStatus.STATUS_ABORTED, FAILED, 'failed to create a plan')

    def _end(self, status, code, text):
        """End the running goal, if there is one."""
        handle = self._handle
        self._handle = None
        if handle is None:
            return
        self._navigator.cancel()
        self._command.publish(Twist())
        result = NavigateToPose.Result(error_code=code, error_msg=text)
        self._results[bytes(handle.goal_id.uuid)] = (status, result)
        self._server.notify_execute(handle, None)

    def _finished(self, handle):
        status, result = self._results.pop(bytes(handle.goal_id.uuid))
        if status == GoalStatus.STATUS_SUCCEEDED:
            handle.succeed()
        elif status == GoalStatus.STATUS_CANCELED:
            handle.canceled()
        else:
            handle.abort()
        return result

    # Driving.

    def _on_mode(self, message):
        self._mode = message.data
        # A process that is halted would be gone from the graph after its lease of 20 s.
        while self._mode == 'mute':
            time.sleep(_POLL_S)

    def _on_map(self, message):
        self._patch = messages.grid_from_msg(message)

    def _on_pace(self, message):
        self._paced_ns = messages.stamp_ns(message.header.stamp)

    def spin_once(self):
        """Process the newest scan once its pose is known: a cycle of the controller.

        With a topic in paced_by, once there is a message of it for the scan, even without a pose.
        """
        if not self._scans:
            return
        message = self._scans[-1]
        stamp_ns = messages.stamp_ns(message.header.stamp)
        if self._is_paced and self._paced_ns < stamp_ns:
            return
        try:
            T_map_base = self._transforms.lookup('map', 'base_link', stamp_ns)
            scan = self._laser.to_scan('scan', message)
        except InputError:
            if not self._is_paced:
                return
        else:
            period_s = min(max((stamp_ns - self._last_ns) / 1e9, 0.0), 0.5)
            self._last_ns = stamp_ns
            self._control(T_map_base, scan, period_s)
        self._scans.clear()
        paced = TopologicalMap() if self._is_paced else PoseWithCovarianceStamped()
        paced.header.stamp = message.header.stamp
        self._paced.publish(paced)

    def _control(self, T_map_base, scan, period_s):
        if self._handle is None or self._patch is None or self._mode == 'stall':
            return
        if self._handle.is_cancel_requested:
            self._end(GoalStatus.STATUS_CANCELED, 0, '')
            return
        # Nav2's own check of progress takes 10 s: no robot of these tests waits so long.
        self._navigator._stuck_detector = StuckDetector()
        command = self._navigator.step(T_map_base, self._patch, scan, period_s)
        self._command.publish(messages.twist_msg(command.v, command.w))
        if command.state == 'reached':
            self._end(GoalStatus.STATUS_SUCCEEDED, 0, '')
        elif command.state == 'failed':
            self._end(GoalStatus.STATUS_ABORTED, FAILED, command.reason)
        else:
            self._report(T_map_base)

    def _report(self, T_map_base):
        now_ns = self.get_clock().now().nanoseconds
        feedback = NavigateToPose.Feedback()
        feedback.current_pose = messages.pose_stamped_msg(T_map_base, 'map', now_ns)
        feedback.navigation_time = messages.duration_msg((now_ns - self._began_ns) / 1e9)
        feedback.distance_remaining = math.dist(T_map_base[:2], self._goal[:2])
        self._handle.publish_feedback(feedback)


def main():
    rclpy.init()
    node = BtNavigator()
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.start()
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        while rclpy.ok():
            executor.spin_once(timeout_sec=_POLL_S)
            node.spin_once()


if __name__ == '__main__':
    main()
