"""The pages that are open, and what they show."""

import asyncio
import json
from threading import Lock
from time import monotonic
from typing import Any, Protocol

from thinmap_ros.web.access import Gate, Role
from thinmap_ros.web.requests import Request, beat


class Board:
    """What the pages show: JSON by name, each with the number of the change that it last underwent.

    Filled by the node and read by the server, in threads of their own.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._change = 0
        self._items: dict[str, tuple[int, str]] = {}

    def put(self, name: str, value: Any) -> None:
        """Show a value; one that is shown already is not sent again."""
        text = json.dumps(value, separators=(',', ':'), allow_nan=False)
        with self._lock:
            if self._items.get(name, (0, ''))[1] != text:
                self._change += 1
                self._items[name] = (self._change, text)

    def keep(self, prefix: str, names: set[str]) -> None:
        """Remove all items whose names begin with a prefix, except those named.

        Pages that show them are not told: another item has to say what is there.
        """
        with self._lock:
            gone = [name for name in self._items if name.startswith(prefix) and name not in names]
            for name in gone:
                del self._items[name]

    def since(self, change: int) -> tuple[int, str]:
        """Items after a change (0: all), as a JSON list of [name, value], and the last change.

        '' where there is none.
        """
        with self._lock:
            newer = sorted(
                (number, name, text)
                for name, (number, text) in self._items.items()
                if number > change
            )
            last = self._change
        if not newer:
            return last, ''
        return last, '[' + ','.join(f'["{name}",{text}]' for _, name, text in newer) + ']'


PERIOD_S = 0.1
MAX_PAGES = 16  # of each role: who may only watch takes no place of those who steer
MAX_STRANGERS = 64  # sockets that have not said a token yet
_MAX_REQUESTS_PER_S = 50
_HELLO_S = 5.0
# A page that takes nothing for so long is gone.
_STUCK_S = 10.0


class Robot(Protocol):
    """What the server tells about the pages; called in its thread."""

    def requested(self, page: int, request: Request) -> None:
        """A page asks for something. Raises InputError where it cannot be done."""

    def page_closed(self, page: int) -> None:
        """A page is gone, with what it held."""


class PageState:
    """What is known of an open page; times are monotonic, s."""

    def __init__(self) -> None:
        self.number = 0
        self.role: Role | None = None
        self.change = 0
        self._opened_s = monotonic()
        self._second = 0
        self._requests = 0
        self._writing: asyncio.Future[None] | None = None
        self._since_s = 0.0

    def is_within_rate(self) -> bool:
        """Count a request: whether there are not too many in this second."""
        second = int(monotonic())
        if second != self._second:
            self._second = second
            self._requests = 0
        self._requests += 1
        return self._requests <= _MAX_REQUESTS_PER_S

    def sent(self, writing: 'asyncio.Future[None]') -> None:
        """Note what is being written."""
        self._writing = writing
        self._since_s = monotonic()

    def is_stuck(self) -> bool:
        """Whether the page has not taken what was last written."""
        return self._writing is not None and not self._writing.done()

    def is_overdue(self) -> bool:
        """Whether it is to be closed: it says no token, or takes nothing."""
        if self.role is None:
            return monotonic() - self._opened_s > _HELLO_S
        return monotonic() - self._since_s > _STUCK_S


class Pages:
    """The pages that are open, and what each of them has received."""

    def __init__(self, board: Board, gate: Gate, robot: Robot) -> None:
        self.board = board
        self.gate = gate
        self.robot = robot
        self.open: set[Any] = set()
        self._last = 0

    def has_place(self, role: Role) -> bool:
        """Whether another page of a role may be opened."""
        return sum(page.role is role for page in self.open) < MAX_PAGES

    def add(self, page: Any) -> None:
        """Open a page; of too many that have said no token, the oldest is closed.

        One that has a token says it at once, however many others come.
        """
        strangers = [other for other in self.open if other.role is None]
        if len(strangers) >= MAX_STRANGERS:
            min(strangers, key=lambda other: other.number).drop()
        self.open.add(page)

    def new_number(self) -> int:
        """Number of a page."""
        self._last += 1
        return self._last

    async def send_for_ever(self) -> None:
        """Send to each page, ten times a second, what has changed."""
        while True:
            await asyncio.sleep(PERIOD_S)
            self.board.put('beat', beat())
            encoded: dict[int, tuple[int, str]] = {}
            for page in list(self.open):
                page.send(encoded)


def role_of(message: str | bytes, gate: Gate) -> Role | None:
    """Role of a page by its first message, {"token": "..."}; a link may ask to watch only."""
    try:
        content = json.loads(message)
    except (ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or not isinstance(content.get('token'), str):
        return None
    role = gate.role(content['token'])
    is_modest = role is not None and content['token'] == Role.WATCH.value
    return Role.WATCH if is_modest else role
