"""One line on stderr that says how a robot is and what it does."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node

from thinmap_msgs.msg import ExplorationStatus
from thinmap_ros.ros import messages, parameters, qos
from thinmap_ros.ros.diagnostics import NAME_END, OK
from thinmap_ros.ros.time_jumps import STEADY
from thinmap_ros.view.progress_bar import ProgressBar

_PERIOD_S = 0.5


def doing(status: ExplorationStatus) -> str:
    """What a robot that explores does, in words; of an exploration that has ended, the reason."""
    if status.state != ExplorationStatus.EXPLORING:
        return str(status.reason)
    position = status.target_position
    return (
        f'to the end node at {position.x:.1f}, {position.y:.1f}'
        if status.has_target
        else 'looking around'
    )


def line_of(states: dict[str, DiagnosticStatus], exploration: ExplorationStatus | None) -> str:
    """The worst state of the nodes, and the progress of the exploration if there is one.

    states: by the name of the node.
    """
    worst = max(states, key=lambda name: states[name].level, default='')
    if not worst:
        said = 'waiting for the nodes'
    elif states[worst].level == OK:
        said = states['localizer'].message if 'localizer' in states else 'well'
    else:
        said = f'{worst}: {states[worst].message}'
    if exploration is None or exploration.state == ExplorationStatus.IDLE:
        return said
    elapsed_s = messages.seconds(exploration.elapsed)
    driven = (
        f'{exploration.known_area_m2:.0f} m2, {exploration.distance_m:.1f} m, {elapsed_s:.0f} s'
    )
    return f'{said}; {driven}: {doing(exploration)}'


class ProgressNode(Node):
    """Shows diagnostics and exploration_status of a robot."""

    def __init__(self) -> None:
        super().__init__('progress')
        parameters.reject_unknown(self)
        self._bar = ProgressBar('robot')
        self._states: dict[str, DiagnosticStatus] = {}
        self._exploration: ExplorationStatus | None = None
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, qos.STREAM)
        self.create_subscription(
            ExplorationStatus, 'exploration_status', self._on_exploration, qos.LATCHED
        )
        self.create_timer(_PERIOD_S, self._show, clock=STEADY)

    def close(self) -> None:
        """End the line."""
        self._bar.close()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        # Of the nodes of this robot, those of its namespace.
        beginning = self.get_namespace().strip('/')
        for status in message.status:
            place, _, name = status.name.removesuffix(NAME_END).rpartition('/')
            if status.name.endswith(NAME_END) and place.strip('/') == beginning:
                self._states[name] = status

    def _on_exploration(self, message: ExplorationStatus) -> None:
        self._exploration = message

    def _show(self) -> None:
        exploration = self._exploration
        is_exploring = exploration is not None and exploration.state == ExplorationStatus.EXPLORING
        share = exploration.coverage_estimate if exploration and is_exploring else None
        self._bar.show(share, line_of(self._states, exploration))
