"""Cases of a team: how many robots, which maps they have, and what goes wrong between them."""

from dataclasses import dataclass, field

import numpy as np

from benchmarks.worlds import Floor
from thinmap_ros.closed_loop import Options
from thinmap_ros.evaluation.team_run import TeamOptions, explore_together
from thinmap_ros.sim.other_robots import starts_side_by_side
from thinmap_ros.sim.robot import PRESETS
from thinmap_ros.team.radio import Trouble

_SPEED_M_S = 0.5
_LIMIT_S = 5000.0
Record = dict[str, str | int | float]


@dataclass(frozen=True)
class Case:
    """Robots that start side by side; with has_own_maps they send each other tiles."""

    robots: int
    has_own_maps: bool = False
    localization: str = 'truth'
    trouble: Trouble = field(default_factory=Trouble)

    def run(self, floor: Floor, seed: int) -> Record:
        """Explore a floor from its first start; returns the figures."""
        radius_m = PRESETS[Options.robot].radius_m
        starts = starts_side_by_side(floor.world, floor.starts[0], self.robots, radius_m)
        options = Options(
            seed=seed,
            speed_m_s=_SPEED_M_S,
            localization=self.localization,
            time_limit_s=_LIMIT_S,
        )
        team = TeamOptions(trouble=self.trouble, has_own_maps=self.has_own_maps)
        loop, report = explore_together(floor.world, starts, options, team)
        working = [
            robot['coverage']
            for number, robot in enumerate(report['robots'])
            if not self.trouble.is_dead(number, loop.now_s)
        ]
        sent = report['bytes_per_m']
        return {
            'finished': int(report['finished']),
            'time_s': report['time'],
            't99_s': report['time_at']['0.99'] or '',
            'distance_m': report['distance'],
            'coverage': report['coverage'],
            'least_coverage': float(np.min(working)),
            'contacts': report['collisions'],
            'yielded_s': sum(robot['yielded_s'] for robot in report['robots']),
            'claim_bytes_m': sent['claims'],
            'tile_bytes_m': sent.get('tiles', 0.0),
            'cpu_s': report['cpu_s'],
        }


_OUT = Trouble(out_of_reach=(1, 60.0, 60.0))
_DEAD = Trouble(dead=(1, 60.0))
CASES = {
    '1': Case(1),
    '2': Case(2),
    '3': Case(3),
    '2 own maps': Case(2, has_own_maps=True),
    '3 own maps': Case(3, has_own_maps=True),
    '3 claims 5 s late': Case(3, has_own_maps=True, trouble=Trouble(claim_delay_s=5.0)),
    '3 one out of reach for 60 s': Case(3, has_own_maps=True, trouble=_OUT),
    '3 one dead from 60 s on': Case(3, has_own_maps=True, trouble=_DEAD),
    '3 a tenth of messages lost': Case(3, has_own_maps=True, trouble=Trouble(loss=0.1)),
    '1 SLAM': Case(1, localization='slam'),
    '2 SLAM': Case(2, localization='slam'),
}
# What each case is compared with.
BASES = {
    '2': '1',
    '3': '1',
    '2 own maps': '2',
    '3 own maps': '3',
    '3 claims 5 s late': '3 own maps',
    '3 one out of reach for 60 s': '3 own maps',
    '3 one dead from 60 s on': '2 own maps',
    '3 a tenth of messages lost': '3 own maps',
    '2 SLAM': '1 SLAM',
}
