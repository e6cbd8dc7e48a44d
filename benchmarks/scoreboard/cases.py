"""What can be on the scoreboard: logs, degraded logs, drives, and explorations."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from thinmap_ros.core.errors import InputError

# Options of degrade_log.py, by the name of what they do to a log.
DEGRADED = {
    'scale': ('--scale', '1.05'),
    'turn_noise_0.05': ('--turn-noise', '0.05'),
    'turn_noise_0.15': ('--turn-noise', '0.15'),
    'no_turn': ('--no-turn',),
    'no_odometry': ('--no-odometry',),
    'range_8m': ('--max-range', '8'),
    'half_blind': ('--blind', '0.5'),
    'slip': ('--slip', '0.4,1,0,0.5'),
    'gap': ('--gap', '0.4,20,20'),
    'gap_anew': ('--gap', '0.4,20,20', '--anew'),
}
THINNED = {'every_2': ('--every', '2'), 'every_5': ('--every', '5'), 'rate_1hz': ('--rate', '1')}
_THINNED_LOGS = ('intel', 'sena', 'mrpt_office')
# intel_raw is the drive of intel with 2.5 times the scans, and a quarter of the time of all logs
# together: intel has all degraded versions, this one those that more scans may help with or harm.
_DEGRADED_OF = {'intel_raw': ('turn_noise_0.15', 'no_odometry', 'slip')}
EXACT_S = 0.002  # of the logs in which a scan lies at each stamp of a relation
BUILDINGS = range(30)
ROBOTS = ('2dx', '3at')
NOISES = (1.0, 3.0)


@dataclass(frozen=True)
class _Case(ABC):
    """What all cases have; run: as in `repeated`."""

    run: int = field(default=0, kw_only=True)

    @property
    @abstractmethod
    def first(self) -> str:
        """Name of the run that is not disturbed."""

    @property
    def name(self) -> str:
        """What it is called on the page, and its file."""
        return f'{self.first}.run_{self.run}' if self.run else self.first


@dataclass(frozen=True)
class LogCase(_Case):
    """A log of a folder, perhaps degraded; exact_s: how near a pose must be to a relation's stamp.

    options: of degrade_log.py.
    """

    log: str
    version: str = ''
    options: tuple[str, ...] = ()
    exact_s: float = 0.1

    @property
    def first(self) -> str:
        """Name of the log, and of what was made worse."""
        return f'{self.log}.{self.version}' if self.version else self.log


@dataclass(frozen=True)
class BuildingCase(_Case):
    """A drive through a generated building; noise: times that of the robot's odometry."""

    seed: int
    robot: str
    noise: float

    @property
    def first(self) -> str:
        """Seed, robot and noise."""
        return f'building_{self.seed:03d}.{self.robot}_x{self.noise:g}'


@dataclass(frozen=True)
class DriveCase(_Case):
    """A recorded exploration of a world, replayed with the odometry noise of a seed."""

    world: str
    odometry_seed: int

    @property
    def first(self) -> str:
        """World and seed."""
        return f'drive_{flat(self.world)}.odometry_{self.odometry_seed}'


@dataclass(frozen=True)
class LoopCase(_Case):
    """An exploration of a world by the estimated pose; laser: a name of LASERS."""

    world: str
    seed: int
    laser: str = 'lms200'

    @property
    def first(self) -> str:
        """World, laser and seed."""
        return f'loop_{flat(self.world)}.{self.laser}_{self.seed}'


Case = LogCase | BuildingCase | DriveCase | LoopCase


def flat(world: str) -> str:
    """Name of a world as part of a file's name."""
    return world.replace('/', '_')


def all_cases(logs: Path) -> list[Case]:
    """All cases, the undegraded logs first; logs: a folder with NAME/log.clf or log.clf.gz.

    Raises InputError where there is no log.
    """
    names = sorted({path.parent.name for path in logs.glob('*/log.clf*')})
    if not names:
        raise InputError(f'{logs}: no NAME/log.clf in it: expected folders with logs')
    cases: list[Case] = [log_case(name) for name in names]
    for name in names:
        versions = _DEGRADED_OF.get(name, DEGRADED)
        cases += [log_case(name, version, DEGRADED[version]) for version in versions]
    thinned = [name for name in _THINNED_LOGS if name in names]
    cases += [log_case(name, *item) for name in thinned for item in THINNED.items()]
    cases += [
        BuildingCase(seed, robot, noise)
        for seed in BUILDINGS
        for robot in ROBOTS
        for noise in NOISES
    ]
    return cases


def repeated(cases: Iterable[Case], runs: int) -> list[Case]:
    """Each case so many times: all runs but the first (number 0) with odometry a little disturbed.

    A case in which small causes have large effects, as where a loop is found a scan later or not at
    all, is not told by a single run.
    """
    return [replace(case, run=run) for case in cases for run in range(runs)]


def log_case(name: str, version: str = '', options: tuple[str, ...] = ()) -> LogCase:
    """The case of a log, whose stamps are near enough to those of its relations."""
    exact = name.endswith('_raw') or (name == 'intel' and version == 'rate_1hz')
    return LogCase(name, version, options, EXACT_S if exact else 0.1)
