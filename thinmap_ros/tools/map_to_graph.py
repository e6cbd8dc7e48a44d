"""Converts map_server maps to route graphs."""

import argparse
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.grid.edits import with_walls
from thinmap_ros.core.grid.fields import label
from thinmap_ros.core.grid.moved import resampled
from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.regions import membership_of
from thinmap_ros.core.topology.routes import DETAIL_M, MIN_NODE_SPACING_M, Coverage, coverage
from thinmap_ros.core.topology.segmentation import RegionConfig, find_regions
from thinmap_ros.core.topology.topology import build_routes
from thinmap_ros.evaluation.batch import (
    REASON,
    Batch,
    FileJob,
    jobs_of,
    reported,
    run_batch,
)
from thinmap_ros.evaluation.parallel_jobs import Report, add_run_options
from thinmap_ros.files import graphs, occupancy_maps
from thinmap_ros.files.keep_out_masks import read_mask
from thinmap_ros.files.sessions import REGIONS, load_edits
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, check_picture, check_place
from thinmap_ros.view.summary import summary_figure

_DEFAULTS = TopologyConfig()
_DESCRIPTIONS = ('.yaml', '.yml')
_MIN_COVERED = 0.8  # of the reachable floor; less is a warning
_FORMATS = ('geojson', 'graphml', 'tmap2.yaml')
# Arguments that decide about a graph.
_OPTIONS = (
    'robot_radius_m',
    'min_clearance_m',
    'allow_touching',
    'prune_m',
    'max_unknown_gap_m',
    'detail_m',
    'node_spacing_m',
    'speed_limit',
    'start',
    'format',
)


def _start(given: str | None) -> tuple[float, float] | None:
    return None if given is None else _pair(given, '--start', 'X,Y (m, map frame)')


def _speed_limit(given: str | None) -> graphs.SpeedLimit | None:
    if given is None:
        return None
    return graphs.SpeedLimit(*_pair(given, '--speed-limit', 'WIDTH,PERCENT (m, %)'))


def _pair(given: str, option: str, expected: str) -> tuple[float, float]:
    try:
        first, second = (float(word) for word in given.split(','))
    except ValueError:
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise InputError(f'{option}={given}: expected two finite numbers {expected}')
    return first, second


def _config(arguments: argparse.Namespace) -> TopologyConfig:
    """Configuration from the arguments: a greater clearance is a wider robot."""
    radius = (
        arguments.robot_radius_m if arguments.min_clearance_m is None else arguments.min_clearance_m
    )
    if radius < arguments.robot_radius_m:
        raise InputError(
            f'--min-clearance-m {radius}: '
            f'expected at least the robot radius ({arguments.robot_radius_m} m)'
        )
    return TopologyConfig(
        robot_radius_m=radius,
        min_branch_length_m=arguments.prune_m,
        max_unknown_gap_m=arguments.max_unknown_gap_m,
    )


def _check_node_spacing(arguments: argparse.Namespace) -> None:
    """Raise InputError for a node spacing that makes no graph."""
    spacing_m = arguments.node_spacing_m
    if spacing_m is None:
        return
    if not MIN_NODE_SPACING_M <= spacing_m < math.inf:
        raise InputError(f'--node-spacing-m {spacing_m}: expected {MIN_NODE_SPACING_M} m or more')
    if arguments.detail_m == 0.0:
        raise InputError(
            f'--node-spacing-m {spacing_m}: expected --detail-m above 0: with 0 all nodes stay'
        )


@dataclass(frozen=True)
class _Graph:
    """What was found in a map: counts, and what is to be said of it, a line each.

    islands: number of the small parts that were left out, and island_m2: their traversable area.
    keep_out: number of the keep-out areas of its session, and masked_m2: what the mask forbids in
    the map; both are walls for the graph.
    """

    nodes: int
    edges: int
    parts: int
    regions: int
    islands: int
    island_m2: float
    keep_out: int
    masked_m2: float
    warnings: list[str]


def _areas(cells: Mask, resolution: float) -> list[float]:
    """Areas of the parts of cells (H, W), m2, the largest first."""
    _, sizes = label(cells)
    return sorted((sizes[1:] * resolution**2).tolist(), reverse=True)


def _told_of_parts(areas: list[float]) -> list[str]:
    """A line on parts of the traversable floor, m2, where there are several."""
    if len(areas) < 2:
        return []
    listed = ', '.join(f'{area:.1f}' for area in areas)
    return [
        f'{len(areas)} parts without a route between them ({listed} m2): --start X,Y keeps the one '
        'in which the robot is'
    ]


def _told_of_coverage(found: Coverage, radius_m: float) -> list[str]:
    """A line on a graph that leads to little of the floor, with the reason."""
    if found.covered >= _MIN_COVERED:
        return []
    reason = (
        'most of the rest is nearer than that to unknown cells; --max-unknown-gap-m closes gaps'
        if found.unknown > found.rays
        else 'paths in most of the rest end at more unknown than walls, as rays through glass do; '
        '--detail-m 0 keeps them'
    )
    return [
        f'the graph covers {found.covered:.0%} of the floor that is {radius_m} m or more from all '
        f'walls: {reason}'
    ]


def _masked(path: Path | None, patch: GridPatch) -> Mask:
    """Cells (H, W) of a map that a keep-out mask forbids."""
    if path is None:
        return np.zeros(patch.shape, dtype=np.bool_)
    return resampled(read_mask(path, patch), patch).occupied


def _convert(path: Path, out: Path, picture: Path | None, arguments: argparse.Namespace) -> _Graph:
    """Write the graph of a map, and a picture of it."""
    start = _start(arguments.start)
    config = _config(arguments)
    radius_m = config.robot_radius_m
    patch = occupancy_maps.read_map(path, keeps_unknown=True)
    keep_out = load_edits(str(path)).keep_out
    forbidden = _masked(arguments.keep_out, patch)
    drivable = with_walls(keep_out.as_walls(patch), forbidden)
    resolution = drivable.frame.resolution
    # Of a map of its own, whose masks go with it: the memory is for the graph.
    found = find_regions(replace(patch), RegionConfig(robot_radius_m=arguments.robot_radius_m))
    session = REGIONS.load_optional(str(path))
    regions = found if session is None else session.names.named(found)
    detail_m = arguments.detail_m
    routes = build_routes(
        drivable, start, config, detail_m, arguments.node_spacing_m, arguments.allow_touching
    )
    topology = routes.map
    limit = _speed_limit(arguments.speed_limit)
    graphs.write_graph(out, topology, membership_of(topology, regions), limit)
    if picture is not None:
        summary_figure(
            picture,
            drivable,
            topology,
            np.empty((0, 2)),
            title=path.stem,
            regions=regions,
        )
    islands = _areas(routes.selected & ~routes.standing, resolution)
    place = 'no free place' if start is None else f'no free place round {start}'
    warnings = [f'{place} for a robot of {radius_m} m radius: the graph is empty']
    if topology.nodes:
        lost = coverage(routes.whole, drivable, routes.standing, routes.config)
        lost = lost if detail_m else replace(lost, rays=0.0)  # the whole skeleton has its rays
        warnings = _told_of_parts(_areas(routes.standing, resolution))
        warnings += _told_of_coverage(lost, radius_m)
    return _Graph(
        len(topology.nodes),
        len(topology.edges),
        len(topology.components()),
        len(regions.regions),
        len(islands),
        sum(islands),
        len(keep_out.areas),
        np.count_nonzero(forbidden) * patch.frame.resolution**2,
        warnings,
    )


def run_job(job: FileJob) -> Report:
    """Convert one of many maps into its folder."""
    arguments = argparse.Namespace(**job.arguments)
    job.folder.mkdir(parents=True, exist_ok=True)
    began = time.process_time()
    found = _convert(
        job.path,
        job.folder / f'topology.{arguments.format}',
        job.folder / 'summary.png',
        arguments,
    )
    row = {
        'nodes': found.nodes,
        'edges': found.edges,
        'parts': found.parts,
        'regions': found.regions,
        'cpu_s': round(time.process_time() - began, 2),
        REASON: '; '.join(found.warnings),
    }
    return reported(job, row)


_BATCH = Batch(run_job, ('nodes', 'edges', 'parts', 'regions', 'cpu_s'), 'Route graphs of maps')


def _work(arguments: argparse.Namespace) -> None:
    _config(arguments)  # report a wrong value before the work
    _start(arguments.start)
    _speed_limit(arguments.speed_limit)
    if not 0.0 <= arguments.detail_m < math.inf:
        raise InputError(f'--detail-m {arguments.detail_m}: expected 0 m or more')
    _check_node_spacing(arguments)
    maps = _without_images(arguments.maps)
    default = f'{maps[0].stem}.{arguments.format}' if len(maps) == 1 else 'graphs'
    arguments.out = arguments.out or Path('out') / default
    check_place(arguments.out)
    if len(maps) == 1:
        _convert_one(maps[0], arguments)
        return
    if arguments.picture is not None:
        raise InputError('--picture: expected one map: of several, each has a summary.png')
    if arguments.keep_out is not None:
        raise InputError('--keep-out: expected one map, in whose frame the mask is')
    arguments.command = cli.command_line()
    options = {name: getattr(arguments, name) for name in _OPTIONS}
    jobs = jobs_of(maps, arguments.out, options, vars(arguments))
    run_batch(_BATCH, jobs, arguments)


def _without_images(paths: list[Path]) -> list[Path]:
    """The paths without the images of descriptions among them, as of maps/*."""
    described = {path.with_suffix('') for path in paths if path.suffix in _DESCRIPTIONS}
    return [
        path
        for path in paths
        if path.suffix in _DESCRIPTIONS or path.with_suffix('') not in described
    ]


def _convert_one(path: Path, arguments: argparse.Namespace) -> None:
    graphs.writer_of(arguments.out)  # report a wrong name before the work
    check_picture(arguments.picture)
    found = _convert(path, arguments.out, arguments.picture, arguments)
    for warning in found.warnings:
        print(f'map_to_graph: warning: {path}: {warning}', file=sys.stderr)
    left_out = (
        f', small parts left out: {found.islands} ({found.island_m2:.1f} m2)'
        if found.islands
        else ''
    )
    kept_out = f', keep-out areas: {found.keep_out}' if found.keep_out else ''
    if arguments.keep_out is not None:
        kept_out += f', keep-out mask: {found.masked_m2:.1f} m2'
    print(
        f'{arguments.out}: {found.nodes} nodes, {found.edges} edges, '
        f'connected parts: {found.parts}, regions: {found.regions}{left_out}{kept_out}'
    )


def main() -> None:
    """Run the program."""
    parser = Parser('map_to_graph', __doc__)
    parser.add_argument('maps', type=Path, nargs='+', metavar='MAP', help='map_server YAML file')
    out_help = (
        'FILE.geojson (Nav2 route server), .graphml, or .tmap2.yaml (topological_navigation); of '
        'several maps a folder with one for each, summary.csv and report.html (default '
        'out/MAP.geojson, out/graphs)'
    )
    parser.add_argument('-o', '--out', type=Path, help=out_help)
    add_run_options(parser)
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.add_argument(
        '--format',
        choices=_FORMATS,
        default=_FORMATS[0],
        help=f'of the graphs of several maps (default {_FORMATS[0]})',
    )
    radius = _DEFAULTS.robot_radius_m
    parser.add_argument(
        '--robot-radius-m', type=float, default=radius, help=f'm (default {radius})'
    )
    clearance_help = 'how far nodes and edges stay from obstacles, m (default: the robot radius)'
    parser.add_argument('--min-clearance-m', type=float, help=clearance_help)
    touching_help = (
        'nodes and edges may be exactly as far from obstacles (default: farther, as Nav2 refuses '
        'cells that are a radius away)'
    )
    parser.add_argument('--allow-touching', action='store_true', help=touching_help)
    default = _DEFAULTS.min_branch_length_m
    prune_help = f'shorter branches of the skeleton are pruned, m (default {default})'
    parser.add_argument(
        '--prune-m', type=float, default=_DEFAULTS.min_branch_length_m, help=prune_help
    )
    # Of a saved map no later scan shows what is in a gap: no edge leads through one.
    gap_help = 'unknown gaps up to this width between free cells count as free, m (default 0)'
    parser.add_argument('--max-unknown-gap-m', type=float, default=0.0, help=gap_help)
    detail_help = (
        f'smaller obstacles are passed on one side only, m (default {DETAIL_M}; 0: the whole '
        'skeleton, as while a robot maps)'
    )
    parser.add_argument('--detail-m', type=float, default=DETAIL_M, help=detail_help)
    spacing_help = (
        'nodes nearer to each other than this are one, and no place in sight is farther than three '
        'times this from a node, m: more for fewer nodes, less for a node at each junction '
        '(default: as --detail-m)'
    )
    parser.add_argument('--node-spacing-m', type=float, help=spacing_help)
    speed_help = (
        'WIDTH,PERCENT: speed_limit of edges narrower than WIDTH, m; of others it is 100 (GeoJSON)'
    )
    parser.add_argument('--speed-limit', help=speed_help)
    parser.add_argument(
        '--start',
        help='X,Y in m: only what a robot can reach from there (default: all but small parts)',
    )
    parser.add_argument(
        '--keep-out',
        type=Path,
        metavar='MASK',
        help="map_server YAML file of a mask for Nav2's KeepoutFilter, in the frame of the map: "
        'its cells of 100 are walls for the graph',
    )
    parser.add_argument('--picture', type=Path, help='FILE.png: the graph drawn on the map')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
