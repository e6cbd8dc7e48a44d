"""What other programs make of a nav_msgs/OccupancyGrid, by their documented rules.

Maps are arrays of cells (H, W) int8, row 0 with the lowest y, as in the message.
"""

from collections import deque
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

LETHAL = 254
NO_INFORMATION = 255
FREE_SPACE = 0


def static_layer(
    cells, lethal_threshold=100, unknown_cost_value=255, track_unknown=True, trinary=True
):
    """Costs of Nav2's static layer, with the defaults of nav2_params.yaml.

    The value is read as an unsigned byte, so that -1 is unknown_cost_value.
    """
    costs = np.empty(cells.shape, dtype=np.uint8)
    for at, value in np.ndenumerate(cells.view(np.uint8)):
        if value == unknown_cost_value:
            costs[at] = NO_INFORMATION if track_unknown else FREE_SPACE
        elif value >= lethal_threshold:
            costs[at] = LETHAL
        else:
            costs[at] = FREE_SPACE if trinary else int(value / lethal_threshold * LETHAL)
    return costs


def amcl_map(cells):
    """Occupancy state of AMCL: -1 free, 1 occupied, 0 unknown; no other value has a meaning."""
    return np.where(cells == 0, -1, np.where(cells == 100, 1, 0))


def slam_toolbox_map(probabilities):
    """Map that slam_toolbox publishes of the same cells: -1, 0 or 100, nothing in between."""
    cells = np.full(probabilities.shape, -1, dtype=np.int8)
    for at, percent in np.ndenumerate(probabilities):
        if percent >= 65:
            cells[at] = 100
        elif 0 <= percent <= 25:
            cells[at] = 0
    return cells


def explore_lite_costs(cells):
    """Costs of explore_lite's costmap client: 0 free, 255 unknown, 254 lethal, 253 inscribed."""
    costs = np.empty(cells.shape, dtype=np.uint8)
    special = {0: FREE_SPACE, -1: NO_INFORMATION, 99: 253, 100: LETHAL}
    for at, value in np.ndenumerate(cells):
        costs[at] = special.get(int(value), 1 + 251 * (int(value) - 1) // 97)
    return costs


def explore_lite_frontiers(costs, start, min_cells):
    """Frontiers of explore_lite, each a set of (row, col), from a free cell `start`.

    Breadth-first through free cells with four neighbours. A frontier cell is unknown and has a free
    neighbour (of four); a frontier is connected by eight neighbours and has at least min_cells.
    """
    assert costs[start] == FREE_SPACE
    frontiers = []
    claimed = set()
    visited = {start}
    queue = deque([start])
    while queue:
        for near in _four(queue.popleft(), costs.shape):
            if costs[near] == FREE_SPACE and near not in visited:
                visited.add(near)
                queue.append(near)
            elif near not in claimed and _is_frontier(costs, near):
                frontiers.append(_grow(costs, near, claimed))
    return [cells for cells in frontiers if len(cells) >= min_cells]


def _grow(costs, first, claimed):
    cells = {first}
    claimed.add(first)
    queue = deque([first])
    while queue:
        row, col = queue.popleft()
        for i in (row - 1, row, row + 1):
            for j in (col - 1, col, col + 1):
                at = (i, j)
                is_inside = 0 <= i < costs.shape[0] and 0 <= j < costs.shape[1]
                if is_inside and at not in claimed and _is_frontier(costs, at):
                    claimed.add(at)
                    cells.add(at)
                    queue.append(at)
    return cells


def _is_frontier(costs, at):
    return costs[at] == NO_INFORMATION and any(
        costs[near] == FREE_SPACE for near in _four(at, costs.shape)
    )


def _four(at, shape):
    for step in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        row = at[0] + step[0]
        col = at[1] + step[1]
        if 0 <= row < shape[0] and 0 <= col < shape[1]:
            yield row, col


def map_saver_image(cells, free_thresh=0.25, occupied_thresh=0.65):
    """Grey values (H, W), top row first, that map_saver_cli writes in trinary mode."""
    grey = np.full(cells.shape, 205, dtype=np.uint8)
    free = round(100 * free_thresh)
    occupied = round(100 * occupied_thresh)
    for at, value in np.ndenumerate(cells):
        if 0 <= value <= free:
            grey[at] = 254
        elif occupied <= value <= 100:
            grey[at] = 0
    return grey[::-1]


def map_server_cells(path: Path):
    """Cells that map_server publishes of a YAML file in trinary mode, and its description."""
    description = yaml.safe_load(path.read_text())
    assert description['mode'] == 'trinary'
    grey = np.asarray(Image.open(path.parent / description['image']).convert('L'))
    cells = np.full(grey.shape, -1, dtype=np.int8)
    for at, value in np.ndenumerate(grey[::-1]):
        shade = float(value) / 255.0
        darkness = shade if description['negate'] else 1.0 - shade
        if darkness > description['occupied_thresh']:
            cells[at] = 100
        elif darkness < description['free_thresh']:
            cells[at] = 0
    return cells, description
