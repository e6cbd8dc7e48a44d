"""Progress of a program on stderr: a bar on a terminal, a line now and then elsewhere."""

import sys
import time
from types import TracebackType
from typing import Any, TextIO

from tqdm import tqdm

_FIRST_LINE_S = 2.0
_LINE_PERIOD_S = 15.0
# The text takes the place of tqdm's unit.
_BAR = '{l_bar}{bar}| {unit} [{elapsed}<{remaining}]'
_BAR_WITHOUT_TOTAL = '{desc}: {unit} [{elapsed}]'


class ProgressBar:
    """Shows a share of the work, and a text; a context manager.

    On a terminal one line is rewritten. Elsewhere, as in a file, a line is written after two
    seconds and then every 15 s, so that a log stays short.
    """

    def __init__(self, name: str, quiet: bool = False, stream: TextIO | None = None) -> None:
        """name: of the work, for lines; quiet: show nothing."""
        self._name = name
        self._quiet = quiet
        self._stream = stream or sys.stderr
        self._bar: Any = None
        self._next_line_at = time.monotonic() + _FIRST_LINE_S
        self._is_terminal = self._stream.isatty()

    def __enter__(self) -> 'ProgressBar':
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the line on a terminal."""
        if self._bar is not None:
            self._bar.close()

    def show(self, share: float | None, text: str) -> None:
        """Show the share of the work that is done, 0 to 1, None if it is unknown."""
        if self._quiet:
            return
        if self._is_terminal:
            self._rewrite(share, text)
        elif time.monotonic() >= self._next_line_at:
            self._next_line_at = time.monotonic() + _LINE_PERIOD_S
            done = '' if share is None else f'{100.0 * min(share, 1.0):.0f} %, '
            print(f'{self._name}: {done}{text}', file=self._stream, flush=True)

    def write(self, text: str) -> None:
        """Write lines that stay, above the bar."""
        tqdm.write(text, file=self._stream)

    def _rewrite(self, share: float | None, text: str) -> None:
        form = _BAR_WITHOUT_TOTAL if share is None else _BAR
        bar: Any = self._bar
        if bar is None:
            bar = tqdm(
                total=100.0,
                desc=self._name,
                file=self._stream,
                dynamic_ncols=True,
                bar_format=form,
                unit=text,
            )
            self._bar = bar
        bar.bar_format = form
        bar.unit = text
        # Limited by tqdm to ten times a second.
        bar.update(0.0 if share is None else 100.0 * min(share, 1.0) - bar.n)
