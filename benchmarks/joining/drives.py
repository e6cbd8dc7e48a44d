"""What robots send of their maps while they explore or drive around, each from its own origin."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.places.make import explored
from benchmarks.worlds import Floor
from thinmap_ros.closed_loop import ClosedLoop
from thinmap_ros.core import se2
from thinmap_ros.core.grid.occupancy import OccupancyGrid
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe, KeyframeConfig
from thinmap_ros.core.slam.joining.messages import KeyframeMessage, KeyframeSender, SentEdge
from thinmap_ros.core.slam.joining.pieces import ReceivedKeyframes, RobotKeyframes
from thinmap_ros.core.slam.localizer import Localizer
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.stage import Estimate
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.sim.drives import random_drive

_EACH_M = 10.0
_POSE_BYTES = 12  # three numbers of 32 bit
_STEP = np.diag([1.0 / 0.02**2, 1.0 / 0.02**2, 1.0 / 0.005**2])


@dataclass(frozen=True, eq=False)
class SentMap:
    """What others know of a robot's map after a path (m).

    truth (N, 3): true poses of its keyframes; keyframe_bytes: sent so far.
    """

    path_m: float
    patch: GridPatch
    graph: TopologicalMap
    keyframes: RobotKeyframes
    truth: Array
    keyframe_bytes: int


class _Radio:
    """Sends the keyframes of an exploration as bytes, and keeps what came each 10 m."""

    is_lost = False

    def __init__(self) -> None:
        self.sent: list[SentMap] = []
        self._sender: KeyframeSender | None = None
        self._received = ReceivedKeyframes()
        self._truth: dict[int, Array] = {}  # by the stamp of the scan
        self._told: list[Array] = []
        self._bytes = 0
        self._path_m = 0.0

    def intercepts(self, loop: ClosedLoop, scan: Scan, T_odom_base: Array) -> bool:
        """No scan."""
        return False

    def add_estimate(self, loop: ClosedLoop, scan: Scan, estimate: Estimate) -> None:
        """Send what is new."""
        poses = loop.log.true_poses
        self._truth[scan.stamp_ns] = poses[-1]
        if len(poses) > 1:
            self._path_m += float(np.hypot(*(poses[-1] - poses[-2])[:2]))
        localizer = loop.pipeline.localizer
        assert isinstance(localizer, Localizer) and localizer.published_graph is not None
        self._sender = self._sender or KeyframeSender(localizer.published_graph)
        self._send(self._sender)
        known = self._received.known()
        if known is not None and self._path_m >= _EACH_M * (len(self.sent) + 1):
            pipeline = loop.pipeline
            patch = pipeline.grid.known_area()
            truth = np.array(self._told[: len(known.frames)])
            self.sent.append(
                SentMap(self._path_m, patch, pipeline.topology.map, known, truth, self._bytes)
            )

    def _send(self, sender: KeyframeSender) -> None:
        poses = sender.corrected_poses()
        if poses is not None:
            self._bytes += _POSE_BYTES * len(poses)
            self._received.correct(1, sender.revision, poses)
        message = sender.next_message()
        if message is not None:
            data = message.encode()
            self._bytes += len(data)
            self._received.add(1, 1, KeyframeMessage.decode(data))
            if message.number == len(self._told):
                self._told.append(self._truth[message.scan.stamp_ns])


def explorations(floor: Floor, start: int, limit_s: float) -> list[SentMap]:
    """What a robot with SLAM has sent each 10 m of an exploration, for so many seconds."""
    radio = _Radio()
    explored(floor.world, floor.starts[start], start, limit_s, radio)
    return radio.sent


def random_drives(floor: Floor, start: int, seconds: float, each_m: float) -> Iterator[SentMap]:
    """What a robot with true poses has sent each so many m of a drive to random places."""
    T_start = floor.starts[start]
    grid = OccupancyGrid()
    frames: list[Keyframe] = []
    path_m = 0.0
    next_m = each_m
    last = T_start
    for sample in random_drive(floor.world, T_start, start):
        path_m += float(np.hypot(*(sample.T_world_base - last)[:2]))
        last = sample.T_world_base
        own = se2.between(T_start, last)
        grid.add_scan(sample.scan, own)
        if not frames or path_m - frames[-1].path_m >= KeyframeConfig.distance_m:
            points = surface_points(sample.scan)
            frames.append(Keyframe(sample.scan, points, own, path_m, np.zeros((3, 3)), submap=0))
        is_over = sample.scan.stamp_ns >= seconds * 1e9
        if path_m >= next_m or is_over:
            next_m += each_m
            edges = [SentEdge(k, k + 1, _STEP) for k in range(len(frames) - 1)]
            patch = grid.known_area()
            graph = build(patch, None, TopologyConfig())
            keyframes = RobotKeyframes(1, list(frames), edges)
            yield SentMap(path_m, patch, graph, keyframes, keyframes.poses, 0)
        if is_over:
            return
