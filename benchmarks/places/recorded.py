"""A recorded piece of map: keyframes with true poses, edges, grid and graph, in a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.scan import Scan
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge
from thinmap_ros.core.slam.matching.surface import surface_points
from thinmap_ros.core.topology.graph import TopologicalMap, flat_topology, topology_from_msg

_GRAPH = 'graph_'


@dataclass(frozen=True, eq=False)
class RecordedPiece:
    """A piece of map, and the true poses (N, 3) of its keyframes; NaN where they are unknown."""

    name: str
    frames: list[Keyframe]
    edges: list[Edge]
    patch: GridPatch
    graph: TopologicalMap
    truth: Array

    @property
    def building(self) -> str:
        """Name of the building: that of the piece without its part."""
        return self.name.rpartition('.')[0]

    @property
    def poses(self) -> Array:
        """Poses (N, 3) of the keyframes."""
        return np.array([frame.T_map_base for frame in self.frames])

    def save(self, folder: Path) -> None:
        """Write FOLDER/NAME.npz."""
        arrays = {
            **_scan_arrays([frame.scan for frame in self.frames]),
            'poses': self.poses,
            'path_m': np.array([frame.path_m for frame in self.frames]),
            'truth': self.truth,
            'edge_ends': np.array([(edge.a, edge.b) for edge in self.edges]),
            'edge_poses': np.array([edge.T_a_b for edge in self.edges]),
            'edge_information': np.array([edge.information for edge in self.edges]),
            'edge_robust': np.array([edge.robust for edge in self.edges]),
            'cells': self.patch.cells,
            'frame': self.patch.frame.as_array(),
            **{_GRAPH + name: values for name, values in flat_topology(self.graph).items()},
        }
        folder.mkdir(parents=True, exist_ok=True)
        aside = folder / f'.{self.name}.npz'
        with aside.open('wb') as stream:
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        aside.rename(folder / f'{self.name}.npz')

    @staticmethod
    def load(folder: Path, name: str) -> 'RecordedPiece':
        """Read FOLDER/NAME.npz."""
        with np.load(folder / f'{name}.npz') as arrays:
            return _of(name, {key: arrays[key] for key in arrays.files})


def _of(name: str, arrays: dict[str, NDArray[Any]]) -> RecordedPiece:
    frames = [
        Keyframe(scan, surface_points(scan), T, float(path_m), np.zeros((3, 3)), 0)
        for scan, T, path_m in zip(_scans(arrays), arrays['poses'], arrays['path_m'], strict=True)
    ]
    edges = [
        Edge(int(a), int(b), T, information, bool(robust))
        for (a, b), T, information, robust in zip(
            arrays['edge_ends'],
            arrays['edge_poses'],
            arrays['edge_information'],
            arrays['edge_robust'],
            strict=True,
        )
    ]
    patch = GridPatch(GridFrame(*arrays['frame'].tolist()), arrays['cells'])
    flat = {
        key.removeprefix(_GRAPH): values for key, values in arrays.items() if key.startswith(_GRAPH)
    }
    graph = topology_from_msg(SimpleNamespace(**flat))
    return RecordedPiece(name, frames, edges, patch, graph, arrays['truth'])


def _scan_arrays(scans: Sequence[Scan]) -> dict[str, NDArray[Any]]:
    first = scans[0]
    limits = (first.angle_min_rad, first.angle_increment_rad, first.range_min_m, first.range_max_m)
    return {
        'stamps_ns': np.array([scan.stamp_ns for scan in scans]),
        'ranges_m': np.array([scan.ranges_m for scan in scans], dtype=np.float32),
        'T_base_laser': np.array([scan.T_base_laser for scan in scans]),
        'limits': np.array(limits),
    }


def _scans(arrays: dict[str, NDArray[Any]]) -> list[Scan]:
    first, step, low, high = arrays['limits'].tolist()
    return [
        Scan.create(int(stamp_ns), ranges_m, first, step, low, high, T_base_laser)
        for stamp_ns, ranges_m, T_base_laser in zip(
            arrays['stamps_ns'], arrays['ranges_m'], arrays['T_base_laser'], strict=True
        )
    ]
