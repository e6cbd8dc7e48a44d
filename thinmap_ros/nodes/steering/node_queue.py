"""Work that other threads leave for the thread of the node."""

from collections import deque
from collections.abc import Callable

from thinmap_ros.core.errors import InputError
from thinmap_ros.ros.lifecycle_node import ThinmapNode


class NodeQueue:
    """Does in the node's thread, in turn, what other threads put."""

    def __init__(self, node: ThinmapNode, on_error: Callable[[str], None]) -> None:
        """on_error: receives the words of an InputError of some work."""
        self._on_error = on_error
        self._works: deque[Callable[[], None]] = deque()
        self._bell = node.create_guard_condition(self._work)

    def put(self, work: Callable[[], None]) -> None:
        """Have the node do something soon; from any thread."""
        self._works.append(work)
        self._bell.trigger()

    def _work(self) -> None:
        while self._works:
            try:
                self._works.popleft()()
            except InputError as error:
                self._on_error(str(error))
