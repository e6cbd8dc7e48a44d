"""What pages ask for, done by the node."""

import base64
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Lock
from time import monotonic, time
from typing import Any, NamedTuple

import numpy as np
from action_msgs.msg import GoalStatus, GoalStatusArray
from action_msgs.srv import CancelGoal
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav2_msgs.action import NavigateToPose
from rclpy.action import ActionClient
from rclpy.client import Client
from rclpy.task import Future as AnswerFuture
from std_msgs.msg import Bool, String

from thinmap_msgs.action import Explore
from thinmap_msgs.srv import AddKeepOut, EraseArea, LoadMap, NameRegion, RemoveKeepOut, SaveMap
from thinmap_ros.core.errors import InputError, one_line, one_line_reason
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.sessions import GRID, PARTS, copy_map
from thinmap_ros.nodes.parts.localization import GIVEN_COVARIANCE
from thinmap_ros.ros import messages, qos
from thinmap_ros.ros.lifecycle_node import Result, ThinmapNode, Worker
from thinmap_ros.ros.session_services import SaveDirectory
from thinmap_ros.ros.stop_topic import StopTopic
from thinmap_ros.ros.velocity import (
    CommandPublisher,
    CommandTimeout,
    CommandWatchdog,
    declare_stamped,
)
from thinmap_ros.web.pages import Board
from thinmap_ros.web.picture import Picture
from thinmap_ros.web.requests import Request, is_name


class NodeQueue:
    """Does in the node's thread, in turn, what other threads put."""

    def __init__(self, node: ThinmapNode, on_error: Callable[[str], None]) -> None:
        """on_error: receives the words of an InputError of some work."""
        self._on_error = on_error
        self._works: deque[Callable[[], None]] = deque()
        self._bell = node.create_guard_condition(self._work)

    def put(self, work: Callable[[], None]) -> None:
        """Have the node do something soon; from any thread."""
        self._works.append(work)
        self._bell.trigger()

    def _work(self) -> None:
        while self._works:
            try:
                self._works.popleft()()
            except InputError as error:
                self._on_error(str(error))


_MERGE_TIMEOUT_S = 600.0
_MAX_SESSIONS = 200
_MAX_PICTURE_BYTES = 4 << 20


class _Trial:
    """The program merge_sessions at work, in a folder of its own, which `drop` deletes."""

    def __init__(self, maps: list[str]) -> None:
        self._folder = TemporaryDirectory(prefix='thinmap-merge-')
        folder = Path(self._folder.name)
        self.stem = str(folder / 'merged')
        self._picture = folder / 'merged.png'
        self._log = folder / 'log'
        self._began_s = monotonic()
        program = ['nice', sys.executable, '-m', 'thinmap_ros.tools.merge_sessions', '--quiet']
        words = [*maps, '-o', self.stem, '--picture', str(self._picture)]
        with self._log.open('wb') as log:
            self._process = subprocess.Popen(
                [*program, *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )

    @property
    def code(self) -> int | None:
        """Exit code; None while it works."""
        return self._process.poll()

    @property
    def is_overdue(self) -> bool:
        """Whether it takes too long."""
        return self.code is None and monotonic() - self._began_s > _MERGE_TIMEOUT_S

    def lines(self) -> list[str]:
        """What it has said."""
        return self._log.read_text(errors='replace').splitlines()

    def picture(self) -> str:
        """The maps and the joint one, PNG in base64; '' where there is none, or a huge one."""
        try:
            content = self._picture.read_bytes()
        except FileNotFoundError:
            return ''
        return base64.b64encode(content).decode() if len(content) < _MAX_PICTURE_BYTES else ''

    def drop(self) -> None:
        """End the program, and delete what it has made."""
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()


class SessionMerge:
    """Shows what two sessions of save_directory make together; saves it where it is wanted.

    The program runs in a process of its own and what it makes is saved in a thread, so that the
    node does not wait. One merge at a time.
    """

    def __init__(self, node: ThinmapNode, board: Board, tell: Callable[[str], None]) -> None:
        """Declare save_directory; tell: shows what has happened."""
        self._board = board
        self._directory = SaveDirectory(node)
        self._trial: _Trial | None = None
        self._is_shown = False
        self._saver = Worker(node, 1.0, lambda error: tell(f'merge: {one_line_reason(error)}'))

    def list_sessions(self) -> None:
        """Show the names of the sessions in the directory."""
        files = sorted(self._directory.path.glob(f'*{GRID.ending}'))
        names = [file.name.removesuffix(GRID.ending) for file in files]
        self._board.put('sessions', [name for name in names if is_name(name)][:_MAX_SESSIONS])

    def begin(self, first: str, second: str) -> None:
        """Merge two sessions on trial. Raises InputError where that is not possible now."""
        if self._trial is not None:
            raise InputError('merge: expected the last one to be saved or dropped')
        if first == second:
            raise InputError(f'merge: {first}: expected two sessions')
        paths = [self._directory.resolve(name) for name in (first, second)]
        for name, path in zip((first, second), paths, strict=True):
            if not GRID.exists(path):
                raise InputError(f'merge: {name}: expected a session of {self._directory.path}')
        self._trial = _Trial(paths)
        self._is_shown = False
        self._show('working', [f'{first} and {second} are merged'])

    def save(self, name: str) -> None:
        """Save the joint map. Raises InputError where there is none, or the name is taken."""
        trial = self._trial
        if trial is None or trial.code != 0 or self._saver.is_busy:
            raise InputError('merge: expected a joint map that is shown')
        path = self._directory.resolve_for_saving(name, GRID)
        if any(part.exists(path) for part in PARTS):
            raise InputError(f'merge: {name}: exists: expected a new name')
        self._saver.begin(lambda: self._copied(trial.stem, path))

    def drop(self) -> None:
        """Forget the joint map, or the work on it."""
        if self._saver.is_busy:
            raise InputError('merge: is being saved')
        self._forget('', [])

    def tick(self) -> None:
        """Show what is done; called ten times a second."""
        if self._trial is not None and not self._is_shown:
            self._watch(self._trial)

    def close(self) -> None:
        """End the work."""
        self._saver.close()
        if self._trial is not None:
            self._trial.drop()

    def _watch(self, trial: _Trial) -> None:
        if trial.is_overdue:
            self._forget('failed', [f'not merged within {_MERGE_TIMEOUT_S:.0f} s'])
        elif trial.code == 0:
            # Lines on the maps, without those on the files that are still to be saved.
            own = f'{self._directory.path}/'
            words = [line for line in trial.lines() if line.startswith(own)]
            self._show('shown', words, trial.picture())
            self._is_shown = True
        elif trial.code is not None:
            self._forget('failed', trial.lines()[-1:] or [f'ended with {trial.code}'])

    def _copied(self, stem: str, path: str) -> Result:
        """Copy the joint map, in the thread of the worker."""
        saved = copy_map(stem, path)
        return lambda: self._saved('; '.join(saved))

    def _saved(self, said: str) -> None:
        self._forget('saved', [said])
        self.list_sessions()

    def _forget(self, state: str, words: list[str]) -> None:
        if self._trial is not None:
            self._trial.drop()
        self._trial = None
        self._show(state, words)

    def _show(self, state: str, words: list[str], picture: str = '') -> None:
        own = f'{self._directory.path}/'
        shown = [one_line(line.replace(own, '')) for line in words]
        self._board.put('merge', {'state': state, 'words': shown, 'picture': picture})


NAVIGATE = 'navigate_to_pose'
EXPLORE = 'explore'
_PAUSED = 'exploration_paused'  # as explore_lite has it, on explore/status
_DRIVING = (NAVIGATE, 'navigate_through_poses')
_GOALS = ('goal', 'go_to_region', 'home')  # requests of a page that drive there
_ACTIVE = (GoalStatus.STATUS_ACCEPTED, GoalStatus.STATUS_EXECUTING)
_OUTCOMES = {
    GoalStatus.STATUS_SUCCEEDED: 'done',
    GoalStatus.STATUS_CANCELED: 'cancelled',
    GoalStatus.STATUS_ABORTED: 'failed',
}


class RobotTasks:
    """Sends goals of navigate_to_pose and explore; cancels all of the robot, of all clients."""

    def __init__(
        self,
        node: ThinmapNode,
        map_frame: str,
        on_news: Callable[[str], None],
        on_goal: Callable[[Array | None], None],
        on_idle: Callable[[], None],
    ) -> None:
        """on_news: receives how a goal ends, in words; on_goal: the place (3,) of it, or None.

        on_idle: called when the robot no longer drives to a goal of anybody.
        """
        self._node = node
        self._map_frame = map_frame
        self._on_news = on_news
        self._on_goal = on_goal
        self._on_idle = on_idle
        self._navigate = ActionClient(node, NavigateToPose, NAVIGATE)
        self._explore = ActionClient(node, Explore, EXPLORE)
        self._cancels = {
            name: node.create_client(CancelGoal, f'{name}/_action/cancel_goal')
            for name in (EXPLORE, *_DRIVING)
        }
        self._is_held = False
        self._cancels_asked = 0
        self._active = {name: False for name in self._cancels}
        self._word = ''
        node.create_subscription(String, 'explore/status', self._on_word, qos.LATCHED)
        self._newest: AnswerFuture | None = None
        for name in self._cancels:
            node.create_subscription(
                GoalStatusArray,
                f'{name}/_action/status',
                lambda message, name=name: self._on_status(name, message),
                qos.LATCHED,
            )

    def hold(self, is_held: bool) -> None:
        """While the robot is held, each goal of anybody is cancelled."""
        self._is_held = is_held
        if is_held:
            self.cancel_all()

    def cancel_all(self) -> None:
        """Cancel all goals of all clients, and those of the page that are on their way."""
        self._cancels_asked += 1
        for name in self._cancels:
            self._cancel(name)

    def refusal(self, action: str) -> str:
        """Why an action cannot be done now; '' where it can."""
        if action in _GOALS and not self._navigate.server_is_ready():
            return f'no server of {NAVIGATE}: expected navigator to run'
        if action == EXPLORE and not self._explore.server_is_ready():
            return f'no server of {EXPLORE}: expected explorer to run'
        if action == 'resume' and not self._is_paused:
            return 'no exploration is paused: expected one, or Explore to start'
        return ''

    def pointlessness(self, action: str) -> str:
        """Why an action would change nothing, by what is known; it is done all the same."""
        if action == 'pause' and (self._is_paused or not self._active[EXPLORE]):
            return 'nothing is explored'
        if action == 'cancel' and not any(self._active.values()):
            return 'there is no goal'
        return ''

    @property
    def _is_paused(self) -> bool:
        """Whether an exploration waits to be continued."""
        return self._active[EXPLORE] and self._word == _PAUSED

    def drive_to(self, pose: Array) -> None:
        """Send a goal (3,), map frame."""
        target = messages.pose_stamped_msg(pose, self._map_frame, self._node.now_ns)
        self._on_goal(pose)
        self._send(self._navigate, NavigateToPose.Goal(pose=target), 'goal')

    def explore(self, area: list[tuple[float, float]], return_home: bool) -> None:
        """Start an exploration inside a polygon, m."""
        goal = Explore.Goal(area=messages.polygon_msg(area), return_home=return_home)
        self._send(self._explore, goal, 'exploration')

    def _send(self, client: ActionClient, goal: Any, what: str) -> None:
        sent = client.send_goal_async(goal)
        if what == 'goal':
            self._newest = sent
        cancels = self._cancels_asked
        sent.add_done_callback(lambda future: self._on_answer(future, what, cancels))

    def _on_answer(self, sent: AnswerFuture, what: str, cancels: int) -> None:
        handle = sent.result()
        if handle is None or not handle.accepted:
            self._end(sent, f'{what} rejected')
            return
        self._on_news(f'{what} accepted')
        if cancels != self._cancels_asked:
            handle.cancel_goal_async()  # all goals were cancelled before this one was known
        handle.get_result_async().add_done_callback(
            lambda future: self._on_result(sent, future.result(), what)
        )

    def _on_result(self, sent: AnswerFuture, answer: Any, what: str) -> None:
        if what == 'goal' and sent is not self._newest:
            return  # the page itself has sent a newer one
        outcome = _OUTCOMES.get(answer.status, 'ended')
        result = answer.result
        reason = result.error_msg if what == 'goal' else result.status.reason
        is_said = reason in ('', outcome)
        self._end(sent, f'{what} {outcome}' if is_said else f'{what} {outcome}: {reason}')

    def _end(self, sent: AnswerFuture, news: str) -> None:
        if sent is self._newest:
            self._on_goal(None)
        self._on_news(news)

    def _cancel(self, name: str) -> None:
        """Cancel all goals of an action: as its service has it, by an id and a time of zero."""
        if self._cancels[name].service_is_ready():
            self._cancels[name].call_async(CancelGoal.Request())

    def _on_status(self, name: str, message: GoalStatusArray) -> None:
        has_driven = self._is_driving
        self._active[name] = any(status.status in _ACTIVE for status in message.status_list)
        if has_driven and not self._is_driving:
            self._on_idle()
        if self._is_held and self._active[name]:
            self._cancel(name)

    @property
    def _is_driving(self) -> bool:
        return any(self._active[name] for name in _DRIVING)

    def _on_word(self, message: String) -> None:
        self._word = message.data


# With the period of the watchdog, 0.1 s, the robot is stopped 0.3 s after the last request.
_HOLD_S = 0.2
# After the last command the publisher stays as long as a stop may need to be received.
_LINGER_S = 2.0


class TopSpeeds(NamedTuple):
    """Velocity of a joystick that is pushed to its end: ahead m/s, turn rad/s."""

    ahead: float
    turn: float


class Teleoperation:
    """Publishes the velocity that one page at a time asks for, again and again.

    The publisher exists while somebody drives, or the robot is held: another one of cmd_vel is
    reported by the navigator.
    """

    def __init__(self, node: ThinmapNode, base_frame: str, top: TopSpeeds) -> None:
        self._top = top
        self._output = CommandPublisher(node, base_frame, declare_stamped(node))
        self._lock = Lock()
        self._sent_s = 0.0
        self._holder: int | None = None
        # By the clock of the machine, whatever that of the node.
        timeout = CommandTimeout(is_simulated=False, limit_s=_HOLD_S)
        self._watchdog = CommandWatchdog(self._send, lambda seconds: None, timeout)

    def take(self, page: int) -> bool:
        """Let a page drive; returns whether it begins to. Raises InputError where another does."""
        with self._lock:
            is_free = self._holder is None or monotonic() - self._sent_s > _LINGER_S
            if not is_free and self._holder != page:
                raise InputError('drive: another page drives: expected it to let go')
            self._holder = page
            self._sent_s = monotonic()
        return is_free

    def let_go(self, page: int) -> None:
        """Stop the robot if this page drives: it is gone."""
        if self._holder == page:
            self.halt()
            self._holder = None

    def drive(self, ahead: float, left: float) -> None:
        """Publish a velocity, as shares of the top speeds; it holds for 0.3 s."""
        self._output.open()
        self._watchdog.send(ahead * self._top.ahead, left * self._top.turn)

    def halt(self) -> None:
        """Stop the robot, if somebody drives; from any thread."""
        self._watchdog.send(0.0, 0.0)

    def keep_standing(self) -> None:
        """Stop the robot, whatever drives it."""
        self._output.hold(True)
        self._watchdog.send(0.0, 0.0)

    def tidy(self) -> None:
        """Destroy the publisher when nobody has driven for a while."""
        self._output.hold(False)
        if monotonic() - self._sent_s > _LINGER_S:
            self._output.close()

    def close(self) -> None:
        """Stop the robot, if somebody drives, and wait until that is received."""
        self._watchdog.close()
        self.halt()
        self._output.wait_until_received()

    def _send(self, v: float, w: float) -> None:
        if self._output.send(v, w):
            self._sent_s = monotonic()


_RESUME = 'explore/resume'

_HELD = 'the robot is stopped: expected it to be released first'
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

# Type and name of the service that does an action, and the node that has it.
_SERVICES: dict[str, tuple[type, str, str]] = {
    'save': (SaveMap, 'save_map', 'grid_mapper'),
    'load': (LoadMap, 'load_map', 'grid_mapper'),
    'name_region': (NameRegion, 'name_region', 'topology_builder'),
    'keep_out': (AddKeepOut, 'add_keep_out', 'grid_mapper'),
    'remove_keep_out': (RemoveKeepOut, 'remove_keep_out', 'grid_mapper'),
    'erase': (EraseArea, 'erase_area', 'grid_mapper'),
}
_MAX_NEWS = 50


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
        self._tasks = RobotTasks(node, self._map_frame, self.tell, self._show_goal, picture.no_plan)
        self._publishers = {
            _RESUME: node.create_publisher(Bool, _RESUME, qos.STREAM),
            'initialpose': node.create_publisher(
                PoseWithCovarianceStamped, 'initialpose', qos.STREAM
            ),
        }
        self._clients: dict[str, Client] = {
            action: node.create_client(kind, name) for action, (kind, name, _) in _SERVICES.items()
        }
        self._merge = SessionMerge(node, picture.board, self.tell)
        self._works = self._works_by_action()
        self._later = NodeQueue(node, self.tell).put
        self._news: deque[tuple[float, str]] = deque(maxlen=_MAX_NEWS)
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
            raise InputError(f'{action}: {_HELD}')
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
        """Show what has happened, and when, on all pages."""
        self._news.append((round(time(), 1), news))
        self._picture.board.put('news', list(self._news))

    def tick(self) -> None:
        """Keep a robot that is held standing; called ten times a second."""
        self._merge.tick()
        if self._held.is_on:
            self._drive.keep_standing()
        else:
            self._drive.tidy()

    def show_refusals(self) -> None:
        """Show what would be refused now, and why; called about once a second."""
        reasons = {action: self._refusal(action) for action in self._works}
        for action in ('pause', 'cancel'):
            reasons[action] = reasons[action] or self._tasks.pointlessness(action)
        self._picture.board.put('refusals', {k: reason for k, reason in reasons.items() if reason})

    def _refusal(self, action: str) -> str:
        """Why an action cannot be done now; '' where it can."""
        if self._held.is_on and action not in _ALWAYS:
            return _HELD
        if action in _SERVICES and not self._clients[action].service_is_ready():
            return f'no service {_SERVICES[action][1]}: expected {_SERVICES[action][2]} to run'
        if action == 'home' and self._picture.path.start is None:
            return 'no pose of the robot yet'
        return self._tasks.refusal(action)

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
        if reason := self._refusal(request.action):
            raise InputError(f'{request.action}: {reason}')
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
            'pause': lambda: self._resume(False),
            'resume': lambda: self._resume(True),
            'cancel': tasks.cancel_all,
            'drive': self._drive.drive,
            'save': lambda name: call('save', SaveMap.Request(path=name)),
            'load': lambda name: call('load', LoadMap.Request(path=name)),
            'name_region': lambda region, name: call(
                'name_region', NameRegion.Request(id=region, name=name)
            ),
            'sessions': merge.list_sessions,
            'merge': merge.begin,
            'merge_save': merge.save,
            'merge_drop': merge.drop,
            'keep_out': lambda corners, is_wall: call(
                'keep_out', AddKeepOut.Request(corners=area_of(corners), is_wall=is_wall)
            ),
            'remove_keep_out': lambda area: call('remove_keep_out', RemoveKeepOut.Request(id=area)),
            'erase': lambda corners: call('erase', EraseArea.Request(corners=area_of(corners))),
        }

    def _go_to_region(self, region: int) -> None:
        centre = self._picture.centres.get(region)
        if centre is None:
            raise InputError(f'region {region}: expected one of the map')
        self._tasks.drive_to(np.array([*centre, 0.0]))

    def _go_home(self) -> None:
        start = self._picture.path.start
        assert start is not None  # as `_refusal` says
        self._tasks.drive_to(np.array([*start, 0.0]))

    def _set_initial_pose(self, x: float, y: float, theta: float) -> None:
        pose = np.array([x, y, theta])
        self._publishers['initialpose'].publish(
            messages.pose_with_covariance_msg(
                pose, GIVEN_COVARIANCE, self._map_frame, self._node.now_ns
            )
        )
        self.tell(f'initial pose {x:.2f}, {y:.2f}')

    def _resume(self, is_wanted: bool) -> None:
        self._publishers[_RESUME].publish(Bool(data=is_wanted))
        self.tell(f'exploration {"continues" if is_wanted else "paused"}')

    def _call(self, action: str, request: Any) -> None:
        def answered(future: AnswerFuture) -> None:
            answer = future.result()
            self.tell(f'{action.replace("_", " ")}: {answer.message if answer else "no answer"}')
            if action == 'save':
                self._merge.list_sessions()

        self._clients[action].call_async(request).add_done_callback(answered)
