"""A matplotlib figure that is saved the same each time, and that a notebook shows by itself."""

from io import BytesIO
from pathlib import Path
from typing import IO

from matplotlib.figure import Figure


class MapFigure(Figure):
    """A figure of a map."""

    def save(self, out: Path | IO[bytes]) -> None:
        """Save a PNG that depends on nothing else than the figure."""
        self.savefig(out, format='png', bbox_inches='tight', metadata={'Software': None})

    def png(self) -> bytes:
        """The PNG of `save`."""
        buffer = BytesIO()
        self.save(buffer)
        return buffer.getvalue()

    def _repr_png_(self) -> bytes:
        """Picture for notebooks, which show other figures only where a backend is set up."""
        return self.png()
