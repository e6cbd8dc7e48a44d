"""Results as rows: what was measured, the value, and what it should be."""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """One measurement; good: whether the value is as it should be, None where there is no target."""

    what: str
    value: str
    target: str = ''
    good: bool | None = None


def at_most(what: str, value: float, limit: float, unit: str = '') -> Row:
    """Row of a value that should not be above a limit."""
    return Row(what, f'{value:.3g} {unit}'.strip(), f'at most {limit:g} {unit}'.strip(), value <= limit)


def at_least(what: str, value: float, limit: float, unit: str = '') -> Row:
    """Row of a value that should not be below a limit."""
    return Row(what, f'{value:.4g} {unit}'.strip(), f'at least {limit:g} {unit}'.strip(), value >= limit)


def show(rows: Iterable[Row]) -> None:
    """Print rows under each other, each as soon as it is there."""
    for row in rows:
        verdict = {True: 'ok', False: 'MISSED', None: ''}[row.good]
        print(f'{row.what:<58} {row.value:>16}  {row.target:<18} {verdict}', flush=True)
