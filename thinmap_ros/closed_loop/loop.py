"""Closed loop of robots, or of one, in a world: simulators, pipelines, strategies, navigators."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from thinmap_ros.closed_loop.kidnapping import KidnappedRobot
from thinmap_ros.closed_loop.maps import Maps, OwnMaps, SharedMap
from thinmap_ros.closed_loop.radio import Radio, Trouble
from thinmap_ros.closed_loop.robot import CONTROL_STEPS, Options, SimulatedRobot
from thinmap_ros.core.exploration.strategy import Observation
from thinmap_ros.core.exploration.team import Claim, Heard, Team, TeamConfig
from thinmap_ros.core.planning.path_follower import (
    MESSAGE_PERIOD_S,
    NEAR_ROBOT_M,
    HeardMotion,
    Motion,
)
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import SECOND_NS, Array
from thinmap_ros.sim.coverage import ObservableCells
from thinmap_ros.sim.other_robots import simulations_in
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World

_CLAIM_BYTES = 104  # of thinmap_msgs with header, pose, speed, place and path length
_SETTLED_BYTES = 12
# Beyond the radius of a robot: noise of the laser, and its motion in the tenth of a second since.
_CUT_MARGIN_M = 0.13


@dataclass(frozen=True)
class ExplorationOutcome:
    """How an exploration ended; finished: whether the strategy ended it, and has explored."""

    finished: bool
    reason: str
    collisions: int


@dataclass(frozen=True)
class TeamOptions:
    """Options of a team, beside those of each robot.

    has_own_maps: whether each robot has a map of its own and sends the others what has changed, as
    it does with poses by SLAM, or all have one map at once.
    """

    config: TeamConfig = field(default_factory=TeamConfig)
    trouble: Trouble = field(default_factory=Trouble)
    has_own_maps: bool = False


DEFAULT_TEAM = TeamOptions()


class ClosedLoop:
    """Robots in one world, each called in turn; several share maps, claims and motions.

    coverage: time, s, and share of the cells to see that are known, of each measurement.
    """

    def __init__(
        self,
        robots: Sequence[SimulatedRobot],
        maps: Maps | None = None,
        team: TeamOptions = DEFAULT_TEAM,
        seed: int = 0,
    ) -> None:
        """maps: None: those of their pipelines. seed: of the loss of messages."""
        self.robots = robots
        self.maps = maps or Maps(robots)
        self.trouble = team.trouble
        delay_s = team.trouble.claim_delay_s
        self.claims: Radio[Claim] = Radio(len(robots), team.trouble, delay_s, seed)
        self.coverage: list[tuple[float, float]] = []
        self._motions: list[Heard[Motion]] = [Heard(team.config) for _ in robots]
        self._scans = 0
        self._claimed_s = -math.inf
        if len(robots) > 1:
            for robot in robots:
                robot.explorer.team = Team(robot.name, team.config)

    @property
    def now_s(self) -> float:
        """Simulated time."""
        return self._now_ns / SECOND_NS

    @property
    def _now_ns(self) -> int:
        return self.robots[0].simulation.stamp_ns

    @property
    def is_finished(self) -> bool:
        """Whether all robots that work have nothing left to explore."""
        return all(robot.is_finished for _, robot in self._working())

    def run(
        self,
        goal: ObservableCells,
        limit_s: float,
        show: Callable[[float, float], None],
        scans_per_show: int = 5,
    ) -> ExplorationOutcome:
        """Explore until all robots are finished or the time is up.

        `show` receives time (s) and coverage with every `scans_per_show`-th scan.
        """
        for robot in self.robots:
            robot.sense()
        steps = 0
        while self.now_s < limit_s:
            is_control_due = steps % CONTROL_STEPS == 0
            if is_control_due:
                self._exchange_motions()
            for scans in zip(*(robot.moment.scans for robot in self.robots), strict=True):
                self._process_scans(scans)
                if self._scans % scans_per_show == 1:
                    show(*self._measure(goal))
            if self.robots[0].moment.scans and self.is_finished:
                break
            if is_control_due:
                for number, robot in self._working():
                    robot.control(self._others(number))
            for number, robot in enumerate(self.robots):
                is_dead = self.trouble.is_dead(number, self.now_s)
                robot.simulation.move(*((0.0, 0.0) if is_dead else robot.command))
                robot.sense()
            steps += 1
        for robot in self.robots:
            robot.pipeline.finish()
        show(*self._measure(goal))
        return self._outcome(limit_s)

    def _outcome(self, limit_s: float) -> ExplorationOutcome:
        endings = [robot.ending(limit_s) for _, robot in self._working()]
        reasons = '; '.join(dict.fromkeys(reason for _, reason in endings))
        # A robot for which others leave nothing has driven nowhere, which is no failure.
        finished = self.is_finished and any(is_success for is_success, _ in endings)
        contacts = sum(robot.simulation.robot.collisions for robot in self.robots)
        return ExplorationOutcome(finished, reasons, contacts)

    def _working(self) -> Iterator[tuple[int, SimulatedRobot]]:
        now_s = self.now_s
        for number, robot in enumerate(self.robots):
            if not self.trouble.is_dead(number, now_s):
                yield number, robot

    def _process_scans(self, scans: tuple[Scan, ...]) -> None:
        """Process one scan of each robot through the maps to decisions."""
        now_s = self.now_s
        located = {}
        for number, robot in self._working():
            places = np.array([each.motion.pose[:2] for each in self._others(number)])
            seen = scans[number].without_places(robot.pose, places, robot.radius_m + _CUT_MARGIN_M)
            estimate = self.maps.add_scan(number, seen)
            if estimate is not None:
                located[number] = estimate
        self.maps.update({i: estimate.T_map_base for i, estimate in located.items()}, now_s)
        self._scans += 1
        if len(self.robots) > 1:
            self._exchange_claims(now_s)
        for number, estimate in located.items():
            topology, patch = self.maps.view(number)
            observation = Observation(topology, patch, scans[number], estimate.T_map_base)
            self.robots[number].decide(observation, estimate.T_map_odom)

    def _exchange_claims(self, now_s: float) -> None:
        if now_s - self._claimed_s >= MESSAGE_PERIOD_S:
            self._claimed_s = now_s
            for number, robot in self._working():
                claim = robot.explorer.claim(self._now_ns, robot.pose)
                robot.explorer.team.sent = claim
                size = _CLAIM_BYTES + _SETTLED_BYTES * len(claim.settled)
                self.claims.broadcast(number, claim, size, now_s)
        for receiver, claim in self.claims.received(now_s):
            self.robots[receiver].explorer.team.add_claim(claim, self._now_ns)

    def _exchange_motions(self) -> None:
        """Send the motion of each robot to all others in reach."""
        told = {
            number: robot.motion
            for number, robot in enumerate(self.robots)
            if not self.trouble.is_silent(number, self.now_s)
        }
        for number, own in told.items():
            others = [motion for other, motion in told.items() if other != number]
            for motion in others:
                self._motions[number].add(motion.robot, motion, self._now_ns)
            is_near = any(math.dist(own.pose[:2], each.pose[:2]) < NEAR_ROBOT_M for each in others)
            is_moving = own.v != 0.0 or own.w != 0.0
            self.claims.sent_bytes += _CLAIM_BYTES * (is_near and is_moving)

    def _others(self, number: int) -> list[HeardMotion]:
        """Motions of the others; one that was silent for long is an obstacle of the map."""
        return [HeardMotion(*each) for each in self._motions[number].lately(self._now_ns)]

    def _measure(self, goal: ObservableCells) -> tuple[float, float]:
        self.coverage.append((self.now_s, goal.coverage(self.maps.known_area())))
        return self.coverage[-1]


def make_loop(
    world: World, starts: Sequence[Array], options: Options, team: TeamOptions = DEFAULT_TEAM
) -> ClosedLoop:
    """Make a loop with a robot at each start (3,).

    Raises InputError where a robot does not fit, ConfigError where there is no such strategy.
    """
    preset = PRESETS[options.robot]
    simulations = simulations_in(world, starts, preset, options.laser, options.seed)
    kind = SimulatedRobot if options.kidnap_at_s is None else KidnappedRobot
    robots = [kind(each, options, f'robot{i}') for i, each in enumerate(simulations, 1)]
    maps: Maps = Maps(robots)
    if len(robots) > 1:
        maps = SharedMap(robots)
        if team.has_own_maps or options.localization == 'slam':
            maps = OwnMaps(robots, team.trouble, options.seed)
    return ClosedLoop(robots, maps, team, options.seed)


def no_progress(seconds: float, coverage: float) -> None:
    """Show no progress."""
