"""Paper 1, section 3.2: the wavefront's navigation function, and the path down its slope."""

import numpy as np
from scipy import ndimage

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.planning.wavefront import (
    WavefrontConfig,
    cost_of_cells,
    navigation_function,
    plan,
)
from thinmap_ros.core.se2 import Array, path_length_m
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Table
from thinmap_ros.experiments.drives import Source, grid_of, tour_of
from thinmap_ros.view.plots import Curve, MapLayer, Panel, Plot, Raster

_START = (2.0, 2.0)
_COSTS = {
    'intrinsic and adjacency': WavefrontConfig(),
    'adjacency alone': WavefrontConfig(inflation_cost=0.0),
}


def run(source: Source) -> Outcome:
    """Plan from the start to each stop, with and without intrinsic cost."""
    patch = grid_of(source.samples('lab_stops')).known_area()
    goals = [(float(x), float(y)) for x, y in tour_of('lab')]
    clearance_m = ndimage.distance_transform_edt(patch.free) * patch.frame.resolution
    rows = []
    paths = {}
    for name, config in _COSTS.items():
        for goal in goals:
            path = plan(patch, _START, goal, config)
            if path is not None:
                cells = patch.frame.cells_of(path)
                clear_m = clearance_m[cells[:, 0], cells[:, 1]]
                room_m = (float(clear_m.min()), float(clear_m.mean()))
                rows.append([name, *goal, path_length_m(path), *room_m])
                paths[name] = path
    field = _field(patch, goals[-1])
    minima = _local_minima(field)
    kinds = {
        name: np.array([row[3:] for row in rows if row[0] == name], dtype=np.float64)
        for name in _COSTS
    }
    wide, short = kinds.values()
    detour = float(wide[:, 0].sum() / short[:, 0].sum() - 1.0)
    return Outcome(
        'Wavefront path',
        'Topological map paper, section 3.2',
        'From (2 m, 2 m) of the laboratory to the last of its twelve stops, '
        'on the map merged from them. '
        'The intrinsic cost keeps the path 0.6 m from walls if there is room. '
        'Without it, the path has the least length.',
        [
            Table(
                'paths',
                [
                    'cost',
                    'goal_x_m',
                    'goal_y_m',
                    'length_m',
                    'clearance_least_m',
                    'clearance_mean_m',
                ],
                rows,
            )
        ],
        [_plot(patch, field, paths)],
        [
            Comparison(
                'goals reached', 'all', f'{len(wide)} of {len(goals)}', len(wide) == len(goals)
            ),
            Comparison('local minima of the navigation function', 'none', str(minima), minima == 0),
            Comparison(
                'effect of the intrinsic cost',
                'go far from the object',
                f'mean clearance {wide[:, 2].mean():.2f} m '
                f'(without {short[:, 2].mean():.2f} m), path length {detour:+.1%}',
                bool(wide[:, 2].mean() > short[:, 2].mean()),
            ),
        ],
    )


def _field(patch: GridPatch, goal: tuple[float, float]) -> Array:
    """Cost to the goal, m, of each cell (H, W); inf without a path."""
    row, col = patch.frame.cells_of(np.array([goal]))[0].tolist()
    return (
        navigation_function(cost_of_cells(patch, WavefrontConfig()), (row, col))
        * patch.frame.resolution
    )


def _local_minima(field: Array) -> int:
    """Reached cells, but for the goal, none of whose neighbours costs less."""
    lowest = ndimage.minimum_filter(
        np.where(np.isfinite(field), field, np.inf), 3, mode='constant', cval=np.inf
    )
    return int(np.count_nonzero(np.isfinite(field) & (field <= lowest) & (field > 0.0)))


def _plot(patch: GridPatch, field: Array, paths: dict[str, Array]) -> Plot:
    shown = Raster(np.where(np.isfinite(field), field, np.nan), patch.frame, 'cost to the goal (m)')
    styles = ('-', '--')
    curves = [
        Curve(path, name, 1 if k == 0 else 5, styles[k], width=2.0)
        for k, (name, path) in enumerate(paths.items())
    ]
    goal = next(iter(paths.values()))[-1:]
    ends = [
        Curve(np.array([_START]), 'start', 'black', '', '*', size=11.0),
        Curve(goal, 'goal', 'black', '', 'X', size=9.0),
    ]
    panel = Panel([MapLayer(patch), shown, *curves, *ends])
    caption = (
        'Paper 1, section 3.2: cost to the goal, and the paths with and without intrinsic cost.'
    )
    return Plot('wavefront', caption, [panel], panel_inches=(9.0, 4.6))
