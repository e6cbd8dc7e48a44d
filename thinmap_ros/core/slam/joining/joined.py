"""One map of two pieces: one pose graph, one grid, one topological map whose ids continue."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from thinmap_ros.core import se2
from thinmap_ros.core.grid.correction import add_scan_outside
from thinmap_ros.core.grid.edits import Erasure
from thinmap_ros.core.grid.moved import MapMotion, overlaid
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.places.recognition import Placement
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.slam.graph.keyframes import Keyframe
from thinmap_ros.core.slam.graph.pose_graph import Edge, optimized
from thinmap_ros.core.slam.joining.links import match_keyframes, placed_keyframes
from thinmap_ros.core.slam.joining.pieces import SlamPiece
from thinmap_ros.core.slam.joining.rigid import found, rigid_links, rigid_transform
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import Ids, TopologyBuilder, join_topologies, moved_map

_ORIGIN = np.zeros((1, 3))


@dataclass(frozen=True, eq=False)
class JoinConfig:
    """Configurations of the joined grid and topological map."""

    grid: OccupancyConfig | None = None
    topology: TopologyConfig | None = None


@dataclass(frozen=True, eq=False)
class JoinedMap:
    """The map of two pieces, in the frame of the first.

    T_first_second (3,): frame of the second piece; ids: of the nodes of the second piece in the
    map, by their own; links: number of edges between keyframes of both; motions: how the places of
    the first and of the second piece have moved.
    """

    piece: SlamPiece
    grid: OccupancyGrid
    topology: TopologyBuilder
    T_first_second: Array
    ids: Ids
    links: int
    motions: tuple[MapMotion, MapMotion]


def join(
    first: SlamPiece, second: SlamPiece, placement: Placement, config: JoinConfig | None = None
) -> JoinedMap:
    """Join two pieces, given where the second lies in the first.

    If both have edges, all keyframes are optimized together, and the grid is rendered from their
    scans. Otherwise both stay rigid.
    """
    config = config or JoinConfig()
    is_rigid = first.is_rigid or second.is_rigid
    priors = list(placed_keyframes(second.frames, second.places.views, placement.hypothesis))
    if is_rigid:
        links = rigid_links(first, second, priors)
        return _joined_rigidly(first, second, placement.T_map_piece, links, config)
    links = found(match_keyframes(first.frames, second.frames, priors))
    return _optimized_together(first, second, placement.T_map_piece, links, config)


def _optimized_together(
    first: SlamPiece, second: SlamPiece, T: Array, links: Sequence[Edge], config: JoinConfig
) -> JoinedMap:
    count = len(first.frames)
    poses = np.vstack([first.poses, [se2.compose(T, own) for own in second.poses]])
    frames = _at([*first.frames, *second.frames], _bent(poses, first, second, links))
    # Again, where the other keyframes are now: those of the views alone left a third more error.
    nearby = enumerate(frame.T_map_base for frame in frames[count:])
    links = found(match_keyframes(frames[:count], frames[count:], nearby))
    poses = _bent(poses, first, second, links)
    frames = _at(frames, poses)
    motions = (MapMotion(first.poses, poses[:count]), MapMotion(second.poses, poses[count:]))
    erased = _erased(first, second, motions)
    grid = _rendered(frames, erased, OccupancyGrid(config.grid, first.patch.frame))
    patch = grid.known_area()
    topology, ids = join_topologies(
        patch,
        moved_map(first.graph, first.poses, poses[:count]),
        moved_map(second.graph, second.poses, poses[count:]),
        first.next_id,
        config.topology,
    )
    edges = _all_edges(first, second, links)
    piece = SlamPiece(frames, edges, patch, topology.map, topology.next_id, erased)
    nearest = links[0].b if links else 0
    T_joined = se2.compose(poses[count + nearest], se2.invert(second.poses[nearest]))
    return JoinedMap(piece, grid, topology, T_joined, ids, len(links), motions)


def _erased(
    first: SlamPiece, second: SlamPiece, motions: tuple[MapMotion, MapMotion]
) -> list[Erasure]:
    """Erased parts of both pieces, where they are now."""
    return [
        erasure.moved(motion.before, motion.after)
        for piece, motion in zip((first, second), motions, strict=True)
        for erasure in piece.erased
    ]


def _rendered(
    frames: Sequence[Keyframe], erased: Sequence[Erasure], grid: OccupancyGrid
) -> OccupancyGrid:
    """The grid with all scans, but for what was erased after they were made."""
    for frame in frames:
        later = [each.corners for each in erased if each.stamp_ns >= frame.scan.stamp_ns]
        add_scan_outside(grid, frame.scan, frame.T_map_base, later)
    return grid


def _all_edges(first: SlamPiece, second: SlamPiece, links: Sequence[Edge]) -> list[Edge]:
    """Edges of both pieces and between them; keyframes of the second count after the first."""
    count = len(first.frames)
    shifted = [replace(edge, a=edge.a + count, b=edge.b + count) for edge in second.edges]
    return [*first.edges, *shifted, *(replace(link, b=link.b + count) for link in links)]


def _bent(poses: Array, first: SlamPiece, second: SlamPiece, links: Sequence[Edge]) -> Array:
    """Poses (N, 3) of all keyframes after an optimization."""
    return optimized(poses, _all_edges(first, second, links))


def _at(frames: Sequence[Keyframe], poses: Array) -> list[Keyframe]:
    return [replace(frame, T_map_base=T) for frame, T in zip(frames, poses, strict=True)]


def _joined_rigidly(
    first: SlamPiece, second: SlamPiece, T: Array, links: Sequence[Edge], config: JoinConfig
) -> JoinedMap:
    T = rigid_transform(first, second, T, links)
    patch = overlaid(first.patch, second.patch, T)
    topology, ids = join_topologies(
        patch,
        moved_map(first.graph, _ORIGIN, _ORIGIN),
        moved_map(second.graph, _ORIGIN, T[None]),
        first.next_id,
        config.topology,
    )
    piece = SlamPiece.of_bare_map(patch, topology.map, topology.next_id)
    grid = OccupancyGrid.from_patch(patch, config.grid)
    motions = (MapMotion.rigid(np.zeros(3)), MapMotion.rigid(T))
    return JoinedMap(piece, grid, topology, T, ids, len(links), motions)
