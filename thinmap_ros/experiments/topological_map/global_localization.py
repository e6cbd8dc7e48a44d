"""Paper 1, Fig. 10 and 11: 5,000 samples of a global localization converge to one place."""

from dataclasses import dataclass
from itertools import islice

import numpy as np

from thinmap_ros.core.grid.patch import GridPatch
from thinmap_ros.core.places.global_localizer import GlobalLocalization, Result, SearchState
from thinmap_ros.core.se2 import Array, wrap
from thinmap_ros.core.topology.graph import TopologyConfig
from thinmap_ros.core.topology.topology import build
from thinmap_ros.evaluation.outcome import Comparison, Outcome, Rows, Table
from thinmap_ros.experiments.drives import SETUP, Source, grid_of
from thinmap_ros.sim.drives import DriveSample
from thinmap_ros.view.plots import Curve, MapLayer, Panel, Plot, RobotMarkers, xy


@dataclass(frozen=True)
class _Setup:
    """Runs and pictures, what the paper reports, and what counts as success.

    shown: steps of the paper's pictures; 0: before the first. seeds, quick_seeds: runs.
    paper_steps: until one position is left. candidate_weight: of a candidate, or more.
    right_m, right_deg: largest errors of a right position.
    """

    shown: tuple[int, ...]
    seeds: int
    quick_seeds: int
    paper_steps: int
    candidate_weight: float
    right_m: float
    right_deg: float


_SETUP = _Setup(
    shown=(0, 2, 7, 11),
    seeds=20,
    quick_seeds=2,
    paper_steps=11,
    candidate_weight=0.01,
    right_m=0.3,
    right_deg=10.0,
)


def run(source: Source) -> Outcome:
    """Localize on one drive with many seeds of the samples; the first one is drawn."""
    patch = grid_of(source.samples('lab_stops')).known_area()
    topology = build(patch, (2.0, 2.0), TopologyConfig())
    drive_samples = list(islice(source.samples('lab_lost'), 0, None, SETUP.scans_per_lost_step))
    rows: Rows = []
    steps: Rows = []
    panels = []
    runs = _SETUP.quick_seeds if source.quick else _SETUP.seeds
    seeds = range(source.seed, source.seed + runs)
    for seed in seeds:
        finder = GlobalLocalization(patch, topology, seed=seed)
        if seed == source.seed:
            panels.append(_panel(patch, finder.samples, None, 0))
        first = None
        for step, sample in enumerate(drive_samples, 1):
            result = finder.step(sample.scan, sample.T_odom_base)
            state = SearchState(result.state).name.lower()
            rows.append([seed, step, _candidates(result), state, *_error(result, sample)])
            if first is None and result.pose is not None:
                first = step
                steps.append([seed, step, *_error(result, sample), int(_is_right(result, sample))])
            if seed == source.seed and step in _SETUP.shown:
                panels.append(_panel(patch, finder.samples, sample, step))
    taken = np.array([row[1] for row in steps])
    right = sum(bool(row[4]) for row in steps)
    worst = float(np.max([row[2] for row in steps]))
    return Outcome(
        'Global localization: 5,000 samples converge',
        'Topological map paper, sections 3.1 and 4.2, Fig. 10 and 11',
        'The robot starts at (2 m, 2 m, 270 deg) of the laboratory, with the map of the twelve '
        'stops and an unknown pose. '
        f'A step is {0.2 * SETUP.scans_per_lost_step:g} s, up to 0.3 m. '
        f'The same drive is localized with {len(seeds)} seeds of the samples.',
        [
            Table('steps', ['seed', 'step', 'candidates', 'state', 'error_m', 'error_deg'], rows),
            Table('convergence', ['seed', 'steps', 'error_m', 'error_deg', 'right'], steps),
        ],
        [_samples(panels), _curve(rows, len(drive_samples))],
        [
            Comparison(
                'steps until one position is left',
                f'{_SETUP.paper_steps}',
                f'median {np.median(taken):.0f}, maximum {taken.max()}, '
                f'in {len(taken)} of {len(seeds)} runs',
                len(taken) == len(seeds) and int(taken.max()) <= _SETUP.paper_steps,
            ),
            Comparison(
                'that position is correct',
                'yes',
                f'{right} of {len(seeds)} runs, largest error {worst:.2f} m',
                right == len(seeds),
            ),
        ],
    )


def _candidates(result: Result) -> int:
    return sum(hypothesis.weight >= _SETUP.candidate_weight for hypothesis in result.hypotheses)


def _error(result: Result, sample: DriveSample) -> tuple[float | None, float | None]:
    """Error of the most likely hypothesis, m and degrees."""
    if not result.hypotheses:
        return None, None
    off = result.hypotheses[0].T_map_base - sample.T_world_base
    return float(np.hypot(off[0], off[1])), float(np.degrees(abs(wrap(float(off[2])))))


def _is_right(result: Result, sample: DriveSample) -> bool:
    metres, degrees = _error(result, sample)
    return (
        metres is not None
        and degrees is not None
        and metres <= _SETUP.right_m
        and degrees <= _SETUP.right_deg
    )


def _panel(patch: GridPatch, samples: Array, sample: DriveSample | None, step: int) -> Panel:
    title = f'after {step} steps' if step else f'at the start: {len(samples)} samples'
    robot = [] if sample is None else [RobotMarkers(sample.T_world_base[None])]
    return Panel(
        [MapLayer(patch), Curve(samples[:, :2], 'samples', 1, '', '.', size=1.5), *robot], title
    )


def _samples(panels: list[Panel]) -> Plot:
    caption = 'Paper 1, Fig. 10 and 11: the samples at the start and after 2, 7 and 11 steps.'
    return Plot('fig10_11', caption, panels, columns=2, panel_inches=(6.0, 3.4))


def _curve(rows: Rows, steps: int) -> Plot:
    layers = []
    table = np.array([[float(str(row[0])), float(str(row[1])), float(str(row[2]))] for row in rows])
    for k, seed in enumerate(np.unique(table[:, 0])):
        mine = table[table[:, 0] == seed]
        label = 'one seed each' if k == 0 else ''
        layers.append(Curve(xy(mine[:, 1], np.maximum(mine[:, 2], 0.5)), label, 5, width=0.8))
    median = [float(np.median(table[table[:, 1] == step, 2])) for step in range(1, steps + 1)]
    layers.append(
        Curve(xy(np.arange(1.0, steps + 1.0), np.array(median)), 'median', 0, marker='o', width=2.0)
    )
    panel = Panel(layers, '', 'step', 'candidate positions', plan=False, log_y=True)
    caption = 'Paper 1, to Fig. 11: candidate positions (of at least 1 % of the weight) over steps.'
    return Plot('candidates', caption, [panel], panel_inches=(6.5, 3.6), legend='inside')
