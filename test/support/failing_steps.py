"""All nodes in one process, in each of which some steps of the core fail."""

from collections.abc import Callable
from typing import Any

from thinmap_ros.core.exploration.mission import Mission
from thinmap_ros.core.grid.mapper import Mapper
from thinmap_ros.core.planning.navigator import Navigator
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.topology.topology import Topology
from thinmap_ros.nodes import thinmap
from thinmap_ros.ros.lifecycle_node import ThinmapNode

FAILING = 3  # steps of each


def plant(kind: type, first: int, is_failing: Callable[[Any], bool] = lambda result: True) -> None:
    """Make steps fail after their work, from one number on, where their results are such."""
    work = kind.step
    steps = 0
    failed = 0

    def step(*arguments: Any) -> Any:
        nonlocal steps, failed
        steps += 1
        result = work(*arguments)
        if steps >= first and failed < FAILING and is_failing(result):
            failed += 1
            raise ZeroDivisionError('planted')
        return result

    kind.step = step


def plant_all(start: Callable[[ThinmapNode], None]) -> Callable[[ThinmapNode], None]:
    """Have the steps fail once a node starts: those of its warm-up do not."""

    def planted(node: ThinmapNode) -> None:
        if node.program == 'localizer':
            plant(Localizer, 10)
            plant(Mapper, 20)
            plant(Topology, 30)
            plant(Mission, 3)
            plant(Navigator, 1, lambda command: command.v > 0.15)
        start(node)

    return planted


if __name__ == '__main__':
    ThinmapNode.start = plant_all(ThinmapNode.start)  # type: ignore[method-assign]
    thinmap.main()
