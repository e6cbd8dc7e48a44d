"""What robots of a team send each other: messages that may be late or lost, and their bytes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

Message = TypeVar('Message')


@dataclass(frozen=True)
class Trouble:
    """What goes wrong between robots, which have numbers from 0.

    claim_delay_s: time that a claim takes; loss: share of messages that do not arrive;
    out_of_reach: robot, time and duration, s, in which it neither sends nor receives; dead: robot
    and time, s, from which it stands and is silent.
    """

    claim_delay_s: float = 0.0
    loss: float = 0.0
    out_of_reach: tuple[int, float, float] | None = None
    dead: tuple[int, float] | None = None

    def is_dead(self, robot: int, now_s: float) -> bool:
        """Whether a robot stands and is silent, for good."""
        return self.dead is not None and robot == self.dead[0] and now_s >= self.dead[1]

    def is_silent(self, robot: int, now_s: float) -> bool:
        """Whether a robot neither sends nor receives."""
        if self.is_dead(robot, now_s):
            return True
        if self.out_of_reach is None:
            return False
        silent, began_s, duration_s = self.out_of_reach
        return robot == silent and began_s <= now_s < began_s + duration_s


class Radio(Generic[Message]):
    """Broadcasts messages of one kind to all other robots, and counts their bytes once each."""

    def __init__(self, robots: int, trouble: Trouble, delay_s: float, seed: int) -> None:
        self.sent_bytes = 0
        self._robots = robots
        self._trouble = trouble
        self._delay_s = delay_s
        self._rng = np.random.default_rng(seed)
        self._pending: list[tuple[float, int, Message]] = []

    def broadcast(self, sender: int, message: Message, size: int, now_s: float) -> None:
        """Send a message of a size, bytes; a silent robot sends nothing."""
        if self._trouble.is_silent(sender, now_s):
            return
        self.sent_bytes += size
        self._pending.append((now_s + self._delay_s, sender, message))

    def received(self, now_s: float) -> Iterator[tuple[int, Message]]:
        """Receiver and message of all that arrive now, each once."""
        due = [entry for entry in self._pending if entry[0] <= now_s]
        self._pending = [entry for entry in self._pending if entry[0] > now_s]
        for _, sender, message in due:
            for receiver in range(self._robots):
                is_heard = receiver != sender and not self._trouble.is_silent(receiver, now_s)
                if is_heard and not self._is_lost():
                    yield receiver, message

    def _is_lost(self) -> bool:
        return self._trouble.loss > 0.0 and float(self._rng.random()) < self._trouble.loss
