"""Nodes on a known map of 100 x 100 m, at rest and driving: processor, memory, traffic by size.

In a shell of scripts/env. All nodes are in one process and start from a session of a floor of
rooms. At rest, in mode localization, no scan comes. Driving, in mode mapping, a simulated robot
goes in a circle within one room, and the same is measured on a floor of 20 x 20 m: what a scan
costs must not grow with the map. A listener, as a viewer does, subscribes to the map, its updates
and all that follows from it.
"""

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, at_most
from benchmarks.speed.node_process import TrafficListener, processor_s, start, stop, use_own_domain
from thinmap_ros.core.grid.occupancy import OccupancyConfig, OccupancyGrid
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.core.topology.segmentation import RegionTracker
from thinmap_ros.core.topology.topology import TopologyBuilder
from thinmap_ros.files import sessions
from thinmap_ros.files.occupancy_maps import write_map

_LARGE_M = 100
_SMALL_M = 20
_ROOM_M = 10
_WALL_CELLS = 2
_DOOR_M = 1.2
_PILLAR_M = 0.4
_START = (4.0, 3.0)  # in the first room
_SETTLE_S = 15.0  # more than the longest period of a node, after which nothing is due


@dataclass(frozen=True)
class _Load:
    """Load of all nodes: share of a core, %; memory, MB; traffic by topic, kB/s."""

    cpu: float
    memory_mb: float
    traffic: dict[str, float]


def run(worlds: Path, quick: bool) -> Iterator[Row]:
    """Rows at rest, and driving on the large floor and on the small one."""
    use_own_domain()
    seconds = 20.0 if quick else 60.0
    with tempfile.TemporaryDirectory() as folder:
        large = write_floor(Path(folder) / 'large', _LARGE_M)
        small = write_floor(Path(folder) / 'small', _SMALL_M)
        rest = _measured(large, seconds, is_driving=False)
        yield Row('at rest, localization', f'{_LARGE_M} x {_LARGE_M} m')
        yield at_most('  CPU load', rest.cpu, 3.0, '%')
        yield at_most('  memory', rest.memory_mb, 260.0, 'MB')
        yield at_most('  traffic', sum(rest.traffic.values()), 5.0, 'kB/s')
        loads = {}
        for path, side_m in ((small, _SMALL_M), (large, _LARGE_M)):
            load = loads[side_m] = _measured(path, seconds, is_driving=True)
            yield Row('driving, mapping', f'{side_m} x {side_m} m')
            yield Row('  CPU load', f'{load.cpu:.3g} %')
            yield Row('  memory', f'{load.memory_mb:.0f} MB')
            for topic, rate in sorted(load.traffic.items(), key=lambda item: -item[1]):
                yield Row(f'  {topic}', f'{rate:.3g} kB/s')
        growth = loads[_LARGE_M].cpu / loads[_SMALL_M].cpu
        yield at_most('  CPU load / that on the small floor', growth, 1.2)
        of_map = sum(loads[_LARGE_M].traffic.get(topic, 0.0) for topic in ('map', 'map_updates'))
        yield at_most('  map and map_updates', of_map, 100.0, 'kB/s')


def floor(side_m: int) -> GridPatch:
    """Rooms with a pillar each, and a door in the middle of each wall between two of them."""
    cell_m = OccupancyConfig().resolution_m
    cells = np.zeros((round(side_m / cell_m),) * 2, dtype=np.int8)
    room = round(_ROOM_M / cell_m)
    gap = round(_DOOR_M / cell_m)
    pillar = round(_PILLAR_M / cell_m)
    for first in range(0, cells.shape[0], room):
        for walls in (cells, cells.T):
            walls[first : first + _WALL_CELLS] = 100
            if first:
                for middle in range(room // 2, cells.shape[0], room):
                    door = slice(middle - gap // 2, middle + gap // 2)
                    walls[first : first + _WALL_CELLS, door] = 0
    # Elsewhere in each room, so that no two look alike.
    offsets = np.random.default_rng(0)
    for row in range(0, cells.shape[0], room):
        for col in range(0, cells.shape[1], room):
            y, x = offsets.integers(room // 2 + gap, room - 2 * pillar, size=2).tolist()
            cells[row + y : row + y + pillar, col + x : col + x + pillar] = 100
    for edge in (cells[-_WALL_CELLS:], cells[:, -_WALL_CELLS:]):
        edge[...] = 100
    return GridPatch(GridFrame(0.0, 0.0, cell_m), cells)


def write_floor(path: Path, side_m: int) -> Path:
    """Write a floor as session and as world; returns the path stem."""
    patch = floor(side_m)
    grid = OccupancyGrid.from_patch(patch)
    sessions.save_grid(str(path), grid)
    topology = TopologyBuilder()
    topology.update(patch, np.array([*_START, 0.0]))
    sessions.TOPOLOGY.save(str(path), topology)
    regions = RegionTracker()
    regions.update(patch)
    sessions.REGIONS.save(str(path), regions)
    write_map(path.with_name(f'{path.name}_world'), patch)
    return path


def _measured(path: Path, seconds: float, is_driving: bool) -> _Load:
    x, y = _START
    parameters = (
        f'session_path:={path} mode:={"mapping" if is_driving else "localization"} '
        f'initial_x_m:={x} initial_y_m:={y} initial_yaw_rad:=0.0 '
        f'use_sim_time:={str(is_driving).lower()}'
    )
    with ExitStack() as stack:
        nodes = start(['thinmap'], parameters)
        stack.callback(stop, nodes)
        listener = TrafficListener((0.3, 0.3) if is_driving else None)
        stack.callback(listener.close)
        listener.listen_until('topology')
        if is_driving:
            world = path.with_name(f'{path.name}_world.yaml')
            sim = start(['sim'], f'world:={world} start:={x},{y},0.0 wait_for_subscribers:=3')
            stack.callback(stop, sim)
            listener.listen_until('local_topology')
        listener.listen(_SETTLE_S)
        listener.forget()
        before = processor_s(nodes)
        began = time.monotonic()
        listener.listen(seconds)
        taken = time.monotonic() - began
        cpu = 100.0 * (processor_s(nodes) - before) / taken
        memory_mb = nodes.memory_full_info().pss / 1e6
        return _Load(cpu, memory_mb, {t: n / 1e3 / taken for t, n in listener.bytes.items()})
