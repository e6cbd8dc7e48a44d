"""Real floors and random worlds to measure on.

map_server maps in a folder, with places to start from.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from thinmap_ros.core.se2 import Array
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.world import World

WORLDS = Path(__file__).resolve().parent.parent.parent / 'shared' / 'data' / 'worlds'


@dataclass(frozen=True, eq=False)
class Floor:
    """A world and the poses (N, 3) in it from which a robot may start."""

    name: str
    path: Path
    world: World
    starts: Array


def floors(folder: Path, wanted: str = '') -> list[Floor]:
    """All worlds of a folder whose name holds `wanted`, the largest last."""
    known = json.loads((folder / 'worlds.json').read_text(encoding='utf-8'))
    names = sorted(
        (name for name in known if wanted in name),
        key=lambda name: float(known[name]['free_area_m2']),
    )
    found = []
    for name in names:
        path = folder / f'{name}.yaml'
        found.append(
            Floor(name, path, World.from_patch(*read_world(path)), np.array(known[name]['starts']))
        )
    return found


def groups(folder: Path, wanted: str = '') -> Iterator[tuple[str, list[Floor]]]:
    """The worlds of each kind: the first part of their names, and they."""
    known = sorted(floors(folder, wanted), key=_kind)
    for kind, some in groupby(known, _kind):
        yield kind, list(some)


def _kind(floor: Floor) -> str:
    return floor.name.partition('/')[0]
