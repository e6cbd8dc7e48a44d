"""Exploration of a simulated world by several robots, with a report."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from thinmap_ros.closed_loop import ClosedLoop, Options, explorer_config, make_loop, no_progress
from thinmap_ros.core.exploration.explorer import Explorer
from thinmap_ros.core.exploration.team import Team, TeamConfig
from thinmap_ros.core.se2 import Array, path_length_m
from thinmap_ros.evaluation.exploration_metrics import MILESTONES, first_time
from thinmap_ros.evaluation.exploration_run import observable_cells, run_timed
from thinmap_ros.sim.other_robots import SharedWorld
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.sim.world import World
from thinmap_ros.team.loop import TeamLoop
from thinmap_ros.team.maps import OwnMaps, SharedMap, TeamMaps
from thinmap_ros.team.radio import Trouble


@dataclass(frozen=True)
class TeamOptions:
    """Options of a team, beside those of each robot.

    has_own_maps: whether each robot has a map of its own and sends the others what has changed, as
    it does with poses by SLAM, or all have one map at once.
    """

    config: TeamConfig = field(default_factory=TeamConfig)
    trouble: Trouble = field(default_factory=Trouble)
    has_own_maps: bool = False


def make_team(
    world: World, starts: Sequence[Array], options: Options, team: TeamOptions
) -> TeamLoop:
    """Make a team with a robot at each start (3,).

    Raises InputError where a robot does not fit.
    """
    loops: list[ClosedLoop] = []
    for number, start in enumerate(starts):
        own_world = SharedWorld.of(world)
        for other in loops:
            own_world.others.append(other.simulation.robot)
        own_options = Options(**{**vars(options), 'seed': options.seed + number})
        loop = make_loop(own_world, start, own_options)
        config = explorer_config(PRESETS[options.robot], options.speed_m_s)
        loop.strategy = Explorer(config, team=Team(f'robot{number + 1}', team.config))
        for other in loops:
            other_world = other.simulation.world
            assert isinstance(other_world, SharedWorld)
            other_world.others.append(loop.simulation.robot)
        loops.append(loop)
    maps: TeamMaps = SharedMap(loops, loops[0].pipeline.config.grid)
    if team.has_own_maps or options.localization == 'slam':
        maps = OwnMaps(loops, team.trouble, options.seed)
    return TeamLoop(loops, maps, team.trouble, options.seed)


def explore_together(
    world: World,
    starts: Sequence[Array],
    options: Options,
    team: TeamOptions | None = None,
    show: Callable[[float, float], None] = no_progress,
) -> tuple[TeamLoop, dict[str, Any]]:
    """Explore a world from several starts (3,); returns the finished loop and the report."""
    team = team or TeamOptions()
    loop = make_team(world, starts, options, team)
    goal = observable_cells(world, starts[0], options)
    outcome, about = run_timed(loop, goal, options, show)
    distances = [path_length_m(np.array(member.loop.log.true_poses)) for member in loop.members]
    coverage = np.array(loop.coverage)
    decision_s = [sum(member.loop.log.decision_s) for member in loop.members]
    report: dict[str, Any] = {
        'finished': outcome.finished,
        'reason': outcome.reason,
        'coverage': round(float(coverage[-1, 1]), 5),
        'distance': round(sum(distances), 3),
        'time': round(loop.now_s, 3),
        'time_at': {f'{share:.2f}': first_time(coverage, share) for share in MILESTONES},
        'collisions': outcome.collisions,
        'robots': [
            {
                'name': member.name,
                'start': [round(float(number), 3) for number in start],
                'coverage': round(goal.coverage(loop.maps.view(number)[1]), 5),
                'distance': round(distance, 3),
                'collisions': member.loop.simulation.robot.collisions,
                'yielded_s': round(member.yielded_s, 1),
            }
            for number, (member, start, distance) in enumerate(
                zip(loop.members, starts, distances, strict=True)
            )
        ],
        'bytes_per_m': {
            kind: round(sent / max(sum(distances), 1.0), 1)
            for kind, sent in _sent_bytes(loop).items()
        },
        'curve': [[round(float(at), 2), round(float(share), 4)] for at, share in coverage],
        'world': world.name,
        **about,
        'team': asdict(team),
        'decision_s': [round(seconds, 3) for seconds in decision_s],
    }
    return loop, report


def _sent_bytes(loop: TeamLoop) -> dict[str, int]:
    """Bytes that all robots have sent, each message once, by kind."""
    sent = {'claims': loop.claims.sent_bytes}
    if isinstance(loop.maps, OwnMaps):
        sent['tiles'] = loop.maps.tiles.sent_bytes
    return sent
