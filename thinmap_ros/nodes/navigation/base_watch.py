"""Whether the base moves as commanded."""

from thinmap_ros.core.planning.navigator import NavigatorConfig
from thinmap_ros.core.planning.supervision import BaseSupervisor
from thinmap_ros.core.se2 import Array
from thinmap_ros.ros import parameters, velocity
from thinmap_ros.ros.diagnostics import ERROR
from thinmap_ros.ros.lifecycle_node import ThinmapNode

_RELEASE = 'no goal is driven before ~/reset, or a stop that is released'


class BaseWatch:
    """Compares commands and odometry; reports at level ERROR what is wrong.

    Where others publish cmd_vel too, or nobody hears it, any motion is allowed.
    """

    def __init__(self, node: ThinmapNode, config: NavigatorConfig) -> None:
        """Declare the parameter `base_velocity_topic`."""
        self._node = node
        self._supervisor = BaseSupervisor(config)
        topic = parameters.declare_parameter(
            node,
            'base_velocity_topic',
            '',
            'Topic of the commands that the base obeys, where a multiplexer (twist_mux) is between '
            'navigator and base: its output. The motion of the robot is compared with them. Empty: '
            'the base obeys this node.',
        )
        self._own_topic = node.resolve_topic_name(velocity.TOPIC)
        self._is_behind = bool(topic)
        if topic:
            velocity.VelocitySubscription(node, node.diagnostics, self._add_command, str(topic))
        node.diagnostics.add_check(ERROR, lambda: self.fault)

    @property
    def fault(self) -> str:
        """Why no goal may be driven; '' for no reason."""
        fault = self._supervisor.fault
        return f'{fault}: {_RELEASE}' if self._supervisor.is_fast else fault

    @property
    def is_creeping(self) -> bool:
        """Whether the robot moves though it is to stand."""
        return self._supervisor.is_creeping

    def set_config(self, config: NavigatorConfig) -> None:
        """Continue with other limits."""
        self._supervisor.set_config(config)

    def release(self) -> None:
        """Drive goals again."""
        self._supervisor.release()

    def add_sent(self, v: float, w: float) -> None:
        """Add a command of this node, m/s and rad/s."""
        if not self._is_behind:
            self._add_command(v, w)

    def add_odometry(self, stamp_ns: int, T_odom_base: Array) -> None:
        """Add a sample of the odometry, T_odom_base (3,)."""
        now_s = self._node.elapsed_time.now_s()
        self._supervisor.set_unheard(now_s, not (self._is_behind or self.is_obeyed))
        self._supervisor.add_odometry(now_s, stamp_ns, T_odom_base)

    @property
    def subscribers(self) -> int:
        """Number of subscriptions of cmd_vel."""
        return int(self._node.count_subscribers(self._own_topic))

    @property
    def is_obeyed(self) -> bool:
        """Whether somebody hears cmd_vel, and nobody else publishes it."""
        return self.subscribers > 0 and int(self._node.count_publishers(self._own_topic)) == 1

    def _add_command(self, v: float, w: float) -> None:
        self._supervisor.add_command(self._node.elapsed_time.now_s(), v, w)
