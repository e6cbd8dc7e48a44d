"""Whether the drives of an exploration have come to anything."""

from dataclasses import dataclass

from thinmap_ros.core.exploration.live.drive_progress import is_same_goal
from thinmap_ros.core.exploration.strategy import Decision, EndNode, FinishCode, Strategy
from thinmap_ros.core.se2 import Array

_MAX_ARRIVALS = 6
STAYS = 'reached, but the target stays'
# Within the distance at which a goal counts as reached: turns in place, and corrections of a pose.
_DRIVEN_M = 0.3


@dataclass
class Drives:
    """What came of the drives so far.

    has_settled: whether a target was reached, or was none any more before the robot was there;
    failure: why the last drive failed.
    """

    has_settled: bool = False
    failure: str = ''
    _target: EndNode | None = None
    _arrivals: int = 0

    def follow(self, target: EndNode | None, strategy: Strategy) -> Array | None:
        """Goal (3,) to drive to for the target of a strategy's decision; None: nowhere.

        A target that is where it was although the robot has arrived there again and again has
        failed: the strategy does not see it as reached.
        """
        last = self._target
        self._target = target
        self.has_settled |= last is not None and (target is None or target.node_id != last.node_id)
        if target is None:
            return None
        if last is None or not is_same_goal(target.goal, last.goal):
            self._arrivals = 0
        if self._arrivals < _MAX_ARRIVALS:
            return target.goal
        self.add_result(False, STAYS)
        strategy.target_failed(STAYS)
        return None

    def add_result(self, is_success: bool, reason: str) -> None:
        """Register how the drive to the present target ended."""
        self.has_settled |= is_success
        self._arrivals += is_success
        if not is_success:
            self.failure = reason
            self._target = None

    def shortcoming(self, end: Decision, distance_m: float) -> str:
        """Why an exploration that leaves something has explored nothing; else empty.

        distance_m: travelled. A strategy that resolves all end nodes from the start needs no drive.
        """
        if end.code != FinishCode.UNREACHABLE:
            return ''
        if self.failure and not (self.has_settled and distance_m > _DRIVEN_M):
            return f'no target was reached: {self.failure}'
        return '' if distance_m > _DRIVEN_M else 'the robot has not driven'
