"""Paper 2, Fig. 3 and 4: end, branch and corner nodes."""

import numpy as np

from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.graph import NodeKind, TopologicalMap, TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Rows, Table
from thinmap_ros.experiments.drives import CELL_M, Source, patch_at_rest
from thinmap_ros.view.plots import GraphLayer, MapLayer, Panel, Plot, Segments

# Free boxes, m: x, y, end x, end y.
_SHAPES = {
    '(a) end nodes': [(0.5, 2.0, 5.5, 3.2)],
    '(b) a branch node': [(0.5, 2.0, 5.5, 3.2), (2.4, 0.4, 3.6, 3.2)],
    '(c) a gentle bend, no corner node': [(0.5, 2.0, 3.2, 3.2), (2.8, 2.2, 5.5, 3.4)],
    '(d) a corner node': [(0.5, 3.0, 3.6, 4.2), (2.4, 0.4, 3.6, 4.2)],
}
_EXPECTED = {
    '(a) end nodes': (2, 0, 0),
    '(b) a branch node': (3, 1, 0),
    '(c) a gentle bend, no corner node': (2, 0, 0),
    '(d) a corner node': (2, 0, 1),
}


def run(source: Source) -> Outcome:
    """Build the graphs of four shapes and of the room."""
    rows: Rows = []
    panels = []
    for name, boxes in _SHAPES.items():
        patch = _patch(boxes)
        graph = build(patch, None, TopologyConfig())
        rows.append([name, *_counts(graph)])
        ends = [
            [*graph.nodes[edge.a].position, *graph.nodes[edge.b].position]
            for edge in graph.edges.values()
        ]
        lines = Segments(np.array(ends), 'straight lines between nodes', 'black', 0.8)
        panels.append(Panel([MapLayer(patch), GraphLayer(graph, 7.0), lines], name))
    room = patch_at_rest('room_10x10')
    graph = build(room, None, TopologyConfig())
    rows.append(['room_10x10', *_counts(graph)])
    right = all(tuple(row[1:]) == _EXPECTED[row[0]] for row in rows[: len(_SHAPES)])
    return Outcome(
        'Three kinds of nodes',
        'Exploration paper, section 2.2, Fig. 3 and 4',
        'A cell of the skeleton with one neighbour is an end node. A cell at which three or more '
        'edges meet is a branch node. '
        'A corner node is added if an obstacle blocks the straight line between two nodes.',
        [Table('nodes', ['shape', 'end', 'branch', 'corner'], rows)],
        [
            Plot(
                'fig3',
                'Paper 2, Fig. 3: nodes of four shapes.',
                panels,
                columns=2,
                panel_inches=(4.4, 3.6),
            ),
            Plot(
                'fig4',
                'Paper 2, Fig. 4: the three types of nodes in the room of 10 x 10 m.',
                [Panel([MapLayer(room), GraphLayer(graph, 7.0)])],
                panel_inches=(6.5, 6.5),
            ),
        ],
        [
            Comparison(
                'nodes of the four shapes',
                'as drawn in Fig. 3',
                'the same' if right else 'different',
                right,
            )
        ],
    )


def _patch(boxes: list[tuple[float, float, float, float]]) -> GridPatch:
    cells = np.full((46, 60), 100, dtype=np.int8)
    for box in boxes:
        x, y, end_x, end_y = (round(v / CELL_M) for v in box)
        cells[y:end_y, x:end_x] = 0
    return GridPatch(GridFrame(0.0, 0.0, CELL_M), cells)


def _counts(graph: TopologicalMap) -> tuple[int, int, int]:
    kinds = [node.kind for node in graph.nodes.values()]
    return kinds.count(NodeKind.END), kinds.count(NodeKind.BRANCH), kinds.count(NodeKind.CORNER)
