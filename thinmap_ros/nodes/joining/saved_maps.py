"""Saved maps beside those of robots: the services of slam_toolbox's map merging."""

from collections.abc import Callable

from thinmap_msgs.srv import AddSubmap, MergeMaps
from thinmap_ros.core.slam.joining.keyframe_messages import SentEdge
from thinmap_ros.core.slam.joining.robot_keyframes import RobotKeyframes
from thinmap_ros.core.slam.joining.slam_piece import SlamPiece
from thinmap_ros.core.slam.joining.team_map import RobotMap
from thinmap_ros.files.merging import read_piece
from thinmap_ros.files.sessions import stem_of
from thinmap_ros.ros.decoding.map_identity import new_map_id
from thinmap_ros.ros.lifecycle_node import ThinmapNode
from thinmap_ros.ros.save_directory import SaveDirectory
from thinmap_ros.ros.services import fill_response


class SavedMaps:
    """Services map_merging/add_submap, with a map of a file, and map_merging/merge_submaps."""

    def __init__(
        self,
        node: ThinmapNode,
        add: Callable[[str, RobotMap], None],
        merge: Callable[[], str],
    ) -> None:
        """add: takes a map, by name; merge: begins to merge, returns what is merged."""
        self._node = node
        self._directory = SaveDirectory(node)
        self._add = add
        self._merge = merge
        node.create_active_service(AddSubmap, 'map_merging/add_submap', self._on_add)
        node.create_active_service(MergeMaps, 'map_merging/merge_submaps', self._on_merge)

    def _on_add(
        self, request: AddSubmap.Request, response: AddSubmap.Response
    ) -> AddSubmap.Response:
        return fill_response(response, lambda: self._read(request.filename))

    def _on_merge(
        self, request: MergeMaps.Request, response: MergeMaps.Response
    ) -> MergeMaps.Response:
        return fill_response(response, self._merge)

    def _read(self, filename: str) -> str:
        path = self._directory.resolve(filename)
        piece = read_piece(path, self._node.get_logger().warning)
        name = f'/{stem_of(path).name}'
        self._add(name, RobotMap(piece.patch, piece.graph, _keyframes(piece)))
        return f'{name}: its place in the other maps is searched for'


def _keyframes(piece: SlamPiece) -> RobotKeyframes | None:
    if piece.is_rigid:
        return None
    edges = [SentEdge(edge.a, edge.b, edge.information) for edge in piece.edges]
    return RobotKeyframes(new_map_id(), list(piece.frames), edges)
