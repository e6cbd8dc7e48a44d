"""Whether the drives of an exploration have come to anything."""

from dataclasses import dataclass

from thinmap_ros.core.exploration.strategy import Decision, EndNode, FinishCode

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
    _target_id: int | None = None

    def follow(self, target: EndNode | None) -> None:
        """Register the target of a decision."""
        target_id = None if target is None else target.node_id
        self.has_settled |= self._target_id is not None and target_id != self._target_id
        self._target_id = target_id

    def add_result(self, is_success: bool, reason: str) -> None:
        """Register how the drive to the present target ended."""
        self.has_settled |= is_success
        if not is_success:
            self.failure = reason
            self._target_id = None

    def shortcoming(self, end: Decision, distance_m: float) -> str:
        """Why an exploration that leaves something has explored nothing; else empty.

        distance_m: travelled. A strategy that resolves all end nodes from the start needs no drive.
        """
        if end.code != FinishCode.UNREACHABLE:
            return ''
        if self.failure and not (self.has_settled and distance_m > _DRIVEN_M):
            return f'no target was reached: {self.failure}'
        return '' if distance_m > _DRIVEN_M else 'the robot has not driven'
