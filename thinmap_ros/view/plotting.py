"""Pictures for notebooks and programs: of a pipeline, or of a map with a graph."""

from typing import TYPE_CHECKING, Any

from thinmap_ros.core.errors import InputError, require_type
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.view.summary import make_figure

if TYPE_CHECKING:
    from thinmap_ros.view.map_figure import MapFigure


def plot(shown: Any, topology: TopologicalMap | None = None, title: str = '') -> 'MapFigure':
    """A matplotlib figure of a Pipeline, with its graph and path, or of a GridPatch with a graph.

    `figure.savefig(path)` saves it; a notebook shows it. Raises InputError for anything else.
    """
    if topology is not None:
        require_type('topology', topology, TopologicalMap)
    if isinstance(shown, GridPatch):
        return make_figure(shown, topology or TopologicalMap(), title=title)
    if not (hasattr(shown, 'grid') and hasattr(shown, 'localizer')):
        raise InputError(f'plot: a {type(shown).__name__}: expected a Pipeline or a GridPatch')
    _, path = shown.localizer.keyframe_trajectory()
    graph = topology or shown.topology.map
    return make_figure(shown.grid.known_area(), graph, path, title=title)
