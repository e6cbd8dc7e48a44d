"""The graph of a saved map, reduced for a route server.

A robot that maps needs every node: each is an event of its exploration. A route server needs few
nodes, straight edges, and a node in sight of each place. The reduced graph has

- no branch into rays that passed through glass;
- one path, the wider one, round an obstacle smaller than `detail_m`;
- one node for several that are nearer to each other than `node_spacing_m`, and none on a straight
  line;
- no two edges along one straight line, and no node without an edge.
"""

import numpy as np
from numpy.typing import NDArray

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.free_space import known_free
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.routes.editing import EditedGraph
from thinmap_ros.core.topology.routes.lines import give_edges, split_parallels
from thinmap_ros.core.topology.routes.nodes import merge_nodes, show_places
from thinmap_ros.core.topology.routes.rays import drop_rays
from thinmap_ros.core.topology.routes.rings import open_rings
from thinmap_ros.core.topology.routes.sight import Sight

DETAIL_M = 1.2  # a small table; nodes are as far apart, unless another spacing is given
MIN_NODE_SPACING_M = 0.05  # a cell of most maps


def route_graph(
    topology: TopologicalMap,
    patch: GridPatch,
    standing: NDArray[np.bool_],
    config: TopologyConfig,
    detail_m: float = DETAIL_M,
    node_spacing_m: float | None = None,
) -> TopologicalMap:
    """The reduced graph of a map; the given one is not changed.

    standing (H, W): cells of the patch that a robot can traverse. Each edge that is changed is a
    straight line over such cells. detail_m: smaller obstacles are passed on one side only.
    node_spacing_m: nodes nearer to each other than this, or than the clearance of one of them, are
    one where places see it as well; None: detail_m.
    """
    known = known_free(patch, config)
    graph = EditedGraph(topology.copy(), patch.frame, standing, known)
    drop_rays(graph, patch)
    open_rings(graph, known, detail_m)
    sight = Sight(patch.frame, standing, known, graph.map.nodes.values())
    merge_nodes(graph, sight, detail_m if node_spacing_m is None else node_spacing_m, detail_m)
    show_places(graph, sight)
    split_parallels(graph)
    give_edges(graph)
    return graph.with_kinds()
