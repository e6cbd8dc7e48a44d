"""The fit of the belief: coefficients, reliability, and what is hidden behind a frontier."""

import json
import sys
from dataclasses import fields

import numpy as np
import pytest

from benchmarks.exploration.fit_belief import (
    UNSEEN,
    fit,
    logistic_fit,
    main,
    observed,
    predicted,
    reliability_table,
    source,
)
from benchmarks.exploration.observed_candidates import COLUMNS, Case, generated, hidden_areas
from thinmap_ros.core.exploration.fitted import FITTED
from thinmap_ros.core.grid.patch import GridFrame, GridPatch
from thinmap_ros.evaluation.parallel_jobs import provenance
from thinmap_ros.sim.coverage import ObservableCells


def candidates(folder, count=4000):
    """Saved exploration whose outcomes follow the present model."""
    rng = np.random.default_rng(5)
    length = rng.uniform(0.5, 8.0, count)
    hidden = rng.uniform(0.1, 30.0, count)
    depth = rng.uniform(0.1, 1.0, count)
    features = zip(length, hidden, depth, strict=True)
    p = np.array([FITTED.probability(*frontier) for frontier in features])
    area = np.where(rng.random(count) < p, 0.0, 0.6 + hidden)
    columns = {
        'evidence_id': np.arange(count),
        'length_m': length,
        'hidden_m2': hidden,
        'depth_m': depth,
        'probability': p,
        'area_m2': area,
    }
    rows = np.column_stack([columns.get(name, np.zeros(count)) for name in COLUMNS])
    path = folder / 'one.json'
    path.write_text(json.dumps({'rows': rows.tolist()}))
    return observed([path]), p


def test_a_fit_finds_the_coefficients_that_made_the_outcomes():
    rng = np.random.default_rng(1)
    terms = np.column_stack([np.ones(20_000), rng.normal(size=(20_000, 2))])
    expected = np.array([0.5, -1.5, 2.0])
    outcomes = (rng.random(20_000) < 1.0 / (1.0 + np.exp(-terms @ expected))).astype(float)
    assert logistic_fit(terms, outcomes, np.ones(20_000)) == pytest.approx(expected, abs=0.1)


def test_a_fitted_model_predicts_what_the_explorer_believes(tmp_path):
    data, p = candidates(tmp_path)
    assert predicted(FITTED, data.columns) == pytest.approx(p)
    model = fit(data)
    assert predicted(model, data.columns) == pytest.approx(p, abs=0.08)
    assert list(model.mean_area_m2) == sorted(model.mean_area_m2)
    assert len(model.mean_area_m2) == len(model.area_limits_m2) + 1
    table = reliability_table(predicted(model, data.columns), data)
    assert float(table[-1].split('mean error ')[1].split(';')[0]) < 0.03


@pytest.mark.programs
def test_the_published_table_is_that_of_the_present_constants(tmp_path, monkeypatch):
    data, _ = candidates(tmp_path)
    kept = (tmp_path / 'one.json').read_text()
    for name in (*generated(5000, 20), *UNSEEN):
        (tmp_path / f'{Case(name).name.replace("/", "_")}.json').write_text(kept)
    monkeypatch.setattr(sys, 'argv', ['fit_belief', '-o', str(tmp_path)])
    main()
    written = (tmp_path / 'reliability.md').read_text().splitlines()
    # Scores alone: there are 25 times as many candidates.
    expected = reliability_table(predicted(FITTED, data.columns), data)
    assert written[-3].split(';')[:2] == expected[-1].split(';')[:2]
    assert written[-1] == f'{provenance()}.'


def test_candidates_seen_often_count_once(tmp_path):
    row = dict.fromkeys(COLUMNS, 1.0)
    rows = [list((row | {'evidence_id': i}).values()) for i in (1, 1, 1, 2)]
    path = tmp_path / 'one.json'
    path.write_text(json.dumps({'rows': rows}))
    assert observed([path]).weights == pytest.approx([1 / 3, 1 / 3, 1 / 3, 1.0])


def test_the_written_constants_are_those_of_the_model():
    found = {}
    exec(source(FITTED), found)
    assert all(
        getattr(found['FITTED'], field.name) == getattr(FITTED, field.name)
        for field in fields(FITTED)
    )


def test_hidden_area_belongs_to_the_nearest_frontier():
    frame = GridFrame(0.0, 0.0, 0.1)
    cells = np.ones((20, 60), dtype=np.bool_)
    cells[:, 30] = False
    known = np.full((20, 60), -1, dtype=np.int8)
    known[:, 20:40] = 0
    frontiers = [np.array([[10, 20]]), np.array([[10, 39]])]
    areas = hidden_areas(frontiers, frame, GridPatch(frame, known), ObservableCells(cells, frame))
    assert areas == pytest.approx([4.0, 4.0])
