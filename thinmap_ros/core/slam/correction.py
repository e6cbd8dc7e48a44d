"""What the optimization of the pose graph did to the keyframes."""

from dataclasses import dataclass

from thinmap_ros.core import se2
from thinmap_ros.core.se2 import Array


@dataclass(frozen=True, eq=False)
class Correction:
    """Poses (N, 3) of the keyframes before and after the pose graph was optimized."""

    before: Array
    after: Array

    def moved(self, k: int, T: Array) -> Array:
        """Where a pose (3,) that was found from keyframe k is now."""
        return se2.compose(self.after[k], se2.between(self.before[k], T))
