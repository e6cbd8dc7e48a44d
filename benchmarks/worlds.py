"""Real floors and random worlds to measure on.

map_server maps in a folder, with places to start from.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.files.package_data import world_path
from thinmap_ros.files.worlds import read_world
from thinmap_ros.sim.world import World

SHARED = Path(__file__).resolve().parents[2] / 'shared'
WORLDS = SHARED / 'data' / 'worlds'


@dataclass(frozen=True, eq=False)
class Floor:
    """A world and the poses (N, 3) in it from which a robot may start."""

    name: str
    path: Path
    world: World
    starts: Array


@lru_cache(maxsize=2)
def floor(name: str, folder: Path = WORLDS) -> Floor:
    """A world of a folder, or a file or world of the package with its one start.

    Raises InputError where there is none of that name.
    """
    known = _listed(folder)
    path = folder / f'{name}.yaml' if name in known else world_path(name)
    world = World.from_patch(*read_world(path))
    starts = known[name]['starts'] if name in known else world.start[None]
    return Floor(name, path, world, np.array(starts))


def floors(folder: Path, wanted: str = '') -> list[Floor]:
    """All worlds of a folder whose name holds `wanted`, the largest last."""
    known = _listed(folder)
    if not known:
        raise InputError(f'{folder}: no worlds.json in it: expected a folder of worlds')
    names = sorted(
        (name for name in known if wanted in name),
        key=lambda name: float(known[name]['free_area_m2']),
    )
    return [floor.__wrapped__(name, folder) for name in names]


def groups(folder: Path, wanted: str = '') -> Iterator[tuple[str, list[Floor]]]:
    """The worlds of each kind: the first part of their names, and they."""
    known = sorted(floors(folder, wanted), key=_kind)
    for kind, some in groupby(known, _kind):
        yield kind, list(some)


def _kind(floor: Floor) -> str:
    return floor.name.partition('/')[0]


def _listed(folder: Path) -> dict[str, Any]:
    """Start poses and free area of the worlds of a folder, by name."""
    file = folder / 'worlds.json'
    return dict(json.loads(file.read_text(encoding='utf-8'))) if file.exists() else {}
