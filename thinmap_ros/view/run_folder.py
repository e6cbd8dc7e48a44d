"""The folder of the results of a run: the same files from each program."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.se2 import Array
from thinmap_ros.core.topology.graph import TopologicalMap
from thinmap_ros.core.topology.regions import membership_of
from thinmap_ros.core.topology.segmentation import RegionConfig, find_regions
from thinmap_ros.files import graphs, occupancy_maps, trajectories
from thinmap_ros.files.safe import write_text
from thinmap_ros.view import report_page
from thinmap_ros.view.summary import summary_figure

# Stamps, ns, and poses (3,).
Trajectory = tuple[Sequence[int], Sequence[Array]]


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a run has made.

    trajectories: by the name of their files; estimated: poses (N, 3) for the picture; shown: more
    for it, as of `summary_figure`.
    """

    patch: GridPatch
    topology: TopologicalMap
    title: str
    trajectories: Mapping[str, Trajectory]
    estimated: Array = field(default_factory=lambda: np.empty((0, 3)))
    shown: Mapping[str, Any] = field(default_factory=dict)
    regions: RegionConfig = field(default_factory=RegionConfig)


def write_run(folder: Path, run: RunResult) -> None:
    """Write trajectories (NAME.tum), map, graph with regions, and picture into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (stamps_ns, poses) in run.trajectories.items():
        trajectories.write_tum(folder / f'{name}.tum', list(stamps_ns), list(poses))
    occupancy_maps.write_map(folder / 'map', run.patch)
    regions = find_regions(run.patch, run.regions)
    membership = membership_of(run.topology, regions)
    graphs.write_geojson(folder / 'topology.geojson', run.topology, membership)
    summary_figure(
        folder / 'summary.png',
        run.patch,
        run.topology,
        run.estimated,
        title=run.title,
        regions=regions,
        **run.shown,
    )


def write_report(folder: Path, title: str, report: dict[str, Any], command: str = '') -> None:
    """Write report.json beside the files of a run and, with its command, report.html."""
    write_text(folder / 'report.json', json.dumps(report, indent=2) + '\n')
    if command:
        report_page.write(folder, title, report, command)
