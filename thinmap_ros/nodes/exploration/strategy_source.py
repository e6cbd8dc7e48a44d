"""Strategies of the node explorer: by its parameters, from a session, or of the last mission."""

from rclpy.node import Node

from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
from thinmap_ros.core.exploration.mission import Mission, MissionGoal
from thinmap_ros.core.exploration.strategy import Strategy
from thinmap_ros.core.snapshot import State
from thinmap_ros.files import sessions
from thinmap_ros.ros import parameters
from thinmap_ros.strategies import DEFAULT, NAMES, check_strategy, make_strategy


class StrategySource:
    """Makes the strategy that the node's parameters describe.

    A config that is changed at run time holds from the next mission on.
    """

    def __init__(self, node: Node) -> None:
        """Declare the parameters. Raises ConfigError where one is wrong."""
        self._name = str(
            parameters.declare_parameter(
                node,
                'strategy',
                DEFAULT,
                f'Exploration strategy: {", ".join(NAMES)}, or your own as package.module:factory, '
                'where factory() returns a Strategy. Parameters of end nodes and frontiers are '
                'those of position_probability and paper.',
            )
        )
        check_strategy(self._name)  # before kernels are compiled
        self._config = parameters.declare_config(node, ExplorerConfig, self._on_config)
        self._is_outdated = False

    @property
    def is_default(self) -> bool:
        """Whether the strategy is the project's own."""
        return self._name == DEFAULT

    @property
    def config(self) -> ExplorerConfig:
        """Parameters of the next new strategy."""
        return self._config

    def initial(self, session: str) -> Strategy:
        """Strategy to start with: of the session STEM where that has one, else new.

        Raises InputError where the session is broken.
        """
        self._is_outdated = False
        restored = None
        if session and self._name == DEFAULT:
            restored = sessions.EXPLORATION.load_optional(session, self._config)
        return restored or self._new()

    def next(self, last: Mission, goal: MissionGoal) -> Strategy:
        """Strategy for a goal: of the last mission where that was interrupted, else new."""
        if self._is_outdated or not last.is_resumed_by(goal):
            return self._new()
        return last.strategy

    def state(self, strategy: Strategy) -> State:
        """What a strategy has learned; empty where it cannot be saved."""
        if self._name == DEFAULT and isinstance(strategy, Explorer):
            return strategy.state()
        return {}

    def restored(self, state: State) -> Strategy:
        """Strategy that continues with a `state`, if there is one; else new.

        Raises InputError where the state is invalid.
        """
        if self._name == DEFAULT and state:
            return Explorer.from_state(state, self._config)
        return self._new()

    def save(self, path: str, strategy: Strategy, overwrite: bool) -> str:
        """Save what a strategy has learned, if it can be saved; returns what was done.

        Raises as `SessionPart.save`.
        """
        if self._name == DEFAULT and isinstance(strategy, Explorer):
            return f'saved {sessions.EXPLORATION.save(path, strategy, overwrite)}'
        archived = sessions.EXPLORATION.archive(path)
        nothing = f'strategy {self._name} has nothing to save'
        return f'{nothing}; {archived}' if archived else nothing

    def _new(self) -> Strategy:
        self._is_outdated = False
        return make_strategy(self._name, self._config)

    def _on_config(self, config: ExplorerConfig) -> None:
        self._config = config
        self._is_outdated = True
