"""One topological map of two maps of a place, whose grids have been joined: ids continue."""

from dataclasses import replace

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.builder import TopologyBuilder
from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.registry import MATCH_RADIUS_M

Ids = dict[int, int]


def join_topologies(
    patch: GridPatch,
    first: TopologicalMap,
    second: TopologicalMap,
    next_id: int,
    config: TopologyConfig | None = None,
) -> tuple[TopologyBuilder, Ids]:
    """Builder with the map of a joined grid, and the id of each node of the second map in it.

    first, second: with their nodes at their places in the joined grid; next_id: smallest number
    that no node or edge of the first map has had. Ids of the first map stay. A node of the second
    one within MATCH_RADIUS_M of one of the first takes its id, nearest pairs first; others,
    and all edges, get new ids. Nodes that the joined grid does not have are left out.
    """
    config = config or TopologyConfig()
    ids = _new_ids(first, second, next_id)
    nodes = [
        *first.nodes.values(),
        *(
            replace(node, id=ids[node.id])
            for node in second.nodes.values()
            if ids[node.id] not in first.nodes
        ),
    ]
    edges = [
        replace(edge, id=ids[edge.id], a=ids[edge.a], b=ids[edge.b])
        for edge in second.edges.values()
        if not {ids[edge.a], ids[edge.b]} <= first.nodes.keys()
    ]
    predecessor = TopologicalMap(nodes, [*first.edges.values(), *edges])
    after = max([next_id - 1, *ids.values()]) + 1
    builder = TopologyBuilder.continued(patch, predecessor, after, config)
    there = builder.map.nodes
    return builder, {own: ids[own] for own in second.nodes if ids[own] in there}


def _new_ids(first: TopologicalMap, second: TopologicalMap, next_id: int) -> Ids:
    """Ids of the nodes and edges of the second map in the joined one."""
    ids: Ids = {}
    pairs = []
    for node in second.nodes.values():
        for other in first.nodes_near(node.x, node.y, MATCH_RADIUS_M):
            away = (node.x - other.x) ** 2 + (node.y - other.y) ** 2
            if away <= MATCH_RADIUS_M**2:
                pairs.append((away, node.id, other.id))
    used: set[int] = set()
    for _, own, other_id in sorted(pairs):
        if own not in ids and other_id not in used:
            ids[own] = other_id
            used.add(other_id)
    for own in sorted([*second.nodes, *second.edges]):
        if own not in ids:
            ids[own] = next_id
            next_id += 1
    return ids
