"""Make docs/results/exploration.md from the results of compare_exploration.

Usage: python -m benchmarks.exploration.page DIR [DIR ...] [--docs DOCS]. A file reliability.md of a
folder is the table of fit_belief.
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from benchmarks.charts import DOCS, OTHERS, Mark, Panel, picture, write_page
from thinmap_ros.core.errors import InputError
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.evaluation.slam_run import Origin
from thinmap_ros.evaluation.strategy_comparison import (
    OURS,
    by_strategy,
    half_interval_95,
    markdown,
    relative_saving,
)
from thinmap_ros.files.safe import read_text

Report = dict[str, Any]
_CHART = 'exploration'
_FULL_COVERAGE = 0.99
_KINDS = {'dungeon': 'Random worlds of 50 x 50 m', 'kth': 'Real floors of a university'}
_NEARLY_ALL = 0.995
_PEERS = ('nearest_frontier', 'explore_lite')  # what others drive by; the rest is thinmap's
_HEAD = """\
# Exploration: distance, time and coverage

{chart}
Simulated robots explore worlds that they do not know. Each section of runs states the laser, the
speed, the source of the poses, and the commit and machine. `python -m benchmarks release`
generates this page.

| strategy | what it is |
|---|---|
| `position_probability` | thinmap's default: position probability with the calibrated belief |
| `nearest_frontier` | the frontier with the shortest path (Yamauchi, 1997), in thinmap's code |
| `explore_lite` | the cost function of the ROS package explore_lite, in thinmap's code |
| `paper` | position probability as the paper prints it |
| `bounded_tour` | a short tour through the next targets |

All strategies have the same map, navigator and simulator; none is another program.
[Peers](peers.md) tells what that means for the comparison.

- *Distance*, *time* and *turns*: means, ± the mean standard deviation over the starts of a world.
- *Differences*: paired by world and start; an interval that includes zero shows no difference. The
  starts of one world are not independent: the intervals are rather too narrow.
- *Coverage*: share of the area that is observable from where the robot can be.
- *Reversals*: returns to the target before the last.
- *Decision*: median CPU time. *Times real time*: on one core, next to other load.

The strategies are described in [Exploration: theory](../theory/exploration.md).
"""
_BELIEF = """\
## Calibration of the belief

The belief is the probability that nothing is hidden behind a frontier candidate. It is evaluated on
20 generated buildings, four dungeons and a floor on which it was not fitted
(`python -m benchmarks.exploration.fit_belief -o DIR`); `core/exploration/fitted.py` tells on
which it was. Nothing is hidden if less than 0.5 m2 of observable area lies behind the frontier.
Each candidate counts once.

"""
_NOTES = """\
## Position probability of the paper and calibrated belief

The strategy `paper` uses the position probability as the paper prints it. The probability starts
at 0.5, and rises with the observations of an end node: by their distance and by the angles between
them. The robot visits an end node only while its probability is below 0.9.

- **Where the claims hold**: in the room of the paper (10 x 10 m) the robot observes the entire
  environment, and never visits some of the end nodes ([Experiments of the papers](papers.md)).
- **Where they do not hold**: in larger buildings. The end of a skeleton at the edge of the known
  area is observed often and from a short distance. Its probability rises although a room is hidden
  behind it. The exploration stops early, as the coverage of `paper` in the tables shows.
- **Efficiency**: the tables compare the distances in pairs. If an interval includes zero, neither
  strategy is shown to be shorter.
- **What the calibrated belief changes**: the strategy `position_probability` keeps the threshold of
  the paper. Its probability depends on the length of the frontier, on the unknown space in line of
  sight behind it, and on the depth of the unknown straight behind it. These predict hidden area
  better than observations do: with them, distance and angle add nothing.

There is no parameter for a share of the area that may remain unexplored. It would not shorten the
path, as no observation distinguishes the last room from the last niche. The report states the area
that is probably missing instead.
"""


def write(folders: list[Path], docs: Path) -> Path:
    """Write the page of folders of compare_exploration and fit_belief, and its chart.

    Returns its path. Raises InputError where no folder has reports.
    """
    tables = [folder / 'reliability.md' for folder in folders]
    reliability = '\n'.join(read_text(table) for table in tables if table.exists())
    reports = [
        {'made': provenance(folder), **report}
        for folder in folders
        if (folder / 'reports.json').exists()
        for report in json.loads(read_text(folder / 'reports.json'))
    ]
    if not reports:
        raise InputError(f'{folders[0]}: no reports.json: expected folders of compare_exploration')
    path = docs / 'results' / f'{_CHART}.md'
    return write_page(path, page(reports, reliability), [panel(reports)], _KEYS)


def page(reports: list[Report], reliability: str = '') -> str:
    """Text of the page: a section for each kind of world and options of the exploration.

    reports: each with a line `made` of commit and machine; reliability: table of `fit_belief`.
    """
    caption = 'Distance of thinmap relative to other strategies; left of the line: thinmap drives '
    caption += 'less. Worlds, range of the laser: strategy. Bars: 95 % confidence intervals of '
    caption += 'paired runs.'
    parts = [_HEAD.format(chart=picture(_CHART, caption))]
    for title, chosen in _sections(reports).items():
        worlds = sorted({report['world'] for report in chosen})
        parts += [
            f'## {title}\n',
            f'Worlds: {", ".join(worlds)}.\n',
            *(f'{made}.\n' for made in dict.fromkeys(report['made'] for report in chosen)),
            markdown(chosen),
            *_verdicts(chosen),
        ]
    belief = [_BELIEF + reliability] if reliability else []
    return '\n'.join([*parts, *belief, _NOTES])


def _sections(reports: list[Report]) -> dict[str, list[Report]]:
    """Reports by kind of world and conditions, by the titles of their sections."""
    found: dict[tuple[str, str], list[Report]] = defaultdict(list)
    for report in reports:
        found[report['world'].split('-')[0], _conditions(report['options'])].append(report)
    return {
        f'{_KINDS.get(kind, kind)} ({len({r["world"] for r in some})}): {conditions}': some
        for (kind, conditions), some in found.items()
    }


_KEYS = (('nearest frontier, explore_lite', OTHERS[Origin.TEAM], True),)


def panel(reports: list[Report]) -> Panel:
    """Differences of distance to what others drive by, a row for each section and strategy.

    The range of the laser tells sections of the same worlds apart.
    """
    marks = []
    for title, chosen in _sections(reports).items():
        runs = by_strategy(chosen)
        where = f'{title.split(":")[0]}, {chosen[0]["options"]["laser"]["range_max_m"]:g} m'
        for name in _PEERS:
            shares = relative_saving(runs.get(OURS, {}), runs.get(name, {}), 'distance')
            if len(shares) > 1:
                marks.append(difference(f'{where}: {name}', shares))
    return Panel('', 'difference of the distance (%)', marks, limit=0.0)


def difference(row: str, shares: Array) -> Mark:
    """Mark of relative differences (N,), in percent, with their confidence interval."""
    mean = 100.0 * float(shares.mean())
    half = 100.0 * half_interval_95(shares)
    return Mark(row, mean, OTHERS[Origin.TEAM], mean - half, mean + half)


def _conditions(options: dict[str, Any]) -> str:
    laser = options['laser']
    known = options['localization'] == 'truth'
    return (
        f'{laser["beams"]} beams over {laser["field_of_view_deg"]:g} degrees, '
        f'{laser["range_max_m"]:g} m, '
        f'{options["speed_m_s"]:g} m/s, poses {"known" if known else "by SLAM"}'
    )


def _verdicts(reports: list[Report]) -> list[str]:
    """Faults of position_probability, and pairs in which another strategy is shorter."""
    runs = by_strategy(reports)
    ours = runs.pop(OURS, {})
    lines = [_fault(report) for report in ours.values() if not _is_good(report)]
    if ours and not lines:
        count = f'{len(ours)} of {len(ours)}'
        share = f'{_FULL_COVERAGE:.0%} or more'
        lines = [
            f'{OURS}: {count} runs stopped by themselves, with a coverage of {share} and '
            'without collisions.'
        ]
    lines += [
        _pose_error(report)
        for report in ours.values()
        if report['options']['localization'] != 'truth'
    ]
    if ours:
        rest = sum(_after(report, _NEARLY_ALL) for report in ours.values()) / len(ours)
        lines.append(
            f'After a coverage of {_NEARLY_ALL:.1%}, {OURS} drove {rest:.1%} of its path (mean).'
        )
    for name, theirs in sorted(runs.items()):
        longer = relative_saving(ours, theirs, 'distance')
        if (longer > 0.0).any():
            lines.append(
                f'{name} has a shorter path in {int((longer > 0.0).sum())} of {len(longer)} pairs; '
                f'that of {OURS} is up to {longer.max():.0%} longer.'
            )
    return [f'{line}\n' for line in lines]


def _after(report: Report, share: float) -> float:
    """Share of the path driven after a coverage was first measured; 0 where it never was."""
    along = [distance for _, distance, coverage in report['curve'] if coverage >= share]
    return 1.0 - along[0] / report['distance'] if along else 0.0


def _is_good(report: Report) -> bool:
    return bool(
        report['finished'] and report['coverage'] >= _FULL_COVERAGE and report['collisions'] == 0
    )


def _fault(report: Report) -> str:
    return (
        f'**{report["world"]}, start {report["start_number"]}**: {report["reason"]}; '
        f'coverage {report["coverage"]:.2%}, {report["collisions"]} collisions.'
    )


def _pose_error(report: Report) -> str:
    return (
        f'{report["world"]}, start {report["start_number"]}: '
        f'pose error {report["pose_rmse"]:.3f} m (rms), '
        f'{report["pose_rmse_aligned"]:.3f} m after alignment.'
    )


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(prog='benchmarks.exploration.page', description=__doc__)
    parser.add_argument('folders', nargs='+', type=Path, help='of compare_exploration, fit_belief')
    parser.add_argument('--docs', type=Path, default=DOCS, help='folder of the pages')
    arguments = parser.parse_args()
    print(write(arguments.folders, arguments.docs))


if __name__ == '__main__':
    main()
