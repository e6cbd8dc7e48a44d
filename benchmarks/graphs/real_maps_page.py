"""Make docs/results/graphs_of_real_maps.md: measures of route graphs of saved maps, and pictures.

Usage: python -m benchmarks.graphs.real_maps_page MAPS [DOCS]. MAPS has map_server maps, in folders
or not.
"""

from collections.abc import Callable
from pathlib import Path

from PIL import Image

from benchmarks.charts import page_program
from benchmarks.graphs.route_measures import RouteMeasures, made, maps_below, measure
from benchmarks.rows import markdown
from thinmap_ros.core.errors import InputError
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.files.occupancy_maps import read_map
from thinmap_ros.files.safe import write_text

_PAGE = Path('results') / 'graphs_of_real_maps.md'
_IMAGES = Path('images') / 'results'
_COLOURS = 64  # of a picture: a quarter of the bytes
_SHOWN = {
    'kobuki_aws_warehouse': 'a simulated warehouse with shelves and pillars',
    'upstairs': 'a flat, by a cheap laser: furniture is specks, and a wall has holes',
    'carmines_floor': 'a floor of a university with rays behind glass',
}
_HEAD = """\
# Graphs of real maps

{made}

Maps that robots of others saved, as they are: by their SLAM, with walls in part, legs of chairs,
rays behind glass. `map_to_graph` makes the graph of each with its defaults, for a robot of 0.25 m
radius. A slow program that shares no code with it reads both files and measures what a route server
needs: that a robot sees a node from where it stands, that the straight lines between nodes are
free, that lengths are those of the drive, and that no detour is long.

`python -m benchmarks.graphs.real_maps_page MAPS` generates this page;
`python -m benchmarks.graphs.route_measures MAP.yaml` measures the graph of your own map.

"""
_TAIL = """
*Floor*: where the robot can stand by Nav2's rule, farther from an obstacle than its radius,
without islands below 2 m2 and 5 % of the largest part. *Parts*: of the graph, and of the floor.
*Sees none*: places 0.25 m apart that see none of their five nearest nodes. *Elsewhere*: places
whose nearest node is on another part of the floor. *Near*: floor within 1.5 m of the graph.
*Far*: places more than 3 m from a node. *Unsafe*: edges whose straight line is nearer than the
radius to an obstacle or the unknown. *Inscribed*: edges over cells that Nav2's inflation layer
calls so. *Overstated*: edges whose length or clearance is more than 1.5 cells above that of the
straight line. *Routes*: between nodes 5 m apart or more, relative to the shortest path on the
grid, median and worst.
"""
_COLUMNS: dict[str, Callable[[RouteMeasures], str]] = {
    'floor (m2)': lambda row: f'{row.floor_m2:.0f}',
    'nodes': lambda row: str(row.nodes),
    'parts': lambda row: f'{row.parts} of {row.floor_parts}',
    'sees none': lambda row: f'{row.unseeing} of {row.places}',
    'elsewhere': lambda row: str(row.elsewhere),
    'near (%)': lambda row: f'{100.0 * row.covered:.0f}',
    'far (%)': lambda row: f'{100.0 * row.far:.0f}',
    'unsafe': lambda row: str(row.unsafe),
    'inscribed': lambda row: str(row.inscribed),
    'overstated': lambda row: f'{row.overlong}, {row.overwide}',
    'routes': lambda row: _routes(row),
}


def _routes(row: RouteMeasures) -> str:
    is_none = row.route_worst != row.route_worst
    return '' if is_none else f'{row.route_median:.2f}, {row.route_worst:.2f}'


def write(maps: Path, docs: Path) -> Path:
    """Write the page of the maps of a folder, with its pictures. Returns its path.

    Raises InputError where the folder has no map.
    """
    paths = maps_below(maps)
    if not paths:
        raise InputError(f'{maps}: no map: expected YAML files of map_server in it')
    rows = []
    pictures = []
    for path in paths:
        picture = docs / _IMAGES / f'graph_{path.stem}.png'
        is_shown = path.stem in _SHOWN
        graph = made(path, ('--picture', picture) if is_shown else ())
        row = measure(read_map(path, report=str, keeps_unknown=True), graph)
        rows.append([f'`{path.stem}`', *(column(row) for column in _COLUMNS.values())])
        if is_shown:
            _shrink(picture)
            pictures.append(_figure(path.stem, picture.name))
    page = docs / _PAGE
    table = markdown(['map', *_COLUMNS], rows)
    write_text(page, _HEAD.format(made=provenance()) + f'{table}\n{_TAIL}' + ''.join(pictures))
    return page


def _shrink(picture: Path) -> None:
    with Image.open(picture) as image:
        small = image.convert('RGB').quantize(_COLOURS)
    small.save(picture, optimize=True)


def _figure(name: str, file: str) -> str:
    caption = f'`{name}`, {_SHOWN[name]}.'
    return f'\n![{caption}](../{_IMAGES.as_posix()}/{file})\n\n*{caption}*\n'


if __name__ == '__main__':
    page_program(write)
