"""What the pages show: named items, of which a page receives those that changed."""

import json
from threading import Lock
from typing import Any


class Board:
    """Items as JSON by name, each with the number of the change that it last underwent.

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
