"""2D laser SLAM, topological maps by thinning, and exploration for robots with one laser.

The names of `__all__` are the public Python interface; other modules may change without notice.
Each name is imported when it is first used: `import thinmap_ros` loads no library and needs no ROS.
It changes nothing in the process.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers and editors, from the places in _PLACES
    from thinmap_ros.closed_loop.robot import Options as ExplorationOptions
    from thinmap_ros.core.ekf_slam.ekf_localizer import EkfConfig
    from thinmap_ros.core.errors import ConfigError, InputError, ThinmapError
    from thinmap_ros.core.exploration.explorer import Explorer, ExplorerConfig
    from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
    from thinmap_ros.core.grid.patch import GridFrame, GridPatch
    from thinmap_ros.core.places.global_localizer import GlobalLocalization as GlobalLocalizer
    from thinmap_ros.core.places.place_database import GlobalLocalizationConfig
    from thinmap_ros.core.planning.paths import shortest_path
    from thinmap_ros.core.scan import LaserConfig, Scan
    from thinmap_ros.core.slam.track import LocalizerConfig
    from thinmap_ros.core.topology.graph import TopologicalMap, TopologyConfig, topology_from_msg
    from thinmap_ros.core.topology.thinning import thin
    from thinmap_ros.core.topology.topology import build as build_topology
    from thinmap_ros.evaluation.exploration_run import explore
    from thinmap_ros.evaluation.run_errors import evaluate
    from thinmap_ros.files.graphs import write_graph
    from thinmap_ros.files.merging import MergedMap, merge_maps
    from thinmap_ros.files.occupancy_maps import read_map, write_map
    from thinmap_ros.files.package_data import world_path
    from thinmap_ros.files.trajectories import ScanTrajectory, StampedPoses, write_trajectory
    from thinmap_ros.files.worlds import read_world
    from thinmap_ros.logs.log import LaserOptions
    from thinmap_ros.logs.reading import open_log, paired_scans
    from thinmap_ros.pipeline import Pipeline, PipelineConfig
    from thinmap_ros.sim.laser import LaserScannerConfig
    from thinmap_ros.sim.world import World
    from thinmap_ros.view.summary import plot

__all__ = [
    'ConfigError',
    'EkfConfig',
    'ExplorationOptions',
    'Explorer',
    'ExplorerConfig',
    'GlobalLocalizationConfig',
    'GlobalLocalizer',
    'GridFrame',
    'GridPatch',
    'InputError',
    'LaserConfig',
    'LaserOptions',
    'LaserScannerConfig',
    'LocalizerConfig',
    'MergedMap',
    'OccupancyConfig',
    'OccupancyGrid',
    'Pipeline',
    'PipelineConfig',
    'Scan',
    'ScanTrajectory',
    'StampedPoses',
    'ThinmapError',
    'TopologicalMap',
    'TopologyConfig',
    'World',
    'build_topology',
    'evaluate',
    'explore',
    'merge_maps',
    'open_log',
    'paired_scans',
    'plot',
    'read_map',
    'read_world',
    'shortest_path',
    'thin',
    'topology_from_msg',
    'world_path',
    'write_graph',
    'write_map',
    'write_trajectory',
]

# The only place of the version: setup.py reads it, and a test compares the two package.xml with it.
__version__ = '0.4.0'

_PLACES = {
    # SLAM
    'Pipeline': 'pipeline.Pipeline',
    'PipelineConfig': 'pipeline.PipelineConfig',
    'LocalizerConfig': 'core.slam.track.LocalizerConfig',
    'EkfConfig': 'core.ekf_slam.ekf_localizer.EkfConfig',
    'plot': 'view.summary.plot',
    'Scan': 'core.scan.Scan',
    # trajectories
    'ScanTrajectory': 'files.trajectories.ScanTrajectory',
    'StampedPoses': 'files.trajectories.StampedPoses',
    'write_trajectory': 'files.trajectories.write_trajectory',
    'evaluate': 'evaluation.run_errors.evaluate',
    # logs
    'open_log': 'logs.reading.open_log',
    'LaserConfig': 'core.scan.LaserConfig',
    'LaserOptions': 'logs.log.LaserOptions',
    'paired_scans': 'logs.reading.paired_scans',
    # maps
    'GridPatch': 'core.grid.patch.GridPatch',
    'GridFrame': 'core.grid.patch.GridFrame',
    'OccupancyConfig': 'core.grid.occupancy.OccupancyConfig',
    'OccupancyGrid': 'core.grid.occupancy.OccupancyGrid',
    'read_map': 'files.occupancy_maps.read_map',
    'write_map': 'files.occupancy_maps.write_map',
    'MergedMap': 'files.merging.MergedMap',
    'merge_maps': 'files.merging.merge_maps',
    # topological maps
    'TopologicalMap': 'core.topology.graph.TopologicalMap',
    'TopologyConfig': 'core.topology.graph.TopologyConfig',
    'build_topology': 'core.topology.topology.build',
    'shortest_path': 'core.planning.paths.shortest_path',
    'thin': 'core.topology.thinning.thin',
    'topology_from_msg': 'core.topology.graph.topology_from_msg',
    'write_graph': 'files.graphs.write_graph',
    # localization in a finished map
    'GlobalLocalizer': 'core.places.global_localizer.GlobalLocalization',
    'GlobalLocalizationConfig': 'core.places.place_database.GlobalLocalizationConfig',
    # exploration, also in the simulator
    'ExplorationOptions': 'closed_loop.robot.Options',
    'LaserScannerConfig': 'sim.laser.LaserScannerConfig',
    'Explorer': 'core.exploration.explorer.Explorer',
    'ExplorerConfig': 'core.exploration.explorer.ExplorerConfig',
    'World': 'sim.world.World',
    'explore': 'evaluation.exploration_run.explore',
    'read_world': 'files.worlds.read_world',
    'world_path': 'files.package_data.world_path',
    # errors
    'ConfigError': 'core.errors.ConfigError',
    'InputError': 'core.errors.InputError',
    'ThinmapError': 'core.errors.ThinmapError',
}


def _load(name: str) -> Any:
    """Import a public name when it is first used."""
    if name not in _PLACES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    module, _, attribute = _PLACES[name].rpartition('.')
    value = getattr(import_module(f'{__name__}.{module}'), attribute)
    globals()[name] = value
    _report_compilation()
    return value


def _report_compilation() -> None:
    """Report the compilation of kernels, as programs do: with no word it looks like a fault."""
    if f'{__name__}.jit' in sys.modules:
        from thinmap_ros.kernels import report_compilation

        report_compilation()


if not TYPE_CHECKING:  # else no type checker would find a name that does not exist
    __getattr__ = _load


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return [*__all__, '__version__']
