"""The chain from scans to the graph: what its stages have in common, and what the first gives."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.estimate import Placement
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.snapshot import State

Input = TypeVar('Input', contravariant=True)
Output = TypeVar('Output', covariant=True)


class Stage(Protocol[Input, Output]):
    """A part of the chain, in one process with the others or in a node of its own."""

    def step(self, given: Input, /) -> Output | None:
        """Process the output of the stage before; None: nothing that the next stage needs."""

    def state(self) -> State:
        """The state as arrays by name."""

    def restore(self, state: State) -> None:
        """Continue from a state. Raises InputError, and changes nothing, if it is invalid."""

    def reset(self) -> None:
        """Begin again with an empty map."""


class Trajectory(NamedTuple):
    """A correction: the scans of these stamps (M,) were made at poses (M, 3).

    since_ns: stamp of the first scan whose pose is already correct.
    """

    stamps_ns: NDArray[np.int64]
    poses: Array
    since_ns: int


@dataclass(frozen=True, eq=False)
class LocalizedScan:
    """A scan, the pose T_map_base (3,) at which it was made, and where it belongs.

    trajectory: the correction that the pose follows, if it is new with this scan.
    """

    scan: Scan
    T_map_base: Array
    placement: Placement
    trajectory: Trajectory | None = None
