"""A live graph under random faults, one after the other, each judged by itself."""

import signal
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.faults.causes import cause_of
from benchmarks.faults.judge import Counts, Passed, PoseWatch, Record, uncounted
from benchmarks.faults.kinds import Fault
from benchmarks.faults.observer import Observer
from benchmarks.goal_client import GoalClient
from benchmarks.node_processes import NODES, Processes
from thinmap_ros.core.errors import ThinmapError
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.drives import random_start
from thinmap_ros.sim.world import World

SPEED_M_S = 0.5
DRIVES_M_S = 0.1
_EXPLORATIONS = 3
_UNDISTURBED = 2  # attempts to drive without a violation before a fault
_START_S = 300.0
_STANDSTILL_S = 120.0  # of the machine, without a new simulated time
_SETTLE_S = 6.0
_RECOVERY_S = 60.0
_MOVING_S = 60.0
_CENSUS_S = 60.0
_REALIGN_S = 2.0
_STOP_S = 2.5
_ANSWER_S = 30.0
_SETTLED = 2  # diagnostics of each node with the same counts
_TOPICS = ('scan', 'odom')


@dataclass(frozen=True)
class Setting:
    """The world (file and obstacles), faults until a time, s (simulated), folder for logs.

    rate: simulated seconds a second at most; seed: of noise and places.
    """

    path: Path
    world: World
    seconds: float
    rate: float
    seed: int
    out: Path
    faults: Iterable[Fault]


@dataclass
class _Census:
    """Counts of all nodes while time stands still: by node, its process number and its counts."""

    passed: Passed
    by_node: dict[str, tuple[int, dict[str, Counts]]]


class FaultRun:
    """Drives a robot about and causes faults until the time is over."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._observer = Observer(setting.world)
        self._processes = Processes(setting.out, SPEED_M_S)
        self._goals = GoalClient(self._observer.node, setting.world, setting.seed, _EXPLORATIONS)
        self._rng = np.random.default_rng([setting.seed, 1])
        self._census: _Census | None = None
        self._record = Record(None, 0.0)
        self._begun_m = 0.0
        self._collisions = 0

    def run(self, report: Callable[[Record], None]) -> None:
        """Run; report: is called with each record.

        Raises ThinmapError if nodes do not start or time stands still.
        """
        setting = self._setting
        self._start_simulator()
        self._start_nodes(setting.world.start)
        for fault in setting.faults:
            if self._observer.track.time_s >= setting.seconds:
                break
            self._drive_undisturbed(fault, report)
            self._begin_record(fault)
            self._cause(fault)
            self._recover(fault)
            self._take_census()
            self._end_record(report)
            is_lost = self._record.recovered_s is None
            if self._record.violations() or fault.kind.resets or is_lost:
                self._restart_all()

    def close(self) -> None:
        """End all processes."""
        self._processes.close()
        self._observer.close()

    # A fault.

    def _drive_undisturbed(self, fault: Fault, report: Callable[[Record], None]) -> None:
        """Drive before a fault; again after a new start, where something was left of the last."""
        for _ in range(_UNDISTURBED):
            self._begin_record(None)
            self._drive_until_it_moves(fault)
            self._end_record(report)
            if not self._record.violations():
                break
            self._restart_all()

    def _drive_until_it_moves(self, fault: Fault) -> None:
        """Drive until the fault is due, and the robot moves, as a fault matters most then."""
        track = self._observer.track
        begun_s = track.time_s
        self._spin_until(lambda: track.time_s > begun_s + fault.gap_s)
        self._spin_until(
            lambda: (
                track.speed_m_s() > 2.0 * DRIVES_M_S
                or track.time_s > begun_s + fault.gap_s + _MOVING_S
            )
        )

    def _cause(self, fault: Fault) -> None:
        track = self._observer.track
        self._observer.order(is_free=True)
        end_s = track.time_s + fault.duration_s
        cause = cause_of(fault, self._setting.world, self._processes, self._observer)
        cause.begin()
        stand_s = track.time_s + fault.kind.stand_s
        self._spin_until(lambda: track.time_s > min(end_s, stand_s))
        before = self._observer.moving_commands
        self._spin_until(lambda: track.time_s > end_s)
        self._record.commands = self._observer.moving_commands - before
        self._spin_until(lambda: cause.may_end() or track.time_s > end_s + _ANSWER_S)
        self._record.others += cause.end() or []
        if fault.kind.is_killed:
            self._await_start(fault.kind.node)
        self._record.driven_m = track.travelled_m - self._begun_m

    def _await_start(self, name: str) -> None:
        self._observer.health.pop(name, None)
        self._spin_until(lambda: name in self._observer.health or not self._processes.pid(name))
        self._goals.ask_again()

    def _recover(self, fault: Fault) -> None:
        """Wait until the pose is right and the robot drives again."""
        track = self._observer.track
        begun_s = track.time_s
        if fault.kind.resets:
            self._spin_until(lambda: track.time_s > begun_s + _REALIGN_S)
            self._observer.align_map()
            self._record.pose = PoseWatch(fault.kind.wrong_s)
        drives = False
        watch = self._record.pose

        def recovered() -> bool:
            nonlocal drives
            drives = drives or track.speed_m_s() > DRIVES_M_S
            is_settled = track.time_s > begun_s + _SETTLE_S
            return is_settled and drives and watch.since_s is None

        def ended() -> bool:
            return recovered() or watch.is_violated or track.time_s > begun_s + _RECOVERY_S

        self._spin_until(ended)
        if recovered():
            self._record.recovered_s = track.time_s - begun_s
        elif not watch.is_violated and not self._is_lost_as_it_may(fault):
            faults = [f'{n}: {h.message}' for n, h in self._observer.health.items() if not h.is_ok]
            state = 'the pose is wrong' if drives else 'the robot does not drive'
            self._record.others.append(
                f'not recovered in {_RECOVERY_S:.0f} s: {state} ({"; ".join(faults)})'
            )
        self._observer.order(is_free=False)

    def _is_lost_as_it_may(self, fault: Fault) -> bool:
        localizer = self._observer.health.get('localizer')
        return fault.kind.may_end_lost and localizer is not None and not localizer.is_ok

    def _begin_record(self, fault: Fault | None) -> None:
        track = self._observer.track
        watch = PoseWatch(fault.kind.wrong_s) if fault else PoseWatch()
        self._record = Record(fault, track.time_s, pose=watch, drawn=self._observer.map.begin())
        self._begun_m = track.travelled_m

    def _end_record(self, report: Callable[[Record], None]) -> None:
        record = self._record
        if record.fault is None:
            record.driven_m = self._observer.track.travelled_m - self._begun_m
        report(record)

    # Counts of messages.

    def _take_census(self) -> None:
        """Let time stand still, and compare what was passed on with what each node counts."""
        self._hold()
        census = self._counts()
        if census is None:
            self._record.others.append(f'no diagnostics of all nodes in {_CENSUS_S:.0f} s')
        elif self._census is not None:
            for name, (pid, counts) in census.by_node.items():
                before_pid, before = self._census.by_node.get(name, (0, {}))
                for topic in counts.keys() & before.keys() if pid == before_pid else ():
                    text = uncounted(
                        topic, before[topic], counts[topic], census.passed, self._census.passed
                    )
                    if text:
                        self._record.others.append(f'{name}: {text}')
        self._census = census
        self._release()

    def _counts(self) -> _Census | None:
        """Counts that no longer change; None if they still do after a while."""
        last: dict[str, tuple[float, dict[str, Counts]]] = {}
        same = dict.fromkeys(NODES, 0)
        end_s = time.monotonic() + _CENSUS_S
        while min(same.values()) < _SETTLED:
            self._spin()
            if time.monotonic() > end_s:
                return None
            for name, health in list(self._observer.health.items()):
                heard_s, before = last.get(name, (0.0, {}))
                if name not in same or health.heard_s == heard_s:
                    continue
                found = ((topic, health.counts(topic)) for topic in _TOPICS)
                counts = {topic: count for topic, count in found if count is not None}
                same[name] = same[name] + 1 if counts == before and heard_s else 0
                last[name] = (health.heard_s, counts)
        by_node = {name: (self._processes.pid(name), last[name][1]) for name in NODES}
        return _Census(self._observer.passed(), by_node)

    # Processes and time.

    def _start_simulator(self) -> None:
        """Start simulator and relay; time stands still until the relay lets it pass."""
        setting = self._setting
        self._processes.start('relay', {}, module='benchmarks.faults.relay')
        parameters: dict[str, object] = {
            'world': setting.path,
            'start': ','.join(map(str, setting.world.start.tolist())),
            'real_time_factor': setting.rate,
            'seed': setting.seed,
            'lockstep': 'local_topology',
            'lockstep_timeout_s': 3600.0,
            'wait_for_subscribers': 1,
        }
        renamed = {'local_topology': 'paced', '/clock': '/raw_clock', '/tf': '/raw_tf'}
        renamed |= {'scan': 'raw_scan', 'odom': 'raw_odom', 'cmd_vel': 'wheels'}
        self._processes.start('sim', parameters, renamed)

    def _start_nodes(self, at: Array) -> None:
        """Start all nodes while time stands still, the robot at a pose (3,)."""
        observer = self._observer
        self._wait_for(observer.is_connected, 'simulator and relay do not start')
        observer.health.clear()
        observer.track.T_world_map = np.zeros(3)
        observer.map.discard()
        self._processes.start_nodes(at)
        self._wait_for(lambda: observer.health.keys() >= set(NODES), 'nodes do not start')
        self._census = self._counts()
        self._release()

    def _restart_all(self) -> None:
        """Start again with an empty map, elsewhere: the next fault is judged by itself."""
        for name in NODES:
            self._processes.kill(name)
        # The robot stops without commands: it must not move before the first scan.
        self._observer.order(is_free=True)
        killed_s = self._observer.track.time_s
        self._spin_until(lambda: self._observer.track.time_s > killed_s + _STOP_S)
        self._observer.order(is_free=False)
        self._hold()
        place = random_start(self._setting.world, self._rng)
        self._observer.teleport(place)
        self._goals.explore_again(_EXPLORATIONS)
        self._start_nodes(place)

    def _hold(self) -> None:
        self._observer.order(holds=True)
        self._wait_for(lambda: self._observer.is_held, 'time does not stand still')

    def _release(self) -> None:
        self._observer.order(holds=False)

    def _wait_for(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for something that takes time of the machine."""
        end_s = time.monotonic() + _START_S
        while not condition():
            self._observer.spin()
            for text in self._processes.ended().values():
                raise ThinmapError(text)
            if time.monotonic() > end_s:
                raise ThinmapError(what)

    def _spin_until(self, condition: Callable[[], bool]) -> None:
        """Drive until a condition holds."""
        track = self._observer.track
        at_s = track.time_s
        seen_s = time.monotonic()
        while not condition():
            self._spin()
            self._goals.step()
            if track.time_s != at_s:
                at_s = track.time_s
                seen_s = time.monotonic()
            elif time.monotonic() - seen_s > _STANDSTILL_S:
                raise ThinmapError(f'time stands still at {at_s:.2f} s')

    def _spin(self) -> None:
        observer = self._observer
        observer.spin()
        for scan in observer.track.located():
            localizer = observer.health.get('localizer')
            self._record.pose.add(scan, localizer is not None and not localizer.is_ok)
            observer.map.add_error(scan.stamp_ns, scan.error_m)
        if observer.collisions != self._collisions:
            self._record.collisions += observer.collisions - self._collisions
            self._collisions = observer.collisions
        for name, text in self._processes.ended().items():
            if name in NODES:
                self._record.others.append(text)
                self._processes.start_node(name)
            else:
                raise ThinmapError(text)


def drive(setting: Setting, report: Callable[[Record], None]) -> None:
    """Run; all processes have ended when it returns. report: is called with each record."""
    run = FaultRun(setting)
    try:
        run.run(report)
    finally:
        # A second Ctrl-C must not leave processes behind.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        with suppress(KeyboardInterrupt):
            run.close()
        signal.signal(signal.SIGINT, before)
