"""The newest diagnostics of each node as a table, the worst first."""

from collections.abc import Iterable
from time import monotonic
from typing import Any

from thinmap_ros.core.errors import one_line

_LEVELS = ('OK', 'WARN', 'ERROR', 'STALE')
_STALE = 3
_SILENT_S = 5.0
_MAX_ROWS = 100


class DiagnosticsTable:
    """Rows of level, name and message, by name; a node that is silent is stale."""

    def __init__(self) -> None:
        self._rows: dict[str, tuple[float, int, str]] = {}

    def update(self, statuses: Iterable[Any], now_s: float | None = None) -> None:
        """Replace the rows of some diagnostic_msgs/DiagnosticStatus; now_s: monotonic time, s."""
        now_s = monotonic() if now_s is None else now_s
        for status in statuses:
            name = one_line(status.name)
            if name in self._rows or len(self._rows) < _MAX_ROWS:
                level = min(_level(status.level), _STALE)
                self._rows[name] = (now_s, level, one_line(status.message))

    def rows(self, now_s: float | None = None) -> list[list[str]]:
        """Level, name and message of each row, the worst first; now_s: monotonic time, s."""
        now_s = monotonic() if now_s is None else now_s
        rows = [
            (_STALE, name, 'silent') if now_s - heard_s > _SILENT_S else (level, name, message)
            for name, (heard_s, level, message) in self._rows.items()
        ]
        rows.sort(key=lambda row: (-row[0], row[1]))
        return [[_LEVELS[level], name, message] for level, name, message in rows]


def _level(level: bytes | int) -> int:
    return level[0] if isinstance(level, bytes) else int(level)
