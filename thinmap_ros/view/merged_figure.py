"""Picture of maps, and of the map that they were merged into."""

from collections.abc import Sequence
from pathlib import Path

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.files.safe import atomic_write
from thinmap_ros.view.figures import DPI, draw_graph, draw_map

_PANEL_IN = 5.0
_NODE_PT = 2.5


def merged_figure(path: Path, maps: Sequence[tuple[str, GridPatch, TopologicalMap]]) -> None:
    """Write a PNG: maps side by side, each with a title and its topological map."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (_PANEL_IN * len(maps), _PANEL_IN)
    figure = Figure(figsize=size, dpi=DPI, layout='constrained')
    FigureCanvasAgg(figure)
    for number, (title, patch, topology) in enumerate(maps, 1):
        axes = figure.add_subplot(1, len(maps), number)
        draw_map(axes, patch)
        draw_graph(axes, topology, _NODE_PT)
        axes.set(xlabel='x (m)', ylabel='y (m)', aspect='equal')
        axes.set_title(title, parse_math=False)
    with atomic_write(path) as aside:
        figure.savefig(aside, format='png', metadata={'Software': None})
