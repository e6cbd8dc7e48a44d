"""A goal at an action server that may answer late, never, or refuse."""

from dataclasses import dataclass

from thinmap_ros.core.exploration.live.drive_progress import is_same_goal
from thinmap_ros.core.se2 import Array

_FIRST_ANSWER_S = 5.0
_LAST_ANSWER_S = 20.0
_MAX_UNANSWERED = 3
_MAX_REJECTED = 5
_REJECTED_PAUSE_S = 2.0


@dataclass
class DriveRequest:
    """Goal (3,) that the server was given at sent_s, and what it reported on it; times in s.

    answer_timeout_s: after which the request counts as lost; feedback_timeout_s: after which a
    server that has published feedback is silent. A server without any feedback is never silent.
    """

    goal: Array
    sent_s: float
    answer_timeout_s: float = _FIRST_ANSWER_S
    feedback_timeout_s: float = 3.0
    is_accepted: bool = False
    remaining_m: float | None = None
    _last_feedback_s: float | None = None

    def is_same(self, goal: Array) -> bool:
        """Whether another goal (3,) is so near that it need not be sent."""
        return is_same_goal(self.goal, goal)

    def add_feedback(self, remaining_m: float, now_s: float) -> None:
        """Register feedback; a remaining path of 0 m is not known."""
        self._last_feedback_s = now_s
        self.remaining_m = remaining_m if remaining_m > 0.0 else None

    def is_unanswered(self, now_s: float) -> bool:
        """Whether the server neither accepted nor rejected the goal in time."""
        return not self.is_accepted and now_s - self.sent_s >= self.answer_timeout_s

    def is_silent(self, now_s: float) -> bool:
        """Whether the server stopped reporting: it may have been restarted and lost the goal."""
        if self._last_feedback_s is None:
            return False
        return now_s - self._last_feedback_s >= self.feedback_timeout_s


@dataclass
class Retries:
    """How often a goal may be sent again to a server that rejects it or does not answer.

    Each time, the server has twice as long to answer.
    """

    _unanswered: int = 0
    _rejected: int = 0
    _not_before_s: float = 0.0

    @property
    def answer_timeout_s(self) -> float:
        """Time that the server has for its next answer, s."""
        return min(_FIRST_ANSWER_S * 2.0**self._unanswered, _LAST_ANSWER_S)

    def add_accepted(self) -> None:
        """Register an accepted goal."""
        self._unanswered = 0
        self._rejected = 0

    def add_unanswered(self) -> bool:
        """Register a goal without answer; returns whether it has to be given up."""
        self._unanswered = min(self._unanswered + 1, _MAX_UNANSWERED)
        return self._unanswered >= _MAX_UNANSWERED

    def add_rejected(self, now_s: float) -> bool:
        """Register a rejected goal; returns whether it has to be given up."""
        self._unanswered = 0
        self._rejected += 1
        self._not_before_s = now_s + _REJECTED_PAUSE_S
        if self._rejected < _MAX_REJECTED:
            return False
        self._rejected = 0
        return True

    def may_send(self, now_s: float) -> bool:
        """Whether the pause after a rejected goal is over; a clock that went back ends it."""
        return not 0.0 < self._not_before_s - now_s <= _REJECTED_PAUSE_S
