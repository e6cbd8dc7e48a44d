"""What an explorer that was killed and is started again continues with."""

from dataclasses import dataclass

import numpy as np

from thinmap_ros.core import snapshot
from thinmap_ros.core.snapshot import Field, State
from thinmap_ros.nodes.exploration.goal_monitor import PREFIX_BYTES

_ID_BYTES = 16
_STRATEGY = 'strategy_'
_IDS = {
    'goal_ids': Field(np.uint8, ('g', _ID_BYTES)),  # none, or one
    'drive_prefix': Field(np.uint8, (PREFIX_BYTES,)),
}


@dataclass(frozen=True, eq=False)
class ExplorerState:
    """State of the node.

    latest_ns: stamp of the last observation; 0 before the first. goal_id: of the action explore;
    empty without one. drive_prefix: of the goals at the navigator, as in `GoalMonitor`. mission: as
    `mission_state`; strategy: as `StrategySource.state`.
    """

    latest_ns: int
    goal_id: bytes
    drive_prefix: bytes
    mission: State
    strategy: State

    def arrays(self) -> State:
        """The state as arrays by name."""
        return {
            'latest_ns': np.array(self.latest_ns),
            'goal_ids': np.frombuffer(self.goal_id, dtype=np.uint8).reshape(-1, _ID_BYTES),
            'drive_prefix': np.frombuffer(self.drive_prefix, dtype=np.uint8),
            **self.mission,
            **{f'{_STRATEGY}{name}': array for name, array in self.strategy.items()},
        }

    @staticmethod
    def from_arrays(state: State) -> 'ExplorerState':
        """State of its `arrays`; those of mission and strategy are not checked.

        Raises InputError where the others are invalid.
        """
        latest_ns, rest = snapshot.split_number(state, 'latest_ns')
        own = {name: array for name, array in rest.items() if name in _IDS}
        ids = snapshot.validate(own, _IDS, 'explorer')
        goal_id = ids['goal_ids'][:1].tobytes()
        strategy = {
            name.removeprefix(_STRATEGY): array
            for name, array in rest.items()
            if name.startswith(_STRATEGY)
        }
        mission = {
            name: array
            for name, array in rest.items()
            if name not in _IDS and not name.startswith(_STRATEGY)
        }
        prefix = ids['drive_prefix'].tobytes()
        return ExplorerState(latest_ns, goal_id, prefix, mission, strategy)
