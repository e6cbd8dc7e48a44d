"""Surfaces of the map of points against what they are in plain words."""

import math

import numpy as np
import pytest

from thinmap_ros.core.se2 import wrap
from thinmap_ros.core.slam.point_map import (
    CENTRE_X,
    CENTRE_Y,
    COUNT,
    LOOSE,
    MEAN_X,
    MEAN_Y,
    NORMAL_X,
    NORMAL_Y,
    UNFORMED,
    PointMap,
)

CELL_M, SEEN_FROM = 0.05, np.array([1.6, 0.1])


def scenes():
    """Noisy points: a corner, a wall with a jamb, a round column, clutter, beams far apart."""
    rng = np.random.default_rng(3)
    along = np.arange(0.2, 1.5, 0.02)
    wall = np.column_stack([along, np.full_like(along, 1.5)])
    corner = np.vstack([wall, np.column_stack([np.full_like(along, 0.2), along])])
    nearer = np.column_stack([along, np.full_like(along, 1.2)])
    jamb = np.vstack([nearer, [[1.5, 1.2 + 0.02 * k] for k in range(6)]])
    angles = np.linspace(math.pi, 1.5 * math.pi, 40)
    column = np.column_stack([1.5 + 0.3 * np.cos(angles), 1.5 + 0.3 * np.sin(angles)])
    clutter = rng.uniform(0.5, 1.1, (60, 2))
    sparse = np.array([[0.4, 0.5], [0.7, 0.8], [1.0, 0.5], [1.3, 0.8], [1.0, 1.2]])
    named = {'corner': corner, 'jamb': jamb, 'column': column, 'clutter': clutter, 'sparse': sparse}
    return [(name, points + rng.normal(0.0, 0.004, points.shape)) for name, points in named.items()]


def line(near, weights, normal=None):
    """Centre, normal, variance across and weighted along of points in a band through the origin."""
    if normal is not None:
        inside = np.abs(near @ normal) <= 0.025
        near, weights = near[inside], weights[inside]
    centre = np.average(near, axis=0, weights=weights)
    values, vectors = np.linalg.eigh((near - centre).T @ (weights[:, None] * (near - centre)))
    return centre, vectors[:, 0], max(values[0], 0.0) / weights.sum(), values[1], len(near)


def plain_surface(near, weights, firm):
    """Centre, normal and looseness, as the text of the kernel has it."""
    if len(near) < 3:
        return np.zeros(2), np.array([1.0, 0.0]), UNFORMED
    centre, normal, across, along, cells = line(near, weights)
    width = across
    if across > 0.01**2:
        turns = [
            np.array([math.cos(math.pi * k / 16), math.sin(math.pi * k / 16)]) for k in range(16)
        ]
        normal = max(turns, key=lambda n: weights[np.abs(near @ n) <= 0.025].sum())
        for _ in range(2):
            centre, normal, across, along, cells = line(near, weights, normal)
    if cells >= 3 and max(across, 0.01**2) <= along * math.radians(2.0) ** 2:
        return centre, normal, 0.0
    if width <= 0.02**2 or firm < 4.0:
        return centre, normal, UNFORMED
    return np.zeros(2), normal, 1.0


def test_some_of_every_kind_are_there():
    kinds = set()
    for _, points in scenes():
        cells = filled(points).cells
        kinds |= set(cells[cells[:, COUNT] > 0][:, LOOSE].tolist())
    assert kinds == {0.0, 1.0, UNFORMED}


def filled(points):
    points_map = PointMap(CELL_M, 30.0)
    points_map.add(points, SEEN_FROM)
    return points_map


@pytest.mark.parametrize(
    ('name', 'points'), scenes(), ids=lambda value: value if isinstance(value, str) else ''
)
def test_surfaces_are_what_the_plain_words_say(name, points):
    points_map = filled(points)
    numbers = points_map.tiles.pool[0]
    rows, cols = np.nonzero(numbers)
    cells = points_map.cells[numbers[rows, cols]].astype(np.float64)
    means, weights = cells[:, [MEAN_X, MEAN_Y]], np.minimum(cells[:, COUNT], 4.0)
    dense = np.minimum(cells[:, 8], 4.0)
    for k, cell in enumerate(cells):
        away = np.maximum(np.abs(rows - rows[k]), np.abs(cols - cols[k]))
        near = away <= 8
        expected = plain_surface((means - means[k])[near], weights[near], dense[away <= 4].sum())
        assert cell[LOOSE] == pytest.approx(expected[2]), (name, means[k])
        np.testing.assert_allclose(cell[[CENTRE_X, CENTRE_Y]] - means[k], expected[0], atol=1e-4)
        normal = expected[1]
        turn = math.atan2(cell[NORMAL_Y], cell[NORMAL_X]) - math.atan2(normal[1], normal[0])
        if cell[LOOSE] == 0.0:
            assert abs(float(wrap(2.0 * turn))) < 1e-3
            assert (SEEN_FROM - means[k]) @ cell[[NORMAL_X, NORMAL_Y]] >= 0.0
