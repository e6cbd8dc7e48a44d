"""Kinds of faults, and a random sequence of them from a seed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.node_processes import NODES

KILL = 'kill'
STOP = 'stop'
_GAP_S = (10.0, 30.0)
# Speed and deceleration of the robot are 0.5 m/s and 0.4 m/s^2: a stop takes 0.3 m.
_SILENT_M = 0.75
WRONG_S = 3.0
_KIDNAPPED_S = 5.0  # as docs/development/targets.md has it
_POSE_M = 2.25  # the navigator drives for 3 s without a pose


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    seconds: shortest and longest duration (simulated). stop_m: how far the robot may drive while it
    lasts. stand_s: after this time, all commands must be zero. resets: nodes discard their state,
    as documented, so that all of them are started again afterwards. may_end_lost: the robot need
    not drive again, as long as it says that its pose is unknown. wrong_s: how long a wrong pose may
    last without a report.
    """

    name: str
    seconds: tuple[float, float]
    stop_m: float = math.inf
    stand_s: float = math.inf
    resets: bool = False
    may_end_lost: bool = False
    wrong_s: float = WRONG_S
    node: str = ''

    @property
    def signal(self) -> str:
        """KILL or STOP for a process that is killed or stopped, else ''."""
        word = self.name.partition('_')[0]
        return word if word in (KILL, STOP) else ''


@dataclass(frozen=True)
class Fault:
    """A fault: after gap_s of undisturbed driving, for duration_s (simulated); seed: of details."""

    number: int
    kind: Kind
    gap_s: float
    duration_s: float
    seed: int


_STOP_M = {'localizer': _POSE_M, 'navigator': _SILENT_M}

KINDS = {
    kind.name: kind
    for kind in (
        *(
            Kind(f'{what}_{node}', seconds, _STOP_M.get(node, math.inf), node=node)
            for what, seconds in ((KILL, (0.5, 3.0)), (STOP, (1.0, 8.0)))
            for node in NODES
        ),
        Kind('drop_scan', (5.0, 15.0)),
        Kind('drop_odom', (5.0, 15.0)),
        Kind('repeat_scan', (5.0, 15.0)),
        Kind('repeat_odom', (5.0, 15.0)),
        Kind('silent_scan', (2.0, 8.0), _SILENT_M, 2.0),
        Kind('silent_odom', (2.0, 8.0), _SILENT_M, 2.0),
        Kind('laser_nan', (3.0, 15.0), _SILENT_M, 2.0),
        Kind('laser_zero', (3.0, 15.0), _SILENT_M, 2.0),
        Kind('laser_inf', (5.0, 40.0), 2.0),
        Kind('laser_max', (5.0, 40.0), 2.0),
        Kind('laser_frozen', (3.0, 10.0), 1.0, 3.0),
        Kind('scan_stamps', (2.0, 6.0), _SILENT_M, 2.0),
        Kind('odom_jump', (1.0, 1.0)),
        Kind('odom_stamps', (2.0, 6.0)),
        Kind('odom_one_stamp', (1.0, 1.0)),
        Kind('clock_ahead', (1.0, 1.0)),
        Kind('clock_minute', (1.0, 1.0)),
        Kind('clock_back', (1.0, 1.0), resets=True),
        # Late by more than the age from which a sensor counts as silent.
        Kind('late_data', (5.0, 10.0), _SILENT_M, 2.0),
        Kind('wheels_blocked', (3.0, 20.0)),
        Kind('use_sim_time', (1.0, 1.0)),
        # No motion was observed: only the scans contradict the map.
        Kind('carried_off', (1.0, 1.0), may_end_lost=True, wrong_s=_KIDNAPPED_S),
        Kind('reset_localizer', (1.0, 1.0), resets=True),
        Kind('forget_localizer', (0.5, 3.0), _POSE_M, node='localizer', may_end_lost=True),
    )
}


def random_faults(seed: int, only: Sequence[str] = ()) -> Iterator[Fault]:
    """Faults without end: of all kinds, or of the named ones; each kind once before any again."""
    rng = np.random.default_rng(seed)
    names = list(only or KINDS)
    number = 0
    while True:
        for index in rng.permutation(len(names)):
            kind = KINDS[names[int(index)]]
            gap_s = float(rng.uniform(*_GAP_S))
            duration_s = float(rng.uniform(*kind.seconds))
            yield Fault(number, kind, gap_s, duration_s, int(rng.integers(2**31)))
            number += 1
