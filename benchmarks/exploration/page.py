"""Make docs/results/exploration.md of what compare_exploration left.

Usage: python -m benchmarks.exploration.page DIR [DIR ...]. A file reliability.md of a folder is the
table of fit_belief.
"""

import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

from thinmap_ros.evaluation.strategy_comparison import OURS, markdown, relative_saving

Report = dict[str, Any]
_PAGE = Path(__file__).resolve().parents[2] / 'docs' / 'results' / 'exploration.md'
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
_BELIEF = """\
## Does the belief come true?

Fitted on 100 generated buildings, four dungeons and a floor; compared on 20 other buildings, four
other dungeons and another floor (`python -m benchmarks.exploration.fit_belief -o DIR`). A
candidate hides nothing if less than 0.5 m2 of what can be observed is behind its frontier. Each
candidate counts once.

"""
_NOTES = """\
## The paper and the belief

The paper visits an end node only while its position probability is below 0.9, starts at 0.5, and
counts how near and from which angles it was seen. That works in its room of 10 x 10 m, and some
end nodes are never visited there. In larger buildings it does not hold: the end of a skeleton at
the rim of the known is seen often and from near, so that its probability rises although a room is
behind it, and the exploration stops early. How long the open frontier is, and how much unknown
space is in line of sight behind it, tell more than views do; once they are known, distance and
angle add almost nothing (weight 0.04 of their log odds). The belief keeps the paper's form, with
the frontier as the prior.

A share of the area that may be left, promised by the user, saves no path: nothing that can be
seen tells the last room from the last niche. So there is no such parameter; what is probably
missing is reported instead.
"""


def page(reports: list[Report], reliability: str = '') -> str:
    """Text of the page: a section for each kind of world and options of the exploration.

    reliability: table of `fit_belief`.
    """
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
    _PAGE.write_text(page(reports, reliability), encoding='utf-8')


if __name__ == '__main__':
    main()
