"""What pages ask for, done by the node."""

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.client import Client
from rclpy.task import Future
from std_msgs.msg import Bool

from thinmap_msgs.srv import (
    AddKeepOut,
    EraseArea,
    LoadMap,
    NameRegion,
    RemoveKeepOut,
    SaveMap,
)
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.nodes.steering.node_queue import NodeQueue
from thinmap_ros.nodes.steering.session_merge import SessionMerge
from thinmap_ros.nodes.steering.tasks import RobotTasks
from thinmap_ros.nodes.steering.teleoperation import Teleoperation, TopSpeeds
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.stop_topic import StopTopic
from thinmap_ros.web.picture import Picture
from thinmap_ros.web.requests import Request

_RESUME = 'explore/resume'
# Standard deviations of a pose that a person has drawn, as of RViz: 0.5 m, 15 degrees.
_DRAWN = np.diag([0.25, 0.25, 0.0685])
# What a robot that is held may be asked for.
_ALWAYS = (
    'cancel',
    'pause',
    'save',
    'initial_pose',
    'name_region',
    'sessions',
    'merge',
    'merge_save',
    'merge_drop',
    'keep_out',
    'remove_keep_out',
    'erase',
)


class Hold:
    """Whether the robot is held, and by which stop: a page ends the one that it shows.

    topic: where the pages and others stop the robot.
    """

    topic: StopTopic

    def __init__(self) -> None:
        self._is_own = False  # of a page
        self._is_others = False
        self._stops = 0

    @property
    def is_on(self) -> bool:
        """Whether the robot is held."""
        return self._is_own or self._is_others

    @property
    def last(self) -> int:
        """Number of the last stop, ended or not; 0: none."""
        return self._stops

    @property
    def number(self) -> int:
        """Number of the stop that holds the robot; 0: none."""
        return self._stops if self.is_on else 0

    def begin(self) -> None:
        """Hold the robot; one that is held, by a later stop."""
        self._stops += 1
        self._is_own = True

    def end(self, stop: int) -> None:
        """End the stop of a page. Raises InputError where there was a later one."""
        if self.is_on and stop != self._stops:
            raise InputError('release: the robot was stopped again')
        self._is_own = False

    def set_by_others(self, is_stopped: bool) -> None:
        """Whether another node stops the robot: no page ends that."""
        if is_stopped and not self.is_on:
            self._stops += 1
        self._is_others = is_stopped


class Steering:
    """Does what pages ask for, in the node's thread; stop and release at once, in the server's."""

    def __init__(
        self,
        node: ThinmapNode,
        picture: Picture,
        frames: tuple[str, str],
        top: TopSpeeds,
    ) -> None:
        """frames: of the map and of the robot."""
        self._node = node
        self._picture = picture
        self._map_frame, base_frame = frames
        self._held = Hold()
        self._drive = Teleoperation(node, base_frame, top)
        self._tasks = RobotTasks(node, self._map_frame, self.tell, self._show_goal)
        self._publishers = {
            _RESUME: node.create_publisher(Bool, _RESUME, qos.STREAM),
            'initialpose': node.create_publisher(
                PoseWithCovarianceStamped, 'initialpose', qos.STREAM
            ),
        }
        self._clients = {
            'save': node.create_client(SaveMap, 'save_map'),
            'load': node.create_client(LoadMap, 'load_map'),
            'name': node.create_client(NameRegion, 'name_region'),
            'keep out': node.create_client(AddKeepOut, 'add_keep_out'),
            'remove': node.create_client(RemoveKeepOut, 'remove_keep_out'),
            'erase': node.create_client(EraseArea, 'erase_area'),
        }
        self._merge = SessionMerge(node, picture.board, self.tell)
        self._works = self._works_by_action()
        self._later = NodeQueue(node, self.tell).put
        self._news = 0
        self._show_held()
        self._held.topic = StopTopic(node, self._stop_changed)
        self._held.topic.prepare()

    # In the server's thread.

    def requested(self, page: int, request: Request) -> None:
        """Take a request of a page. Raises InputError where it cannot be done now."""
        action = request.action
        if action == 'stop':
            self.stop()
            return
        if action == 'release':
            self._release(**request.values)
            return
        if self._held.is_on and action not in _ALWAYS:
            raise InputError(f'{action}: the robot is stopped: expected it to be released first')
        if action == 'drive' and self._drive.take(page):
            self._later(self._tasks.cancel_all)
        stops = self._held.last
        self._later(lambda: self._do(request, stops))

    def page_closed(self, page: int) -> None:
        """Stop the robot if this page drives it."""
        self._drive.let_go(page)

    def stop(self) -> None:
        """Stop the robot, and hold it: it is published, and no goal is followed."""
        self._held.begin()
        self._held.topic.publish(True)
        self._drive.halt()
        # Also where the release comes before the node has had the time to hold the robot.
        self._later(self._tasks.cancel_all)
        self._later(self._hold)

    def _release(self, stop: int) -> None:
        """End a stop, at once as it begins: a queued release could end a later one."""
        self._held.end(stop)
        self._held.topic.publish(False)
        self._later(self._released)

    # In the node's thread.

    def tell(self, news: str) -> None:
        """Show what has happened on all pages."""
        self._news += 1
        self._picture.board.put('news', [self._news, news])

    def tick(self) -> None:
        """Keep a robot that is held standing; called ten times a second."""
        self._merge.tick()
        if self._held.is_on:
            self._drive.keep_standing()
        else:
            self._drive.tidy()

    def close(self) -> None:
        """Stop the robot, if a page drives it, and a merge."""
        self._drive.close()
        self._merge.close()

    def _stop_changed(self, stop: StopTopic) -> None:
        """Follow what others say; a page's own stop and release hold at once."""
        was_on = self._held.is_on
        self._held.set_by_others(bool(stop.others))
        self._picture.board.put('held_by', stop.reason)
        if self._held.is_on != was_on:
            self._hold()

    def _released(self) -> None:
        """Release, too, what earlier processes of this node have left; not what others say."""
        self._held.topic.release(self._node.get_fully_qualified_name())
        if others := self._held.topic.others:
            self.tell(f'released; still stopped by {others}')
        self._hold()

    def _hold(self) -> None:
        self._tasks.hold(self._held.is_on)
        self._show_held()

    def _show_held(self) -> None:
        self._picture.board.put('held', self._held.number)

    def _show_goal(self, pose: Array | None) -> None:
        self._picture.board.put('goal', None if pose is None else pose.tolist())

    def _do(self, request: Request, stops: int) -> None:
        """Do a request; stops: number of the last stop when it was taken."""
        is_stopped = self._held.is_on or self._held.last != stops
        if is_stopped and request.action not in _ALWAYS:
            return  # stopped since it was taken, and perhaps released
        request.require_recent()  # it may have waited for the node
        self._works[request.action](**request.values)

    def _works_by_action(self) -> dict[str, Callable[..., None]]:
        """What does each action of a page, with the values of the request."""
        merge = self._merge
        tasks = self._tasks
        call = self._call
        area_of = messages.polygon_msg
        return {
            'goal': lambda x, y, theta: tasks.drive_to(np.array([x, y, theta])),
            'go_to_region': self._go_to_region,
            'home': self._go_home,
            'initial_pose': self._set_initial_pose,
            'explore': tasks.explore,
            'pause': self._pause,
            'resume': self._resume,
            'cancel': tasks.cancel_all,
            'drive': self._drive.drive,
            'save': lambda name: call('save', SaveMap.Request(path=name)),
            'load': lambda name: call('load', LoadMap.Request(path=name)),
            'name_region': lambda region, name: call(
                'name', NameRegion.Request(id=region, name=name)
            ),
            'sessions': merge.list_sessions,
            'merge': merge.begin,
            'merge_save': merge.save,
            'merge_drop': merge.drop,
            'keep_out': lambda corners, is_wall: call(
                'keep out', AddKeepOut.Request(corners=area_of(corners), is_wall=is_wall)
            ),
            'remove_keep_out': lambda area: call('remove', RemoveKeepOut.Request(id=area)),
            'erase': lambda corners: call('erase', EraseArea.Request(corners=area_of(corners))),
        }

    def _go_to_region(self, region: int) -> None:
        centre = self._picture.centres.get(region)
        if centre is None:
            raise InputError(f'region {region}: expected one of the map')
        self._tasks.drive_to(np.array([*centre, 0.0]))

    def _go_home(self) -> None:
        start = self._picture.path.start
        if start is None:
            raise InputError('home: no pose of the robot yet')
        self._tasks.drive_to(np.array([*start, 0.0]))

    def _set_initial_pose(self, x: float, y: float, theta: float) -> None:
        now_ns = int(self._node.get_clock().now().nanoseconds)
        pose = np.array([x, y, theta])
        self._publishers['initialpose'].publish(
            messages.pose_with_covariance_msg(pose, _DRAWN, self._map_frame, now_ns)
        )
        self.tell(f'initial pose {x:.2f}, {y:.2f}')

    def _pause(self) -> None:
        self._publishers[_RESUME].publish(Bool(data=False))
        self.tell('exploration paused')

    def _resume(self) -> None:
        self._tasks.require_paused()
        self._publishers[_RESUME].publish(Bool(data=True))
        self.tell('exploration continues')

    def _call(self, name: str, request: Any) -> None:
        client: Client = self._clients[name]
        if not client.service_is_ready():
            owner = 'topology_builder' if name == 'name' else 'grid_mapper'
            raise InputError(f'no service {client.srv_name}: expected {owner} to run')

        def answered(future: Future) -> None:
            answer = future.result()
            self.tell(f'{name}: {answer.message if answer else "no answer"}')

        client.call_async(request).add_done_callback(answered)
