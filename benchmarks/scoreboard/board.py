"""The cases of the board, and what is asked of logs."""

from pathlib import Path

from benchmarks.scoreboard.cases import (
    BUILDINGS,
    ROBOTS,
    BuildingCase,
    Case,
    DriveCase,
    LogCase,
    LoopCase,
    all_cases,
    repeated,
)

LARGEST = 'kth/50037764_PLAN1'
KTH = ('kth/50052748', 'kth/50052749', 'kth/50052751', LARGEST)
WORLDS = (*KTH, 'dungeon/d1573', 'dungeon/d114')
_ODOMETRY_SEEDS = (1, 2, 3, 4)
_LOOP_SEEDS = (1, 3)
OTHER_LASERS = ('turtlebot3', 'rplidar_a1')
_OTHER_WORLDS = ('office', 'lab', 'kth/50052751')
RUNS = 5
# Asked of the mean error of a log's relations, live, m.
ASKED_OF_LOGS = {
    'intel': 0.046,
    'intel_sparse': 0.057,
    'intel_raw': 0.022,
    'csail': 0.036,
    'csail_raw': 0.029,
    'aces_raw': 0.043,
}
ASKED_OF_REPEATED = {'fhw': 0.058, 'aces': 0.052}
ASKED_OF_DEGRADED = {
    'aces_raw.turn_noise_0.15': 0.06,
    'fhw.half_blind': 0.08,
    'csail_raw.no_odometry': 0.03,
    'intel_raw.slip': 0.03,
    'intel_raw.no_odometry': 0.05,
    'intel.range_8m': 0.05,
    'aces.range_8m': 0.10,
}


def board_cases(logs: Path) -> list[Case]:
    """All cases of the board, those that take longest first.

    logs: a folder with NAME/log.clf or log.clf.gz; those that are missing are left out.
    Raises InputError where there is no log.
    """
    cases: list[Case] = [LoopCase(world, seed) for world in KTH for seed in _LOOP_SEEDS]
    cases += [LoopCase(_OTHER_WORLDS[-1], _LOOP_SEEDS[0], laser) for laser in OTHER_LASERS]
    known = {case.name: case for case in all_cases(logs) if isinstance(case, LogCase)}
    names = ('intel_raw.no_odometry', 'intel_raw.slip', *ASKED_OF_LOGS, *ASKED_OF_DEGRADED)
    cases += [known[name] for name in dict.fromkeys(names) if name in known]
    again = [known[name] for name in ASKED_OF_REPEATED if name in known]
    cases += repeated(again, RUNS)
    cases += [DriveCase(world, seed) for world in WORLDS for seed in _ODOMETRY_SEEDS]
    cases += [LoopCase(world, seed) for world in WORLDS[len(KTH) :] for seed in _LOOP_SEEDS]
    cases += [BuildingCase(seed, robot, 1.0) for seed in BUILDINGS for robot in ROBOTS]
    cases += [
        LoopCase(world, _LOOP_SEEDS[0], laser)
        for world in _OTHER_WORLDS[:-1]
        for laser in OTHER_LASERS
    ]
    return cases
