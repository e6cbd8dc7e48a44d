"""Merge sessions and map_server maps of one place into one session, in the frame of the first."""

import thinmap_ros.startup  # isort: skip  # noqa: F401  before all other modules
import argparse
import math
import sys
from pathlib import Path

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.places.place_odds import JOIN_ODDS
from thinmap_ros.files.merging import (
    CannotTellError,
    MapJoin,
    MergedMap,
    NotTheSamePlaceError,
    merge_maps,
    write_ids,
)
from thinmap_ros.files.sessions import GRID, maps_in, require_own_files, stem_of
from thinmap_ros.logs.transforms import parse_pose
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser, check_picture, check_place
from thinmap_ros.view.progress_bar import ProgressBar
from thinmap_ros.view.summary import merged_figure

_NOT_THE_SAME_PLACE = 1
_CANNOT_TELL = 3


def _describe(joined: MapJoin) -> str:
    x, y, theta = joined.T_merged_map.tolist()
    sigmas = np.sqrt(np.diag(joined.covariance)).tolist()
    is_given = math.isinf(joined.log_odds)
    said = 'pose given' if is_given else f'log odds {joined.log_odds:.1f}'
    if not math.isnan(joined.found):
        said += f', {100.0 * joined.found:.0f} % of the walls agree'
    return (
        f'{joined.path}: at {x:.3f}, {y:.3f} m, {math.degrees(theta):.2f} deg '
        f'(sigma {sigmas[0]:.3f}, {sigmas[1]:.3f} m, {math.degrees(sigmas[2]):.2f} deg), '
        f'{said}, {joined.links} matches; '
        f'{len(joined.ids)} of {joined.nodes} nodes in the map'
    )


def _print_ids(first: str, merged: MergedMap) -> None:
    own = merged.maps[first].graph.nodes
    there = merged.topology.map.nodes
    print(f'{first}: {len(own.keys() & there.keys())} of {len(own)} nodes keep their ids')


def _maps_of(given: str, out: str) -> list[str]:
    """The map that is given; of a folder, its sessions and maps in the order of their names."""
    folder = Path(given)
    if not folder.is_dir():
        return [given]
    found = maps_in(folder)
    if not found:
        raise InputError(f'{given}: no map: expected sessions or map_server YAML files')
    return [path for path in found if stem_of(path) != stem_of(out)]


def _merge(arguments: argparse.Namespace) -> MergedMap:
    with ProgressBar('merge_sessions', arguments.quiet) as bar:
        try:
            return merge_maps(
                arguments.maps,
                arguments.join_odds,
                progress=bar.show,
                at=arguments.at,
                tag=arguments.tag,
            )
        except NotTheSamePlaceError as error:
            bar.close()
            print(error, file=sys.stderr)
            is_unsure = isinstance(error, CannotTellError)
            sys.exit(_CANNOT_TELL if is_unsure else _NOT_THE_SAME_PLACE)


def _work(arguments: argparse.Namespace) -> None:
    for path in filter(None, (arguments.out, arguments.ids)):
        check_place(Path(path))
    arguments.at = [parse_pose(given, '--at', 'X,Y,YAW') for given in arguments.at]
    require_own_files(arguments.out, GRID)  # report a wrong name before the work
    arguments.maps = [each for given in arguments.maps for each in _maps_of(given, arguments.out)]
    check_picture(arguments.picture)
    merged = _merge(arguments)
    for line in merged.save(arguments.out):
        print(line)
    for joined in merged.joins:
        print(_describe(joined))
    _print_ids(arguments.maps[0], merged)
    if arguments.ids is not None:
        write_ids(arguments.ids, merged)
    if arguments.picture is not None:
        shown = [(Path(path).name, one.patch, one.graph) for path, one in merged.maps.items()]
        joined_map = (Path(arguments.out).name, merged.grid.known_area(), merged.topology.map)
        merged_figure(arguments.picture, [*shown, joined_map])


def main() -> None:
    """Run the program."""
    parser = Parser(
        'merge_sessions',
        __doc__,
        epilog='Ends with 1, and writes nothing, if a map does not show the same place, with 3 if '
        'that it does is not sure enough.',
    )
    parser.add_argument(
        'maps',
        nargs='+',
        metavar='MAP',
        help='session (path STEM), map_server YAML file, or a folder of such',
    )
    parser.add_argument('-o', '--out', required=True, help='path STEM of the merged session')
    odds_help = (
        'odds from which a map is joined: of false joins, at most one in so many. Raise it for '
        f'buildings with similar floors, lower it if maps overlap little (default {JOIN_ODDS:g})'
    )
    parser.add_argument('--join-odds', type=float, default=JOIN_ODDS, help=odds_help)
    parser.add_argument(
        '--at',
        action='append',
        default=[],
        metavar='X,Y,YAW',
        help='pose of the second map in the first one (m, m, rad), to some 0.5 m and 0.1 rad, '
        'instead of looking for it; again for each further map',
    )
    parser.add_argument(
        '--tag',
        default='',
        help='storey that all maps show which have no map_tag, any name: their places are found by '
        'views alone, and maps of another storey are refused',
    )
    parser.add_argument('--picture', type=Path, help='FILE.png: the maps, and the merged one')
    parser.add_argument('--ids', type=Path, help='FILE.csv: ids of nodes in the merged map')
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
