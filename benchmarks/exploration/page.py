"""Make docs/exploration.md of what compare_exploration left.

Usage: python -m benchmarks.exploration.page DIR [DIR ...].
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from thinmap_ros.evaluation.strategy_comparison import OURS, markdown, relative_saving

Report = dict[str, Any]
_PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'exploration.md'
_FULL_COVERAGE = 0.99
_NEARLY_ALL = 0.995
_HEAD = """\
# Exploration, measured

Made by `python -m benchmarks.exploration.page DIR ...` of the folders that
`compare_exploration WORLD... -o DIR` left, with the options that each section names. Distance, time
and turns are means ± the mean spread over the starts of a world; coverage is the share of what
could be seen from where the robot can get to; a contact is a collision. Times are of the processor,
on a machine that did other things as well.
"""
_NOTES = """\
## What was tried for the order of targets

In a model of such worlds with cells of half a metre: the nearest place from which the unknown can
be seen; tours through all places with other costs of waiting, or that come back; ways through the
unknown or not; the distance-advantage rule; a laser that sees all around; an oracle that told how
much is hidden behind each border. None was clearly better than the default, a tour through all. One
turn at the first fork decides a lot, so that single worlds scatter widely.

Borders seen in pieces, with gaps of a cell, counted as one: doorways that specks almost shut are
then looked into, for more way in most worlds, where there are no such doorways. Not taken.
"""


def page(reports: list[Report]) -> str:
    """Text of the page: a section for each kind of world and options of the exploration."""
    sections: dict[tuple[str, str], list[Report]] = defaultdict(list)
    for report in reports:
        sections[report['world'].split('-')[0], _conditions(report['options'])].append(report)
    parts = [_HEAD]
    for (kind, conditions), chosen in sections.items():
        worlds = {report['world'] for report in chosen}
        parts += [
            f'## {kind} ({len(worlds)}): {conditions}\n',
            markdown(chosen),
            *_verdicts(chosen),
        ]
    return '\n'.join([*parts, _NOTES])


def _conditions(options: dict[str, Any]) -> str:
    laser = options['laser']
    known = options['localization'] == 'truth'
    return (
        f'{laser["beams"]} beams over {laser["field_of_view_deg"]:g} degrees, '
        f'{laser["range_max_m"]:g} m, '
        f'{options["speed_m_s"]:g} m/s, poses {"known" if known else "by SLAM"}'
    )


def _verdicts(reports: list[Report]) -> list[str]:
    """What went wrong in ours, and where another one is shorter."""
    by_strategy: dict[str, dict[tuple[str, int], Report]] = defaultdict(dict)
    for report in reports:
        by_strategy[report['strategy']][report['world'], report['start_number']] = report
    ours = by_strategy.pop(OURS, {})
    lines = [_fault(report) for report in ours.values() if not _is_good(report)]
    if ours and not lines:
        count = f'{len(ours)} of {len(ours)}'
        share = f'{_FULL_COVERAGE:.0%} or more'
        lines = [f'{OURS}: {count} stopped by itself, with {share}, without contact.']
    lines += [
        _pose_error(report)
        for report in ours.values()
        if report['options']['localization'] != 'truth'
    ]
    if ours:
        rest = sum(_after(report, _NEARLY_ALL) for report in ours.values()) / len(ours)
        lines.append(
            f'After {_NEARLY_ALL:.1%} were seen, {OURS} drove {rest:.1%} of its way (mean).'
        )
    for name, theirs in sorted(by_strategy.items()):
        longer = relative_saving(ours, theirs, 'distance')
        if (longer > 0.0).any():
            lines.append(
                f'{name} drove less in {int((longer > 0.0).sum())} of {len(longer)} pairs; '
                f'{OURS} drove up to {longer.max():.0%} more.'
            )
    return [f'{line}\n' for line in lines]


def _after(report: Report, share: float) -> float:
    """Share of the whole way driven after a coverage was first measured; 0 where it never was."""
    along = [distance for _, distance, coverage in report['curve'] if coverage >= share]
    return 1.0 - along[0] / report['distance'] if along else 0.0


def _is_good(report: Report) -> bool:
    return bool(
        report['finished'] and report['coverage'] >= _FULL_COVERAGE and report['collisions'] == 0
    )


def _fault(report: Report) -> str:
    return (
        f'**{report["world"]}, start {report["start_number"]}**: {report["reason"]}; '
        f'coverage {report["coverage"]:.2%}, {report["collisions"]} contacts.'
    )


def _pose_error(report: Report) -> str:
    return (
        f'{report["world"]}, start {report["start_number"]}: '
        f'pose error {report["pose_rmse"]:.3f} m (rms).'
    )


def main() -> None:
    """Write the page."""
    folders = [Path(word) for word in sys.argv[1:]]
    reports = [
        report
        for folder in folders
        for report in json.loads((folder / 'reports.json').read_text('utf-8'))
    ]
    _PAGE.write_text(page(reports), encoding='utf-8')


if __name__ == '__main__':
    main()
