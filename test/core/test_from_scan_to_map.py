"""A scan goes through the files that the page on the architecture names."""

import cProfile
import pstats
import re
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import thinmap_ros
from thinmap_ros.files.package_data import world_path
from thinmap_ros.files.worlds import read_world
from thinmap_ros.pipeline import Pipeline
from thinmap_ros.sim.drives import random_drive, random_start
from thinmap_ros.sim.world import World

PACKAGE = Path(thinmap_ros.__file__).parent
PAGE = PACKAGE.parent / 'docs' / 'development' / 'architecture.md'
SEED = 2
WARM = 60  # scans: the map and its first keyframes are there
MAX_CALLS = 700


def documented() -> list[tuple[list[str], str]]:
    """Files of each row of the table, and the function that it names."""
    section = PAGE.read_text().split('## From a scan to the map')[1].split('\n## ')[0]
    rows = re.findall(r'^\| (`.+?) \| `(\w+)` \|', section, re.MULTILINE)
    return [(re.findall(r'`([\w/]+)`', files), function) for files, function in rows]


@pytest.fixture(scope='module')
def calls() -> dict[tuple[str, str], float]:
    """Calls of each file and function of the package for a scan of a drive."""
    world = World.from_patch(*read_world(world_path('office')))
    start = random_start(world, np.random.default_rng(SEED))
    drive = list(islice(random_drive(world, start, SEED), 2 * WARM))
    pipeline = Pipeline()
    for sample in drive[:WARM]:
        pipeline.step(sample.scan, sample.T_odom_base)
    profile = cProfile.Profile()
    profile.enable()
    for sample in drive[WARM:]:
        pipeline.step(sample.scan, sample.T_odom_base)
    profile.disable()
    found: dict[tuple[str, str], float] = {}
    for (file, _, function), (_, count, *_) in pstats.Stats(profile).stats.items():
        path = Path(file)
        if path.is_relative_to(PACKAGE):
            key = (str(path.relative_to(PACKAGE).with_suffix('')), function)
            found[key] = found.get(key, 0.0) + count / WARM
    return found


def test_each_function_of_the_table_is_called(calls):
    called = set(calls)
    assert documented()
    missed = [row for row in documented() if not any((file, row[1]) in called for file in row[0])]
    assert not missed


def test_a_scan_touches_no_other_file(calls):
    told = {file for files, _ in documented() for file in files}
    assert {file for file, _ in calls if not file.startswith('jit')} <= told


def test_a_scan_makes_few_calls(calls):
    assert sum(calls.values()) < MAX_CALLS
