"""What a page may ask for: one JSON object a message, checked before anything is done."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Any

from thinmap_ros.core.errors import InputError, quoted
from thinmap_ros.core.grid.edits import MAX_CORNERS
from thinmap_ros.core.se2 import MAX_COORDINATE_M
from thinmap_ros.core.topology.graph import MAX_ID
from thinmap_ros.core.topology.regions import checked_name

MAX_MESSAGE_BYTES = 16_384
_MAX_BEAT = 2**53  # what a page can count to
# Ages, there and back, beyond which a request no longer says what a person wants now: a hand on
# the joystick has moved on; who has clicked and seen nothing for two seconds clicks again, or walks
# up to the robot. What stops the robot is never too old.
_MAX_AGE_S = {
    'drive': 0.5,
    'goal': 2.0,
    'go_to_region': 2.0,
    'home': 2.0,
    'explore': 2.0,
    'resume': 2.0,
    'release': 2.0,
    'initial_pose': 2.0,
}
_NAME = re.compile(r'[A-Za-z0-9][A-Za-z0-9_-]{0,63}')


@dataclass(frozen=True)
class Request:
    """A request of a page.

    action: its name; values: its fields, each of the type and in the range that the action has;
    beat: the newest that the page had received, where it says one.
    """

    action: str
    values: dict[str, Any]
    beat: int | None = None

    @property
    def max_age_s(self) -> float:
        """Age until which it is done; a joystick that is let go is never too late."""
        is_zero = self.action == 'drive' and not any(self.values.values())
        return math.inf if is_zero else _MAX_AGE_S.get(self.action, math.inf)

    def require_recent(self) -> None:
        """Raise InputError where the page has asked too long ago, by the beat that it heard."""
        if self.beat is None:
            return  # `parse` refuses those that need one
        age_s = (beat() - self.beat) / 1000
        if self.max_age_s < math.inf and age_s < 0.0:
            raise InputError(f'{self.action}: beat {self.beat}: expected one that was sent')
        if age_s > self.max_age_s:
            raise InputError(
                f'{self.action}: the link is {age_s:.1f} s late: nothing is done: '
                f'expected at most {self.max_age_s:g} s'
            )


def beat() -> int:
    """Time of this machine, ms, that pages receive again and again, and send back."""
    return int(1000 * monotonic())


def _number(limit: float) -> Callable[[Any], float]:
    def check(value: Any) -> float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        # Compared first: a whole number of a thousand digits is no float.
        if not is_number or not -limit <= value <= limit:
            raise InputError(f'{quoted(value)}: expected a number from {-limit:g} to {limit:g}')
        return float(value)

    return check


def _identity(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_ID:
        raise InputError(f'{quoted(value)}: expected an id from 0 to {MAX_ID}')
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise InputError(f'{quoted(value)}: expected true or false')
    return value


def is_name(text: str) -> bool:
    """Whether a text is the name of a session that a page may ask for."""
    return _NAME.fullmatch(text) is not None


def _name(value: Any) -> str:
    if not isinstance(value, str) or not is_name(value):
        raise InputError(
            f'{quoted(value)}: expected a name of 1 to 64 letters, digits, _ and -, '
            'that begins with a letter or digit'
        )
    return value


def _words(value: Any) -> str:
    """The name of a region; empty: none."""
    if not isinstance(value, str):
        raise InputError(f'{quoted(value)}: expected a text')
    return checked_name(value)


def _limit(value: Any) -> list[tuple[float, float]]:
    """Corners of a polygon, m; none: no limit."""
    if not isinstance(value, list) or len(value) > MAX_CORNERS or len(value) in (1, 2):
        raise InputError(f'{quoted(value)}: expected no corner, or 3 to {MAX_CORNERS}')
    return _places(value)


def _line(value: Any) -> list[tuple[float, float]]:
    """Corners of a line or polygon, m."""
    if not isinstance(value, list) or not 2 <= len(value) <= MAX_CORNERS:
        raise InputError(f'{quoted(value)}: expected 2 to {MAX_CORNERS} corners')
    return _places(value)


def _places(value: list[Any]) -> list[tuple[float, float]]:
    for corner in value:
        if not isinstance(corner, list) or len(corner) != 2:
            raise InputError(f'{quoted(corner)}: expected a corner [x, y]')
    return [(_PLACE(x), _PLACE(y)) for x, y in value]


_PLACE = _number(MAX_COORDINATE_M)
_POSE = {'x': _PLACE, 'y': _PLACE, 'theta': _number(2.0 * math.pi)}
_ACTIONS: dict[str, dict[str, Callable[[Any], Any]]] = {
    'stop': {},
    # The number of the stop that the page shows.
    'release': {'stop': _identity},
    'goal': _POSE,
    'initial_pose': _POSE,
    'go_to_region': {'region': _identity},
    'name_region': {'region': _identity, 'name': _words},
    'explore': {'area': _limit, 'return_home': _flag},
    # A service checks whether the corners are enough for an area.
    'keep_out': {'corners': _line, 'is_wall': _flag},
    'remove_keep_out': {'area': _identity},
    'erase': {'corners': _line},
    'pause': {},
    'resume': {},
    'cancel': {},
    'home': {},
    # Shares of the top speeds.
    'drive': {'ahead': _number(1.0), 'left': _number(1.0)},
    'save': {'name': _name},
    'load': {'name': _name},
    'sessions': {},
    'merge': {'first': _name, 'second': _name},
    'merge_save': {'name': _name},
    'merge_drop': {},
}


def parse(text: str | bytes) -> Request:
    """Request of a message of a page.

    Raises InputError where it is not one JSON object with `action`, exactly its fields, and the
    beat: of what moves the robot, or lets it move, the age is known.
    """
    if len(text) > MAX_MESSAGE_BYTES:
        raise InputError(f'{len(text)} bytes: expected at most {MAX_MESSAGE_BYTES}')
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError('expected a message of JSON') from error
    if not isinstance(content, dict):
        raise InputError('expected a JSON object')
    action = content.pop('action', None)
    fields = _ACTIONS.get(action) if isinstance(action, str) else None
    if fields is None:
        raise InputError(f'action {quoted(action)}: expected one of {", ".join(_ACTIONS)}')
    heard = _beat(action, content.pop('beat')) if 'beat' in content else None
    if content.keys() != fields.keys():
        names = ', '.join(fields) or 'none'
        raise InputError(f'{action}: fields {quoted(sorted(content))}: expected {names}')
    values = {name: _checked(action, name, content[name]) for name in fields}
    request = Request(action, values, heard)
    if heard is None and request.max_age_s < math.inf:
        raise InputError(f'{action}: no beat: expected the newest that the page has received')
    return request


def _beat(action: str, value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _MAX_BEAT:
        raise InputError(f'{action}: beat: {quoted(value)}: expected a number of milliseconds')
    return value


def _checked(action: str, name: str, value: Any) -> Any:
    try:
        return _ACTIONS[action][name](value)
    except InputError as error:
        raise InputError(f'{action}: {name}: {error}') from error
