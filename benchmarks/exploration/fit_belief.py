"""Compare the belief of the explorer with what is hidden in worlds that it was not fitted on.

Usage: python -m benchmarks.exploration.fit_belief -o DIR [--write [--buildings N]]. Explorations
are kept in DIR. With --write the belief is fitted first, and its constants go to
core/exploration/fitted.py.
"""

import argparse
import json
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.exploration.observed_candidates import COLUMNS, Case, generated, observe
from benchmarks.rows import markdown
from thinmap_ros.core.exploration import fitted
from thinmap_ros.core.exploration.belief import WORTH_SEEING_M2, BeliefModel
from thinmap_ros.core.exploration.fitted import FITTED
from thinmap_ros.core.se2 import Array
from thinmap_ros.evaluation.parallel_jobs import (
    add_run_options,
    failure_summary,
    provenance,
    run_pending,
)
from thinmap_ros.files.safe import read_text, write_text

FITTED_ON = ('dungeon/d114', 'dungeon/d1305', 'dungeon/d1336', 'dungeon/d1407', 'kth/50052749')
UNSEEN = ('dungeon/d1573', 'dungeon/d1641', 'dungeon/d2191', 'dungeon/d3230', 'kth/50052751')
_FIRST_FITTED_SEED = 2000
_FIRST_UNSEEN_SEED = 5000
_UNSEEN_BUILDINGS = 20
_COLUMNS = ('probability that nothing is hidden', 'candidates', 'predicted', 'observed')
_EDGES = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0001)
_AREA_QUANTILES = (0.05, 0.15, 0.3, 0.5, 0.75)
_STEPS = 60
_MAX_STEP = 2.0
_L2 = 1e-3
_PLACES = 3
_MIN_CANDIDATES = 100  # of a bin whose error counts


@dataclass(frozen=True, eq=False)
class Observed:
    """Candidates with a frontier: columns (N,) by name, and weights (N,), 1 for each candidate."""

    columns: dict[str, Array]
    weights: Array

    @property
    def hides_nothing(self) -> NDArray[np.bool_]:
        """Whether nothing worth seeing was behind, (N,)."""
        return np.asarray(self.columns['area_m2'] < WORTH_SEEING_M2)


def observed(paths: list[Path]) -> Observed:
    """Candidates of saved explorations."""
    tables = []
    for run, path in enumerate(paths):
        rows = np.array(json.loads(read_text(path))['rows']).reshape(-1, len(COLUMNS))
        tables.append(np.column_stack([rows, np.full(len(rows), run)]))
    table = np.vstack(tables)
    columns = dict(zip((*COLUMNS, 'run'), table.T, strict=True))
    pairs = np.column_stack([columns['run'], columns['evidence_id']])
    _, inverse, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    return Observed(columns, 1.0 / counts[inverse.ravel()])


def design(columns: dict[str, Array]) -> Array:
    """Terms of the log odds, (N, 5), in the order of the first fields of BeliefModel."""
    return np.column_stack(
        [
            np.ones(len(columns['length_m'])),
            np.log(np.maximum(columns['length_m'], 0.1)),
            np.log(np.maximum(columns['hidden_m2'], 0.05)),
            np.log(np.maximum(columns['depth_m'], 0.05)),
            columns['visits'],
        ]
    )


def logistic_fit(terms: Array, outcomes: Array, weights: Array) -> Array:
    """Coefficients (K,) of terms (N, K) that make outcomes (N,) most probable, by Newton steps."""
    coefficients = np.zeros(terms.shape[1])
    for _ in range(_STEPS):
        predicted = _sigmoid(terms @ coefficients)
        slope = terms.T @ (weights * (outcomes - predicted)) - _L2 * coefficients
        curvature = (terms * (weights * predicted * (1.0 - predicted))[:, None]).T @ terms
        step = np.linalg.solve(curvature + _L2 * np.eye(terms.shape[1]), slope)
        coefficients += step * min(1.0, _MAX_STEP / max(float(np.abs(step).max()), 1e-12))
    return coefficients


def fit(data: Observed) -> BeliefModel:
    """Constants of the belief."""
    nothing = data.hides_nothing
    coefficients = logistic_fit(design(data.columns), nothing.astype(float), data.weights)
    hidden = data.columns['hidden_m2'][~nothing]
    areas = data.columns['area_m2'][~nothing]
    weights = data.weights[~nothing]
    limits = np.unique(np.round(np.quantile(hidden, _AREA_QUANTILES), 1))
    bins = np.searchsorted(limits, hidden, side='right')
    # More in line of sight never means less behind it.
    means = np.maximum.accumulate(
        [
            float(np.average(areas[bins == k], weights=weights[bins == k]))
            for k in range(len(limits) + 1)
        ]
    )
    rounded = np.round(coefficients, _PLACES).tolist()
    names = (field.name for field in fields(BeliefModel))
    values = [*rounded, tuple(limits.tolist()), tuple(np.round(means, 1).tolist())]
    return BeliefModel(**dict(zip(names, values, strict=True)))


def predicted(model: BeliefModel, columns: dict[str, Array]) -> Array:
    """Probability (N,) that nothing is behind."""
    values = [getattr(model, field.name) for field in fields(model)][:5]
    return _sigmoid(design(columns) @ np.array(values))


def reliability_table(probabilities: Array, data: Observed) -> list[str]:
    """Lines of a table: predicted against observed share, by bins; and the scores."""
    nothing = data.hides_nothing.astype(float)
    weights = data.weights
    rows = []
    worst = error = 0.0
    for low, high in pairwise(_EDGES):
        inside = (probabilities >= low) & (probabilities < high)
        count = weights[inside].sum()
        if count < 1.0:
            continue
        p = np.average(probabilities[inside], weights=weights[inside])
        share = np.average(nothing[inside], weights=weights[inside])
        error += count * abs(p - share)
        if count >= _MIN_CANDIDATES:
            worst = max(worst, abs(p - share))
        bounds = f'{low:.2f} to {min(high, 1.0):.2f}'
        rows.append((bounds, f'{count:.0f}', f'{p:.3f}', f'{share:.3f}'))
    brier = np.average((probabilities - nothing) ** 2, weights=weights)
    return [
        markdown(_COLUMNS, rows),
        '',
        f'Brier score {brier:.4f}; mean error {error / weights.sum():.3f}; largest error of a bin '
        f'with at least {_MIN_CANDIDATES} candidates {worst:.3f}.',
    ]


def source(model: BeliefModel) -> str:
    """Text of belief/fitted.py."""
    values = '\n'.join(f'    {f.name}={getattr(model, f.name)!r},' for f in fields(model))
    return (
        '"""Constants of the belief about candidates.\n\n'
        'Written by `python -m benchmarks.exploration.fit_belief --write`, '
        f'{datetime.now(UTC):%Y-%m-%d}.\nFit again instead of editing.\n"""\n\n'
        'from thinmap_ros.core.exploration.belief import BeliefModel\n\n'
        f'FITTED = BeliefModel(\n{values}\n)\n'
    )


def _sigmoid(log_odds: Array) -> Array:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -30.0, 30.0))))


def _explored(names: list[str], arguments: argparse.Namespace) -> Observed:
    cases = [Case(name) for name in names]

    def file_of(case: Case) -> Path:
        return Path(arguments.out) / f'{case.name.replace("/", "_")}.json'

    failures = run_pending(observe, cases, file_of, arguments)
    if failures:
        raise failure_summary(failures)
    return observed([file_of(case) for case in cases])


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('-o', '--out', type=Path, required=True, help='folder for explorations')
    parser.add_argument('--buildings', type=int, default=100, help='with --write: to fit on')
    parser.add_argument('--write', action='store_true', help='fit, and write the constants')
    add_run_options(parser)
    arguments = parser.parse_args()
    models = {'present': FITTED}
    if arguments.write:
        fitted_on = [*generated(_FIRST_FITTED_SEED, arguments.buildings), *FITTED_ON]
        models['fitted'] = fit(_explored(fitted_on, arguments))
    test = _explored([*generated(_FIRST_UNSEEN_SEED, _UNSEEN_BUILDINGS), *UNSEEN], arguments)
    for name, model in models.items():
        table = reliability_table(predicted(model, test.columns), test)
        print(f'\n{name}: {model}\n', *table, sep='\n')
    # Of the constants that hold from now on: the last ones.
    lines = [*table, '', f'{provenance()}.']
    write_text(arguments.out / 'reliability.md', '\n'.join(lines) + '\n')
    if arguments.write:
        write_text(Path(fitted.__file__), source(model))


if __name__ == '__main__':
    main()
