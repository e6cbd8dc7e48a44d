"""Kinds of faults, of kinds.csv, and a random sequence of them from a seed."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.rows import read_cases

KILL = 'kill'
STOP = 'stop'
_FORGET = 'forget'
_GAP_S = (10.0, 30.0)


@dataclass(frozen=True)
class Kind:
    """A kind of fault.

    node: that is killed or stopped. shortest_s, longest_s: of its duration (simulated). stop_m: how
    far the robot may drive while it lasts: a stop takes 0.3 m, and the navigator drives for 3 s
    without a pose. stand_s: after this time, all commands must be zero. wrong_s: how long a wrong
    pose may last without a report. resets: nodes discard their state, as documented, so that all of
    them are started again afterwards. may_end_lost: the robot need not drive again, as long as it
    says that its pose is unknown.
    """

    name: str
    node: str = ''
    shortest_s: float = 1.0
    longest_s: float = 1.0
    stop_m: float = math.inf
    stand_s: float = math.inf
    wrong_s: float = 3.0
    resets: bool = False
    may_end_lost: bool = False

    @property
    def signal(self) -> str:
        """KILL or STOP for a process that is killed or stopped, else ''."""
        word = self.name.partition('_')[0]
        return word if word in (KILL, STOP) else ''

    @property
    def forgets(self) -> bool:
        """Whether a node is killed, and its checkpoint is removed before it is started again."""
        return self.name.startswith(_FORGET)

    @property
    def is_killed(self) -> bool:
        """Whether a node is killed."""
        return self.signal == KILL or self.forgets


@dataclass(frozen=True)
class Fault:
    """A fault: after gap_s of undisturbed driving, for duration_s (simulated); seed: of details."""

    number: int
    kind: Kind
    gap_s: float
    duration_s: float
    seed: int


KINDS = {kind.name: kind for kind in read_cases(Path(__file__).with_name('kinds.csv'), Kind)}


def random_faults(seed: int, only: Sequence[str] = ()) -> Iterator[Fault]:
    """Faults without end: of all kinds, or of the named ones; each kind once before any again."""
    rng = np.random.default_rng(seed)
    names = list(only or KINDS)
    number = 0
    while True:
        for index in rng.permutation(len(names)):
            kind = KINDS[names[int(index)]]
            gap_s = float(rng.uniform(*_GAP_S))
            duration_s = float(rng.uniform(kind.shortest_s, kind.longest_s))
            yield Fault(number, kind, gap_s, duration_s, int(rng.integers(2**31)))
            number += 1
