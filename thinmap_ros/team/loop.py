"""Closed loop of several robots in one world: simulators, maps, explorers and navigators."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from thinmap_ros.closed_loop import CONTROL_STEPS, ClosedLoop, ExplorationOutcome, RightOfWay
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.exploration.strategy import Observation
from thinmap_ros.core.exploration.team import Claim
from thinmap_ros.core.planning.navigator import Command
from thinmap_ros.core.planning.path_follower import NEAR_ROBOT_M, Motion, must_stop
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.sim.coverage import ObservableCells
from thinmap_ros.sim.simulation import STEP_NS, SensorReadings
from thinmap_ros.team.maps import TeamMaps
from thinmap_ros.team.radio import Radio, Trouble

_CLAIM_PERIOD_S = 1.0
_CLAIM_BYTES = 104  # of thinmap_msgs with header, pose, speed, place and path length
_SETTLED_BYTES = 12
# Beyond the radius of a robot: noise of the laser, and its motion in the tenth of a second since.
_CUT_MARGIN_M = 0.13
_GIVE_WAY_MARGIN_M = 0.11


@dataclass(eq=False)
class Member:
    """A robot of a team: its closed loop and explorer, and motions of others with their times.

    yielded_steps: steps of control in which it has given way.
    """

    loop: ClosedLoop
    explorer: Explorer
    moment: SensorReadings
    motions: dict[int, tuple[float, Motion]] = field(default_factory=dict)
    yielded_steps: int = 0

    @property
    def name(self) -> str:
        """Name in the team."""
        return self.explorer.team.name

    @property
    def yielded_s(self) -> float:
        """Time for which it has given way."""
        return self.yielded_steps * CONTROL_STEPS * STEP_NS / SECOND_NS

    @property
    def radius_m(self) -> float:
        """Radius of the robot."""
        return self.loop.simulation.robot.config.radius_m

    @property
    def pose(self) -> Array:
        """Estimated pose (3,) now."""
        return self.loop.pose_at(self.moment.T_odom_base)

    def motion(self) -> Motion:
        """The motion that it sends."""
        robot = self.loop.simulation.robot
        return Motion(self.name, self.pose, robot.v, robot.w)

    def claim(self) -> Claim:
        """The claim that it sends."""
        return self.explorer.claim(self.moment.stamp_ns, self.pose)


class TeamLoop:
    """Robots in one world, each with its own explorer; they share maps, claims and motions."""

    def __init__(
        self, loops: Sequence[ClosedLoop], maps: TeamMaps, trouble: Trouble, seed: int
    ) -> None:
        """loops: each with an Explorer as its strategy, whose team has a name of its own."""
        self.members = [_member(loop) for loop in loops]
        self.maps = maps
        self.trouble = trouble
        self.claims: Radio[Claim] = Radio(len(loops), trouble, trouble.claim_delay_s, seed)
        self.coverage: list[tuple[float, float]] = []
        self._scans = 0
        self._claimed_s = -math.inf

    @property
    def now_s(self) -> float:
        """Simulated time."""
        return self.members[0].moment.stamp_ns / SECOND_NS

    @property
    def is_finished(self) -> bool:
        """Whether all robots that work have nothing left to explore."""
        return all(member.loop.is_finished for _, member in self._working())

    def run(
        self,
        goal: ObservableCells,
        limit_s: float,
        show: Callable[[float, float], None],
        scans_per_show: int = 5,
    ) -> ExplorationOutcome:
        """As ClosedLoop.run: until all robots are finished or the time is up."""
        steps = 0
        while self.now_s < limit_s:
            if steps % CONTROL_STEPS == 0:
                self._exchange_motions()
            for scans in zip(*(member.moment.scans for member in self.members), strict=True):
                self._process_scans(scans)
                if self._scans % scans_per_show == 1:
                    show(*self._measure(goal))
            if self.members[0].moment.scans and self.is_finished:
                break
            if steps % CONTROL_STEPS == 0:
                for _, member in self._working():
                    member.loop.control(member.moment, self._right_of_way(member))
            for number, member in enumerate(self.members):
                is_dead = self.trouble.is_dead(number, self.now_s)
                command = (0.0, 0.0) if is_dead else member.loop.command
                member.moment = member.loop.simulation.step(*command)
            steps = steps + 1
        for member in self.members:
            member.loop.pipeline.finish()
        show(*self._measure(goal))
        return self._outcome(limit_s)

    def _outcome(self, limit_s: float) -> ExplorationOutcome:
        endings = [member.loop.ending(limit_s) for _, member in self._working()]
        reasons = '; '.join(dict.fromkeys(reason for _, reason in endings))
        # A robot for which others leave nothing has driven nowhere, which is no failure.
        finished = self.is_finished and any(is_success for is_success, _ in endings)
        contacts = sum(member.loop.simulation.robot.collisions for member in self.members)
        return ExplorationOutcome(finished, reasons, contacts)

    def _working(self) -> Iterator[tuple[int, Member]]:
        now_s = self.now_s
        for number, member in enumerate(self.members):
            if not self.trouble.is_dead(number, now_s):
                yield number, member

    def _process_scans(self, scans: tuple[Scan, ...]) -> None:
        """Process one scan of each robot through the maps to decisions."""
        now_s = self.now_s
        estimates = {}
        for number, member in self._working():
            places = np.array([m.pose[:2] for m in self._recent_motions(member)]).reshape(-1, 2)
            cut_m = member.radius_m + _CUT_MARGIN_M
            seen = scans[number].without_places(member.pose, places, cut_m)
            estimates[number] = self.maps.add_scan(number, seen, member.moment.T_odom_base)
        self.maps.update({i: estimate.T_map_base for i, estimate in estimates.items()}, now_s)
        self._scans += 1
        self._exchange_claims(now_s)
        for number, member in self._working():
            estimate = estimates[number]
            for box in self.maps.take_changes(number):
                member.explorer.team.add_changes(box)
            if not estimate.blind_reason:
                topology, patch = self.maps.view(number)
                observation = Observation(topology, patch, scans[number], estimate.T_map_base)
                member.loop.decide_on(observation, estimate.T_map_odom)

    def _exchange_claims(self, now_s: float) -> None:
        if now_s - self._claimed_s >= _CLAIM_PERIOD_S:
            self._claimed_s = now_s
            for number, member in self._working():
                claim = member.claim()
                member.explorer.team.sent = claim
                self.claims.broadcast(number, claim, _size_of(claim), now_s)
        for receiver, claim in self.claims.received(now_s):
            stamp_ns = round(now_s * SECOND_NS)
            self.members[receiver].explorer.team.add_claim(claim, stamp_ns)

    def _exchange_motions(self) -> None:
        """Send the motion of each robot to all others in reach."""
        now_s = self.now_s
        motions = {
            number: member.motion()
            for number, member in enumerate(self.members)
            if not self.trouble.is_silent(number, now_s)
        }
        for number, own in motions.items():
            others = {other: motion for other, motion in motions.items() if other != number}
            self.members[number].motions |= {i: (now_s, motion) for i, motion in others.items()}
            is_near = any(
                math.dist(own.pose[:2], other.pose[:2]) < NEAR_ROBOT_M for other in others.values()
            )
            is_moving = own.v != 0.0 or own.w != 0.0
            self.claims.sent_bytes += _CLAIM_BYTES * (is_near and is_moving)

    def _right_of_way(self, member: Member) -> RightOfWay:
        others = list(self._recent_motions(member))
        distance_m = 2.0 * member.radius_m + _GIVE_WAY_MARGIN_M
        controller = member.loop.navigator.config.controller
        horizon_s = controller.max_speed_m_s / controller.max_acceleration_m_s2

        def allowed(T_map_base: Array, command: Command, period_s: float) -> Command:
            own = Motion(member.name, T_map_base, command.v, command.w)
            if command.v <= 0.0 or not must_stop(own, others, distance_m, horizon_s):
                return command
            member.yielded_steps += 1
            places = np.array([other.pose[:2] for other in others])
            return member.loop.navigator.give_way(command, period_s, places, distance_m)

        return allowed

    def _recent_motions(self, member: Member) -> Iterator[Motion]:
        """Newest motions of the others; one that was silent for long is an obstacle of the map."""
        timeout_s = member.explorer.team.config.claim_timeout_s
        for received_s, motion in member.motions.values():
            if self.now_s - received_s <= timeout_s:
                yield motion

    def _measure(self, goal: ObservableCells) -> tuple[float, float]:
        self.coverage.append((self.now_s, goal.coverage(self.maps.known_area())))
        return self.coverage[-1]


def _member(loop: ClosedLoop) -> Member:
    assert isinstance(loop.strategy, Explorer)
    return Member(loop, loop.strategy, loop.simulation.read_sensors())


def _size_of(claim: Claim) -> int:
    return _CLAIM_BYTES + _SETTLED_BYTES * len(claim.settled)
