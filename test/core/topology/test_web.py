"""What simplifying a web keeps and what it drops."""

import numpy as np
import pytest

from thinmap_ros.core.topology.web import Chain, Limits, Spot, Web, simplify

LIMITS = Limits(radius=2.5, spur=6.0, spur_ratio=0.5, join=4.0)
ROOMY = 36


def chain(web, *cells):
    """Chain along straight pieces between cells, with spots where it begins and ends."""
    way = [cells[0]]
    for row, col in cells[1:]:
        while way[-1] != (row, col):
            way.append((way[-1][0] + np.sign(row - way[-1][0]), way[-1][1] + np.sign(col - way[-1][1])))
    known = {spot.cell: number for number, spot in web.spots.items()}
    for cell in {cells[0], cells[-1]} - set(known):
        known[cell] = web.add_spot(Spot(cell, ROOMY))
    ends = known[cells[0]], known[cells[-1]]
    return web.add_chain(Chain(*ends, np.array(way), np.full(len(way), ROOMY)))


def simplified(web):
    simplify(web, set(web.spots), lambda spot: True, LIMITS)
    return sorted((len(c.cells), c.a == c.b) for c in web.chains.values())


@pytest.mark.parametrize('copies', [1, 2, 5])
def test_a_way_there_and_back_is_no_ring(copies):
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (0, 60))
    for _ in range(copies):
        chain(web, (0, 30), (12, 30), (0, 30))
    assert simplified(web) == [(61, False)]


def test_one_way_twice_is_one():
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (0, 50))
    chain(web, (0, 30), (0, 39), (1, 40), (0, 41), (0, 50))
    chain(web, (0, 50), (0, 80))
    assert simplified(web) == [(81, False)]


def test_a_ring_round_the_smallest_pillar_stays():
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (-3, 33), (0, 36))
    chain(web, (0, 30), (3, 33), (0, 36))
    chain(web, (0, 36), (0, 60))
    assert len(simplified(web)) == 4


def test_loops_that_are_cut_and_drawn_together_again_do_not_multiply():
    web = Web()
    chain(web, (0, 0), (0, 30))
    chain(web, (0, 30), (0, 60))
    for _ in range(3):
        chain(web, (0, 30), (2, 30))
        chain(web, (2, 30), (0, 30))
    assert simplified(web) == [(61, False)]
