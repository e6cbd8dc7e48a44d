"""Simplification of a skeleton graph: kept and removed chains."""

import numpy as np
import pytest
import reference_pruning
from hypothesis import given, settings
from hypothesis import strategies as st

from thinmap_ros.core.topology import net
from thinmap_ros.core.topology.net import web_of_net
from thinmap_ros.core.topology.pruning import Limits, Outlook
from thinmap_ros.core.topology.simplify import simplify
from thinmap_ros.core.topology.skeleton import net_along, simplified
from thinmap_ros.core.topology.skeleton_graph import Chain, Spot, Web, extent
from thinmap_ros.core.topology.thinning import thin

LIMITS = Limits(radius=2.5, spur=6.0, min_branch_ratio=0.5, join=4.0)
ROOMY = 36
EVERYWHERE = Outlook(np.ones((0, 0), dtype=bool), 0, 0)


def chain(web, *cells):
    """Chain along straight segments between cells, with vertices at its ends."""
    way = [cells[0]]
    for row, col in cells[1:]:
        while way[-1] != (row, col):
            way.append(
                (way[-1][0] + np.sign(row - way[-1][0]), way[-1][1] + np.sign(col - way[-1][1]))
            )
    known = {spot.cell: number for number, spot in web.spots.items()}
    for cell in {cells[0], cells[-1]} - set(known):
        known[cell] = web.add_spot(Spot(cell, ROOMY))
    ends = known[cells[0]], known[cells[-1]]
    return web.add_chain(Chain(*ends, np.array(way), np.full(len(way), ROOMY)))


def left_of(web):
    simplify(web, set(web.spots), EVERYWHERE, LIMITS)
    return sorted((len(c.cells), c.a == c.b) for c in web.chains.values())


@pytest.mark.parametrize('copies', [1, 2, 5])
def test_a_way_there_and_back_is_no_ring(copies):
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (0, 60))
    for _ in range(copies):
        chain(web, (0, 30), (12, 30), (0, 30))
    assert left_of(web) == [(61, False)]


def test_one_way_twice_is_one():
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (0, 50))
    chain(web, (0, 30), (0, 39), (1, 40), (0, 41), (0, 50))
    chain(web, (0, 50), (0, 80))
    assert left_of(web) == [(81, False)]


def test_a_ring_round_the_smallest_pillar_stays():
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (-3, 33), (0, 36))
    chain(web, (0, 30), (3, 33), (0, 36))
    chain(web, (0, 36), (0, 60))
    assert len(left_of(web)) == 4


def test_loops_that_are_cut_and_drawn_together_again_do_not_multiply():
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (0, 60))
    for _ in range(3):
        chain(web, (0, 30), (2, 30))
        chain(web, (2, 30), (0, 30))
    assert left_of(web) == [(61, False)]


def scribble(seed, size=60):
    """A skeleton with all cases of simplification, and inconsistent clearances."""
    rng = np.random.default_rng(seed)
    free = np.ones((size, size), dtype=bool)
    for row, col in rng.integers(0, size, (rng.integers(5, 60), 2)):
        free[row : row + rng.integers(1, 9), col : col + rng.integers(1, 9)] = False
    squared = rng.integers(6, rng.choice([9, 40, 200]), free.shape)
    return thin(free), lambda cells: squared[cells[:, 0], cells[:, 1]]


def said(web):
    spots = [(spot.cell, spot.squared) for spot in web.spots.values()]
    return spots, [
        (web.spots[c.a].cell, web.spots[c.b].cell, c.cells.tolist(), c.squared.tolist())
        for c in web.chains.values()
    ]


def looking(rim, row, col):
    """Reference for the outlook of a vertex."""
    marked = np.argwhere(rim) + (row, col)

    def promising(spot):
        if not (
            row <= spot.cell[0] < row + rim.shape[0] and col <= spot.cell[1] < col + rim.shape[1]
        ):
            return True
        return (
            ((marked - spot.cell) ** 2).sum(axis=1) <= (np.sqrt(spot.squared) + 1.0) ** 2
        ).sum() >= 3

    return promising


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_compiled_rules_are_the_plain_ones_wherever_they_are_applied(seed, everywhere):
    skeleton, measure = scribble(seed)
    rng = np.random.default_rng(seed + 1)
    limits = Limits(
        rng.uniform(0.0, 3.0), rng.uniform(0.0, 8.0), rng.uniform(0.0, 2.0), rng.uniform(0.0, 6.0)
    )
    outlook = Outlook(rng.random((30, 40)) < 0.1, *rng.integers(0, 20, 2).tolist())
    one, two = (web_of_net(net_along(skeleton, measure)) for _ in range(2))
    chosen = {spot for spot in one.spots if everywhere or rng.random() < 0.3}
    simplify(one, chosen, outlook, limits)
    reference_pruning.simplify(two, chosen, looking(*outlook), limits)
    assert said(one) == said(two)
    if everywhere:
        assert said(web_of_net(simplified(skeleton, measure, outlook, limits))) == said(two)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_what_was_left_out_at_first_is_fetched_where_it_is_needed(seed):
    rng = np.random.default_rng(seed)
    one, two = (web_of_net(net_along(*scribble(seed))) for _ in range(2))
    chosen = {spot for spot in one.spots if rng.random() < 0.1}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(net, '_REACH', 1)
        simplify(one, chosen, EVERYWHERE, LIMITS)
    reference_pruning.simplify(two, chosen, lambda spot: True, LIMITS)
    assert said(one) == said(two)


def test_room_is_made_for_a_long_way_of_many_pieces():
    web = Web()
    for col in range(0, 600, 2):
        chain(web, (0, col), (0, col + 2))
    assert left_of(web) == [(601, False)]


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(-40, 40), st.integers(-40, 40)), min_size=1, max_size=12))
def test_the_extent_of_a_chain_holds_its_cells_closely(corners):
    cells = np.array(corners)
    assert extent(cells) == (*cells.min(axis=0), *cells.max(axis=0))
