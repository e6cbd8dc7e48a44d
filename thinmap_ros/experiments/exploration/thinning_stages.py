"""Paper 2, Fig. 2: the free space is thinned stage by stage."""

import numpy as np

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Mask
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.thinning import select_free_space, thin
from thinmap_ros.core.topology.topology import build
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Table
from thinmap_ros.experiments.drives import Source, patch_of_world, world_of
from thinmap_ros.view.plots import GraphLayer, MapLayer, Panel, Plot

_SHOWN = (1, 2, 5, 8, 10, 13)
# Neighbours p2 ... p9 in rows and columns, clockwise from north; as in pictures, the row before
# lies to the north.
_AROUND = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))


def run(source: Source) -> Outcome:
    """Thin a world step by step, and compare the end with the fast thinning."""
    world = world_of('room_10x10')
    patch = patch_of_world(world)
    start = (float(world.start[0]), float(world.start[1]))
    free = select_free_space(patch, start, TopologyConfig())
    all_stages = stages(free)
    same = bool(np.array_equal(all_stages[-1], thin(free)))
    panels = [Panel([MapLayer(patch)], 'environment'), _panel(patch, free, 'selected free space')]
    last = len(all_stages) - 1
    panels += [_panel(patch, all_stages[k], f'stage {k}') for k in _SHOWN if k <= last]
    graph = build(patch, start, TopologyConfig())
    panels.append(
        Panel([MapLayer(patch), GraphLayer(graph, 4.0)], f'final result: stage {last}, with nodes')
    )
    return Outcome(
        'Stages of thinning',
        'Exploration paper, section 2.1, Fig. 2 (and SLAM paper, Fig. 4)',
        'The room of 10 x 10 m, 0.1 m a cell. '
        'Free cells are those where the centre of a robot with a radius of 0.25 m can be. '
        "A stage is both sub-iterations, by a literal implementation of the paper's rules.",
        [
            Table(
                'stages',
                ['stage', 'cells_left'],
                [[k, int(cells.sum())] for k, cells in enumerate(all_stages)],
            )
        ],
        [
            Plot(
                'fig2',
                'Paper 2, Fig. 2: environment, selection of free space, '
                'and thinning stage by stage (dark: remaining cells).',
                panels,
                columns=3,
                panel_inches=(3.6, 3.6),
            )
        ],
        [
            Comparison('stages until nothing changes', 'more than 13', str(last)),
            Comparison(
                'the fast implementation gives the same cells', '', 'yes' if same else 'no', same
            ),
        ],
    )


def stages(free: Mask) -> list[Mask]:
    """The free cells (H, W) after 0, 1, 2, ... stages, until nothing changes.

    Source: topological map paper section 2.1, steps 1 and 2.
    """
    found = [free]
    while True:
        after = _sub_iteration(_sub_iteration(found[-1], first=True), first=False)
        if np.array_equal(after, found[-1]):
            return found
        found.append(after)


def _sub_iteration(cells: Mask, first: bool) -> Mask:
    padded = np.pad(cells, 1).astype(np.int8)
    rows, cols = cells.shape
    p = [
        padded[1 + down : 1 + down + rows, 1 + right : 1 + right + cols] for down, right in _AROUND
    ]
    count = np.sum(p, axis=0)
    rises = np.sum([(p[k] == 0) & (p[(k + 1) % 8] == 1) for k in range(8)], axis=0)
    north = p[0]
    east = p[2]
    south = p[4]
    west = p[6]
    if first:
        open_sides = (north * east * south == 0) & (east * south * west == 0)
    else:
        open_sides = (north * east * west == 0) & (north * south * west == 0)
    return np.asarray(cells & ~((count >= 2) & (count <= 6) & (rises == 1) & open_sides))


def _panel(patch: GridPatch, cells: Mask, title: str) -> Panel:
    shown = np.where(cells, np.int8(100), np.int8(0))
    shown[~patch.free] = -1
    return Panel([MapLayer(GridPatch(patch.frame, shown))], f'{title}: {int(cells.sum())} cells')
