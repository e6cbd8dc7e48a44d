"""The joint map of several robots: how their maps bend, and what they show together."""

from collections.abc import Mapping
from dataclasses import dataclass

from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.joining.team import Bend, RobotMap, TeamGraph, TeamMap, merged
from thinmap_ros.core.topology.regions import RegionMap
from thinmap_ros.core.topology.segmentation import RegionTracker


@dataclass(frozen=True, eq=False)
class Merge:
    """A joint map, and how the maps of the robots bend in it."""

    merged: TeamMap
    regions: RegionMap
    bend: Bend


class JointMap:
    """Merges maps again and again; ids of nodes and regions stay."""

    def __init__(self) -> None:
        self.bend = Bend()
        self._merged: TeamMap | None = None
        self._graph = TeamGraph()
        self._regions = RegionTracker()

    def merge(self, maps: Mapping[str, RobotMap], places: Mapping[str, Array]) -> Merge:
        """Merge maps at their places (3,) in the world, bent where their keyframes are known."""
        known = {name: robot.keyframes for name, robot in maps.items() if robot.keyframes}
        bend = self._graph.bend(known, places)
        joint = merged(maps, places, self._merged, bend.poses)
        return Merge(joint, self._regions.update(joint.patch), bend)

    def take(self, merge: Merge) -> None:
        """Continue from a joint map, which is published."""
        self.bend = merge.bend
        self._merged = merge.merged

    def begin_ids_again(self) -> None:
        """Forget the ids of nodes: a map was separated."""
        self._merged = None
