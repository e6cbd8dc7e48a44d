"""Comparison of two runs of the scoreboard."""

from collections.abc import Sequence

import numpy as np

from benchmarks.rows import markdown
from benchmarks.scoreboard.cases import Case
from benchmarks.scoreboard.page import MAX_ERROR_M, errors, worst_tenth
from benchmarks.scoreboard.played import Numbers

_SAME = 0.05  # a change of an error by a smaller share, or by less than 5 mm, is not listed
_SAME_M = 0.005


def against(
    cases: Sequence[Case], reports: Sequence[Numbers], others: Sequence[Numbers | None]
) -> str:
    """Markdown: live errors of both runs in their common cases, those that increase first."""
    both = [k for k, other in enumerate(others) if other is not None]
    common = [cases[k] for k in both]
    ours = [reports[k] for k in both]
    theirs = [other for other in others if other is not None]
    here = errors(common, ours)
    there = errors(common, theirs)
    ratio = (here + 1e-6) / (there + 1e-6)
    lines = [
        f'## Comparison with another run ({len(both)} of {len(cases)} cases)\n',
        f'Live error: median of the ratios {np.median(ratio):.3f}; worst tenth '
        f'{worst_tenth(common, ours):.3f} m (other run {worst_tenth(common, theirs):.3f} m); '
        f'{MAX_ERROR_M:g} m or failed: {np.count_nonzero(here >= MAX_ERROR_M)} '
        f'(other run {np.count_nonzero(there >= MAX_ERROR_M)}). '
        f'Changes by more than {_SAME:.0%} and '
        f'{1000 * _SAME_M:.0f} mm:\n',
    ]
    changed = (np.abs(ratio - 1.0) > _SAME) & (np.abs(here - there) > _SAME_M)
    rows = [
        (common[k].name, f'{here[k]:.3f}', f'{there[k]:.3f}', f'{ratio[k]:.2f}')
        for k in np.argsort(-ratio, kind='stable')
        if changed[k]
    ]
    columns = ('case', 'this run (m)', 'other run (m)', 'ratio')
    return '\n'.join([*lines, markdown(columns, rows), ''])
