"""Path lengths on the grid, compared with a textbook Dijkstra's algorithm."""

import heapq
import math

import numpy as np
import pytest

from thinmap_ros.core.planning.grid_search import distance_field_from, path_lengths_from


def dijkstra(allowed, start):
    steps = {start: 0}
    queue = [(0, start)]
    while queue:
        now, (row, col) = heapq.heappop(queue)
        if now > steps[row, col]:
            continue
        for dr, dc in [(dr, dc) for dr in (-1, 0, 1) for dc in (-1, 0, 1) if dr or dc]:
            r = row + dr
            c = col + dc
            inside = 0 <= r < allowed.shape[0] and 0 <= c < allowed.shape[1]
            if inside and allowed[r, c] and allowed[r, col] == allowed[row, c]:
                reached = now + (7 if dr and dc else 5)
                if reached < steps.get((r, c), math.inf):
                    steps[r, c] = reached
                    heapq.heappush(queue, (reached, (r, c)))
    return steps


@pytest.mark.parametrize('seed', range(5))
def test_paths_are_those_of_dijkstra(seed):
    rng = np.random.default_rng(seed)
    allowed = rng.random((40, 50)) < 0.75
    allowed[20, 20] = True
    goals = np.argwhere(np.ones_like(allowed))
    expected = dijkstra(allowed, (20, 20))
    found = path_lengths_from(allowed, (20, 20), goals)
    assert found.tolist() == [expected.get((r, c), math.inf) / 5 for r, c in goals.tolist()]


def test_few_goals_give_what_all_give_and_places_outside_cannot_be_reached():
    allowed = np.random.default_rng(9).random((30, 30)) < 0.8
    allowed[3, 3] = True
    everywhere = np.argwhere(np.ones_like(allowed))
    whole = path_lengths_from(allowed, (3, 3), everywhere)
    for i in (0, 77, 450, 899):
        assert path_lengths_from(allowed, (3, 3), everywhere[[i]])[0] == whole[i]
    assert path_lengths_from(allowed, (3, 3), np.array([[-1, 3], [3, 30]])).tolist() == [
        math.inf,
        math.inf,
    ]


@pytest.mark.parametrize(
    'start', [(-1, 3), (3, -1), (30, 3), (3, 30), (29, 31), (-2, 29), (10**9, 0), (0, -(10**9))]
)
def test_from_beyond_the_grid_nothing_can_be_reached(start):
    allowed = np.ones((30, 30), dtype=np.bool_)
    everywhere = np.argwhere(allowed)
    assert np.isinf(distance_field_from(allowed, start)).all()
    assert np.isinf(path_lengths_from(allowed, start, everywhere)).all()


def test_paths_are_at_most_a_twelfth_longer_than_straight_lines():
    goals = np.argwhere(np.ones((60, 60), dtype=np.bool_))[1:]
    ratio = path_lengths_from(np.ones((60, 60), dtype=np.bool_), (0, 0), goals) / np.hypot(*goals.T)
    assert ratio.min() > 0.98
    assert ratio.max() < 1.0 + 1.0 / 12.0
