"""Arrays that grow by rows."""

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Rows:
    """Rows of an array; adding one takes constant time on average."""

    def __init__(self, *shape: int, dtype: DTypeLike = np.float64) -> None:
        """shape: of a row."""
        self._room: NDArray[Any] = np.zeros((8, *shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, row: object) -> None:
        """Add a row."""
        if self._count == len(self._room):
            self._room = np.concatenate([self._room, np.zeros_like(self._room)])
        self._room[self._count] = row
        self._count += 1

    @property
    def values(self) -> NDArray[Any]:
        """The rows (N, ...), which may be changed in place; a view until the next one is added."""
        return self._room[: self._count]
