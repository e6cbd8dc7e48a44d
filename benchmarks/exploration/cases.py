"""Worlds to explore, by name: `building/SEED/AREA` is generated, all others are given."""

from functools import cache
from pathlib import Path

import numpy as np

from benchmarks.buildings import BuildingConfig, generate_building
from benchmarks.worlds import WORLDS, Floor, floors
from thinmap_ros.core.se2 import Array
from thinmap_ros.sim.world import World

_GENERATED = 'building/'


def load_case(name: str, start: int = 0) -> tuple[World, Array]:
    """World and start (3,) of a case; a generated one has one start."""
    if not name.startswith(_GENERATED):
        floor = _given()[name]
        return floor.world, floor.starts[start]
    _, seed, area_m2 = name.split('/')
    config = BuildingConfig(
        area_m2=float(area_m2), people_per_1000_m2=0.0, moving_doors=0.0, glass_share=0.0
    )
    world = generate_building(int(seed), config).world
    return world, np.asarray(world.start)


def generated(first_seed: int, count: int) -> list[str]:
    """Names of generated buildings of 300 to 900 m2."""
    return [f'{_GENERATED}{seed}/{300 + 100 * (seed % 7)}' for seed in _seeds(first_seed, count)]


def _seeds(first_seed: int, count: int) -> range:
    return range(first_seed, first_seed + count)


@cache
def _given(folder: Path = WORLDS) -> dict[str, Floor]:
    return {floor.name: floor for floor in floors(folder)}
