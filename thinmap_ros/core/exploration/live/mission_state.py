"""A mission as arrays, without its strategy: for an explorer that is killed and started again."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core import snapshot
from thinmap_ros.core.exploration.mission import (
    Budget,
    Finish,
    InputWatchdog,
    Mission,
    MissionGoal,
    MissionState,
)
from thinmap_ros.core.exploration.strategy import FinishCode, Strategy
from thinmap_ros.core.snapshot import MAX_COORDINATE_M, MAX_COUNT, Field

FIELDS = {
    'budget': Field(np.float64, (3,), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'area': Field(np.float64, ('n', 2), -MAX_COORDINATE_M, MAX_COORDINATE_M),
    'return_to_start': Field(np.bool_),
    'phase': Field(np.int64, (), min(MissionState), max(MissionState)),
    'end_code': Field(np.int64, (), min(FinishCode), max(FinishCode)),
    'end_reason': Field(np.uint8, ('t',)),  # UTF-8
    'elapsed_s': Field(np.float64, (), 0.0, MAX_COUNT),
    'start': Field(np.float64, ('s', 3), -MAX_COORDINATE_M, MAX_COORDINATE_M),  # none, or one
    'distance_m': Field(np.float64, (), 0.0, MAX_COUNT),
    'is_paused': Field(np.bool_),
    'has_returned': Field(np.bool_),
    'has_explored': Field(np.bool_),
    'has_settled': Field(np.bool_),
}


def mission_state(mission: Mission, now_s: float) -> dict[str, NDArray[Any]]:
    """Goal and progress of a mission as arrays by name; `resumed_mission` continues it."""
    budget = mission.goal.budget
    start = mission.odometer.start
    return {
        'budget': np.array([budget.time_s, budget.distance_m, budget.area_m2]),
        'area': mission.goal.area.reshape(-1, 2),
        'return_to_start': np.array(mission.goal.return_to_start),
        'phase': np.array(int(mission.state)),
        'end_code': np.array(int(mission.end.code)),
        'end_reason': np.frombuffer(mission.end.reason.encode(), dtype=np.uint8),
        'elapsed_s': np.array(max(mission.elapsed_s(now_s), 0.0)),
        'start': np.empty((0, 3)) if start is None else start.reshape(1, 3),
        'distance_m': np.array(mission.odometer.distance_m),
        'is_paused': np.array(mission.is_paused),
        'has_returned': np.array(mission.has_returned),
        'has_explored': np.array(mission.end.has_explored),
        'has_settled': np.array(mission.drives.has_settled),
    }


def resumed_mission(
    state: Mapping[str, NDArray[Any]], strategy: Strategy, watchdog: InputWatchdog, now_s: float
) -> Mission:
    """Mission that continues another's `mission_state`, with a strategy.

    Raises InputError where it is no such state.
    """
    own = snapshot.validate(state, FIELDS, 'mission')
    goal = MissionGoal(Budget(*own['budget'].tolist()), own['area'], bool(own['return_to_start']))
    phase = MissionState(int(own['phase']))
    mission = Mission(goal, strategy, watchdog, now_s, phase, float(own['elapsed_s']))
    reason = own['end_reason'].tobytes().decode(errors='replace')
    has_explored = bool(own['has_explored'])
    mission.end = Finish(FinishCode(int(own['end_code'])), reason, has_explored)
    mission.drives.has_settled = bool(own['has_settled'])
    mission.odometer.start = own['start'][0] if len(own['start']) else None
    mission.odometer.distance_m = float(own['distance_m'])
    mission.is_paused = bool(own['is_paused'])
    mission.has_returned = bool(own['has_returned'])
    return mission
