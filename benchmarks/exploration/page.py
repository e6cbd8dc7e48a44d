"""Make docs/results/exploration.md from the results of compare_exploration.

Usage: python -m benchmarks.exploration.page DIR [DIR ...]. A file reliability.md of a folder is the
table of fit_belief.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from thinmap_ros.evaluation.machine import provenance
from thinmap_ros.evaluation.strategy_comparison import OURS, markdown, relative_saving

Report = dict[str, Any]
_PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'results' / 'exploration.md'
_FULL_COVERAGE = 0.99
_KINDS = {'dungeon': 'Dungeons', 'kth': 'KTH floors'}
_NEARLY_ALL = 0.995
_HEAD = """\
# Exploration

{provenance}

`python -m benchmarks.exploration.page DIR ...` generates this page from folders of
`compare_exploration WORLD... -o DIR`. Each section states the laser, the speed and the source of
the poses.

- *Distance*, *time* and *turns*: means, ± the mean standard deviation over the starts of a world.
- *Coverage*: share of the area that is observable from where the robot can be.
- *Reversals*: returns to the target before the last.
- *Decision*: median CPU time. *Times real time*: on one core, next to other load.

The strategies are described in [Exploration: theory](../theory/exploration.md).
"""
_BELIEF = """\
## Calibration of the belief

The belief is the probability that nothing is hidden behind a frontier candidate. It is fitted on
100 generated buildings, four dungeons and a floor, and evaluated on 20 other buildings, four other
dungeons and another floor (`python -m benchmarks.exploration.fit_belief -o DIR`). Nothing is
hidden if less than 0.5 m2 of observable area lies behind the frontier. Each candidate counts once.

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


def page(reports: list[Report], reliability: str = '', made: str = '') -> str:
    """Text of the page: a section for each kind of world and options of the exploration.

    reliability: table of `fit_belief`; made: line of commit and machine.
    """
    sections: dict[tuple[str, str], list[Report]] = defaultdict(list)
    for report in reports:
        sections[report['world'].split('-')[0], _conditions(report['options'])].append(report)
    parts = [_HEAD.format(provenance=made)]
    for (kind, conditions), chosen in sections.items():
        worlds = {report['world'] for report in chosen}
        parts += [
            f'## {_KINDS.get(kind, kind)} ({len(worlds)}): {conditions}\n',
            f'Worlds: {", ".join(sorted(worlds))}.\n',
            markdown(chosen),
            *_verdicts(chosen),
        ]
    belief = [_BELIEF + reliability] if reliability else []
    return '\n'.join([*parts, *belief, _NOTES])


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
    by_strategy: dict[str, dict[tuple[str, int], Report]] = defaultdict(dict)
    for report in reports:
        by_strategy[report['strategy']][report['world'], report['start_number']] = report
    ours = by_strategy.pop(OURS, {})
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
    for name, theirs in sorted(by_strategy.items()):
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
    folders = [Path(word) for word in sys.argv[1:]]
    tables = [folder / 'reliability.md' for folder in folders]
    reliability = '\n'.join(table.read_text('utf-8') for table in tables if table.exists())
    reports = [
        report
        for folder in folders
        if (folder / 'reports.json').exists()
        for report in json.loads((folder / 'reports.json').read_text('utf-8'))
    ]
    # Folders that were made later may be of another commit; the table of fit_belief has none.
    made = dict.fromkeys(provenance(folder) for folder in folders if (folder / 'runs').exists())
    text = page(reports, reliability, '\n'.join(made))
    _PAGE.write_text(text, encoding='utf-8')


if __name__ == '__main__':
    main()
