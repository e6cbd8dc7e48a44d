"""Two explorers on one graph, whose maps are joined by hand: claims, tiles, and silence."""

import math
from itertools import count
from time import monotonic

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from support.localized import local_grid

from thinmap_msgs.msg import (
    ExplorationStatus,
    JoinStatus,
    LocalGrid,
    MapTiles,
    ProbabilityGrid,
    RobotMap,
    TeamClaim,
    TopologicalMap,
)
from thinmap_ros.core import se2
from thinmap_ros.core.grid.moved import overlaid
from thinmap_ros.core.grid.patch import UNKNOWN, GridFrame, GridPatch
from thinmap_ros.core.grid.raytrace import cast_rays
from thinmap_ros.core.planning.path_follower import SpeedConfig
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.ros import messages, qos

pytestmark = pytest.mark.live
CELL_M = 0.1
LENGTH_M = 20.0
RANGE_M = 3.0  # shorter than the way to both ends: robots see them from one place
ANGLES = np.radians(np.arange(-90.0, 91.0))
PERIOD_NS = 200_000_000
SPEAK_S = 0.04  # five times real time; the explorers use the simulated time
SILENCE_S = 40.0
# Robots tell each second what they do. Time is slow while one is late: it would count as silent.
LATE_NS = 5 * 10**9
SLOW_S = 0.5
ONE = '/robot1'
TWO = '/robot2'
# Of the maps of the robots in the world.
PLACES = {ONE: se2.pose(0.0, 0.0, 0.0), TWO: se2.pose(3.0, 1.0, 0.7)}


def hall(first_m=0.0, last_m=LENGTH_M):
    """A closed hall of 20 x 4 m, known from one x to another."""
    cells = np.zeros((40, round(LENGTH_M / CELL_M)), dtype=np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    cells[:, : round(first_m / CELL_M)] = UNKNOWN
    cells[:, round(last_m / CELL_M) :] = UNKNOWN
    return GridPatch(GridFrame(0.0, 0.0, CELL_M), cells)


class Robot:
    """Publishes what the other nodes of a robot do that stands in the hall.

    T: place of its map in the world; at: its own place there.
    """

    def __init__(self, graph, name, x, first_m, last_m):
        self.graph = graph
        self.name = name
        self.T = PLACES[name]
        self.at = se2.pose(x, 2.0, 0.0)
        node = graph.node
        self.targets = graph.heard(f'{name}/exploration_target', PoseStamped, qos.LATCHED)
        self.status = graph.heard(f'{name}/exploration_status', ExplorationStatus, qos.LATCHED)
        self._grid = node.create_publisher(ProbabilityGrid, f'{name}/grid', qos.LATCHED)
        self._graph_map = node.create_publisher(TopologicalMap, f'{name}/topology', qos.LATCHED)
        self._window = node.create_publisher(LocalGrid, f'{name}/local_grid', qos.STREAM)
        self.knows(first_m, last_m)

    def knows(self, first_m, last_m):
        base = GridPatch(GridFrame(0.02, 0.05, CELL_M), np.full((1, 1), UNKNOWN, dtype=np.int8))
        self.patch = overlaid(base, hall(first_m, last_m), se2.invert(self.T))
        self._grid.publish(messages.probability_grid_msg(self.patch, 'map', 0))
        x, y, _ = self.own_pose().tolist()
        topology = build(self.patch, (x, y), TopologyConfig())
        self._graph_map.publish(messages.topology_msg(topology, 'map', 0))

    def own_pose(self):
        return se2.between(self.T, self.at)

    def speak(self, ns):
        opaque = hall().occupied.astype(np.uint8)
        x, y = self.at[:2] / CELL_M
        ranges = CELL_M * cast_rays(opaque, x, y, ANGLES + self.at[2], RANGE_M / CELL_M)
        scan = Scan.create(ns, ranges, -0.5 * math.pi, math.pi / 180.0, 0.05, RANGE_M)
        self._window.publish(local_grid(self.patch, self.own_pose(), ns, scan))

    def explores(self, **parameters):
        self.graph.start(
            'explorer',
            remap=(f'__ns:={self.name}',),
            label=self.name.strip('/'),
            laser_pose='0,0,0',
            use_sim_time=True,
            drive=False,
            autostart_exploration=True,
            progress_timeout_s=1000.0,  # they stand, and keep what they claim
            **parameters,
        )

    @property
    def looks_left(self):
        """Whether its target looks at the left end of the hall."""
        if not self.targets:
            return None
        goal = messages.pose_from_msg(self.targets[-1].pose)
        return math.cos(se2.compose(self.T, goal)[2]) < 0.0


class Hall:
    """Two robots, and the clock; join: what map_joiner says of them."""

    def __init__(self, graph, one, two):
        self.graph = graph
        self.claims = graph.heard('/team/claims', TeamClaim, qos.SENSOR)
        self.one = Robot(graph, ONE, *one)
        self.two = Robot(graph, TWO, *two)
        self._join = graph.node.create_publisher(JoinStatus, '/join_status', qos.LATCHED)
        self._clock = graph.node.create_publisher(Clock, '/clock', qos.STREAM)
        self._numbers = count(1)
        self._ns = 0
        self._spoken_s = 0.0
        graph.node.create_timer(SPEAK_S, self._speak)

    def _speak(self):
        if self._is_ahead() and monotonic() - self._spoken_s < SLOW_S:
            return
        self._spoken_s = monotonic()
        self._ns = next(self._numbers) * PERIOD_NS
        self._clock.publish(Clock(clock=messages.time_msg(self._ns)))
        for robot in (self.one, self.two):
            robot.speak(self._ns)

    def _is_ahead(self):
        """Whether a robot has not told for long what it does: a busy machine has not run it."""
        told_ns = {each.robot: messages.stamp_ns(each.header.stamp) for each in self.claims[-20:]}
        running = {f'/{label}' for label in self.graph.processes}
        return any(self._ns - told_ns[name] > LATE_NS for name in told_ns.keys() & running)

    def state(self, name):
        """What a robot told last; None before it did."""
        claims = [claim for claim in self.claims if claim.robot == name]
        return claims[-1].state if claims else None

    def claimed_x(self, name):
        """Place in the world of the frontier that a robot claimed last; NaN where it has none."""
        claims = [claim for claim in self.claims if claim.robot == name]
        if not claims or claims[-1].state != TeamClaim.DRIVING:
            return math.nan
        frontier = claims[-1].frontier
        point = np.array([[frontier.x, frontier.y]])
        return float(se2.transform_points(PLACES[name], point)[0, 0])

    def until_claimed(self, name, x):
        self.graph.until(lambda: abs(self.claimed_x(name) - x) < 0.3, f'{name} claims {x}')

    def join(self, is_joined=True):
        maps = [
            RobotMap(name=name, is_joined=is_joined, pose=messages.pose_msg(T))
            for name, T in PLACES.items()
        ]
        self._join.publish(JoinStatus(header=messages.header('world', 0), maps=maps))


def test_claims_keep_the_other_robot_away_until_their_robot_is_silent(graph):
    hall = Hall(graph, (7.0, 1.5, 17.0), (8.5, 1.5, 17.0))
    hall.one.explores(team=True, claim_timeout_s=SILENCE_S)
    hall.two.explores(team=True, claim_timeout_s=SILENCE_S, follow_m=0.0)
    hall.until_claimed(ONE, 1.5)
    hall.until_claimed(TWO, 1.5)  # they are not joined
    hall.join()
    hall.until_claimed(TWO, 17.0)
    hall.until_claimed(ONE, 1.5)
    # Target and claim are two topics: the older target may be the last one here for a moment.
    graph.until(lambda: hall.two.looks_left is False, 'robot 2 looks right')
    assert hall.claimed_x(TWO) == pytest.approx(17.0, abs=0.3)
    last = next(claim for claim in reversed(hall.claims) if claim.robot == ONE)
    assert messages.stamp_ns(last.header.stamp) > 0
    assert (last.pose.position.x, last.pose.position.y) == pytest.approx((7.0, 2.0))
    assert (
        last.remaining_s
        > math.dist((7.0, 2.0), (last.goal.x, last.goal.y)) / SpeedConfig().max_speed_m_s
    )

    stranger = TeamClaim(robot=TWO, session=1, header=messages.header('map', 1))
    speaker = graph.node.create_publisher(TeamClaim, '/team/claims', qos.SENSOR)

    def is_refused():
        speaker.publish(stranger)
        return 'expected another team_name' in graph.log('robot2')

    graph.until(is_refused, 'a robot of the same name is refused')
    hall.two.knows(1.5, LENGTH_M)
    graph.until(lambda: hall.state(TWO) == TeamClaim.WAITING, 'robot 2 has nothing left')
    graph.stop('robot1')
    hall.until_claimed(TWO, 1.5)


def test_what_another_robot_has_seen_is_known(graph):
    hall = Hall(graph, (5.0, 2.0, 12.0), (15.0, 9.0, LENGTH_M))
    tiles = graph.heard('/team/tiles', MapTiles, qos.LATCHED)
    hall.one.explores(team=True)
    graph.until(lambda: tiles, 'tiles')
    count = len(tiles)
    hall.one.knows(0.0, 12.0)
    graph.until(lambda: len(tiles) > count, 'the tiles that have changed')
    hall.until_claimed(ONE, 12.0)
    # The last message does not hold all: this robot has to ask for the rest.
    hall.two.explores(team=True)
    hall.until_claimed(TWO, 9.0)
    hall.join()
    for robot in (hall.one, hall.two):
        graph.until(
            lambda robot=robot: hall.state(robot.name) == TeamClaim.FINISHED,
            f'{robot.name} has nothing left',
        )
        graph.until(
            lambda robot=robot: robot.status[-1].state == ExplorationStatus.FINISHED,
            f'the status of {robot.name}',
        )
        assert robot.status[-1].known_area_m2 == pytest.approx(19.8 * 3.8, rel=0.05)


def test_a_team_of_one_explores_as_without(graph):
    hall = Hall(graph, (7.0, 1.5, 17.0), (8.5, 1.5, 17.0))
    hall.one.explores(team=True)
    hall.two.explores()
    hall.join()
    hall.until_claimed(ONE, 1.5)
    graph.until(lambda: hall.two.looks_left, 'robot 2 looks to the left, too')
    assert {claim.robot for claim in hall.claims} == {ONE}


def test_a_strategy_that_cannot_share_is_refused(graph):
    process = graph.start('explorer', team=True, strategy='nearest_frontier')
    assert graph.ended(process) != 0
    graph.processes.clear()
    assert 'team = true: expected strategy = position_probability' in graph.log('explorer')
